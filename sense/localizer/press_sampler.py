"""What a training draws: presses at random moments, moved to other positions, held still or sliding.

A press moved elsewhere responds as the table of the response says there, with its own residual. The response to a
finger that slides is the superposition of those to where it was, each as old as that is: so strokes are learnt from
presses.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from padforge.common.compilation import kernel
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.localizer.bayes import N_SUMMARY, BayesianLocalizer
from padforge.sense.localizer.moments import DOWN, N_DOWN, NOW, Phase, stage_of
from padforge.sense.localizer.response_model import interpolate_grid
from padforge.sense.localizer.scaler import TrainingPresses

FULL_SHARE = 0.25
"""Share of training presses that keep all fibres; others lose 1 .. `max_failures`, each number as often."""
NOW_NOISE = 0.05  # of single readings, beside that of means
SPEEDS_MM_S = 2.0, 60.0  # range of their speeds, logarithmically uniform
LONGER = 40  # readings beyond `DOWN` for which a finger slides
RESIDUAL_MM = 10.0  # distance over which what a press leaves unexplained becomes another
SUDDEN = 4  # window of `DOWN` up to which a response follows the finger; what changes later follows as much later
N_NOW = len(NOW)
_ENDS = np.array([0, *(end for _, end in DOWN), DOWN[-1][1] + 1])  # of windows of `DOWN`, and one before and after
_MIDDLES = np.array([(first + end - 1) / 2 for first, end in DOWN])
_WINDOW_OF = np.array([max(sum(first <= n for first, _ in DOWN) - 1, 0) for n in range(DOWN[-1][1])])  # a reading


class _Source(NamedTuple):
    """What presses are drawn from."""

    table: Floats  # scaled response by position, over [-1, 1] in x and y; shape (S, S, C, F)
    residual: Floats  # what the table leaves unexplained of each press; shape (Q, C, F)
    complete: Mask  # windows that are complete; shape (Q, K)
    now_factor: Floats  # see `TrainingPresses`
    now_offset: Floats
    depth_gain: float  # growth of the response with the scaled depth
    now_noise: float


class _Moments(NamedTuple):
    """When the presses of a batch are looked at, and how those slide that do, the first S of them."""

    counts: Indices  # complete windows; shape (B,)
    last: Indices  # the latest reading of the press; shape (B,)
    end: Array  # the latest reading of one that slides, which may do so for longer; shape (S,)
    velocity: Array  # scaled distance from one reading to the next; shape (S, 2)
    reach: float  # scaled distance over which a residual becomes another


class PressSampler:
    """Presses at random moments of a phase, whose features follow the response model to other targets."""

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
        now = presses.now_factor, presses.now_offset, float(self.depth_gain), NOW_NOISE
        self._source = _Source(np.ascontiguousarray(table), residual, presses.complete, *now)
        self._n_timed = presses.complete.shape[1]
        self._bayes = tuple(stage.map_arrays(torch.from_numpy) for stage in bayes)
        self.n_inputs = fibres * (n_features + 1) + self._n_timed + (N_SUMMARY if bayes else 0)
        self._phase, self._cumulated = phase, np.cumsum(phase.shares)
        self._speed, self._per_mm = presses.speed, presses.per_mm

    def draw(self, batch: int) -> Indices:
        """Draw (B,) rows of presses."""
        return self.rng.integers(len(self.targets), size=batch)

    def inputs(self, rows: Indices, targets: Floats, noise: float) -> tuple[Floats, Floats]:
        """Network inputs (B, D), and positions to correct, (B, 2) or 0, of presses moved to (B, 2 + T) targets."""
        moments = self._draw_moments(len(rows))
        fibres, n_features = self._source.residual.shape[1:]
        fibre_mask = sample_fibre_dropout(len(rows), fibres, self._max_failures, self.rng)
        fibre_mask &= self._fibre_mask[rows]
        x = np.zeros((len(rows), self.n_inputs), np.float32)
        _compute_inputs(self._source, rows, targets, fibre_mask, moments, noise, self.rng, x)
        if not self._bayes:
            return x, np.zeros(1, np.float32)
        bayes = self._bayes[stage_of(int(moments.counts[0]), self._n_timed) or 0]
        features = torch.from_numpy(x)[:, : fibres * n_features].view(-1, fibres, n_features)
        with torch.no_grad():
            position, summary = bayes.predict(features, torch.from_numpy(fibre_mask), torch)
        x[:, -N_SUMMARY:] = summary.numpy()
        return x, position.numpy()

    def _draw_moments(self, batch: int) -> _Moments:
        """Draw moments of the phase, a batch of one where a Bayesian localizer answers, of which each stage has one."""
        n_drawn, rng = 1 if self._bayes else batch, self.rng
        drawn = np.searchsorted(self._cumulated, rng.random(n_drawn) * self._cumulated[-1], side="right")
        counts = np.full(batch, self._phase.first + drawn)
        begin, end = (_ENDS[np.minimum(counts + k, N_DOWN + 1)] for k in (0, 1))
        last = begin + (rng.random(batch) * (end - begin)).astype(np.int64) - 1
        n_sliding = round(self._phase.sliding * batch) if self._speed and self._n_timed else 0
        low, high = np.log(SPEEDS_MM_S)
        speed = self._speed * np.exp(rng.uniform(low, high, n_sliding))
        angle, longer = rng.uniform(0, 2 * math.pi, n_sliding), LONGER * rng.random(n_sliding) ** 2
        velocity = speed[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        sliding = last[:n_sliding]
        end = sliding + np.where(sliding >= _ENDS[N_DOWN] - 1, longer, 0.0)
        return _Moments(counts, last, end, velocity, RESIDUAL_MM * self._per_mm)


def sample_fibre_dropout(batch: int, fibres: int, max_failures: int, rng: np.random.Generator) -> Mask:
    """Sample (B, C) masks in which all fibres are kept, or 1 .. `max_failures` are masked, each set equally likely."""
    count = rng.integers(1, max(max_failures, 1) + 1, (batch, 1))
    full = rng.random((batch, 1)) < (FULL_SHARE if max_failures else 1.0)
    rank = rng.random((batch, fibres)).argsort(axis=1)
    return (rank >= count) | full


@kernel
def _compute_inputs(
    source: Any, rows: Any, targets: Any, fibre_mask: Any, moments: Any, noise: float, rng: Any, x: Any
) -> None:
    """Write the inputs of a network for presses (B,) of the source, moved to targets (B, 2 + T), into x, which is 0.

    What is masked, and windows yet to come, stay 0.
    """
    side, (fibres, size), n_timed = len(source.table), source.residual.shape[1:], source.complete.shape[1]
    residual, features, of_now = np.empty(size), np.empty(size), np.empty(N_NOW)
    complete, windows = np.ones(size, np.bool_), np.empty(N_NOW, np.int64)
    for b, row in enumerate(rows):
        gain = 1 + source.depth_gain * targets[b, 2] if targets.shape[1] > 2 else 1.0
        i, j, u, v = _locate(targets[b, 0], targets[b, 1], side)
        for k in range(n_timed):
            complete[k] = source.complete[row, k] and k < moments.counts[b]
            x[b, fibres * (size + 1) + k] = complete[k]
        for k in range(N_NOW):
            windows[k] = _WINDOW_OF[min(max(moments.last[b] - k, 0), len(_WINDOW_OF) - 1)]
        is_sliding = b < len(moments.end)
        is_now_mapped = n_timed > 0 and (is_sliding or moments.counts[b] <= N_DOWN)
        if is_sliding:
            path = _trace(targets[b], moments.velocity[b], moments.end[b], windows, moments.reach, side)
            other = rows[b - 1] if b else rows[len(moments.end) - 1]
        for c in range(fibres):
            if not fibre_mask[b, c]:
                continue
            x[b, fibres * size + c] = 1
            for f in range(size):
                if f < N_DOWN or complete[f]:
                    residual[f] = source.residual[row, c, f] + noise * rng.standard_normal()
                    features[f] = gain * _respond(source.table, i, j, u, v, c, f) + residual[f]
            if is_sliding:
                _slide(source, path, c, gain, residual, source.residual[other, c], noise, rng, features, of_now)
            elif is_now_mapped:
                for k in range(N_NOW):
                    of_now[k] = features[windows[k]]
            if is_now_mapped:
                for k in range(N_NOW):
                    mapped = of_now[k] * source.now_factor[c, k, windows[k]] + source.now_offset[c, k, windows[k]]
                    features[n_timed + k] = mapped + source.now_noise * rng.standard_normal()
            for f in range(size):
                if complete[f]:
                    x[b, c * size + f] = features[f]


@kernel(inline="always")
def _locate(x: float, y: float, side: int) -> tuple[int, int, float, float]:
    """Return the cell of the table in which a position lies, or the nearest one, and how far in it along both axes."""
    u = min(max((x + 1) * ((side - 1) / 2), 0.0), side - 1 - 1e-3)
    v = min(max((y + 1) * ((side - 1) / 2), 0.0), side - 1 - 1e-3)
    return int(u), int(v), u - int(u), v - int(v)


@kernel
def _respond(table: Any, i: int, j: int, u: float, v: float, c: int, f: int) -> float:
    """Interpolate a window of a fibre in the table."""
    near = (1 - v) * table[i, j, c, f] + v * table[i, j + 1, c, f]
    return (1 - u) * near + u * ((1 - v) * table[i + 1, j, c, f] + v * table[i + 1, j + 1, c, f])


@kernel(inline="always")
def _trace(target: Any, velocity: Any, end: float, now: Any, reach: float, side: int) -> tuple[Any, Any, Any, Any]:
    """Trace a finger that slides to its target back to its touch, for the windows of `DOWN` and those of now.

    Returns:
        Windows (J,), and the correlation (J,) of their residuals with the press's. Cells (L, J, 2) of the table and the
        places (L, J, 2) in them, to which a window up to SUDDEN responds, and later ones one after the other.
    """
    count, later = N_DOWN + len(now), N_DOWN - SUDDEN
    windows, correlation = np.empty(count, np.int64), np.empty(count)
    cells, places = np.empty((later, count, 2), np.int64), np.empty((later, count, 2))
    for k in range(count):
        windows[k] = k if k < N_DOWN else now[k - N_DOWN]
        time = _MIDDLES[k] if k < N_DOWN else end - (k - N_DOWN)
        for n in range(later):
            # Windows of `DOWN` before it have not seen the change; those of now may have.
            behind = time - (_MIDDLES[SUDDEN + n] - _MIDDLES[SUDDEN])
            since = max(end - max(behind, _MIDDLES[1]), 0.0)
            x = min(max(target[0] - since * velocity[0], -1.0), 1.0)
            y = min(max(target[1] - since * velocity[1], -1.0), 1.0)
            i, j, u, v = _locate(x, y, side)
            cells[n, k, 0], cells[n, k, 1], places[n, k, 0], places[n, k, 1] = i, j, u, v
            if n == 0:
                correlation[k] = math.exp(-0.5 * (since * math.hypot(velocity[0], velocity[1]) / reach) ** 2)
    return windows, correlation, cells, places


@kernel
def _slide(
    source: Any, path: Any, c: int, gain: float, residual: Any, other: Any, noise: float, rng: Any, down: Any, now: Any
) -> None:
    """Write the windows of a fibre under a finger that slides, over those of one at rest."""
    windows, correlation, cells, places = path
    for k in range(len(windows)):
        window, response = windows[k], 0.0
        for n in range(1 + max(min(window, k) - SUDDEN, 0)):
            i, j, u, v = cells[n, k, 0], cells[n, k, 1], places[n, k, 0], places[n, k, 1]
            if n == 0:
                response = _respond(source.table, i, j, u, v, c, min(window, SUDDEN))
            else:
                response += _respond(source.table, i, j, u, v, c, SUDDEN + n)
                response -= _respond(source.table, i, j, u, v, c, SUDDEN + n - 1)
        far = math.sqrt(1 - correlation[k] ** 2) * (other[window] + noise * rng.standard_normal())
        slid = gain * response + correlation[k] * residual[window] + far
        if k < N_DOWN:
            down[k] = slid
        else:
            now[k - N_DOWN] = slid
