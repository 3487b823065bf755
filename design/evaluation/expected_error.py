"""Expected localisation error: how far off a regression is that learns places from signals, and what noise adds to it.

For presses a with signals s_a, in full scales, noise of standard deviation sigma on each and the set K of fibres that
still work, two terms are added:

    E_K = mean_a |alpha_a| / c_aa,           alpha = C p,    C = (k + r 1)^-1,    k_ab = exp(-|s_a - s_b|^2_K / 2 w^2),
    B_K = mean_a sqrt(trace F_a^-1),         F_a = J_a' J_a / sigma^2 + 12 / size^2,    J_a = ds / dp there.

E_K is how far off kernel ridge regression finds each press when it has learnt from all the others, which is known
without learning anew (C. E. Rasmussen, C. K. I. Williams, Gaussian Processes for Machine Learning, 2006, chapter 2 and
section 5.4.2; w is the width of the kernel, r the ridge, c_aa C's diagonal, p the places from their middle). So it
counts confusions by how far off they lead, as the ambiguity does, but without a noise level; and besides, what a
localizer has to learn between presses: signals that fold the pad too often are far apart for neighbours. It goes with
the error of a trained network. B_K is the Cramer-Rao bound (van Trees 1968, section 2.4) with what is known beforehand,
that the place is one of the pad: what no localizer falls below, however many presses it has learnt from. It grows with
the noise, and where noise is small, E_K is all there is.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from design.criteria.ambiguity import full_scale
from design.criteria.fibre_loss import loss_masks, loss_shares
from design.pad.contact import signals as exact_signals
from design.pad.knots import Array
from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings, Rectangle

SEARCHED, JUDGED, WINDOW = 12, 14, 5.0
"""Presses along a side of a lattice, in a search and where a pad is judged, and the longest side, grid units: presses
further apart are seldom confused. With 10 in place of 12 a search errs more under a small contact; 14 take a
seventh to a third more time for 1 to 2 % with few knots."""
LATTICES, MOST_LOSSES = 4, 32
"""Lattices, and sets of lost fibres of a size, by which a finished pad is judged."""
WIDTH, RIDGE = 0.5, 1e-2
"""Width of the kernel, full scales of a signal, and the ridge: such errors go best with those of trained networks."""
LEAST = 1e-12
"""Squared length, so that its root has a gradient at 0."""


def expected_errors(
    pad: Morphology, contact: Contact, lost: int | tuple[float, ...], noise: float, size: PadSettings
) -> list[float]:
    """Expected error (formula of this module) with 0, 1, ... fibres lost, grid units, always by the same presses.

    Args:
        lost: how many fibres may fail at most, or weights of 0, 1, ... lost. noise: of a signal, share of full scale.
        size: says what is pressed.
    """
    rng, fibres = np.random.default_rng(0), len(pad.knots)
    levels = range(min(len(loss_shares(lost)), fibres))
    masks = [torch.tensor(loss_masks(fibres, k, MOST_LOSSES)) for k in levels]
    errors = np.zeros((LATTICES, len(masks)))
    for lattice in errors:
        places, step = shifted_lattice(size.sensed, JUDGED, rng)
        found = torch.tensor(exact_signals(pad, places, contact).T)
        touched = found.any(dim=1)  # on a large pad most fibres are touched by none of the presses
        given = found[touched] / full_scale(found), torch.tensor(places), torch.tensor(step)
        for k, kept in enumerate(masks):
            lattice[k] = expected_error(*given, kept[:, touched], noise).mean().item()
    return errors.mean(axis=0).tolist()


def error_terms(errors: Sequence[float]) -> dict[str, float]:
    """`expected_errors` by name."""
    return {f"expected_error_lost_{lost}": value for lost, value in enumerate(errors)}


def shifted_lattice(rectangle: Rectangle, side: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Presses (side^2, 2) on a lattice that is shifted by up to a cell, and its step (2,), grid units.

    It lies over a part of what is pressed, all of it unless it is large.
    """
    low, high = np.array(rectangle)
    size = np.minimum(high - low, WINDOW)
    corner = low + rng.random(2) * (high - low - size)
    cells = np.stack(np.meshgrid(*2 * [np.arange(side, dtype=float)]), axis=-1).reshape(-1, 2)
    return corner + size * (cells + rng.random(2)) / side, size / side


def expected_error(signals: Tensor, places: Tensor, step: Tensor, kept: Tensor, sigma: float) -> Tensor:
    """(L,) E + B of the module's formula for each of some losses, grid units, with gradient by the signals.

    Args:
        signals: (F, Q) in full scales, for the presses of a lattice of Q = side^2; single precision is enough.
        places: (Q, 2), grid units. step: (2,) between neighbours of the lattice, grid units.
        kept: (L, F), 1 for a fibre that works, 0 for a lost one.
        sigma: of the noise, in full scales, > 0.
    """
    there, apart, masks = (given.to(signals.dtype) for given in (places, step, kept))
    bound = _bound(_rates(signals.T, apart) / sigma, masks, apart * math.isqrt(len(there)))
    learnt = _LeaveOneOut.apply(signals / WIDTH, there - there.mean(dim=0), masks)
    return learnt + bound


def over_losses(errors: Tensor, kept: Tensor, shares: tuple[float, ...]) -> Tensor:
    """Geometric mean of errors over numbers of lost fibres: a gain of a tenth counts alike, however many are lost.

    Args:
        errors: (L,). kept: (L, F) the losses they are of.
        shares: P(k) of k = 0, 1, ... lost; what is not in `kept` is left out.
    """
    lost = (kept == 0).sum(dim=1)
    levels = [k for k in range(len(shares)) if (lost == k).any()]
    logs = torch.stack([errors[lost == k].mean().log() for k in levels])
    weights = torch.tensor([shares[k] for k in levels], dtype=logs.dtype, device=logs.device)
    return (logs @ weights / weights.sum()).exp()


def _rates(signals: Tensor, step: Tensor) -> Tensor:
    """(P, F, 2) by how much signals (Q, F) on a lattice change by x and y, by differences over each of its cells."""
    fibres, side = signals.shape[1], math.isqrt(len(signals))
    a, b, c, d = (
        signals.reshape(side, side, fibres)[rows, columns]
        for rows in (slice(None, -1), slice(1, None))
        for columns in (slice(None, -1), slice(1, None))
    )
    by_x, by_y = (b + d - a - c) / (2 * step[0]), (c + d - a - b) / (2 * step[1])
    return torch.stack([by_x, by_y], dim=-1).reshape((side - 1) ** 2, fibres, 2)


def _bound(rates: Tensor, kept: Tensor, size: Tensor) -> Tensor:
    """(L,) B for rates (P, F, 2) in units of the noise."""
    told = torch.einsum("lk,qki,qkj->lqij", kept, rates, rates)
    xx, yy, (prior_x, prior_y) = told[..., 0, 0], told[..., 1, 1], 12 / size**2
    # at a faint noise the first difference cancels where one direction alone is told, and the prior must not with it
    volume = (xx * yy - told[..., 0, 1] ** 2).clamp(min=0) + prior_x * yy + prior_y * xx + prior_x * prior_y
    return ((xx + yy + prior_x + prior_y) / volume).sqrt().mean(dim=1)


class _LeaveOneOut(torch.autograd.Function):
    """E with its gradient in closed form, since both come from the same inverse."""

    @staticmethod
    def forward(ctx: Any, signals: Tensor, presses: Tensor, kept: Tensor) -> Tensor:
        """(L,) E for signals (F, Q) in widths of the kernel."""
        (fibres, count), losses = signals.shape, len(kept)
        # differences, unlike products, do not cancel: single precision serves
        apart = signals[:, :, None] - signals[:, None, :]
        kernel = torch.exp(torch.mm(kept / -2, apart.square().view(fibres, count**2)).view(losses, count, count))
        ridged = kernel.clone()
        ridged.diagonal(dim1=1, dim2=2).add_(RIDGE)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(ridged))
        alpha = inverse @ presses
        length = (alpha.square().sum(dim=-1) + LEAST).sqrt()
        ctx.save_for_backward(apart, kernel, inverse, alpha, length, kept)
        return (length / inverse.diagonal(dim1=1, dim2=2)).mean(dim=1)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient by the signals."""
        apart, kernel, inverse, alpha, length, kept = ctx.saved_tensors
        diagonal = inverse.diagonal(dim1=1, dim2=2)
        share = upstream[0][:, None] / diagonal.shape[1]
        by_alpha, by_diagonal = alpha * (share / (length * diagonal))[..., None], -share * length / diagonal**2
        # dC = -C dk C, whence how E changes with every entry of k, but for the sign
        by_kernel = torch.bmm(inverse * by_diagonal[:, None, :], inverse)
        by_kernel += torch.bmm(inverse @ by_alpha, alpha.mT)
        pull = torch.mm(kept.T, (by_kernel * kernel).flatten(1)).view(apart.shape) * apart
        return pull.sum(dim=2) - pull.sum(dim=1), None, None
