import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from padforge.design import Morphology
from padforge.design.paths.curves import SPARE_LENGTH, add_spare_knots, remove_spare_knots
from padforge.design.paths.knot_fitting import fit_knots


def test_fit_knots_needs_few_knots():
    points = np.stack([np.linspace(-20, 20, 50), np.full(50, 3.0)], axis=1)
    assert np.array_equal(fit_knots(points, 0.05), points[[0, -1]])
    x = np.linspace(-6, 3, 150)
    points = np.stack([x, 4 * np.sin(x / 3)], axis=1)
    knots = fit_knots(points, 0.05)
    along_normal = np.abs(PchipInterpolator(*knots.T)(x) - points[:, 1]) / np.hypot(1, 4 / 3 * np.cos(x / 3))
    assert along_normal.max() < 0.06
    assert len(fit_knots(points, 0.8)) < len(knots) < 9
    assert (np.diff(knots[:, 0]) > 0).all()
    assert np.array_equal(knots[[0, -1]], points[[0, -1]])
    steep = fit_knots(np.array([[0.0, 0], [10, 0], [10.001, 5], [20, 5]]), 0.5)
    assert np.isfinite(steep).all()
    assert np.ptp(steep[:, 1]) >= 4


def moved(course, count):
    """By how far (grid units) a course of a pad of 2 + 2 is off with so many more knots, and what is found of them."""
    straight = Morphology.straight(2)
    layout = straight.layout
    more = np.stack([np.linspace(0, 3, len(course) + count), np.full(len(course) + count, 2.0)], axis=1)
    pad = Morphology.from_layout(add_spare_knots([course, more, *straight.knots[2:]], layout), layout)
    assert pad.knots.shape[1] == len(course) + count
    x = np.linspace(0, 3, 5001)
    plain, filled = (PchipInterpolator(*line.T)(x) for line in (course, pad.knots[0]))
    return np.abs(plain - filled).max(), remove_spare_knots(pad.knots, layout)[0]


@given(st.lists(st.integers(1, 29), min_size=5, max_size=12), st.integers(1, 40))
@settings(max_examples=15)
def test_spare_knots_preserve_paths_that_turn_inside(heights, count):
    x = np.linspace(0, 3, len(heights) + 2)
    course = np.stack([x, [1, *(height / 10 for height in heights), 1]], axis=1)
    course[3, 1] = 2.95 if course[2, 1] < 2.9 and course[4, 1] < 2.9 else 0.05
    course[[2, 4], 1] = 1.5  # so it turns at its fourth knot
    off, found = moved(course, count)
    assert off < 10 * SPARE_LENGTH
    assert found == pytest.approx(course)


@pytest.mark.parametrize("heights", [[], [1.0] * 3, [0.5, 1.8], [1.8, 1.5, 1.2]])
def test_spare_knots_preserve_straight_paths_and_nearly_turns_at_ends(heights):
    course = np.stack([np.linspace(0, 3, len(heights) + 2), [1.0, *heights, 1.0]], axis=1)
    for count in (1, 9):
        off, found = moved(course, count)
        assert off < 0.02
        if set(heights) <= {1.0}:
            assert off == 0
            assert found == pytest.approx(course)
