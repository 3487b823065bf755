"""The mapping of the columns, datasets or topics of a foreign file to quantities.

A mapping such as `time=t_ms:ms,fibres=ch*:mV,x=px,y=py` has entries QUANTITY=NAME or QUANTITY=NAME:UNIT. In a name `*`
stands for any characters and `?` for any one, also for a comma or a colon. `NAME[1]` and `NAME[1:5]` are columns of an
array, which count from 0 and exclude the last as in Python; `2-5` are columns of a table without header, which count
from 1. A unit is one of `UNITS` or a factor, such as 0.001; by default times are in s, readings in V, positions and
depths in mm, and forces in N. `rate=20`, in Hz, replaces `time` in a file without times.
"""

import re
from collections.abc import Callable, Mapping, Sequence, Set
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.validation import InputError, check_path, check_type, join_names, short_repr
from padforge.sense.recording.recording import Recording

_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
MILLIMETRES = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1000.0}
UNITS: dict[str, Mapping[str, float]] = {
    "time": _SECONDS,
    "rate": {},
    "fibres": {"V": 1.0, "mV": 1e-3, "uV": 1e-6},
    **dict.fromkeys(("x", "y", "positions", "depth", "reached"), MILLIMETRES),
    "force": {"N": 1.0, "mN": 1e-3},
    "press": {},
    **dict.fromkeys(("down_command", "up_command", "down", "up", "duration"), _SECONDS),
}
"""Quantities that a mapping may name, and the factors of their units to s, V, mm or N.

`positions` are x and y in one array. `depth` is the commanded one, `reached` the measured one. `press` numbers the
presses, or is 1 while the pad is pressed. `down_command` and `up_command` are indices of readings, or times if they
have a unit; `down`, `up` and `duration` are columns of a table of presses.
"""
DATASETS = tuple(name for name in UNITS if name not in ("down", "up", "duration"))
"""Quantities that a dataset or a variable may hold."""
_NUMBER = re.compile(r"\d{1,9}")
_INDEX = re.compile(r"(.+?)(\[(?:: ?, ?)?\d*:?\d*\])")


class ColumnEntry(NamedTuple):
    """An entry of a mapping."""

    quantity: str
    name: str  # name or pattern of the columns
    factor: float | None = None  # to s, V, mm or N; None without a unit
    index: str = ""  # which columns of an array; "" for all

    def select(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the columns of an array that the index names; the shorter axis of an array is that of its columns."""
        if not self.index:
            return values
        if values.ndim != 2:
            raise InputError(f"{self.quantity} is {self.name}{self.index} of shape {values.shape}, expected a matrix")
        values = values if values.shape[0] >= values.shape[1] else values.T
        bounds = [int(bound) if bound else None for bound in self.index.strip("[]:, ").split(":")]
        columns = values[:, slice(*bounds) if len(bounds) > 1 else slice(bounds[0], (bounds[0] or 0) + 1)]
        if columns.shape[1] == 0:
            what = f"{self.quantity} is {self.name}{self.index}"
            raise InputError(f"{what}, expected columns from 0 to {values.shape[1] - 1}")
        return columns


def check_import(path: object, columns: object) -> tuple[Path, str]:
    """Check and return the arguments of an import, a path and the text of a mapping."""
    return check_path("path", path), check_type("columns", columns, str)


def check_export(recording: object, path: object, localization: object = None) -> Path:
    """Check the types of the arguments of an export, and return the path."""
    check_type("recording", recording, Recording)
    if localization is not None:
        from padforge.sense.localizer.model import Localization

        check_type("localization", localization, Localization)
    return check_path("path", path)


def parse_columns(text: str, quantities: Sequence[str] = DATASETS) -> list[ColumnEntry]:
    """Return the entries of a mapping, in its order; only `fibres` may have several."""
    entries = [_parse_entry(entry.strip(), quantities) for entry in re.split(r",(?![^\[\]]*\])", text)]
    named = [entry.quantity for entry in entries]
    for quantity in named:
        if quantity != "fibres" and named.count(quantity) > 1:
            raise InputError(f"columns {short_repr(text)} name {quantity} twice, expected once")
    required = [quantity for quantity in ("time", "fibres") if quantity in quantities]
    for quantity in required:
        if quantity not in named and not (quantity == "time" and "rate" in named):
            expected = f"expected {' and '.join(required)}"
            if quantity == "time":  # other tables hold a line per press
                advice = "features of whole presses are for Localizer.fit in Python"
                expected += f", or rate=HZ of regular readings; {advice}"
            raise InputError(f"columns {short_repr(text)} do not name {quantity}, {expected}")
    for one, other in (("x", "y"), ("down_command", "up_command")):
        if (one in named) != (other in named):
            raise InputError(f"columns {short_repr(text)} name one of {one} and {other}, expected both or neither")
    for one, other in (("x", "positions"), ("press", "down_command"), ("time", "rate")):
        if one in named and other in named:
            raise InputError(f"columns {short_repr(text)} name {one} and {other}, expected one of them")
    return entries


def _parse_entry(text: str, quantities: Sequence[str]) -> ColumnEntry:
    quantity, _, name = (piece.strip() for piece in text.partition("="))
    unit = None
    if ":" in name.rpartition("]")[2]:
        name, _, unit = (piece.strip() for piece in name.rpartition(":"))
    if quantity not in quantities or not name:
        raise InputError(
            f"columns are {short_repr(text)}, expected QUANTITY=NAME or QUANTITY=NAME:UNIT, "
            f"where QUANTITY is one of {', '.join(quantities)}"
        )
    if quantity == "rate":
        rate_hz = _parse_number(name.lower().removesuffix("hz"))
        if rate_hz <= 0:
            raise InputError(f"rate is {short_repr(name)}, allowed is a number of readings a second")
        return ColumnEntry(quantity, name, rate_hz)
    return ColumnEntry(quantity, name, None if unit is None else _parse_unit(quantity, unit))


def _parse_unit(quantity: str, unit: str) -> float:
    units = UNITS[quantity]
    factor = units.get(unit) or _parse_number(unit)
    if factor == 0 or quantity == "press":
        allowed = f"{', '.join(units)} or a factor" if units else "none"
        raise InputError(f"unit of {quantity} is {short_repr(unit)}, allowed is {allowed}")
    return factor


def _parse_number(text: str) -> float:
    """Return a finite number, or 0 for any other text."""
    try:
        number = float(text) if text.isascii() and "_" not in text else 0.0
    except ValueError:
        return 0.0
    return number if isfinite(number) else 0.0


def matches(name: str, pattern: str) -> bool:
    """Return whether a name is that of an entry, or matches its pattern."""
    if (span := re.fullmatch(r"(\d+)-(\d+)", pattern)) and name.isdecimal():
        return int(span[1]) <= int(name) <= int(span[2])
    return name == pattern or fnmatchcase(name, pattern.replace("[", "[[]"))  # a bracket holds a unit


def match_columns(entries: Sequence[ColumnEntry], names: Sequence[str]) -> list[tuple[ColumnEntry, int]]:
    """Return, for each column that an entry names, that entry with the column's name, and its index; fibres come last.

    A pattern does not match the columns of earlier entries. Columns of one pattern whose names differ only by a number
    are in the order of that number, others in the order of the file.
    """
    matched: list[tuple[ColumnEntry, int]] = []
    used: set[int] = set()
    for entry in sorted(entries, key=lambda entry: entry.quantity == "fibres"):
        if entry.quantity == "rate":
            matched.append((entry, -1))
            continue
        what = f"{entry.quantity} is {short_repr(entry.name)}"
        columns = _find_columns(entry.name, names, used)
        if not columns and (indexed := _INDEX.fullmatch(entry.name)):
            entry = entry._replace(name=indexed[1], index=indexed[2])
            columns = _find_columns(entry.name, names, set())
        if not columns:
            raise InputError(f"{what}, expected one of {join_names(names)}")
        if len(columns) > 1 and entry.quantity != "fibres":
            raise InputError(f"{what}, which may be each of {join_names([names[i] for i in columns])}; expected one")
        if not entry.index and not used.isdisjoint(columns):
            raise InputError(f"{what}, which is named before; expected each once")
        used.update(columns)
        matched += [(entry._replace(name=names[i]), i) for i in _by_number(columns, names)]
    return matched


def _find_columns(pattern: str, names: Sequence[str], used: Set[int]) -> list[int]:
    exact = [i for i, name in enumerate(names) if name == pattern]
    return exact or [i for i, name in enumerate(names) if i not in used and matches(name, pattern)]


def read_entries(
    matched: Sequence[tuple[ColumnEntry, int]], read: Callable[[int], NDArray[Any]]
) -> list[tuple[ColumnEntry, NDArray[Any]]]:
    """Return the arrays of matched columns, read by their indices; a rate has its value in the mapping only."""
    return [(entry, np.ones(1) if entry.quantity == "rate" else read(i)) for entry, i in matched]


def order_notes(matched: Sequence[tuple[ColumnEntry, int]]) -> list[str]:
    """Return a note on the columns of the fibres if these are sorted by their numbers, and not as in the file."""
    columns = [i for entry, i in matched if entry.quantity == "fibres"]
    if columns == sorted(columns):
        return []
    names = [entry.name for entry, _ in matched if entry.quantity == "fibres"]
    fibres = ", ".join(f"fibre {number} = {name}" for number, name in enumerate(names, 1))
    return [f"fibres are in the order of their numbers, not of the file: {fibres}"]


def _by_number(columns: Sequence[int], names: Sequence[str]) -> list[int]:
    """Sort columns by the numbers in their names, within groups of names that are otherwise equal.

    pandas, R and HDF5 sort names as text, so that c10 comes before c2.
    """
    alike: dict[str, list[int]] = {}
    for column in columns:
        alike.setdefault(_NUMBER.sub("#", names[column]), []).append(column)
    ranked = {
        text: iter(sorted(group, key=lambda i: [int(number) for number in _NUMBER.findall(names[i])]))
        for text, group in alike.items()
    }
    return [next(ranked[_NUMBER.sub("#", names[column])]) for column in columns]
