"""Fibre loss: which sets of fibres may fail, all of a size or a fair sample where there are too many."""

import itertools
import math

import numpy as np

from padforge.design.morphology import Array

DRAWS = 2
"""Random sets of failed fibres of each size in a step of the search."""


def failure_subsets(fibres: int, n_failed: int, max_subsets: int = 256) -> list[tuple[int, ...]]:
    """Return all sets of failed fibres of one size, in order; if there are too many, always the same sample of them."""
    if math.comb(fibres, n_failed) <= max_subsets:
        return list(itertools.combinations(range(fibres), n_failed))
    rng = np.random.default_rng(0)
    drawn: set[tuple[int, ...]] = set()
    while len(drawn) < max_subsets:
        drawn.add(tuple(sorted(rng.choice(fibres, n_failed, replace=False).tolist())))
    return sorted(drawn)


def failure_masks(fibres: int, n_failed: int, max_subsets: int) -> Array:
    """Return `failure_subsets` as masks (L, F): 1 for a fibre that works, 0 for a failed one."""
    subsets = np.array(failure_subsets(fibres, n_failed, max_subsets), dtype=np.int64)  # (L, n_failed)
    return 1.0 - (subsets[:, :, None] == np.arange(fibres)).any(axis=1)


def failure_shares(max_failures: int | tuple[float, ...]) -> tuple[float, ...]:
    """Return the probabilities P(k) that k = 0, 1, ... fibres have failed, from their weights.

    They are equal if only the largest number of failed fibres is given.
    """
    weights = (1.0,) * (max_failures + 1) if isinstance(max_failures, int) else max_failures
    return tuple(weight / sum(weights) for weight in weights)


def sample_failures(fibres: int, shares: tuple[float, ...], rng: np.random.Generator) -> Array:
    """Draw masks (L, F), 1 for a fibre that works, of DRAWS sets of failed fibres of each size, and of one of size 0.

    Sizes of probability 0 by the `shares` P(k), and those that leave no fibre, are left out.
    """
    draws = [size for size, share in enumerate(shares[:fibres]) if share > 0 for _ in range(DRAWS if size else 1)]
    masks = np.ones((len(draws), fibres))
    for mask, n_failed in zip(masks, draws, strict=True):
        mask[rng.choice(fibres, n_failed, replace=False)] = 0
    return masks
