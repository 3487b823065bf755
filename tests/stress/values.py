"""What hostile callers hand in: values of any kind, arrays of any layout, and pads as wild as a morphology may be."""

import datetime
import decimal
import fractions
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from hypothesis import HealthCheck
from hypothesis import strategies as st
from numpy.typing import NDArray

from design import Contact, InputError, Morphology
from design.pad.knots import assemble
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time

Array = NDArray[np.float64]
LAX = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much, HealthCheck.large_base_example]
"""What hypothesis need not complain of where work on one case takes long."""
MOST_SIDES = 512 if few(1).max_examples == 1 else 4096
"""Of a press: the outline takes time as the square of its sides."""


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
    *(
        [],
        [[]],
        [None],
        [0.5, "a"],
        [[1], [1, 2]],
        (),
        {},
        {1: 2},
        {"radius": 0.5},
        {"grid": {"a": [1]}},
        set(),
        [[[]]],
    ),
    *(range(3), iter([1]), len, Rude(), [Rude()], Morphology, InputError, datetime.date(2020, 1, 1), slice(3)),
    *(pathlib.Path("/dev/null/y.json"), "/dev/null/x", "x" * 5000, _endless()),
]
_ARRAYS: list[Any] = [
    *(np.empty(0), np.empty((0, 2)), np.empty((2, 0)), np.empty((3, 0, 2)), np.empty((0, 3, 2)), np.array(3.0)),
    *(np.ones(3), np.ones((4, 3)), np.ones((1, 2, 3, 4)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)),
    *(
        np.full((2, 2), 1e300),
        np.full((2, 2), 5e-324),
        np.full((2, 2), "a"),
        np.full((2, 2), None),
        np.ones((2, 2)) * 1j,
    ),
    *(np.ones((2, 2), bool), np.ones((2, 2), np.int8), np.ones((2, 2), ">f4"), np.zeros((2, 2), "M8[s]")),
    *(np.zeros(3, [("x", float)]), np.ma.masked_all((2, 2)), np.broadcast_to(1.0, (2**40, 2)), np.ones((2, 2), "f2")),
    np.broadcast_to(1.0, (2**20, 2**10, 2)),
]


ODD = (*_NUMBERS, *_OTHERS, *_ARRAYS)
"""Values of any kind: numbers that are no sizes, names that are none, arrays of odd shapes, objects that raise."""


def anything() -> st.SearchStrategy[Any]:
    """Any of `ODD`, or any number."""
    return st.sampled_from(_NUMBERS) | st.sampled_from(_OTHERS) | st.sampled_from(_ARRAYS) | st.floats() | st.integers()


def seeds() -> st.SearchStrategy[int]:
    """Of a numpy generator."""
    return st.integers(0, 2**32 - 1)


@st.composite
def pads(draw: st.DrawFn, grids: tuple[int, int] = (1, 3), knots: tuple[int, int] = (0, 8)) -> Morphology:
    """Pads as wild as the class allows: steps and needles, fibres on the border, on each other, on knots of others."""
    grid, count = draw(st.integers(*grids)), draw(st.integers(*knots))
    rng, pitch = np.random.default_rng(draw(seeds())), draw(st.sampled_from([11.25, 11.25, 11.25, 0.1, 4.0, 1000.0]))
    kind = draw(st.sampled_from(["random", "steps", "lattice", "border", "alike", "edge", "needles", "level"]))
    return Morphology(wild_knots(kind, grid, count, rng), pitch)


def wild_knots(kind: str, grid: int, count: int, rng: np.random.Generator) -> Array:
    """Knots (2M, N+2, 2) of a kind of wildness."""
    inner = rng.uniform(0, grid + 1, (2 * grid, count, 2))
    if kind == "steps":  # knots of one travel coordinate are put next to each other
        inner[:grid, :, 0], inner[grid:, :, 1] = rng.uniform(0, grid + 1, 2)
    elif kind == "lattice":
        inner = np.round(2 * inner) / 2
    elif kind == "border":
        inner[:grid, :, 1] = rng.choice([0, grid + 1.0], (grid, count))
        inner[grid:, :, 0] = rng.choice([0, grid + 1.0], (grid, count))
    elif kind == "alike":  # the fibres of a family run on each other
        inner[:grid], inner[grid:] = inner[0], inner[grid]
    elif kind == "edge":
        inner = rng.choice([0.0, 1e-9, grid + 1.0], inner.shape)
    elif kind == "needles":
        inner[:grid, :, 0] = inner[:1, :1, 0] + 1e-9 * np.arange(count)
        inner[grid:, :, 1] = inner[:1, :1, 1] + 1e-9 * np.arange(count)
        inner = inner.clip(0, grid + 1)
    elif kind == "level":
        inner[:grid, :, 1] = np.arange(1, grid + 1)[:, None] + rng.normal(0, 1e-12, (grid, count))
        inner[grid:, :, 0] = np.arange(1, grid + 1)[:, None]
        inner = inner.clip(0, grid + 1)
    return assemble(inner)


def contacts() -> st.SearchStrategy[Contact]:
    """Presses of every size and shape, weight and length."""
    return st.builds(
        Contact,
        radius=st.sampled_from([1e-9, 1e-6, 0.1, 0.6, 1.0, 7.0, 1e4]),
        sides=st.sampled_from([None, 3, 4, 5, 30, MOST_SIDES]),
        weight=st.sampled_from(["uniform", "inverse_square", "inverse"]),
        length=st.sampled_from(["manhattan", "euclidean"]),
    )


@st.composite
def presses(draw: st.DrawFn, pad: Morphology, most: int = 12) -> Any:
    """Presses (Q, 2) on knots and levels, outside of the pad and far away, in any layout and type of numbers."""
    rng, count = np.random.default_rng(draw(seeds())), draw(st.integers(0, most))
    places = rng.uniform(-1, pad.grid + 2, (count, 2))
    knots = pad.knots.reshape(-1, 2)
    for q in range(count):
        places[q] = (
            *(places[q], places[q], knots[rng.integers(len(knots))], np.round(places[q])),
            *(knots[rng.integers(len(knots))] + rng.choice([0, 0.6, -0.6], 2), rng.choice([-1e6, 1e6, 0, 1e-300], 2)),
        )[rng.integers(6)]
    kind = draw(st.sampled_from(["plain", "list", "f4", "i4", "fortran", "strided", "still", "big-endian"]))
    if kind == "list":
        return places.tolist()
    if kind == "strided":
        return np.repeat(np.repeat(places, 2, axis=0), 3, axis=1)[::2, ::3]
    if kind == "still":
        places.setflags(write=False)
        return places
    types = {"f4": "<f4", "i4": "<i4", "big-endian": ">f8"}
    return np.asarray(places, types.get(kind, "f8"), order="F" if kind == "fortran" else "C")


def call_spoiled(calls: Mapping[str, Any], data: st.DataObject) -> None:
    """Call one of the functions with one or two of its arguments replaced by anything."""
    name = data.draw(st.sampled_from(sorted(calls)))
    function, sound, verify = calls[name]
    spoiled = data.draw(st.sets(st.sampled_from(sorted(sound)), min_size=1, max_size=2))
    others = [value for _, arguments, _ in calls.values() for value in arguments.values()]
    given_ = sound | {key: data.draw(anything() | st.sampled_from(others)) for key in spoiled}
    with ends_in_time():
        try:
            found = function(**given_)
        except InputError as error:
            said = str(error)
        else:
            return verify(found, given_)
    assert len(said.splitlines()) == 1
    assert len(said) < 1000
