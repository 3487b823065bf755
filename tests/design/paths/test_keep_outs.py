import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design import Morphology, check_rules
from padforge.design.contact import fibre_axes
from padforge.design.objectives.penalties import penalties
from padforge.design.paths.curves import bend_radius, rolled_turns
from padforge.design.paths.keep_outs import is_outside, keep_outs, pass_keep_outs, straight_paths
from padforge.design.settings import Layout, PadSettings, RulesSettings
from tests.design.objectives.pads import only, square


def kept_off(*polygons, counts=(3, 6), pitch_mm=(8.0, 15.0)):
    return PadSettings(keep_out_mm=polygons, **Layout.create(counts, pitch_mm).settings)


def penalty(pad, size, cross=None, clearance=3.0):
    travel, own = (axis[0] for axis in fibre_axes(pad)[:2])
    rules = only(keep_out_mm=clearance, max_common_track_mm=None)
    return penalties(travel, own if cross is None else cross, size, rules)


def test_keep_out_penalty_vanishes_with_clearance_and_has_its_gradient():
    size = kept_off(square(2.0, 6.0, 9.0))
    straight = Morphology.straight(size.layout)
    assert penalty(straight, size, clearance=1.0).values["keep_out_mm"] > 0
    assert penalty(straight, kept_off(square(0.0, 7.0, 1.8))).values["keep_out_mm"] == 0
    pad, rng = Morphology.random(size.layout, 4, seed=3), np.random.default_rng(0)
    cross = fibre_axes(pad)[1][0]
    step = 1e-6 * rng.standard_normal(cross.shape)
    step[:, [0, -1]] = 0
    ahead, behind = (sum(penalty(pad, size, cross + sign * step).values.values()) for sign in (1, -1))
    assert penalty(pad, size).values["keep_out_mm"] > 0.01
    assert (ahead - behind) / 2 == pytest.approx((penalty(pad, size).grad_across * step).sum(), rel=1e-3)


@given(st.integers(0, 99), st.floats(-8, 8), st.floats(-8, 8), st.sampled_from([6.0, 25.0]))
@settings(max_examples=12)
def test_pass_keep_outs_keeps_the_order_of_fibres(seed, x, y, side):
    size, rng = kept_off(square(x, y, side), square(-x, 2.0, 3.0)), np.random.default_rng(seed)
    course = straight_paths(PadSettings().for_layout(size.layout), RulesSettings(), 12)
    lifts = 0.3 * rng.standard_normal(12)
    course[:3, 1:-1, 1] += lifts
    course[3:, 1:-1, 0] += lifts
    found = pass_keep_outs(course, size, RulesSettings())
    assert (np.diff(found[:3, :, 1], axis=0) > 0).all()
    assert (np.diff(found[3:, :, 0], axis=0) > 0).all()
    np.testing.assert_array_equal(pass_keep_outs(course, size, RulesSettings(enforce=False)), course)


def test_bend_radius_on_a_cylinder_matches_curves_in_space():
    """A line at the angle a to x on a cylinder of radius R is a helix of radius R / cos(a)^2.

    At the top of an arc, which runs along x there, the curvature is the root of 1 / r^2 + 1 / R^2.
    """
    for angle, expected in ((0.0, 5.0), (np.pi / 4, 10.0), (np.pi / 3, 20.0), (np.pi / 2, np.inf)):
        line = np.linspace(0, 30, 61)[:, None] * [np.cos(angle), np.sin(angle)]
        headings = np.full(61, angle)
        radius = bend_radius(line, headings, 2.0, rolled_turns(line, headings, 5.0))[0]
        assert radius == pytest.approx(expected) if angle < 1.5 else radius > 1e15
    r, cylinder, window = 6.0, 8.0, 0.2
    angle = np.linspace(-0.3, 0.3, 4001)
    points = r * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    found, place = bend_radius(points, angle, window, rolled_turns(points, angle, cylinder))
    assert found == pytest.approx(1 / np.hypot(1 / r, 1 / cylinder), rel=1e-3)
    assert place == pytest.approx((0, 0), abs=0.05)
    rules, pad = only(min_mean_bend_radius_mm=10.0), Morphology.straight(Layout.create((3, 2), (8.0, 15.0)))
    assert check_rules(pad, rules, PadSettings(bent_radius_mm=10.5)) == []
    broken = check_rules(pad, rules, PadSettings(bent_radius_mm=9.0))
    assert [(v.fibres, v.measured) for v in broken] == [((fibre,), pytest.approx(9)) for fibre in (1, 2, 3)]


def test_fibres_are_back_at_their_levels_after_a_keep_out_by_the_wall():
    """Beside the wall there is less room to turn aside than behind the keep-out to turn back."""
    size = kept_off(square(-18.0, 4.0, 10.0), counts=(2, 6))
    paths = straight_paths(size, RulesSettings(), 4)[:2]
    along, across = paths[:, 1:-1, 0], paths[:, 1:-1, 1]
    assert (along[:, 1] - along[:, 0] < along[:, 3] - along[:, 2]).all()
    np.testing.assert_allclose(across[:, [0, 3]], size.layout.levels[:2, None] * [1, 1], atol=1e-3)
    assert np.abs(across[:, 1:3] - size.layout.levels[:2, None]).max() > 0.2


def test_fibres_and_presses_keep_clear_of_the_head_of_a_screw():
    size, rules = kept_off((2.0, 1.0, 3.0, 8.0)), RulesSettings()
    assert {v.rule for v in check_rules(Morphology.straight(size.layout), rules, size)} == {"keep_out_mm"}
    pad = Morphology.from_layout(straight_paths(size, rules, 21), size.layout)
    assert check_rules(pad, rules, size) == []
    angles = np.linspace(0, 2 * np.pi, 50)[:, None]
    for radius_mm, outside in ((4.02, True), (3.98, False)):
        ring_mm = np.array([2.0, 1.0]) + radius_mm * np.hstack([np.cos(angles), np.sin(angles)])
        assert (is_outside(pad.to_grid(ring_mm), size) == outside).all()


def test_keep_out_distances_and_free_presses_are_exact():
    """Horizontals of this pad run at y = -15, 0 and 15 mm, verticals 8 mm apart from x = -20 mm."""
    size = kept_off(square(1.0, 7.0, 4.0))
    found = check_rules(Morphology.straight(size.layout), only(keep_out_mm=5.9), size)
    # edges at y = 5 and 9, x = -1 and 3; verticals at -4 and 4
    assert {v.fibres: v.measured for v in found} == pytest.approx({(2,): 5.0, (6,): 3.0, (7,): 1.0})
    assert {v.rule for v in found} == {"keep_out_mm"}
    assert {v.fibres: v.place_mm for v in found}[7,] == pytest.approx((4, 7), abs=2.1)
    size = kept_off(square(-10.0, 0.0, 4.0))  # one runs through it and one touches it
    found = {v.fibres: v for v in check_rules(Morphology.straight(size.layout), only(keep_out_mm=0.0), size)}
    assert {fibres: v.measured for fibres, v in found.items()} == {(2,): 0, (5,): 0}
    assert found[2,].place_mm == pytest.approx((-10, 0))
    assert not check_rules(Morphology.straight(size.layout), only(keep_out_mm=0.0), kept_off(square(-8.0, 7.0, 6.0)))
    size = kept_off(square(0.0, 0.0, 16.0), ((-20.0, -20.0), (-10.0, -20.0), (-15.0, -10.0)))
    places = np.random.default_rng(0).uniform(0, size.layout.extent, (500, 2))
    free, mm = is_outside(places, size), Morphology.straight(size.layout).to_mm(places)
    assert not free[(np.abs(mm) < 8).all(axis=1)].any()
    assert free[(mm[:, 0] > 8.1)].all()
    assert sum(polygon.area for polygon in keep_outs(size)) * size.layout.unit_mm**2 == pytest.approx(16**2 + 50)
