"""Straight moves with a trapezoidal velocity profile."""

import pytest

from padforge.sense.rig.arms.motion import StraightMove, TrapezoidalProfile

MOVE = StraightMove((0.0, 0.0, 0.0), (30.0, 40.0, 0.0), 10.0, 20.0)


def test_a_move_follows_its_profile_of_distance_and_speed():
    profile = TrapezoidalProfile(50.0, 10.0, 20.0)
    assert profile.duration_s == pytest.approx(50 / 10 + 10 / 20)
    assert profile.evaluate(0.25) == pytest.approx((0.625, 5.0))
    assert profile.evaluate(1.0) == pytest.approx((7.5, 10.0))
    assert profile.evaluate(profile.duration_s - 0.25) == pytest.approx((50 - 0.625, 5.0))
    assert profile.evaluate(99.0) == (50.0, 0.0)
    assert MOVE.position(-1.0) == MOVE.start
    assert MOVE.position(2.5) == pytest.approx((13.5, 18.0, 0.0))
    assert MOVE.position(99.0) == MOVE.end
    short = StraightMove((0.0, 0.0, 5.0), (0.0, 0.0, 4.0), 100.0, 100.0)  # never at full speed
    assert short.duration_s == pytest.approx(0.2)
    assert short.position(0.1) == pytest.approx((0.0, 0.0, 4.5))


def test_move_limit_axes_slows_down_to_slowest_axis():
    move = MOVE.limit_axes((3.0, 100.0, 1.0), (100.0, 4.0, 1.0))  # z does not move, and limits nothing
    assert move.speed * 0.6 == pytest.approx(3.0)
    assert move.acceleration * 0.8 == pytest.approx(4.0)
    assert MOVE.limit_axes((100.0, 100.0, 1.0), (100.0, 100.0, 1.0)) == MOVE
    rest = StraightMove((1.0, 2.0, 3.0), (1.0, 2.0, 3.0), 10.0, 10.0)
    assert rest.duration_s == 0
    assert rest.limit_axes((1.0, 1.0, 1.0), (1.0, 1.0, 1.0)).position(0.0) == rest.end
    assert rest.distance_mm((1.0, 2.0, 4.0)) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("position", "expected"), [((15.0, 20.0, 2.0), 2.0), ((33.0, 44.0, 0.0), 5.0), ((-4.0, 3.0, 0.0), 5.0)]
)
def test_move_distance_is_to_nearest_point_between_its_ends(position, expected):
    assert MOVE.distance_mm(position) == pytest.approx(expected)
