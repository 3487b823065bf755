"""The sketch itself, compiled for this computer with a stand-in for the chip; the program's decoder reads it."""

from pathlib import Path

import numpy as np
import pytest

from padforge.sense.rig.boards import line_framing as framing
from padforge.sense.rig.boards.line_board import LineAssembler, LineReader
from padforge.sense.rig.boards.line_framing import LineDecoder, LineHeader, Sample, header_line, sample_line
from padforge.sense.rig.devices import BoardSamples
from tests.sense.rig.boards.compiling import compiled, sent

FIRMWARE = Path(framing.__file__).parent / "firmware" / "padforge_line"
PAGE = Path(__file__).parents[4] / "docs" / "devices.md"
SAID = (("name", "padforge-line"),)
HEADERS = {
    "ESP32": LineHeader(500, 12, 3.3, 16, said=(*SAID, ("serial", "a1b2c3d4e5f6"))),
    "TEENSY": LineHeader(500, 12, 3.3, 16, said=SAID),
}
BOOT_US, PERIOD_US = 4_294_900_000, 2000


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled("line", FIRMWARE, tmp_path_factory.mktemp("firmware"), "ESP32")


def read(program: Path, *script: str) -> tuple[list[LineHeader | Sample], bytes]:
    stream, decoder = sent(program, list(script)), LineDecoder()
    found = decoder.feed(stream)
    assert decoder.damaged == 0
    return found, stream


def samples_of(found: list[LineHeader | Sample]) -> list[Sample]:
    return [each for each in found if isinstance(each, Sample)]


def taken_of(header: LineHeader, samples: list[Sample]) -> BoardSamples:
    lines = LineReader([each.time_us for each in samples], [each.counts for each in samples])
    return LineAssembler(header, range(header.channels)).samples([(1.0, lines)])


@pytest.mark.parametrize("board", ["ESP32", pytest.param("TEENSY", marks=pytest.mark.slow)])
def test_it_says_what_it_is_as_it_starts_and_whenever_it_is_asked(board: str, program: Path, tmp_path: Path) -> None:
    runs = program if board == "ESP32" else compiled("line", FIRMWARE, tmp_path, board)
    found, _ = read(runs, "run 5000", "host x", "host ?", "run 5000")
    assert [place for place, each in enumerate(found) if isinstance(each, LineHeader)] == [0, 4]
    assert found[0] == found[4] == HEADERS[board]


def test_every_input_is_read_in_its_turn_once_a_period(program: Path) -> None:
    found, stream = read(program, "run 400000")
    samples = samples_of(found)
    assert len(samples) == 200
    for number, sample in enumerate(samples):
        assert sample.counts == tuple((256 * i + number) % 4096 for i in range(16))
        assert 0 <= (sample.time_us - BOOT_US) % 2**32 - number * PERIOD_US < 10
    assert samples[-1].time_us < samples[0].time_us  # the clock has wrapped around
    header, *lines = stream.splitlines(keepends=True)
    assert header == header_line(HEADERS["ESP32"])
    assert lines == [sample_line(each.time_us, each.counts, True) for each in samples]


@pytest.mark.parametrize("trouble", ["held 9000", "room 700"])
def test_what_comes_too_late_or_cannot_be_sent_is_missing_and_the_rest_in_time(program: Path, trouble: str) -> None:
    found, _ = read(program, "run 20000", trouble, "run 20000", "room 1000000", "run 20000")
    samples = samples_of(found)
    missing = taken_of(HEADERS["ESP32"], samples).missing
    since_us = (np.array([each.time_us for each in samples]) - BOOT_US) % 2**32
    assert missing.sum() == since_us[-1] // PERIOD_US + 1 - len(samples) == (5 if trouble == "held 9000" else 3)
    assert (since_us % PERIOD_US < PERIOD_US / 4).all()


def test_the_sketch_that_the_page_begins_with_speaks_the_protocol(tmp_path: Path) -> None:
    (tmp_path / "sketch.ino").write_text(PAGE.read_text("utf-8").split("```cpp\n")[1].split("```")[0], "utf-8")
    runs = compiled("simplest", tmp_path, tmp_path)
    found, _ = read(runs, "run 100000", "host ?", "run 1000", "held 25000", "run 100000")
    header = LineHeader(100, 10, 5.0, 4, checked=False, said=(("name", "uno"),))
    assert [each for each in found if isinstance(each, LineHeader)] == [header, header]
    samples = samples_of(found)
    assert {each.counts for each in samples} == {(0, 100, 200, 300)}
    taken = taken_of(header, samples)
    assert (len(taken.times_s), taken.missing.sum()) == (21, 2)
