"""What the stress tests of sense share: pads, recordings and models made in moments, and hostile arguments."""

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar
from unittest import mock

import numpy as np
from hypothesis import strategies as st

from design.common.errors import InputError
from sense import HealthModel, Localizer, Recording, calibrate, fit_health_model
from sense import settings as sense_settings
from tests.stress.clock import LIMIT_S, ends_in_time

TINY = sense_settings.LocalizerSettings(members=1, hidden=8, layers=1, epochs=2, batch=64, lost=2)
"""Learns next to nothing, in a moment."""
RATE_HZ = 13.3

Result = TypeVar("Result")
seeds = st.integers(0, 2**32 - 1)


def made(seed: int, presses: int = 40, fibres: int = 4, cycle: int = 40, rate_hz: float = RATE_HZ) -> Recording:
    """A recording of presses that every fibre answers by how near it is, with noise and drift."""
    rng = np.random.default_rng(seed)
    count = presses * cycle
    places_mm = rng.uniform(-20, 20, (presses, 2))
    begun = cycle * np.arange(presses) + cycle // 2
    lifted = np.minimum(begun + cycle // 2, count)
    axis = np.linspace(-20, 20, max(fibres // 2, 1))
    near = np.exp(-(((places_mm[:, [0]] - axis) / 15) ** 2)), np.exp(-(((places_mm[:, [1]] - axis) / 15) ** 2))
    answers = np.concatenate(near, axis=1)[:, :fibres]
    down = np.repeat(answers, cycle, axis=0) * (np.arange(count) % cycle >= cycle // 2)[:, None]
    drift = 0.02 * np.cumsum(rng.standard_normal((count, fibres)), axis=0) / count**0.5
    readings = 1.8 + 0.2 * down + drift + 1.6e-3 * rng.standard_normal((count, fibres))
    return Recording(readings, np.arange(1, count + 1) / rate_hz, places_mm, begun, lifted, {"kind": "made"})


@cache
def recorded() -> Recording:
    """A recording that the models below were learnt from."""
    return made(1, presses=320)


@cache
def learnt(features: str = "full", method: str = "masked") -> Localizer:
    """A localizer of that pad."""
    return calibrate(recorded(), TINY.model_copy(update={"features": features, "method": method}))[0]


@cache
def watched() -> HealthModel:
    """The health of that pad, learnt in a moment."""
    one = recorded()
    with mock.patch("sense.health.fibre_prediction.MOST_STEPS", 30):
        return fit_health_model(one.readings, one.times_s, one.begun, one.lifted, rng=np.random.default_rng(0))


@cache
def models() -> None:
    """Make the models, so that they are there."""
    for features in ("full", "causal", "early"):
        learnt(features)
    learnt("published", "published")
    watched()


def right_or_refused(call: Callable[[], Result], limit_s: float = LIMIT_S) -> Result | None:
    """What `call` gives; None where it refuses its input in one line. Anything else raised, warned or hung fails."""
    models()  # not on the clock
    with ends_in_time(limit_s), warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            return call()
        except InputError as error:
            refused = str(error)
    assert refused.strip()
    assert "\n" not in refused
    return None


EXTREMES = (0.0, -0.0, 1.0, -1.0, 5e-324, 1e-300, 1e-9, 1e-3, 1e3, 1e6, 1e100, 1e300, -1e300, 1.7e308, np.nan, np.inf)
DTYPES = ("f4", "f2", "i1", "i8", "u8", "?", "c16", "O", "U8", "M8[s]", "g", ">f8")
ODD: tuple[Any, ...] = (
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
    return ODD[rng.integers(len(ODD))]
