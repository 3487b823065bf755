"""Straight moves within the limits of axes."""

import math

import pytest

from sense.rig.arms.printer.motion import StraightMove

LONG_WAY = StraightMove((0.0, 0.0, 0.0), (30.0, 40.0, 0.0), 10.0, 20.0)


def test_a_long_move_has_a_trapezoid_of_speed():
    assert LONG_WAY.duration_s == pytest.approx(50 / 10 + 10 / 20)
    assert LONG_WAY.at(-1.0) == LONG_WAY.start
    assert LONG_WAY.at(0.5) == pytest.approx((1.5, 2.0, 0.0))  # 2.5 mm while it gains speed
    assert LONG_WAY.at(2.5) == pytest.approx((13.5, 18.0, 0.0))
    assert LONG_WAY.at(LONG_WAY.duration_s - 0.5) == pytest.approx((28.5, 38.0, 0.0))
    assert LONG_WAY.at(99.0) == LONG_WAY.end


def test_a_short_move_never_reaches_its_speed():
    move = StraightMove((0.0, 0.0, 5.0), (0.0, 0.0, 4.0), 100.0, 100.0)
    assert move.duration_s == pytest.approx(0.2)
    assert move.at(0.1) == pytest.approx((0.0, 0.0, 4.5))


def test_no_axis_exceeds_its_limits():
    move = LONG_WAY.within((3.0, 100.0, 1.0), (100.0, 4.0, 1.0))  # z does not move, and limits nothing
    assert move.speed * 0.6 == pytest.approx(3.0)
    assert move.acceleration * 0.8 == pytest.approx(4.0)
    assert LONG_WAY.within((100.0, 100.0, 1.0), (100.0, 100.0, 1.0)) == LONG_WAY


def test_no_way_takes_no_time():
    nowhere = StraightMove((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 10.0, 10.0)
    assert nowhere.duration_s == 0
    assert nowhere.within((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)).at(0.0) == nowhere.end


@pytest.mark.parametrize(
    ("place", "expected"), [((15.0, 20.0, 2.0), 2.0), ((33.0, 44.0, 0.0), 5.0), ((-4.0, 3.0, 0.0), 5.0)]
)
def test_distance_is_to_the_way_between_its_ends(place, expected):
    assert LONG_WAY.distance_mm(place) == pytest.approx(expected)
    assert math.isfinite(StraightMove(place, place, 1.0, 1.0).distance_mm((0.0, 0.0, 0.0)))
