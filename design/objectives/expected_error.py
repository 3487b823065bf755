"""Expected localisation error: the error of a regression of positions on responses, and the bound that noise sets.

The response x of a fibre is its relative stretch in full scales of straight fibres. It scatters by a floor and by a
share of itself, of whose variance all fibres have a part in common:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1).

For presses a and the set K of fibres that still work, two terms are added, as trained networks weigh them:

    L_K = mean_a |alpha_a| / c_aa,           alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|x_a - x_b|^2_K / 2 w^2),
    B_K = mean_a sqrt(trace F_a^-1),         F_a = J_a' S_a^-1 J_a + 12 / size^2,     J_a = dx / dp there,
    expected error = 0.85 B_K + 0.47 L_K.

L_K is the leave-one-out error of kernel ridge regression, in closed form, with w the width of the kernel, r the ridge,
c_aa C's diagonal and p the positions from their middle; B_K is the Cramer-Rao bound with a prior over the pad, S_a the
covariance of the responses there. `docs/method.md` names sources and reasons.

Presses are compared on a fine grid over a window of the pad. Presses of a coarse grid over the remaining pad whose
responses resemble some press of the window are added to the regression, so that distant positions may not look alike.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padforge.design.common.parallel import one_torch_thread
from padforge.design.contact import grid_positions, relative_stretch
from padforge.design.kernels.error_bound import error_bound
from padforge.design.morphology import Array, Morphology
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
GRIDS, MAX_SETS, MIN_SETS = 4, 32, 8
"""Grids, and sets of failed fibres of a size, by which a finished pad is evaluated; with more windows, fewer sets do
for each, down to the last."""
WIDTH, RIDGE = 0.8, 1e-2
"""Width of the kernel, full scales, and the ridge."""
BOUND_WEIGHT, REGRESSION_WEIGHT = 0.85, 0.47
"""Weights of both terms, by which errors agree best with those of trained networks, within 7 % over straight, gently
and strongly curved pads: a network's mean error is below the root of a variance, and it learns better than the ridge.
"""
EPSILON = 1e-12
"""Squared length, so that its root has a gradient at 0."""
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

    def with_partners(self, partners: Tensor) -> Tensor:
        """Return (Q + P, 2) positions of the window and of far presses by their indices."""
        return torch.tensor(np.concatenate([self.positions, self.far[partners.cpu().numpy()]]))


@one_torch_thread()
def expected_errors(pad: Morphology, contact: Contact, search: SearchSettings, size: PadSettings) -> list[float]:
    """Compute the expected errors, grid units, with 0, 1, ... fibres failed, always on the same presses.

    `search` says how many fibres may fail, and how responses scatter; `size` says what is pressed.
    """
    rng, fibres = np.random.default_rng(0), len(pad.knots)
    levels = range(min(len(failure_shares(search.max_failures)), fibres))
    windows = evaluation_windows(size.sensed)
    masks = [failure_masks(fibres, k, max(MAX_SETS * GRIDS // len(windows), MIN_SETS)) for k in levels]
    scale, weights = straight_full_scale(pad.layout, contact, size.sensed_mm), kernel_weights(pad.layout)
    scatter = scatter_of_full_scale(search.response_scatter, contact, scale)
    errors: list[list[float]] = []  # by window, means over the sets of each size
    for window in windows:
        presses = window_presses(size, window, EVALUATION_SIDE, rng)
        if not presses.free.any():
            continue
        near, far = (
            torch.tensor(relative_stretch(pad, positions, contact).T / scale)
            for positions in (presses.positions, presses.far)
        )
        touched = torch.cat([near, far], dim=1).any(dim=1)  # on a large pad most fibres are far from all the presses
        # and most sets of failed fibres are equal for the touched ones
        sets = [np.unique(mask[:, touched.numpy()], axis=0, return_inverse=True) for mask in masks]
        weighted = [weights[touched, None] * responses[touched] for responses in (near, far)]
        step, free = torch.tensor(presses.step), torch.tensor(presses.free)
        errors.append([])
        for unique, rows in sets:
            mask = torch.tensor(unique)
            partners = confusable(weighted[0], weighted[1], mask)
            responses, positions = torch.cat([near, far[:, partners]], dim=1)[touched], presses.with_partners(partners)
            values = expected_error(responses, positions, step, free, mask, scatter, weights[touched])
            errors[-1].append(float(values.numpy()[rows].mean()))
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


def kernel_weights(layout: Layout) -> Tensor:
    """Return weights (F,) of the fibres' responses in the kernel: by the full scale of each.

    The long fibres of a strip stretch little beside those across it, and a network scales its inputs.
    """
    along = torch.tensor(np.repeat(layout.extent, layout.counts), dtype=torch.float64)
    return along * (1 / along).mean()


def evaluation_windows(rectangle: Rectangle) -> list[Rectangle]:
    """Return the windows by which a pad is evaluated, GRIDS or more: tiles of what is pressed, a sample if many."""
    low, high = np.array(rectangle)
    counts = np.ceil((high - low) / WINDOW - 1e-9).astype(int).clip(1)
    size = (high - low) / counts
    tiles = np.stack(np.unravel_index(np.arange(counts.prod()), counts), axis=1)
    if len(tiles) > MAX_WINDOWS:
        tiles = np.random.default_rng(0).permutation(tiles)[:MAX_WINDOWS]
    corners = low + size * np.tile(tiles, (math.ceil(GRIDS / len(tiles)), 1))
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


def confusable(near: Tensor, far: Tensor, masks: Tensor) -> Tensor:
    """Find the far presses whose responses are nearest to some press of a window, under any set of failed fibres.

    They are at most MAX_PARTNERS ascending indices; none at MAX_PARTNER_DISTANCE widths or more. Responses of
    the window (F, Q) and of the remaining pad (F, N) are weighted as in the kernel; `masks` are (L, F).
    """
    if not far.shape[1]:
        return torch.empty(0, dtype=torch.int64)
    # fibres that no press of the window stretches, most of them on a large pad, add the far response alone
    touched = near.any(dim=1)
    window, beyond, elsewhere = (x.detach().float().T / WIDTH for x in (near[touched], far[touched], far[~touched]))
    distance = torch.full((far.shape[1],), torch.inf, device=far.device)
    for mask in masks.float().unique(dim=0):
        within = torch.cdist(beyond * mask[touched], window * mask[touched]).amin(dim=1)
        distance = torch.minimum(distance, torch.hypot(within, (elsewhere.square() @ mask[~touched]).sqrt()))
    best = distance.topk(min(MAX_PARTNERS, len(distance)), largest=False)
    return best.indices[best.values < MAX_PARTNER_DISTANCE].sort().values


def expected_error(
    responses: Tensor, positions: Tensor, step: Tensor, free: Tensor, masks: Tensor, scatter: Scatter, weights: Tensor
) -> Tensor:
    """Compute the expected error (L,), grid units, for each set of failed fibres; differentiable.

    Args:
        responses: in full scales of straight fibres, for the presses of a grid of Q = side^2, row by row, and P others
            in the regression; single precision is enough; shape (F, Q + P).
        positions: shape (Q + P, 2), grid units.
        step: between neighbours of the grid; shape (2,), grid units.
        free: which presses of the grid count; the others lie in a keep-out; shape (Q,).
        masks: 1 for a fibre that works, 0 for a failed one; shape (L, F).
        scatter: of responses; its floor is above 0.
        weights: of responses in the kernel; shape (F,).
    """
    positions, masks = (x.to(responses.dtype) for x in (positions, masks))
    count = len(free)
    bound = _Bound.apply(responses[:, :count], step, free, masks, scatter)
    rows = torch.cat([free.nonzero()[:, 0], torch.arange(count, len(positions))])
    middle = positions[:count].mean(dim=0)
    weighted = (responses * weights[:, None].to(responses))[:, rows] / WIDTH
    regression = _LeaveOneOut.apply(weighted, positions[rows] - middle, masks, int(free.sum()))
    return BOUND_WEIGHT * bound + REGRESSION_WEIGHT * regression


def aggregate_failures(errors: Tensor, masks: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Return the geometric mean of errors (L,) over numbers of failed fibres: relative gains count alike at each.

    `masks` (L, F) are the sets of failed fibres, `shares` P(k) of k = 0, 1, ... failed, as far as they occur there.
    """
    n_failed = (masks == 0).sum(dim=1)
    levels = [k for k in range(len(shares)) if (n_failed == k).any()]
    logs = torch.stack([errors[n_failed == k].mean().log() for k in levels])
    weights = torch.tensor([shares[k] for k in levels], dtype=logs.dtype, device=logs.device)
    return (logs @ weights / weights.sum()).exp()


class _Bound(torch.autograd.Function):
    """B with its gradient."""

    @staticmethod
    def forward(ctx: Any, responses: Tensor, step: Tensor, free: Tensor, masks: Tensor, scatter: Scatter) -> Tensor:
        """Return B (L,) for responses (F, Q) on a grid, over its free cells."""
        # squares of slopes over a faint noise overflow in single precision, and one direction would hide the other
        values, steps, working = (x.detach().cpu().double().numpy() for x in (responses, step, masks))
        side = math.isqrt(len(free))
        grid = free.cpu().numpy().reshape(side, side)
        row, column = np.nonzero(grid[:-1, :-1] & grid[:-1, 1:] & grid[1:, :-1] & grid[1:, 1:])
        gradient = np.zeros((len(working), len(values) if responses.requires_grad else 0, len(free)))
        bound = np.zeros(len(working))  # no more than slits between keep-outs
        if len(row):
            prior = 12 / (steps * side) ** 2
            where = np.ascontiguousarray(values), steps, row * side + column, working
            bound = error_bound(*where, (scatter.floor, scatter.share, scatter.common), prior, gradient)
        ctx.gradient = torch.from_numpy(gradient)
        return torch.from_numpy(bound).to(responses)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient by the responses."""
        by_responses = torch.einsum("l,lkq->kq", upstream[0].cpu().double(), ctx.gradient)
        return by_responses.to(upstream[0]), None, None, None, None


class _LeaveOneOut(torch.autograd.Function):
    """L with its gradient in closed form, since both come from the same inverse."""

    @staticmethod
    def forward(ctx: Any, responses: Tensor, positions: Tensor, masks: Tensor, count: int) -> Tensor:
        """Return L (L,) over the first `count` presses, for responses (F, Q) in widths of the kernel."""
        # differences, unlike products, do not cancel: single precision serves
        difference = responses[:, :, None] - responses[:, None, :]
        kernel = torch.exp(torch.mm(masks / -2, difference.square().flatten(1)).view(-1, *difference.shape[1:]))
        ridged = kernel.clone()
        ridged.diagonal(dim1=1, dim2=2).add_(RIDGE)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(ridged))
        alpha = inverse @ positions
        length = (alpha.square().sum(dim=-1) + EPSILON).sqrt()
        ctx.save_for_backward(difference, kernel, inverse, alpha, length, masks)
        ctx.count = count
        return (length / inverse.diagonal(dim1=1, dim2=2))[:, :count].mean(dim=1)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient by the responses."""
        difference, kernel, inverse, alpha, length, masks = ctx.saved_tensors
        diagonal = inverse.diagonal(dim1=1, dim2=2)
        share = upstream[0][:, None] / ctx.count * (torch.arange(diagonal.shape[1]) < ctx.count).to(diagonal)
        by_alpha, by_diagonal = alpha * (share / (length * diagonal))[..., None], -share * length / diagonal**2
        # dC = -C dk C gives the derivative of L by every entry of k, but for the sign
        by_kernel = torch.bmm(inverse * by_diagonal[:, None, :], inverse)
        by_kernel += torch.bmm(inverse @ by_alpha, alpha.mT)
        by_response = torch.mm(masks.T, (by_kernel * kernel).flatten(1)).view(difference.shape) * difference
        return by_response.sum(dim=2) - by_response.sum(dim=1), None, None, None
