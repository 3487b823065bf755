"""The plan of a pad as a picture: what it shows of holes, and what it does not take for some."""

import numpy as np
import pytest
from matplotlib.patches import Circle, Polygon

from design import Contact, InputError, Morphology, draw_plan

PAD = Morphology.straight(2)


def test_keep_outs_are_drawn_as_they_are_stated():
    holes = [((-3.0, 1.0), (2.0, 1.0), (0.0, 4.0)), [[5, 5], [6, 5], [6, 6], [5, 6]]]
    drawn = [patch for patch in draw_plan(PAD, Contact(), (), holes).axes[0].patches if isinstance(patch, Polygon)]
    assert [patch.get_xy()[:-1].tolist() for patch in drawn] == [np.array(hole).tolist() for hole in holes]


@pytest.mark.parametrize("pitch_mm", [5.0, 11.25, (20.0, 8.0)])
def test_a_measured_contact_is_drawn_to_where_half_of_it_is_felt_in_mm(pitch_mm):
    (press,) = [
        patch
        for patch in draw_plan(Morphology.straight(2, pitch_mm), Contact()).axes[0].patches
        if isinstance(patch, Circle)
    ]
    assert press.radius == pytest.approx(np.sqrt(2 * np.log(2)) * 6.2, rel=0.01)


@pytest.mark.parametrize("holes", [4, None, "ab", [3], [[1.0, 2.0]], [[]], [[(0, 0), (1, np.nan)]], np.ones((1, 3, 2))])
def test_what_is_no_polygon_is_refused_in_one_line(holes):
    with pytest.raises(InputError, match="keep_out_mm"):
        draw_plan(PAD, Contact(), (), holes)
