"""Augmented presses for training: at random moments, moved to other positions, at rest or sliding.

The features of a press that is moved are the response of the table at its new position, plus its own residual. Those of
a sliding finger superpose the responses to its earlier positions, each delayed by its age (see `_trace_slide`), so that
strokes are learnt from presses.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from padforge.common.compilation import kernel
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.localizer.bayes import N_SUMMARY, BayesianLocalizer
from padforge.sense.localizer.moments import (
    LATEST_WINDOWS,
    N_PRESS_WINDOWS,
    PRESS_MIDDLES,
    PRESS_WINDOWS,
    Phase,
    bayes_stage,
)
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.localizer.scaler import TrainingPresses

FULL_SHARE = 0.25
"""Share of training presses with all fibres; the others have 1 .. `max_failures` masked, each number equally often."""
LATEST_NOISE = 0.05  # additional noise of `LATEST_WINDOWS`, which are single readings
SPEEDS_MM_S = 2.0, 60.0  # range of speeds of sliding fingers, logarithmically uniform
MAX_SLIDE_READINGS = 40  # maximum readings beyond `PRESS_WINDOWS` for which a finger slides
RESIDUAL_LENGTH_MM = 10.0  # correlation length of residuals along a slide
LAST_INSTANT_WINDOW = 4  # last of `PRESS_WINDOWS` that responds without delay
N_LATEST = len(LATEST_WINDOWS)
_N_READINGS = PRESS_WINDOWS[-1][1]  # readings after the probe was sent down, up to the end of `PRESS_WINDOWS`
_ENDS = np.array([0, *(end for _, end in PRESS_WINDOWS), _N_READINGS + 1])
"""Readings after which 0, 1, ... `PRESS_WINDOWS` are complete, and one reading after the last of these."""
_WINDOW_OF = np.array([max(sum(first <= n for first, _ in PRESS_WINDOWS) - 1, 0) for n in range(_N_READINGS)])
"""Window of each of these readings; that before the first window counts to it."""


class _Source(NamedTuple):
    """Presses and response table that are sampled from."""

    table: Floats  # scaled response by position, over [-1, 1] in x and y; shape (S, S, C, F)
    residual: Floats  # features minus the response table, of each press; shape (Q, C, F)
    complete: Mask  # complete windows; shape (Q, K)
    latest_factor: Floats  # see `TrainingPresses`
    latest_offset: Floats
    depth_gain: float  # growth of the response with the scaled depth
    latest_noise: float


class _Moments(NamedTuple):
    """Moments at which the B presses of a batch are read; the first n of them slide."""

    counts: Indices  # complete windows; shape (B,)
    last: Indices  # latest reading of the press; shape (B,)
    end: Array  # latest reading of a slide, which may be longer than `PRESS_WINDOWS`; shape (n,)
    velocity: Array  # scaled distance per reading; shape (n, 2)
    correlation_length: float  # of residuals, scaled


class PressSampler:
    """Sampler of presses at random moments of a phase, with features for augmented targets."""

    def __init__(
        self,
        presses: TrainingPresses,
        table: Floats,
        max_failures: int,
        rng: np.random.Generator,
        phase: Phase,
        bayes: Sequence[BayesianLocalizer],
    ) -> None:
        self.rng, self.targets, self.depth_gain = rng, presses.targets, presses.depth_gain
        fibres, n_features = presses.inputs.shape[1:]
        self._fibre_mask, self._max_failures = presses.fibre_mask, min(max_failures, fibres - 1)
        expected = interpolate_grid(table.reshape(*table.shape[:2], -1), self.targets[:, :2])
        if self.targets.shape[1] > 2:
            expected *= 1 + self.depth_gain * self.targets[:, 2:3]
        residual = (presses.inputs - expected.reshape(presses.inputs.shape)).astype(np.float32)
        windows = presses.complete, presses.latest_factor, presses.latest_offset
        self._source = _Source(np.ascontiguousarray(table), residual, *windows, float(self.depth_gain), LATEST_NOISE)
        self._n_timed = presses.n_timed
        self._bayes = tuple(stage.map_arrays(np.ascontiguousarray) for stage in bayes)
        self.n_inputs = fibres * (n_features + 1) + self._n_timed + (N_SUMMARY if bayes else 0)
        self._phase, self._speed, self._per_mm = phase, presses.speed, presses.per_mm

    def sample_rows(self, batch: int) -> Indices:
        """Sample the rows (B,) of a batch of presses."""
        return self.rng.integers(len(self.targets), size=batch)

    def inputs(self, rows: Indices, targets: Floats, noise: float) -> tuple[Floats, Floats]:
        """Compute the network inputs of presses that are moved to other targets.

        Args:
            rows: of the presses; shape (B,).
            targets: scaled; shape (B, 2 + T).
            noise: standard deviation of noise on the scaled features.

        Returns:
            Inputs (B, I), and the positions (B, 2) by the Bayesian localizer, or 0 without one.
        """
        moments = self._sample_moments(len(rows))
        fibres, n_features = self._source.residual.shape[1:]
        fibre_mask = sample_fibre_dropout(len(rows), fibres, self._max_failures, self.rng)
        fibre_mask &= self._fibre_mask[rows]
        x = np.zeros((len(rows), self.n_inputs), np.float32)
        _compute_inputs(self._source, rows, targets, fibre_mask, moments, noise, self.rng, x)
        if not self._bayes:
            return x, np.zeros(1, np.float32)
        bayes = self._bayes[bayes_stage(int(moments.counts[0]), self._n_timed) or 0]
        features = x[:, : fibres * n_features].reshape(-1, fibres, n_features)
        position, x[:, -N_SUMMARY:] = bayes.predict(features, fibre_mask)
        return x, position

    def _sample_moments(self, batch: int) -> _Moments:
        """Sample moments of the phase; with Bayesian localizers one for all, since each of these serves one stage."""
        # 1. Numbers of complete windows, and the latest reading while these and no more are complete
        n_moments, rng, shares = 1 if self._bayes else batch, self.rng, np.cumsum(self._phase.shares)
        offsets = np.searchsorted(shares, rng.random(n_moments) * shares[-1], side="right")
        counts = np.full(batch, self._phase.first + offsets)
        begin, end = (_ENDS[np.minimum(n_complete, N_PRESS_WINDOWS + 1)] for n_complete in (counts, counts + 1))
        last = begin + (rng.random(batch) * (end - begin)).astype(np.int64) - 1
        # 2. Velocities of sliding fingers; after the last window they slide on
        n_sliding = round(self._phase.sliding * batch) if self._speed and self._n_timed else 0
        low, high = np.log(SPEEDS_MM_S)
        speed = self._speed * np.exp(rng.uniform(low, high, n_sliding))
        angle = rng.uniform(0, 2 * math.pi, n_sliding)
        extra_readings = MAX_SLIDE_READINGS * rng.random(n_sliding) ** 2
        velocity = speed[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        slide_end = last[:n_sliding]
        slide_end = slide_end + np.where(slide_end >= _ENDS[N_PRESS_WINDOWS] - 1, extra_readings, 0.0)
        return _Moments(counts, last, slide_end, velocity, RESIDUAL_LENGTH_MM * self._per_mm)


def sample_fibre_dropout(batch: int, fibres: int, max_failures: int, rng: np.random.Generator) -> Mask:
    """Sample (B, C) fibre masks: none masked, or 1 .. `max_failures`; all sets of a size are equally likely."""
    count = rng.integers(1, max(max_failures, 1) + 1, (batch, 1))
    full = rng.random((batch, 1)) < (FULL_SHARE if max_failures else 1.0)
    rank = rng.random((batch, fibres)).argsort(axis=1)
    return (rank >= count) | full


@kernel
def _compute_inputs(
    source: Any, rows: Any, targets: Any, fibre_mask: Any, moments: Any, noise: float, rng: Any, x: Any
) -> None:
    """Write the inputs of a network for presses of the source into x.

    Args:
        source: a `_Source`.
        rows: of the presses; shape (B,).
        targets: to which presses are moved; shape (B, 2 + T).
        fibre_mask: valid fibres; shape (B, C).
        moments: `_Moments` of the presses.
        noise: standard deviation of noise on the features.
        rng: of the noise.
        x: filled with 0; shape (B, I). Masked features, and windows that are not complete, stay 0.
    """
    side, (fibres, size), n_timed = len(source.table), source.residual.shape[1:], source.complete.shape[1]
    residual, features, latest = np.empty(size), np.empty(size), np.empty(N_LATEST)
    complete, latest_windows = np.ones(size, np.bool_), np.empty(N_LATEST, np.int64)
    for b, row in enumerate(rows):
        # 1. Windows that are complete, and those that hold the latest readings
        gain = 1 + source.depth_gain * targets[b, 2] if targets.shape[1] > 2 else 1.0
        i, j, u, v = _locate(targets[b, 0], targets[b, 1], side)
        for k in range(n_timed):
            complete[k] = source.complete[row, k] and k < moments.counts[b]
            x[b, fibres * (size + 1) + k] = complete[k]
        for k in range(N_LATEST):
            latest_windows[k] = _WINDOW_OF[min(max(moments.last[b] - k, 0), len(_WINDOW_OF) - 1)]
        is_sliding = b < len(moments.end)
        has_latest = n_timed > 0 and (is_sliding or moments.counts[b] <= N_PRESS_WINDOWS)
        if is_sliding:
            path = _trace_slide(
                targets[b], moments.velocity[b], moments.end[b], latest_windows, moments.correlation_length, side
            )
            other_row = rows[b - 1] if b else rows[len(moments.end) - 1]
        for c in range(fibres):
            if not fibre_mask[b, c]:
                continue
            x[b, fibres * size + c] = 1
            # 2. Response of a finger at rest
            for f in range(size):
                if f < N_PRESS_WINDOWS or complete[f]:  # the latest readings may lie in a window that is not complete
                    residual[f] = source.residual[row, c, f] + noise * rng.standard_normal()
                    features[f] = gain * _respond(source.table, i, j, u, v, c, f) + residual[f]
            # 3. Windows that the slide changes, and the latest readings
            if is_sliding:
                other_residual = source.residual[other_row, c]
                _write_slide(source, path, c, gain, residual, other_residual, noise, rng, features, latest)
            elif has_latest:
                for k in range(N_LATEST):
                    latest[k] = features[latest_windows[k]]
            if has_latest:
                for k in range(N_LATEST):
                    window = latest_windows[k]
                    scaled = latest[k] * source.latest_factor[c, k, window] + source.latest_offset[c, k, window]
                    features[n_timed + k] = scaled + source.latest_noise * rng.standard_normal()
            for f in range(size):
                if complete[f]:
                    x[b, c * size + f] = features[f]


@kernel(inline="always")
def _locate(x: float, y: float, side: int) -> tuple[int, int, float, float]:
    """Return the cell (i, j) of the table that holds a position, clipped, and the position (u, v) in it, 0 to 1."""
    u = min(max((x + 1) * ((side - 1) / 2), 0.0), side - 1 - 1e-3)
    v = min(max((y + 1) * ((side - 1) / 2), 0.0), side - 1 - 1e-3)
    return int(u), int(v), u - int(u), v - int(v)


@kernel
def _respond(table: Any, i: int, j: int, u: float, v: float, c: int, f: int) -> float:
    """Interpolate window f of fibre c bilinearly in cell (i, j) of the table."""
    near = (1 - v) * table[i, j, c, f] + v * table[i, j + 1, c, f]
    return (1 - u) * near + u * ((1 - v) * table[i + 1, j, c, f] + v * table[i + 1, j + 1, c, f])


@kernel(inline="always")
def _trace_slide(
    target: Any, velocity: Any, end: float, latest_windows: Any, correlation_length: float, side: int
) -> tuple[Any, Any, Any, Any]:
    """Trace a finger from its target back to its touch, for `PRESS_WINDOWS` and then `LATEST_WINDOWS`.

    With R_m(x) the response of window m to a press at x, i = `LAST_INSTANT_WINDOW`, x(t) the position of the finger and
    t_m the middle of window m, the response of window k at time t is the superposition of delayed increments

        R_min(k, i)(x(t)) + sum over n = 1 .. k - i of [R_(i + n) - R_(i + n - 1)](x(t - (t_(i + n) - t_i))).

    Args:
        target: position of the finger at the end; shape (2,).
        velocity: scaled distance per reading; shape (2,).
        end: time of the latest reading.
        latest_windows: windows that hold the latest readings.
        correlation_length: of residuals, scaled.
        side: of the table.

    Returns:
        Windows k and the correlation of their residuals with that of the press at rest, for all windows; and for each
        increment n, by window, the cells (i, j) of the table and the positions (u, v) in them.
    """
    n_windows, n_increments = N_PRESS_WINDOWS + len(latest_windows), N_PRESS_WINDOWS - LAST_INSTANT_WINDOW
    windows, correlation = np.empty(n_windows, np.int64), np.empty(n_windows)
    cells, fractions = np.empty((n_increments, n_windows, 2), np.int64), np.empty((n_increments, n_windows, 2))
    for k in range(n_windows):
        windows[k] = k if k < N_PRESS_WINDOWS else latest_windows[k - N_PRESS_WINDOWS]
        time = PRESS_MIDDLES[k] if k < N_PRESS_WINDOWS else end - (k - N_PRESS_WINDOWS)
        for n in range(n_increments):
            delayed = time - (PRESS_MIDDLES[LAST_INSTANT_WINDOW + n] - PRESS_MIDDLES[LAST_INSTANT_WINDOW])
            age = max(end - max(delayed, PRESS_MIDDLES[1]), 0.0)  # the finger does not slide before it has sunk in
            x = min(max(target[0] - age * velocity[0], -1.0), 1.0)
            y = min(max(target[1] - age * velocity[1], -1.0), 1.0)
            cells[n, k, 0], cells[n, k, 1], fractions[n, k, 0], fractions[n, k, 1] = _locate(x, y, side)
            if n == 0:
                distance = age * math.hypot(velocity[0], velocity[1])
                correlation[k] = math.exp(-0.5 * (distance / correlation_length) ** 2)
    return windows, correlation, cells, fractions


@kernel
def _write_slide(
    source: Any,
    path: Any,
    c: int,
    gain: float,
    residual: Any,
    other_residual: Any,
    noise: float,
    rng: Any,
    features: Any,
    latest: Any,
) -> None:
    """Write the windows of fibre c under a sliding finger, see `_trace_slide`, into `features` and `latest`.

    Along the slide, the residual of the press becomes `other_residual`, that of another press.
    """
    windows, correlation, cells, fractions = path
    for k in range(len(windows)):
        window, response = windows[k], 0.0
        for n in range(1 + max(min(window, k) - LAST_INSTANT_WINDOW, 0)):
            i, j, u, v = cells[n, k, 0], cells[n, k, 1], fractions[n, k, 0], fractions[n, k, 1]
            if n == 0:
                response = _respond(source.table, i, j, u, v, c, min(window, LAST_INSTANT_WINDOW))
            else:
                response += _respond(source.table, i, j, u, v, c, LAST_INSTANT_WINDOW + n)
                response -= _respond(source.table, i, j, u, v, c, LAST_INSTANT_WINDOW + n - 1)
        uncorrelated = math.sqrt(1 - correlation[k] ** 2) * (other_residual[window] + noise * rng.standard_normal())
        sliding = gain * response + correlation[k] * residual[window] + uncorrelated
        if k < N_PRESS_WINDOWS:
            features[k] = sliding
        else:
            latest[k - N_PRESS_WINDOWS] = sliding
