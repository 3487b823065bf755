"""What the columns, datasets or topics of a foreign file hold, and the recording in them.

A mapping such as `time=t_ms:ms,fibres=ch*:mV,x=px,y=py` has entries QUANTITY=NAME or QUANTITY=NAME:UNIT. In a name `*`
stands for any characters and `?` for any one, also for a comma or a colon. A unit is one of `UNITS` or a factor, such
as 0.001; without any, times are s, readings V, positions and depths mm, and forces N.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.validation import InputError, check_path, check_type, short_repr
from padforge.sense.arrays import Array, Indices, Mask, check_numbers
from padforge.sense.recording.csv_table import UNKNOWN
from padforge.sense.recording.recording import FIBRE_NAMES, Recording

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
MILLIMETRES = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0}
UNITS: dict[str, Mapping[str, float]] = {
    "time": _SECONDS,
    "fibres": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    **dict.fromkeys(("x", "y", "positions", "depth", "reached"), MILLIMETRES),
    "force": {"N": 1.0, "mN": 1e-3},
    "press": {},
    **dict.fromkeys(("down_command", "up_command"), _SECONDS),
}
"""Quantities that a mapping may name, and their units in s, V, mm or N.

`positions` are x and y in one array. `depth` was commanded and `reached` was measured. `press` numbers the presses, or
is 1 while the pad is pressed. `down_command` and `up_command` are indices of readings, or times if they have a unit.
"""
MEASURES = {"depth": "depths_mm", "reached": "reached_mm", "force": "forces_n"}
"""Quantities with one value a press, and their attributes of a `Recording`."""
NOTE = "note"
"""Key in the source of a recording that says what was left out of it, or filled in."""
MAX_GAP = 3  # readings without a position that are bridged within a press
PRESSES_DETECTED = {"presses": "detected"}
"""Entry of the source of a recording whose presses were detected in its readings."""
_MAX_LISTED = 12
_NUMBER = re.compile(r"\d{1,9}")


class ColumnEntry(NamedTuple):
    """A quantity, the name or pattern of its column, and the factor to s, V, mm or N; None without a unit."""

    quantity: str
    name: str
    factor: float | None = None


@contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Put what is read before the message of an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def check_import(path: object, columns: object) -> tuple[Path, str]:
    """Check the arguments of an import, a path and the text of a mapping, and return them."""
    return check_path("path", path), check_type("columns", columns, str)


def parse_columns(text: str, quantities: Sequence[str] = tuple(UNITS)) -> list[ColumnEntry]:
    """Return the entries of a mapping of these quantities, in its order; `fibres` may have several."""
    entries = [_parse_entry(entry.strip(), quantities) for entry in text.split(",")]
    named = [entry.quantity for entry in entries]
    for quantity in named:
        if quantity != "fibres" and named.count(quantity) > 1:
            raise InputError(f"columns {short_repr(text)} name {quantity} twice, expected once")
    required = [quantity for quantity in ("time", "fibres") if quantity in quantities]
    for quantity in required:
        if quantity not in named:
            expected = f"expected {' and '.join(required)} in each"
            raise InputError(f"columns {short_repr(text)} do not name {quantity}, {expected}")
    for one, other in (("x", "y"), ("down_command", "up_command")):
        if (one in named) != (other in named):
            raise InputError(f"columns {short_repr(text)} name one of {one} and {other}, expected both or neither")
    for one, other in (("x", "positions"), ("press", "down_command")):
        if one in named and other in named:
            raise InputError(f"columns {short_repr(text)} name {one} and {other}, expected one of them")
    return entries


def _parse_entry(text: str, quantities: Sequence[str]) -> ColumnEntry:
    quantity, _, name = (piece.strip() for piece in text.partition("="))
    unit = None
    if ":" in name:
        name, _, unit = (piece.strip() for piece in name.rpartition(":"))
    if quantity not in quantities or not name:
        raise InputError(
            f"columns are {short_repr(text)}, expected QUANTITY=NAME or QUANTITY=NAME:UNIT, "
            f"where QUANTITY is one of {', '.join(quantities)}"
        )
    return ColumnEntry(quantity, name, None if unit is None else _parse_unit(quantity, unit))


def _parse_unit(quantity: str, unit: str) -> float:
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


def matches(name: str, pattern: str) -> bool:
    """Whether a name is that of an entry, or matches its pattern."""
    return name == pattern or fnmatchcase(name, pattern.replace("[", "[[]"))  # brackets hold units, no characters


def match_columns(entries: Sequence[ColumnEntry], names: Sequence[str]) -> list[tuple[ColumnEntry, int]]:
    """Return the columns that entries name, each with its own name and its index: fibres last, others once each.

    A pattern leaves out the columns of entries before it. Columns of one pattern whose names differ by a number alone
    come in the order of that number, others in the order of the file.
    """
    matched: list[tuple[ColumnEntry, int]] = []
    used: set[int] = set()
    for entry in sorted(entries, key=lambda entry: entry.quantity == "fibres"):
        what = f"{entry.quantity} is {short_repr(entry.name)}"
        columns = [i for i, name in enumerate(names) if name == entry.name]
        columns = columns or [i for i, name in enumerate(names) if i not in used and matches(name, entry.name)]
        if not columns:
            raise InputError(f"{what}, expected one of {join_names(names)}")
        if len(columns) > 1 and entry.quantity != "fibres":
            raise InputError(f"{what}, which may be each of {join_names([names[i] for i in columns])}; expected one")
        if not used.isdisjoint(columns):
            raise InputError(f"{what}, which is named before; expected each once")
        used.update(columns)
        matched += [(entry._replace(name=names[i]), i) for i in _by_number(columns, names)]
    return matched


def _by_number(columns: Sequence[int], names: Sequence[str]) -> list[int]:
    """Sort columns by the numbers in their names, among those whose names are alike otherwise.

    pandas, R and HDF5 sort names as text, in which c10 comes before c2.
    """
    alike: dict[str, list[int]] = {}
    for column in columns:
        alike.setdefault(_NUMBER.sub("#", names[column]), []).append(column)
    ranked = {
        text: iter(sorted(group, key=lambda i: [int(number) for number in _NUMBER.findall(names[i])]))
        for text, group in alike.items()
    }
    return [next(ranked[_NUMBER.sub("#", names[column])]) for column in columns]


def join_names(names: Sequence[str]) -> str:
    """Return the first names with commas between them, for a message."""
    more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
    return (", ".join(short_repr(name) for name in names[:_MAX_LISTED]) or "nothing") + more


def assemble_recording(
    path: Path, arrays: Sequence[tuple[ColumnEntry, NDArray[Any]]], source: Mapping[str, Any]
) -> Recording:
    """Make a recording of the arrays of a file.

    Presses are where `down_command` and `up_command` are, else `press`, else where positions are missing between
    presses; or they are detected in the readings. Of positions, depths and forces with one value a reading, a press
    gets the one in its middle.

    Args:
        path: of the file, for messages.
        arrays: each with its entry and its own name. `time` and `press` have R values; `fibres` is (R, C), (C, R) or
            (R,), in one array or several; `positions` is (n, 2) or (2, n), and x and y are (n,), for n readings or
            presses.
        source: of the recording; the names of the fibres are added.
    """
    with naming_file(path):
        return _assemble(arrays, source)


def _assemble(arrays: Sequence[tuple[ColumnEntry, NDArray[Any]]], source: Mapping[str, Any]) -> Recording:
    columns: dict[str, Array] = {}
    fibres: list[tuple[str, Array]] = []
    for entry, array in arrays:
        values = _scaled(entry, array)
        if entry.quantity == "fibres":
            fibres.append((entry.name, values))
        elif entry.quantity == "positions" or values.size in values.shape:
            columns[entry.quantity] = values if entry.quantity == "positions" else values.ravel()
        else:
            raise InputError(f"{entry.quantity} has shape {values.shape}, expected one row or column")
    times = columns["time"]
    fibres = [(name, _by_readings(values, len(times))) for name, values in fibres]
    readings = fibres[0][1] if len(fibres) == 1 else np.column_stack([values for _, values in fibres])
    source = {**source, FIBRE_NAMES: [name for each in fibres for name in _fibre_names(*each)]}
    timed = {entry.quantity for entry, _ in arrays if entry.factor is not None}
    for name in timed & {"down_command", "up_command"}:
        # A thousandth of an interval is allowed for: times that were converted to another unit and back are rounded.
        tolerance = 1e-3 * np.median(np.diff(times)) if len(times) > 1 else 0.0
        columns[name] = np.searchsorted(times, columns[name] - tolerance).astype(np.float64)
    positions, rows = _join_positions(columns), np.arange(len(times))
    if positions is not None and len(positions) == len(times) and not {"press", "down_command"} & columns.keys():
        rows = _bridge_gaps(positions)
        positions, n_bridged = positions[rows], int((rows != np.arange(len(rows))).sum())
        if n_bridged:
            filled = f"{n_bridged} readings within presses lack a position; gaps of up to {MAX_GAP} are bridged"
            source = {**source, NOTE: "; ".join([*filter(None, [source.get(NOTE)]), filled])}
    presses = _find_presses(columns, positions, len(times))
    if presses is None:
        presses, source = _detect(readings, times, source), {**source, **PRESSES_DETECTED}
    down, up = presses

    def at_presses(name: str, values: Array) -> Array:
        if len(values) == len(down):
            return values
        if len(values) != len(times):
            expected = f"one for each of {len(down)} presses or {len(times)} readings"
            raise InputError(f"{name} are {len(values)}, expected {expected}")
        return values[rows[np.clip((down + up) // 2, 0, len(times) - 1)]]

    measures: dict[str, Any] = {MEASURES[name]: at_presses(name, columns[name]) for name in MEASURES if name in columns}
    presses_mm = np.full((len(down), 2), np.nan) if positions is None else at_presses("positions", positions)
    return Recording(readings, times, np.where(presses_mm == UNKNOWN, np.nan, presses_mm), down, up, source, **measures)


def _scaled(entry: ColumnEntry, array: NDArray[Any]) -> Array:
    """Return values in s, V, mm or N; UNKNOWN stays what it is."""
    array = np.asarray(array)
    array = array.astype(np.uint8) if array.dtype.kind == "b" else array
    values = check_numbers(array, np.float64, entry.quantity, copy=False)
    if entry.factor in (None, 1):
        return values
    with np.errstate(over="ignore"):  # a recording refuses infinity
        return np.where(values == UNKNOWN, UNKNOWN, values * entry.factor)


def _by_readings(values: Array, n_readings: int) -> Array:
    """Return (R, c) readings from (R, c), (c, R) or (R,)."""
    if values.ndim not in (1, 2) or n_readings not in values.shape:
        expected = f"({n_readings}, C) or (C, {n_readings}), as time has it"
        raise InputError(f"fibres have shape {values.shape}, expected {expected}")
    if values.ndim == 1:
        return values[:, None]
    return values if len(values) == n_readings else values.T


def _fibre_names(name: str, values: Array) -> list[str]:
    """Return the names of (R, c) readings from an array: its own, with an index where it holds several fibres."""
    return [name] if values.shape[1] == 1 else [f"{name}[{i}]" for i in range(values.shape[1])]


def _join_positions(columns: Mapping[str, Array]) -> Array | None:
    """Return (n, 2) positions of readings or presses; None if there are none."""
    if "x" in columns:
        x, y = columns["x"], columns["y"]
        if len(x) != len(y):
            raise InputError(f"x has {len(x)} values and y {len(y)}, expected as many")
        return np.column_stack([x, y])
    positions = columns.get("positions")
    if positions is not None and (positions.ndim != 2 or 2 not in positions.shape):
        raise InputError(f"positions have shape {positions.shape}, expected (n, 2) or (2, n)")
    return positions if positions is None or positions.shape[1] == 2 else positions.T


def _find_presses(
    columns: Mapping[str, Array], positions: Array | None, n_readings: int
) -> tuple[Indices, Indices] | None:
    """Return the (Q,) down and up commands that the columns say; None if they say nothing."""
    if "down_command" in columns:
        down, up = (check_numbers(columns[name], np.int64, name) for name in ("down_command", "up_command"))
        if len(down) != len(up):
            raise InputError(f"down_command has {len(down)} values and up_command {len(up)}, expected as many")
        return down, up
    if "press" in columns:
        press = columns["press"]
        if len(press) != n_readings:
            raise InputError(f"press has {len(press)} values, expected {n_readings}, one a reading")
        return _find_runs(press[:, None], _is_pressed(press))
    if positions is None or len(positions) != n_readings:
        return None
    missing = np.isnan(positions)
    incomplete = missing[:, 0] != missing[:, 1]
    if incomplete.any():
        raise InputError(f"positions have one of x and y in row {int(np.argmax(incomplete))}, expected both or neither")
    pressed = ~missing[:, 0]
    return _find_runs(positions, pressed) if pressed.any() and not pressed.all() else None


def _bridge_gaps(positions: Array) -> Indices:
    """Return which of (R, 2) positions each reading takes, (R,): its own, or in a short gap the last before it.

    A gap is short if it has MAX_GAP readings at most, fewer than half a rest between presses, and the same position
    before and after.
    """
    known = np.flatnonzero(~np.isnan(positions[:, 0]))
    before, after = known[:-1], known[1:]
    n_missing = after - before - 1
    is_same = (positions[before] == positions[after]).all(axis=1) & (positions[before, 0] != UNKNOWN)
    rests = n_missing[~is_same & (n_missing > 0)]
    max_gap = min(MAX_GAP, (np.median(rests) - 1) // 2) if len(rests) else 0
    rows = np.arange(len(positions))
    for gap in np.flatnonzero(is_same & (n_missing > 0) & (n_missing <= max_gap)):
        rows[before[gap] : after[gap]] = before[gap]
    return rows


def _is_pressed(press: Array) -> Mask:
    """Return (R,) where `press` is not 0, or where it is neither missing nor negative."""
    missing, zero = ~(press >= 0), press == 0
    if missing.any() and zero.any():
        raise InputError(
            f"press is missing or negative in row {int(np.argmax(missing))} and 0 in row {int(np.argmax(zero))}, "
            f"expected one of both where the pad is not pressed"
        )
    pressed = ~(missing | zero)
    if pressed.all() or not pressed.any():
        what = "0, missing or negative" if pressed.all() else "above 0"
        raise InputError(f"press is nowhere {what}; without it, presses are detected in the readings")
    return pressed


def _find_runs(values: Array, pressed: Mask) -> tuple[Indices, Indices]:
    """Return the down and up commands of presses: runs of readings that are pressed and have equal values (R, k)."""
    before = np.vstack([np.full((1, values.shape[1]), np.nan), values[:-1]])
    down = np.flatnonzero(pressed & (values != before).any(axis=1))
    ends = np.append(np.flatnonzero(~pressed), len(values))
    return down, np.minimum(ends[np.searchsorted(ends, down)], np.append(down[1:], len(values)))


def _detect(readings: Array, times_s: Array, source: Mapping[str, Any]) -> tuple[Indices, Indices]:
    """Return the down and up commands of presses that are detected in the readings."""
    from padforge.sense.signals.press_detection import detect_presses, estimate_commands

    placeholder = np.array([1])
    Recording(readings, times_s, np.zeros((1, 2)), placeholder, placeholder + 1, source)  # checks the readings first
    presses = detect_presses(readings, times_s)
    if len(presses.touched) == 0:
        raise InputError("has no press: no position or number tells of one, and none is detected in the readings")
    return estimate_commands(presses, times_s)
