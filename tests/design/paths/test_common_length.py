"""How far lines run along each other, on lines whose answer is known and against shapely's buffers."""

import numpy as np
import pytest
import shapely

from padforge.design.morphology import Morphology
from padforge.design.paths.curves import common_stretches, flatten

LEVEL = np.array([[-9.0, 0.0], [9.0, 0.0]])


def test_common_stretches_are_separate_by_pair_and_position():
    """A line that crosses two others twice each, with a vertex given twice and a segment too long for one box."""
    rungs = [np.array([[x, -9.0], [x, 9.0]]) for x in (-3.0, 3.0)]
    turning = np.array([[-6.0, -1.0], [6, -1], [6, -1], [6, 1], [-6, 1]])
    shared = common_stretches([LEVEL + 100, turning], rungs, 0.4)
    assert shared.line.tolist() == [1] * 4
    assert shared.other.tolist() == [0, 0, 1, 1]
    assert shared.begin == pytest.approx([2.6, 22.6, 8.6, 16.6])
    assert shared.length == pytest.approx([0.8] * 4)
    for apart, lengths in ((0.39, [18.0]), (0.41, [])):
        beside = np.linspace(-9, 9, 100)[:, None] * [1, 0] + [0, apart]
        assert common_stretches([beside], [LEVEL], 0.4).length == pytest.approx(lengths)
    shared = common_stretches([np.array([[9.3, -2.0], [9.3, 2.0]])], [LEVEL], 0.5)
    assert shared.length == pytest.approx([2 * np.sqrt(0.5**2 - 0.3**2)])


@pytest.mark.parametrize(("knots", "seed"), [(3, 0), (9, 1), (21, 2)])
def test_common_stretches_of_tangled_fibres_match_buffers(knots, seed):
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
