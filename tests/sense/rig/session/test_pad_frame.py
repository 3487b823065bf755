"""The pad's frame in the arm's: closed forms of a turned and shifted pad."""

import numpy as np
import pytest

from sense.rig.devices.protocols import RigFault
from sense.rig.session.pad_frame import Frame
from tests.sense.rig.devices.fakes import RIG

TURNED = RIG.model_copy(update={"pad_mm": (10.0, -400.0), "pad_angle_deg": 90.0, "tool_rad": (0.1, 3.1, 0.2)})


def test_a_pad_turned_to_the_left_has_its_x_axis_along_the_arms_y_axis():
    frame = Frame.of(TURNED)
    assert frame.pose(np.array([3.0, 0.0]), 4.0) == pytest.approx((10, -397, 46, 0.1, 3.1, 0.2))
    assert frame.pose(np.array([0.0, 3.0]), -8.0) == pytest.approx((7, -400, 58, 0.1, 3.1, 0.2))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, -135.0])
def test_a_tip_is_where_its_pose_was_asked_for(angle_deg):
    frame = Frame.of(TURNED.model_copy(update={"pad_angle_deg": angle_deg}))
    places, depths = np.array([[3.0, 1.0], [-2.0, 5.0]]), [4.0, -8.0]
    poses = np.array([frame.pose(place, depth) for place, depth in zip(places, depths, strict=True)])
    found = frame.tip(poses)
    np.testing.assert_allclose(found[0], places, atol=1e-12)
    np.testing.assert_allclose(found[1], depths)


def test_an_unknown_height_is_refused():
    with pytest.raises(RigFault, match="contact_mm is unknown"):
        Frame.of(RIG.model_copy(update={"contact_mm": None}))
