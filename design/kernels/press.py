"""The press: what a fibre element in it weighs."""

import math

from numba import njit

UNIFORM, INVERSE_SQUARE, INVERSE = 0, 1, 2
MANHATTAN, EUCLIDEAN = 0, 1


@njit(cache=True, error_model="numpy")
def weigh(square: float, radius: float, weight: int) -> float:
    """Weight of a fibre element at squared distance `square` from the press centre."""
    if weight == UNIFORM:
        return 1.0
    if weight == INVERSE_SQUARE:
        return 1 / (radius + square)
    return 1 / max(math.sqrt(square), radius / 100)
