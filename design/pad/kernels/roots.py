"""Roots of polynomials on [0, 1], none missed: Bernstein coefficients bound the sign changes of what they describe."""

from typing import Any

from numba import njit

DEPTH = 60
MAX_DEGREE = 6
SCRATCH = (DEPTH + 2, MAX_DEGREE + 3)
"""Shape of the work array of `roots_in_unit`."""


@njit(cache=True, error_model="numpy")
def sort(values: Any, count: Any) -> None:
    """Sort values[:count] in place, by Shell's method: numpy's sort takes a second to compile."""
    gap = count
    while gap > 1:
        gap = max(gap * 5 // 11, 1)
        for i in range(gap, count):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value


@njit(cache=True, error_model="numpy")
def _bracketed(p: Any, degree: int, low: float, high: float, rising: bool) -> float:
    """The one sign change of p in (low, high): Newton's method, bisected where it would leave the bracket."""
    u = 0.5 * (low + high)
    for _ in range(100):
        value, slope = p[degree], 0.0
        for i in range(degree - 1, -1, -1):
            slope = slope * u + value
            value = value * u + p[i]
        if value == 0:
            return u
        if (value > 0) == rising:
            high = u
        else:
            low = u
        after = u - value / slope if slope != 0 else low
        if not low < after < high:
            after = 0.5 * (low + high)
        if abs(after - u) <= 1e-16 or not low < after < high:
            return after
        u = after
    return u


@njit(cache=True, error_model="numpy")
def roots_in_unit(p: Any, degree: Any, tolerance: float, out: Any, count: Any, work: Any) -> int:
    """Append the sign changes of sum p[i] u^i on (0, 1), ascending, to out[count:]; return the new count.

    Bernstein coefficients with no change of sign exclude a root, with one change hold exactly one; else the interval
    is halved. Where all coefficients are within `tolerance` of 0 the polynomial only touches zero: no sign change.

    Args:
        p: (degree + 1,) power coefficients, degree <= MAX_DEGREE; no literal, for each of which it would be compiled.
        work: (SCRATCH) floats, overwritten: a stack of [coefficients ..., low, high].
    """
    lo, hi = MAX_DEGREE + 1, MAX_DEGREE + 2
    for j in range(degree + 1):  # power to Bernstein form: b_j = sum_i C(j, i) / C(n, i) p_i
        ratio, total = 1.0, 0.0
        for i in range(j + 1):
            total += ratio * p[i]
            ratio *= (j - i) / (degree - i) if degree > i else 0.0
        work[0, j] = total
    work[0, lo], work[0, hi] = 0.0, 1.0
    top = 0
    while top >= 0:
        b = work[top]
        # a zero counts as positive, so that a root at the border of two halves shows in one of them
        changes, largest = 0, abs(b[0])
        for j in range(1, degree + 1):
            largest = max(largest, abs(b[j]))
            if (b[j] < 0) != (b[j - 1] < 0):
                changes += 1
        if changes == 0 or largest <= tolerance:
            top -= 1
        elif changes == 1:
            out[count] = _bracketed(p, degree, b[lo], b[hi], b[0] < 0)
            count += 1
            top -= 1
        elif top >= DEPTH:
            top -= 1
        else:  # de Casteljau at the middle; the left half goes on top of the stack, so roots come in order
            left = work[top + 1]
            for j in range(degree + 1):
                left[j] = b[0]
                for i in range(degree - j):
                    b[i] = 0.5 * (b[i] + b[i + 1])
            # after the sweep b holds the last diagonal reversed: the right half
            middle = 0.5 * (b[lo] + b[hi])
            left[lo], left[hi] = b[lo], middle
            b[lo] = middle
            top += 1
    return count
