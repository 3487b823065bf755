"""Bayesian localizer: position of a press from the fitted response of the pad, with any fibres masked.

The features of a fibre are normally distributed about the response expected at a position, with the scatter of the
presses near it. A posterior on a grid over the pad, each position of which stands for its cell, gives a mean and
variances. A few Gauss-Newton steps from that mean, with the posterior of the grid as the prior, lead to the maximum a
posteriori position (the steps of an iterated Kalman filter: M. S. Grewal and A. P. Andrews, Kalman filtering, 2015).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from padforge.common.parallel import map_threads
from padforge.common.progress import OnProgress, ignore_progress
from padforge.sense.arrays import Array, Mask
from padforge.sense.localizer.moments import BAYES_STAGES, LATEST_WINDOWS
from padforge.sense.localizer.response_model import grid_positions, interpolate_grid

COMPONENTS = 6  # linear discriminants of a fibre
LINEARIZED = 2  # cells of the response table along a side of a cell of the linearization
COARSENING = 3  # cells of the response table along a side of a cell of the posterior grid
SCATTER_WIDTH = 4.0  # standard deviation of the weights by which scatter is averaged, in distances between presses
SCATTER_PRIOR_COUNT = 10.0  # weight of the scatter of the whole pad in these averages, in presses
PRIOR_WEIGHT = 0.05  # of the grid posterior in the Gauss-Newton steps; small, since both use the same features
GAUSS_NEWTON_STEPS = 2
MAX_STEP = 0.2  # maximum Gauss-Newton step, in units of the scaled position
MIN_STD = 1e-2  # minimum standard deviation of the grid posterior, a tenth of a cell
N_SUMMARY = 9  # entries of a posterior summary, see `BayesianLocalizer.predict`
MIN_EXPONENT = -60.0
"""Exponents are clipped to it: smaller ones are negligible, and ten times slower to exponentiate. The expected error of
a design (`bayes_error`) has the same limit for the same reason, but importing it from there would take seconds."""
_CHUNK = 2**15


@dataclass(frozen=True)
class BayesianLocalizer:
    """Fitted likelihood of a pad, in arrays of NumPy or of torch.

    All values are exact in single precision. NumPy computes in double precision, since the Gauss-Newton steps are only
    as accurate as the residuals; single precision suffices for training.
    """

    projection: Any  # (C, F + G, D), scaled features to whitened discriminants
    grid: Any  # (P, 2) positions
    # (C (D (D + 3) / 2 + 1), P), coefficients of products of discriminants, discriminants and 1, fibre by fibre
    log_likelihood_coefficients: Any
    # (S, S, C (3 D + 3)) on a grid over [-1, 1] in x and y, see `_linearize`
    linearization: Any
    bounds: Any  # (2, 2), lowest and highest x and y of presses
    rotation: Any  # (2, 2), from the positions of the fit to the returned ones
    shift: Any  # (2,), added to the rotated positions

    @classmethod
    def fit(
        cls, table: Any, inputs: Any, fibre_mask: Mask, positions: Any, earlier: "BayesianLocalizer | None" = None
    ) -> "BayesianLocalizer":
        """Fit the likelihood to scaled presses (Q, C, F + G) at positions (Q, 2).

        The table (S, S, C, F + G) is the scaled response over [-1, 1] in x and y. Discriminants and pressed area of an
        earlier localizer are kept: the correlation of the windows of a fibre depends on the silicone more than on the
        pad, and cannot be estimated from few presses.
        """
        side, _, fibres, _ = table.shape
        table, inputs, positions = (part.astype(np.float64) for part in (table, inputs, positions))
        low, high = positions.min(axis=0), positions.max(axis=0)
        if earlier is not None:
            low, high = np.minimum(low, earlier.bounds[0]), np.maximum(high, earlier.bounds[1])

        # 1. Grids: the table, the linearization and the posterior, from fine to coarse
        grid = grid_positions(side)
        step, coarse = float(grid[1, 0, 0] - grid[0, 0, 0]), grid[::COARSENING, ::COARSENING]
        linearized = (slice(None, None, LINEARIZED),) * 2
        cell = float(coarse[1, 0, 0] - coarse[0, 0, 0])
        inside = ((coarse >= low - cell) & (coarse <= high + cell)).all(axis=2)

        # 2. Discriminants, and the covariance of their residuals on the coarse grid
        residual = inputs - interpolate_grid(table, positions)
        projection = fit_projection(table, residual, fibre_mask, COMPONENTS, earlier.projection if earlier else None)
        residual = np.einsum("qcf,cfd->qcd", residual, projection) * fibre_mask[:, :, None]
        scatter = local_scatter(coarse.reshape(-1, 2), positions, residual, fibre_mask, cell)
        scatter = scatter.reshape(*coarse.shape[:2], fibres, -1)

        # 3. Linearization and coefficients of the log likelihood, fibre by fibre
        coefficients, responses, jacobians, informations = [], [], [], []
        for fibre in range(fibres):
            expected = table[:, :, fibre] @ projection[fibre]
            covariance = interpolate_grid(scatter[:, :, fibre], grid.reshape(-1, 2))
            covariance = covariance.reshape(side, side, COMPONENTS, COMPONENTS)
            unused = np.flatnonzero(~projection[fibre].any(axis=0))
            covariance[:, :, unused, unused] = 1.0  # constant, since it must not depend on the density of presses
            jacobian = np.stack(np.gradient(expected, step, axis=(0, 1)), axis=2)
            weighted = jacobian @ np.linalg.inv(covariance)
            fisher = weighted @ jacobian.swapaxes(2, 3)
            responses.append(expected[linearized])
            jacobians.append(weighted[linearized].reshape(*responses[-1].shape[:2], -1))
            diagonal = (np.maximum(fisher[..., k, k], 0) for k in (0, 1))  # may be negative by rounding
            informations.append(np.stack([*diagonal, fisher[..., 0, 1]], axis=2)[linearized])
            # Each position of the grid stands for its cell, over which the response varies by its slope.
            slope = jacobian[::COARSENING, ::COARSENING][inside]
            blurred = covariance[::COARSENING, ::COARSENING][inside] + cell**2 / 12 * slope.swapaxes(1, 2) @ slope
            on_grid = expected[::COARSENING, ::COARSENING][inside]
            coefficients.append(_log_likelihood_coefficients(on_grid, np.linalg.inv(blurred)))
        linearization = np.concatenate([*responses, *jacobians, *informations], axis=2)
        arrays = projection, coarse[inside], np.concatenate(coefficients), linearization, np.stack([low, high])
        return cls(*map(_rounded, (*arrays, np.eye(2), np.zeros(2))))

    def predict(self, inputs: Any, fibre_mask: Any, xp: Any = np) -> tuple[Any, Any]:
        """Predict positions and posterior summaries from scaled features (Q, C, F + G); `xp` is numpy or torch.

        Returns:
            Maximum a posteriori positions (Q, 2), scaled; and summaries (Q, N_SUMMARY): position, its log variances,
            mean of the grid posterior, its log variances, and its correlation.
        """
        mask = xp.asarray(fibre_mask, dtype=inputs.dtype)
        z = xp.matmul(xp.where(fibre_mask[:, :, None], inputs, 0.0).swapaxes(0, 1), self.projection).swapaxes(0, 1)
        grid_mean, grid_var, grid_corr = self._grid_posterior(z, mask, xp)
        prior_precision, position, var = PRIOR_WEIGHT / grid_var, grid_mean, grid_var
        for _ in range(GAUSS_NEWTON_STEPS):
            expected, weighted_jacobian, fisher = self._linearize(position, xp)
            residual = mask[:, :, None] * (z - expected)
            gradient = (weighted_jacobian * residual[:, :, None, :]).sum(axis=3).sum(axis=1)
            gradient = gradient + prior_precision * (grid_mean - position)
            var, step = _solve_2x2((mask[:, :, None] * fisher).sum(axis=1), prior_precision, gradient, xp)
            position = xp.clip(position + xp.clip(step, -MAX_STEP, MAX_STEP), self.bounds[0], self.bounds[1])
        # Scaled to about 1, as the inputs of a network should be
        log_var, log_grid_var = (1 + 0.25 * xp.log(values) for values in (var, grid_var))
        summary = xp.concat([2 * position, log_var, 2 * grid_mean, log_grid_var, grid_corr[:, None]], axis=1)
        return position @ self.rotation.T + self.shift, summary

    def _linearize(self, position: Any, xp: Any) -> tuple[Any, Any, Any]:
        """Linearize the response of each fibre at (Q, 2) positions.

        Returns:
            Expected discriminants (Q, C, D); their Jacobian, transposed, times the inverse of their covariance
            (Q, C, 2, D); and that times the Jacobian, the Fisher information in xx, yy and xy (Q, C, 3).
        """
        fibres, _, size = self.projection.shape
        local = interpolate_grid(self.linearization, position, xp)
        return (
            local[:, : fibres * size].reshape(-1, fibres, size),
            local[:, fibres * size : 3 * fibres * size].reshape(-1, fibres, 2, size),
            local[:, 3 * fibres * size :].reshape(-1, fibres, 3),
        )

    def _grid_posterior(self, z: Any, mask: Any, xp: Any) -> tuple[Any, Any, Any]:
        """Return mean (Q, 2), variances (Q, 2) and correlation (Q,) of the posterior on the grid."""
        first, second = (indices.tolist() for indices in np.triu_indices(z.shape[2]))
        monomials = xp.concat([z[:, :, first] * z[:, :, second], z, xp.ones_like(z[:, :, :1])], axis=2)
        coefficients = self.log_likelihood_coefficients
        # -1 for the presses, whose number is symbolic in an export
        log_likelihood = (monomials * mask[:, :, None]).reshape(-1, len(coefficients)) @ coefficients
        log_likelihood -= xp.amax(log_likelihood, axis=1)[:, None]  # in place, since memory bandwidth is the limit
        clipped = xp.clip(log_likelihood, MIN_EXPONENT, 0.0, out=log_likelihood)
        posterior = xp.exp(clipped, out=log_likelihood)
        moments = posterior @ xp.concat([self.grid, self.grid**2, self.grid[:, :1] * self.grid[:, 1:]], axis=1)
        moments = moments / posterior.sum(axis=1)[:, None]
        mean = moments[:, :2]
        var = xp.clip(moments[:, 2:4] - mean**2, MIN_STD**2, 4.0)
        corr = (moments[:, 4] - mean[:, 0] * mean[:, 1]) / xp.sqrt(var[:, 0] * var[:, 1])
        return mean, var, xp.clip(corr, -1, 1)

    def transformed(self, rotation: Array, shift: Array) -> "BayesianLocalizer":
        """Return a localizer whose positions are rotated (or mapped linearly), (2, 2), and shifted, (2,)."""
        return replace(self, rotation=_rounded(rotation @ self.rotation), shift=_rounded(rotation @ self.shift + shift))

    def map_arrays(self, function: Callable[[Any], Any]) -> "BayesianLocalizer":
        """Apply a function to every array in single precision, for example to convert it to torch."""
        return BayesianLocalizer(*(function(getattr(self, each.name).astype(np.float32)) for each in fields(self)))


def fit_stages(
    table: Any,
    inputs: Any,
    fibre_mask: Mask,
    positions: Any,
    n_timed: int,
    on_progress: OnProgress = ignore_progress,
    earlier: Sequence[BayesianLocalizer] = (),
) -> tuple[BayesianLocalizer, ...]:
    """Fit a localizer for each of `BAYES_STAGES`, or a single one if `n_timed` = K is 0.

    The first K features are the windows in the order of their completion, followed by the latest ones. Other arguments
    are as in `BayesianLocalizer.fit`, with an earlier localizer for each stage.
    """
    stages, numbers = [], BAYES_STAGES if n_timed else (0,)

    def fit(stage: int) -> BayesianLocalizer:
        unused = slice(numbers[stage], (n_timed + len(LATEST_WINDOWS)) if n_timed else 0)
        masked = table.copy()
        masked[:, :, :, unused] = 0
        earlier_stage = earlier[stage] if earlier else None
        return BayesianLocalizer.fit(masked, inputs, fibre_mask, positions, earlier_stage)

    for fitted in map_threads(fit, range(len(numbers))):
        on_progress(len(stages), len(numbers), "Bayesian localizer")
        stages.append(fitted)
    return tuple(stages)


def fit_projection(
    table: Array, residual: Array, fibre_mask: Mask, components: int, earlier: Array | None = None
) -> Array:
    """Return the whitened linear discriminants of each fibre (C, F, D), fitted unless the fibre has `earlier` ones.

    Those of an earlier pad are 0 for a fibre that had none. The response table (S, S, C, F) is 0 where a feature is not
    used; residuals of presses are (Q, C, F).
    """
    projection = np.zeros((*table.shape[2:], components)) if earlier is None else earlier.copy()
    for fibre in np.flatnonzero(~projection.any(axis=(1, 2))):
        used, valid = table[:, :, fibre].any(axis=(0, 1)), fibre_mask[:, fibre]
        expected = table[:, :, fibre, used].reshape(len(table) ** 2, -1)
        projection[fibre, used] = _fit_lda(expected, residual[valid, fibre][:, used], components)
    return projection


def _fit_lda(expected: Array, residual: Array, components: int) -> Array:
    """Return whitened linear discriminants (F, D), from responses at positions (P, F) and residuals (Q, F)."""
    size = residual.shape[1]
    scatter = residual.T @ residual / max(len(residual), 1) + 1e-4 * np.eye(size)  # features are about 1
    whitening = np.linalg.inv(np.linalg.cholesky(scatter)).T
    between = (expected - expected.mean(axis=0)) @ whitening
    _, directions = np.linalg.eigh(between.T @ between)
    projection = np.zeros((size, components))
    projection[:, : min(size, components)] = whitening @ directions[:, ::-1][:, :components]
    return projection


def _solve_2x2(fisher: Any, prior_precision: Any, gradient: Any, xp: Any) -> tuple[Any, Any]:
    """Solve (fisher + prior_precision) step = gradient for Q presses; return variances and steps, (Q, 2).

    The Fisher information (Q, 3) is in xx, yy and xy, the prior precision (Q, 2) diagonal.
    """
    xx, yy, xy = fisher[:, 0] + prior_precision[:, 0], fisher[:, 1] + prior_precision[:, 1], fisher[:, 2]
    det = xp.clip(fisher[:, 0] * fisher[:, 1] - xy**2, 0.0, np.inf)  # may be negative by rounding
    det = det + fisher[:, 0] * prior_precision[:, 1] + fisher[:, 1] * prior_precision[:, 0]
    det = det + prior_precision[:, 0] * prior_precision[:, 1]
    step = xp.stack([yy * gradient[:, 0] - xy * gradient[:, 1], xx * gradient[:, 1] - xy * gradient[:, 0]], axis=1)
    return xp.stack([yy, xx], axis=1) / det[:, None], step / det[:, None]


def _rounded(part: Array) -> Array:
    return part.astype(np.float32).astype(np.float64)


def local_scatter(centres: Array, positions: Array, residual: Array, fibre_mask: Mask, cell: float) -> Any:
    """Return covariances (P, C, D, D) of whitened residuals (Q, C, D) at centres (P, 2), Gaussian weighted by distance.

    The weights are as wide as some distances between presses, which are taken for a square grid, or as a cell.
    """
    distance = float(np.sqrt(np.ptp(positions, axis=0).prod() / len(np.unique(positions, axis=0))))
    width = max(cell, SCATTER_WIDTH * distance)
    fibres, size = residual.shape[1:]
    sums, weights = np.zeros((len(centres), fibres * size * size)), np.zeros((len(centres), fibres))
    step = max(1, _CHUNK // fibres)
    for first in range(0, len(residual), step):
        rows = slice(first, first + step)
        squared = ((centres[:, None] - positions[rows]) ** 2).sum(axis=2)
        weight = np.exp(-0.5 * squared / width**2)
        sums += weight @ (residual[rows, :, :, None] * residual[rows, :, None, :]).reshape(weight.shape[1], -1)
        weights += weight @ fibre_mask[rows]
    prior = SCATTER_PRIOR_COUNT * np.eye(size)  # residuals are whitened
    return (sums.reshape(-1, fibres, size, size) + prior) / (weights + SCATTER_PRIOR_COUNT)[:, :, None, None]


def _log_likelihood_coefficients(expected: Array, precision: Array) -> Array:
    """Return the coefficients (D (D + 3) / 2 + 1, P) of a normal log density of mean (P, D), precision (P, D, D)."""
    first, second = np.triu_indices(expected.shape[1])
    quadratic = -precision[:, first, second] * np.where(first == second, 0.5, 1.0)
    linear = np.einsum("pij,pj->pi", precision, expected)
    constant = 0.5 * (np.linalg.slogdet(precision)[1] - (linear * expected).sum(axis=1))
    coefficients = np.column_stack([quadratic, linear, constant]).T
    return coefficients - coefficients.mean(axis=1, keepdims=True)  # the mean cancels, and would cost digits
