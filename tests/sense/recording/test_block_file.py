"""Block files: rows are read back exactly, a torn end is cut off, other damage is an error."""

import io
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from padforge.common.validation import InputError
from padforge.sense.recording.block_file import BlockWriter, block_dtype, read_blocks


def write(path: Path, rows: np.ndarray, cuts: Sequence[int] = (), flush: bool = False) -> None:
    with path.open("wb") as file:
        writer = BlockWriter(file, rows.shape[1] - 1)
        for part in np.split(rows, cuts):
            writer.append(part)
            if flush:
                writer.flush()
        writer.flush()


def some_rows(count: int, fibres: int) -> np.ndarray:
    return np.random.default_rng(count).standard_normal((count, 1 + fibres))


@settings(max_examples=25)
@given(
    count=st.integers(0, 60),
    fibres=st.integers(1, 40),
    cuts=st.lists(st.integers(0, 60), max_size=5),
    flush=st.booleans(),
)
def test_block_file_round_trip(tmp_path_factory, count: int, fibres: int, cuts: list[int], flush: bool) -> None:
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    rows = some_rows(count, fibres)
    write(path, rows, sorted(cuts), flush)
    assert np.array_equal(np.column_stack(read_blocks(path, fibres)), rows)


@settings(max_examples=25)
@given(size=st.integers(0, 10 * 256), zeros=st.sampled_from([0, 13, 700]))
def test_read_blocks_cuts_off_a_torn_tail(tmp_path_factory, size: int, zeros: int) -> None:
    """Also one of zeros, as a crashed disk leaves it. Blocks are a multiple of 256 bytes and hold four rows or more."""
    for fibres, size in ((1, 256), (6, 256), (7, 512), (128, 4352), (512, 16640)):
        assert block_dtype(fibres).itemsize == size
        assert block_dtype(fibres)["rows"].shape[0] >= 4
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    rows = some_rows(40, 6)
    write(path, rows)
    assume(not zeros or size % 256 < 248)  # the last 8 bytes of a block are zeros
    path.write_bytes(path.read_bytes()[:size] + bytes(zeros))
    assert np.array_equal(np.column_stack(read_blocks(path, 6)), rows[: size // 256 * 4])


@settings(max_examples=25)
@given(byte=st.integers(0, 9 * 256 - 1), bit=st.integers(0, 7))
def test_read_blocks_refuses_a_flipped_bit(tmp_path_factory, byte: int, bit: int) -> None:
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    write(path, some_rows(40, 6))
    content = bytearray(path.read_bytes())
    content[byte] ^= 1 << bit
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"block {byte // 256} .*damaged"):
        read_blocks(path, 6)


def test_read_blocks_refuses_a_lost_block_and_another_count(tmp_path: Path) -> None:
    write(tmp_path / "s", some_rows(40, 6))
    content = (tmp_path / "s").read_bytes()
    block = bytearray(content[8 * 256 : 9 * 256])
    block[16:20] = (3).to_bytes(4, "little")
    block[20:24] = zlib.crc32(block[24:], zlib.crc32(block[:20])).to_bytes(4, "little")
    damaged = {"2": content[:512] + content[768:], "[89]": content[: 8 * 256] + block + content[9 * 256 :]}
    for number, each in damaged.items():
        (tmp_path / "s").write_bytes(each)
        with pytest.raises(InputError, match=rf"block {number} .*damaged"):
            read_blocks(tmp_path / "s", 6)


@settings(max_examples=20)
@given(fails=st.sets(st.integers(0, 30), max_size=8), share=st.floats(0, 1))
def test_block_writer_repairs_failed_writes(tmp_path_factory, fails: set[int], share: float) -> None:
    path, rows, calls = tmp_path_factory.mktemp("flaky") / "s", some_rows(40, 6), iter(range(999))

    class Flaky(io.FileIO):
        def write(self, data) -> int:
            if next(calls) in fails:
                super().write(bytes(data)[: int(share * len(data))])
                raise OSError(28, "No space left on device")
            return super().write(data)

    with Flaky(path, "w") as file:
        writer = BlockWriter(file, 6)
        for part in np.split(rows, 8):
            for work in (lambda part=part: writer.append(part), writer.flush):
                while True:
                    try:
                        work()
                        break
                    except OSError:
                        continue
    assert np.array_equal(np.column_stack(read_blocks(path, 6)), rows)
