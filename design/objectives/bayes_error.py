"""Expected localization error: that of Bayes' rule on one reading of a held press, and a little for learning it.

The response x of a fibre is its relative stretch in full scales of straight fibres. It scatters by a floor and by a
share of itself, of whose variance all fibres have a part in common:

    x' = x (1 + share (sqrt(common) g + sqrt(1 - common) g_f)) + floor e_f,       g, g_f, e_f ~ N(0, 1),

so that at a position p, where x is x_p, it is normal with the covariance

    S_p = diag(floor^2 + share^2 (1 - common) x_p^2) + share^2 common x_p x_p'.

Bayes' rule takes the mean of the posterior N(x'; x_p, S_p) over all positions, which are equally likely. On average no
localizer of that reading has a lesser mean square, and a network errs LEARNING times as much once it has learnt the
rule from many presses. A search minimises a formula that is differentiable (`expected_error`); this one counts every
confusion in full.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from padforge.design.contact import relative_stretch
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.expected_error import (
    evaluation_windows,
    scatter_of_full_scale,
    straight_full_scale,
)
from padforge.design.objectives.fibre_loss import failure_masks, failure_shares
from padforge.design.paths.keep_outs import is_outside
from padforge.design.settings import Contact, PadSettings, Rectangle, Scatter, SearchSettings

LEARNING = 1.05
"""Error of networks of three layers trained on 20 000 presses, over that of Bayes' rule: 1.02 to 1.09."""
STEP, FAR_STEP, MAX_FAR, MARGIN = 0.1, 0.7, 2048, 1.0
"""Steps of the grids of positions, grid units: of the fine one over a window and MARGIN around it, whose step is about
that of a posterior's standard deviation, which suffices for a sum over Gaussians, and of the coarse one over the
remaining pad, of at most MAX_FAR positions."""
PRESSES, MIN_PRESSES, MAX_SETS, MIN_SETS = 8192, 64, 64, 8
"""Presses that are localized for each number of failed fibres, over all windows and sets, and by each of these at
least; sets of failed fibres of a size, fewer for each of several windows."""
LEAST_NOISE = 5e-3
"""Floor of the scatter, full scales, that lesser ones are taken for: the grid would not resolve the posterior."""
Mask = NDArray[np.bool_]


class Positions(NamedTuple):
    """Positions that a press may have, and what fibres respond there."""

    places: Array  # shape (P, 2), grid units
    log_prior: Array  # logarithms of the areas they stand for; shape (P,)
    responses: Array  # shape (P, F), full scales
    blur: Array  # variance of the responses within these areas; shape (P, F)


@threadpool_limits.wrap(limits=1, user_api="blas")  # threads that wait for each other take longer beside other work
def expected_errors(pad: Morphology, contact: Contact, search: SearchSettings, size: PadSettings) -> list[float]:
    """Compute the expected errors, grid units, with 0, 1, ... fibres failed, always of the same draws.

    Args:
        pad: the fibres.
        contact: what a press does to them.
        search: says how many fibres may fail, and how responses scatter.
        size: says what is pressed.
    """
    fibres, windows = len(pad.knots), evaluation_windows(size.sensed)
    levels = range(min(len(failure_shares(search.max_failures)), fibres))
    masks = [failure_masks(fibres, k, max(MAX_SETS // len(windows), MIN_SETS)) > 0 for k in levels]
    scale = straight_full_scale(pad.layout, contact, size.sensed_mm)
    scatter = scatter_of_full_scale(search.response_scatter, contact, scale)
    scatter = scatter._replace(floor=max(scatter.floor, LEAST_NOISE))
    rng, errors = np.random.default_rng(0), []
    for window in windows:
        pressed = _random_presses(window, PRESSES // len(windows), size, rng)
        if not len(pressed):
            continue
        readings = scatter.sample(relative_stretch(pad, pressed, contact) / scale, rng)
        positions = possible_positions(pad, contact, size, window, scale)
        errors.append([])
        for sets in masks:
            count, means = max(len(pressed) // len(sets), MIN_PRESSES), []
            for number, working in enumerate(sets):  # each set has presses of its own, as far as there are enough
                rows = np.arange(number * count, (number + 1) * count) % len(pressed)
                located = bayes_positions(readings[rows], positions, scatter, working)
                means.append(np.hypot(*(located - pressed[rows]).T).mean())
            errors[-1].append(np.mean(means))
    return (LEARNING * np.mean(errors, axis=0)).tolist()


def possible_positions(
    pad: Morphology, contact: Contact, size: PadSettings, window: Rectangle, scale: float
) -> Positions:
    """Return what a press in a window may be taken for: a fine grid there, and a coarse one over the remaining pad."""
    low, high = np.array(size.sensed)
    near_low, near_high = np.clip(np.add(window, [[-MARGIN], [MARGIN]]), low, high)
    parts = [_responding_grid(pad, contact, near_low, near_high, STEP)]
    if (near_low > low).any() or (near_high < high).any():
        far = _responding_grid(pad, contact, low, high, max(FAR_STEP, math.sqrt((high - low).prod() / MAX_FAR)))
        is_far = ((far.places < near_low) | (far.places > near_high)).any(axis=1)
        parts.append(Positions(*(part[is_far] for part in far)))
    positions = Positions(*map(np.concatenate, zip(*parts, strict=True)))
    free = is_outside(positions.places, size)
    places, log_prior, responses, blur = (part[free] for part in positions)
    return Positions(places, log_prior, responses / scale, blur / scale**2)


def _responding_grid(pad: Morphology, contact: Contact, low: Array, high: Array, step: float) -> Positions:
    """Return a grid of cell centres over a rectangle, of about such a step, with responses not in full scales."""
    counts = np.maximum(np.ceil((high - low) / step).astype(int), 2)
    cell = (high - low) / counts
    places = low + cell * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1) + 0.5)
    responses = relative_stretch(pad, places.reshape(-1, 2), contact).reshape(*counts, -1)
    change = np.stack(np.gradient(responses, axis=(0, 1)))  # from a cell to the next one
    blur, log_prior = (change**2).sum(axis=0) / 12, np.full(counts, math.log(cell.prod()))
    return Positions(
        places.reshape(-1, 2), log_prior.ravel(), *(a.reshape(counts.prod(), -1) for a in (responses, blur))
    )


def _random_presses(window: Rectangle, presses: int, size: PadSettings, rng: np.random.Generator) -> Array:
    """Return about so many presses of a window in random order, one in each cell of a grid, but for keep-outs."""
    low, high = np.array(window)
    side = math.ceil(math.sqrt(presses))
    cells = rng.permutation(np.stack(np.meshgrid(*[np.arange(side)] * 2), axis=-1).reshape(-1, 2))
    pressed = low + (high - low) * (cells + rng.random(cells.shape)) / side
    return pressed[is_outside(pressed, size)]


def bayes_positions(readings: Array, positions: Positions, scatter: Scatter, working: Mask) -> Array:
    """Return the means (Q, 2) of the posteriors of presses, by the readings of the fibres that work.

    The common part of the covariance has rank one: its inverse is that of Sherman and Morrison.

    Args:
        readings: responses as they scatter, shape (Q, F), full scales.
        positions: what a press may be.
        scatter: of responses.
        working: which fibres work, shape (F,).
    """
    z, x, blur = readings[:, working], positions.responses[:, working], positions.blur[:, working]
    precision = 1 / (scatter.floor**2 + scatter.share**2 * (1 - scatter.common) * x**2 + blur)  # of each fibre alone
    common = scatter.share * math.sqrt(scatter.common) * x
    excess = 1 + (common**2 * precision).sum(axis=1)
    along = common * precision / np.sqrt(excess)[:, None]
    constant = (np.log(precision) - precision * x**2).sum(axis=1) - np.log(excess) + 2 * positions.log_prior
    # twice its logarithm: of each fibre alone, and of their common gain; in single precision and in place, for speed
    coefficients = np.hstack([-precision, 2 * precision * x])
    log_posterior = np.float32(np.hstack([z**2, z])) @ np.float32(coefficients.T) + np.float32(constant)
    gain = np.float32(z) @ np.float32(along.T) - np.float32((along * x).sum(axis=1))
    log_posterior += np.square(gain, out=gain)
    log_posterior -= log_posterior.max(axis=1, keepdims=True)
    log_posterior *= np.float32(0.5)
    posterior = np.exp(log_posterior, out=log_posterior)
    return posterior @ np.float32(positions.places) / posterior.sum(axis=1)[:, None]
