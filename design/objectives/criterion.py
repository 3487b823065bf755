"""Criterion of a search for the expected error: a regression error plus the Cramer-Rao bound, both differentiable.

`bayes_error` computes the expected error of a finished pad; this criterion has a gradient and ranks pads the same way.

The response x of a fibre is its relative stretch in full scales of straight fibres. Its noise has a floor, and a part
proportional to the response, a fraction `common` of whose variance is shared by all fibres:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1).

For presses a, cells c of a grid between them and the set K of fibres that still work, the criterion is a weighted sum
of two terms:

    L_K = mean_a |alpha_a| / G_aa,           alpha = G p,    G = (k + r I)^-1,    k_ab = exp(-|x_a - x_b|^2_K / 2 w^2),
    B_K = mean_c sqrt(trace F_c^-1),         F_c = J_c' S_c^-1 J_c + 12 / side^2,     J_c = dx / dp in c,
    criterion = 0.85 B_K + 0.47 L_K.

L_K is the leave-one-out error of kernel ridge regression in closed form, with the kernel width w, the ridge r, the
diagonal G_aa of G and the positions p relative to their centre. B_K is the Cramer-Rao bound with a prior over the
window, of that side, and the covariance S_c of the responses. The weights are fitted to errors of small trained
networks. `docs/method.md` names sources and reasons.

Presses are compared on a fine grid over a window of the pad. To penalise distant positions of similar responses, the
presses of a coarse grid over the remaining pad whose responses resemble some press of the window join the regression.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.design.contact import grid_positions, relative_stretch
from padforge.design.kernels.error_bound import error_bound
from padforge.design.kernels.leave_one_out import leave_one_out_errors
from padforge.design.morphology import Array, Ints, Morphology
from padforge.design.objectives.fibre_loss import failure_masks, failure_shares
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import (
    Contact,
    Layout,
    PadSettings,
    Rectangle,
    Scatter,
    SearchSettings,
    Sensed,
    sensed_rectangle,
)

SEARCH_SIDE = 12
"""Presses along a side of a window's grid in a search. With 10 a search errs more under a small contact; 14 take a
seventh to a third more time for an improvement of 1 to 2 %.
"""
EVALUATION_SIDE = 14  # presses along a side of a window's grid in an evaluation
WINDOW = 5.0  # maximum side of a window, grid units
COARSE_STEP = 0.7  # step of the coarse grid over the remaining pad, grid units
WINDOW_MARGIN = 1.0  # minimum distance of the coarse grid to the window, grid units
MAX_FAR = 2048  # maximum number of presses of the coarse grid
MAX_WINDOWS = 16  # maximum number of windows by which a pad is evaluated; of more, a sample is taken
MAX_PARTNERS = 36  # maximum number of presses of the coarse grid that join the regression
MAX_PARTNER_DISTANCE = 1.0
"""Maximum response distance of such presses to a press of the window, kernel widths. Fibres along a strip respond
equally to many presses; a network distinguishes these by the other fibres.
"""
MAX_SETS = 32  # maximum number of sets of failed fibres of each size in an evaluation, divided among the windows
MIN_SETS = 8  # number of such sets for a window even if there are many windows
WIDTH = 0.8  # width of the kernel, full scales
RIDGE = 1e-2  # ridge of the regression
BOUND_WEIGHT = 0.85
"""Weight of the Cramer-Rao bound. With both weights the criterion agrees with errors of trained networks within 7 %
over straight, gently and strongly curved pads. This one is below 1 since a mean error is below the root of a variance.
"""
REGRESSION_WEIGHT = 0.47  # weight of the regression error, below 1 since a network learns better than ridge regression
POWER = 12  # exponent of the power mean of relative errors over contacts and numbers of failed fibres
DEFAULT_FULL_SCALE = 0.182
"""Full scale of straight fibres of the default pad under the default press, a relative stretch."""


class PressWindow(NamedTuple):
    """Presses on a square grid over a window of the pad, and on a coarse grid over the remaining pad; grid units."""

    positions: Array  # in the window, row by row; shape (Q, 2)
    step: Array  # distance of neighbours; shape (2,)
    free: NDArray[np.bool_]  # mask of the positions outside keep-outs; shape (Q,)
    far: Array  # on the remaining pad, none if the window covers all of it; shape (P, 2)

    def with_partners(self, partners: Ints) -> Array:
        """Return the positions of the window, and of the far presses of these indices; shape (Q + len(partners), 2)."""
        return np.concatenate([self.positions, self.far[partners]])


def criterion_errors(
    pad: Morphology, contact: Contact, search: SearchSettings, pad_settings: PadSettings
) -> list[float]:
    """Compute the criterion with 0, 1, ... fibres failed, grid units, always on the same presses."""
    rng, fibres = np.random.default_rng(0), len(pad.knots)
    levels = range(min(len(failure_shares(search.max_failures)), fibres))
    windows = evaluation_windows(pad_settings.sensed)
    masks_by_size = [failure_masks(fibres, k, max(MAX_SETS // len(windows), MIN_SETS)) for k in levels]
    scale, weights = straight_full_scale(pad.layout, contact, pad_settings.sensed_mm), kernel_weights(pad.layout)
    scatter = scatter_of_full_scale(search.response_scatter, contact, scale)
    errors: list[list[float]] = []  # by window, means over the sets of each size
    for window in windows:
        presses = window_presses(pad_settings, window, EVALUATION_SIDE, rng)
        if not presses.free.any():
            continue
        near, far = (
            relative_stretch(pad, positions, contact).T / scale for positions in (presses.positions, presses.far)
        )
        # On a large pad the presses touch few fibres, and most sets of failed fibres do not differ in these: errors are
        # computed once for each distinct set.
        touched = np.concatenate([near, far], axis=1).any(axis=1)
        near, far, touched_weights = near[touched], far[touched], weights[touched]
        errors.append([])
        for masks in masks_by_size:
            unique, inverse = np.unique(masks[:, touched], axis=0, return_inverse=True)
            partners = confusable(touched_weights[:, None] * near, touched_weights[:, None] * far, unique)
            values, _ = criterion(
                np.concatenate([near, far[:, partners]], axis=1),
                presses.with_partners(partners),
                presses.step,
                presses.free,
                unique,
                scatter,
                touched_weights,
                differentiate=False,
            )
            errors[-1].append(float(values[inverse].mean()))
    return np.mean(errors, axis=0).tolist()


def straight_full_scale(layout: Layout, contact: Contact, sensed_mm: Sensed) -> float:
    """Compute the full scale of responses: the mean over straight fibres of their largest relative stretch."""
    rectangle = sensed_rectangle(layout, sensed_mm)
    presses = grid_positions(place_window(rectangle, 0.5), side=24)
    largest = relative_stretch(Morphology.straight(layout), presses, contact).max(axis=0)
    if (np.ptp(rectangle, axis=0) > WINDOW).any():  # fibres outside the window respond as those of their family in it
        for rows in layout.families:
            largest[rows] = largest[rows].max(initial=0.0)
    return float(largest[largest > 0].mean()) if largest.any() else 1.0


def scatter_of_full_scale(scatter: Scatter, contact: Contact, full_scale: float) -> Scatter:
    """Return the scatter with its floor relative to a full scale.

    The responses of a layer are strains, whose noise floor does not depend on the strength of the press: it is given
    relative to DEFAULT_FULL_SCALE. The responses of other contacts have no unit, so their floor already is relative.
    """
    if contact.model != "layer":
        return scatter
    return scatter._replace(floor=scatter.floor * DEFAULT_FULL_SCALE / full_scale)


def kernel_weights(layout: Layout) -> Array:
    """Return the weights (F,) of the fibres' responses in the kernel, proportional to the length of straight fibres.

    The long fibres of a strip have small relative stretches, which a network compensates by scaling its inputs.
    """
    along = np.repeat(layout.extent, layout.counts)
    return along * (1 / along).mean()


def evaluation_windows(rectangle: Rectangle) -> list[Rectangle]:
    """Return the windows by which a pad is evaluated: tiles of the pressed rectangle, or a sample of them if many."""
    low, high = np.array(rectangle)
    counts = np.ceil((high - low) / WINDOW - 1e-9).astype(int).clip(1)
    size = (high - low) / counts
    tiles = np.stack(np.unravel_index(np.arange(counts.prod()), counts), axis=1)
    if len(tiles) > MAX_WINDOWS:
        tiles = np.random.default_rng(0).permutation(tiles)[:MAX_WINDOWS]
    corners = low + size * tiles
    return [(tuple(corner.tolist()), tuple((corner + size).tolist())) for corner in corners]


def place_window(rectangle: Rectangle, share: float | Array) -> Rectangle:
    """Return a window in a rectangle, from one corner (share 0) to the other (1), or all of it if it is small."""
    low, high = np.array(rectangle)
    size = np.minimum(high - low, WINDOW)
    corner = low + share * (high - low - size)
    return tuple(corner.tolist()), tuple((corner + size).tolist())


def window_presses(pad_settings: PadSettings, window: Rectangle, side: int, rng: np.random.Generator) -> PressWindow:
    """Return side^2 presses on a randomly shifted grid over a window, and a coarse grid over the rest of the pad."""

    def shifted_grid(low: Array, high: Array, counts: Array) -> Array:
        cells = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in counts)), axis=-1).reshape(-1, 2)
        return low + (high - low) * (cells + rng.random(2)) / counts

    low, high = np.array(window)
    positions, far = shifted_grid(low, high, np.array([side, side])), np.empty((0, 2))
    pad_low, pad_high = np.array(pad_settings.sensed)
    if ((high - low) < (pad_high - pad_low) - 2 * WINDOW_MARGIN).any():
        far = shifted_grid(pad_low, pad_high, np.ceil((pad_high - pad_low) / COARSE_STEP).astype(int))
        if len(far) > MAX_FAR:
            far = far[rng.choice(len(far), MAX_FAR, replace=False)]
        is_outside_window = ((far < low - WINDOW_MARGIN) | (far > high + WINDOW_MARGIN)).any(axis=1)
        far = far[is_outside_window & is_outside(far, pad_settings)]
    return PressWindow(positions, (high - low) / side, is_outside(positions, pad_settings), far)


def confusable(near: Array, far: Array, masks: Array) -> Ints:
    """Find the far presses that may be confused with a press of the window under any of the `masks` (L, F).

    These are at most MAX_PARTNERS, with the most similar responses, and nearer than MAX_PARTNER_DISTANCE kernel widths;
    their indices ascend. Responses to the presses of the window (F, Q) and of the remaining pad (F, N) are weighted as
    in the kernel.
    """
    if not far.shape[1]:
        return np.empty(0, np.int64)
    max_square = (MAX_PARTNER_DISTANCE * WIDTH) ** 2
    touched = near.any(axis=1)  # other fibres, most of them on a large pad, are the same for all presses of the window
    others = far[~touched].T ** 2 @ masks[:, ~touched].T
    near, far, working = near[touched].T, far[touched].T, masks[:, touched].T
    squares = np.full(len(far), max_square)
    for i in np.flatnonzero(others.min(axis=1) < max_square):
        squares[i] = ((far[i] - near) ** 2 @ working + others[i]).min()
    best = np.argsort(squares, kind="stable")[:MAX_PARTNERS]
    return np.sort(best[squares[best] < max_square])


def criterion(
    responses: Array,
    positions: Array,
    step: Array,
    free: NDArray[np.bool_],
    masks: Array,
    scatter: Scatter,
    weights: Array,
    differentiate: bool = True,
) -> tuple[Array, Array]:
    """Compute the criterion, which approximates the expected error, for each set of failed fibres, and its gradient.

    Args:
        responses: responses to the Q = side^2 presses of a grid, row by row, and to P other presses of the regression;
            shape (F, Q + P), full scales of straight fibres.
        positions: positions of these presses; shape (Q + P, 2), grid units.
        step: distance of neighbours on the grid; shape (2,), grid units.
        free: mask of the presses of the grid that count, outside keep-outs; shape (Q,).
        masks: 1 for a working fibre, 0 for a failed one; shape (L, F).
        scatter: scatter of the responses; its floor is above 0.
        weights: weights of the responses in the kernel; shape (F,).
        differentiate: whether to compute the gradient.

    Returns:
        Errors (L,), grid units, and their gradients (L, F, Q + P), or (L, 0, Q + P) without `differentiate`.
    """
    n_grid, fibres = len(free), len(responses) if differentiate else 0
    gradient = np.zeros((len(masks), fibres, len(positions)))
    # 1. the regression
    rows = np.concatenate([np.flatnonzero(free), np.arange(n_grid, len(positions))])
    factor = weights[:, None] / WIDTH
    scaled = np.float32(factor * responses[:, rows])
    centred = np.float32(positions[rows] - positions[:n_grid].mean(axis=0))
    grad_scaled = np.empty((len(masks), fibres, len(rows)))
    regression = leave_one_out_errors(scaled, centred, masks, int(free.sum()), RIDGE, grad_scaled)
    gradient[:, :, rows] = REGRESSION_WEIGHT * factor[:fibres] * grad_scaled
    # 2. the bound, over cells of four free corners; between keep-outs there may be none
    side = math.isqrt(n_grid)
    grid = free.reshape(side, side)
    row, column = np.nonzero(grid[:-1, :-1] & grid[:-1, 1:] & grid[1:, :-1] & grid[1:, 1:])
    if not len(row):
        return REGRESSION_WEIGHT * regression, gradient
    grad_grid = np.empty((len(masks), fibres, n_grid))
    cells, prior = row * side + column, 12 / (step * side) ** 2
    bound = error_bound(
        np.ascontiguousarray(responses[:, :n_grid]), step, cells, masks, tuple(scatter), prior, grad_grid
    )
    gradient[:, :, :n_grid] += BOUND_WEIGHT * grad_grid
    return BOUND_WEIGHT * bound + REGRESSION_WEIGHT * regression, gradient


def relative_error(errors: Array, straight: Array, shares: tuple[float, ...]) -> tuple[float, Array]:
    """Return the power mean of the errors relative to those of straight fibres, and its gradient (C, K) by the errors.

    Errors (C, K) are by contact and by number of failed fibres; `shares` are the probabilities of these numbers. The
    largest relative errors dominate the mean.
    """
    weights = np.array(shares[: errors.shape[1]])
    weights /= weights.sum() * len(errors)
    ratios = errors / straight
    total = float((weights * ratios**POWER).sum())
    value = total ** (1 / POWER)
    return value, value / total * weights * ratios ** (POWER - 1) / straight
