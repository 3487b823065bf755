"""From readings to presses: what the localizer is given of each fibre for each press.
Inputs are (Q, C, F): F numbers of each fibre, made of that fibre's readings alone, so that a lost fibre can be masked
and takes nothing of the others with it. Readings are counted from the one at which the probe was sent down or up; a
window that would reach into a neighbouring press is filled with the nearest reading that does not. What the fibre gave
before the press, its history, is kept apart (`response_model` says what of it still shows).
Readings may be missing (NaN): short gaps are bridged, and a fibre that lacks too much of a press counts as lost in it.

How a pad answers: what each fibre gives for a press at a place, and what still shows of what came before.
A fibre's windows are modelled as a smooth function of the place, a sum of Gaussian bumps on a grid over the pad, plus
a linear function of the fibre's own history: silicone creeps, so the rest is still on its way when the next press
comes. Of presses of several depths, the first is in proportion to the depth. Both are found together by ridge
regression. The second is taken off the windows before they are looked at; the first lets a press be moved by a few
millimetres, which turns thousands of presses into as many as training asks for.
What came before also makes a fibre answer more strongly or weakly: one that was stretched a moment ago gives a fifth
more. A place cannot be cleared of that before it is known, so the network is told: for each phase of a press, what is
left of the answers is fitted by the modelled answer times a linear function of the history, the gain.

How the inputs of presses become numbers of about 1, and what the network gives becomes mm and N.
Where presses of several depths were learnt from, the network gives depths (and forces) as well, and inputs are measured
from no press at all, so that they are in proportion to the depth.

Presses as trainings take them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.arrays import MIN_SCALE_V, Array, Floats, Indices, Mask

Window = tuple[int, int]

REST: Window = (-10, 0)
"""Readings before the probe is sent down whose mean is the rest that windows are measured from."""
DOWN: tuple[Window, ...] = ((1, 2), (2, 3), (3, 4), (4, 5), (5, 6), (6, 8), (8, 12), (12, 16), (16, 20))
"""Windows after the probe was sent down: fine while it sinks in, broad while it rests in the silicone."""
EARLY = 6
"""Of them, those over by the sixth reading after the touch, which comes two after the command."""
UP: tuple[Window, ...] = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 6), (6, 9), (9, 14), (14, 20))
"""Windows after the probe was sent up: the release tells as much of the place as the press."""
PAST: tuple[Window, ...] = (
    *((-2, 0), (-5, -2), (-10, -5), (-15, -10), (-18, -15), (-20, -18), (-30, -20), (-40, -30)),
    *((-50, -40), (-60, -50), (-80, -60), (-100, -80), (-120, -100), (-160, -120)),
)
"""Windows before the probe was sent down: silicone remembers what was done to it for seconds to minutes."""
SLOW = (800, 4000)
"""Lengths before the press, readings, whose medians are the fibre's settled rest: a minute and five at 13 Hz."""
SLOW_SAMPLES = 200
"""Readings that such a median is taken of."""
MEDIAN = 15
"""Width of the published running median, readings."""
LEAST_THERE = 0.75
"""Share of a press's readings that a fibre must have given to count."""

FEATURES = ("press_and_release", "causal", "onset", "published")
"""What inputs are made of: press and release, the press up to its end, its first readings, or the published values."""
SIZES = {"press_and_release": len(DOWN) + len(UP), "causal": len(DOWN), "onset": EARLY, "published": 3}
"""F, how many numbers of each fibre they are."""
PHASES = {
    "press_and_release": (slice(2, 5), slice(5, 9), slice(12, 17)),
    "causal": (slice(2, 5), slice(5, 9)),
    "onset": (slice(2, 6),),
    "published": (),
}
"""Windows in which a fibre answers more or less strongly together: while the probe sinks in, rests, and has gone."""
PASTS = {
    "press_and_release": len(PAST) + len(SLOW),
    "causal": len(PAST) + len(SLOW),
    "onset": len(PAST) + len(SLOW),
    "published": 0,
}
"""J, how many numbers of its history."""


@dataclass(frozen=True)
class PressFeatures:
    """What readings say of Q presses.

    Attributes:
        windows: (Q, C, F) V. history: (Q, C, J) V, relative to the rest before the press.
        fibre_mask: (Q, C) whether the fibre gave enough readings to count.
    """

    windows: Array
    history: Array
    fibre_mask: Mask

    def __getitem__(self, rows: Indices | slice) -> "PressFeatures":
        return PressFeatures(self.windows[rows], self.history[rows], self.fibre_mask[rows])

    def __add__(self, other: "PressFeatures") -> "PressFeatures":
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("windows", "history", "fibre_mask"))
        return PressFeatures(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.windows)


def press_inputs(readings: Array, down_command: Indices, up_command: Indices, features: str) -> PressFeatures:
    """The inputs of every press.

    Args:
        readings: (R, C) volts, NaN where missing. down_command, up_command: (Q,) first reading after the probe was sent down, up.
        features: one of `FEATURES`.
    """
    filled = bridged(readings)
    fibre_mask = _there(readings, down_command, up_command, features)
    if features == "published":
        return PressFeatures(
            published_inputs(filled, down_command, up_command), np.empty((*fibre_mask.shape, 0)), fibre_mask
        )
    windows = window_inputs(filled, down_command, up_command, release=features == "press_and_release")
    return PressFeatures(windows[:, :, : SIZES[features]], history(filled, down_command), fibre_mask)


def bridged(readings: Array) -> Array:
    """(R, C) readings with gaps filled along straight lines, and 0 for a fibre that never gave any."""
    missing = np.isnan(readings)
    if not missing.any():
        return readings
    filled = np.where(missing, 0.0, readings)
    rows = np.arange(len(readings))
    for fibre in np.flatnonzero(missing.any(axis=0) & ~missing.all(axis=0)):
        gone = missing[:, fibre]
        filled[gone, fibre] = np.interp(rows[gone], rows[~gone], readings[~gone, fibre])
    return filled


def _there(readings: Array, down_command: Indices, up_command: Indices, features: str) -> Mask:
    """(Q, C) whether enough of a press's readings are there, from its rest to the end of what `features` looks at."""
    counts = np.vstack([np.zeros((1, readings.shape[1])), np.cumsum(~np.isnan(readings), axis=0)])
    first = np.maximum(down_command + REST[0], 0)
    ends = up_command if features in ("causal", "onset") else up_command + UP[-1][1]
    ends = np.minimum(ends, len(readings))
    return counts[ends] - counts[first] >= LEAST_THERE * (ends - first)[:, None]


def window_inputs(readings: Array, down_command: Indices, up_command: Indices, release: bool = True) -> Array:
    """Means over windows of the press and its release, minus the mean at rest before it.

    Args:
        readings: (R, C) volts, none missing. down_command, up_command: (Q,) first reading after the probe was sent down, and up.
        release: whether the windows after the release are wanted.

    Returns:
        (Q, C, 17) volts, or (Q, C, 9).
    """
    free, following = _neighbours(down_command, up_command, len(readings))
    rest = _gather(readings, down_command, REST, free, down_command).mean(axis=1)
    means = [_gather(readings, down_command, window, down_command, up_command).mean(axis=1) for window in DOWN]
    if release:
        means += [_gather(readings, up_command, window, down_command, following).mean(axis=1) for window in UP]
    return np.stack(means, axis=2) - rest[:, :, None]


def history(readings: Array, down_command: Indices) -> Array:
    """What each fibre gave before the presses, relative to the rest just before: windows, then slow medians.

    Whatever was recorded counts, whether or not a press is known there.

    Args:
        readings: (R, C) volts, none missing. down_command: (Q,).

    Returns:
        (Q, C, 16) volts.
    """
    level = readings[0]  # taken off, so that long sums keep their digits
    sums = np.vstack([np.zeros((1, readings.shape[1])), np.cumsum(readings - level, axis=0)])

    def mean(window: Window) -> Array:
        first = np.maximum(down_command + window[0], 0)
        end = np.maximum(down_command + window[1], first + 1)
        return (sums[end] - sums[first]) / (end - first)[:, None] + level

    rest = mean(REST)
    windows = [mean(window) for window in PAST]
    slow = [_settled(readings, down_command, length) for length in SLOW]
    return np.stack(windows + slow, axis=2) - rest[:, :, None]


def _settled(readings: Array, down_command: Indices, length: int) -> Array:
    """(Q, C) medians of some readings spread over the `length` before each press."""
    offsets = np.arange(-length, 0, length // SLOW_SAMPLES)
    out = np.empty((len(down_command), readings.shape[1]))
    for part in range(0, len(down_command), 1024):
        index = np.maximum(down_command[part : part + 1024, None] + offsets, 0)
        out[part : part + 1024] = np.median(readings[index], axis=1)
    return out


def published_inputs(readings: Array, down_command: Indices, up_command: Indices) -> Array:
    """The published inputs: the running median of 15 readings before, in and after the press.

    Args and returns as `window_inputs`, but (Q, C, 3) volts.
    """
    free, following = _neighbours(down_command, up_command, len(readings))
    reach = (-(MEDIAN // 2), MEDIAN // 2 + 1)
    ranges = (
        (down_command - 10, free, down_command),
        (down_command + 10, down_command, up_command),
        (up_command + 10, down_command, following),
    )
    return np.stack([np.median(_gather(readings, at, reach, low, high), axis=1) for at, low, high in ranges], axis=2)


def _neighbours(down_command: Indices, up_command: Indices, readings: int) -> tuple[Indices, Indices]:
    """(Q,) the first reading that no earlier press owns, and the first that belongs to the next press."""
    return np.concatenate([[0], up_command[:-1]]), np.concatenate([down_command[1:], [readings]])


def _gather(readings: Array, at: Indices, window: Window, low: Indices, high: Indices) -> Array:
    """(Q, W, C) readings `at` + window, held within low <= index < high (and within the readings)."""
    index = at[:, None] + np.arange(*window)
    high = np.minimum(high, len(readings))
    return readings[np.clip(index, low[:, None], high[:, None] - 1)]


BUMPS = 21
"""Bumps along a side of the pad."""
WIDTH = 2.0
"""Their standard deviation, in distances between neighbours: wide enough that sums of them are smooth."""
RIDGE_PLACE, RIDGE_HISTORY = 1.0, 300.0
"""Penalties on the squares of the weights: of bumps, and of history in units of its spread. What its numbers tell is
much the same: by little of a penalty, weights cancel each other, and a few hundred presses err by a tenth more."""
STEPS = 60
"""Cells along a side of the table the function is kept in."""
_PART = 16_384


@dataclass(frozen=True)
class ResponseModel:
    """A fitted pad.

    Attributes:
        table: (STEPS + 1, STEPS + 1, C, F + G) V, windows by place in units of the span, over [-1, 1] in x and in y; 0
            for the G gains.
        memory: (C, J, F + G) V/V, what of a volt of history shows in the windows; and by how much, as a share, a volt
            of it weakens the answers in each of G phases, 1/V: taken off nothing, it leaves how much stronger they are.
        usual: (C, J) V, the history that the table is for.
    """

    table: Array
    memory: Array
    usual: Array

    @classmethod
    def fit(
        cls,
        places: Array,
        windows: Array,
        history: Array,
        fibre_mask: Mask,
        strengths: Array | None = None,
        phases: Sequence[slice] = (),
    ) -> "ResponseModel":
        """From places (Q, 2) within [-1, 1], windows (Q, C, F) V, history (Q, C, J) V of presses of training.

        A fibre learns from the presses in which it is alive, (Q, C).

        Args:
            strengths: (Q,) how deep each press was, relative to that of the table; all alike if None.
            phases: windows that are stronger together, G times.
        """
        fibres, pasts = history.shape[1:]
        size = windows.shape[2]
        grid = np.linspace(-1, 1, STEPS + 1)
        at_table = bumps(np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2))
        usual = np.zeros((fibres, pasts))
        memory = np.zeros((fibres, pasts, size + len(phases)))
        table = np.zeros((len(at_table), fibres, size + len(phases)))
        penalty = np.diag(np.repeat([RIDGE_PLACE, RIDGE_HISTORY], [BUMPS**2, pasts]))
        for fibre in np.flatnonzero(fibre_mask.any(axis=0)):
            there = fibre_mask[:, fibre]
            past, answer = history[there, fibre], windows[there, fibre]
            usual[fibre] = past.mean(axis=0)
            spread = past.std(axis=0)
            past = np.divide(past - usual[fibre], spread, out=np.zeros_like(past), where=spread > MIN_SCALE_V)
            shown = None if strengths is None else strengths[there]
            own, both = _moments(places[there], past, answer, shown)
            weights = np.linalg.solve(own + penalty, both)
            by_place, by_past = weights[: BUMPS**2], weights[BUMPS**2 :]
            gains = []
            if phases:
                expected = _answers(places[there], by_place, shown)
                left = answer - expected - past @ by_past
                gains = [_gain(expected[:, phase].mean(axis=1), left[:, phase].mean(axis=1), past) for phase in phases]
            shares = np.column_stack([by_past, *(-gain for gain in gains)])
            memory[fibre] = np.divide(
                shares, spread[:, None], out=np.zeros(shares.shape), where=spread[:, None] > MIN_SCALE_V
            )
            table[:, fibre, :size] = at_table @ by_place
        return cls(table.reshape(STEPS + 1, STEPS + 1, fibres, -1), memory, usual)


def _answers(places: Array, by_place: Any, strengths: Array | None) -> Array:
    """(Q, F) V, what a fibre is expected to give, a part at a time."""
    parts = range(0, len(places), _PART)
    found = np.concatenate([bumps(places[first : first + _PART]) @ by_place for first in parts])
    return found if strengths is None else strengths[:, None] * found


def _gain(expected: Array, left: Array, past: Array) -> Array:
    """(J,) by how much, as a share, a spread of each history strengthens (Q,) answers that leave (Q,) to explain."""
    usual = expected.std()
    if not past.shape[1] or usual <= MIN_SCALE_V:
        return np.zeros(past.shape[1])
    known = np.hstack([expected[:, None] / usual * past, past])  # what is added anew is none of the gain
    own = known.T @ known + RIDGE_HISTORY * np.eye(known.shape[1])
    return np.linalg.solve(own, known.T @ left)[: past.shape[1]] / usual


def _moments(places: Array, past: Array, answer: Array, strengths: Array | None) -> tuple[Array, Array]:
    """K' K and K' answer of the bumps and history K of presses, a part at a time: they take kilobytes a press."""
    own = both = np.zeros(())
    for first in range(0, len(places), _PART):
        part = slice(first, first + _PART)
        shown = _shown(places[part], None if strengths is None else strengths[part])
        known = np.hstack([shown, past[part]])
        own, both = own + known.T @ known, both + known.T @ answer[part]
    return own, both


def _shown(places: Array, strengths: Array | None) -> Array:
    return bumps(places) if strengths is None else strengths[:, None] * bumps(places)


def settled(windows: Array, history: Array, memory: Array, usual: Array) -> Array:
    """(Q, C, F + G) windows as they would be after the usual history, and by how much stronger they are for it."""
    gains = memory.shape[2] - windows.shape[2]
    return np.pad(windows, ((0, 0), (0, 0), (0, gains))) - np.einsum("qcj,cjf->qcf", history - usual, memory)


def looked_up(table: Any, places: Any, xp: Any = np) -> Any:
    """(S, S, D) table over [-1, 1] in x and y, and (B, 2) places, to (B, D), linear between entries.

    Args:
        xp: the module whose arrays these are, numpy or torch.
    """
    side = table.shape[0]
    at = xp.clip((places + 1) * ((side - 1) / 2), 0, side - 1 - 1e-3)
    whole = xp.floor(at)
    x, y = (at - whole).T[:, :, None]
    corner = xp.asarray(whole[:, 0] * side + whole[:, 1], dtype=xp.int64)
    flat = table.reshape(side * side, -1)
    near = (1 - y) * flat[corner] + y * flat[corner + 1]
    return (1 - x) * near + x * ((1 - y) * flat[corner + side] + y * flat[corner + side + 1])


def leverages(places: Array, strengths: Array | None = None) -> Array:
    """(Q,) by how much a press decides what is expected of it, 0 to 1: those of one place together, (Q, 2)."""
    nothing = np.empty((len(places), 0))
    own = _moments(places, nothing, nothing, strengths)[0] + RIDGE_PLACE * np.eye(BUMPS**2)
    alone = np.empty(len(places))
    for first in range(0, len(places), _PART):
        part = slice(first, first + _PART)
        known = _shown(places[part], None if strengths is None else strengths[part])
        alone[part] = (known * np.linalg.solve(own, known.T).T).sum(axis=1)
    _, place = np.unique(places, axis=0, return_inverse=True)
    return np.bincount(place.ravel(), alone).astype(np.float64)[place.ravel()]


def bumps(places: Array) -> Array:
    """(Q, 2) places in units of the span to (Q, BUMPS^2) values of the bumps."""
    apart = 2 / (BUMPS - 1)
    centres = np.linspace(-1, 1, BUMPS)
    x, y = np.exp(-0.5 * ((places[:, :, None] - centres) / (WIDTH * apart)) ** 2).transpose(1, 0, 2)
    return (x[:, :, None] * y[:, None, :]).reshape(len(places), -1)


MAX_INPUT = 1e4
"""Greatest scaled input, in spreads: what lies further off is no press, and is held there."""


@dataclass(frozen=True)
class ScaledFeatures:
    """Presses as the network takes them.

    Attributes:
        inputs: (Q, C, F). fibre_mask: (Q, C) whether the fibre gave enough readings to count.
    """

    inputs: Floats
    fibre_mask: Mask

    def __getitem__(self, rows: slice | Indices) -> "ScaledFeatures":
        return ScaledFeatures(self.inputs[rows], self.fibre_mask[rows])

    def __len__(self) -> int:
        return len(self.inputs)


@dataclass(frozen=True)
class TargetScaler:
    """What the network gives beside the place.

    Attributes:
        name: one of `Recording.measures`. middle: the value that the network calls 0. span: the difference that it
            calls 1; both in the unit that the name ends in.
    """

    name: str
    middle: float
    span: float

    @classmethod
    def of(cls, name: str, values: Array) -> "TargetScaler":
        """The one that puts (Q,) known values within [-1, 1]."""
        low, high = float(values.min()), float(values.max())
        return cls(name, (low + high) / 2, (high - low) / 2 or 1.0)

    def scaled(self, values: Array) -> Array:
        """(Q,) values to what the network gives."""
        return (values - self.middle) / self.span

    def values(self, scaled: Array) -> Array:
        """What the network gives to values."""
        return scaled * self.span + self.middle


@dataclass(frozen=True)
class FeatureScaler:
    """Fitted on the presses of training.

    Attributes:
        centre, spread: (C, F + G) V; an input enters as (input - centre) / spread. The G gains enter as they are.
        memory: (C, J, F + G) V/V, what of a volt of history shows in the inputs, see `ResponseModel`.
        usual: (C, J) V, the usual history.
        origin_mm: (2,) place that the network calls 0. span_mm: distance that it calls 1.
        measures: what the network gives beside the place; none, the depth, or depth and force, in this order.
        half_mm: (2,) half the width and height of what was pressed; None where nobody has kept it.
    """

    centre: Array
    spread: Array
    memory: Array
    usual: Array
    origin_mm: Array
    span_mm: float
    measures: Sequence[TargetScaler] = ()
    half_mm: Array | None = None

    @classmethod
    def fit(
        cls,
        inputs: PressFeatures,
        positions_mm: Array,
        measures: Mapping[str, Array] | None = None,
        phases: Sequence[slice] = (),
    ) -> tuple["FeatureScaler", Floats]:
        """From the inputs and the places (Q, 2) of the presses of training, and (Q,) of each measure to be learnt.

        For each of `phases`, windows that are stronger together, what came before a press tells a gain. A window is
        scaled by the geometric mean of its own spread and its fibre's: the fine windows of a touch keep some of their
        smallness, and so of their noise. What never varied is left as large as it is.

        Returns:
            The scaling, and the scaled inputs by place (S, S, C, F + G), see `ResponseModel.table`; of several depths,
            for the one that the network calls 0.
        """
        targets = tuple(TargetScaler.of(name, values) for name, values in (measures or {}).items())
        low, high = positions_mm.min(axis=0), positions_mm.max(axis=0)
        middle, span = (low + high) / 2, float((high - low).max() / 2) or 1.0
        strengths = measures["depth_mm"] / targets[0].middle if measures else None
        response = ResponseModel.fit(
            (positions_mm - middle) / span, inputs.windows, inputs.history, inputs.fibre_mask, strengths, phases
        )
        size = inputs.windows.shape[2]
        windows = settled(inputs.windows, inputs.history, response.memory, response.usual)[:, :, :size]
        there = np.broadcast_to(inputs.fibre_mask[:, :, None], windows.shape)
        centre = _mean(windows, there)
        variance = _mean((windows - centre) ** 2, there)
        spread = (variance * variance.mean(axis=1, keepdims=True)) ** 0.25
        spread = np.where(spread >= MIN_SCALE_V, spread, 1.0)
        centre = np.zeros_like(centre) if targets else centre
        gains = ((0, 0), (0, len(phases)))
        centre, spread = np.pad(centre, gains), np.pad(spread, gains, constant_values=1.0)
        scaling = cls(centre, spread, response.memory, response.usual, middle, span, targets, (high - low) / 2)
        return scaling, scaling.scaled(response.table)

    def refuse_unsound(self, table: Floats) -> None:
        """Raise InputError unless `table` is one of scaled inputs by place, see `fit`."""
        expected = (STEPS + 1, STEPS + 1, *self.centre.shape)
        if table.shape != expected or table.dtype != np.float32 or not np.abs(table).max(initial=0) <= MAX_INPUT:
            raise InputError(
                f"table of inputs by place is {table.dtype} of shape {table.shape}, "
                f"expected float32 {expected} up to {MAX_INPUT:g}"
            )

    def entries(self, method: str) -> int:
        """D, the numbers that enter the network: the inputs, and, if masked, one a fibre that says whether it lives."""
        return self.centre.size + (len(self.centre) if method == "ensemble" else 0)

    def inputs(self, inputs: PressFeatures) -> ScaledFeatures:
        """What the network takes."""
        return ScaledFeatures(
            self.scaled(settled(inputs.windows, inputs.history, self.memory, self.usual)), inputs.fibre_mask
        )

    def scaled(self, windows: Array) -> Floats:
        """(..., C, F + G) volts after the usual history, and gains, to numbers of about 1."""
        return np.clip((windows - self.centre) / self.spread, -MAX_INPUT, MAX_INPUT).astype(np.float32)

    @property
    def stretch(self) -> float:
        """By how much a press grows stronger, as a share of one of the middle depth, for a depth that is 1 greater."""
        return self.measures[0].span / self.measures[0].middle if self.measures else 0.0

    def targets(self, positions_mm: Array, measures: Mapping[str, Array] | None = None) -> Floats:
        """(Q, 2) mm, and (Q,) of each measure that is learnt, to what the network gives, (Q, 2 + T)."""
        more = [each.scaled((measures or {})[each.name]) for each in self.measures]
        return np.column_stack([(positions_mm - self.origin_mm) / self.span_mm, *more]).astype(np.float32)

    def positions_mm(self, targets: Floats) -> Array:
        """What the network gives of places, (Q, 2), to mm."""
        return targets * self.span_mm + self.origin_mm


def _mean(windows: Array, there: Mask) -> Array:
    """(C, F) means over the presses in which a fibre was there; 0 for one that never was."""
    return np.where(there, windows, 0.0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)


@dataclass(frozen=True)
class TrainingPresses:
    """Presses to learn from or to check on.

    Attributes:
        inputs: (Q, C, F) scaled. fibre_mask: (Q, C).
        targets: (Q, 2 + T) what the network is to give. stretch: see `FeatureScaler`.
    """

    inputs: Floats
    fibre_mask: Mask
    targets: Floats
    stretch: float = 0.0


MOST_LEVERAGE = 0.9
"""Of a press far from all others; what it leaves is made ten times as much at most."""


def as_unseen(presses: TrainingPresses, table: Floats) -> TrainingPresses:
    """Presses as far from a table (S, S, C, F) of expected inputs as if it had been fitted without each of them.

    Of a linear fit, what a press leaves when it is left out is what it leaves now, divided by 1 - its leverage: of a
    few hundred presses, a third more. It takes all presses of a place as one.
    """
    targets = presses.targets.astype(np.float64)
    places, strengths = targets[:, :2], np.ones(len(targets))
    if presses.stretch:
        strengths += presses.stretch * targets[:, 2]
    expected = looked_up(table.reshape(*table.shape[:2], -1), places).reshape(presses.inputs.shape)
    expected = strengths[:, None, None] * expected
    share = np.minimum(leverages(places, strengths), MOST_LEVERAGE)[:, None, None]
    rest = (presses.inputs - expected) / np.where(table.any(axis=(0, 1)), 1 - share, 1.0)
    return replace(presses, inputs=(expected + rest).astype(np.float32))
