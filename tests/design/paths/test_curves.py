"""The forms of a PCHIP curve (samples, values in spans, Bezier) against SciPy's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from padforge.design import Morphology, crossings, flatten
from padforge.design.contact import fibre_axes
from padforge.design.kernels.pchip import pchip_sample as sample_curve
from padforge.design.kernels.pchip import (
    sample_spans,
)
from padforge.design.paths.curves import beziers, common_stretches, crossing_angles, lengths, slope_beziers, slopes
from tests.design.wild_pads import SEEDS, wild_pads

pads = st.builds(Morphology.random, st.integers(1, 3), st.integers(0, 10), SEEDS)


def scipy_curve(pad, fibre):
    axis = 0 if fibre < pad.grid else 1
    return PchipInterpolator(pad.knots[fibre, :, axis], pad.knots[fibre, :, 1 - axis])


@given(pads)
@settings(max_examples=15)
def test_slopes_samples_and_beziers_match_scipy(pad):
    at = np.linspace(0, pad.grid + 1, 200)
    shares = np.array([0.0, 0.2, 0.7])
    along, across = (axis[0] for axis in fibre_axes(pad)[:2])
    slope = np.empty((len(along), 3 * (along.shape[1] - 1) + 1))
    points = np.empty((*slope.shape, 2))
    sample_spans(along, across, slopes(pad), shares, points, slope)
    for fibre in range(2 * pad.grid):
        curve = scipy_curve(pad, fibre)
        expected = curve(at)
        np.testing.assert_allclose(slopes(pad)[fibre], curve.derivative()(curve.x), rtol=1e-9, atol=1e-9)
        compiled = np.empty(len(at))
        sample_curve(curve.x, curve(curve.x), at[1], compiled)
        np.testing.assert_allclose(compiled, expected, atol=1e-9)
        np.testing.assert_allclose(points[fibre, :, 1], curve(points[fibre, :, 0]), atol=1e-9)
        np.testing.assert_allclose(slope[fibre], curve.derivative()(points[fibre, :, 0]), atol=1e-6)
    u = np.linspace(0, 1, 7)[:, None]
    for fibre, spans in enumerate(beziers(pad)):
        axis, curve = 0 if fibre < pad.grid else 1, scipy_curve(pad, fibre)
        for p in spans:
            points = (1 - u) ** 3 * p[0] + 3 * (1 - u) ** 2 * u * p[1] + 3 * (1 - u) * u**2 * p[2] + u**3 * p[3]
            np.testing.assert_allclose(points[:, 1 - axis], curve(points[:, axis]), atol=1e-6)


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


def test_common_stretches_of_one_line_with_two_others_stay_two() -> None:
    """One runs beside its end and the other beside its beginning, 0.5 from it: near within sqrt(1 - 0.25)."""
    line, beside = np.array([[0.0, 0.0], [10.0, 0.0]]), np.sqrt(0.75)
    others = [np.array([[8.0, 0.5], [12.0, 0.5]]), np.array([[-3.0, 0.5], [2.0, 0.5]])]
    stretches = common_stretches([line], others, 1.0)
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
    assert np.isfinite(slope_beziers(pad)).all()
    assert (lengths(pad) >= (pad.grid + 1) * (1 - 1e-9)).all()
    found = crossings(pad)
    across = [c for c in found if c.first < pad.grid <= c.second]
    grid = range(pad.grid)
    assert {(c.first, c.second) for c in across} == {(h, pad.grid + v) for h in grid for v in grid}
    places, angles = np.array([c.position for c in found]), crossing_angles(pad, across)
    assert ((places >= -1e-9) & (places <= pad.grid + 1 + 1e-9)).all()
    assert ((angles >= 0) & (angles <= 90)).all()
    assert crossings(pad, across=False) == [c for c in found if c not in across]


def test_lengths_and_crossings_match_closed_forms():
    """Each other's mirror image in the diagonal, straight along it from (0.8, 0.8) to (1.2, 1.2)."""
    pad = Morphology.random(4, 5, seed=3)
    polyline = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in flatten(pad, 1e-8)]
    np.testing.assert_allclose(lengths(pad), polyline, rtol=1e-6)
    found = crossings(Morphology.straight(2))
    assert [(c.first, c.second) for c in found] == [(0, 2), (0, 3), (1, 2), (1, 3)]
    np.testing.assert_allclose([c.position for c in found], [(1, 1), (2, 1), (1, 2), (2, 2)], atol=1e-12)
    fibre = np.array([[0, 1], [0.4, 0.4], [0.8, 0.8], [1.2, 1.2], [1.6, 1.6], [2, 1]])
    pad = Morphology(np.stack([fibre, fibre[:, ::-1]]))
    found = crossings(pad)
    np.testing.assert_allclose([c.position for c in found], [(0.4, 0.4), (1, 1), (1.6, 1.6)])
    np.testing.assert_allclose(crossing_angles(pad, found), [90, 0, 90])
