"""Which part fills what, against volumes that arithmetic gives and against the mesh."""

import math

import numpy as np
import pytest
import shapely

from design.pad.morphology import Morphology
from fabricate.mould.assembly import conductive_body, conductive_plan, mould_body, plan_mesh, well_outlines
from fabricate.mould.cad.layout import HORIZONTAL, NUMBERS, TRAY, VERTICAL, Part, Surface, contact_mm2, layout
from fabricate.mould.cad.outlines.arrangement import Arrangement
from fabricate.mould.cad.outlines.drawing import Drawing
from fabricate.mould.mesh import mesh
from fabricate.mould.plan import Plan
from tests.fabricate.planted import level_pad, winding_pad, with_settings

UPRIGHT = with_settings({"wall_draft_deg": 0.0, "exit_mm": 0.0, "number_mm": 0.0})
FITS_MM = 2e-3, 5e-4, 1e-4
FIT_MM = FITS_MM[0]


def volumes(drawing: Drawing, parts: list[Part]) -> dict[str, float]:
    """Of every part, cell by cell: prisms under planes, whose mean height is that over the cell's centroid."""
    middles = shapely.get_coordinates(shapely.centroid(drawing.cells))

    def height(surface: Surface, cell: int) -> float:
        return float(surface[0].plane(surface[1], middles[[cell]])[0]) if isinstance(surface, tuple) else surface

    return {
        part.name: sum(
            drawing.cells[cell].area * (height(span.top, cell) - height(span.bottom, cell))
            for cell, span in enumerate(part.spans)
            if span is not None
        )
        for part in parts
    }


@pytest.mark.parametrize(("deep", "family"), [(HORIZONTAL, "horizontal"), (VERTICAL, "vertical")])
def test_a_straight_pad_has_the_volumes_that_arithmetic_gives(deep, family):
    settings = with_settings(UPRIGHT.mould.model_dump(), pad={"deep_family": family})
    plan = Plan(Morphology.straight(3, pitch_mm=10.0), settings)
    inner, ridge, tray = 40.0, 0.4, plan.tray.area
    found = volumes(*layout(plan, FIT_MM))
    shallow = VERTICAL if deep == HORIZONTAL else HORIZONTAL
    assert found == pytest.approx(
        {
            TRAY: tray * 8 - inner**2 * 6,
            deep: 3 * inner * ridge * 1.2,
            shallow: 3 * ridge * 0.4 * (inner - 3 * ridge),  # the taller ones go through
        },
        rel=1e-9,
    )


def test_contact_of_a_straight_pad_is_what_tracks_stand_on_and_end_at():
    plan = Plan(Morphology.straight(1, pitch_mm=10.0), UPRIGHT)
    drawing, parts = layout(plan, FIT_MM)
    footprint = 20 * 0.4 * 2 - 0.4**2
    crossing = 2 * 0.4 * 0.4
    ends = 2 * 0.4 * (1.2 + 0.4)
    assert contact_mm2(drawing, parts) == pytest.approx(footprint + crossing + ends, rel=1e-6)


def test_contact_with_walls_that_lean_is_what_lies_on_them():
    plan = Plan(
        Morphology.straight(1, pitch_mm=20.0), with_settings({"exit_mm": 0.0, "number_mm": 0.0, "wall_draft_deg": 10.0})
    )
    drawing, parts = layout(plan, FIT_MM)
    slope = math.tan(math.radians(10))
    lean = math.hypot(1, slope)  # of the wall, per mm of height
    expected = 40 * 0.4 * 2 - 0.4**2 + 2 * 0.4 * 0.4 + 2 * 0.4 * (1.2 + 0.4) * lean
    assert contact_mm2(drawing, parts) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("mould", [{}, {"number_mm": 0.0}])
def test_parts_are_named_and_none_is_empty(mould):
    _, parts = layout(Plan(Morphology.straight(2), with_settings(mould)), FIT_MM)
    assert [part.name for part in parts] == [TRAY, HORIZONTAL, VERTICAL, *([NUMBERS] if not mould else [])]
    for part in parts:
        assert any(part.spans)


CASES = {
    "defaults": (Morphology.random(2, 3, seed=1), {}),
    "upright": (Morphology.random(2, 2, seed=2), {"wall_draft_deg": 0.0}),
    "border": (Morphology.random(1, 5, seed=3), {"border_mm": 2.0, "wall_draft_deg": 5.0}),
    "no exits": (Morphology.random(1, 5, seed=4), {"exit_mm": 0.0}),
    "terraces": (Morphology.random(1, 3, seed=5), {"ridge_draft_deg": 6.0}),
    "three levels": (level_pad(1.8, 1.2), {}),
    "one on the other": (level_pad(1.5, 1.5), {}),
    "along the wall": (winding_pad((0.2, 0.01), (1.8, 0.01)), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_parts_fill_what_the_mesh_fills_and_nothing_twice(case):
    pad, mould = CASES[case]
    plan = Plan(pad, with_settings(mould))
    drawing, parts = layout(plan, FIT_MM)
    found = volumes(drawing, parts)
    assert sum(found.values()) == pytest.approx(plan_mesh(plan).volume(), rel=1e-4)
    solid = mesh(mould_body(plan))
    for z in (0.5, 2.1, 2.5, 2.9, 5.0):
        filled = np.zeros(len(drawing.cells))
        for part in parts:
            for cell, span in enumerate(part.spans):
                if span is not None and not any(isinstance(surface, tuple) for surface in span):
                    filled[cell] += span.bottom < z < span.top  # pyright: ignore[reportOperatorIssue]
        assert filled.max() <= 1
        if not plan.flare_mm:
            assert shapely.area(drawing.cells) @ filled == pytest.approx(solid.slice(z).area(), rel=1e-4)


def test_tracks_and_numbers_stand_on_the_tray():
    _, parts = layout(Plan(Morphology.random(2, 2, seed=6)), FIT_MM)
    tray, *standing = parts
    assert tray.name == TRAY
    for cell, below in enumerate(tray.spans):
        over = [part.spans[cell] for part in standing if part.spans[cell]]
        assert len(over) <= 1
        if below is None:
            assert not over
        elif over:
            assert over[0] is not None
            assert over[0].bottom == below.top
            assert below.bottom == 0.0


def test_wells_belong_to_their_tracks():
    plan = conductive_plan(
        Plan(winding_pad((0.6, 1.3), (1.5, 0.8), pitch_mm=12.0), with_settings({"conductive": True}))
    )
    sides = 64
    with_wells = volumes(*layout(plan, FIT_MM, well_outlines(plan, sides)))
    without = volumes(*layout(plan, FIT_MM))
    assert sum(with_wells.values()) == pytest.approx(mesh(conductive_body(plan)).volume(), rel=1e-5)
    for name in (HORIZONTAL, VERTICAL):
        assert with_wells[name] > without[name] + 2 * 0.3 * math.pi * 1.5**2
    assert with_wells[NUMBERS] == pytest.approx(without[NUMBERS])


def test_the_curves_are_as_near_as_asked():
    plan = Plan(Morphology.random(1, 5, seed=9))
    spans = []
    for fit_mm in (2e-3, 1e-4):
        drawing, _ = layout(plan, fit_mm)
        spans.append(sum(len(piece.curve.c) for piece in drawing.pieces if piece.curve))
    assert spans[0] < spans[1]


@pytest.mark.parametrize("fit_mm", FITS_MM)
def test_no_chain_is_too_short_for_the_kernel(fit_mm):
    """A tip within a few micrometres whose walls meet where they leave the tray's wall."""
    plan = Plan(winding_pad((1 - 1e-5, 0.5), (1.0, 0.01), (1 + 1e-5, 0.5)))
    drawing, parts = layout(plan, fit_mm)
    for part in parts:
        assert min(chain.end - chain.start for chain in Arrangement(drawing, part.spans).chains) > 1e-5
