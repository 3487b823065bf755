"""A double-ended priority queue in two flat arrays: smallest and greatest at hand, insertion and removal in log time.

Node k holds entries 2k and 2k + 1, the low and the high end of an interval that lies within its parent's; so the low
ends are a heap with the smallest at 0, the high ends one with the greatest at 1. A last node may hold one entry, which
is both its ends. Each entry is a key with a value that travels along (J. van Leeuwen, D. Wood, "Interval heaps", The
Computer Journal 36, 1993). All is inlined where it is used: a call takes longer than the work on a short queue.
"""

from typing import Any

from numba import njit

LOW, HIGH = 0, 1


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def end_slot(size: int, end: int) -> int:
    """Where the smallest (LOW) or greatest (HIGH) of `size` > 0 entries is."""
    return end if size > 1 else 0


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def _beyond(key: float, other: float, end: int) -> bool:
    """Whether `key` is nearer to the end than `other`: strictly, so that equal keys stay where they are."""
    return key < other if end == LOW else key > other


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def push(keys: Any, values: Any, size: int, key: float, value: float) -> None:
    """Add an entry to the `size` that are there; the arrays hold more than that."""
    slot, end = size, size % 2
    if end == HIGH and key < keys[slot - 1]:  # the node's other entry becomes its high end
        keys[slot], values[slot] = keys[slot - 1], values[slot - 1]
        slot, end = slot - 1, LOW
    elif end == LOW and slot > 0 and key > keys[2 * ((slot // 2 - 1) // 2) + HIGH]:
        end = HIGH
    while slot > 1:
        parent = 2 * ((slot // 2 - 1) // 2) + end
        if not _beyond(key, keys[parent], end):
            break
        keys[slot], values[slot] = keys[parent], values[parent]
        slot = parent
    keys[slot], values[slot] = key, value


@njit(cache=True, error_model="numpy", nogil=True, forceinline=True)
def pop(keys: Any, values: Any, size: int, end: int) -> None:
    """Remove the smallest (LOW) or greatest (HIGH) of `size` > 0 entries."""
    size -= 1
    key, value = keys[size], values[size]  # the last entry looks for a place along the gap that opens at the end
    slot = end
    if slot >= size:
        return
    while True:
        nearest = -1
        for node in (slot // 2 * 2 + 1, slot // 2 * 2 + 2):
            child = 2 * node + end  # a node of one entry has lost the last as its high end, which is not below it
            if child < size and (nearest < 0 or _beyond(keys[child], keys[nearest], end)):
                nearest = child
        if nearest < 0 or not _beyond(keys[nearest], key, end):
            break
        keys[slot], values[slot] = keys[nearest], values[nearest]
        slot = nearest
        other = slot ^ 1
        if other < size and _beyond(keys[other], key, end):
            keys[other], key = key, keys[other]
            values[other], value = value, values[other]
    keys[slot], values[slot] = key, value
