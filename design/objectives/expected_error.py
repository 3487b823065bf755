"""Expected localisation error: how far off a regression is that learns positions from responses, and what noise adds.

The response x of a fibre is its relative stretch (signal over length, as a divider shows it), in full scales of
straight fibres. It scatters by a floor and by a share of itself, of whose variance all fibres have a part in common:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1).

For presses a and the set K of fibres that still work, two terms are added, as trained networks weigh them:

    L_K = mean_a |alpha_a| / c_aa,           alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|x_a - x_b|^2_K / 2 w^2),
    B_K = mean_a sqrt(trace F_a^-1),         F_a = J_a' S_a^-1 J_a + 12 / size^2,     J_a = dx / dp there,
    expected error = 0.85 B_K + 0.47 L_K.

L_K is how far off kernel ridge regression finds each press when it has learnt from all the others, which is known
without learning anew (C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, 2006, chapter 2 and
section 5.4.2; w is the width of the kernel, r the ridge, c_aa C's diagonal, p the positions from their middle). So it
counts confusions by how far off they lead, as the ambiguity does; and besides, what a localizer has to learn between
presses: responses that fold the pad too often are far apart for neighbours. B_K is the Cramer-Rao bound (van Trees
1968, section 2.4) with what is known beforehand, that the position is one of the pad: what no localizer falls below,
however many presses it has learnt from. S_a is the covariance of the responses there, a diagonal matrix and a product
of one vector. That it depends on the position, which tells a few per cent more, is left out.

Presses are compared on a fine lattice over a window of the pad; where the pad is larger, presses of a coarse lattice
over the rest of it that answer like some press of the window are learnt from as well, so that places far apart may not
look alike. The cost of a window grows with the pad's area, by which there are more presses to look at, up to MAX_FAR.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from padforge.design.common.parallel import one_torch_thread
from padforge.design.contact import grid_positions, relative_stretch
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.fibre_loss import failure_masks, loss_shares
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

SEARCHED, JUDGED, WINDOW = 12, 14, 5.0
"""Presses along a side of a window's lattice, in a search and where a pad is judged, and its longest side, grid units.
With 10 in place of 12 a search errs more under a small contact; 14 take a seventh to a third more time for 1 to 2 %."""
COARSE, BESIDE = 0.7, 1.0
"""Step of the lattice over the rest of the pad, and how far beside the window it begins, grid units."""
MAX_FAR, MAX_WINDOWS = 2048, 16
"""Most presses of it that are looked at, and most windows by which a pad is judged; a larger pad has a draw of them."""
MAX_PARTNERS, ALIKE = 36, 1.0
"""Most presses of it that are learnt from besides, and how near they answer, widths of the kernel: along a strip, where
some fibres answer all presses of a row alike, a network tells them apart by the others."""
LATTICES, MAX_SETS, MIN_SETS = 4, 32, 8
"""Lattices, and sets of failed fibres of a size, by which a finished pad is judged; where it takes more windows, fewer
sets do for each, down to the last."""
WIDTH, RIDGE = 0.8, 1e-2
"""Width of the kernel, full scales, and the ridge."""
BY_NOISE, BY_LEARNING = 0.85, 0.47
"""Weights of both terms. Such errors go best with those of trained networks, within 7 % over straight, gently and
strongly curved pads: a network's mean error is below the root of a variance, and it learns better than the ridge."""
EPSILON = 1e-12
"""Squared length, so that its root has a gradient at 0."""
FULL_SCALE_SIDE = 24
"""Presses along a side by which the full scale of straight fibres is known."""


class PressWindow(NamedTuple):
    """Presses of a window of the pad.

    Attributes:
        positions: (Q, 2), grid units, of a square lattice, row by row.
        step: (2,) between its neighbours, grid units.
        free: (Q,) which lie in no keep-out.
        far: (P, 2) presses over the rest of the pad, none where the window is all that is pressed.
    """

    positions: Array
    step: Array
    free: NDArray[np.bool_]
    far: Array

    def joined(self, partners: Tensor) -> Tensor:
        """Return (Q + P, 2) positions of the window and of some of the presses beyond it."""
        return torch.tensor(np.concatenate([self.positions, self.far[partners.cpu().numpy()]]))


@one_torch_thread()
def expected_errors(pad: Morphology, contact: Contact, search: SearchSettings, size: PadSettings) -> list[float]:
    """Return the expected error with 0, 1, ... fibres failed, by this module's formula, always on the same presses.

    Args:
        pad: the fibres.
        contact: what a press does to them.
        search: how many fibres may fail, and how responses scatter.
        size: says what is pressed.

    Returns:
        Means over sets of failed fibres, grid units.
    """
    rng, fibres = np.random.default_rng(0), len(pad.knots)
    levels = range(min(len(loss_shares(search.max_failures)), fibres))
    windows = judged_windows(size.sensed)
    masks = [failure_masks(fibres, k, max(MAX_SETS * LATTICES // len(windows), MIN_SETS)) for k in levels]
    scale, weights = straight_full_scale(pad.layout, contact, size.sensed_mm), kernel_weights(pad.layout)
    errors: list[list[float]] = []
    for window in windows:
        presses = window_presses(size, window, JUDGED, rng)
        if not presses.free.any():
            continue
        near, far = (
            torch.tensor(relative_stretch(pad, positions, contact).T / scale)
            for positions in (presses.positions, presses.far)
        )
        touched = torch.cat([near, far], dim=1).any(dim=1)  # on a large pad most fibres are far from all the presses
        # and most sets of failed fibres are alike to what is left
        sets = [np.unique(mask[:, touched.numpy()], axis=0, return_inverse=True) for mask in masks]
        weighed = [weights[touched, None] * responses[touched] for responses in (near, far)]
        step, free = torch.tensor(presses.step), torch.tensor(presses.free)
        errors.append([])
        for few, rows in sets:
            alive = torch.tensor(few)
            partners = confusable(weighed[0], weighed[1], alive)
            responses, positions = torch.cat([near, far[:, partners]], dim=1)[touched], presses.joined(partners)
            given = responses, positions, step, free, alive, search.response_scatter
            found = expected_error(*given, weights[touched])
            errors[-1].append(float(found.numpy()[rows].mean()))
    return np.mean(errors, axis=0).tolist()


def error_terms(errors: Sequence[float], unit_mm: float) -> dict[str, float]:
    """Return `expected_errors`, in grid units of `unit_mm`, by name in mm."""
    return {f"expected_error_mm_{n_failed}": unit_mm * error for n_failed, error in enumerate(errors)}


def straight_full_scale(layout: Layout, contact: Contact, sensed_mm: Sensed) -> float:
    """Return the mean over straight fibres of their largest relative stretch, to which responses are scaled."""
    low, high = np.array(sensed_rectangle(layout, sensed_mm))
    size = np.minimum(high - low, WINDOW)
    corner = low + (high - low - size) / 2
    presses = grid_positions((tuple(corner.tolist()), tuple((corner + size).tolist())), FULL_SCALE_SIDE)
    largest = relative_stretch(Morphology.straight(layout), presses, contact).max(axis=0)
    if (size < high - low).any():  # fibres beside the presses are as those of their family among them
        for rows in layout.families:
            largest[rows] = largest[rows].max(initial=0.0)
    return float(largest[largest > 0].mean()) if largest.any() else 1.0


def kernel_weights(layout: Layout) -> Tensor:
    """Return by what the responses (F,) of fibres are weighed where they are compared: each by its own full scale.

    The fibres of a strip's long family show little beside those across it, and a network scales its inputs.
    """
    along = torch.tensor(np.repeat(layout.extent, layout.counts), dtype=torch.float64)
    return along * (1 / along).mean()


def judged_windows(rectangle: Rectangle) -> list[Rectangle]:
    """Return the windows that judge a pad, LATTICES or more: they tile what is pressed; of a huge pad a draw."""
    low, high = np.array(rectangle)
    counts = np.ceil((high - low) / WINDOW - 1e-9).astype(int).clip(1)
    size = (high - low) / counts
    tiles = np.stack(np.unravel_index(np.arange(counts.prod()), counts), axis=1)
    if len(tiles) > MAX_WINDOWS:
        tiles = np.random.default_rng(0).permutation(tiles)[:MAX_WINDOWS]
    corners = low + size * np.tile(tiles, (math.ceil(LATTICES / len(tiles)), 1))
    return [(tuple(corner.tolist()), tuple((corner + size).tolist())) for corner in corners]


def drawn_window(rectangle: Rectangle, rng: np.random.Generator) -> Rectangle:
    """Draw a window anywhere in what is pressed: all of it unless it is large."""
    low, high = np.array(rectangle)
    size = np.minimum(high - low, WINDOW)
    corner = low + rng.random(2) * (high - low - size)
    return tuple(corner.tolist()), tuple((corner + size).tolist())


def window_presses(size: PadSettings, window: Rectangle, side: int, rng: np.random.Generator) -> PressWindow:
    """Return presses on a lattice over a window that is shifted by up to a cell, and those over the rest of the pad."""
    low, high = np.array(window)
    cells = np.stack(np.meshgrid(*2 * [np.arange(side, dtype=float)]), axis=-1).reshape(-1, 2)
    positions = low + (high - low) * (cells + rng.random(2)) / side
    least, most = np.array(size.sensed)
    counts = np.ceil((most - least) / COARSE).astype(int)
    far = np.empty((0, 2))
    if ((high - low) < (most - least) - 2 * BESIDE).any():
        grid = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in counts)), axis=-1).reshape(-1, 2)
        far = least + (most - least) * (grid + rng.random(2)) / counts
        if len(far) > MAX_FAR:
            far = far[rng.choice(len(far), MAX_FAR, replace=False)]
        far = far[((far < low - BESIDE) | (far > high + BESIDE)).any(axis=1) & is_outside(far, size)]
    return PressWindow(positions, (high - low) / side, is_outside(positions, size), far)


def confusable(near: Tensor, far: Tensor, masks: Tensor) -> Tensor:
    """Return which presses (P,) of `far` answer most like some press of a window, under any of some losses.

    Args:
        near: (F, Q) responses of the window, weighed as they are compared.
        far: (F, N) those over the rest of the pad.
        masks: (L, F), 1 for a fibre that works.

    Returns:
        At most MAX_PARTNERS indices, ascending; none that is ALIKE widths of the kernel or more away.
    """
    if not far.shape[1]:
        return torch.empty(0, dtype=torch.int64)
    # where no press of the window is felt, the far one's responses alone are apart: on a large pad by most fibres
    felt = near.any(dim=1)
    window, beyond, elsewhere = (x.detach().float().T / WIDTH for x in (near[felt], far[felt], far[~felt]))
    least = torch.full((far.shape[1],), torch.inf, device=far.device)
    for mask in masks.float().unique(dim=0):
        within = torch.cdist(beyond * mask[felt], window * mask[felt]).amin(dim=1)
        least = torch.minimum(least, torch.hypot(within, (elsewhere.square() @ mask[~felt]).sqrt()))
    best = least.topk(min(MAX_PARTNERS, len(least)), largest=False)
    return best.indices[best.values < ALIKE].sort().values


def expected_error(
    responses: Tensor,
    positions: Tensor,
    step: Tensor,
    free: Tensor,
    masks: Tensor,
    scatter: Scatter,
    weights: Tensor | None = None,
) -> Tensor:
    """Return the expected error of the module's formula for each of some losses, with gradient by the responses.

    Args:
        responses: (F, Q + P) in full scales of straight fibres, for the presses of a lattice of Q = side^2, row by row,
            and P others that are learnt from; single precision is enough.
        positions: (Q + P, 2), grid units.
        step: (2,) between neighbours of the lattice, grid units.
        free: (Q,) which presses of the lattice count; others lie in a keep-out.
        masks: (L, F), 1 for a fibre that works, 0 for a failed one.
        scatter: of responses; its floor is above 0.
        weights: (F,) of responses in the kernel; all 1 if None.

    Returns:
        (L,) grid units.
    """
    where, apart, masks = (given.to(responses.dtype) for given in (positions, step, masks))
    count = len(free)
    bound = _bound(responses[:, :count], apart, free, masks, scatter)
    learnt = torch.cat([free.nonzero()[:, 0], torch.arange(count, len(where))])
    middle = where[:count].mean(dim=0)
    compared = responses if weights is None else responses * weights[:, None].to(responses)
    left_out = _LeaveOneOut.apply(compared[:, learnt] / WIDTH, where[learnt] - middle, masks, int(free.sum()))
    return BY_NOISE * bound + BY_LEARNING * left_out


def aggregate_failures(errors: Tensor, masks: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Return the geometric mean of errors over numbers of failed fibres: a gain of a tenth counts alike at each.

    Args:
        errors: (L,).
        masks: (L, F) the losses they are of.
        shares: P(k) of k = 0, 1, ... failed; what is not in `masks` is left out.
    """
    lost = (masks == 0).sum(dim=1)
    levels = [k for k in range(len(shares)) if (lost == k).any()]
    logs = torch.stack([errors[lost == k].mean().log() for k in levels])
    weights = torch.tensor([shares[k] for k in levels], dtype=logs.dtype, device=logs.device)
    return (logs @ weights / weights.sum()).exp()


def _corners(values: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Values (Q, ...) of a lattice at the four corners of each of its cells, row by row from below."""
    side = math.isqrt(len(values))
    grid = values.reshape(side, side, *values.shape[1:])
    return grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]


def _rates(values: Tensor, step: Tensor) -> Tensor:
    """(P, F, 2) by how much values (F, Q) on a lattice change by x and y, by differences over each of its cells."""
    a, b, c, d = (corner.flatten(0, 1) for corner in _corners(values.T))
    return torch.stack([(b + d - a - c) / (2 * step[0]), (c + d - a - b) / (2 * step[1])], dim=-1)


def _bound(responses: Tensor, step: Tensor, free: Tensor, masks: Tensor, scatter: Scatter) -> Tensor:
    """(L,) B for responses (F, Q) on a lattice, over its cells that are free."""
    cells = torch.stack([corner.flatten() for corner in _corners(free)]).all(dim=0)
    if not cells.any():  # no more than slits between keep-outs
        return masks.new_zeros(len(masks))
    middle = torch.stack([corner.flatten(0, 1) for corner in _corners(responses.T)]).mean(dim=0)[cells]
    deviation = (scatter.floor**2 + scatter.share**2 * (1 - scatter.common) * middle**2).sqrt()
    rates = _rates(responses, step)[cells] / deviation[..., None]
    gain = math.sqrt(scatter.common) * scatter.share * middle / deviation
    information = torch.einsum("lk,qki,qkj->lqij", masks, rates, rates)
    shared = torch.einsum("lk,qk,qki->lqi", masks, gain, rates)
    total = 1 + torch.einsum("lk,qk->lq", masks, gain**2)
    # Sherman and Morrison: (1 + u u')^-1 = 1 - u u' / (1 + u'u)
    xx, yy, xy = (information[..., i, j] - shared[..., i] * shared[..., j] / total for i, j in ((0, 0), (1, 1), (0, 1)))
    prior_x, prior_y = 12 / (step * math.isqrt(len(free))) ** 2
    # at a faint noise the first difference cancels where one direction alone is told, and the prior must not with it
    volume = (xx * yy - xy**2).clamp(min=0) + prior_x * yy + prior_y * xx + prior_x * prior_y
    return ((xx + yy + prior_x + prior_y) / volume).sqrt().mean(dim=1)


class _LeaveOneOut(torch.autograd.Function):
    """L with its gradient in closed form, since both come from the same inverse."""

    @staticmethod
    def forward(ctx: Any, responses: Tensor, positions: Tensor, masks: Tensor, count: int) -> Tensor:
        """(L,) L over the first `count` presses, for responses (F, Q) in widths of the kernel."""
        (fibres, presses), losses = responses.shape, len(masks)
        # differences, unlike products, do not cancel: single precision serves
        apart = responses[:, :, None] - responses[:, None, :]
        kernel = torch.exp(torch.mm(masks / -2, apart.square().view(fibres, presses**2)).view(losses, presses, presses))
        ridged = kernel.clone()
        ridged.diagonal(dim1=1, dim2=2).add_(RIDGE)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(ridged))
        alpha = inverse @ positions
        length = (alpha.square().sum(dim=-1) + EPSILON).sqrt()
        ctx.save_for_backward(apart, kernel, inverse, alpha, length, masks)
        ctx.count = count
        return (length / inverse.diagonal(dim1=1, dim2=2))[:, :count].mean(dim=1)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by the responses."""
        apart, kernel, inverse, alpha, length, masks = ctx.saved_tensors
        diagonal = inverse.diagonal(dim1=1, dim2=2)
        share = upstream[0][:, None] / ctx.count * (torch.arange(diagonal.shape[1]) < ctx.count).to(diagonal)
        by_alpha, by_diagonal = alpha * (share / (length * diagonal))[..., None], -share * length / diagonal**2
        # dC = -C dk C, whence how E changes with every entry of k, but for the sign
        by_kernel = torch.bmm(inverse * by_diagonal[:, None, :], inverse)
        by_kernel += torch.bmm(inverse @ by_alpha, alpha.mT)
        pull = torch.mm(masks.T, (by_kernel * kernel).flatten(1)).view(apart.shape) * apart
        return pull.sum(dim=2) - pull.sum(dim=1), None, None, None
