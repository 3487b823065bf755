"""Drawings, pages and courses of pads that are no squares."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely

from design.pad.morphology import Morphology
from design.settings import PadSettings
from fabricate.dispensing.course import laying_steps, turned_over
from fabricate.export import build
from fabricate.mould.plan import Plan
from fabricate.report.laying.orientation import orientation_svg, sentence
from fabricate.report.relief import WALL, mould_relief
from fabricate.report.track_drawings import tracks_svg
from fabricate.settings import DEFAULTS, FabricationSettings, FibreSettings

PAD = Morphology.straight((2, 3), (8.0, 15.0))
HOLE = ((-7.0, -5.0), (-1.0, -5.0), (-1.0, 5.0), (-7.0, 5.0))


def settings(pad: Morphology = PAD, **own: Any) -> FabricationSettings:
    return replace(DEFAULTS, pad=PadSettings(**{**pad.layout.settings, **own}))


@pytest.mark.parametrize(
    ("fibres", "leads", "says"),
    [
        ((2, 3), "edges", "horizontal fibres count from near to far and start on the right, vertical ones"),
        ((0, 3), "edges", "all fibres are vertical: they count from right to left and start at the near side."),
        ((2, 0), "edges", "all fibres are horizontal: they count from near to far and start on the right."),
        ((2, 3), "one side", "all leads leave at the near side: horizontal fibres"),
    ],
)
def test_one_sentence_says_which_way_round(fibres, leads, says):
    pad = Morphology.straight(fibres, (8.0, 15.0))
    assert says in sentence(fibres, leads)
    assert says in re.sub(r"\s+", " ", orientation_svg(Plan(pad, settings(pad, leads=leads))))


def test_the_page_has_holes_bending_exits_and_lengths(tmp_path):
    own = settings(leads="one side", keep_out_mm=(HOLE,), bent_radius_mm=30.0)
    own = replace(own, fibre=FibreSettings(ohm_per_mm=10.0))
    document = build(PAD, tmp_path, [], own)
    page = (tmp_path / "laying.md").read_text(encoding="utf-8")
    assert "Horizontal fibres are 1 to 2, vertical ones 3 to 5." in page
    assert "around every pillar" in page
    assert "bent to 30 mm, fibres are stretched by up to" in page
    assert "from left to right as the pad lies for laying, these fibres end: 5, 2, 1, 5, 4, 3, 1, 2, 3, 4." in page
    assert document["settings"]["pad"]["horizontals"] == 2
    plan = Plan(PAD, own)
    for entry, line in zip(document["fibres"], plan.lines, strict=True):
        assert entry["in_pad_mm"] == pytest.approx(line.length - 1.0, abs=0.01)  # less what runs into the walls
        assert entry["resistance_ohm"] == pytest.approx(10 * entry["cut_mm"], rel=1e-3)


def test_a_pad_without_crossings_has_a_page(tmp_path):
    document = build(Morphology.straight((0, 2), 10.0), tmp_path, [], DEFAULTS)
    assert document["crossings"]["gap_mm"] is None
    assert "No two fibres cross." in (tmp_path / "laying.md").read_text(encoding="utf-8")


def test_the_silicone_to_cast_is_less_the_holes(tmp_path):
    with_hole, whole = (
        build(PAD, tmp_path / str(len(holes)), [], settings(keep_out_mm=holes)) for holes in ((HOLE,), ())
    )
    less = whole["silicone_volume_ml"] - with_hole["silicone_volume_ml"]
    assert less == pytest.approx(6 * 10 * 6 / 1000, abs=1e-3)


def test_the_relief_is_as_the_tray():
    plan = Plan(PAD, settings(keep_out_mm=(HOLE,)))
    left, low, right, high = plan.tray.bounds
    heights, shown = mould_relief(plan, round(10 * (right - left)), round(10 * (high - low)))
    row, column = round(10 * high), round(10 * (-4 - left))
    assert (shown[row, column], heights[row, column]) == (WALL, plan.silicone_mm)
    assert heights.shape == shown.shape == (round(10 * (high - low)), round(10 * (right - left)))


def test_drawings_show_holes_and_number_both_ends_along_one_side():
    drawing = tracks_svg(Plan(PAD, settings(leads="one side", keep_out_mm=(HOLE,))))
    edge = re.search(r'<path id="edge" d="([^"]*)"', drawing)
    assert edge is not None
    assert edge[1].count("M") == 2
    assert [len(re.findall(rf">{number}</text>", drawing)) for number in range(1, 6)] == [2] * 5


def test_a_needle_follows_the_leads():
    own = replace(settings(leads="one side"), fibre=FibreSettings(least_bend_mm=3.0))
    plan = Plan(PAD, own)
    for step in laying_steps(plan, 0.3):
        for stroke in step.strokes:
            line = shapely.LineString(turned_over(stroke.places_mm))
            assert line.length == pytest.approx(plan.lengths_mm[stroke.fibre] + 60, rel=1e-3)
            places = np.asarray(shapely.points(turned_over(stroke.places_mm)))
            places = places[shapely.within(places, plan.silicone)]
            assert shapely.distance(plan.lines[stroke.fibre], places).max() < 0.01
            assert set(stroke.feeds_mm_s) == {10.0}  # a bend of 3 mm could be taken at 17 mm/s


def test_a_needle_is_slow_in_tight_bends_of_leads():
    slow = replace(
        settings(leads="one side"), dispenser=DEFAULTS.dispenser.model_copy(update={"acceleration_mm_s2": 25})
    )
    (first, *_), *_ = (step.strokes for step in laying_steps(Plan(PAD, slow), 0.3))
    assert first.feeds_mm_s.min() in (4.0, 5.0)  # 1 mm: the root of 25, rounded down
    assert first.feeds_mm_s.max() == 10.0
