"""Knots through drawn curves: within the tolerance, and no more than it takes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design.pad.courses.fitting import fitted_knots
from tests.helpers.effort import few


def off(knots, points):
    """Greatest distance along the normal, by scipy's curve."""
    curve = PchipInterpolator(*knots.T)
    slope = np.gradient(points[:, 1], points[:, 0])
    return (np.abs(curve(points[:, 0]) - points[:, 1]) / np.hypot(1, slope)).max()


def test_a_straight_curve_needs_no_knots_but_its_ends():
    points = np.stack([np.linspace(-20, 20, 50), np.full(50, 3.0)], axis=1)
    assert np.array_equal(fitted_knots(points, 0.05), points[[0, -1]])
    assert len(fitted_knots(points[[0, -1]], 0.05)) == 2


def test_a_wave_needs_few_knots():
    x = np.linspace(-28, 28, 3000)
    points = np.stack([x, 4 * np.sin(x / 3)], axis=1)
    found = fitted_knots(points, 0.05)
    assert off(found, points) < 0.06
    assert len(found) < 40
    assert (np.diff(found[:, 0]) > 0).all()
    assert np.array_equal(found[[0, -1]], points[[0, -1]])


@few(6)
@given(st.lists(st.floats(-8, 8), min_size=1, max_size=8))
def test_a_pchip_curve_is_found_with_hardly_more_knots_than_it_has(heights):
    t = np.linspace(-28, 28, len(heights) + 2)
    knots = np.stack([t, [1.0, *heights, 1.0]], axis=1)
    x = np.linspace(-28, 28, 4000)
    points = np.stack([x, PchipInterpolator(*knots.T)(x)], axis=1)
    found = fitted_knots(points, 0.05)
    assert off(found, points) < 0.06
    assert len(found) <= len(knots) + 4


def test_a_finer_tolerance_takes_more_knots_and_no_more_than_allowed():
    x = np.linspace(0, 40, 2000)
    points = np.stack([x, np.sin(x) + 0.3 * np.sin(2.7 * x)], axis=1)
    counts = [len(fitted_knots(points, tolerance)) for tolerance in (0.3, 0.03)]
    assert counts[0] < counts[1]
    assert len(fitted_knots(points, 1e-6, most=20)) == 22


def test_a_step_is_followed():
    points = np.array([[0.0, 0], [10, 0], [10.001, 5], [20, 5]])
    found = fitted_knots(points, 0.05)
    assert off(found, np.stack([np.linspace(0, 9.9, 100), np.zeros(100)], axis=1)) < 0.06
    assert np.isfinite(found).all()
    with pytest.raises(AssertionError):  # it does rise
        assert np.ptp(found[:, 1]) < 4.9
