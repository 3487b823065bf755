"""Quantities as text with a unit, such as `"0.5 cm"`, converted to the unit in which a setting counts."""

import math
import re
from collections.abc import Mapping
from fractions import Fraction

MAX_DEPTH = 6  # of nested lists; more than any setting has, while a list may contain itself

Size = int | Fraction
_MILLI, _PER_MIN, _DEGREES = Fraction(1, 1000), Fraction(1, 60), Fraction(180 / math.pi)  # degrees in a radian
# units that are understood, with their sizes, by the unit in which a setting counts, as its name ends
_UNITS: Mapping[str, Mapping[str, Size]] = {
    "mm": {"mm": 1, "cm": 10, "m": 1000, "um": _MILLI, "in": Fraction("25.4")},
    "mm_s": {"mm/s": 1, "cm/s": 10, "m/s": 1000, "mm/min": _PER_MIN},
    "mm_s2": {"mm/s^2": 1, "m/s^2": 1000},
    "s": {"s": 1, "ms": _MILLI, "min": 60},
    "min": {"min": 1, "s": _PER_MIN, "h": 60},
    "h": {"h": 1, "min": _PER_MIN},
    "hz": {"Hz": 1, "kHz": 1000},
    "mv": {"mV": 1, "V": 1000, "uV": _MILLI},
    "n": {"N": 1, "mN": _MILLI},
    "deg": {"deg": 1, "°": 1, "rad": _DEGREES},
    "rad": {"rad": 1, "deg": 1 / _DEGREES, "°": 1 / _DEGREES},
}
_NUMBER = r"[+-]?(?:\d{1,20}(?:\.\d{0,20})?|\.\d{1,20})(?:[eE][+-]?\d{1,2})?"
_MICRO = "[u\u00b5\u03bc]"  # the sign of micro and the Greek letter look alike, and keyboards have either
_SUFFIX = re.compile(rf"(?<!_per)_({'|'.join(_UNITS)})$")  # `ohm_per_mm` is no length


def units_of(name: str) -> Mapping[str, Size]:
    """Return the units that a setting may be written in, with their sizes; none if its name ends in no unit.

    Args:
        name: of the setting, such as `pitch_mm`.
    """
    suffix = _SUFFIX.search(name)
    return _UNITS[suffix[1]] if suffix else {}


def quantity_pattern(name: str) -> str:
    """Return the regular expression of a number with a unit that a setting may be written in.

    Args:
        name: of the setting, which ends in a unit.
    """
    return rf"^{_NUMBER} *({'|'.join(map(re.escape, units_of(name))).replace('u', _MICRO)})$"


def to_unit(name: str, value: object, depth: int = MAX_DEPTH) -> object:
    """Convert numbers with a unit, also in lists, to numbers in the unit that the name of a setting ends in.

    Args:
        name: of the setting, such as `pitch_mm`.
        value: a number, a text, or a list of these; all but text of a number is returned unchanged.
        depth: limit of nested lists.

    Raises:
        ValueError: text of a number without a unit, or with one of another quantity.
    """
    if depth and isinstance(value, list | tuple):
        items = [to_unit(name, item, depth - 1) for item in value]
        return items if isinstance(value, list) else tuple(items)
    units = units_of(name)
    match = re.match(rf"\s*({_NUMBER})\s*(.*)", value) if units and isinstance(value, str) else None
    if match is None:
        return value
    size = units.get(re.sub(_MICRO, "u", match[2].strip()))
    if size is None:
        raise ValueError(f"expected a number, or a text with one of the units {', '.join(units)}")
    return float(Fraction(match[1]) * size)  # rounded once: 0.2 in is 5.08 mm
