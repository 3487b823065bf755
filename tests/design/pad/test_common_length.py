"""How far lines run along each other, on lines whose answer is known and against shapely's buffers."""

import numpy as np
import pytest
import shapely

from design.pad.courses.common_length import common_stretches
from design.pad.courses.curves import flatten
from design.pad.morphology import Morphology

LEVEL = np.array([[-9.0, 0.0], [9.0, 0.0]])


def through_middle(angle_deg: float, points: int = 2) -> np.ndarray:
    ahead = [np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))]
    return np.linspace(-9, 9, points)[:, None] * ahead


@pytest.mark.parametrize("points", [2, 50, 1000])
@pytest.mark.parametrize("angle_deg", [90, 45, 16])
def test_straight_lines_that_cross(angle_deg, points):
    length = 0.8 / np.sin(np.radians(angle_deg))
    for lines in ((LEVEL, through_middle(angle_deg, points)), (through_middle(angle_deg, points), LEVEL)):
        shared = common_stretches(lines[:1], lines[1:], 0.4)
        assert shared.length == pytest.approx([length])
        assert (shared.begin + shared.end) / 2 == pytest.approx([9.0])


@pytest.mark.parametrize(("apart", "lengths"), [(0.39, [18.0]), (0.41, [])])
def test_a_line_beside_another_that_it_never_crosses(apart, lengths):
    beside = np.linspace(-9, 9, 100)[:, None] * [1, 0] + [0, apart]
    assert common_stretches([beside], [LEVEL], 0.4).length == pytest.approx(lengths)


def test_a_line_past_the_end_of_another_is_near_it_in_a_circle_around_that_end():
    shared = common_stretches([np.array([[9.3, -2.0], [9.3, 2.0]])], [LEVEL], 0.5)
    assert shared.length == pytest.approx([2 * np.sqrt(0.5**2 - 0.3**2)])


def test_each_pair_and_each_place_has_its_stretch():
    """A line that crosses two others twice each, with a vertex given twice and a segment too long for one box."""
    rungs = [np.array([[x, -9.0], [x, 9.0]]) for x in (-3.0, 3.0)]
    turning = np.array([[-6.0, -1.0], [6, -1], [6, -1], [6, 1], [-6, 1]])
    shared = common_stretches([LEVEL + 100, turning], rungs, 0.4)
    assert shared.line.tolist() == [1] * 4
    assert shared.other.tolist() == [0, 0, 1, 1]
    assert shared.begin == pytest.approx([2.6, 22.6, 8.6, 16.6])
    assert shared.length == pytest.approx([0.8] * 4)


@pytest.mark.parametrize(("knots", "seed"), [(3, 0), (9, 1), (21, 2)])
def test_tangled_fibres_against_buffers(knots, seed):
    pad = Morphology.random(3, knots, seed)
    lines = [pad.to_mm(line) for line in flatten(pad, 1e-4)]
    shared = common_stretches(lines[:3], lines[3:], 0.4)
    assert len(shared.length) > 9
    for line in range(3):
        for other in range(3):
            near = shapely.buffer(shapely.LineString(lines[3 + other]), 0.4, quad_segs=200)
            within = shapely.intersection(shapely.LineString(lines[line]), near)
            lengths = [part.length for part in shapely.get_parts(shapely.line_merge(within))]
            ours = shared.length[(shared.line == line) & (shared.other == other)]
            assert sorted(ours) == pytest.approx(sorted(lengths), abs=2e-3)
