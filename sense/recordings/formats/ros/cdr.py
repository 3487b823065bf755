"""ROS 2 messages by the thousand: those that differ in their numbers alone are rows of one NumPy record.

A message in CDR has its numbers at places that only the lengths of its texts and arrays decide. They are found once for
all messages of equal lengths, by the definition of the type, and written or read at once.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

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
