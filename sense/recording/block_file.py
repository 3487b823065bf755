"""An append-only file of readings in blocks, each with a checksum.

Blocks have one size: a header (magic, sequence number, index of the first reading, number of readings, CRC-32 of all
but itself), rows of float64 (time in s, then one voltage per fibre) and zeros. A writer that dies leaves at worst a
torn last block, which is cut off by readers; damage before an intact block has another cause, and is an error.
"""

import os
import re
import zlib
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import check_file
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_BYTES, MAX_FIBRES, Array

_MAGIC = b"PFB1"
_UNIT = 256
_COUNT_OFFSET, _CRC_OFFSET = 16, 20
_HEADER = 24
_CHUNK_BYTES = 2**22  # of a file that are read at once


def open_in_place(path: Path) -> BinaryIO:
    """Open an existing file for reading and writing in place, unbuffered, without following a symbolic link."""
    file = path.open("r+b", buffering=0)
    if not os.path.samestat(os.fstat(file.fileno()), path.lstat()):
        file.close()
        raise InputError(f"{path}: is a link, and none is followed where a file is continued")
    return file


def block_dtype(fibres: int) -> np.dtype[np.void]:
    """Return the layout of a block: little-endian, four or more rows of 1 + `fibres` numbers, n x 256 bytes."""
    row = 8 * (1 + fibres)
    size = -(-(_HEADER + 4 * row) // _UNIT) * _UNIT
    rows = (size - _HEADER) // row
    names = ["magic", "sequence", "first", "count", "crc", "rows"]
    formats = ["S4", "<u4", "<u8", "<u4", "<u4", ("<f8", (rows, 1 + fibres))]
    offsets = [0, 4, 8, _COUNT_OFFSET, _CRC_OFFSET, _HEADER]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


class BlockWriter:
    """Appends rows to an open file: full blocks at once, the remaining rows at `flush`.

    A write that fails adds nothing, and the next one overwrites what it left. `blocks` and `rows` count what the file,
    open for writing in place, has already.
    """

    def __init__(self, file: BinaryIO, fibres: int, blocks: int = 0, rows: int = 0) -> None:
        self._file = file
        self.fibres = fibres
        self._dtype = block_dtype(fibres)
        self._rows = self._dtype["rows"].shape[0]
        self._waiting = np.empty((0, 1 + fibres))
        self._sequence = blocks
        self._first = rows

    @classmethod
    def resume(cls, path: Path, fibres: int) -> tuple["BlockWriter", BinaryIO, Array]:
        """Cut off the torn tail of a file; return a writer, the open file, and the (R,) times of its rows."""
        times_s, _, _ = read_blocks(path, fibres)
        dtype = block_dtype(fibres)
        file = open_in_place(path)
        blocks = sum(map(len, _intact_chunks(file, dtype)))
        file.seek(blocks * dtype.itemsize)
        file.truncate()
        return cls(file, fibres, blocks, len(times_s)), file, times_s

    def append(self, rows: Array) -> None:
        """Add (n, 1 + C) rows of time and volts."""
        rows = np.concatenate([self._waiting, rows])
        n_full = len(rows) // self._rows * self._rows
        self._write(rows[:n_full])
        self._waiting = rows[n_full:]

    def flush(self) -> None:
        """Write the waiting rows as a block that is not full."""
        self._write(self._waiting)
        self._waiting = self._waiting[:0]
        self._file.flush()

    def _write(self, rows: Array) -> None:
        blocks = np.zeros(-(-len(rows) // self._rows), self._dtype)
        starts = np.arange(len(blocks)) * self._rows
        blocks["magic"] = _MAGIC
        blocks["sequence"] = self._sequence + np.arange(len(blocks))
        blocks["first"] = self._first + starts
        blocks["count"] = np.minimum(self._rows, len(rows) - starts)
        payload = np.zeros((len(blocks) * self._rows, rows.shape[1]))
        payload[: len(rows)] = rows
        blocks["rows"] = payload.reshape(blocks["rows"].shape)
        blocks["crc"] = _checksums(blocks)
        write_at(self._file, self._sequence * self._dtype.itemsize, blocks.tobytes())
        self._sequence += len(blocks)
        self._first += len(rows)


def write_at(file: BinaryIO, position: int, data: bytes) -> None:
    """Write all data at a position; after a failure, writing again repairs what is there in part."""
    file.seek(position)
    remaining = memoryview(data)
    while remaining:
        remaining = remaining[file.write(remaining) :]


def read_blocks(path: Path, fibres: int) -> tuple[Array, Array, bool]:
    """Return times (R,) and values (R, C) of all intact rows, and whether a torn tail follows; refuse other damage.

    The file is read in chunks, straight into the arrays: it may have gigabytes.
    """
    dtype = block_dtype(fibres)
    try:
        with check_file(path, MAX_BYTES).open("rb") as file:
            n_blocks = os.fstat(file.fileno()).st_size // dtype.itemsize
            max_rows = n_blocks * dtype["rows"].shape[0]
            times_s, values = np.empty(max_rows), np.empty((max_rows, fibres))
            end = n_rows = 0
            for blocks in _intact_chunks(file, dtype):
                rows = blocks["rows"][np.arange(dtype["rows"].shape[0]) < blocks["count"][:, None]]
                part = slice(n_rows, n_rows + len(rows))
                times_s[part], values[part] = rows[:, 0], rows[:, 1:]
                end, n_rows = end + len(blocks), part.stop
            file.seek(end * dtype.itemsize)
            tail = file.read()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if _has_block(tail, dtype):
        raise InputError(
            f"{path}: block {end} (byte {end * dtype.itemsize}) is damaged although intact blocks follow, "
            "allowed is a torn end of the file only"
        )
    if _begins_with_block(tail):  # a writer that died does not leave it
        raise InputError(f"{path}: block {end} is whole, but not of {fibres} fibres, as the recording says it is")
    # In place, no view of a larger array: nothing else has them.
    times_s.resize(n_rows, refcheck=False)
    values.resize((n_rows, fibres), refcheck=False)
    return times_s, values, bool(tail)


def _intact_chunks(file: BinaryIO, dtype: np.dtype[np.void]) -> Iterator[NDArray[np.void]]:
    """Yield the blocks before the first one that is not intact, in chunks, as far as the file goes now."""
    remaining = os.fstat(file.fileno()).st_size // dtype.itemsize  # it may grow meanwhile
    sequence = first = 0
    while remaining:
        n_blocks = min(remaining, max(1, _CHUNK_BYTES // dtype.itemsize))
        blocks = _intact_blocks(file.read(n_blocks * dtype.itemsize), dtype, sequence, first)
        yield blocks
        if len(blocks) < n_blocks:
            return
        sequence, first = sequence + n_blocks, first + int(blocks["count"].sum())
        remaining -= n_blocks


def _intact_blocks(content: bytes, dtype: np.dtype[np.void], sequence: int, first: int) -> NDArray[np.void]:
    """Return the blocks before the first without its magic and checksum, or that was written elsewhere.

    The content begins with block number `sequence`, whose first row is row number `first`.
    """
    blocks = np.frombuffer(content, dtype, count=len(content) // dtype.itemsize)
    counts = blocks["count"].astype(np.int64)
    is_intact = (
        (blocks["magic"] == _MAGIC)
        & (blocks["crc"] == _checksums(blocks))
        & (blocks["sequence"] == sequence + np.arange(len(blocks)))
        & (blocks["first"] == first + np.cumsum(counts) - counts)
        & (counts <= dtype["rows"].shape[0])
    )
    return blocks[: int(np.argmin(np.append(is_intact, False)))]


def _begins_with_block(content: bytes) -> bool:
    """Whether the content begins with an intact block of any number of fibres."""
    dtypes = map(block_dtype, range(1, MAX_FIBRES + 1))
    fitting = takewhile(lambda dtype: dtype.itemsize <= len(content), dtypes)
    return content.startswith(_MAGIC) and any(_has_valid_crc(content, dtype, 0) for dtype in fitting)


def _has_block(content: bytes, dtype: np.dtype[np.void]) -> bool:
    """Whether the content has an intact block at any offset."""
    for match in re.finditer(re.escape(_MAGIC), content[: max(len(content) - dtype.itemsize + len(_MAGIC), 0)]):
        start = match.start()
        count = int.from_bytes(content[start + _COUNT_OFFSET : start + _CRC_OFFSET], "little")
        # The count is checked first: that is quick, in a file full of magic words.
        if count <= dtype["rows"].shape[0] and _has_valid_crc(content, dtype, start):
            return True
    return False


def _has_valid_crc(content: bytes, dtype: np.dtype[np.void], start: int) -> bool:
    block = np.frombuffer(content, dtype, count=1, offset=start)
    return bool(block["crc"][0] == _checksums(block)[0])


def _checksums(blocks: NDArray[np.void]) -> NDArray[np.uint32]:
    """Return (B,) CRC-32 of each block without its checksum field."""
    view = np.ascontiguousarray(blocks).view(np.uint8).data  # no copy of what was read, which may be gigabytes
    size = blocks.dtype.itemsize
    crcs = np.empty(len(blocks), np.uint32)
    for i in range(len(blocks)):
        block = view[i * size : (i + 1) * size]
        crcs[i] = zlib.crc32(block[_CRC_OFFSET + 4 :], zlib.crc32(block[:_CRC_OFFSET]))
    return crcs
