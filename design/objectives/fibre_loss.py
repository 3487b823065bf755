"""Which fibres may be lost: all sets of a size, or a fair sample where there are too many."""

import itertools
import math

import numpy as np

from padforge.design.morphology import Array

DRAWS = 2  # random losses of each size a step of the search looks at


def failure_subsets(fibres: int, lost: int, most: int = 256) -> list[tuple[int, ...]]:
    """All sets of `lost` of the fibres, by index; of more than `most`, as many different ones, always the same."""
    if math.comb(fibres, lost) <= most:
        return list(itertools.combinations(range(fibres), lost))
    rng = np.random.default_rng(0)
    drawn: set[tuple[int, ...]] = set()
    while len(drawn) < most:
        drawn.add(tuple(sorted(rng.choice(fibres, lost, replace=False).tolist())))
    return sorted(drawn)


def failure_masks(fibres: int, lost: int, most: int) -> Array:
    """`failure_subsets` as masks (L, F): 1 for a fibre that works, 0 for a lost one."""
    losses = failure_subsets(fibres, lost, most)
    kept = np.ones((len(losses), fibres))
    for row, loss in enumerate(losses):
        kept[row, list(loss)] = 0
    return kept


def loss_shares(max_failures: int | tuple[float, ...]) -> tuple[float, ...]:
    """P(k), k = 0, 1, ...: half for none and equal up to a number of lost fibres, or the given weights, of sum 1."""
    weights = (max(max_failures, 1.0), *(1.0,) * max_failures) if isinstance(max_failures, int) else max_failures
    return tuple(weight / sum(weights) for weight in weights)


def sample_failures(fibres: int, shares: tuple[float, ...], rng: np.random.Generator) -> tuple[Array, Array]:
    """Masks (L, F) of fibres that still work, and their weights (L,): DRAWS random losses of each size above 0.

    Sizes of weight 0, and those that would leave no fibre, are left out.
    """
    kept, weights = [], []
    for lost, share in enumerate(shares[:fibres]):
        draws = DRAWS if lost else 1
        for _ in range(draws if share > 0 else 0):
            mask = np.ones(fibres)
            mask[rng.choice(fibres, lost, replace=False)] = 0
            kept.append(mask)
            weights.append(share / draws)
    return np.array(kept), np.array(weights) / sum(weights)
