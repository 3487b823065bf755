"""Bends, folds and common stretches against closed forms and slow oracles."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Morphology, flatten
from padforge.design.paths.curves import (
    FOLD,
    UNFOLDED,
    bend_radius,
    common_stretches,
    fold_gap,
)
from tests.design.wild_pads import SEEDS

AXES = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def arc_of(points):
    return np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())


@given(st.lists(st.tuples(st.integers(1, 5), st.integers(0, 2)), min_size=1, max_size=20), st.integers(1, 12))
@settings(max_examples=15)
def test_bend_radius_includes_corners_at_window_ends(steps, quarters):
    """On quarter steps, whose lengths add without rounding, corners lie exactly a window apart again and again."""
    lengths, ways = np.array(steps).T
    corners = np.vstack([np.zeros(2), np.cumsum(AXES[ways] * lengths[:, None] / 4, axis=0)])
    points = np.repeat(corners, 2, axis=0)[1:-1]
    headings = np.repeat(np.array([0, 1, -1])[ways] * np.pi / 2, 2)
    arc = arc_of(corners)
    window = min(quarters / 4, arc[-1])
    turns = np.abs(np.diff(headings[::2]))
    most = max(turns[(arc[1:-1] >= start) & (arc[1:-1] <= start + window)].sum() for start in [*arc, *(arc - window)])
    assert bend_radius(points, headings, quarters / 4)[0] == pytest.approx(window / most if most else np.inf)


def folds_tried(line, gap, step):
    """Least distance of points `step` apart along a polyline that lie at least `FOLD` gaps apart."""
    arc = arc_of(line)
    at = np.unique(np.concatenate([np.arange(0, arc[-1], step), arc]))
    points = np.column_stack([np.interp(at, arc, axis) for axis in line.T])
    least = np.inf
    for first, start in enumerate(np.searchsorted(at, at + FOLD * gap)):
        least = min(least, np.linalg.norm(points[start:] - points[first], axis=1).min(initial=np.inf))
    return least


@given(SEEDS, st.integers(1, 12), st.sampled_from([0.1, 0.4]))
@settings(max_examples=6)
def test_fold_gap_matches_exhaustive_pairs(seed, knots, gap):
    pad = Morphology.random(1, knots, seed)
    line = flatten(pad, 1e-3)[0]
    found, tried = fold_gap(line, gap), folds_tried(line, gap, gap / 20)
    least, most = (gap, np.inf) if found is None else (found[0], found[0] + gap / 20)  # at most a step is missed
    assert least - 1e-9 <= tried <= most


def test_fold_gap_of_corners_is_their_opening():
    half = np.radians(20)
    line = 3 * np.array([[-np.sin(half), -np.cos(half)], [0, 0], [np.sin(half), -np.cos(half)]])
    found = fold_gap(line, 0.8)
    assert found is not None
    assert found[0] == pytest.approx(FOLD * 0.8 * np.sin(half))
    assert found[1] == pytest.approx((0, -FOLD * 0.4 * np.cos(half)))
    for turn, folds in ((UNFOLDED - 1e-6, False), (UNFOLDED + 1e-6, True)):
        line = np.array([[-np.cos(turn / 2), -np.sin(turn / 2)], [0, 0], [np.cos(turn / 2), -np.sin(turn / 2)]])
        assert (fold_gap(line, 0.5) is not None) == folds


@pytest.mark.parametrize(("knots", "seed"), [(3, 0), (9, 1)])
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
