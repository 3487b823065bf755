"""The pad's frame in the arm's: closed forms of a pad that is turned, shifted and turned over."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from padforge.design.twin import PlanTransform as TwinFrame
from padforge.sense.rig.config import RobotFrame
from padforge.sense.rig.devices import RigFault
from tests.sense.rig.fakes import RIG


@pytest.mark.parametrize(("mirrored", "y_mm"), [(False, -397), (True, -403)])
def test_a_pad_turned_to_the_left_has_its_x_axis_along_the_arms_y_axis(mirrored, y_mm):
    """With its tracks up it keeps its y axis, and x runs the other way."""
    lies = {"pad_mm": (10.0, -400.0), "pad_angle_deg": 90.0, "tool_rad": (0.1, 3.1, 0.2), "mirrored": mirrored}
    frame = RobotFrame.of(RIG.model_copy(update=lies))
    assert frame.pose(np.array([3.0, 0.0]), 4.0) == pytest.approx((10, y_mm, 46, 0.1, 3.1, 0.2))
    assert frame.pose(np.array([0.0, 3.0]), -8.0) == pytest.approx((7, -400, 58, 0.1, 3.1, 0.2))


NUMBERS = st.floats(-500, 500)
PLACES = st.lists(st.tuples(NUMBERS, NUMBERS, st.floats(-20, 20)), min_size=1, max_size=5)


@given(st.booleans(), st.floats(-360, 360), st.tuples(NUMBERS, NUMBERS), PLACES)
def test_a_tip_is_where_its_pose_was_asked_for_and_a_twins_frame_says_the_same(mirrored, angle_deg, centre_mm, asked):
    """No length changes, however the pad lies; a twin's frame takes an arm's places that was told nothing of it."""
    frame = RobotFrame.of(
        RIG.model_copy(update={"mirrored": mirrored, "pad_angle_deg": angle_deg, "pad_mm": centre_mm})
    )
    places, depths = np.array(asked)[:, :2], np.array(asked)[:, 2]
    poses = np.array([frame.pose(place, depth) for place, depth in zip(places, depths, strict=True)])
    np.testing.assert_allclose(np.hypot(*(poses[:, :2] - centre_mm).T), np.hypot(*places.T), atol=1e-9)
    found = frame.tip(poses)
    np.testing.assert_allclose(found[0], places, atol=1e-9)
    np.testing.assert_allclose(found[1], depths, atol=1e-9)
    twin = TwinFrame(mirrored, angle_deg if mirrored else -angle_deg)
    moved = replace(twin, shift_mm=tuple(-twin.rotate(np.array(centre_mm))))
    np.testing.assert_allclose(moved.to_plan(poses[:, :2]), places, atol=1e-9)


def test_an_unknown_height_is_refused():
    with pytest.raises(RigFault, match="contact_mm is unknown"):
        RobotFrame.of(RIG.model_copy(update={"contact_mm": None}))
