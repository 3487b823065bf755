"""An append-only stream of readings in blocks, each of which proves itself whole.

A file is a run of blocks of one size. A block is a header (magic, sequence number, index of its first reading, count
of readings, checksum), `count` rows of float64 (time in s, then one voltage per fibre) and zeros up to the size; the
CRC-32 covers all of the block but itself. A writer that dies leaves at worst a torn last block, which a reader cuts
off; damage before an intact block cannot come from that and is an error."""

import os
import re
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import read_bytes
from padforge.design.common.validation import InputError
from padforge.sense.arrays import MAX_BYTES, MAX_FIBRES, Array, Mask

_MAGIC = b"PFB1"
_UNIT = 256
_COUNT_OFFSET, _CRC_OFFSET = 16, 20
_COUNT = struct.Struct("<I")
_HEADER = 24


def open_in_place(path: Path) -> BinaryIO:
    """Open an existing file for reading and writing in place, unbuffered, without following a symbolic link.

    Raises:
        InputError: it is a symbolic link.
        OSError: it cannot be opened.
    """
    file = path.open("r+b", buffering=0)
    if not os.path.samestat(os.fstat(file.fileno()), path.lstat()):
        file.close()
        raise InputError(f"{path}: is a link, and none is followed where a file is gone on with")
    return file


def block_dtype(fibres: int) -> np.dtype[np.void]:
    """The layout of a block of rows of 1 + `fibres` numbers: little-endian, at least four rows, n x 256 bytes."""
    row = 8 * (1 + fibres)
    size = -(-(_HEADER + 4 * row) // _UNIT) * _UNIT
    rows = (size - _HEADER) // row
    return np.dtype(
        {
            "names": ["magic", "sequence", "first", "count", "crc", "rows"],
            "formats": ["S4", "<u4", "<u8", "<u4", "<u4", ("<f8", (rows, 1 + fibres))],
            "offsets": [0, 4, 8, _COUNT_OFFSET, _CRC_OFFSET, _HEADER],
            "itemsize": size,
        }
    )


class BlockWriter:
    """Appends rows to an open stream. Rows reach the file a full block at a time, or at `flush`.

    A write that fails adds nothing, and the next one overwrites whatever it left.
    """

    def __init__(self, file: BinaryIO, fibres: int, blocks: int = 0, rows: int = 0) -> None:
        """Append to `file`, which holds so many blocks and rows already."""
        self._file = file
        self.fibres = fibres
        self._dtype = block_dtype(fibres)
        self._rows = self._dtype["rows"].shape[0]
        self._waiting = np.empty((0, 1 + fibres))
        self._sequence = blocks
        self._first = rows

    @classmethod
    def resume(cls, path: Path, fibres: int) -> tuple["BlockWriter", BinaryIO, Array]:
        """Go on with a stream, its torn tail cut off.

        Returns:
            The writer, the open file it appends to, and the (R, 1 + C) rows that are there.

        Raises:
            InputError: as `read_blocks`, or it is a link.
        """
        rows, _ = read_blocks(path, fibres)
        dtype = block_dtype(fibres)
        file = open_in_place(path)
        blocks = int(np.argmin(np.append(_sound(_blocks(file.read(), dtype)), False)))
        file.seek(blocks * dtype.itemsize)
        file.truncate()
        return cls(file, fibres, blocks, len(rows)), file, rows

    def append(self, rows: Array) -> None:
        """Add (n, 1 + C) rows of time and volts."""
        rows = np.concatenate([self._waiting, rows])
        whole = len(rows) // self._rows * self._rows
        self._write(rows[:whole])
        self._waiting = rows[whole:]

    def flush(self) -> None:
        """Hand what waits to the operating system as a block that is not full."""
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
    """Write `data` from a position on, all of it; where that fails, doing it again sets right what is half there."""
    file.seek(position)
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]


def read_blocks(path: Path, fibres: int) -> tuple[Array, bool]:
    """All intact rows of a stream.

    Returns:
        (R, 1 + C) rows, and whether a torn tail was cut off behind them.

    Raises:
        InputError: the file is missing, of another number of fibres, or a block is damaged although intact ones follow.
    """
    dtype = block_dtype(fibres)
    content = read_bytes(path, MAX_BYTES)
    blocks = _blocks(content, dtype)
    sound = _sound(blocks)
    end = len(blocks) if sound.all() else int(np.argmin(sound))
    tail = content[end * dtype.itemsize :]
    if _holds_block(tail, dtype):
        raise InputError(
            f"{path}: block {end} (byte {end * dtype.itemsize}) is damaged although intact blocks follow, "
            "allowed is a torn end of the file only"
        )
    if _begins_with_block(tail):  # no writer that died has left it
        raise InputError(f"{path}: block {end} is whole, but not of {fibres} fibres, as the recording says it is")
    blocks = blocks[:end]
    kept = np.arange(dtype["rows"].shape[0]) < blocks["count"][:, None]
    return blocks["rows"][kept], bool(tail)


def _blocks(content: bytes, dtype: np.dtype[np.void]) -> NDArray[np.void]:
    """Whatever lies where whole blocks should, intact or not."""
    return np.frombuffer(content, dtype, count=len(content) // dtype.itemsize)


def _sound(blocks: NDArray[np.void]) -> Mask:
    """(B,) whether each block has its magic and checksum and stands where it was written."""
    counts = blocks["count"].astype(np.int64)
    return (
        (blocks["magic"] == _MAGIC)
        & (blocks["crc"] == _checksums(blocks))
        & (blocks["sequence"] == np.arange(len(blocks)))
        & (blocks["first"] == np.cumsum(counts) - counts)
        & (counts <= blocks.dtype["rows"].shape[0])
    )


def _begins_with_block(content: bytes) -> bool:
    """Whether an intact block comes first, of any number of fibres."""
    if not content.startswith(_MAGIC):
        return False
    for dtype in map(block_dtype, range(1, MAX_FIBRES + 1)):
        if len(content) < dtype.itemsize:
            return False
        block = np.frombuffer(content, dtype, count=1)
        if block["crc"][0] == _checksums(block)[0]:
            return True
    return False


def _holds_block(content: bytes, dtype: np.dtype[np.void]) -> bool:
    """Whether an intact block lies anywhere in `content`, at whatever offset."""
    most = dtype["rows"].shape[0]
    for found in re.finditer(re.escape(_MAGIC), content[: max(len(content) - dtype.itemsize + len(_MAGIC), 0)]):
        start = found.start()
        (count,) = _COUNT.unpack_from(content, start + _COUNT_OFFSET)
        if count > most:  # told at once, where a file is full of magic words
            continue
        block = np.frombuffer(content, dtype, count=1, offset=start)
        if block["crc"][0] == _checksums(block)[0]:
            return True
    return False


def _checksums(blocks: NDArray[np.void]) -> NDArray[np.uint32]:
    """(B,) CRC-32 of every block without its checksum field."""
    view = memoryview(blocks.tobytes())
    size = blocks.dtype.itemsize
    crcs = np.empty(len(blocks), np.uint32)
    for i in range(len(blocks)):
        block = view[i * size : (i + 1) * size]
        crcs[i] = zlib.crc32(block[_CRC_OFFSET + 4 :], zlib.crc32(block[:_CRC_OFFSET]))
    return crcs
