"""The press: what lies inside its shape, and what a fibre element there weighs."""

import math

from numba import njit

UNIFORM, INVERSE_SQUARE, INVERSE = 0, 1, 2
MANHATTAN, EUCLIDEAN = 0, 1


@njit(cache=True, error_model="numpy")
def inside(dx: float, dy: float, radius: float, sides: int) -> bool:
    """Whether (dx, dy) from the press centre lies in the regular polygon, or the circle where sides is 0."""
    square = dx * dx + dy * dy
    if square > radius * radius:
        return False
    if sides == 0:
        return True
    apothem = radius * math.cos(math.pi / sides)
    if square <= apothem * apothem:
        return True
    wedge = 2 * math.pi / sides
    middle = (math.floor(math.atan2(dy, dx) / wedge) + 0.5) * wedge
    return dx * math.cos(middle) + dy * math.sin(middle) <= apothem


@njit(cache=True, error_model="numpy")
def weigh(square: float, radius: float, weight: int) -> float:
    """Weight of a fibre element at squared distance `square` from the press centre."""
    if weight == UNIFORM:
        return 1.0
    if weight == INVERSE_SQUARE:
        return 1 / (radius + square)
    return 1 / max(math.sqrt(square), radius / 100)
