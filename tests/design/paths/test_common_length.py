"""How far lines run along each other, on lines whose answer is known and against shapely's buffers."""

import pytest
import shapely

from padforge.design.morphology import Morphology
from padforge.design.paths.curves import common_stretches, flatten


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
