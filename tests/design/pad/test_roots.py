"""Roots on the unit interval: none missed, none made up, in order."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from design.pad.kernels.roots import SCRATCH, roots_in_unit


def found(coefficients: list[float], tolerance: float = 1e-14) -> list[float]:
    p, out = np.array(coefficients, dtype=float), np.full(16, np.nan)
    out[:2] = 7.0, 8.0  # those of another polynomial, which stay
    count = roots_in_unit(p, len(p) - 1, tolerance, out, 2, np.empty(SCRATCH))
    assert out[:2].tolist() == [7, 8]
    return out[2:count].tolist()


@pytest.mark.parametrize(
    ("coefficients", "roots"),
    [
        ([1.0, -2.0, 0.5], [2 - np.sqrt(2)]),  # its middle Bernstein coefficient is 0
        ([-1.0, 2.0, -0.5], [2 - np.sqrt(2)]),
        ([-0.5, 1.0], [0.5]),
        ([1.0, 0.0, 0.0, -8.0], [0.5]),
        ([0.1875, -1.0, 1.0], [0.25, 0.75]),
        ([0.25 + 1e-9, -1.0, 1.0], []),
        ([0.25 - 1e-6, -1.0, 1.0], [0.499, 0.501]),
        ([3.0, 1.0], []),
        ([1e-15, -2e-15], []),
        ([0.0, 0.0, 0.0], []),
    ],
)
def test_polynomials_of_known_roots(coefficients, roots):
    assert found(coefficients) == pytest.approx(roots, abs=1e-12)


@given(
    st.sets(st.integers(-20, 40).filter(lambda k: k not in (0, 16)), min_size=1, max_size=6),
    st.booleans(),
    st.sampled_from([-3.0, 1.0, 1e-12, 1e150]),
)
@settings(max_examples=60)
def test_simple_roots_are_all_found(places, with_pair, factor):
    """Roots at sixteenths, some outside, and a pair that is not real where there is room for it."""
    p = np.poly1d(factor)
    for k in places:
        p *= np.poly1d([1, -k / 16])
    if with_pair and len(places) <= 4:
        p *= np.poly1d([1, -1, 0.3])
    expected = sorted(k / 16 for k in places if 0 < k < 16)
    assert found(p.coeffs[::-1].tolist(), 1e-14 * abs(factor)) == pytest.approx(expected, abs=1e-9)


def test_a_touch_within_the_tolerance_is_no_root():
    touch = [1 / 9 - 1e-13, -2 / 3, 1.0]
    assert len(found(touch, tolerance=0.0)) == 2
    assert found(touch, tolerance=1e-11) == []
