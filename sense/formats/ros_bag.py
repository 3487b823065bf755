"""What is kept of a bag as it is read, and how much of it at most, whatever a file claims.

The messages of an MCAP file, whatever an index in it says; see https://mcap.dev/spec.

The messages of a rosbag2 file of SQLite.

Messages out of bags of anyone, read with care: MCAP and SQLite files, and folders of such.
Files are gone through from their begin to their end, and nothing is unpacked or kept beyond what `bag` states.

ROS 2 messages by the thousand: those that differ in their numbers alone are rows of one NumPy record.
A message in CDR has its numbers at places that only the lengths of its texts and arrays decide. They are found once for
all messages of equal lengths, by the definition of the type, and written or read at once.
"""

import re
import sqlite3
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import InputError, short_repr

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


MOST_CHUNK_BYTES = 2**26
"""Most that one chunk may hold, unpacked; recorders make them of 1 to 4 MiB."""
FREE_BYTES, PACKED = 2**28, 32
"""What all chunks may hold, unpacked; beyond, at most so many bytes for each that they have in the file."""
MOST_RECORDS = 2**23
"""Most messages and other records of a bag, of all topics."""
MOST_MESSAGES, MOST_BYTES = 2**22, 2**28
"""Most messages and bytes of the topics that are asked for, together."""
MOST_TOPICS, MOST_LENGTHS = 10_000, 256
"""Most topics of a bag, and lengths that messages of one topic may have."""
LEAST_BYTES = 5
"""Size of the least message: what says how it is written, and one number."""
CUT = "is cut off or damaged"


class Topic:
    """The messages of one topic.

    Attributes:
        kind: their type, as `std_msgs/msg/Bool`.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._groups: dict[int, tuple[bytearray, array[int], array[int]]] = {}
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, stamp: int, message: bytes | memoryview) -> None:
        """Keep a message that was logged at `stamp`, ns."""
        if len(message) < LEAST_BYTES:
            raise InputError(f"a message of {self.kind} has {len(message)} bytes, allowed are {LEAST_BYTES} and more")
        group = self._groups.get(len(message))
        if group is None:
            if len(self._groups) == MOST_LENGTHS:
                raise InputError(f"messages of {self.kind} have more than {MOST_LENGTHS} lengths, allowed are so many")
            group = self._groups[len(message)] = (bytearray(), array("Q"), array("Q"))
        group[0].extend(message)
        group[1].append(stamp)
        group[2].append(self._count)
        self._count += 1

    @property
    def rows(self) -> list[NDArray[np.uint8]]:
        """The messages as groups of (n, size) bytes, one group for each length of them."""
        return [
            np.frombuffer(data, np.uint8).reshape(len(stamps), size) for size, (data, stamps, _) in self._groups.items()
        ]

    @property
    def order(self) -> tuple[NDArray[np.intp], NDArray[np.uint64]]:
        """(N,) which of `rows` comes first, second, ... by its stamp, then by its place in the bag; (N,) stamps, ns."""
        stamps, places = (
            np.concatenate([np.asarray(group[at], np.uint64) for group in self._groups.values()]) for at in (1, 2)
        )
        order = np.lexsort((places, stamps))
        return order, stamps[order]


class Bag:
    """What is kept of a bag as it is read.

    Attributes:
        kinds: the type of each topic. topics: those that are asked for.
    """

    def __init__(self, wanted: Callable[[str], bool]) -> None:
        self.kinds: dict[str, str] = {}
        self.topics: dict[str, Topic] = {}
        self._wanted = wanted
        self._records = self._messages = self._bytes = 0
        self._unpacked, self._packed = 0, 0

    def open(self, name: str, kind: str, encoding: str) -> Topic | None:
        """The topic of this name to add messages to; None where it is not asked for."""
        if kind.count("/") != 2:  # the short form that ROS 1 had
            kind = kind.replace("/", "/msg/")
        if self.kinds.setdefault(name, kind) != kind:
            raise InputError(f"topic {short_repr(name)} is of {short_repr(self.kinds[name])} and of {short_repr(kind)}")
        if len(self.kinds) > MOST_TOPICS:
            raise InputError(f"it has more than {MOST_TOPICS} topics, allowed are so many")
        if not self._wanted(name):
            return None
        if encoding != "cdr":
            raise InputError(
                f"topic {short_repr(name)} is written as {short_repr(encoding)}, expected 'cdr', as ROS 2 writes it"
            )
        return self.topics.setdefault(name, Topic(kind))

    def count(self) -> None:
        self._records += 1
        if self._records > MOST_RECORDS:
            raise InputError(f"it has more than {MOST_RECORDS} records, allowed are so many")

    def keep(self, topic: Topic, stamp: int, message: bytes | memoryview) -> None:
        self._messages += 1
        self._bytes += len(message)
        if self._messages > MOST_MESSAGES or self._bytes > MOST_BYTES:
            raise InputError(
                f"the topics read have more than {MOST_MESSAGES} messages or {MOST_BYTES} bytes, allowed are so many"
            )
        topic.add(stamp, message)

    def unpack(self, size: int, packed: int) -> None:
        """Allow a chunk that claims to be of `size` bytes, `packed` in the file."""
        self._unpacked, self._packed = self._unpacked + size, self._packed + packed
        if size > MOST_CHUNK_BYTES or self._unpacked > max(FREE_BYTES, PACKED * self._packed):
            raise InputError(
                f"its chunks claim {self._unpacked} bytes in {self._packed} of the file, allowed are "
                f"{MOST_CHUNK_BYTES} a chunk, {FREE_BYTES} in all, or {PACKED} for each byte of the file"
            )


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


MOST_STEPS = 2**27
"""Most steps of SQLite's machine; a million messages take some ten million."""
_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("id", "topic_id", "timestamp", "data"),
}


def read_sqlite(path: Path, bag: Bag) -> None:
    """Go through the messages of a file.

    Raises:
        InputError: no such file, or one that is beyond the limits of `bag`.
        ValueError: damaged, or no SQLite at all.
    """
    try:
        _go_through(path, bag)
    except sqlite3.Error as error:
        raise ValueError(str(error)) from error


def _go_through(path: Path, bag: Bag) -> None:
    with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)) as file:
        file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_BYTES)
        file.execute("PRAGMA trusted_schema = OFF")
        steps = 0

        def stop() -> bool:
            nonlocal steps
            steps += 2**16
            return steps > MOST_STEPS

        file.set_progress_handler(stop, 2**16)
        for table, columns in _COLUMNS.items():
            _refuse_strange(file, table, columns)
        topics = {
            number: bag.open(name, kind, encoding)
            for number, name, kind, encoding in file.execute("SELECT id, name, type, serialization_format FROM topics")
            if _is(number, int) and _is(name, str) and _is(kind, str) and _is(encoding, str)
        }
        wanted = ", ".join(str(number) for number, topic in topics.items() if topic is not None)
        # Row by row as they lie: to bring them into an order, or to skip others, SQLite would unpack and keep all.
        rows = f"SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id IN ({wanted})"
        for number, stamp, message in file.execute(rows):
            bag.count()
            topic = topics.get(number) if _is(stamp, int) and _is(message, bytes) else None
            if topic is not None:
                bag.keep(topic, stamp, message)


def _is(value: object, kind: type) -> bool:
    if not isinstance(value, kind):
        raise InputError(f"it has a {type(value).__name__} where rosbag2 has a {kind.__name__}")
    return True


def _refuse_strange(file: sqlite3.Connection, table: str, columns: tuple[str, ...]) -> None:
    """Refuse what is no table of stored values: views and columns that are computed may take any time."""
    found = file.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    plain = len(found) == 1 and found[0][0] == "table" and str(found[0][1]).upper().startswith("CREATE TABLE")
    about = file.execute(f"PRAGMA table_xinfo({table})").fetchall() if plain else []
    hidden = {name: hidden for _, name, _, _, _, _, hidden in about}
    if any(hidden.get(column) != 0 for column in columns):
        raise InputError(f"has no table {table} with {', '.join(columns)}, expected a rosbag2 file")


MOST_FILE_BYTES = 2**33
"""Size of the largest file that is looked at."""
MOST_METADATA_BYTES = 2**24
SUFFIXES = (".mcap", ".db3")
METADATA = "metadata.yaml"
"""What a folder that is a bag holds beside its files."""


def read_bag(path: Path, wanted: Callable[[str], bool]) -> tuple[dict[str, Topic], dict[str, str]]:
    """Messages of a bag: an .mcap or .db3, or a folder with `METADATA` and such.

    Args:
        wanted: whether messages of a topic of this name are asked for.

    Returns:
        The topics asked for that have messages, and the types of all topics, by their names.

    Raises:
        InputError: nothing there, another kind of file, one that is cut off or damaged, or more than is allowed.
    """
    bag = Bag(wanted)
    for file in _files(path):
        file = check_file(file, MOST_FILE_BYTES)
        with _blamed(file):
            if file.suffix.lower() == ".mcap":
                with file.open("rb") as stream:
                    read_mcap(stream, file.stat().st_size, bag)
            else:
                read_sqlite(file, bag)
    return {name: topic for name, topic in bag.topics.items() if len(topic)}, bag.kinds


@contextmanager
def _blamed(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(f"{path}: {CUT} ({error})") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _files(path: Path) -> list[Path]:
    """The files of a bag in the order in which they were recorded."""
    if not path.is_dir():
        return [path]
    about = read_bytes(path / METADATA, MOST_METADATA_BYTES).decode(errors="replace")
    mode = re.search(r"^[ \t]*compression_mode:[ \t]*[\"']?(file|message)\b", about, re.IGNORECASE | re.MULTILINE)
    if mode:
        raise InputError(f"{path}: is compressed by {mode[1]}, expected none or by chunk (ros2 bag convert)")

    def number(file: Path) -> tuple[int, str]:
        end = re.search(r"_(\d{1,9})$", file.stem)
        return (int(end[1]) if end else -1, file.name)

    files = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=number)
    if not files:
        raise InputError(f"{path}: has {METADATA}, but no file that ends in {' or '.join(SUFFIXES)}")
    return files


MOST_SHAPES = 256
"""Most lengths of texts and arrays that the messages of one topic may differ by."""
MOST_FIELDS = 1000
"""Most numbers and arrays of one message."""
_HEADER = 4
_TYPES = {"bool": "u1", "byte": "u1", "char": "u1"} | {
    f"{kind}{8 * size}": f"{code}{size}"
    for kind, code, sizes in (("int", "i", (1, 2, 4, 8)), ("uint", "u", (1, 2, 4, 8)), ("float", "f", (4, 8)))
    for size in sizes
}


def typestore(what: str) -> "Typestore":
    """The definitions of ROS 2's own messages.

    Raises:
        InputError: saying what needs rosbags, where it is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(f"{what} needs rosbags: pip install 'padforge[ros]'") from error
    return get_typestore(Stores.ROS2_HUMBLE)


class _Layout:
    """Where the numbers of one message lie.

    Attributes:
        numbers: offset and type of each, by its path, as `pose.position.x`. lengths: offsets of lengths, u4.

    Raises:
        InputError: the message ends before its type does.
    """

    def __init__(self, store: "Typestore", kind: str, message: bytes) -> None:
        if len(message) < _HEADER or message[1] > 1:
            raise InputError(f"message of {len(message)} bytes does not begin as plain CDR does")
        self.numbers: dict[str, tuple[int, np.dtype[Any]]] = {}
        self.lengths: list[int] = []
        self._store, self._message, self._at = store, message, _HEADER
        self._order = "<" if message[1] else ">"
        self._walk(kind, "")

    @property
    def record(self) -> np.dtype[Any]:
        offsets, formats = zip(*self.numbers.values(), strict=True)
        return np.dtype(
            {"names": list(self.numbers), "formats": formats, "offsets": offsets, "itemsize": len(self._message)}
        )

    def _walk(self, kind: str, path: str) -> None:
        for name, (node, about) in self._store.fielddefs[kind][1]:
            self._field(node.name, about, f"{path}.{name}".lstrip("."))

    def _field(self, node: str, about: Any, path: str) -> None:
        """A field by what rosbags calls its node: a BASE number or text, a NAMEd type, an ARRAY or a SEQUENCE."""
        if node == "BASE" and about[0] == "string":
            self._pass(self._length(), path)
        elif node == "BASE":
            self._number(path, about[0])
        elif node == "NAME":
            self._walk(about, path)
        else:
            (inner, what), count = about
            count = count if node == "ARRAY" else self._length()
            if _plain(inner.name, what):
                if count:
                    self._number(path, what[0], count)
            else:
                for each in range(count):
                    self._field(inner.name, what, f"{path}.{each}")

    def _number(self, path: str, name: str, count: int | None = None) -> None:
        """One number, or an array of so many."""
        if len(self.numbers) + len(self.lengths) > MOST_FIELDS:
            raise InputError(f"message has more than {MOST_FIELDS} fields, allowed are so many")
        kind = np.dtype(self._order + _TYPES[name])
        self._align(kind.itemsize)
        begin = self._at
        self._pass(kind.itemsize * (1 if count is None else count), path)
        self.numbers[path] = (begin, kind if count is None else np.dtype((kind, (count,))))

    def _length(self) -> int:
        self._align(4)
        self.lengths.append(self._at)
        self._pass(4, "a length")
        return int.from_bytes(self._message[self._at - 4 : self._at], "little" if self._order == "<" else "big")

    def _align(self, size: int) -> None:
        self._at += -(self._at - _HEADER) % size

    def _pass(self, size: int, path: str) -> None:
        self._at += size
        if self._at > len(self._message):
            raise InputError(f"message of {len(self._message)} bytes ends before {path} does")


def rows_like(store: "Typestore", message: Any, fields: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Messages as (n, size) bytes: like `message`, but for the fields that are given, of n values each."""
    pattern = bytes(store.serialize_cdr(message, message.__msgtype__))
    count = len(next(iter(fields.values())))
    rows = np.tile(np.frombuffer(pattern, np.uint8), (count, 1))
    records = rows.view(_Layout(store, message.__msgtype__, pattern).record)[:, 0]
    for path, values in fields.items():
        records[path] = values
    return rows


def numbers_in(
    store: "Typestore", kind: str, groups: Sequence[NDArray[np.uint8]], paths: Sequence[str]
) -> list[NDArray[Any]]:
    """Numbers at `paths` of messages of one type, that are given as groups of (n, size) bytes; in the order of these.

    Returns:
        For each path (N,), or (N, k) where the field is an array.

    Raises:
        InputError: messages that are torn, have no such number, arrays of different lengths, or too many shapes.
    """
    parts: list[list[tuple[NDArray[np.intp], NDArray[Any]]]] = [[] for _ in paths]
    done = shapes = 0
    for rows in groups:
        left = np.arange(len(rows))
        while len(left):
            shapes += 1
            if shapes > MOST_SHAPES:
                raise InputError(f"messages are of more than {MOST_SHAPES} shapes, allowed are so many")
            layout = _Layout(store, kind, rows[left[0]].tobytes())
            fixed = [0, 1, *(at + byte for at in layout.lengths for byte in range(4))]
            alike = np.ones(len(left), bool)
            for at in fixed:
                alike &= rows[left, at] == rows[left[0], at]
            records = (rows if alike.all() and len(left) == len(rows) else rows[left[alike]]).view(layout.record)[:, 0]
            for part, path in zip(parts, paths, strict=True):
                if path not in layout.numbers:
                    raise InputError(f"message {done + left[0]} has no {path}")
                part.append((done + left[alike], records[path]))
            left = left[~alike]
        done += len(rows)
    return [_together(part, done, path) for part, path in zip(parts, paths, strict=True)]


def _together(parts: Sequence[tuple[NDArray[np.intp], NDArray[Any]]], count: int, path: str) -> NDArray[Any]:
    shapes = sorted({values.shape[1:] for _, values in parts})
    if len(shapes) > 1:
        raise InputError(f"{path} has {shapes[0][0]} values in some messages and {shapes[1][0]} in others")
    if not parts:
        return np.empty(0)
    whole = np.empty((count, *shapes[0]), parts[0][1].dtype.newbyteorder("="))
    for at, values in parts:
        whole[at] = values
    return whole


def blank(store: "Typestore", kind: str, **fields: Any) -> Any:
    """A message of a type with nothing in it but the `fields` that are given."""
    made = {name: _nothing(store, node.name, about) for name, (node, about) in store.fielddefs[kind][1]}
    return store.types[kind](**(made | fields))


def _nothing(store: "Typestore", node: str, about: Any) -> Any:
    if node == "BASE":
        return "" if about[0] == "string" else 0
    if node == "NAME":
        return blank(store, about)
    (inner, what), count = about
    count = count if node == "ARRAY" else 0
    if _plain(inner.name, what):
        return np.zeros(count, _TYPES[what[0]])
    return [_nothing(store, inner.name, what) for _ in range(count)]


def _plain(node: str, about: Any) -> bool:
    """Whether a field is a number."""
    return node == "BASE" and about[0] != "string"
