"""What changes in a pad as a whole when it is re-made, re-mounted or worn: few numbers, found from few presses.

Every fibre answers by its own factor more or less, and the pad lies shifted, turned and stretched under the arm. All
fold into what a localizer has anyway, the scales of its inputs and its last layer, so that a corrected one is one like
any other.
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from padforge.sense.localizer.features import Inputs
from padforge.sense.localizer.localizer import Localizer
from padforge.sense.localizer.network import Weights
from padforge.sense.recordings.processing.limits import Array, Floats

GAIN, TURN, SHIFT = 0.2, 0.05, 0.1
"""Spreads expected: of the logarithm of a gain, of the angle (radians) and the stretch, of the shift (spans)."""
IN_R90 = 1.645
"""Standard deviations in the half-width that holds 90 % of what is normally distributed."""
STEP = 0.02
"""Way over which slopes are taken, in these spreads: shorter ones drown in the rounding of the network."""


def fit_correction(
    localizer: Localizer, raw: Inputs, places_mm: Array, measures: Mapping[str, Array] = MappingProxyType({})
) -> Localizer:
    """The corrected localizer that finds presses nearest to where they were, in robust least squares.

    A correction costs the square of its size in the spreads expected, so of three presses little is made.

    Args:
        raw: inputs of Q presses in volts. places_mm: (Q, 2).
        measures: (Q,) of those that the localizer has learnt, as far as they are known; NaN tells nothing.
    """
    from scipy.optimize import least_squares  # slow to import, and needed here only

    expected = localizer.locate(localizer.normalization.inputs(raw))

    def off(numbers: Array) -> Array:
        # Numbers are counted from 1, since the solver takes its steps relative to them.
        found = _corrected(localizer, numbers - 1)
        presses = found.locate(found.normalization.inputs(raw))
        misses = (presses.places_mm - places_mm) / expected.sd_mm
        more = [
            (each.values - measures[name]) / (expected.measures[name].r90 / IN_R90)
            for name, each in presses.measures.items()
            if name in measures
        ]
        return np.nan_to_num(np.concatenate([misses.ravel(), *more, numbers - 1]))

    solved = least_squares(off, np.ones(localizer.fibres + 4), loss="soft_l1", diff_step=STEP, xtol=1e-2, ftol=1e-3)
    numbers = solved.x - 1
    return replace(_corrected(localizer, numbers), table=_moved_table(localizer, *_parts(localizer, numbers)[1:]))


def _parts(localizer: Localizer, numbers: Array) -> tuple[Array, Array, Array]:
    """Gains (C,), turn (2, 2) and shift (2,), in spans, from numbers in spreads."""
    angle, stretch = TURN * numbers[-4:-2]
    turn = np.exp(stretch) * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.exp(GAIN * numbers[:-4]), turn, SHIFT * numbers[-2:]


def _corrected(localizer: Localizer, numbers: Array) -> Localizer:
    gains, turn, shift = _parts(localizer, numbers)
    before, observer, gains = localizer.normalization, localizer.observer, gains[:, None]
    return replace(
        localizer,
        weights=_turned(localizer.weights, turn, shift),
        observer=observer and observer.moved(turn, shift),
        corrector=_turned(localizer.corrector, turn, np.zeros(2)) if observer else {},
        normalization=replace(
            before, centre=gains * before.centre, spread=gains * before.spread, usual=gains * before.usual
        ),
    )


def _turned(weights: Weights, turn: Array, shift: Array) -> Weights:
    last, bias = weights["last.w"].copy(), weights["last.b"].copy()
    last[..., :2] = last[..., :2] @ turn.T
    bias[..., :2] = bias[..., :2] @ turn.T + shift
    return {**weights, "last.w": last, "last.b": bias}


def _moved_table(localizer: Localizer, turn: Array, shift: Array) -> Floats:
    """The table by places as they are called now; over the edge, what is at the edge."""
    from scipy.interpolate import RegularGridInterpolator

    grid = np.linspace(-1, 1, len(localizer.table))
    places = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    before = np.clip((places - shift) @ np.linalg.inv(turn).T, -1, 1)
    return RegularGridInterpolator((grid, grid), localizer.table)(before).astype(np.float32)
