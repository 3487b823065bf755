"""Fibre loss: the sets of fibres that may fail, all sets of a size or a random sample of them."""

import itertools
import math

import numpy as np

from padforge.design.morphology import Array


def failure_subsets(fibres: int, n_failed: int, max_subsets: int = 256) -> list[tuple[int, ...]]:
    """Return all sets of `n_failed` fibres in order, or always the same sample if they are more than `max_subsets`."""
    if math.comb(fibres, n_failed) <= max_subsets:
        return list(itertools.combinations(range(fibres), n_failed))
    rng = np.random.default_rng(0)
    sample: set[tuple[int, ...]] = set()
    while len(sample) < max_subsets:
        sample.add(tuple(sorted(rng.choice(fibres, n_failed, replace=False).tolist())))
    return sorted(sample)


def failure_masks(fibres: int, n_failed: int, max_subsets: int) -> Array:
    """Return `failure_subsets` as masks (L, F): 1 for a working fibre, 0 for a failed one."""
    subsets = np.array(failure_subsets(fibres, n_failed, max_subsets), dtype=np.int64)  # (L, n_failed)
    return 1.0 - (subsets[:, :, None] == np.arange(fibres)).any(axis=1)


def failure_shares(max_failures: int | tuple[float, ...]) -> tuple[float, ...]:
    """Return the probabilities of 0, 1, ... failed fibres, from their weights or, if equal, from their maximum."""
    weights = (1.0,) * (max_failures + 1) if isinstance(max_failures, int) else max_failures
    return tuple(weight / sum(weights) for weight in weights)


def sample_failures(fibres: int, shares: tuple[float, ...], rng: np.random.Generator) -> Array:
    """Draw one set of failed fibres of each size, as masks (L, F): 1 for a working fibre, 0 for a failed one.

    Sizes whose probability in `shares` is 0, and those that leave no working fibre, are omitted.
    """
    sizes = [size for size, share in enumerate(shares[:fibres]) if share > 0]
    masks = np.ones((len(sizes), fibres))
    for mask, n_failed in zip(masks, sizes, strict=True):
        mask[rng.choice(fibres, n_failed, replace=False)] = 0
    return masks
