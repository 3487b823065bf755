"""What a search minimises for the expected error: the error of a regression, and the bound that noise sets.

The expected error of a finished pad is that of `bayes_error`; this has a gradient, and ranks pads alike.

The response x of a fibre is its relative stretch in full scales of straight fibres. It scatters by a floor and by a
share of itself, of whose variance all fibres have a part in common:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1).

For presses a and the set K of fibres that still work, two terms are added, as small trained networks weigh them:

    L_K = mean_a |alpha_a| / c_aa,           alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|x_a - x_b|^2_K / 2 w^2),
    B_K = mean_a sqrt(trace F_a^-1),         F_a = J_a' S_a^-1 J_a + 12 / size^2,     J_a = dx / dp there,
    criterion = 0.85 B_K + 0.47 L_K.

L_K is the leave-one-out error of kernel ridge regression, in closed form, with w the width of the kernel, r the ridge,
c_aa C's diagonal and p the positions from their middle; B_K is the Cramer-Rao bound with a prior over the pad, S_a the
covariance of the responses there. `docs/method.md` names sources and reasons.

Presses are compared on a fine grid over a window of the pad. Presses of a coarse grid over the remaining pad whose
responses resemble some press of the window are added to the regression, so that distant positions may not look alike.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.compilation import kernel
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

SEARCH_SIDE, EVALUATION_SIDE, WINDOW = 12, 14, 5.0
"""Presses along a side of a window's grid, in a search and in an evaluation, and its longest side, grid units. With 10
in place of 12 a search errs more under a small contact; 14 take a seventh to a third more time for 1 to 2 %."""
COARSE_STEP, WINDOW_MARGIN = 0.7, 1.0
"""Step of the grid over the remaining pad, and its distance from the window, grid units."""
MAX_FAR, MAX_WINDOWS = 2048, 16
"""Presses of the coarse grid, and windows by which a pad is evaluated; a larger pad has a sample of them."""
MAX_PARTNERS, MAX_PARTNER_DISTANCE = 36, 1.0
"""Presses of the coarse grid that are added to the regression, and their distance in response, widths of the kernel:
along a strip, where some fibres answer all presses of a row alike, a network tells them apart by the others."""
MAX_SETS, MIN_SETS = 32, 8
"""Sets of failed fibres of a size by which a finished pad is evaluated; with more windows, fewer sets do for each, down
to the last."""
WIDTH, RIDGE = 0.8, 1e-2
"""Width of the kernel, full scales, and the ridge."""
BOUND_WEIGHT, REGRESSION_WEIGHT = 0.85, 0.47
"""Weights of both terms, by which errors agree best with those of trained networks, within 7 % over straight, gently
and strongly curved pads: a network's mean error is below the root of a variance, and it learns better than the ridge.
"""
POWER = 12
"""Of the mean over contacts and numbers of failed fibres of errors as shares of straight fibres'."""
DEFAULT_FULL_SCALE = 0.182
"""Full scale of straight fibres of the default pad under the default press, a relative stretch."""
FULL_SCALE_SIDE = 24
"""Presses along a side by which the full scale of straight fibres is computed."""


class PressWindow(NamedTuple):
    """Presses of a window of the pad."""

    positions: Array  # of a square grid, row by row; shape (Q, 2), grid units
    step: Array  # between its neighbours; shape (2,), grid units
    free: NDArray[np.bool_]  # which lie in no keep-out; shape (Q,)
    far: Array  # presses over the remaining pad, none where the window is all that is pressed; shape (P, 2)

    def with_partners(self, partners: Ints) -> Array:
        """Return (Q + P, 2) positions of the window and of far presses by their indices."""
        return np.concatenate([self.positions, self.far[partners]])


def criterion_errors(pad: Morphology, contact: Contact, search: SearchSettings, size: PadSettings) -> list[float]:
    """Compute the criterion, grid units, with 0, 1, ... fibres failed, always on the same presses.

    `search` says how many fibres may fail, and how responses scatter; `size` says what is pressed.
    """
    rng, fibres = np.random.default_rng(0), len(pad.knots)
    levels = range(min(len(failure_shares(search.max_failures)), fibres))
    windows = evaluation_windows(size.sensed)
    masks = [failure_masks(fibres, k, max(MAX_SETS // len(windows), MIN_SETS)) for k in levels]
    scale, weights = straight_full_scale(pad.layout, contact, size.sensed_mm), kernel_weights(pad.layout)
    scatter = scatter_of_full_scale(search.response_scatter, contact, scale)
    errors: list[list[float]] = []  # by window, means over the sets of each size
    for window in windows:
        presses = window_presses(size, window, EVALUATION_SIDE, rng)
        if not presses.free.any():
            continue
        near, far = (
            relative_stretch(pad, positions, contact).T / scale for positions in (presses.positions, presses.far)
        )
        touched = np.concatenate([near, far], axis=1).any(axis=1)  # on a large pad most fibres are far from the presses
        # and most sets of failed fibres are equal for the touched ones
        sets = [np.unique(mask[:, touched], axis=0, return_inverse=True) for mask in masks]
        weighted = [weights[touched, None] * responses[touched] for responses in (near, far)]
        errors.append([])
        for unique, rows in sets:
            partners = confusable(weighted[0], weighted[1], unique)
            responses = np.concatenate([near, far[:, partners]], axis=1)[touched]
            where = presses.with_partners(partners), presses.step, presses.free
            values, _ = expected_error(responses, *where, unique, scatter, weights[touched], differentiate=False)
            errors[-1].append(float(values[rows].mean()))
    return np.mean(errors, axis=0).tolist()


def straight_full_scale(layout: Layout, contact: Contact, sensed_mm: Sensed) -> float:
    """Compute the full scale of responses: the mean over straight fibres of their largest relative stretch."""
    rectangle = sensed_rectangle(layout, sensed_mm)
    presses = grid_positions(place_window(rectangle, 0.5), FULL_SCALE_SIDE)
    largest = relative_stretch(Morphology.straight(layout), presses, contact).max(axis=0)
    if (np.ptp(rectangle, axis=0) > WINDOW).any():  # fibres beside the presses are as those of their family among them
        for rows in layout.families:
            largest[rows] = largest[rows].max(initial=0.0)
    return float(largest[largest > 0].mean()) if largest.any() else 1.0


def scatter_of_full_scale(scatter: Scatter, contact: Contact, full_scale: float) -> Scatter:
    """Return a scatter whose floor is a share of a full scale.

    What a layer responds is a strain, and what it scatters by has nothing to do with how strong a press is: the floor
    of `scatter` is a share of DEFAULT_FULL_SCALE. What other contacts respond has no unit: it is a share of their own.
    """
    return (
        scatter._replace(floor=scatter.floor * DEFAULT_FULL_SCALE / full_scale) if contact.model == "layer" else scatter
    )


def kernel_weights(layout: Layout) -> Array:
    """Return weights (F,) of the fibres' responses in the kernel: by the full scale of each.

    The long fibres of a strip stretch little beside those across it, and a network scales its inputs.
    """
    along = np.repeat(layout.extent, layout.counts)
    return along * (1 / along).mean()


def evaluation_windows(rectangle: Rectangle) -> list[Rectangle]:
    """Return the windows by which a pad is evaluated: tiles of what is pressed, a sample if many."""
    low, high = np.array(rectangle)
    counts = np.ceil((high - low) / WINDOW - 1e-9).astype(int).clip(1)
    size = (high - low) / counts
    tiles = np.stack(np.unravel_index(np.arange(counts.prod()), counts), axis=1)
    if len(tiles) > MAX_WINDOWS:
        tiles = np.random.default_rng(0).permutation(tiles)[:MAX_WINDOWS]
    corners = low + size * tiles
    return [(tuple(corner.tolist()), tuple((corner + size).tolist())) for corner in corners]


def place_window(rectangle: Rectangle, share: float | Array) -> Rectangle:
    """Return a window at a share of the way from corner to corner of a rectangle, or all of it if it is small."""
    low, high = np.array(rectangle)
    size = np.minimum(high - low, WINDOW)
    corner = low + share * (high - low - size)
    return tuple(corner.tolist()), tuple((corner + size).tolist())


def window_presses(size: PadSettings, window: Rectangle, side: int, rng: np.random.Generator) -> PressWindow:
    """Return side x side presses on a randomly shifted grid over a window, and coarse ones over all that is beside."""

    def shifted_grid(low: Array, high: Array, counts: Array) -> Array:
        cells = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in counts)), axis=-1).reshape(-1, 2)
        return low + (high - low) * (cells + rng.random(2)) / counts

    low, high = np.array(window)
    positions, far = shifted_grid(low, high, np.array([side, side])), np.empty((0, 2))
    pad_low, pad_high = np.array(size.sensed)
    if ((high - low) < (pad_high - pad_low) - 2 * WINDOW_MARGIN).any():
        far = shifted_grid(pad_low, pad_high, np.ceil((pad_high - pad_low) / COARSE_STEP).astype(int))
        if len(far) > MAX_FAR:
            far = far[rng.choice(len(far), MAX_FAR, replace=False)]
        is_beside = ((far < low - WINDOW_MARGIN) | (far > high + WINDOW_MARGIN)).any(axis=1)
        far = far[is_beside & is_outside(far, size)]
    return PressWindow(positions, (high - low) / side, is_outside(positions, size), far)


def confusable(near: Array, far: Array, masks: Array) -> Ints:
    """Find the far presses whose responses are nearest to some press of a window, under any set of failed fibres.

    They are at most MAX_PARTNERS ascending indices; none at MAX_PARTNER_DISTANCE widths or more. Responses of
    the window (F, Q) and of the remaining pad (F, N) are weighted as in the kernel; `masks` are (L, F).
    """
    if not far.shape[1]:
        return np.empty(0, np.int64)
    limit = MAX_PARTNER_DISTANCE * WIDTH
    squares = least_squares(np.ascontiguousarray(near.T), np.ascontiguousarray(far.T), masks, limit**2)
    best = np.argsort(squares, kind="stable")[:MAX_PARTNERS]
    return np.sort(best[squares[best] < limit**2])


@kernel
def least_squares(near: Any, far: Any, masks: Any, limit: float) -> Any:
    """Compute the least squared distance (N,) of each response of far (N, F) to any of near (Q, F), under any set.

    `masks` (L, F) are the sets of working fibres. Distances of `limit` or more may be given as `limit`.
    """
    sets, most = len(masks), int(masks.shape[1] - masks.sum(axis=1).min())
    out, largest = np.full(len(far), limit), np.empty(most)
    touched = np.array([f for f in range(near.shape[1]) if near[:, f].any()])
    others = np.array([f for f in range(near.shape[1]) if not near[:, f].any()])
    terms, beside = np.empty(len(touched)), np.empty(sets)
    for i in range(len(far)):
        # fibres that no press of the window stretches, most of them on a large pad, add the far response alone
        for k in range(sets):
            beside[k] = 0.0
            for f in others:
                beside[k] += masks[k, f] * far[i, f] ** 2
        least_beside = beside.min()
        for q in range(len(near) if least_beside < limit else 0):
            # without the `most` largest terms it is no more than under any set
            total = least_beside
            largest[:] = 0.0
            for j in range(len(touched)):
                term = (far[i, touched[j]] - near[q, touched[j]]) ** 2
                terms[j] = term
                total += term
                for k in range(most):
                    if term > largest[k]:
                        term, largest[k] = largest[k], term
            if total - largest.sum() >= out[i]:
                continue
            for k in range(sets):
                square = beside[k]
                for j in range(len(touched)):
                    square += masks[k, touched[j]] * terms[j]
                out[i] = min(out[i], square)
    return out


def expected_error(
    responses: Array,
    positions: Array,
    step: Array,
    free: NDArray[np.bool_],
    masks: Array,
    scatter: Scatter,
    weights: Array,
    differentiate: bool = True,
) -> tuple[Array, Array]:
    """Compute the expected error (L,), grid units, for each set of failed fibres, and its gradient by the responses.

    Args:
        responses: in full scales of straight fibres, for the presses of a grid of Q = side^2, row by row, and P others
            in the regression; shape (F, Q + P).
        positions: shape (Q + P, 2), grid units.
        step: between neighbours of the grid; shape (2,), grid units.
        free: which presses of the grid count; the others lie in a keep-out; shape (Q,).
        masks: 1 for a fibre that works, 0 for a failed one; shape (L, F).
        scatter: of responses; its floor is above 0.
        weights: of responses in the kernel; shape (F,).
        differentiate: whether to compute the gradient.

    Returns:
        Errors (L,) and their gradients (L, F, Q + P), or (L, 0, Q + P) where none is asked for.
    """
    count, fibres = len(free), len(responses) if differentiate else 0
    gradient = np.zeros((len(masks), fibres, len(positions)))
    rows = np.concatenate([np.flatnonzero(free), np.arange(count, len(positions))])
    # 1. the regression
    share = weights[:, None] / WIDTH
    scaled = np.float32(share * responses[:, rows])
    where = np.float32(positions[rows] - positions[:count].mean(axis=0))
    by_scaled = np.empty((len(masks), fibres, len(rows)))
    regression = leave_one_out_errors(scaled, where, masks, int(free.sum()), RIDGE, by_scaled)
    gradient[:, :, rows] = REGRESSION_WEIGHT * share[:fibres] * by_scaled
    # 2. the bound, over cells whose corners all count: none where there are no more than slits between keep-outs
    side = math.isqrt(count)
    grid = free.reshape(side, side)
    row, column = np.nonzero(grid[:-1, :-1] & grid[:-1, 1:] & grid[1:, :-1] & grid[1:, 1:])
    if not len(row):
        return REGRESSION_WEIGHT * regression, gradient
    by_grid = np.empty((len(masks), fibres, count))
    cells, prior = row * side + column, 12 / (step * side) ** 2
    bound = error_bound(np.ascontiguousarray(responses[:, :count]), step, cells, masks, tuple(scatter), prior, by_grid)
    gradient[:, :, :count] += BOUND_WEIGHT * by_grid
    return BOUND_WEIGHT * bound + REGRESSION_WEIGHT * regression, gradient


def averages(masks: Array, levels: int) -> Array:
    """Return the weights (K, L) of sets of failed fibres in the means over those of each of K sizes, 0, 1, ... failed.

    Args:
        masks: the sets, 1 for a fibre that works; shape (L, F).
        levels: K.
    """
    of_size = (masks == 0).sum(axis=1) == np.arange(levels)[:, None]
    return of_size / np.maximum(of_size.sum(axis=1, keepdims=True), 1)


def relative_error(errors: Array, straight: Array, shares: tuple[float, ...]) -> tuple[float, Array]:
    """Return the power mean of errors as shares of those of straight fibres: the worst weighs most.

    Args:
        errors: by contact and number of failed fibres; shape (C, K).
        straight: of straight fibres; shape (C, K).
        shares: P(k) of k = 0, 1, ... failed.

    Returns:
        The mean, and its derivatives (C, K) by the errors.
    """
    weights = np.array(shares[: errors.shape[1]])
    weights /= weights.sum() * len(errors)
    ratios = errors / straight
    total = float((weights * ratios**POWER).sum())
    value = total ** (1 / POWER)
    return value, value / total * weights * ratios ** (POWER - 1) / straight
