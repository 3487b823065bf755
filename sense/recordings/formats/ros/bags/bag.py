"""What is kept of a bag as it is read, and how much of it at most, whatever a file claims."""

from array import array
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, short_repr

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
