"""The free variables of the search, and the courses it begins with."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator

from design import Contact, Morphology
from design.criteria.rules import check_rules
from design.optimisers.gradient_search import GradientSearch
from design.optimisers.parametrization import OTHER_START, Fibres, border_of, first_course
from design.optimisers.problem import SearchProblem
from design.pad.courses.curves import refine
from design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings


@given(st.integers(1, 5), st.integers(1, 9), st.integers(0, 99))
def test_variables_of_a_pad_give_back_its_knots(grid, knots, seed):
    pad = Morphology.random(grid, knots, seed)
    back = Morphology(Fibres.through(pad.knots, pad.layout, 1e-3).knots())
    clear = (pad.knots > 0.006 * (grid + 1)) & (pad.knots < 0.994 * (grid + 1))  # others are moved off the border
    assert np.abs(back.knots - pad.knots)[clear].max(initial=0) < 1e-9
    assert np.abs(back.knots - pad.knots).max() < 0.01 * (grid + 1)


@given(st.integers(1, 20), st.integers(0, 99))
def test_more_knots_leave_the_old_ones_and_keep_near_the_curve(more, seed):
    pad = Morphology.random(3, 4, seed)
    finer = refine(pad.knots, 4 + more, pad.layout)
    assert finer.shape == (6, 6 + more, 2)
    for fibre, (old, new) in enumerate(zip(pad.knots, finer, strict=True)):
        axis = fibre // 3
        assert np.isin(old[:, axis], new[:, axis]).all()
        curve = PchipInterpolator(old[:, axis], old[:, 1 - axis])
        assert new[:, 1 - axis] == pytest.approx(curve(new[:, axis]), abs=1e-12)


@pytest.mark.parametrize("knots", [1, 2, 5, 6, 7, 20, 21, 64])
@pytest.mark.parametrize("grid", [1, 2, 4, 8])
@pytest.mark.parametrize("rules", [RulesSettings(), RulesSettings(enforce=False)])
def test_a_random_course_is_a_pad_without_crossings_in_a_family_at_its_turns(knots, grid, rules):
    pad = PadSettings(grid=grid)
    course = first_course(pad, rules, knots, None, 0, np.random.default_rng(knots))
    found = Morphology(course, pad.pitch_mm)
    assert found.knots.shape == (2 * grid, knots + 2, 2)
    other = first_course(pad, rules, knots, None, 0, np.random.default_rng(knots + 1))
    assert not np.array_equal(course, other)


def test_the_first_start_from_a_pad_is_that_pad_and_the_next_are_near_it():
    origin = Morphology.random(4, 5, seed=3)
    begin = [
        first_course(PadSettings(), RulesSettings(), 5, origin, start, np.random.default_rng(start)) for start in (0, 1)
    ]
    assert np.array_equal(begin[0], origin.knots)
    assert 0 < np.abs(begin[1] - origin.knots).max() < 1
    straight = first_course(PadSettings(), RulesSettings(), 5, Morphology.straight(4), 0, np.random.default_rng(0))
    assert 0 < np.abs(straight[:4, :, 1] - np.arange(1, 5)[:, None]).max() < 1


@pytest.mark.parametrize("gentle", [True, False])
def test_starts_have_nearly_straight_fibres_but_for_a_zigzag_or_the_other_way_round(gentle):
    """Within a tenth of a grid unit or so, and clear of the slopes without a gradient of fibres that are quite so."""
    pad, rules = PadSettings(), RulesSettings()
    courses = [first_course(pad, rules, 21, None, start, np.random.default_rng(start), gentle) for start in range(5)]
    off = [np.abs(course[:4, :, 1] - np.arange(1, 5)[:, None]) for course in courses]
    straight = [each for each in off if each.max() < 0.5]
    assert [each.max() < 0.5 for each in off] == [(start == OTHER_START) != gentle for start in range(5)]
    assert all((each[:, 1:-1] > 0).all() for each in straight)


@pytest.mark.parametrize(("contact", "gentle"), [(Contact(), True), (PUBLISHED_CONTACT, False)])
def test_starts_are_gentle_under_a_measured_contact(contact, gentle):
    problem = SearchProblem(PadSettings(), (contact,), SearchSettings(), RulesSettings())
    knots = GradientSearch(problem, 0).fibres.knots()
    assert (np.abs(knots[:4, :, 1] - np.arange(1, 5)[:, None]).max() < 0.5) == gentle


def test_a_border_wider_than_the_pad_leaves_the_knots_in_the_middle():
    rules = RulesSettings(border_mm=400)
    pad = Morphology.random(4, 5)
    knots = Fibres.through(pad.knots, pad.layout, border_of(PadSettings(), rules)).knots()
    assert "border_mm" in {violation.rule for violation in check_rules(Morphology(knots), rules)}
