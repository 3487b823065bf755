"""An append-only file of readings in blocks, each with a checksum.

All blocks have the same size: a header (magic number, sequence number, index of the first reading, number of readings,
CRC-32 of the block without this field), rows of float64 (time in s, then one voltage per fibre) and zeros. A killed
writer leaves at worst a torn last block, which is ignored in reading; damage before an intact block is an error.
"""

import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from padforge.common.files import check_file, to_disk
from padforge.common.validation import InputError
from padforge.sense.arrays import MAX_BYTES, Array, Mask

_MAGIC = b"PFB1"
_UNIT = 256  # the size of a block is a multiple of this, bytes
_CRC_OFFSET = 20  # offset of the checksum, bytes
_HEADER = 24  # size of the header, bytes


def block_dtype(fibres: int) -> np.dtype[np.void]:
    """Return the layout of a block: little-endian, at least four rows of 1 + `fibres` numbers."""
    row = 8 * (1 + fibres)
    size = -(-(_HEADER + 4 * row) // _UNIT) * _UNIT
    rows = (size - _HEADER) // row
    names = ["magic", "sequence", "first", "count", "crc", "rows"]
    formats = ["S4", "<u4", "<u8", "<u4", "<u4", ("<f8", (rows, 1 + fibres))]
    offsets = [0, 4, 8, 16, _CRC_OFFSET, _HEADER]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


class BlockWriter:
    """Appends rows to a file: full blocks at once, the remaining rows at `flush`.

    A failed write adds nothing; the next one overwrites its remains. The file is open for writing in place, and has
    `blocks` blocks of `rows` rows in all.
    """

    def __init__(self, file: BinaryIO, fibres: int, blocks: int = 0, rows: int = 0) -> None:
        self._file = file
        self.fibres = fibres
        self._dtype = block_dtype(fibres)
        self._rows = self._dtype["rows"].shape[0]
        self._pending = np.empty((0, 1 + fibres))
        self._sequence = blocks
        self._first = rows

    @classmethod
    def resume(cls, path: Path, fibres: int) -> tuple["BlockWriter", Array]:
        """Cut off the torn tail of a file; return a writer, and the (R,) times of its rows."""
        blocks = _intact_blocks(path, fibres)
        times_s = blocks["rows"][_has_row(blocks), 0]
        file = path.open("r+b", buffering=0)
        file.seek(blocks.nbytes)
        file.truncate()
        return cls(file, fibres, len(blocks), len(times_s)), times_s

    def append(self, rows: Array) -> None:
        """Add (n, 1 + C) rows of time and volts."""
        rows = np.concatenate([self._pending, rows])
        n_full = len(rows) // self._rows * self._rows
        self._write(rows[:n_full])
        self._pending = rows[n_full:]

    def flush(self) -> None:
        """Write the pending rows as an incomplete block."""
        self._write(self._pending)
        self._pending = self._pending[:0]
        self._file.flush()

    def sync(self) -> None:
        """Write everything to the disk."""
        self.flush()
        to_disk(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

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
    """Write all data at a position; after a failure, repeat the call to overwrite what was written in part."""
    file.seek(position)
    remaining = memoryview(data)
    while remaining:
        remaining = remaining[file.write(remaining) :]


def read_blocks(path: Path, fibres: int) -> tuple[Array, Array]:
    """Return times (R,) and values (R, C) of all rows before a torn tail; raise InputError for other damage."""
    blocks = _intact_blocks(path, fibres)
    has_row = _has_row(blocks)
    return blocks["rows"][has_row, 0], blocks["rows"][has_row, 1:]


def _has_row(blocks: NDArray[np.void]) -> Mask:
    """Return whether each row of blocks (B,) is filled; shape (B, rows of a block)."""
    return np.arange(blocks.dtype["rows"].shape[0]) < blocks["count"][:, None]


def _intact_blocks(path: Path, fibres: int) -> NDArray[np.void]:
    """Return the blocks before the first one with a wrong magic number, checksum or position.

    The file is memory-mapped, since it may have gigabytes.
    """
    dtype = block_dtype(fibres)
    try:
        n_blocks = check_file(path, MAX_BYTES).stat().st_size // dtype.itemsize
        # An empty file cannot be mapped.
        blocks = np.asarray(np.memmap(path, dtype, "r", shape=(n_blocks,))) if n_blocks else np.empty(0, dtype)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    counts = blocks["count"].astype(np.int64)
    is_block = (blocks["magic"] == _MAGIC) & (blocks["crc"] == _checksums(blocks))
    is_intact = is_block & (blocks["sequence"] == np.arange(n_blocks)) & (blocks["first"] == np.cumsum(counts) - counts)
    end = int(np.argmin(np.append(is_intact, False)))
    if is_block[end:].any():
        raise InputError(
            f"{path}: block {end} (byte {end * dtype.itemsize}) is damaged although intact blocks follow, "
            "allowed is a torn end of the file only"
        )
    return blocks[:end]


def _checksums(blocks: NDArray[np.void]) -> NDArray[np.uint32]:
    """Return the CRC-32 (B,) of each block without its checksum field."""
    view = np.ascontiguousarray(blocks).view(np.uint8).data  # copies nothing of a mapped file
    size = blocks.dtype.itemsize
    crcs = np.empty(len(blocks), np.uint32)
    for i in range(len(blocks)):
        block = view[i * size : (i + 1) * size]
        crcs[i] = zlib.crc32(block[_CRC_OFFSET + 4 :], zlib.crc32(block[:_CRC_OFFSET]))
    return crcs
