"""Exact rule checks on geometry whose answer is known."""

import numpy as np
import pytest

from design import Morphology
from design.rules import bend_radius, check
from design.settings import Rules

NONE = Rules(min_bend_radius_mm=0, min_gap_mm=0, same_family_crossings=10**6, border_mm=0, max_length_mm=1e6)


def only(**limits):
    return NONE.model_copy(update=limits)


@pytest.mark.parametrize("radius", [0.5, 2.0, 10.0])
def test_an_arc_has_its_own_radius(radius):
    angle = np.linspace(0, 1.5, 4000)
    arc = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    assert bend_radius(arc, window_mm=radius / 2)[0] == pytest.approx(radius, rel=5e-3)


def test_a_corner_is_found_where_it_is():
    line = np.array([[0, 0], [5, 0], [5, 5.0]])
    radius, vertex = bend_radius(line, window_mm=1.0)
    assert radius == pytest.approx(1 / (np.pi / 2))
    assert vertex == 1


def test_a_straight_line_does_not_bend():
    assert bend_radius(np.array([[0, 0], [1, 0], [2, 0.0]]), 1.0)[0] == np.inf


def test_the_straight_grid_breaks_nothing():
    assert check(Morphology.straight(4), Rules()) == []


def bent(cross, travel=2.5, fibre=0):
    """A 4 x 4 grid with one knot of one fibre moved."""
    knots = np.repeat(Morphology.straight(4).knots, [1] * 8, axis=0)
    middle = knots.mean(axis=1, keepdims=True)
    knots = np.concatenate([knots[:, :1], middle, knots[:, 1:]], axis=1)
    knots[fibre, 1] = (travel, cross) if fibre < 4 else (cross, travel)
    return Morphology(knots)


def test_fibres_too_close_are_named_with_their_gap():
    found = check(bent(1.95), only(min_gap_mm=0.8))
    assert [v.fibres for v in found] == [(1, 2)]
    assert found[0].measured == pytest.approx(0.05 * 11.25, abs=1e-3)
    assert found[0].place_mm == pytest.approx((0, (1.975 - 2.5) * 11.25), abs=0.3)


def test_a_crossing_within_a_family_is_counted_at_its_places():
    found = check(bent(2.5), only(same_family_crossings=0))
    assert len(found) == 2
    assert {v.fibres for v in found} == {(1, 2)}
    assert check(bent(2.5), only(same_family_crossings=2)) == []


def test_a_fibre_at_the_border_is_found():
    found = check(bent(0.05, fibre=4), only(border_mm=2.0))
    assert [v.fibres for v in found] == [(5,)]
    assert found[0].measured == pytest.approx(0.05 * 11.25, abs=1e-3)


def test_a_long_fibre_is_found():
    found = check(bent(3.0), only(max_length_mm=5 * 11.25 + 0.1))
    assert [(v.rule, v.fibres) for v in found] == [("max_length_mm", (1,))]


def test_a_sharp_bend_is_found_and_a_gentle_one_passes():
    knots = np.array([[0, 1], [0.9, 1], [1.0, 1.9], [2, 1.0]])
    straight = np.array([[1, 0], [1, 0.5], [1, 1.0], [1, 2.0]])
    sharp = Morphology(np.stack([knots, straight]))
    found = check(sharp, only(min_bend_radius_mm=1.0))
    assert [v.fibres for v in found] == [(1,)]
    assert check(bent(1.3), only(min_bend_radius_mm=1.0)) == []


def test_a_finding_reads_as_one_line():
    text = str(check(bent(1.95), only(min_gap_mm=0.8))[0])
    assert text.startswith("min_gap_mm: fibre 1 and fibre 2 at (0.0, -5.9) mm: 0.56")
    assert "\n" not in text
