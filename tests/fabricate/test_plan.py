from itertools import combinations, permutations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from padforge.common.settings import Spec
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import Crossing
from padforge.design.settings import FIBRE_MM, read_contact
from padforge.fabricate.mould import mould_body
from padforge.fabricate.plan import COVER_MM, Plan, assign_layers, draw_number
from padforge.sense.rig.config import RobotFrame
from padforge.sense.settings import RigSettings
from tests.fabricate.planted import exact_fibre, level_pad, with_settings


@pytest.mark.parametrize("tolerance_mm", [0.05, pytest.param(0.002, marks=pytest.mark.slow)])
def test_ridges_follow_the_curves_within_the_tolerance(tolerance_mm):
    pad = Morphology.random(3, 5, seed=1)
    plan = Plan(pad, with_settings({"tolerance_mm": tolerance_mm}))
    exact = [exact_fibre(pad, fibre, 0.02) for fibre in range(len(pad.knots))]
    for line, curve in zip(plan.lines, exact, strict=True):
        assert shapely.distance(shapely.points(curve), line).max() < tolerance_mm / 4
    for level, ridge in enumerate(plan.ridges):
        own = [shapely.LineString(curve) for curve, at in zip(exact, plan.layer_indices, strict=True) if at == level]
        curves, inside = shapely.union_all(own), plan.cavity.buffer(-0.5)  # clear of the ends, which go on straight
        assert ridge.intersection(inside).within(curves.buffer(0.2 + tolerance_mm, quad_segs=16))
        assert curves.buffer(0.2 - tolerance_mm, quad_segs=16).intersection(inside).within(ridge)


@pytest.mark.parametrize("leads", ["edges", "one side"])
def test_shrinkage_compensated_plan_shrinks_to_the_pad(leads):
    settings = with_settings({"border_mm": 1.0}, pad={"leads": leads}, silicone={"shrinkage": 0.03})
    plan = Plan(Morphology.random(3, 4, seed=2), settings)
    mould = plan.shrinkage_compensated
    assert np.array(mould.cavity.bounds) * 0.97 == pytest.approx(plan.cavity.bounds, rel=1e-12)
    assert mould.lengths_mm * 0.97 == pytest.approx(plan.lengths_mm)
    for larger, slot in zip(mould.exits, plan.exits, strict=True):
        assert np.array(larger.bounds) * 0.97 == pytest.approx(slot.bounds, rel=1e-12)
    for fibre, larger in enumerate(mould.lines):
        shrunk = shapely.transform(larger, lambda places: 0.97 * places)
        assert shapely.distance(shapely.points(exact_fibre(plan.pad, fibre, 0.02)), shrunk).max() < 0.0025
    assert mould.heights_mm[:2] == (0.4, 1.2)  # 0.412 and 1.237 mm in whole layers
    assert plan.depths_mm == pytest.approx([0.97 * height for height in mould.heights_mm], rel=1e-8)
    assert plan.thickness_mm == pytest.approx(0.97 * mould.silicone_mm) == pytest.approx(0.97 * 6.2)
    assert mould.shrinkage_compensated is mould
    assert (mould.depths_mm, mould.thickness_mm) == (mould.heights_mm, mould.silicone_mm)


@settings(max_examples=25)
@given(st.integers(1, 6), st.data())
def test_assign_layers_separates_crossing_fibres(grid, data):
    fibres = [*combinations(range(grid), 2), *combinations(range(grid, 2 * grid), 2)]
    pairs = data.draw(st.lists(st.sampled_from(fibres), max_size=12)) if fibres else []
    deep = data.draw(st.booleans())
    levels = assign_layers((grid, grid), [Crossing(i, j, (0.0, 0.0)) for i, j in pairs], deep)
    assert all(levels[i] != levels[j] for i, j in pairs)
    horizontal, vertical = levels[:grid], levels[grid:]
    assert min(horizontal if deep else vertical) > max(vertical if deep else horizontal)
    assert set(levels) == set(range(max(levels) + 1))


def test_layers_are_a_step_apart_thicken_the_pad_and_have_common_tracks_where_fibres_cross():
    plan = Plan(Morphology.random(3, 3, seed=3))
    levels = plan.layer_indices
    assert max(levels) >= 2
    crossing = {tuple(sorted((c.first, c.second), key=lambda fibre: levels[fibre])) for c in plan.crossings}
    assert any(levels[deep] - levels[shallow] > 1 for shallow, deep in crossing)
    assert {(each.shallow, each.deep) for each in plan.common_tracks} >= crossing
    plan = Plan(level_pad(1.8, 1.2))
    assert plan.heights_mm == (0.4, 1.2, 2.0)
    assert plan.layer_indices[0] != plan.layer_indices[1]
    assert plan.silicone_mm == 6.0
    assert Plan(level_pad(1.8, 1.2), with_settings({"silicone_mm": 2.5})).silicone_mm == 2.0 + COVER_MM
    assert Plan(Morphology.straight(2), with_settings({"silicone_mm": 1.5})).silicone_mm == 1.5
    assert Plan(Morphology.straight(2)).layer_indices == (1, 1, 0, 0)
    assert Plan(Morphology.straight(2), with_settings(pad={"deep_family": "vertical"})).layer_indices == (0, 0, 1, 1)


@pytest.mark.parametrize("deep", ["horizontal", "vertical"])
@pytest.mark.parametrize("fibres", [(1, 0), (2, 3)])
def test_every_family_is_laid_at_the_depth_that_it_is_designed_for(fibres, deep):
    pad, settings = Morphology.straight(fibres), with_settings(pad={"deep_family": deep})
    plan = Plan(pad, settings)
    depths_mm = [plan.depths_mm[layer] - FIBRE_MM / 2 for layer in plan.layer_indices]
    contact = read_contact(Spec({"pad": {"deep_family": deep}}))
    assert depths_mm == pytest.approx(np.repeat(contact.fibre_depths_mm, fibres).tolist())
    assert plan.silicone_mm == 6.0


def test_digits_turned_over_or_upside_down_are_no_other_digits():
    """Mirror images of two digits share no more than the digits as they are read; a seven-segment 2 is a 5."""
    digits = [draw_number(number, 2.5, 0.4) for number in range(10)]

    def share(number: int, other: int, *mirror: int) -> float:
        lying = affinity.scale(digits[number], *mirror, origin=(0, 0))
        return lying.intersection(digits[other]).area / lying.union(digits[other]).area

    for number, other in permutations(range(10), 2):
        for mirror in ((-1, 1), (1, -1), (-1, -1)):
            assert share(number, other, *mirror) <= max(0.6, share(number, other, 1, 1) + 1e-6), (number, other, mirror)


def test_numbers_keep_clear_of_all_and_are_next_to_the_start_of_their_fibre():
    plan = Plan(Morphology.random(4, 5, seed=3), with_settings({"min_silicone_mm": 0.6}))
    placed = [number for number in plan.numbers if number is not None]
    assert len(placed) >= len(plan.numbers) - 1
    ridges = shapely.union_all(plan.ridges)
    for i, number in enumerate(placed):
        assert number.distance(ridges) > 0.6 - 0.01
        assert number.within(plan.cavity)
        assert all(number.distance(other) > 0.6 for other in placed[:i])
    plan = Plan(Morphology.straight(4))
    starts = np.array([line.coords[0] for line in plan.lines])
    for fibre, number in enumerate(plan.numbers):
        assert number is not None
        middle = np.array(number.centroid.coords[0])
        assert int(np.argmin(np.linalg.norm(starts - middle, axis=1))) == fibre


def test_numbers_of_the_mould_are_legible_on_the_pad():
    """The mould's floor, which the tracks' side of the pad is cast from, as an arm sees the pad: upright."""
    plan, mould = Plan(Morphology.random(5, 3, seed=2)), with_settings({}).mould
    floor = shapely.union_all([prism.area for prism in mould_body(plan).adds if prism.top_mm > mould.floor_mm])
    lying = RobotFrame.from_settings(RigSettings(pad_mm=(0.0, 0.0), contact_mm=0.0, mirrored=True))
    for number, outline in enumerate(plan.numbers, 1):
        assert outline is not None
        x, y, *_ = lying.pose(np.array(shapely.box(*outline.bounds).centroid.coords[0]), 0.0)
        upright = affinity.scale(draw_number(number, mould.number_mm, mould.ridge_width_mm), -1, origin=(0, 0))
        for points, is_raised in ((shapely.get_coordinates(upright.buffer(-0.1)), True), (bays(upright), False)):
            seen = np.column_stack([points + np.array([x, y]), np.zeros(len(points))])
            places, _ = lying.tip(seen)
            assert (shapely.contains_xy(floor, *places[:, :2].T) == is_raised).all(), number


def bays(outline: BaseGeometry) -> np.ndarray:
    """Points (n, 2) within the box around an outline, clear of its strokes."""
    x_min, y_min, x_max, y_max = outline.bounds
    grid = np.stack(np.meshgrid(np.linspace(x_min, x_max, 25), np.linspace(y_min, y_max, 25)), axis=-1).reshape(-1, 2)
    return grid[shapely.distance(outline, shapely.points(grid)) > 0.1]


@pytest.mark.parametrize("step", [0.05, 1.0])
def test_trace_turns_by_the_step_at_most(step):
    """Headings are the directions of the sampled path; leads to one side turn by a quarter."""
    plan = Plan(Morphology.random(2, 2, seed=3), with_settings(pad={"leads": "one side"}))
    for points, headings in plan.trace(step, 5.0):
        moves = np.diff(points, axis=0)
        assert np.abs(np.diff(headings)[np.hypot(*moves.T) > 0]).max() <= 1.001 * step
        assert len(points) == len(headings)
        long = np.hypot(*moves.T) > 1e-9
        between = np.arctan2(moves[long, 1], moves[long, 0])
        mean = (headings[1:] + headings[:-1])[long] / 2
        assert np.abs((between - mean + np.pi) % (2 * np.pi) - np.pi).max() < max(0.02, step / 2)
