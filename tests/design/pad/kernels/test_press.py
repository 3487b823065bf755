"""Which fibres a press can touch, and what an element in it weighs, against plain ways to say it."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from design import Morphology
from design.pad.contact import fibre_axes
from design.pad.kernels.press import (
    INVERSE,
    INVERSE_SQUARE,
    MANHATTAN,
    PROFILE,
    UNIFORM,
    Ends,
    Law,
    count_touched,
    family_strays,
    profile_of,
    touched_range,
    weigh,
)

EIGHTHS = st.integers(-40, 80).map(lambda k: k / 8)


def can_touch(cv: float, low: float, high: float, stray: float, count: int, apart: float = 1) -> list[int]:
    levels = [apart * (i + 1) for i in range(count)]
    return [i for i, level in enumerate(levels) if level + stray >= cv + low and level - stray <= cv + high]


@given(
    EIGHTHS,
    st.integers(1, 16).map(lambda k: -k / 8),
    st.integers(1, 16).map(lambda k: k / 8),
    st.integers(0, 16).map(lambda k: k / 8),
    st.integers(0, 6),
    st.integers(0, 6),
    st.sampled_from([0.25, 1.0, 1.5]),
    st.integers(0, 1),
)
def test_the_range_holds_just_the_fibres_whose_band_a_press_overlaps(
    cv, low, high, stray, horizontals, verticals, apart, family
):
    """On eighths, where bands and presses often only touch: that counts."""
    ends = Ends(horizontals, verticals, *((apart, 2.0) if family == 0 else (2.0, apart)))
    before, count = (0, horizontals) if family == 0 else (horizontals, verticals)
    first, end = touched_range(cv, np.array([-9.0, 9.0, low, high, 0.1]), stray, ends, family)
    assert before <= first <= before + count
    assert before <= end <= before + count
    assert [f - before for f in range(first, end)] == can_touch(cv, low, high, stray, count, apart)


def test_the_running_number_of_touched_fibres():
    rng = np.random.default_rng(0)
    presses, strays = rng.uniform(-1, 6, (30, 2)), np.array([0.3, 1.1])
    reach = np.array([[-1, 1, -0.5, 0.7, 0.1], [-1, 1, -0.2, 0.4, 0.1]])
    ends, of_family = Ends(4, 2, 1.0, 1.5), ((4, 1.0), (2, 1.5))
    numbers = [
        sum(
            len(can_touch(press[1 - family], reach[family, 2], reach[family, 3], strays[family], *of_family[family]))
            for family in (0, 1)
        )
        for press in presses
    ]
    np.testing.assert_array_equal(count_touched(strays, presses, reach, ends), np.append(0, np.cumsum(numbers)))


def test_strays_are_the_farthest_that_fibres_of_a_family_leave_their_levels():
    for seed in range(5):
        pads = np.stack([Morphology.random(3, 2, 10 * seed + k).knots for k in range(2)])
        found = family_strays(*fibre_axes(pads)[1:3])
        for pad, strays in zip(pads, found, strict=True):
            for family in (0, 1):
                away = [np.abs(pad[3 * family + i, :, 1 - family] - (i + 1)).max() for i in range(3)]
                assert strays[family] == pytest.approx(max(away))


@pytest.mark.parametrize(("d", "inverse"), [(2.0, 0.5), (0.25, 4.0), (0.006, 1 / 0.006), (0.004, 200.0), (0.0, 200.0)])
def test_weights_of_an_element(d, inverse):
    radius = 0.5
    expected = {UNIFORM: 1, INVERSE_SQUARE: 1 / (radius + d**2), INVERSE: inverse}
    for weight, value in expected.items():
        assert weigh(d**2, Law(radius, weight, MANHATTAN)) == pytest.approx(value)


def test_a_profile_goes_through_its_points_and_ends_without_a_kink():
    reach = ((0.0, 1.0), (0.4, 0.7), (0.8, -0.1), (1.5, 0.0))
    law = Law(1.5, PROFILE, MANHATTAN, profile_of(reach))
    assert [weigh(d**2, law) for d, _ in reach] == pytest.approx([weight for _, weight in reach], abs=1e-12)
    line = np.linspace(0, 1.5, 400)
    ends: Any = ((2, 0), (1, 0))
    spline = CubicSpline(np.square([d for d, _ in reach]), [w for _, w in reach], bc_type=ends)
    np.testing.assert_allclose([weigh(d**2, law) for d in line], spline(line**2), atol=1e-12)
    assert abs(weigh((1.5 - 1e-5) ** 2, law)) < 1e-8
