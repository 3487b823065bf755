"""Response of a pad from few presses: a Gaussian process about prior knowledge.

Some sixty presses do not determine the hundreds of basis functions of `ResponseModel`. The response of a fibre is
modelled as that of an earlier pad, or zero, plus the deviations of `response_priors` and a smooth remainder. Their
variances, and whether the fibre is that of the earlier pad, maximize the evidence, the marginal likelihood
(C. E. Rasmussen, C. K. I. Williams, Gaussian processes for machine learning, 2006).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from padforge.sense.arrays import MIN_SCALE_V, Array, Mask
from padforge.sense.localizer.response_model import GRID_CELLS, grid_positions, interpolate_grid, sum_by_position

SNR_NEW = 10.0, 30.0, 100.0
"""Candidate variances of the deviations of a new fibre, relative to the variance of a press about its response."""
SNR_OLD = 0.1, 1.0, 10.0  # the same for a fibre of the earlier pad, which deviates less from that
KERNELS = (1.0, 0.003), (1.0, 0.03), (1.0, 0.3), (0.0, 1.0)
"""Candidate variances of the maps of the prior and of the smooth remainder, over the SNR; the last ignores the maps."""
REMAINDER_STD = 0.35  # correlation length of the smooth remainder, scaled position
LOG_ODDS = 0.05
"""Difference of log evidence, old less new, per press and window: above it a fibre is recognized as that of the earlier
pad, below -LOG_ODDS as new. Smaller differences arise by chance, since windows are correlated."""
MIN_OLD_SHARE = 0.5
"""Share of recognized fibres above which the pad is the earlier one, and undecided fibres are old, too. On another pad
all fibres are new."""
SCATTER_SHARE = 0.8  # share of the variance of a press that grows with its squared response, on a printed pad
ROUNDS = 2  # fits of the process; the first one ignores this growth


@dataclass(frozen=True)
class ResponsePrior:
    """Prior of the response of a pad: maps on a grid over [-1, 1] in x and y.

    Each window deviates from the mean by a sum of maps with independent standard normal weights, times an amplitude.
    """

    deviations: Array  # (S, S, C, n)
    mean: Array | None = None  # (S, S, C, F), responses of an earlier pad, V or scaled as the windows


@dataclass(frozen=True)
class ResponseFit:
    """Fitted response of a pad."""

    table: Array  # (S, S, C, F), windows on the grid of the prior
    leverage: Array  # (Q, C), of presses, 0 to 1, summed over the presses at one position
    is_new: Mask  # (C,), fibres that are not those of the earlier pad
    log_evidence: float  # of the scaled windows


def fit_response(
    positions: Array, windows: Array, fibre_mask: Mask, prior: ResponsePrior, relative_depth: Array | None = None
) -> ResponseFit:
    """Fit the response, fibre by fibre, to the presses in which the fibre is valid, in a time of O(Q^3).

    Arguments are as in `ResponseModel.fit`; windows are without history, and not centred: 0 is no response. A fibre
    that is valid in no press keeps the mean of the prior, or 0.
    """
    depth = np.ones(len(positions)) if relative_depth is None else relative_depth
    fibres = np.flatnonzero(fibre_mask.any(axis=0))
    table = np.zeros((GRID_CELLS + 1, GRID_CELLS + 1, *windows.shape[1:])) if prior.mean is None else prior.mean.copy()

    # 1. Each fibre as a new one, and as that of the earlier pad
    processes, odds = [], np.zeros(len(fibres))
    for number, fibre in enumerate(fibres):
        valid = fibre_mask[:, fibre]
        presses, maps = (positions[valid], windows[valid, fibre], depth[valid]), prior.deviations[:, :, fibre]
        new = _fit_process(*presses, maps, None, SNR_NEW)
        old = new if prior.mean is None else _fit_process(*presses, maps, prior.mean[:, :, fibre], SNR_OLD)
        processes.append((new, old))
        odds[number] = (old.log_evidence - new.log_evidence) / presses[1].size

    # 2. Choice between the two
    is_same_pad = (odds > LOG_ODDS).mean() > MIN_OLD_SHARE
    is_old = is_same_pad & (odds > -LOG_ODDS)
    leverage, is_new = np.zeros(fibre_mask.shape), np.zeros(fibre_mask.shape[1], bool)
    is_new[fibres] = ~is_old
    log_evidence = 0.0
    for fibre, process in zip(fibres, processes, strict=True):
        fitted = process[int(not is_new[fibre])]
        table[:, :, fibre], leverage[fibre_mask[:, fibre], fibre] = fitted.response_on_grid(), fitted.leverages()
        log_evidence += fitted.log_evidence
    return ResponseFit(table, leverage, is_new, log_evidence)


class _Process(NamedTuple):
    """Fitted Gaussian process of the windows of a fibre. Variances are relative to that of a press."""

    log_evidence: float
    maps_variance: float  # of the deviations by the maps
    smooth_variance: float  # of the smooth remainder
    weights: Array  # (Q, F), inverse covariance times residual
    precision: Array  # (Q,), diagonal of the inverse covariance
    noise: Array  # (Q,), variance of each press
    positions: Array  # (Q, 2)
    depth: Array  # (Q,), relative
    maps: Array  # (S, S, n)
    mean: Array | None  # (S, S, F)

    def response_on_grid(self) -> Array:
        """Compute the posterior mean of the response; shape (S, S, F)."""
        grid, maps = grid_positions(GRID_CELLS + 1).reshape(-1, 2), self.maps
        weighted = self.depth[:, None] * self.weights
        deviation = self.smooth_variance * _smooth_covariance(grid, self.positions) @ weighted
        at_presses = interpolate_grid(maps, self.positions)
        deviation += self.maps_variance * maps.reshape(len(grid), -1) @ (at_presses.T @ weighted)
        deviation = deviation.reshape(*maps.shape[:2], -1)
        return deviation if self.mean is None else self.mean + deviation

    def leverages(self) -> Array:
        """Compute the leverages (Q,), summed over the presses at one position."""
        return sum_by_position(self.positions, 1 - self.noise * self.precision)


def _fit_process(
    positions: Array, windows: Array, depth: Array, maps: Array, mean: Array | None, snrs: Sequence[float]
) -> _Process:
    """Fit a process to windows (Q, F) of one fibre by maximum evidence; the scale of each window is profiled out."""
    at_presses = depth[:, None] * interpolate_grid(maps, positions)
    maps_covariance = at_presses @ at_presses.T
    smooth_covariance = np.outer(depth, depth) * _smooth_covariance(positions, positions)
    residual = windows if mean is None else windows - depth[:, None] * interpolate_grid(mean, positions)
    # A press that is given twice, as commanded and as detected, has half the weight each time.
    multiplicity = sum_by_position(positions, np.ones(len(positions)))
    best, noise = None, multiplicity
    for _ in range(ROUNDS):
        if best is not None:
            # Leave-one-out prediction of each press, and its square relative to the mean
            squares = (windows - best.weights / best.precision[:, None]) ** 2
            square = (squares / np.maximum(squares.mean(axis=0), MIN_SCALE_V**2)).mean(axis=1)
            noise, best = multiplicity * (1 - SCATTER_SHARE + SCATTER_SHARE * square), None
        for snr, (share_maps, share_smooth) in product(snrs, KERNELS):
            covariance = snr * (share_maps * maps_covariance + share_smooth * smooth_covariance) + np.diag(noise)
            precision = np.linalg.inv(covariance)
            weights = precision @ residual
            variance = np.maximum((residual * weights).mean(axis=0), MIN_SCALE_V**2)
            log_det = np.linalg.slogdet(covariance)[1]
            log_evidence = -0.5 * float(len(windows) * np.log(variance).sum() + windows.shape[1] * log_det)
            if best is None or log_evidence > best.log_evidence:
                variances = snr * share_maps, snr * share_smooth  # those of `_Process`
                prior = positions, depth, maps, mean
                best = _Process(log_evidence, *variances, weights, np.diag(precision), noise, *prior)
    assert best is not None
    return best


def _smooth_covariance(positions: Array, others: Array) -> Array:
    """Covariance (Q, P) of the smooth remainder at (Q, 2) and (P, 2) positions."""
    squares = ((positions[:, None] - others) ** 2).sum(axis=2)
    return np.exp(-0.5 * squares / REMAINDER_STD**2)
