import numpy as np
import pytest
import shapely
from scipy.interpolate import PchipInterpolator

from design.common.errors import InputError
from design.pad.morphology import Morphology
from fabricate.mould.plan import INTO_WALL_MM, Plan, polygon_rings
from tests.fabricate.planted import with_settings


def exact_lines(pad: Morphology) -> list[shapely.LineString]:
    """Every fibre in mm from scipy's PCHIP, finely sampled, knots included."""
    lines = []
    for fibre, knots in enumerate(pad.knots):
        travel = fibre // pad.grid
        t = np.unique(np.linspace(knots[:-1, travel], knots[1:, travel], 400))
        places = np.empty((len(t), 2))
        places[:, travel] = t
        places[:, 1 - travel] = PchipInterpolator(knots[:, travel], knots[:, 1 - travel])(t)
        lines.append(shapely.LineString(pad.to_mm(places)))
    return lines


@pytest.mark.parametrize("tolerance_mm", [0.05, 0.01, 0.002])
def test_ridges_follow_the_curves_within_the_tolerance(tolerance_mm):
    pad = Morphology.random(4, 6, seed=1)
    plan = Plan(pad, with_settings({"tolerance_mm": tolerance_mm}))
    exact = exact_lines(pad)
    for line, curve in zip(plan.lines, exact, strict=True):
        assert shapely.distance(shapely.points(curve.coords), line).max() < tolerance_mm / 4
    for level, ridge in enumerate(plan.ridges):
        curves = shapely.union_all([curve for curve, own in zip(exact, plan.levels, strict=True) if own == level])
        inside = plan.cavity.buffer(-0.5)  # clear of the ends, which go on straight
        assert ridge.intersection(inside).within(curves.buffer(0.2 + tolerance_mm, quad_segs=16))
        assert curves.buffer(0.2 - tolerance_mm, quad_segs=16).intersection(inside).within(ridge)


def test_published_curves_within_the_tolerance(published):
    pad = Morphology.load(published / "20para.mat")
    for line, curve in zip(Plan(pad).lines, exact_lines(pad), strict=True):
        assert shapely.distance(shapely.points(curve.coords), line).max() < 0.0025


@pytest.mark.parametrize("border_mm", [0.0, 3.0])
def test_ridges_run_into_the_walls_at_both_ends(border_mm):
    plan = Plan(Morphology.random(3, 4, seed=2), with_settings({"border_mm": border_mm}))
    side = plan.pad.layout.size_mm[0] / 2 + border_mm
    assert plan.cavity.bounds == pytest.approx((-side, -side, side, side))
    ends = np.array([line.coords[0] for line in plan.lines[:3]])
    assert ends[:, 0] == pytest.approx(-side - plan.settings.mould.exit_mm - INTO_WALL_MM)
    assert ends[:, 1] == pytest.approx(plan.pad.to_mm([[0, 1], [0, 2], [0, 3]])[:, 1])
    for line in plan.lines:
        assert shapely.within(line, plan.tray)


def test_a_mould_shrunk_is_the_pad():
    plan = Plan(Morphology.random(3, 4, seed=2), with_settings({"border_mm": 1.0}, silicone={"shrinkage": 0.03}))
    mould = plan.enlarged
    assert mould.cavity.bounds[2] * 0.97 == pytest.approx(plan.cavity.bounds[2], rel=1e-12)
    for larger, slot in zip(mould.exits, plan.exits, strict=True):
        assert np.array(larger.bounds) * 0.97 == pytest.approx(slot.bounds, rel=1e-12)
    for larger, curve in zip(mould.lines, exact_lines(plan.pad), strict=True):
        shrunk = shapely.transform(larger, lambda places: 0.97 * places)
        assert shapely.distance(shapely.points(curve.coords), shrunk).max() < 0.0025
    assert mould.heights_mm[:2] == (0.4, 1.2)  # 0.412 and 1.237 mm in whole layers
    assert plan.depths_mm == pytest.approx([0.97 * height for height in mould.heights_mm], rel=1e-8)
    assert plan.thickness_mm == pytest.approx(0.97 * mould.silicone_mm) == pytest.approx(0.97 * 6.2)
    assert mould.enlarged is mould
    assert (mould.depths_mm, mould.thickness_mm) == (mould.heights_mm, mould.silicone_mm)


def test_a_pad_that_does_not_shrink_is_its_own_mould():
    plan = Plan(Morphology.straight(2), with_settings(silicone={"name": "EcoFlex 00-20", "shrinkage": 0.0}))
    assert plan.enlarged is plan
    assert Plan(Morphology.straight(2)).enlarged.pad.pitch_mm == 11.25


def test_polygon_rings_keep_the_area_on_their_left():
    area = shapely.box(0, 0, 3, 3).difference(shapely.box(1, 1, 2, 2))
    ((outer, hole),) = polygon_rings(area)
    assert shapely.is_ccw(shapely.LinearRing(outer))
    assert not shapely.is_ccw(shapely.LinearRing(hole))
    assert len(outer) == len(hole) == 4


@pytest.mark.parametrize(
    ("mould", "line"),
    [
        ({"ridge_width_mm": 12.0}, "[mould] ridge_width_mm: got 12, allowed is less than the pitch, 11.25 mm"),
        (
            {"shallow_ridge_height_mm": 1.2},
            "[mould] shallow_ridge_height_mm: got 1.2, allowed is less than deep_ridge_height_mm, 1.2 mm",
        ),
        ({"silicone_mm": 1.0}, "[mould] deep_ridge_height_mm: got 1.2, allowed is less than silicone_mm, 1 mm"),
        (
            {"tolerance_mm": 0.1, "ridge_width_mm": 0.4},
            "[mould] tolerance_mm: got 0.1, allowed is less than a quarter of ridge_width_mm, 0.1 mm",
        ),
    ],
)
def test_contradictory_settings_are_one_clear_line(mould, line):
    with pytest.raises(InputError) as error:
        Plan(Morphology.straight(4), with_settings(mould))
    assert str(error.value) == line
