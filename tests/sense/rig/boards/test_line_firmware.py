"""Lines of text: read back in any portions and damaged in every way, and as the sketch itself sends them."""

import pickle
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.sense.rig.boards import line_board
from padforge.sense.rig.boards.line_board import LineAssembler, LineDecoder, LineHeader, LineSample
from padforge.sense.rig.devices import BoardSamples
from tests.emulators.boards import format_header, format_sample

PAGE = Path(__file__).parents[4] / "docs" / "howto-boards.md"
HEADER = LineHeader(500, 12, 3.3, 4, extra=(("name", "my-board"),))
SAMPLES = [LineSample(2000 * (k + 1), (2048 + k, 1991, 870 + k, 2003)) for k in range(3)]
LINES = [format_sample(sample.time_us, sample.counts, True) for sample in SAMPLES]


def decoded(*lines: bytes, header: bytes = format_header(HEADER)) -> tuple[list[LineHeader | LineSample], LineDecoder]:
    decoder = LineDecoder()
    decoder.decode(header)
    return decoder.decode(b"".join(lines)), decoder


def test_decode_reads_documented_example() -> None:
    """The one that whoever writes a board's program has before him."""
    text = PAGE.read_text("utf-8").split("```text\n")[1].split("```")[0]
    items = LineDecoder().decode(text.encode())
    assert items[0] == HEADER
    assert items[1:] == [LineSample(2000, (2048, 1991, 870, 2003)), LineSample(4000, (2049, 1990, 871, 2004))]


@settings(max_examples=15)
@given(st.data())
def test_decode_returns_lines_in_any_portions(data: st.DataObject) -> None:
    header = LineHeader(
        data.draw(st.sampled_from([10.0, 333.25, 10_000.0])),
        data.draw(st.integers(1, 24)),
        data.draw(st.sampled_from([0.1, 1.1, 5.0])),
        data.draw(st.integers(1, 20)),
        data.draw(st.booleans()),
    )
    counts = st.tuples(*[st.integers(0, header.full_scale)] * header.channels)
    samples = data.draw(st.lists(st.builds(LineSample, st.integers(0, 2**63 - 1), counts), max_size=9))
    sent = [format_header(header), *(format_sample(each.time_us, each.counts, header.checked) for each in samples)]
    stream = b"".join(sent)
    if data.draw(st.booleans()):
        stream = stream.replace(b"\n", b"\r\n")
    decoder, items, at = LineDecoder(), [], 0
    while at < len(stream):
        size = data.draw(st.integers(1, 100))
        items += decoder.decode(stream[at : at + size])
        at += size
    assert items == [header, *samples]


def test_decode_never_returns_wrong_sample_for_damaged_line() -> None:
    """Every flipped bit, every byte dropped, doubled or replaced, and every pair of neighbours swapped."""
    line = LINES[1]
    for i in range(len(line)):
        others = [bytes([line[i] ^ 1 << bit]) for bit in range(8)] + [b"", line[i : i + 1] * 2, b"7", b",", b"\n"]
        damaged = [line[:i] + other + line[i + 1 :] for other in others if other != line[i : i + 1]]
        damaged.append(line[:i] + line[i : i + 2][::-1] + line[i + 2 :])
        for bad_line in damaged:
            items, _ = decoded(LINES[0], bad_line, LINES[2])
            assert [sample for sample in items if sample not in (SAMPLES[0], SAMPLES[2])] in ([], [SAMPLES[1]])
            assert items[0] == SAMPLES[0]


def test_decode_skips_comments_and_counts_bad_lines() -> None:
    short = format_sample(2000, (1, 2, 3), True)
    items, decoder = decoded(b"# warming up\n", LINES[0], b"#\n\n")
    assert (items, decoder.n_errors) == ([SAMPLES[0]], 0)
    decoder.decode(short + short + b"1,2\n# hot\n")
    assert (decoder.n_errors, decoder.error[:21]) == (3, "a line has 4 numbers,")
    header = b"# padforge-line 1 rate_hz=100 bits=10 reference_v=5 channels=2\r\n"  # its check is optional
    items, decoder = decoded(b"10,1,2\r\n", b"20,1,3*00000000\n", header=header)
    assert (items, decoder.n_errors) == ([LineSample(10, (1, 2))], 1)
    assert LineDecoder().decode(b"boot: 1,2,3\n" + LINES[0]) == []


THREE = LineHeader(1000, 10, 5.0, 3)


def read(times_us: list[int] | np.ndarray, assembler: LineAssembler | None = None) -> BoardSamples:
    """The samples of lines of these times, all come at once; the first count is the number of the line."""
    assembler = assembler or LineAssembler(THREE, (0, 1, 2))
    samples = [LineSample(int(time_us), (k, 10, 1023)) for k, time_us in enumerate(times_us)]
    return assembler.assemble([(1.0, samples)])


WRAPPED = ((2**32 - 3000 + 1000 * np.array([0, 1, 4, 5, 25])) % 2**32).tolist()


@pytest.mark.parametrize(
    ("times_us", "kept_lines", "missing"),
    [
        (WRAPPED, [0, 1, 2, 3, 4], [0, 0, 2, 0, 19]),
        ([2**40 + 1000, 2**40 + 2000, 2**40 + 5000], [0, 1, 2], [0, 0, 2]),
        ([1000, 2000, 5000, 5100, 5200, 6000, 7000], [0, 1, 2, 5, 6], [0, 0, 2, 0, 0]),
        ([1000, 2000, 2_003_000_000, 4000, 17, 6000], [0, 1, 3, 5], [0, 0, 1, 1]),
    ],
    ids=["a time that wraps", "a time that does not wrap", "lines held up and sent in a bunch", "times that cannot be"],
)
def test_assemble_counts_empty_slots_as_missing(times_us, kept_lines, missing) -> None:
    samples = read(times_us)
    assert np.rint(samples.volts[:, 0] * 1023 / 5).astype(int).tolist() == kept_lines
    assert samples.missing.tolist() == missing
    assert np.diff(samples.times_s) == pytest.approx(1e-3 * (1 + samples.missing[1:]), rel=1e-3)


@pytest.mark.parametrize("share", [0.98, 1.001])
def test_assemble_follows_inexact_rate_and_late_lines(share: float) -> None:
    rng, assembler = np.random.default_rng(0), LineAssembler(THREE, (0, 1, 2))
    samples = read(np.cumsum(np.full(2000, 1000 / share)) + rng.uniform(-150, 150, 2000), assembler)
    assert len(samples.times_s) == 2000
    assert not samples.missing.any()
    assert len(pickle.dumps(assembler)) < 10_000
    slots = np.sort(rng.choice(4000, 3000, replace=False))
    samples = read(1000 * slots + rng.uniform(0, 450, 3000))
    assert np.array_equal(np.cumsum(1 + samples.missing) - 1, slots - slots[0])


def test_assemble_gives_volts_of_the_inputs_asked_for_in_their_order() -> None:
    """The highest count of 10 bits, 1023, is the reference."""
    assembler = LineAssembler(LineHeader(1000, 10, 5.0, 3), (2, 0, 2))
    samples = assembler.assemble([(1.0, [LineSample(1000, (0, 1, 1023)), LineSample(2000, (341, 5, 682))])])
    np.testing.assert_allclose(samples.volts, [[5, 0, 5], [10 / 3, 5 / 3, 10 / 3]])


FIRMWARE = Path(line_board.__file__).parent / "firmware" / "padforge_line"
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


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """By the name of a board; each is compiled once."""
    return cache(lambda board: compile_sketch("line", FIRMWARE, tmp_path_factory.mktemp("firmware"), board))


Items = list[LineHeader | LineSample]


def run_and_decode(program: Path, *script: str) -> tuple[Items, list[LineSample], bytes]:
    """What the board sends while it runs a script, see the stubs: headers and samples, the samples alone, and bytes."""
    text, decoder = "\n".join(script).encode(), LineDecoder()
    stream = subprocess.run([program], input=text, capture_output=True, check=True, timeout=20).stdout
    items = decoder.decode(stream)
    assert decoder.n_errors == 0
    return items, [item for item in items if isinstance(item, LineSample)], stream


def assemble(header: LineHeader, samples: list[LineSample]) -> BoardSamples:
    return LineAssembler(header, range(header.channels)).assemble([(1.0, samples)])


@pytest.mark.parametrize("board", ["ESP32", "ARDUINO_SAM_DUE", pytest.param("TEENSY", marks=pytest.mark.slow)])
def test_firmware_sends_header_at_start_and_on_request(board: str, programs: Callable[[str], Path]) -> None:
    items, *_ = run_and_decode(programs(board), "run 5000", "host x", "host ?", "run 5000")
    n_samples = 6 if board == "ARDUINO_SAM_DUE" else 3  # within 5 ms, and as the host says x
    assert [place for place, item in enumerate(items) if isinstance(item, LineHeader)] == [0, 1 + n_samples]
    assert items[0] == items[1 + n_samples] == HEADERS[board]


def test_firmware_samples_every_input_once_a_period(programs: Callable[[str], Path]) -> None:
    _, samples, stream = run_and_decode(programs("ESP32"), "run 400000")
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
    _, samples, _ = run_and_decode(programs("ARDUINO_SAM_DUE"), "run 200000")
    assert len(samples) == 200
    conversions = (256 * np.arange(12)[:, None] + np.arange(8 * 200)) % 4096
    means = conversions.reshape(12, 200, 8).mean(axis=2).T
    assert [sample.counts for sample in samples] == [tuple(row) for row in np.floor(means * 65535 / 4095 + 0.5)]
    volts = assemble(header, samples).volts
    assert volts == pytest.approx(means * 3.3 / 4095, abs=3.3 / 65535)
    assert not assemble(header, samples).missing.any()


@pytest.mark.parametrize("trouble", ["held 9000", "room 700"])
def test_firmware_leaves_out_late_and_unsendable_lines(programs: Callable[[str], Path], trouble: str) -> None:
    script = ("run 20000", trouble, "run 20000", "room 1000000", "run 20000")
    _, samples, _ = run_and_decode(programs("ESP32"), *script)
    missing = assemble(HEADERS["ESP32"], samples).missing
    since_us = (np.array([item.time_us for item in samples]) - BOOT_US) % 2**32
    assert missing.sum() == since_us[-1] // PERIOD_US + 1 - len(samples) == (5 if trouble == "held 9000" else 3)
    assert (since_us % PERIOD_US < PERIOD_US / 4).all()


def test_documented_sketch_speaks_protocol(tmp_path: Path) -> None:
    (tmp_path / "sketch.ino").write_text(PAGE.read_text("utf-8").split("```cpp\n")[1].split("```")[0], "utf-8")
    runs = compile_sketch("simplest", tmp_path, tmp_path)
    items, samples, _ = run_and_decode(runs, "run 100000", "host ?", "run 1000", "held 25000", "run 100000")
    header = LineHeader(100, 10, 5.0, 4, checked=False, extra=(("name", "uno"),))
    assert [item for item in items if isinstance(item, LineHeader)] == [header, header]
    assert {item.counts for item in samples} == {(0, 100, 200, 300)}
    samples_v = assemble(header, samples)
    assert (len(samples_v.times_s), samples_v.missing.sum()) == (21, 2)
