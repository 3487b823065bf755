"""Values that are wrong nearly everywhere: words of a command line, arguments of calls, arrays."""

import datetime
import decimal
import fractions
import pathlib
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from padforge.design import InputError, Morphology
from tools.hostile_inputs.workplace import SPECIAL

Array = NDArray[np.float64]

LONG = "x" * 300
"""Longer than a name may be."""

HOSTILE = (
    *("", " ", "-", "--", "-1", "0", "1", "2", "3", "9" * 20, "-" + "9" * 20, "1e400", "nan", "inf"),
    *("-inf", "NaN", "0x10", "1_000", "1.5", "٣", "½", "true", "none", "None", "null", "é", "日本"),
    *("\udc80\udcff", "\x01", "a\nb", "a\tb", "\x1b[31m", "%s%n", "{0}", "$HOME", "~", "*", "../x", "0,1", "0,,1"),
    *(",", "0,0"),
    *("1" * 5000, "x" * 70_000),
)
"""Values that are wrong nearly everywhere."""

PATHS = (
    *(".", "..", "", "pad", "empty", "file", "file/below", "new", "new/deep/er", "nowhere/", "pad/"),
    "pad/recording",
    *("pad/morphology.json", "pad/mould.stl", "pad/mould.3mf", "pad/design.json", "pad/recording/start.json"),
    *("presses.csv", "presses.h5", "pad.toml", "other.toml", "bad.toml", "nested.json", "nested.toml", "list.json"),
    *(f"{kind}.{suffix}" for kind in ("junk", "zero", "dangling", "loop") for suffix in ("json", "stl", "mat", "toml")),
    *(f"{kind}.{suffix}" for kind in ("junk", "zero", "dangling") for suffix in ("csv", "h5", "3mf")),
    *(f"{kind}.{suffix}" for kind in ("folder", "nothing") for suffix in ("json", "stl", "mat")),
    *SPECIAL,
    *("/dev/null", "/dev/full", "/dev/zero", "/dev/stdin/x", "/proc/self/mem", "/proc/nowhere/x", "/sys/x", "new.svg"),
    *(LONG, f"{LONG}.json", f"new/{LONG}/x", "/".join(["y" * 100] * 60), "日本", "\udc80\udcff", "a\nb", "-", "--"),
    *(" ", "~"),
    *("new.json", "new.csv", "new.h5", "new.png", "new.stl", "new.mat", "\x1b[31m.json", "pad/../pad", "con"),
    "x" * 250 + ".svg",
)
"""Paths of all kinds, some of which are right for each command."""


class Rude:
    """Raises whatever is asked of it."""

    def __repr__(self) -> str:
        raise RuntimeError("no")

    def __array__(self, *args: object, **kwargs: object) -> Array:
        raise RuntimeError("no")


def _endless() -> list[Any]:
    values: list[Any] = []
    values.append(values)
    return values


_NUMBERS: list[Any] = [
    *(-1, 0, 1, 2, 3, 7, 2**31, 2**63, 2**70, 10**400, -(10**400), 10**5000, True, False),
    *(0.5, -0.5, 1e-320, 1e-12, 1e12, 1e300, -1e300, -0.0, np.nan, np.inf, -np.inf, 1j),
    *(np.int8(2), np.uint64(2**64 - 1), np.float16(0.5), np.float32(0.6), np.longdouble("1e4000"), np.bool_(True)),
    *(decimal.Decimal("0.5"), fractions.Fraction(1, 2), np.complex64(1), np.datetime64("2020-01-01")),
]

_OTHERS: list[Any] = [
    *(None, "", "4", "text", "a\nb", "\0", "\udc80", b"x", "uniform", "sphere", "x" * 100_000, ..., object(), object),
    *([], [[]], [None], [0.5, "a"], [[1], [1, 2]], (), {}, {1: 2}, {"radius": 0.5}, {"grid": {"a": [1]}}, set()),
    [[[]]],
    *(range(3), iter([1]), len, Rude(), [Rude()], Morphology, InputError, datetime.date(2020, 1, 1), slice(3)),
    *(pathlib.Path("/dev/null/y.json"), "/dev/null/x", "x" * 5000, _endless()),
]

_ARRAYS: list[Any] = [
    *(np.empty(0), np.empty((0, 2)), np.empty((2, 0)), np.empty((3, 0, 2)), np.empty((0, 3, 2)), np.array(3.0)),
    *(np.ones(3), np.ones((4, 3)), np.ones((1, 2, 3, 4)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)),
    *(np.full((2, 2), 1e300), np.full((2, 2), 5e-324), np.full((2, 2), "a"), np.full((2, 2), None)),
    np.ones((2, 2)) * 1j,
    *(np.ones((2, 2), bool), np.ones((2, 2), np.int8), np.ones((2, 2), ">f4"), np.zeros((2, 2), "M8[s]")),
    *(np.zeros(3, [("x", float)]), np.ma.masked_all((2, 2)), np.broadcast_to(1.0, (2**40, 2)), np.ones((2, 2), "f2")),
    np.broadcast_to(1.0, (2**20, 2**10, 2)),
]

ODD = (*_NUMBERS, *_OTHERS, *_ARRAYS)
"""Values of any kind: numbers that are no sizes, names that are none, arrays of odd shapes, objects that raise."""


EXTREMES = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-9, 1e-3, 1e3, 1e6, 1e100, 1e300, -1e300, 1.7e308, np.nan, np.inf)

DTYPES = ("f4", "f2", "i1", "i8", "u8", "?", "c16", "O", "U8", "M8[s]", "g", ">f8")

MISTAKEN: tuple[Any, ...] = (
    *(None, "", "a", "1", b"x", 1j, [], [1], (1, 2), {}, {"a": 1}, True, False, 0, -1, 1, 2, 3, 7, 1.5, -0.5),
    *(float("nan"), float("inf"), -float("inf"), 5e-324, 1e300, -1e300, 2**31, 2**63, -(2**63), 2**64, 10**400),
    *(np.float32(1), np.int8(3), np.float64("nan"), np.array(1.0), np.array([]), [[1], [1, 2]], object(), [None]),
)
"""Arguments that a caller may hand over by mistake."""


def spoiled(rng: np.random.Generator, array: np.ndarray) -> Any:
    """`array` with something wrong with its values, its type or its shape; now and then nothing."""
    array = np.array(array)
    kind = rng.integers(10)
    if kind == 0:
        return array
    if kind == 1:  # some values are extreme
        array = array.astype(float)
        where = rng.random(array.shape) < rng.choice([0.001, 0.1, 0.9])
        array[where] = rng.choice(EXTREMES, int(where.sum()))
        return array
    if kind == 2:  # one value is
        array = array.astype(float)
        if array.size:
            array.ravel()[rng.integers(array.size)] = rng.choice(EXTREMES)
        return array
    if kind == 3:  # all are one
        return np.full(array.shape, rng.choice(EXTREMES))
    if kind == 4:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return array.astype(rng.choice(DTYPES)) if rng.random() < 0.9 else array.tolist()
    if kind == 5:  # of another length
        return array[: rng.integers(len(array) + 1)] if array.ndim else array
    if kind == 6:  # of another shape
        return array[None] if rng.random() < 0.5 else array.ravel()[:0]
    if kind == 7:  # lies the other way, or in another order
        return array.T if rng.random() < 0.5 else np.flip(array, 0) if array.ndim else array
    if kind == 8:  # scaled
        with np.errstate(all="ignore"):
            return array * rng.choice(EXTREMES)
    return MISTAKEN[rng.integers(len(MISTAKEN))]
