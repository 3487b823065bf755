import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly, PchipInterpolator

from padforge.design import Morphology, crossings, flatten
from padforge.design.contact import fibre_axes
from padforge.design.kernels.pchip import pchip_sample, sample_spans
from padforge.design.paths import curves
from tests.design.wild_pads import SEEDS, wild_pads

pads = st.builds(Morphology.random, st.integers(1, 3), st.integers(0, 10), SEEDS)


@given(pads)
@settings(max_examples=15)
def test_slopes_samples_and_beziers_match_scipy(pad):
    at, shares = np.linspace(0, pad.grid + 1, 200), np.array([0.0, 0.2, 0.7])
    along, across = (axis[0] for axis in fibre_axes(pad)[:2])
    slope = np.empty((len(along), 3 * (along.shape[1] - 1) + 1))
    points = np.empty((*slope.shape, 2))
    sample_spans(along, across, curves.slopes(pad), shares, points, slope)
    for fibre in range(2 * pad.grid):
        axis, compiled = pad.layout.family(fibre), np.empty(len(at))
        curve = PchipInterpolator(pad.knots[fibre, :, axis], pad.knots[fibre, :, 1 - axis])
        np.testing.assert_allclose(curves.slopes(pad)[fibre], curve.derivative()(curve.x), rtol=1e-9, atol=1e-9)
        pchip_sample(curve.x, curve(curve.x), at[1], compiled)
        np.testing.assert_allclose(compiled, curve(at), atol=1e-9)
        np.testing.assert_allclose(points[fibre, :, 1], curve(points[fibre, :, 0]), atol=1e-9)
        np.testing.assert_allclose(slope[fibre], curve.derivative()(points[fibre, :, 0]), atol=1e-6)
        for bezier in curves.beziers(pad)[fibre]:
            drawn = BPoly(bezier[:, None], [0, 1])(np.linspace(0, 1, 7))
            np.testing.assert_allclose(drawn[:, 1 - axis], curve(drawn[:, axis]), atol=1e-6)


@given(pads, st.sampled_from([1e-2, 1e-3, 1e-4]))
@settings(max_examples=15)
def test_flatten_keeps_the_tolerance(pad, tolerance):
    """Each point of a finer line is as near as that to the chord it lies beside."""
    for fibre, (coarse, fine) in enumerate(zip(flatten(pad, tolerance), flatten(pad, tolerance / 100), strict=True)):
        axis = 0 if fibre < pad.grid else 1
        chord = np.clip(np.searchsorted(coarse[:, axis], fine[:, axis]) - 1, 0, len(coarse) - 2)
        a, way = coarse[chord], coarse[chord + 1] - coarse[chord]
        along = np.clip(((fine - a) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-300), 0, 1)
        assert np.linalg.norm(fine - a - along[:, None] * way, axis=1).max() <= tolerance * 1.02


def test_tightest_bend_starts_or_ends_at_a_point() -> None:
    """By headings: 0.45 rad within 1.5, of which 0.05 before the third point; the same from the other end."""
    line, turned = np.column_stack([np.arange(5.0), np.zeros(5)]), np.array([0, 0, 0.1, 0.5, 0.5])
    ending, starting = (curves.bend_radius(sign * line[::sign], turned[::sign], 1.5) for sign in (1, -1))
    for (radius, place), sign in ((ending, 1), (starting, -1)):
        assert radius == pytest.approx(1.5 / 0.45)
        np.testing.assert_allclose(place, [sign * (2 + 0.175 / 0.4), 0])  # half of the turn lies before it


def test_common_stretches_of_one_line_with_two_others_stay_two() -> None:
    """One runs beside its end and the other beside its beginning, 0.5 from it: near within sqrt(1 - 0.25)."""
    line, beside = np.array([[0.0, 0.0], [10.0, 0.0]]), np.sqrt(0.75)
    others = [np.array([[8.0, 0.5], [12.0, 0.5]]), np.array([[-3.0, 0.5], [2.0, 0.5]])]
    stretches = curves.common_stretches([line], others, 1.0)
    assert (stretches.line.tolist(), stretches.other.tolist()) == ([0, 0], [0, 1])
    np.testing.assert_allclose(stretches.begin, [8 - beside, 0])
    np.testing.assert_allclose(stretches.end, [10, 2 + beside])


@pytest.mark.parametrize(("name", "all_", "family"), [("5para_dis", 30, 6), ("20para", 672, 124)])
def test_crossings_of_the_published_pads(published, name, all_, family):
    """Counts measured independently with a B-Rep kernel's intersection of exact Beziers."""
    found = crossings(Morphology.load(published / f"{name}.mat"))
    assert len(found) == all_
    assert sum((c.first < 4) == (c.second < 4) for c in found) == family


@given(wild_pads((1, 3), (0, 12)))
@settings(max_examples=20)
def test_families_of_wild_pads_cross(pad):
    assert np.isfinite(curves.slope_beziers(pad)).all()
    assert (curves.lengths(pad) >= (pad.grid + 1) * (1 - 1e-9)).all()
    found = crossings(pad)
    across = [c for c in found if c.first < pad.grid <= c.second]
    grid = range(pad.grid)
    assert {(c.first, c.second) for c in across} == {(h, pad.grid + v) for h in grid for v in grid}
    places, angles = np.array([c.position for c in found]), curves.crossing_angles(pad, across)
    assert ((places >= -1e-9) & (places <= pad.grid + 1 + 1e-9)).all()
    assert ((angles >= 0) & (angles <= 90)).all()
    assert crossings(pad, across=False) == [c for c in found if c not in across]


def test_lengths_and_crossings_match_closed_forms():
    """Each other's mirror image in the diagonal, straight along it from (0.8, 0.8) to (1.2, 1.2)."""
    pad = Morphology.random(4, 5, seed=3)
    polyline = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in flatten(pad, 1e-8)]
    np.testing.assert_allclose(curves.lengths(pad), polyline, rtol=1e-6)
    found = crossings(Morphology.straight(2))
    assert [(c.first, c.second) for c in found] == [(0, 2), (0, 3), (1, 2), (1, 3)]
    np.testing.assert_allclose([c.position for c in found], [(1, 1), (2, 1), (1, 2), (2, 2)], atol=1e-12)
    fibre = np.array([[0, 1], [0.4, 0.4], [0.8, 0.8], [1.2, 1.2], [1.6, 1.6], [2, 1]])
    pad = Morphology(np.stack([fibre, fibre[:, ::-1]]))
    found = crossings(pad)
    np.testing.assert_allclose([c.position for c in found], [(0.4, 0.4), (1, 1), (1.6, 1.6)])
    np.testing.assert_allclose(curves.crossing_angles(pad, found), [90, 0, 90])


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
    assert curves.bend_radius(points, headings, quarters / 4)[0] == pytest.approx(window / most if most else np.inf)


def folds_tried(line, gap, step):
    """Least distance of points `step` apart along a polyline that lie at least `FOLD` gaps apart."""
    arc = arc_of(line)
    at = np.unique(np.concatenate([np.arange(0, arc[-1], step), arc]))
    points = np.column_stack([np.interp(at, arc, axis) for axis in line.T])
    least = np.inf
    for first, start in enumerate(np.searchsorted(at, at + curves.FOLD * gap)):
        least = min(least, np.linalg.norm(points[start:] - points[first], axis=1).min(initial=np.inf))
    return least


@given(SEEDS, st.integers(1, 12), st.sampled_from([0.1, 0.4]))
@settings(max_examples=6)
def test_fold_gap_matches_exhaustive_pairs(seed, knots, gap):
    pad = Morphology.random(1, knots, seed)
    line = flatten(pad, 1e-3)[0]
    found, tried = curves.fold_gap(line, gap), folds_tried(line, gap, gap / 20)
    least, most = (gap, np.inf) if found is None else (found[0], found[0] + gap / 20)  # at most a step is missed
    assert least - 1e-9 <= tried <= most


def test_fold_gap_of_corners_is_their_opening():
    half = np.radians(20)
    line = 3 * np.array([[-np.sin(half), -np.cos(half)], [0, 0], [np.sin(half), -np.cos(half)]])
    found = curves.fold_gap(line, 0.8)
    assert found is not None
    assert found[0] == pytest.approx(curves.FOLD * 0.8 * np.sin(half))
    assert found[1] == pytest.approx((0, -curves.FOLD * 0.4 * np.cos(half)))
    for turn, folds in ((curves.UNFOLDED - 1e-6, False), (curves.UNFOLDED + 1e-6, True)):
        line = np.array([[-np.cos(turn / 2), -np.sin(turn / 2)], [0, 0], [np.cos(turn / 2), -np.sin(turn / 2)]])
        assert (curves.fold_gap(line, 0.5) is not None) == folds


@pytest.mark.parametrize(("knots", "seed"), [(3, 0), (9, 1)])
def test_common_stretches_of_tangled_fibres_match_buffers(knots, seed):
    pad = Morphology.random(3, knots, seed)
    lines = [pad.to_mm(line) for line in flatten(pad, 1e-4)]
    shared = curves.common_stretches(lines[:3], lines[3:], 0.4)
    assert len(shared.length) > 9
    for line in range(3):
        for other in range(3):
            near = shapely.buffer(shapely.LineString(lines[3 + other]), 0.4, quad_segs=200)
            within = shapely.intersection(shapely.LineString(lines[line]), near)
            lengths = [part.length for part in shapely.get_parts(shapely.line_merge(within))]
            ours = shared.length[(shared.line == line) & (shared.other == other)]
            assert sorted(ours) == pytest.approx(sorted(lengths), abs=2e-3)
