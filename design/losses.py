"""Which fibres may be lost: all sets of a size, or a fair sample where there are too many."""

import itertools
import math

import numpy as np


def lost_subsets(fibres: int, lost: int, most: int = 256) -> list[tuple[int, ...]]:
    """All sets of `lost` of the fibres, by index; of more than `most`, as many different ones, always the same."""
    if math.comb(fibres, lost) <= most:
        return list(itertools.combinations(range(fibres), lost))
    rng = np.random.default_rng(0)
    drawn: set[tuple[int, ...]] = set()
    while len(drawn) < most:
        drawn.add(tuple(sorted(rng.choice(fibres, lost, replace=False).tolist())))
    return sorted(drawn)
