import numpy as np
import pytest
import shapely
from shapely import affinity

from design.pad.morphology import Morphology
from fabricate.mould.assembly import mould_body
from fabricate.mould.plan import Plan
from fabricate.mould.planning.numerals import number_strokes
from sense.rig.session.pad_frame import Frame
from sense.settings import RigSettings
from tests.fabricate.planted import with_settings


@pytest.mark.parametrize(
    ("digit", "parts", "holes"), [(0, 1, 1), (1, 1, 0), (4, 1, 0), (6, 1, 1), (8, 1, 2), (9, 1, 1)]
)
def test_digits_have_the_shape_of_digits(digit, parts, holes):
    outline = shapely.MultiPolygon(shapely.get_parts(number_strokes(digit, 2.5, 0.4)).tolist())
    assert len(outline.geoms) == parts
    assert sum(len(part.interiors) for part in outline.geoms) == holes


def test_numbers_read_on_the_casting():
    """Turned over, left and right change places: 1 is a bar, and 7 has its foot on the right when read."""
    seven = affinity.scale(number_strokes(7, 2.5, 0.4), xfact=-1, origin=(0, 0))
    left, low, right, high = seven.bounds
    assert shapely.Point(right - 0.1, low + 0.1).within(seven)
    assert not shapely.Point(left + 0.1, low + 0.1).within(seven)
    assert shapely.Point(left + 0.1, high - 0.1).within(seven)
    twelve = affinity.scale(number_strokes(12, 2.5, 0.4), xfact=-1, origin=(0, 0))
    first, second = sorted(shapely.get_parts(twelve), key=lambda part: part.bounds[0])
    assert first.area < second.area


@pytest.mark.parametrize(("height", "width"), [(1.5, 0.2), (2.5, 0.4), (5.0, 0.8)])
def test_strokes_and_gaps_are_as_wide_as_ridges(height, width):
    for number in (0, 8, 23, 96):
        outline = number_strokes(number, height, width)
        assert outline.buffer(-0.49 * width).buffer(0.49 * width, join_style="mitre").area == pytest.approx(
            outline.area, rel=0.02
        )
        left, low, right, high = outline.bounds
        assert high - low == pytest.approx(height + width)
        assert (left + right, low + high) == pytest.approx((0, 0), abs=1e-9)


@pytest.mark.parametrize("pad", [Morphology.straight(4), Morphology.random(4, 5, seed=3), Morphology.straight(1)])
def test_numbers_keep_clear_of_ridges_walls_and_each_other(pad):
    plan = Plan(pad, with_settings({"min_silicone_mm": 0.6}))
    placed = [number for number in plan.numbers if number is not None]
    assert len(placed) >= len(plan.numbers) - 1
    ridges = shapely.union_all(plan.ridges)
    for i, number in enumerate(placed):
        assert number.distance(ridges) > 0.6 - 0.01
        assert number.within(plan.cavity)
        assert all(number.distance(other) > 0.6 for other in placed[:i])


def test_a_number_stands_beside_its_own_start():
    plan = Plan(Morphology.straight(4))
    starts = np.array([line.coords[0] for line in plan.lines])
    for fibre, number in enumerate(plan.numbers):
        assert number is not None
        middle = np.array(number.centroid.coords[0])
        assert int(np.argmin(np.linalg.norm(starts - middle, axis=1))) == fibre


def test_numbers_can_be_left_out_and_crowded_out():
    assert Plan(Morphology.straight(2), with_settings({"number_mm": 0.0})).numbers == []
    crowded = Plan(Morphology.straight(2, pitch_mm=4.0), with_settings({"number_mm": 6.0, "exit_mm": 0.0}))
    assert crowded.numbers == [None] * 4


DIGITS = """
### ..# ### ### #.# ### ### ### ### ###
#.# ..# ..# ..# #.# #.. #.. ..# #.# #.#
#.# ..# ### ### ### ### ### ..# ### ###
#.# ..# #.. ..# ..# ..# #.# ..# #.# ..#
### ..# ### ### ..# ### ### ..# ### ###
"""


@pytest.mark.parametrize("digit", range(10))
def test_every_digit_reads_as_it_should(digit):
    """After an 8, turned over: corners, ends and middles of strokes are there or not."""
    height, width = 2.5, 0.4
    outline = affinity.scale(number_strokes(80 + digit, height, width), xfact=-1, origin=(0, 0))
    left, low, right, _ = outline.bounds
    assert right - left == pytest.approx(width + height * 0.5 * 2 + width + 0.25 * height)
    place = np.array([right - width / 2 - 0.5 * height, low + width / 2])
    rows = [row.split()[digit] for row in DIGITS.split("\n") if row]
    for down, row in enumerate(rows):
        for across, cell in enumerate(row):
            point = shapely.Point(place + height * np.array([across / 4, 1 - down / 4]))
            assert outline.covers(point) == (cell == "#")


@pytest.mark.parametrize("pad", [Morphology.straight(5), Morphology.random(5, 3, seed=2)])
def test_numbers_in_the_mould_read_right_on_the_pad_as_it_is_used(pad):
    """The heights of the mould's floor, which the tracks' side of the pad is cast from, seen as an arm sees the pad."""
    plan, mould = Plan(pad), with_settings({}).mould
    floor = shapely.union_all([prism.area for prism in mould_body(plan).adds if prism.top_mm > mould.floor_mm])
    lying = Frame.of(RigSettings(pad_mm=(0.0, 0.0), contact_mm=0.0, mirrored=True))
    rows = [row.split() for row in DIGITS.split("\n") if row]
    for number, outline in enumerate(plan.numbers, 1):
        assert outline is not None
        x, y, *_ = lying.pose(np.array(shapely.box(*outline.bounds).centroid.coords[0]), 0.0)
        half, height = (outline.bounds[2] - outline.bounds[0] - mould.ridge_width_mm) / 2, mould.number_mm
        digit = number % 10  # the last one, on the right of who reads
        for down, row in enumerate(rows):
            for across, cell in enumerate(row[digit]):
                seen = x + half + (across / 4 - 0.5) * height, y + height * (0.5 - down / 4), 0.0
                (place,), _ = lying.tip(np.array([seen]))
                assert floor.covers(shapely.Point(place)) == (cell == "#"), (number, down, across)
