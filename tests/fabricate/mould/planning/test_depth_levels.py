import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from design.common.errors import InputError
from design.pad.courses.curves import Crossing
from design.pad.morphology import Morphology
from fabricate.mould.plan import COVER_MM, Plan
from fabricate.mould.planning.depth_levels import fibre_levels
from tests.fabricate.planted import level_pad, with_settings


def test_two_levels_are_enough_without_crossings_in_a_family():
    assert fibre_levels((3, 3), [], deep_horizontal=True) == (1, 1, 1, 0, 0, 0)
    assert fibre_levels((3, 3), [], deep_horizontal=False) == (0, 0, 0, 1, 1, 1)


@given(st.integers(1, 6), st.data())
def test_fibres_that_cross_never_share_a_level(grid, data):
    fibres = [*itertools.combinations(range(grid), 2), *itertools.combinations(range(grid, 2 * grid), 2)]
    pairs = data.draw(st.lists(st.sampled_from(fibres), max_size=12)) if fibres else []
    deep = data.draw(st.booleans())
    levels = fibre_levels((grid, grid), [Crossing(i, j, (0.0, 0.0)) for i, j in pairs], deep)
    assert all(levels[i] != levels[j] for i, j in pairs)
    horizontal, vertical = levels[:grid], levels[grid:]
    assert min(horizontal if deep else vertical) > max(vertical if deep else horizontal)
    assert set(levels) == set(range(max(levels) + 1))


def test_a_star_of_crossings_needs_one_level_more():
    star = [Crossing(0, other, (0.0, 0.0)) for other in range(1, 5)]
    assert max(fibre_levels((5, 5), star, deep_horizontal=True)) == 2


def test_crossing_fibres_of_a_family_lie_a_step_apart():
    plan = Plan(level_pad(1.8, 1.2))
    assert plan.heights_mm == (0.4, 1.2, 2.0)
    assert plan.levels[0] != plan.levels[1]
    assert plan.silicone_mm == 6.0


def test_the_pad_is_thickened_for_many_levels():
    plan = Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 2.5}))
    assert plan.silicone_mm == 2.0 + COVER_MM
    assert Plan(Morphology.straight(2), with_settings({"silicone_mm": 1.5})).silicone_mm == 1.5


def test_two_levels_only_refuse_a_family_that_crosses_itself():
    settings = with_settings({"levels": "two"})
    plan = Plan(level_pad(1.8, 1.2), settings)
    with pytest.raises(
        InputError, match=r'levels: got "two".*2 crossings: fibres 1 x 2 at \(-\d+\.\d, -?0\.0\)'
    ) as refusal:
        plan.require_levels()
    assert "\n" not in str(refusal.value)
    assert plan.heights_mm == (0.4, 1.2)
    Plan(Morphology.straight(3), settings).require_levels()


def test_published_pads_take_as_many_levels_as_their_crossings_need(published):
    for name, least in (("1para", 2), ("5para_dis", 3), ("20para", 8)):
        plan = Plan(Morphology.load(published / f"{name}.mat"))
        assert len(plan.heights_mm) >= least
        assert all(plan.levels[c.first] != plan.levels[c.second] for c in plan.crossings)
        assert np.diff(plan.heights_mm) == pytest.approx(0.8)
