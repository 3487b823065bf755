"""Response model of a pad: response of each fibre to a press at a position, and the effect of its history.

The windows of a fibre are a sum of Gaussian radial basis functions of the position (proportional to the depth, if
depths vary) plus a linear function of its history, fitted jointly by ridge regression. Silicone creeps, so the effect
of the history is subtracted before the windows are used. The history also modulates the sensitivity: the response of a
fibre that was stretched a moment ago is larger by a fifth. This modulation, a linear function of the history for each
phase, is an input of the networks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.sense.arrays import MIN_SCALE_V, Array, Mask

RBF_SIDE = 21  # basis functions along a side of the pad
RBF_STD = 2.0  # their standard deviation, in distances between neighbours: wide enough that sums of them are smooth
RIDGE_POSITION = 1.0  # penalty on squared weights of basis functions
RIDGE_HISTORY = 3000.0
"""Penalty on squared weights of standardized history. These features are collinear: with a small penalty weights cancel
each other, and errors of presses grow by up to a tenth."""
RIDGE_MODULATION = 300.0  # penalty on squared weights of modulations by standardized history
GRID_CELLS = 60  # cells along a side of the grid on which the response is tabulated
_CHUNK = 16_384


@dataclass(frozen=True)
class ResponseModel:
    """Fitted response of a pad."""

    table: Array  # (S, S, C, F + G), V, windows on a grid over [-1, 1] in x and y; 0 for the G modulations
    # (C, J, F + G), effect of a volt of each history feature: V, on F windows; and 1/V, with the opposite sign, on the
    # relative sensitivity in G phases
    history_coef: Array
    history_mean_v: Array  # (C, J), mean history, at which the table holds

    @classmethod
    def fit(
        cls,
        positions: Array,
        windows: Array,
        history: Array,
        fibre_mask: Mask,
        relative_depth: Array | None = None,
        phases: Sequence[slice] = (),
        ridge_history: float = RIDGE_HISTORY,
    ) -> "ResponseModel":
        """Fit the response, fibre by fibre, to the presses in which the fibre is valid.

        Positions (Q, 2) are within [-1, 1], windows (Q, C, F) and history (Q, C, J) in V. Depths (Q,) are relative to
        that of the table; None if all are equal. Each of the G slices of windows in `phases` has one modulation of the
        sensitivity. `ridge_history` is the penalty on squared weights of the history.
        """
        fibres, n_history = history.shape[1:]
        size, n_rbf = windows.shape[2], RBF_SIDE**2
        grid_rbf = rbf_features(grid_positions(GRID_CELLS + 1).reshape(-1, 2))
        history_mean = np.zeros((fibres, n_history))
        history_coef = np.zeros((fibres, n_history, size + len(phases)))
        table = np.zeros((len(grid_rbf), fibres, size + len(phases)))
        penalty = np.diag(np.repeat([RIDGE_POSITION, ridge_history], [n_rbf, n_history]))
        for fibre in np.flatnonzero(fibre_mask.any(axis=0)):
            valid = fibre_mask[:, fibre]
            past, response = history[valid, fibre], windows[valid, fibre]
            history_mean[fibre] = past.mean(axis=0)
            std = past.std(axis=0)
            past = np.divide(past - history_mean[fibre], std, out=np.zeros_like(past), where=std > MIN_SCALE_V)
            depth = None if relative_depth is None else relative_depth[valid]
            gram, moments = _normal_equations(positions[valid], past, response, depth)
            weights = np.linalg.solve(gram + penalty, moments)
            coef = weights[n_rbf:]
            if phases:
                expected = np.concatenate([rbf @ weights[:n_rbf] for _, rbf in _scaled_rbf(positions[valid], None)])
                expected = expected if depth is None else depth[:, None] * expected
                residual = response - expected - past @ weights[n_rbf:]
                for phase in phases:
                    means = expected[:, phase].mean(axis=1), residual[:, phase].mean(axis=1)
                    coef = np.column_stack([coef, -_sensitivity_modulation(*means, past)])
            std = std[:, None]
            history_coef[fibre] = np.divide(coef, std, out=np.zeros(coef.shape), where=std > MIN_SCALE_V)
            table[:, fibre, :size] = grid_rbf @ weights[:n_rbf]
        return cls(table.reshape(GRID_CELLS + 1, GRID_CELLS + 1, fibres, -1), history_coef, history_mean)


def grid_positions(side: int) -> Array:
    """Return the (side, side, 2) positions of a grid over [-1, 1] in x and y."""
    axis = np.linspace(-1, 1, side)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)


def rbf_features(positions: Array) -> Array:
    """Return the (Q, RBF_SIDE^2) values of Gaussian radial basis functions at (Q, 2) positions."""
    centres = np.linspace(-1, 1, RBF_SIDE)
    std = RBF_STD * (2 / (RBF_SIDE - 1))
    x, y = np.exp(-0.5 * ((positions[:, :, None] - centres) / std) ** 2).transpose(1, 0, 2)
    return (x[:, :, None] * y[:, None, :]).reshape(len(positions), -1)


def remove_history(windows: Array, history: Array, history_coef: Array, history_mean_v: Array) -> Array:
    """Return (Q, C, F + G) windows without the effect of their history, and the modulations of the sensitivity."""
    n_phases = history_coef.shape[2] - windows.shape[2]
    effect = np.einsum("qcj,cjf->qcf", history - history_mean_v, history_coef)
    return np.pad(windows, ((0, 0), (0, 0), (0, n_phases))) - effect


def interpolate_grid(table: Any, positions: Any, xp: Any = np) -> Any:
    """Interpolate a (S, S, ...) table over [-1, 1] bilinearly at (Q, 2) positions, clipped to its edge.

    Returned are the values (Q, ...); `xp` is the module of the arrays, numpy or torch.
    """
    side = table.shape[0]
    cell = xp.clip((positions + 1) * ((side - 1) / 2), 0, side - 1 - 1e-3)
    lower = xp.floor(cell)
    x, y = (cell - lower).T[:, :, None]
    corner = xp.asarray(lower[:, 0] * side + lower[:, 1], dtype=xp.int64)
    flat = table.reshape(side * side, -1)
    near = (1 - y) * flat[corner] + y * flat[corner + 1]
    values = (1 - x) * near + x * ((1 - y) * flat[corner + side] + y * flat[corner + side + 1])
    return values if table.ndim == 3 else values.reshape(-1, *table.shape[2:])


def leverages(positions: Array, relative_depth: Array | None = None) -> Array:
    """Return the (Q,) leverages of presses in the fit, 0 to 1, summed over the presses at one position."""
    empty = np.empty((len(positions), 0))
    gram = _normal_equations(positions, empty, empty, relative_depth)[0] + RIDGE_POSITION * np.eye(RBF_SIDE**2)
    single = np.empty(len(positions))
    for rows, rbf in _scaled_rbf(positions, relative_depth):
        single[rows] = (rbf * np.linalg.solve(gram, rbf.T).T).sum(axis=1)
    return sum_by_position(positions, single)


def sum_by_position(positions: Array, values: Array) -> Array:
    """Return for each press the sum of the values (Q,) of the presses at its position."""
    _, position = np.unique(positions, axis=0, return_inverse=True)
    return np.bincount(position.ravel(), values).astype(np.float64)[position.ravel()]


def _scaled_rbf(positions: Array, relative_depth: Array | None) -> Any:
    """Yield slices of presses, and their basis functions times the depth. A press takes kilobytes, hence the chunks."""
    for first in range(0, len(positions), _CHUNK):
        rows = slice(first, first + _CHUNK)
        rbf = rbf_features(positions[rows])
        yield rows, rbf if relative_depth is None else relative_depth[rows, None] * rbf


def _normal_equations(
    positions: Array, past: Array, response: Array, relative_depth: Array | None
) -> tuple[Array, Array]:
    """Return X' X and X' response for the design matrix X of basis functions and history."""
    gram = moments = np.zeros(())
    for rows, rbf in _scaled_rbf(positions, relative_depth):
        design_matrix = np.hstack([rbf, past[rows]])
        gram, moments = gram + design_matrix.T @ design_matrix, moments + design_matrix.T @ response[rows]
    return gram, moments


def _sensitivity_modulation(expected: Array, residual: Array, past: Array) -> Array:
    """Fit the relative change (J,) of (Q,) responses per standard deviation of history to (Q,) residuals."""
    scale = expected.std()
    if not past.shape[1] or scale <= MIN_SCALE_V:
        return np.zeros(past.shape[1])
    design_matrix = np.hstack([expected[:, None] / scale * past, past])  # factor, and additive effect
    gram = design_matrix.T @ design_matrix + RIDGE_MODULATION * np.eye(design_matrix.shape[1])
    return np.linalg.solve(gram, design_matrix.T @ residual)[: past.shape[1]] / scale
