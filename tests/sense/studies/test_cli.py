"""`padforge study` from the outside."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import padforge


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["robustness", "nowhere.json"], "nowhere.json: no such file, and none of square, optimised, random-N"),
        (["robustness", "square", "square"], "one called square is there already"),
        (["robustness", "square", "--presses", "1000"], "presses is 1000, allowed is a square number from 4"),
        (["robustness", "square@0"], "square@0: no such file"),
        (["scaling", "square", "--grids", "4,x"], "grids is '4,x', expected numbers from 2 to 256"),
        (["scaling", "square@3", "--grids", "4"], "grids has 4, expected multiples of 3"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["padforge", "study", *arguments, "--out", "out"])
    with pytest.raises(SystemExit) as caught:
        padforge.main()
    err = capsys.readouterr().err
    assert caught.value.code == 2
    assert said in err
    assert len(err.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_an_interrupt_ends_at_once_and_keeps_what_was_finished(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "padforge", "study", "robustness", "square@6", "--presses", "256"]
    study = subprocess.Popen(
        [*command, "--out", str(out)],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not list(out.glob("robustness-unfinished/start_*.npz")) and time.monotonic() < deadline:
            time.sleep(0.1)
        study.send_signal(signal.SIGINT)
        begin = time.monotonic()
        _, said = study.communicate(timeout=60)
    finally:
        study.kill()
    assert study.returncode == 130
    assert said == "padforge: interrupted; --resume goes on from what was finished\n"
    assert time.monotonic() - begin < 30
    assert list(out.glob("robustness-unfinished/start_*.npz"))
