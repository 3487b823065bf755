"""Expected localisation error: how far off a regression is that learns places from noisy signals.

For signals s of the fibres K that still work, with noise of standard deviation sigma on each, two terms are added:

    G_K = mean_b |p_b - f_K(s_b + noise)|,                  f_K learnt from the noisy signals of other presses a,
    C_K = mean_a sqrt(trace F_a^-1),   F_a = J_a' J_a / sigma^2 + 12 / size^2,   J_a = ds / dp there.

f_K is kernel ridge regression with a Gaussian kernel one full scale wide (C. E. Rasmussen, C. K. I. Williams, Gaussian
Processes for Machine Learning, 2006, chapter 2), so G_K is what a localizer of few presses comes to, confusions of far
places included. C_K is the Cramer-Rao bound (van Trees 1968, section 2.4) with what is known beforehand, that the place
is one of the pad: what no localizer falls below, however many presses it has learnt from. Where noise is small the
ambiguity counts only confusions, of which there are none left; these two still fall with it.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from design.criteria.ambiguity import full_scale
from design.criteria.fibre_loss import loss_masks, loss_shares
from design.pad.contact import signals as exact_signals
from design.pad.knots import Array
from design.pad.morphology import Morphology
from design.settings import Contact, PadSettings, Rectangle

SIDE, WINDOW = 14, 5.0
"""Presses along a side of a lattice, and the longest side, grid units: presses further apart are seldom confused."""
PAIRS, MOST_LOSSES = 8, 32
"""Pairs of lattices, and sets of lost fibres of a size, by which a finished pad is judged."""
HARDER = 3.0
"""About how many times as great the error is with one more fibre lost: by its inverse each counts as much."""
WIDTH, RIDGE = 1.0, 1e-3
"""Width of the regression's kernel, full scales of a signal, and its ridge."""
LEAST = 1e-8
"""Squared distance, so that its root has a gradient at 0."""


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
    errors = np.zeros((PAIRS, len(masks)))
    for pair in errors:
        places, step = two_lattices(size.sensed, rng)
        found = torch.tensor(exact_signals(pad, places, contact).T)
        white = torch.tensor(rng.standard_normal(found.shape))
        given = found / full_scale(found), torch.tensor(places), torch.tensor(step)
        for k, kept in enumerate(masks):
            equal = torch.full((len(kept),), 1 / len(kept), dtype=torch.float64)
            pair[k] = expected_error(*given, kept, equal, white, noise).item()
    return errors.mean(axis=0).tolist()


def error_terms(errors: Sequence[float]) -> dict[str, float]:
    """`expected_errors` by name."""
    return {f"expected_error_lost_{lost}": value for lost, value in enumerate(errors)}


def balanced(shares: tuple[float, ...]) -> tuple[float, ...]:
    """Shares (sum 1) of 0, 1, ... lost fibres in which a gain of some percent counts alike, from the P(k) `shares`."""
    weights = [share * HARDER**-k for k, share in enumerate(shares)]
    return tuple(weight / sum(weights) for weight in weights)


def cells(rectangle: Rectangle, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """SIDE x SIDE cells over a part of what is pressed, all of it unless it is large.

    Returns:
        Low corner and size (2,) of the part, grid units, and column and row (SIDE^2, 2) of each cell.
    """
    low, high = np.array(rectangle)
    size = np.minimum(high - low, WINDOW)
    corner = low + rng.random(2) * (high - low - size)
    side = np.arange(SIDE, dtype=float)
    return corner, size, np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def two_lattices(rectangle: Rectangle, rng: np.random.Generator) -> tuple[Array, Array]:
    """Presses (2 SIDE^2, 2) on two lattices, each shifted by up to a cell, and their step (2,), grid units.

    They lie over a part of what is pressed, all of it unless it is large.
    """
    corner, size, cell = cells(rectangle, rng)
    return corner + size * np.concatenate([cell + rng.random(2) for _ in range(2)]) / SIDE, size / SIDE


def expected_error(
    signals: Tensor, places: Tensor, step: Tensor, kept: Tensor, weight: Tensor, noise: Tensor, sigma: float
) -> Tensor:
    """Mean of G + C of the module's formula over losses, a scalar in grid units with gradient by the signals.

    Args:
        signals: (F, 2Q) in full scales, for the presses of two lattices of Q = side^2 one after the other.
        places: (2Q, 2), grid units. step: (2,) between neighbours of a lattice, grid units.
        kept: (L, F), 1 for a fibre that works, 0 for a lost one. weight: (L,) share of each loss, sum 1.
        noise: (F, 2Q) standard normal. sigma: of the noise, in full scales, > 0.
    """
    found, where = signals.T.double(), places.double()
    count = len(found) // 2
    rates = torch.cat([_rates(part, step.double()) for part in found.split(count)]) / sigma
    size = step.double() * math.isqrt(count)
    noisy = kept.double()[:, None, :] * (found + sigma * noise.T.double())
    errors = _regression(noisy, where - where.mean(dim=0), count) + _bound(rates, kept.double(), size)
    return errors.to(signals.dtype) @ weight


def _rates(signals: Tensor, step: Tensor) -> Tensor:
    """(P, F, 2) by how much signals (Q, F) on a lattice change by x and y, by differences over each of its cells."""
    side = math.isqrt(len(signals))
    a, b, c, d = (
        signals.view(side, side, -1)[rows, columns]
        for rows in (slice(None, -1), slice(1, None))
        for columns in (slice(None, -1), slice(1, None))
    )
    by_x, by_y = (b + d - a - c) / (2 * step[0]), (c + d - a - b) / (2 * step[1])
    return torch.stack([by_x, by_y], dim=-1).reshape(-1, signals.shape[1], 2)


def _bound(rates: Tensor, kept: Tensor, size: Tensor) -> Tensor:
    """(L,) C for rates (P, F, 2) in units of the noise."""
    known = torch.einsum("lk,qki,qkj->lqij", kept, rates, rates) + torch.diag(12 / size**2)
    trace = known[..., 0, 0] + known[..., 1, 1]
    return (trace / (known[..., 0, 0] * known[..., 1, 1] - known[..., 0, 1] ** 2)).sqrt().mean(dim=1)


def _regression(noisy: Tensor, places: Tensor, count: int) -> Tensor:
    """(L,) G for noisy signals (L, 2Q, F): the first `count` presses are learnt, the others asked for."""
    learnt, asked = noisy[:, :count], noisy[:, count:]
    known = torch.exp(_squares(learnt, learnt) / (-2 * WIDTH**2)) + RIDGE * torch.eye(count, dtype=noisy.dtype)
    weights = torch.cholesky_solve(places[:count].expand(len(noisy), -1, -1), torch.linalg.cholesky(known))
    found = torch.exp(_squares(asked, learnt) / (-2 * WIDTH**2)) @ weights
    return ((found - places[count:]).square().sum(dim=-1) + LEAST).sqrt().mean(dim=1)


def _squares(a: Tensor, b: Tensor) -> Tensor:
    """(L, A, B) squared distances of rows (L, A, n) to rows (L, B, n)."""
    return a.square().sum(dim=-1)[:, :, None] + b.square().sum(dim=-1)[:, None, :] - 2 * a @ b.mT
