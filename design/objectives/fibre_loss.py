"""Fibre loss: which sets of fibres may fail, all of a size or a fair sample where there are too many."""

import itertools
import math

import numpy as np

from padforge.design.morphology import Array

DRAWS = 2
"""Random sets of failed fibres of each size in a step of the search."""


def failure_subsets(fibres: int, n_failed: int, max_subsets: int = 256) -> list[tuple[int, ...]]:
    """Return all sets of failed fibres of one size; if there are too many, a sample that is always the same.

    Args:
        fibres: number of fibres.
        n_failed: size of a set.
        max_subsets: most sets.

    Returns:
        Tuples of ascending indices, in lexicographic order.
    """
    if math.comb(fibres, n_failed) <= max_subsets:
        return list(itertools.combinations(range(fibres), n_failed))
    rng = np.random.default_rng(0)
    drawn: set[tuple[int, ...]] = set()
    while len(drawn) < max_subsets:
        drawn.add(tuple(sorted(rng.choice(fibres, n_failed, replace=False).tolist())))
    return sorted(drawn)


def failure_masks(fibres: int, n_failed: int, max_subsets: int) -> Array:
    """Return `failure_subsets` as masks (L, F): 1 for a fibre that works, 0 for a failed one."""
    subsets = failure_subsets(fibres, n_failed, max_subsets)
    masks = np.ones((len(subsets), fibres))
    for row, failed in enumerate(subsets):
        masks[row, list(failed)] = 0
    return masks


def failure_shares(max_failures: int | tuple[float, ...]) -> tuple[float, ...]:
    """Return the probabilities P(k) that k = 0, 1, ... fibres have failed.

    Args:
        max_failures: most failed fibres: half for none, and equal from 1 to it; or weights of 0, 1, ... failed.
    """
    weights = (max(max_failures, 1.0), *(1.0,) * max_failures) if isinstance(max_failures, int) else max_failures
    return tuple(weight / sum(weights) for weight in weights)


def sample_failures(fibres: int, shares: tuple[float, ...], rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw DRAWS random sets of failed fibres of each size above 0, and the one of size 0.

    Args:
        fibres: number of fibres.
        shares: P(k) of k = 0, 1, ... failed; sizes of probability 0, and those that leave no fibre, are left out.
        rng: source of the draws.

    Returns:
        Masks (L, F), 1 for a fibre that works, and their weights (L,), sum 1.
    """
    masks, weights = [], []
    for n_failed, share in enumerate(shares[:fibres]):
        draws = DRAWS if n_failed else 1
        for _ in range(draws if share > 0 else 0):
            mask = np.ones(fibres)
            mask[rng.choice(fibres, n_failed, replace=False)] = 0
            masks.append(mask)
            weights.append(share / draws)
    return np.array(masks), np.array(weights) / sum(weights)
