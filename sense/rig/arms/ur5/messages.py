"""What the child that holds ur-rtde writes to its parent: states as numbers, answers as JSON."""

import json
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

_STATE = struct.Struct("<c14d")
_ANSWER = struct.Struct("<cI")


class Row(NamedTuple):
    """One state on the wire: mm, rad, s and N; the flags are 0 or 1, force is NaN without a sensor."""

    time_s: float
    x_mm: float
    y_mm: float
    z_mm: float
    rx: float
    ry: float
    rz: float
    speed_mm_s: float
    force_n: float
    protective_stop: float
    emergency_stop: float
    moving: float
    skipped: float
    sideways_n: float


def pack_row(row: Row) -> bytes:
    """Bytes of a state."""
    return _STATE.pack(b"S", *row)


def pack_answer(answer: Any) -> bytes:
    """Bytes of an answer."""
    text = json.dumps(answer).encode()
    return _ANSWER.pack(b"A", len(text)) + text


def read(source: Callable[[int], bytes]) -> Iterator[Row | dict[str, Any]]:
    """States and answers from a blocking `source` of bytes until it ends, be it in the middle of one."""
    while kind := source(1):
        head = kind + source((_STATE if kind == b"S" else _ANSWER).size - 1)
        try:
            if kind == b"S":
                yield Row._make(_STATE.unpack(head)[1:])
            else:
                yield json.loads(source(_ANSWER.unpack(head)[1]))
        except (struct.error, ValueError, RecursionError):
            return
