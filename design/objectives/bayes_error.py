"""Expected localization error of a pad: that of the posterior mean, given one reading of a held press.

The response x of a fibre is its relative stretch in full scales of straight fibres. Its noise has a floor, and a part
proportional to the response, a fraction `common` of whose variance is shared by all fibres:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1).

At a position p of the responses x_p, the reading x' is normal with the mean x_p and the covariance

    S_p = diag(floor^2 + share^2 (1 - common) x_p^2) + share^2 common x_p x_p'.

The estimate is the mean of the posterior over all positions, with the likelihood N(x'; x_p, S_p) and a uniform prior.
No other localizer has a smaller mean squared error; a network trained on many presses errs LEARNING times as much. A
search minimises a differentiable approximation (`criterion`); the error computed here includes every confusion.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from padforge.design.contact import relative_stretch
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.criterion import evaluation_windows, scatter_of_full_scale, straight_full_scale
from padforge.design.objectives.fibre_loss import failure_masks, failure_shares
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import Contact, PadSettings, Rectangle, Scatter, SearchSettings

LEARNING = 1.05
"""Error of networks of three layers trained on 20 000 presses, relative to that of the posterior mean: 0.97 to 1.14."""
STEP = 0.1
"""Step of the fine grid of positions, over a window and its surroundings, grid units. It is about the standard
deviation of a posterior, which is fine enough for a sum over Gaussians.
"""
MARGIN = 1.0  # width of these surroundings, grid units
FAR_STEP = 0.7  # minimum step of the coarse grid over the remaining pad, grid units
MAX_FAR = 2048  # maximum number of positions of the coarse grid
PRESSES = 8192
"""Presses that are localized for each number of failed fibres, over all windows and sets of failed fibres."""
MIN_PRESSES = 64  # minimum number of presses for each set of failed fibres
MAX_SETS = 64  # maximum number of sets of failed fibres of each size, divided among the windows
MIN_SETS = 8  # number of such sets for a window even if there are many windows
MIN_NOISE = 5e-3  # minimum floor of the scatter, full scales: below, the grid would not resolve the posterior
BLOCK = 128  # readings whose posteriors are computed together, so that these stay in the cache of a core
MIN_EXPONENT = np.float32(-60)
"""Exponents are clipped to it: smaller ones are negligible, and several times slower to exponentiate."""
Mask = NDArray[np.bool_]


class Positions(NamedTuple):
    """Positions that a press may have, each of which stands for a cell around it."""

    centres: Array  # the positions; shape (P, 2), grid units
    log_prior: Array  # logarithms of the areas of the cells; shape (P,)
    responses: Array  # responses of the fibres; shape (P, F), full scales
    blur: Array  # variances of the responses within the cells; shape (P, F)


@threadpool_limits.wrap(limits=1, user_api="blas")  # threads of BLAS wait for each other if cores are busy
def expected_errors(
    pad: Morphology, contact: Contact, search: SearchSettings, pad_settings: PadSettings
) -> list[float]:
    """Compute the expected errors with 0, 1, ... fibres failed, grid units, always with the same random numbers."""
    fibres, windows = len(pad.knots), evaluation_windows(pad_settings.sensed)
    levels = range(min(len(failure_shares(search.max_failures)), fibres))
    masks = [failure_masks(fibres, k, max(MAX_SETS // len(windows), MIN_SETS)) > 0 for k in levels]
    scale = straight_full_scale(pad.layout, contact, pad_settings.sensed_mm)
    scatter = scatter_of_full_scale(search.response_scatter, contact, scale)
    scatter = scatter._replace(floor=max(scatter.floor, MIN_NOISE))
    rng, errors = np.random.default_rng(0), []
    for window in windows:
        presses = _random_presses(window, PRESSES // len(windows), pad_settings, rng)
        if not len(presses):
            continue
        readings = scatter.sample(relative_stretch(pad, presses, contact) / scale, rng)
        positions = possible_positions(pad, contact, pad_settings, window, scale)
        errors.append([])
        for sets in masks:
            count, means = max(len(presses) // len(sets), MIN_PRESSES), []
            for index, working in enumerate(sets):  # presses are used again only if there are too few for all sets
                rows = np.arange(index * count, (index + 1) * count) % len(presses)
                estimates = bayes_positions(readings[rows], positions, scatter, working)
                means.append(np.hypot(*(estimates - presses[rows]).T).mean())
            errors[-1].append(np.mean(means))
    return (LEARNING * np.mean(errors, axis=0)).tolist()


def possible_positions(
    pad: Morphology, contact: Contact, pad_settings: PadSettings, window: Rectangle, scale: float
) -> Positions:
    """Return the positions that a press in a window may have: a fine grid, and a coarse one over the remaining pad."""
    low, high = np.array(pad_settings.sensed)
    near_low, near_high = np.clip(np.add(window, [[-MARGIN], [MARGIN]]), low, high)
    grids = [_position_grid(pad, contact, near_low, near_high, STEP)]
    if (near_low > low).any() or (near_high < high).any():
        far = _position_grid(pad, contact, low, high, max(FAR_STEP, math.sqrt((high - low).prod() / MAX_FAR)))
        is_far = ((far.centres < near_low) | (far.centres > near_high)).any(axis=1)
        grids.append(Positions(*(values[is_far] for values in far)))
    positions = Positions(*map(np.concatenate, zip(*grids, strict=True)))
    free = is_outside(positions.centres, pad_settings)
    centres, log_prior, responses, blur = (values[free] for values in positions)
    return Positions(centres, log_prior, responses / scale, blur / scale**2)


def _position_grid(pad: Morphology, contact: Contact, low: Array, high: Array, step: float) -> Positions:
    """Return the centres of cells of a rectangle, `step` or a little less apart, with relative stretches."""
    counts = np.maximum(np.ceil((high - low) / step).astype(int), 2)
    cell = (high - low) / counts
    centres = low + cell * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1) + 0.5)
    responses = relative_stretch(pad, centres.reshape(-1, 2), contact).reshape(*counts, -1)
    differences = np.stack(np.gradient(responses, axis=(0, 1)))  # from cell to cell
    blur = (differences**2).sum(axis=0) / 12  # the variance of a uniform distribution over a cell
    n = counts.prod()
    return Positions(
        centres.reshape(n, 2), np.full(n, math.log(cell.prod())), responses.reshape(n, -1), blur.reshape(n, -1)
    )


def _random_presses(window: Rectangle, presses: int, pad_settings: PadSettings, rng: np.random.Generator) -> Array:
    """Return about `presses` positions outside keep-outs, in random order, one in each cell of a grid over a window."""
    low, high = np.array(window)
    side = math.ceil(math.sqrt(presses))
    cells = rng.permutation(np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2))
    positions = low + (high - low) * (cells + rng.random(cells.shape)) / side
    return positions[is_outside(positions, pad_settings)]


def bayes_positions(readings: Array, positions: Positions, scatter: Scatter, working: Mask) -> Array:
    """Return the posterior means (Q, 2) of presses, given the readings of the working fibres.

    The shared part of the covariance has rank one, so that the Sherman-Morrison formula gives its inverse. With the
    precisions d = 1 / (floor^2 + share^2 (1 - common) x^2 + blur) of single fibres, u = share sqrt(common) x and
    e = 1 + sum(d u^2), twice the log-posterior of a position is, up to a constant,

        sum(log d - d (z - x)^2) + (sum(d u (z - x)))^2 / e - log e + 2 log_prior.

    Args:
        readings: noisy responses z; shape (Q, F), full scales.
        positions: positions that a press may have, with responses x.
        scatter: scatter of the responses.
        working: mask of the working fibres; shape (F,).
    """
    z, x, blur = readings[:, working], positions.responses[:, working], positions.blur[:, working]
    precision = 1 / (scatter.floor**2 + scatter.share**2 * (1 - scatter.common) * x**2 + blur)
    shared = scatter.share * math.sqrt(scatter.common) * x
    excess = 1 + (shared**2 * precision).sum(axis=1)
    direction = shared * precision / np.sqrt(excess)[:, None]
    constant = (np.log(precision) - precision * x**2).sum(axis=1) - np.log(excess) + 2 * positions.log_prior
    # Single precision, operations in place on blocks that fit the cache, and a clipped exponent are for speed.
    quadratic = np.float32(np.vstack([-precision.T, 2 * precision.T * x.T, constant]) / 2)
    linear = np.float32(np.vstack([direction.T, -(direction * x).sum(axis=1)]) / math.sqrt(2))
    centres = np.float32(np.column_stack([positions.centres, np.ones(len(x))]))
    estimates = np.empty((len(z), 2))
    for first in range(0, len(z), BLOCK):
        rows = slice(first, first + BLOCK)
        block = np.float32(np.column_stack([z[rows], np.ones(len(z[rows]))]))
        log_posterior = np.hstack([block[:, :-1] ** 2, block]) @ quadratic
        shared_term = block @ linear
        log_posterior += np.square(shared_term, out=shared_term)
        log_posterior -= log_posterior.max(axis=1, keepdims=True)
        posterior = np.exp(np.maximum(log_posterior, MIN_EXPONENT, out=log_posterior), out=log_posterior)
        sums = posterior @ centres
        estimates[rows] = sums[:, :2] / sums[:, 2:]
    return estimates
