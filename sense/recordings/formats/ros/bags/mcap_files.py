"""The messages of an MCAP file, whatever an index in it says; see https://mcap.dev/spec."""

import struct
import zlib
from typing import BinaryIO

from padforge.design.common.validation import InputError, short_repr

from padforge.sense.recordings.formats.ros.bags.bag import CUT, MOST_CHUNK_BYTES, Bag, Topic

_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 2, 3, 4, 5, 6
"""Codes of the records that are looked at."""
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_Topics = dict[int, Topic | None]


class _Reader:
    """Values one after another in the body of a record."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data, self._at = data, 0

    def take(self, form: str) -> tuple[int, ...]:
        values = struct.unpack_from(form, self._data, self._at)
        self._at += struct.calcsize(form)
        return values

    def text(self) -> str:
        (size,) = self.take("<I")
        return bytes(self.rest(size)).decode()

    def rest(self, size: int) -> bytes | memoryview:
        found = self._data[self._at : self._at + size]
        if len(found) != size:
            raise InputError(f"{CUT} (a record ends before its content)")
        self._at += size
        return found


def read_mcap(file: BinaryIO, size: int, bag: Bag) -> None:
    """Go through the records of an open file of so many bytes.

    Raises:
        InputError: no such file, or one that is cut off, damaged or beyond the limits of `bag`.
        struct.error, UnicodeDecodeError: damaged as well.
    """
    if file.read(len(_MAGIC)) != _MAGIC:
        raise InputError("is no MCAP file: it does not begin as such")
    schemas: dict[int, str] = {}
    channels: _Topics = {}
    while True:
        code, length = struct.unpack("<BQ", file.read(9))
        if length > size - file.tell():
            raise InputError(f"{CUT} (a record of {length} bytes ends beyond its end)")
        bag.count()
        if code == _FOOTER:
            file.seek(length, 1)
            if file.read() != _MAGIC:
                raise InputError(f"{CUT} (it does not end as an MCAP file)")
            return
        if code == _CHUNK:
            _read_records(_unpacked(_Reader(_limited(file, length)), length, bag), bag, schemas, channels)
        elif code in (_SCHEMA, _CHANNEL, _MESSAGE):
            _read_record(code, _limited(file, length), bag, schemas, channels)
        else:
            file.seek(length, 1)


def _limited(file: BinaryIO, length: int) -> memoryview:
    if length > MOST_CHUNK_BYTES:
        raise InputError(f"it has a record of {length} bytes, allowed are {MOST_CHUNK_BYTES}")
    return memoryview(file.read(length))


def _unpacked(chunk: _Reader, length: int, bag: Bag) -> memoryview:
    """The records of a chunk; never more bytes than it says there are."""
    _, _, size, checksum = chunk.take("<QQQI")
    packing = chunk.text()
    packed = bytes(chunk.rest(chunk.take("<Q")[0]))
    bag.unpack(size, length)
    if packing == "lz4":
        from lz4.frame import LZ4FrameDecompressor as Decompressor
    elif packing == "zstd":
        try:
            from compression.zstd import ZstdDecompressor as Decompressor  # pyright: ignore  from Python 3.14 on
        except ImportError:
            from backports.zstd import ZstdDecompressor as Decompressor
    elif packing:
        raise InputError(f"a chunk is packed by {short_repr(packing)}, expected lz4, zstd or nothing")
    else:
        Decompressor = None
    try:
        content = Decompressor().decompress(packed, size + 1) if Decompressor else packed
    except Exception as error:  # each library has its own
        raise InputError(f"{CUT} (a chunk of {packing}: {error})") from error
    if len(content) != size:
        raise InputError(f"{CUT} (a chunk of {size} bytes has {'more' if len(content) > size else len(content)})")
    if checksum and zlib.crc32(content) != checksum:
        raise InputError(f"{CUT} (the checksum of a chunk is wrong)")
    return memoryview(content)


def _read_records(data: memoryview, bag: Bag, schemas: dict[int, str], channels: _Topics) -> None:
    at, end, head = 0, len(data), struct.Struct("<BQ")
    while at < end:
        code, length = head.unpack_from(data, at)
        at += 9
        if length > end - at:
            raise InputError(f"{CUT} (a record of {length} bytes ends beyond its chunk)")
        bag.count()
        if code in (_SCHEMA, _CHANNEL, _MESSAGE):
            _read_record(code, data[at : at + length], bag, schemas, channels)
        at += length


def _read_record(code: int, body: memoryview, bag: Bag, schemas: dict[int, str], channels: _Topics) -> None:
    """A schema, a channel or a message."""
    if code == _MESSAGE:
        channel, _, stamp, _ = _MESSAGE_HEAD.unpack_from(body)
        if channel not in channels:
            raise InputError(f"{CUT} (a message is of a topic that is not told)")
        topic = channels[channel]
        if topic is not None:
            bag.keep(topic, stamp, body[22:])
        return
    reader = _Reader(body)
    (number,) = reader.take("<H")
    if code == _SCHEMA:
        schemas[number] = reader.text()
        return
    (schema,) = reader.take("<H")
    name, encoding = reader.text(), reader.text()
    if schema not in schemas:
        raise InputError(f"topic {short_repr(name)} is of a type that is not told")
    channels[number] = bag.open(name, schemas[schema], encoding)
