"""The programs of the page on using a pad in one's own."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
import serial

from padforge.sense import Recording
from padforge.sense.localizer.model import LocalizerModel
from tests.docs.pages import ROOT
from tests.sense.recording.test_frames import repeated

PAGE = (ROOT / "docs" / "howto-program.md").read_text(encoding="utf-8")
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
PLACE = re.compile(r"press (\d+): (-?[\d.]+), (-?[\d.]+) mm, within")


def check_places(printed: str, recording: Recording) -> int:
    """Check that presses are located at all that well; return how many lines say so."""
    places = np.array(PLACE.findall(printed), dtype=float)
    assert len(places) == len(printed.splitlines())
    pressed_mm = recording.presses_mm[places[:, 0].astype(int)]
    assert np.median(np.hypot(*(places[:, 1:] - pressed_mm).T)) < 6
    return len(places)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs run in a folder of their own."""
    monkeypatch.chdir(tmp_path)


def test_program_prints_each_press(localizer: LocalizerModel, recording: Recording, capsys) -> None:
    localizer.save("out/example")
    recording.save("out/example/recording", {})
    exec(PROGRAMS[0], {})
    assert check_places(capsys.readouterr().out, recording) == 9


def test_program_reads_a_board(localizer: LocalizerModel, recording: Recording, monkeypatch, capsys) -> None:
    """A board that prints 106 lines a second, until it is unplugged."""
    stream = repeated(recording, 8)
    times_s, rows = iter(stream.times_s[:1500].tolist()), iter(stream.readings[:1500])

    class Board:
        def __init__(self, port: str, baud: int) -> None:
            assert (port, baud) == ("/dev/ttyACM0", 115200)

        def __enter__(self) -> "Board":
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def readline(self) -> bytes:
            return ",".join(f"{volts:.6f}" for volts in next(rows)).encode() + b"\r\n"

    localizer.save("out/pad")
    with monkeypatch.context() as patched:
        patched.setattr(serial, "Serial", Board)
        patched.setattr(time, "monotonic", lambda: next(times_s))
        with pytest.raises(StopIteration):
            exec(PROGRAMS[1], {})
    assert check_places(capsys.readouterr().out, recording) > 40
