import numpy as np
import pytest

from padforge.design import Morphology, PadSettings, RulesSettings, check_rules, crossings
from padforge.design.contact import fibre_axes
from padforge.design.objectives.penalties import penalties
from padforge.design.paths.curves import slopes
from tests.design.objectives.pads import bent, climbing, only, swung


def test_check_rules_of_the_straight_grid_at_its_limits():
    """A straight grid: gaps and borders of one pitch, fibres of five, 16 crossings at right angles."""
    grid, hair = Morphology.straight(4, 10.0), 1e-6
    assert check_rules(Morphology.straight(4), RulesSettings()) == []
    for met, broken, count in (
        ({"min_gap_mm": 10.0}, {"min_gap_mm": 10.0 + hair}, 6),
        ({"border_mm": 10.0 - hair}, {"border_mm": 10.0 + hair}, 4),
        ({"max_length_mm": 50.0 + hair}, {"max_length_mm": 50.0 - hair}, 8),
        ({"max_crossings": 16}, {"max_crossings": 15}, 1),
    ):
        assert check_rules(grid, only(**met)) == []
        assert len(check_rules(grid, only(**broken))) == count


@pytest.mark.parametrize(("rise", "breaks"), [(0.145, False), (0.155, True)])
def test_min_mean_bend_radius_passes_kinks_up_to_half_a_radian(rise, breaks):
    """Two straight branches that meet in a peak within 1e-7 of it, where the PCHIP's slope overshoots by a third."""
    at = np.array([0, 0.5, 1 - 1e-7, 1, 1 + 1e-7, 1.5, 2])
    roof = np.column_stack([at, 1 + rise * (1 - np.abs(at - 1))])
    turn = 2 * (2 * np.arctan(4 / 3 * rise) - np.arctan(rise))
    pad = Morphology(np.stack([roof, np.column_stack([np.ones(7), at])]))
    found = check_rules(pad, only(min_mean_bend_radius_mm=3.0))
    assert (turn > 0.5) == breaks
    assert [v.measured for v in found] == ([pytest.approx(1.5 / turn, rel=1e-3)] if breaks else [])
    assert all(v.place_mm == pytest.approx((0, rise * 11.25), abs=1.6) for v in found)


def test_max_common_track_with_and_without_a_crossing():
    """Half-way up between two turning points a PCHIP is half as steep again as its chord."""
    flat = [[1, 0], [0.5, 0.88], [1.5, 1.12], [1, 2]]
    pad, sine = Morphology(np.array([[[0, 1], [0.5, 1], [1.5, 1], [2, 1]], flat])), np.sin(np.arctan(2 * 0.12 / 1.5))
    (found,) = check_rules(pad, only(max_common_track_mm=2.0))
    assert (found.rule, found.fibres, found.limit) == ("max_common_track_mm", (1, 2), 2.0)
    assert found.measured == pytest.approx(0.8 / sine, rel=0.05)
    assert found.place_mm == pytest.approx((0, 0), abs=1e-2)
    assert check_rules(pad, only(max_common_track_mm=found.measured + 1e-3)) == []
    assert check_rules(pad, only(max_common_track_mm=None)) == []
    assert check_rules(Morphology.straight(4), only(max_common_track_mm=1.0)) == []
    horizontal = [[0, 1], [0.3, 0.3], [0.4, 0.4], [0.7, 0.7], [0.9, 0.9], [1.5, 1.3], [2, 1]]
    vertical = [[1, 0], [0.34, 0.31], [0.43, 0.4], [0.73, 0.7], [0.93, 0.9], [1.6, 1.0], [1, 2]]
    pad = Morphology(np.array([horizontal, vertical]))
    (found,) = check_rules(pad, only(max_common_track_mm=2.0))
    assert found.measured > 5
    place = np.array(found.place_mm)
    assert min(np.hypot(*(pad.to_mm(c.position) - place)) for c in crossings(pad)) > found.measured / 2


def test_crossings_are_placed_and_measured():
    found = check_rules(bent(2.5), only(same_family_crossings=0))
    assert [v.fibres for v in found] == [(1, 2)] * 2
    assert check_rules(bent(2.5), only(same_family_crossings=2)) == []
    (found,) = check_rules(swung(), only(min_crossing_angle_deg=40))
    assert (found.rule, found.fibres) == ("min_crossing_angle_deg", (1, 2))
    assert found.measured == pytest.approx(np.degrees(np.arctan(1 / 1.5)), abs=1e-6)
    assert found.place_mm == pytest.approx((0, 0), abs=1e-3)
    assert check_rules(swung(), only(min_crossing_angle_deg=33)) == []


@pytest.mark.parametrize("fibre", [0, 6])
def test_min_gap_numbers_and_places_fibres_of_both_families(fibre):
    level = fibre % 4 + 1
    (found,) = check_rules(bent(level + 0.95, fibre=fibre), only(min_gap_mm=0.8))
    assert (found.rule, found.fibres) == ("min_gap_mm", (fibre + 1, fibre + 2))
    assert found.measured == pytest.approx(0.05 * 11.25, abs=1e-3)
    across_mm = (level + 0.975 - 2.5) * 11.25
    assert found.place_mm == pytest.approx((0, across_mm) if fibre < 4 else (across_mm, 0), abs=0.3)


@pytest.mark.parametrize(("fibre", "cross"), [(0, 0.1), (3, 4.9), (4, 0.1), (7, 4.9)])
def test_border_of_every_side(fibre, cross):
    (found,) = check_rules(bent(cross, fibre=fibre), only(border_mm=2.0))
    assert (found.fibres, found.measured) == ((fibre + 1,), pytest.approx(0.1 * 11.25, abs=1e-3))
    across_mm = (cross - 2.5) * 11.25
    assert found.place_mm == pytest.approx((0, across_mm) if fibre < 4 else (across_mm, 0), abs=0.05)


@pytest.mark.parametrize(("rise", "breaks"), [(0.5, False), (0.6, True)])
@pytest.mark.parametrize(("family", "end"), [(0, 0), (1, -1)])
def test_min_mean_bend_radius_passes_lead_kinks_up_to_half_a_radian(rise, breaks, family, end):
    """Of the check and of the penalty; leads go straight on along the fibre's axis."""
    pad, rules = climbing(rise, family, end), only(min_mean_bend_radius_mm=1.0)
    angle = np.arctan(slopes(pad)[family, end])
    assert (abs(angle) > 0.5) == breaks
    along, across = (axis[0] for axis in fibre_axes(pad)[:2])
    assert (penalties(along, across, PadSettings(grid=1), rules).values["min_mean_bend_radius_mm"] > 0) == breaks
    found = check_rules(pad, rules)
    assert [v.fibres for v in found] == ([(family + 1,)] if breaks else [])
    if breaks:
        assert found[0].measured == pytest.approx(0.5 / abs(angle), rel=0.02)
        assert np.abs(found[0].place_mm or 0).max() == pytest.approx(11.25, abs=0.3)
