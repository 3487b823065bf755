"""Fit of an as-built pad to responses: maximum a posteriori by Levenberg-Marquardt, and the scatter of its residuals.

Residuals are Gaussian, with one standard deviation for each channel. The prior is that fibres lie within a millimetre
or so of the plan: lateral offsets and log-sensitivities are smooth Gaussian curves along each fibre, whose standard
deviations are estimated with everything else by maximum evidence (D. J. C. MacKay, Neural Computation 4, 1992).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import nnls

from padforge.design.twin import TwinScatter
from padforge.sense.arrays import MIN_SCALE_V, Array, Indices, Mask
from padforge.sense.twin.as_built import (
    N_CHANNEL,
    N_OFFSET,
    N_SENSITIVITY,
    N_SHARED,
    N_SPLINES,
    OFFSET,
    SENSITIVITY,
    AsBuiltPad,
    channel_indices,
    evaluate_along_fibre,
)
from padforge.sense.twin.responses import Responses, near_pairs

CORRELATION_LENGTH = 0.3  # correlation length of lateral offsets and log-sensitivities, as a share of the fibre
TRANSFORM_STD = np.array([0.1, 5.0, 5.0, 0.05])
"""Prior standard deviations of turn (rad, from a quarter turn), shift (mm, from 0) and scale (from 1)."""
ANGULAR_STD = 0.3  # prior standard deviation of the splines of v
PROFILE_BEND = 0.15
"""Prior standard deviation of the second differences of a profile's splines, as a share of its largest weight."""
OFFSET_RANGE_MM, SENSITIVITY_RANGE = (0.1, 1.2), (0.02, 0.9)
"""Ranges of the standard deviations of lateral offset, mm, and log-sensitivity."""
FIRST_PRIOR_STEP = 3  # step from which these are estimated; before, a poor fit would pass for large offsets
TOLERANCE = 1e-4  # relative change of the objective at which a fit has converged
MAX_DAMPING = 1e8
MAX_STEPS = 25
WANDER_PRESSES = 250  # presses over which gains are averaged
MIN_PAIRS = 30  # pairs of presses that the scatter is estimated from, at least


@dataclass(frozen=True)
class Priors:
    """Prior standard deviations of deviations from the plan; 0 where there are none."""

    lateral_offset_mm: float = 0.0
    log_sensitivity: float = 0.0
    angular: bool = False  # whether the response may depend on the angle between fibre and press
    pose: bool = True  # whether the plan transform is fitted

    def free_mask(self, channels: int) -> Mask:
        """Return which of `AsBuiltPad.values` are fitted."""
        by_channel = np.ones((channels, N_CHANNEL), bool)
        by_channel[:, OFFSET], by_channel[:, SENSITIVITY] = self.lateral_offset_mm > 0, self.log_sensitivity > 0
        shared = np.ones(N_SHARED, bool)
        shared[:4], shared[4 + N_SPLINES :] = self.pose, self.angular
        return np.concatenate([shared, by_channel.ravel()])


@dataclass(frozen=True)
class AsBuiltFit:
    """A fitted pad, maximum a posteriori, and its uncertainty."""

    pad: AsBuiltPad
    priors: Priors
    covariance: Array  # of `pad.values`; 0 for those that were not fitted
    log_evidence: float  # logarithm of the marginal likelihood, to compare fits to the same presses

    def offset_std(self, channel: int) -> Array:
        """Compute the standard deviation of the lateral offset along a channel's fibre (E,), grid units."""
        _, first, values = evaluate_along_fibre(np.zeros((1, N_OFFSET)), self.pad.plan.elements)
        basis = np.zeros((self.pad.plan.elements, N_OFFSET))
        np.put_along_axis(basis, first[:, None] + np.arange(4), values[0], axis=1)
        blocks = [self.covariance[np.ix_(axis, axis)] for axis in np.split(channel_indices(channel)[OFFSET], 2)]
        return np.sqrt(np.maximum(sum(np.einsum("fj,jk,fk->f", basis, block, basis) for block in blocks), 0))


def fit_as_built(
    start: AsBuiltPad, responses: Responses, priors: Priors, noise_inflation: Array | float = 1.0
) -> AsBuiltFit:
    """Fit a pad to the responses of its channels, maximum a posteriori, from a first guess whose wiring stays.

    `noise_inflation` is a factor (C,) on the noise of each channel, since residuals of neighbouring presses are
    correlated where the model is wrong.
    """
    free, damping = np.flatnonzero(priors.free_mask(len(start.fibres))), 1e-3
    current = _Objective(start, responses, priors, noise_inflation, np.sqrt(responses.variance) / 2)
    for step in range(MAX_STEPS):
        hessian, gradient = current.normal_equations()
        block, change, proposal = hessian[np.ix_(free, free)], np.zeros(len(gradient)), None
        while proposal is None and damping < MAX_DAMPING:
            change[free] = cho_solve(cho_factor(block + damping * np.diag(np.diag(block))), gradient[free])
            proposal = current.at_step(change)
            if proposal.value >= current.value:
                damping, proposal = 4 * damping, None
        if proposal is None:
            break
        gain, damping = current.value - proposal.value, max(damping / 16, 1e-7)
        current = proposal.update_noise(_inverse(hessian, free) if step >= FIRST_PRIOR_STEP else None)
        if gain < TOLERANCE * abs(current.value):
            break
    hessian = current.normal_equations()[0]
    return AsBuiltFit(current.pad, current.priors, _inverse(hessian, free), current.log_evidence(hessian, free))


def _inverse(matrix: Array, free: Indices) -> Array:
    """Invert the block of a matrix that belongs to `free` parameters; 0 elsewhere."""
    out = np.zeros_like(matrix)
    out[np.ix_(free, free)] = cho_solve(cho_factor(matrix[np.ix_(free, free)]), np.eye(len(free)))
    return out


def _smooth_precision(count: int) -> Array:
    """Return the prior precision (count, count) of the coefficients of a curve of unit variance along a fibre."""
    position = np.arange(count) / (count - 3)
    covariance = np.exp(-0.5 * ((position[:, None] - position) / CORRELATION_LENGTH) ** 2) + 1e-4 * np.eye(count)
    return np.asarray(np.linalg.inv(covariance), np.float64)


OFFSET_PRECISION = np.kron(np.eye(2), _smooth_precision(N_OFFSET)).astype(np.float64)
SENSITIVITY_PRECISION = _smooth_precision(N_SENSITIVITY)
_second_difference = np.eye(N_SPLINES, k=1) + np.eye(N_SPLINES, k=-1) - 2 * np.eye(N_SPLINES)
_second_difference[0, 1] = 2.0  # a profile is mirrored at 0, and 0 from its end on
PROFILE_PRECISION = _second_difference.T @ _second_difference / PROFILE_BEND**2


class _Objective:
    """Twice the negative log-posterior of a pad, given responses and the noise (C,) of their residuals, V."""

    def __init__(
        self, pad: AsBuiltPad, responses: Responses, priors: Priors, noise_inflation: Array | float, noise: Array
    ) -> None:
        self.pad, self.priors, self.noise = pad, priors, noise
        self._responses, self._noise_inflation = responses, noise_inflation
        volts, self._jacobians = pad.predict_with_jacobian(responses.positions_mm)
        self._residual = np.where(responses.valid, responses.volts - volts, 0.0)
        self._precision, self._deviation = self._prior()
        self.value = self._evaluate()

    def at_step(self, step: Array) -> "_Objective":
        """Return the objective of the pad with `step` added to its parameters."""
        pad = self.pad.with_values(self.pad.values + step)
        return _Objective(pad, self._responses, self.priors, self._noise_inflation, self.noise)

    def normal_equations(self) -> tuple[Array, Array]:
        """Return J' J and J' r of residuals over noise, with the prior."""
        hessian, gradient = self._precision.copy(), -self._precision @ self._deviation
        for c, jacobian in enumerate(self._jacobians):
            columns = np.concatenate([np.arange(N_SHARED), channel_indices(c)])
            weighted = jacobian * (self._responses.valid[:, c, None] / self.noise[c])
            hessian[np.ix_(columns, columns)] += weighted.T @ weighted
            gradient[columns] += weighted.T @ (self._residual[:, c] / self.noise[c])
        profile = np.arange(4, 4 + N_SPLINES)
        # profile and gains share one scale, which `with_values` settles; this keeps the matrix from being singular
        hessian[profile, profile] += 1e-3 * hessian[profile, profile].max()
        return hessian, gradient

    def update_noise(self, covariance: Array | None) -> "_Objective":
        """Re-estimate the noise and, given the covariance of the parameters, the priors; return the objective."""
        std = np.sqrt((self._residual**2).sum(axis=0) / np.maximum(self._responses.valid.sum(axis=0), 1))
        self.noise = np.maximum(self._noise_inflation * std, MIN_SCALE_V)
        if covariance is not None:
            if self.priors.lateral_offset_mm:
                std_mm = self._curve_std(covariance, OFFSET, OFFSET_PRECISION) * self.pad.plan.layout.unit_mm
                self.priors = replace(self.priors, lateral_offset_mm=float(np.clip(std_mm, *OFFSET_RANGE_MM)))
            if self.priors.log_sensitivity:
                std = self._curve_std(covariance, SENSITIVITY, SENSITIVITY_PRECISION)
                self.priors = replace(self.priors, log_sensitivity=float(np.clip(std, *SENSITIVITY_RANGE)))
            self._precision, self._deviation = self._prior()
        self.value = self._evaluate()
        return self

    def log_evidence(self, hessian: Array, free: Indices) -> float:
        """Return the log marginal likelihood by Laplace's approximation, up to a constant."""
        informed = free[np.diag(self._precision)[free] > 0]
        prior_log_det = np.linalg.slogdet(self._precision[np.ix_(informed, informed)])[1]
        return -0.5 * (self.value + np.linalg.slogdet(hessian[np.ix_(free, free)])[1] - prior_log_det)

    def _evaluate(self) -> float:
        counts = self._responses.valid.sum(axis=0)
        misfit = ((self._residual / self.noise) ** 2).sum() + 2 * (counts * np.log(self.noise)).sum()
        return float(misfit + self._deviation @ self._precision @ self._deviation)

    def _prior(self) -> tuple[Array, Array]:
        """Return the prior precision of all parameters, and their deviation from the prior mean."""
        pad, size = self.pad, len(self.pad.values)
        precision, deviation = np.zeros((size, size)), pad.values.copy()
        quarter = np.pi / 2
        deviation[:4] -= [np.round(deviation[0] / quarter) * quarter, 0.0, 0.0, 1.0]
        diagonal = np.repeat([0.0, ANGULAR_STD**-2.0], [4 + N_SPLINES, N_SPLINES])
        diagonal[:4] = TRANSFORM_STD**-2.0
        precision[:N_SHARED, :N_SHARED] = np.diag(diagonal)
        for profile in (slice(4, 4 + N_SPLINES), slice(4 + N_SPLINES, N_SHARED)):
            precision[profile, profile] += PROFILE_PRECISION
        for c in range(len(pad.fibres)):
            indices = channel_indices(c)
            for rows, block, std in (
                (indices[OFFSET], OFFSET_PRECISION, self.priors.lateral_offset_mm / pad.plan.layout.unit_mm),
                (indices[SENSITIVITY], SENSITIVITY_PRECISION, self.priors.log_sensitivity),
            ):
                if std > 0:
                    precision[np.ix_(rows, rows)] = block / std**2
        return precision, deviation

    def _curve_std(self, covariance: Array, part: slice, precision: Array) -> float:
        """Return the standard deviation of the curves of all channels, with their uncertainty."""
        curves = self.pad.channel_values[:, part]
        indices = [channel_indices(c)[part] for c in range(len(curves))]
        uncertainty = sum(np.trace(precision @ covariance[np.ix_(rows, rows)]) for rows in indices)
        return float(np.sqrt((np.einsum("cj,jk,ck->", curves, precision, curves) + uncertainty) / curves.size))


def estimate_scatter(pad: AsBuiltPad, responses: Responses, noise_v: Array) -> TwinScatter:
    """Estimate the part of the scatter of responses that grows with them.

    Half the squared difference of the residuals of two neighbouring presses is their variance, since a smooth function
    of the position cancels. It is floor^2 + share^2 x^2 for responses x, a straight line over x^2. Half the product of
    such differences of two channels is common share^2 x_c x_c'. With too few presses, the scatter is a constant noise.
    `noise_v` (C,) is the standard deviation of each channel's total scatter.
    """
    valid = np.flatnonzero(responses.valid.all(axis=1))
    if len(valid) < 2 * MIN_PAIRS:
        return TwinScatter()
    first, second = (valid[pair] for pair in near_pairs(responses.positions_mm[valid]))
    expected = pad.predict(responses.positions_mm) - pad.channel_values[:, 1]
    residual = responses.volts - expected
    difference = (residual[first] - residual[second]) / noise_v
    response = (responses.volts[first] + responses.volts[second]) / 2 / noise_v
    variance = difference**2 / 2
    floor_var, share_var = 1.0, 0.0
    for _ in range(10):  # reweighted: the variance of one pair scatters by about itself
        weight = 1 / (floor_var + share_var * response.ravel() ** 2).clip(1e-3)
        design_matrix = np.column_stack([np.ones(response.size), response.ravel() ** 2])
        (floor_var, share_var), _ = nnls(weight[:, None] * design_matrix, weight * variance.ravel())
    # scale the sum to the variance of the noise, from which it differs if variances do not grow with squares
    total = floor_var + share_var * float(np.mean(response**2))
    floor_var, share_var = (part / total if total > 0 else part for part in (floor_var, share_var))
    first, second = np.triu_indices(response.shape[1], 1)  # pairs of channels
    scale = 1 / (floor_var + share_var * response**2).clip(1e-3)
    response_products, difference_products = (
        np.einsum("qc,qd->qcd", values * scale**0.5, values * scale**0.5)[:, first, second]
        for values in (response, difference / np.sqrt(2))
    )
    squared = share_var * (response_products**2).sum()
    common = float((response_products * difference_products).sum() / squared) if squared > 0 else 0.0
    share, floor = (float(np.sqrt(min(part, 1.0))) for part in (share_var, floor_var))
    return TwinScatter(share, float(np.clip(common, 0, 0.99)), floor)


def gain_wander(pad: AsBuiltPad, responses: Responses) -> float:
    """Estimate the standard deviation of gains between blocks of successive presses, beyond that by chance."""
    expected = pad.predict(responses.positions_mm) - pad.channel_values[:, 1]
    volts = np.where(responses.valid, responses.volts - pad.channel_values[:, 1], expected)
    blocks = len(volts) // WANDER_PRESSES
    if blocks < 2:
        return 0.0
    y, x = (values[: blocks * WANDER_PRESSES].reshape(blocks, WANDER_PRESSES, -1) for values in (volts, expected))
    power = np.maximum((x**2).sum(axis=1), MIN_SCALE_V**2)
    gain = (x * y).sum(axis=1) / power
    chance_var = ((y - gain[:, None] * x) ** 2 * x**2).sum(axis=1) / power**2
    return float(np.clip(np.mean(gain.var(axis=0, ddof=1) - chance_var.mean(axis=0)), 0, 1) ** 0.5)
