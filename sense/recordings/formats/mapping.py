"""What the columns or datasets of somebody's file hold: `time=t_ms:ms,fibres=ch*:mV,x=px,y=py`.

A mapping has `QUANTITY=NAME` or `QUANTITY=NAME:UNIT` with commas between them. In a name, `*` stands for any
characters and `?` for any one, so also for a comma or a colon. A unit is one that `UNITS` lists for the quantity, or a
factor, such as 0.001; without any, times are s, readings V, places and depths mm and forces N.
"""

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from padforge.design.common.validation import InputError, check_type, short_repr
from padforge.design.common.validation import check_path as as_path

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
    "begun": SECONDS,
    "lifted": SECONDS,
}
"""Quantities that a mapping may name, and how many s, V, mm or N their units are.

`press` numbers the presses, or is 1 while the pad is pressed; `places` are x and y in one array; `depth`
is how deep a press was to be, `reached` how deep it was, and `force` how hard; `begun` and `lifted`
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
    for one, other in (("x", "y"), ("begun", "lifted")):
        if (one in named) != (other in named):
            raise InputError(f"mapping {short_repr(text)} names one of {one} and {other}, expected both or neither")
    for one, other in (("x", "places"), ("press", "begun")):
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
