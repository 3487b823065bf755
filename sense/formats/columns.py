"""What the columns or datasets of somebody's file hold: `time=t_ms:ms,fibres=ch*:mV,x=px,y=py`.
A mapping has `QUANTITY=NAME` or `QUANTITY=NAME:UNIT` with commas between them. In a name, `*` stands for any
characters and `?` for any one, so also for a comma or a colon. A unit is one that `UNITS` lists for the quantity, or a
factor, such as 0.001; without any, times are s, readings V, places and depths mm and forces N.

A recording put together from arrays that a mapping has named, however presses are told in them.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.design.common.validation import check_path as as_path
from padforge.sense.arrays import Array, Indices, Mask, check_numbers
from padforge.sense.recording.csv_table import UNKNOWN
from padforge.sense.recording.recording import Recording

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
VOLTS = {"V": 1.0, "mV": 1e-3, "uV": 1e-6}
MILLIMETRES = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0}
NEWTONS = {"N": 1.0, "mN": 1e-3}
UNITS: dict[str, Mapping[str, float]] = {
    "time": SECONDS,
    "fibres": VOLTS,
    "x": MILLIMETRES,
    "y": MILLIMETRES,
    "places": MILLIMETRES,
    "depth": MILLIMETRES,
    "reached": MILLIMETRES,
    "force": NEWTONS,
    "press": {},
    "down_command": SECONDS,
    "up_command": SECONDS,
}
"""Quantities that a mapping may name, and how many s, V, mm or N their units are.

`press` numbers the presses, or is 1 while the pad is pressed; `places` are x and y in one array; `depth`
is how deep a press was to be, `reached` how deep it was, and `force` how hard; `down_command` and `up_command`
are numbers of readings, or times where a unit is said.
"""
_LONGEST = 10_000


class Part(NamedTuple):
    """One part of a mapping.

    Attributes:
        quantity: one of `UNITS`. name: of a column or dataset, or a pattern of such.
        factor: by which its values become s, V, mm or N; None where no unit is said.
    """

    quantity: str
    name: str
    factor: float | None = None


def file_and_mapping(path: object, mapping: object) -> tuple[Path, str]:
    """What a caller hands to a reader of files: a path and the text of a mapping, "" for none.

    Raises:
        InputError: one of them is something else.
    """
    return as_path("path", path), check_type("mapping", mapping, str)


def parse_mapping(text: str, allowed: Sequence[str] = tuple(UNITS)) -> list[Part]:
    """The parts of a mapping, in its order; of `fibres` there may be several.

    Raises:
        InputError: no mapping, a quantity that is not `allowed` or named twice, one of two that belong together, two
            that say the same, or no `time` (where it is allowed) or `fibres`; the message names the part.
    """
    if len(text) > _LONGEST:
        raise InputError(f"mapping has {len(text)} characters, allowed are {_LONGEST}")
    parts = [_part(each.strip(), allowed) for each in text.split(",")]
    named = [part.quantity for part in parts]
    for quantity in named:
        if quantity != "fibres" and named.count(quantity) > 1:
            raise InputError(f"mapping {short_repr(text)} names {quantity} twice, expected once")
    needed = [quantity for quantity in ("time", "fibres") if quantity in allowed]
    for quantity in needed:
        if quantity not in named:
            raise InputError(
                f"mapping {short_repr(text)} does not name {quantity}, expected {' and '.join(needed)} in each"
            )
    for one, other in (("x", "y"), ("down_command", "up_command")):
        if (one in named) != (other in named):
            raise InputError(f"mapping {short_repr(text)} names one of {one} and {other}, expected both or neither")
    for one, other in (("x", "places"), ("press", "down_command")):
        if one in named and other in named:
            raise InputError(f"mapping {short_repr(text)} names {one} and {other}, expected one of them")
    return parts


def _part(text: str, allowed: Sequence[str]) -> Part:
    quantity, _, rest = (piece.strip() for piece in text.partition("="))
    name, colon, unit = (piece.strip() for piece in (rest.rpartition(":") if ":" in rest else (rest, "", "")))
    if quantity not in allowed or not name:
        raise InputError(
            f"mapping has {short_repr(text)}, expected QUANTITY=NAME or QUANTITY=NAME:UNIT, "
            f"where QUANTITY is one of {', '.join(allowed)}"
        )
    return Part(quantity, name, _factor(quantity, unit) if colon else None)


def _factor(quantity: str, unit: str) -> float:
    units = UNITS[quantity]
    if unit in units:
        return units[unit]
    try:
        factor = float(unit) if unit.isascii() and "_" not in unit else 0.0
    except ValueError:
        factor = 0.0
    if not isfinite(factor) or factor == 0 or quantity == "press":
        allowed = f"{', '.join(units)} or a factor" if units else "none"
        raise InputError(f"unit of {quantity} is {short_repr(unit)}, allowed is {allowed}")
    return factor


def chosen(parts: Sequence[Part], names: Sequence[str]) -> list[tuple[Part, list[int]]]:
    """Which of `names` each part means; a pattern leaves out what parts before it take, and fibres come last.

    Returns:
        Parts with their places in `names`, ascending: one place each, but for fibres.

    Raises:
        InputError: a part means none of them, what another one has, or several where it is not of fibres.
    """
    found: list[tuple[Part, list[int]]] = []
    taken: set[int] = set()
    for part in sorted(parts, key=lambda part: part.quantity == "fibres"):
        if part.name in names:
            places = [at for at, name in enumerate(names) if name == part.name]
        else:
            pattern = part.name.replace("[", "[[]")  # units stand in such brackets
            places = [at for at, name in enumerate(names) if fnmatchcase(name, pattern) and at not in taken]
        if not places:
            raise InputError(f"{part.quantity} is {short_repr(part.name)}, expected one of {listed(names)}")
        if len(places) > 1 and part.quantity != "fibres":
            several = listed([names[at] for at in places])
            raise InputError(
                f"{part.quantity} is {short_repr(part.name)}, which may be each of {several}; expected one"
            )
        if not taken.isdisjoint(places):
            raise InputError(f"{part.quantity} is {short_repr(part.name)}, which is named before; expected each once")
        taken.update(places)
        found.append((part, places))
    return found


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names with commas between them, the first of many."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(short_repr(name) for name in names[:most]) or "nothing") + more


MEASURES = {"depth": "depths_mm", "reached": "reached_mm", "force": "forces_n"}
"""Quantities of which each press has one, and what they are called in a `Recording`."""
FOUND = {"presses": "found"}
"""What the source of a recording says whose presses were found in its readings."""


class _PressColumns(NamedTuple):
    """(Q,) readings at which presses begin and end, as in a `Recording`, and how they are known."""

    down_command: Indices
    up_command: Indices
    source: Mapping[str, str]


def assembled(path: Path, found: Sequence[tuple[Part, NDArray[Any]]], source: Mapping[str, Any]) -> Recording:
    """The recording in the arrays of a file, each with the part of a mapping that it belongs to.

    `time` has R values, `fibres` is (R, C), (C, R) or R values of one fibre, in one array or several. `press` has R
    values. Places are (2, n) or (n, 2), or x and y of n values, for n = R readings or n = Q presses. Presses are where
    `down_command` and `up_command` say so, else `press`, else where places stand that are missing between presses; or they are
    found in the readings. Where places, depths or forces are given a reading, that of a press is the one in the middle
    of it.

    Raises:
        InputError: shapes that do not fit together, no press, or as `Recording`; the message names the file.
    """
    try:
        return _assembled(found, source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _assembled(found: Sequence[tuple[Part, NDArray[Any]]], source: Mapping[str, Any]) -> Recording:
    given: dict[str, Array] = {}
    fibres: list[Array] = []
    for part, array in found:
        factor = 1.0 if part.factor is None else part.factor
        numbers = _numbers(part.quantity, array)
        numbers = numbers if factor == 1 else _scaled(numbers, factor)
        if part.quantity == "fibres":
            fibres.append(numbers)
        else:
            given[part.quantity] = numbers if part.quantity == "places" else _vector(part.quantity, numbers)
    times = given["time"]
    columns = [_oriented(each, len(times)) for each in fibres]
    readings = columns[0] if len(columns) == 1 else np.column_stack(columns)
    places = _places(given)
    timed = {part.quantity for part, _ in found if part.factor is not None}
    for name in ("down_command", "up_command"):
        if name in timed:
            given[name] = _first_at(times, given[name]).astype(np.float64)
    presses = _told(given, places, len(times)) or _found(readings, times, source)
    measures: dict[str, Any] = {
        attribute: _of_presses(name, given[name], presses, len(times))
        for name, attribute in MEASURES.items()
        if name in given
    }
    said = {**source, **presses.source}
    return Recording(readings, times, _pressed(places, presses, len(times)), *presses[:2], said, **measures)


def _first_at(times_s: Array, events_s: Array) -> Indices:
    """First of (R,) readings at or after each of (n,) times.

    Times that were turned into another unit and back are off by a rounding, so the last thousandth of an interval
    before an event counts as at it.
    """
    steps = np.diff(times_s)
    return np.searchsorted(times_s, events_s - (1e-3 * np.median(steps) if len(steps) else 0.0))


def _numbers(name: str, values: NDArray[Any]) -> Array:
    values = np.asarray(values)
    return check_numbers(values.astype(np.uint8) if values.dtype.kind == "b" else values, np.float64, name, copy=False)


def _scaled(numbers: Array, factor: float) -> Array:
    """Numbers in another unit; what stands for an unknown place stays what it is."""
    with np.errstate(over="ignore"):  # what becomes infinite is refused as such
        return np.where(numbers == UNKNOWN, UNKNOWN, numbers * factor)


def _vector(name: str, values: Array) -> Array:
    if values.size not in values.shape:
        raise InputError(f"{name} has shape {values.shape}, expected one row or column")
    return values.ravel()


def _oriented(readings: Array, count: int) -> Array:
    """Readings (R, c) of R = `count`, from such, (c, R) or (R,)."""
    if readings.ndim in (1, 2) and len(readings) == count:
        return readings[:, None] if readings.ndim == 1 else readings
    if readings.ndim == 2 and readings.shape[1] == count:
        return readings.T
    raise InputError(f"fibres have shape {readings.shape}, expected ({count}, C) or (C, {count}), as time has it")


def _places(given: Mapping[str, Array]) -> Array | None:
    """Places (n, 2) of readings or presses; None where there are none."""
    if "x" in given:
        if len(given["x"]) != len(given["y"]):
            raise InputError(f"x has {len(given['x'])} values and y {len(given['y'])}, expected as many")
        return np.column_stack([given["x"], given["y"]])
    places = given.get("places")
    if places is not None and (places.ndim != 2 or 2 not in places.shape):
        raise InputError(f"places have shape {places.shape}, expected (n, 2) or (2, n)")
    return places if places is None or places.shape[1] == 2 else places.T


def _told(given: Mapping[str, Array], places: Array | None, count: int) -> _PressColumns | None:
    """Presses as the arrays tell them; None where they do not."""
    if "down_command" in given:
        down_command, up_command = (
            check_numbers(given[name], np.int64, name) for name in ("down_command", "up_command")
        )
        if len(down_command) != len(up_command):
            raise InputError(f"begun has {len(down_command)} values and lifted {len(up_command)}, expected as many")
        return _PressColumns(down_command, up_command, {})
    if "press" in given:
        press = given["press"]
        if len(press) != count:
            raise InputError(f"press has {len(press)} values, expected {count}, one a reading")
        return _runs(press[:, None], _contact(press))
    if places is None or len(places) != count:
        return None
    empty = np.isnan(places)
    half = empty[:, 0] != empty[:, 1]
    if half.any():
        raise InputError(f"places have one of x and y in row {int(np.argmax(half))}, expected both or neither")
    down = ~empty[:, 0]
    return _runs(places, down) if down.any() and not down.all() else None


def _contact(press: Array) -> Mask:
    """(R,) whether the pad is pressed: where `press` is not 0, or where it is neither missing nor below 0."""
    none, zero = ~(press >= 0), press == 0
    if none.any() and zero.any():
        raise InputError(
            f"press is missing or negative in row {int(np.argmax(none))} and 0 in row {int(np.argmax(zero))}, "
            f"expected one of both where the pad is not pressed"
        )
    down = ~(none | zero)
    if down.all() or not down.any():
        what = "0, missing or negative" if down.all() else "above 0"
        raise InputError(f"press is nowhere {what}; without it, presses are found in the readings")
    return down


def _runs(values: Array, down: Mask) -> _PressColumns:
    """Presses that last while the pad is `down` (R,) and `values` (R, k) stay the same."""
    before = np.vstack([np.full((1, values.shape[1]), np.nan), values[:-1]])
    down_command = np.flatnonzero(down & (values != before).any(axis=1))
    ends = np.append(np.flatnonzero(~down), len(values))
    up_command = np.minimum(ends[np.searchsorted(ends, down_command)], np.append(down_command[1:], len(values)))
    return _PressColumns(down_command, up_command, {})


def _found(readings: Array, times_s: Array, source: Mapping[str, Any]) -> _PressColumns:
    """Presses that the readings show."""
    from padforge.sense.signals.press_detection import estimate_commands, detect_presses

    first = np.array([1])  # a press that is none: refuses what are no readings, before they are searched
    Recording(readings, times_s, np.zeros((1, 2)), first, first + 1, source)
    presses = detect_presses(readings, times_s)
    if len(presses.touched) == 0:
        raise InputError("has no press: no place or number tells one, and none is found in the readings")
    return _PressColumns(*estimate_commands(presses, times_s), FOUND)


def _pressed(places: Array | None, presses: _PressColumns, count: int) -> Array:
    """(Q, 2) places of presses, NaN where they are unknown."""
    if places is None:
        return np.full((len(presses.down_command), 2), np.nan)
    places = _of_presses("places", places, presses, count)
    return np.where(places == UNKNOWN, np.nan, places)


def _of_presses(name: str, values: Array, presses: _PressColumns, count: int) -> Array:
    """(Q, ...) values of presses, from such, or from (R, ...) of readings, R = `count`."""
    if len(values) == len(presses.down_command):
        return values
    if len(values) != count:
        raise InputError(
            f"{name} are {len(values)}, expected one for each of {len(presses.down_command)} presses or {count} readings"
        )
    middle = (presses.down_command + presses.up_command) // 2
    return values[np.clip(middle, 0, count - 1)]
