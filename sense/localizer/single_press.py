"""Tests whether a single press explains the responses of a pad, and whether the pad is that of the calibration.

The responses of a press are those expected at some position, times a strength, with the scatter of the presses near it.
The misfit of a press is the residual at the best position and strength, in units of that scatter. It is large for most
presses on another pad. Two fingers are distinguished from one by the generalized likelihood ratio of two presses and
one. The distributions of both quantities are calibrated on presses that were not used in training.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.sense.arrays import Array, Floats, Indices, Mask
from padforge.sense.localizer.bayes import fit_projection, local_scatter
from padforge.sense.localizer.moments import LATEST_WINDOWS, N_PRESS_WINDOWS, N_TIMED
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid
from padforge.sense.localizer.scaler import ScaledFeatures, TrainingPresses

STAGES = (N_PRESS_WINDOWS, N_TIMED)
"""Numbers of complete windows from which on presses are tested: while the finger rests, and after the release."""
COMPONENTS = 4  # linear discriminants of a fibre; further ones are noise
COARSENING = 6  # cells of the response table along a side of a cell of the grid
# Two presses that are nearer, or of which one is weaker, would fit errors of the response model to a single press
MIN_CELLS = 2  # minimum distance of two presses, in cells of the grid
MIN_SHARE = 0.2  # minimum ratio of the weaker of two presses to the stronger
MAX_STRENGTH = 1.5
"""Maximum strength of either of two presses relative to the strongest in training. Without it, two strong presses would
explain the large misfit of a single one that is twice as deep."""
FALSE_RATE = 0.01  # share of single presses that the test rejects
LEVELS = 4  # numbers of failed fibres, from 0, that the tests are calibrated for
SUBSETS = 4  # sets of failed fibres of a size in the calibration
MAX_LEFT_OUT = 2  # maximum fibres left out as failed, and at most a third of all, since few fibres fit any press
# A pad is another one if its mean log misfit exceeds that of the calibration by both limits, in standard deviations of
# single presses. With 30 presses after 1500 of training, the excess with all fibres / without the worst ones was at
# least 2.0 / 0.6 on pads cast again, and at most 0.5 / 0.3 on healthy ones. With two failed fibres the second number
# was at most 0.4; with gains that drifted by up to 20 %, one of the two stayed below its limit.
MIN_MISFIT = 1.35  # with all fibres
MIN_MISFIT_LEFT_OUT = 0.4  # without the fibres that fit worst
MIN_PRESSES = 25  # with fewer presses a pad is not tested
MAX_PRESSES = 300  # presses of a pad that are used at most
MIN_STD = 0.1  # minimum standard deviation of logarithms of misfits, which few presses underestimate
OTHER_PAD = (
    "these presses are unlike those of the calibration: another pad, or one cast again; radii do not hold; recalibrate"
)
"""What `is_other_pad` means, for people."""
_CHUNK = 256


@dataclass(frozen=True)
class SinglePressTest:
    """Expected responses of a pad at one stage of a press, and the usual misfits."""

    projection: Array  # (C, F + G, D), scaled features to whitened discriminants
    positions: Array  # (P, 2), scaled, of a grid over the presses
    expected: Array  # (P, C, D), discriminants of the response
    precision: Array  # (P, C, D, D), inverse of their scatter
    offset: Array  # (C, D), discriminants without a response
    floor_share: Array  # (1,), share of the scatter variance that does not grow with the response
    max_strength: Array  # (1,), maximum strength of either of two presses
    limit: Array  # (L,), root likelihood ratio above which a press is no single one, by number of failed fibres
    usual_misfit: Array  # (L, 2), mean and standard deviation of the log misfit, by number of failed fibres
    n_presses: Array  # (1,), presses that `limit` and `usual_misfit` are calibrated on; 0 before the calibration

    @classmethod
    def fit(
        cls,
        table: Floats,
        presses: TrainingPresses,
        centring: Array,
        n_complete: int,
        earlier: "SinglePressTest | None" = None,
    ) -> "SinglePressTest":
        """Fit the leave-one-out scatter of presses about the response, in the first `n_complete` windows.

        The table (S, S, C, F + G) is the scaled response over [-1, 1] in x and y; `centring` (C, F + G) is what
        scaling has subtracted from the features. Discriminants of an `earlier` test are kept, since few presses do not
        determine them.
        """
        # 1. Discriminants of the windows that are complete
        n_timed, side = presses.n_timed, len(table)
        usable = np.ones(table.shape[3], bool)
        if n_timed:
            usable[n_complete : n_timed + len(LATEST_WINDOWS)] = False
        table = np.where(usable, table, 0.0)
        positions = presses.targets[:, :2].astype(np.float64)
        relative_depth = 1 + presses.depth_gain * presses.targets[:, 2:3] if presses.depth_gain else np.ones((1, 1))
        at_presses = relative_depth * interpolate_grid(table.reshape(side, side, -1), positions)
        residual = presses.inputs - at_presses.reshape(presses.inputs.shape)
        earlier_projection = earlier.projection if earlier else None
        projection = fit_projection(table, residual, presses.fibre_mask, COMPONENTS, earlier_projection)
        residual = np.einsum("qcf,cfd->qcd", residual, projection) * presses.fibre_mask[:, :, None]
        # 2. Responses and scatter on a coarse grid over the presses
        offset = np.einsum("cf,cfd->cd", centring * usable, projection)
        responses = np.einsum("xycf,cfd->xycd", table, projection) + offset
        low, high = positions.min(axis=0), positions.max(axis=0)
        grid = grid_positions(side)[::COARSENING, ::COARSENING]
        step, cell = 2 / (side - 1), float(grid[1, 0, 0] - grid[0, 0, 0])
        inside = ((grid >= low - cell / 2) & (grid <= high + cell / 2)).all(axis=2)
        slopes = np.stack(np.gradient(responses, step, axis=(0, 1)), axis=-1)[::COARSENING, ::COARSENING][inside]
        scatter = local_scatter(grid[inside], positions, residual, presses.fibre_mask, cell)
        # Each position of the grid stands for its cell, over which the response varies by its slope.
        blurred = scatter + cell**2 / 12 * slopes @ slopes.swapaxes(2, 3)
        modelled = relative_depth * interpolate_grid(responses.reshape(side, side, -1), positions)
        return cls(
            projection=projection,
            positions=grid[inside],
            expected=responses[::COARSENING, ::COARSENING][inside],
            precision=np.linalg.inv(blurred),
            offset=offset,
            floor_share=np.array([_floor_share(residual, modelled.reshape(residual.shape))]),
            max_strength=np.array([MAX_STRENGTH * float(relative_depth.max())]),
            limit=np.full(LEVELS, np.inf),
            usual_misfit=np.tile([0.0, 1.0], (LEVELS, 1)),
            n_presses=np.zeros(1),
        )

    def calibrated(self, presses: ScaledFeatures) -> "SinglePressTest":
        """Return the test with `limit` and `usual_misfit` of presses that were not used in training."""
        fibres, n_presses = len(self.expected[0]), len(presses)
        limit, usual = self.limit.copy(), self.usual_misfit.copy()
        for level in range(min(LEVELS, fibres) if n_presses > 1 else 0):
            subsets = failure_subsets(fibres, level, SUBSETS)
            masks = [presses.fibre_mask & ~np.isin(np.arange(fibres), failed) for failed in subsets]
            ratio = np.concatenate([self._root_likelihood_ratio(presses.inputs, mask) for mask in masks])
            misfit = np.concatenate([self._fit(presses.inputs, mask[:, None]).log_misfit[:, 0] for mask in masks])
            # prediction limit of a normal distribution whose mean and variance are estimated
            quantile = stdtrit(n_presses - 1, 1 - FALSE_RATE) * sqrt(1 + 1 / n_presses)
            limit[level] = ratio.mean() + quantile * ratio.std()
            usual[level] = misfit.mean(), max(misfit.std(), MIN_STD)
        return replace(self, limit=limit, usual_misfit=usual, n_presses=np.array([float(n_presses)]))

    def is_unlike(self, inputs: Floats, fibre_mask: Mask) -> Mask:
        """Return (Q,) whether two presses explain (Q, C, F + G) scaled features much better than one."""
        limit = self.limit[np.minimum((~fibre_mask).sum(axis=1), LEVELS - 1)]
        # the squared ratio does not exceed the misfit of a single press
        rows = np.flatnonzero(self._fit(inputs, fibre_mask[:, None]).misfit[:, 0] > limit**2)
        unlike = np.zeros(len(inputs), bool)
        unlike[rows] = self._root_likelihood_ratio(inputs[rows], fibre_mask[rows]) > limit[rows]
        return unlike

    def misfits(self, inputs: Floats, fibre_mask: Mask) -> Array:
        """Return (Q, M) log misfits, standardized by the usual ones, with each of M sets of fibres left out.

        The sets have up to MAX_LEFT_OUT fibres. The first one is empty: all fibres in the (Q, C) mask are used.
        """
        fibres = fibre_mask.shape[1]
        max_left_out = min(MAX_LEFT_OUT, fibres // 3)
        sets = [left_out for size in range(max_left_out + 1) for left_out in combinations(range(fibres), size)]
        masks = fibre_mask[:, None] & np.array([~np.isin(np.arange(fibres), left_out) for left_out in sets])
        mean, std = self.usual_misfit[np.minimum((~masks).sum(axis=2), LEVELS - 1)].transpose(2, 0, 1)
        return (self._fit(inputs, masks).log_misfit - mean) / std

    def _fit(self, inputs: Floats, masks: Mask) -> "_Fit":
        """Fit a single press to inputs (Q, C, F + G), with the fibres in each of the masks (Q, M, C)."""
        parts = [
            self._fit_chunk(self._project(inputs[start : start + _CHUNK]), masks[start : start + _CHUNK])
            for start in range(0, max(len(inputs), 1), _CHUNK)
        ]
        return _Fit(*map(np.concatenate, zip(*parts, strict=True)))

    def _fit_chunk(self, z: Array, masks: Mask) -> "_Fit":
        """Fit a single press to (Q, C, D) discriminants z at each position, and keep the best position.

        With the expected response m of a position and the precision P, the strength is z' P m / m' P m, but at least 0.
        """
        # z' P z is summed over the upper triangle of P, with twice the elements off the diagonal
        first, second = np.triu_indices(COMPONENTS)
        factors = self.precision[:, :, first, second] * np.where(first == second, 1.0, 2.0)
        weighted = np.einsum("pcde,pce->pcd", self.precision, self.expected)
        fibre_masks = masks.swapaxes(1, 2).astype(np.float64)

        def over_fibres(part: Array) -> Array:  # (Q, P, C) or (P, C) to (Q, P, M)
            return part @ fibre_masks

        norm_z = over_fibres(np.einsum("qcm,pcm->qpc", z[:, :, first] * z[:, :, second], factors, optimize=True))
        cross = over_fibres(np.einsum("qcd,pcd->qpc", z, weighted, optimize=True))
        norm = over_fibres(np.einsum("pcd,pcd->pc", weighted, self.expected))
        strength = np.maximum(cross / np.maximum(norm, 1e-9), 0.0)
        growth = np.maximum(self.floor_share + (1 - self.floor_share) * strength**2, 1.0)
        misfit = (norm_z - strength * cross) / growth
        best = misfit.argmin(axis=1)
        misfit, growth = (np.take_along_axis(part, best[:, None], axis=1)[:, 0] for part in (misfit, growth))
        n_terms = np.maximum(COMPONENTS * masks.sum(axis=2), 1)
        return _Fit(np.log(np.maximum(misfit / n_terms, 1e-6)), misfit, best, growth)

    def _root_likelihood_ratio(self, inputs: Floats, fibre_mask: Mask) -> Array:
        """Return the root (Q,) of twice the log-likelihood ratio of two presses over one.

        The scatter of both is that of the single press that fits best.
        """
        one, z = self._fit(inputs, fibre_mask[:, None]), self._project(inputs)
        ratios = np.empty(len(z))
        for press, (position, valid) in enumerate(zip(one.position[:, 0], fibre_mask, strict=True)):
            whitening = np.linalg.cholesky(self.precision[position, valid])
            expected = (self.expected[:, valid, None] @ whitening).reshape(len(self.positions), -1)
            measured = (z[press, valid, None] @ whitening).ravel()
            gram, moment = expected @ expected.T, expected @ measured
            norm = np.diag(gram)[:, None] * np.diag(gram)
            det = np.maximum(norm - gram**2, 1e-3 * norm)  # the two responses may be nearly the same
            # least-squares strengths of the first and of the second press, for each pair of positions (P, P)
            first = (np.diag(gram) * moment[:, None] - gram * moment) / np.maximum(det, 1e-9)
            second = first.T
            is_pair = self._is_apart & (first > MIN_SHARE * second) & (second > MIN_SHARE * first)
            is_pair &= np.maximum(first, second) < self.max_strength
            explained = np.where(is_pair, first * moment[:, None] + second * moment, 0.0).max()
            two = (measured @ measured - explained) / one.scatter_growth[press, 0]
            ratios[press] = sqrt(max(one.misfit[press, 0] - two, 0.0))
        return ratios

    def _project(self, inputs: Floats) -> Array:
        """Return discriminants (Q, C, D) of scaled features (Q, C, F + G), with NaN as 0."""
        return np.einsum("qcf,cfd->qcd", np.nan_to_num(inputs), self.projection, optimize=True) + self.offset

    @cached_property
    def _is_apart(self) -> Mask:
        """Pairs of positions (P, P) that are distant enough for two presses."""
        distance = np.linalg.norm(self.positions[:, None] - self.positions, axis=2)
        cell = distance[distance > 0].min(initial=np.inf)
        return distance > (MIN_CELLS - 0.5) * cell  # half a cell less, against rounding


def find_unlike(tests: Sequence[SinglePressTest], presses: ScaledFeatures) -> Mask:
    """Return (Q,) whether two presses explain the features much better than one, by the test of the latest stage.

    The result is false for presses before the first stage.
    """
    n_complete, unlike = presses.n_complete, np.zeros(len(presses), bool)
    numbers = stages(presses.n_timed)
    for test, first, end in zip(tests, numbers, [*numbers[1:], np.inf], strict=True):
        rows = np.flatnonzero((n_complete >= first) & (n_complete < end))
        unlike[rows] = test.is_unlike(presses.inputs[rows], presses.fibre_mask[rows])
    return unlike


def stages(n_timed: int) -> tuple[int, ...]:
    """Return the numbers of complete windows from which on each test holds; 0 alone without timed windows."""
    return STAGES if n_timed else (0,)


def find_misfits(tests: Sequence[SinglePressTest], presses: ScaledFeatures) -> Array:
    """Return (Q, M) `SinglePressTest.misfits` of up to MAX_PRESSES complete presses."""
    finished = np.flatnonzero(presses.complete.all(axis=1))
    rows = finished[np.linspace(0, len(finished) - 1, min(len(finished), MAX_PRESSES)).astype(np.int64)]
    return tests[-1].misfits(presses.inputs[rows], presses.fibre_mask[rows])


def is_other_pad(tests: Sequence[SinglePressTest], misfits: Array) -> bool:
    """Return whether presses with (Q, M) misfits are of another pad than that of the calibration, or one cast again.

    The result is false for fewer than MIN_PRESSES. A failed fibre makes no other pad: without it the others fit.
    """
    if len(misfits) < MIN_PRESSES or tests[-1].n_presses[0] < 2:
        return False
    mean, uncertainty = misfits.mean(axis=0), 1 / sqrt(tests[-1].n_presses[0])
    return bool(mean[0] > MIN_MISFIT + uncertainty and mean.min() > MIN_MISFIT_LEFT_OUT + uncertainty)


class _Fit(NamedTuple):
    """The single press that fits best, with the fibres in each mask; shapes (Q, M)."""

    log_misfit: Array  # logarithm of the misfit per component
    misfit: Array  # squared residual, in units of the scatter
    position: Indices  # index in `SinglePressTest.positions`
    scatter_growth: Array  # variance at the strength of the press, relative to that in training


def _floor_share(residual: Array, response: Array) -> float:
    """Return the share of the scatter variance that does not grow with the response, from (Q, C, D) training presses.

    First the strength that all fibres of a press have in common is fitted and removed. The variance is then assumed to
    grow linearly with the squared response; its slope is taken from the stronger and the weaker half of the responses.
    """
    norm = np.maximum((response**2).sum(axis=(1, 2)), 1e-9)
    strength = (residual * response).sum(axis=(1, 2)) / norm
    residual = residual - strength[:, None, None] * response
    variance, energy = ((part**2).mean(axis=2).ravel() for part in (residual, response))
    is_strong = energy > np.median(energy)
    if not is_strong.any() or not variance.any():
        return 1.0
    rise, run = (part[is_strong].mean() - part[~is_strong].mean() for part in (variance, energy))
    return float(np.clip(1 - rise / run * energy.mean() / variance.mean(), 0.0, 1.0))
