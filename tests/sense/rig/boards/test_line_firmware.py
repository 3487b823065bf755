"""The sketch itself, compile_sketch for this computer with a stand-in for the chip; the program's decoder reads it."""

import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from padforge.sense.rig.boards import line_board
from padforge.sense.rig.boards.line_board import LineAssembler, LineDecoder, LineHeader, LineSample
from padforge.sense.rig.devices import BoardSamples
from tests.emulators.boards import format_header, format_sample

FIRMWARE = Path(line_board.__file__).parent / "firmware" / "padforge_line"
PAGE = Path(__file__).parents[4] / "docs" / "howto-boards.md"
NAME = (("name", "padforge-line"),)
HEADERS = {
    "ESP32": LineHeader(500, 12, 3.3, 16, extra=(*NAME, ("serial", "a1b2c3d4e5f6"))),
    "TEENSY": LineHeader(500, 12, 3.3, 16, extra=NAME),
    "ARDUINO_SAM_DUE": LineHeader(
        1000, 16, 3.3, 12, extra=(("name", "padforge-due"), ("serial", b"serial-of-a-chip".hex()))
    ),
}
BOOT_US, PERIOD_US = 4_294_900_000, 2000


STUBS = Path(__file__).parent / "stub"


def compile_sketch(stub: str, sketch: Path, folder: Path, *defines: str) -> Path:
    """Compile a sketch with a stub for its chip; skip the test without g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("there is no g++")
    path = folder / "board"
    flags = ["-std=gnu++11", "-Wall", "-Wextra", "-Werror", *(f"-D{name}" for name in defines)]
    subprocess.run([compiler, *flags, "-I", STUBS, "-I", sketch, STUBS / f"{stub}.cpp", "-o", path], check=True)
    return path


def run_sketch(program: Path, script: list[str]) -> bytes:
    """Return what the board sends while it runs a script, see the stubs."""
    text = "\n".join(script).encode()
    return subprocess.run([program], input=text, capture_output=True, check=True, timeout=20).stdout


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """By the name of a board; each is compiled once."""
    return cache(lambda board: compile_sketch("line", FIRMWARE, tmp_path_factory.mktemp("firmware"), board))


@pytest.fixture
def program(programs: Callable[[str], Path]) -> Path:
    return programs("ESP32")


def read(program: Path, *script: str) -> tuple[list[LineHeader | LineSample], bytes]:
    stream, decoder = run_sketch(program, list(script)), LineDecoder()
    items = decoder.decode(stream)
    assert decoder.n_errors == 0
    return items, stream


def select_samples(items: list[LineHeader | LineSample]) -> list[LineSample]:
    return [item for item in items if isinstance(item, LineSample)]


def assemble(header: LineHeader, samples: list[LineSample]) -> BoardSamples:
    return LineAssembler(header, range(header.channels)).assemble([(1.0, samples)])


@pytest.mark.parametrize("board", ["ESP32", "ARDUINO_SAM_DUE", pytest.param("TEENSY", marks=pytest.mark.slow)])
def test_firmware_sends_header_at_start_and_on_request(board: str, programs: Callable[[str], Path]) -> None:
    items, _ = read(programs(board), "run 5000", "host x", "host ?", "run 5000")
    n_samples = 6 if board == "ARDUINO_SAM_DUE" else 3  # within 5 ms, and as the host says x
    assert [place for place, item in enumerate(items) if isinstance(item, LineHeader)] == [0, 1 + n_samples]
    assert items[0] == items[1 + n_samples] == HEADERS[board]


def test_firmware_samples_every_input_once_a_period(program: Path) -> None:
    items, stream = read(program, "run 400000")
    samples = select_samples(items)
    assert len(samples) == 200
    for number, sample in enumerate(samples):
        assert sample.counts == tuple((256 * i + number) % 4096 for i in range(16))
        assert 0 <= (sample.time_us - BOOT_US) % 2**32 - number * PERIOD_US < 10
    assert samples[-1].time_us < samples[0].time_us  # the clock has wrapped around
    header, *lines = stream.splitlines(keepends=True)
    assert header == format_header(HEADERS["ESP32"])
    assert lines == [format_sample(item.time_us, item.counts, True) for item in samples]


def test_due_averages_conversions_of_every_input(programs: Callable[[str], Path]) -> None:
    """Eight, after one that is dropped; the mean of 12 bits is told in 16."""
    header = HEADERS["ARDUINO_SAM_DUE"]
    items, _ = read(programs("ARDUINO_SAM_DUE"), "run 200000")
    samples = select_samples(items)
    assert len(samples) == 200
    conversions = (256 * np.arange(12)[:, None] + np.arange(8 * 200)) % 4096
    means = conversions.reshape(12, 200, 8).mean(axis=2).T
    assert [sample.counts for sample in samples] == [tuple(row) for row in np.floor(means * 65535 / 4095 + 0.5)]
    volts = assemble(header, samples).volts
    assert volts == pytest.approx(means * 3.3 / 4095, abs=3.3 / 65535)
    assert not assemble(header, samples).missing.any()


@pytest.mark.parametrize("trouble", ["held 9000", "room 700"])
def test_firmware_leaves_out_late_and_unsendable_lines(program: Path, trouble: str) -> None:
    items, _ = read(program, "run 20000", trouble, "run 20000", "room 1000000", "run 20000")
    samples = select_samples(items)
    missing = assemble(HEADERS["ESP32"], samples).missing
    since_us = (np.array([item.time_us for item in samples]) - BOOT_US) % 2**32
    assert missing.sum() == since_us[-1] // PERIOD_US + 1 - len(samples) == (5 if trouble == "held 9000" else 3)
    assert (since_us % PERIOD_US < PERIOD_US / 4).all()


def test_documented_sketch_speaks_protocol(tmp_path: Path) -> None:
    (tmp_path / "sketch.ino").write_text(PAGE.read_text("utf-8").split("```cpp\n")[1].split("```")[0], "utf-8")
    runs = compile_sketch("simplest", tmp_path, tmp_path)
    items, _ = read(runs, "run 100000", "host ?", "run 1000", "held 25000", "run 100000")
    header = LineHeader(100, 10, 5.0, 4, checked=False, extra=(("name", "uno"),))
    assert [item for item in items if isinstance(item, LineHeader)] == [header, header]
    samples = select_samples(items)
    assert {item.counts for item in samples} == {(0, 100, 200, 300)}
    samples_v = assemble(header, samples)
    assert (len(samples_v.times_s), samples_v.missing.sum()) == (21, 2)
