"""CAD models of moulds: closed forms, exact offsets of fibres, and the mesh as judge."""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math
from itertools import combinations, product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from OCP.Standard import Standard_Failure
from scipy.spatial import KDTree

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.design.paths.curves import lengths
from padforge.fabricate.cad import model as of_model
from padforge.fabricate.cad.model import (
    FIT_TOLERANCES_MM,
    CadModel,
    assemble,
    build_models,
    build_mould,
    build_mould_model,
)
from padforge.fabricate.mesh import build_mesh
from padforge.fabricate.mould import conductive_plan, holder_body, lid_body, mould_body, well_outlines
from padforge.fabricate.plan import Plan
from tests.fabricate.planted import exact_fibre, level_pad, winding_pad, with_settings

if TYPE_CHECKING:
    from build123d import Compound

PLAIN: dict[str, object] = {"wall_draft_deg": 0.0, "exit_mm": 0.0, "number_mm": 0.0}


SOFT = winding_pad((0.3, 1.0), (0.6, 1.5), (0.9, 1.35), (1.3, 0.6), (1.7, 1.0))
"""A fibre without tight bends that leaves the pad straight on."""


def part(model: CadModel, name: str) -> "Compound":
    (found,) = (child for child in model.shape.children if child.label == name)
    return found


def judged(plan: Plan, **wells) -> CadModel:
    """The model of a plan's mould, valid and as large as its mesh."""
    model = build_mould_model(plan.shrinkage_compensated, "mould", **wells)
    assert all(solid.is_valid for solid in model.shape.solids())
    apart = model.compare(build_mesh(mould_body(plan.shrinkage_compensated, **wells)))
    assert max(apart) < 2e-4, apart
    return model


@pytest.mark.parametrize(("draft_deg", "deep"), [(0.0, "vertical"), (20.0, "horizontal")])
def test_mould_model_of_a_straight_pad_has_closed_form_volumes(draft_deg, deep):
    settings = with_settings(PLAIN | {"wall_draft_deg": draft_deg}, pad={"deep_family": deep})
    plan = Plan(Morphology.straight(2), settings)
    slope = math.tan(math.radians(draft_deg))
    inner, ridge, lean = 33.75, 0.4, 2 * 6 * slope
    behind = 2 * ridge * slope * 2 / 2  # where the wall leans off a ridge's end, times its height squared
    rim = inner + lean
    tray = (rim + 4) ** 2 * 8 - 6 * (inner**2 + inner * rim + rim**2) / 3
    deeper = 2 * inner * ridge * 1.2 + behind * 1.2**2
    shallow = 2 * (inner - 2 * ridge) * ridge * 0.4 + behind * 0.4**2  # the taller ones go through
    model, other = judged(plan), {"horizontal": "vertical", "vertical": "horizontal"}[deep]
    volumes = {child.label: child.volume for child in model.shape.children}
    expected = {"tray": tray, f"{deep} tracks": deeper, f"{other} tracks": shallow}
    assert volumes == pytest.approx(expected, rel=1e-9)
    assert build_mould(plan.pad, plan.settings).volume == pytest.approx(sum(expected.values()), rel=1e-9)
    assert max(model.compare(build_mesh(mould_body(plan)))) < 1e-7
    assert all(face.geom_type.name == "PLANE" for face in model.shape.faces())
    footprint = 2 * (inner + inner - 2 * ridge) * ridge
    crossings, ends = 4 * 2 * ridge * 0.4, 2 * 2 * ridge * (1.2 + 0.4) * math.hypot(1, slope)
    assert model.contact_mm2 == pytest.approx(footprint + crossings + ends, rel=1e-6)


def test_mould_model_walls_are_as_long_as_exact_offsets():
    """Where a bend is wider than half the track, the offsets to the left and right are together as long as two fibres.

    So are each by itself where a fibre leaves the pad as it came: what one gains in a bend the other loses.
    """
    plan = Plan(SOFT, with_settings(PLAIN))
    model = judged(plan)
    length = SOFT.unit_mm * float(lengths(SOFT)[0])
    tracks = part(model, "horizontal tracks")
    upright = [face for face in tracks.faces() if abs(face.normal_at().Z) < 0.5]
    ends = 2 * 0.4 * 1.2
    assert sum(face.area for face in upright) == pytest.approx(2 * length * 1.2 + ends, rel=5e-5)
    mean_mm = 2.4e-4  # of how far walls lie off, of 2 µm allowed
    assert tracks.volume == pytest.approx(length * 0.4 * 1.2, rel=mean_mm / 0.4)
    curved = sum(face.area for face in upright if face.geom_type.name in ("EXTRUSION", "CYLINDER"))
    assert curved > 0.9 * (2 * length * 1.2 - 2 * 2 * 3.0 * 1.2)  # the fibre begins and ends 3 mm straight


@pytest.mark.parametrize(
    ("pad", "mould"),
    [(SOFT, {}), pytest.param(Morphology.random(1, 6, seed=3), {"ridge_width_mm": 0.8}, marks=pytest.mark.slow)],
)
def test_mould_model_edges_are_half_a_width_from_exact_fibres(pad, mould):
    """Thousands of places on the kernel's own curves, on the floor, against scipy's own PCHIP."""
    plan = Plan(pad, with_settings(PLAIN | mould))
    points = []
    for edge in part(build_mould_model(plan, "mould"), "horizontal tracks").edges():
        if edge.geom_type.name != "LINE" and abs(edge.center().Z - 2.0) < 1e-9:
            points += [(p.X, p.Y) for p in edge.positions(np.linspace(0, 1, 400).tolist())]
    inside = np.array(points)
    inside = inside[np.abs(inside[:, 0]) < plan.cavity.bounds[2] - 1.0]
    distance, _ = KDTree(exact_fibre(pad, 0)).query(inside)
    assert len(inside) > 2000
    assert np.abs(distance - plan.settings.mould.ridge_width_mm / 2).max() < 3e-3


SETTINGS = {
    "upright": {"wall_draft_deg": 0.0},
    "leaning": {"wall_draft_deg": 5.0},
    "no exits": {"exit_mm": 0.0},
    "terraces": {"ridge_draft_deg": 6.0},
    "pins": {"pins": True, "wall_mm": 3.0},
}


ODD = {
    "a family that crosses itself": (level_pad(1.8, 1.2), {}),
    "two that lie on each other": (level_pad(1.5, 1.5), {}),
    "two nearly so": (level_pad(1.5, 1.501), {}),
    "two that overlap by three nanometres": (level_pad(1.5, 1.5399997), {}),
    "two a micrometre apart": (level_pad(1.5, 1.5401), {}),
    "along the wall": (level_pad(0.0, 1.5), {"wall_draft_deg": 0.0}),
    "touching the wall": (level_pad(0.02, 1.5), {"wall_draft_deg": 0.0, "exit_mm": 0.0}),
    "grazing the wall": (winding_pad((0.7, 0.4), (1.0, 0.015), (1.3, 0.4)), {}),
    "a tip on the wall": (winding_pad((0.9999, 0.5), (1.0, 0.02), (1.0001, 0.5)), {"ridge_width_mm": 2.0}),
    "a hairpin": (winding_pad((0.59, 0.5), (0.595, 1.6), (0.6, 0.5), (0.605, 1.6), (0.61, 0.5)), {}),
    "a fold in a wide track": (winding_pad((0.5, 0.6), (0.6, 1.5), (0.7, 0.6)), {"ridge_width_mm": 2.0}),
    "three knots at one place": (winding_pad((0.6, 1.3), (0.6, 1.3), (0.6, 1.3), (1.5, 0.4)), {}),
}


NARROW = "two that overlap by three nanometres"
RARE = {*SETTINGS, *ODD} - {*[*SETTINGS, *ODD][::5], NARROW}


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] if case in RARE else []) for case in [*SETTINGS, *ODD]]
)
def test_mould_models_are_valid_and_match_their_meshes(case):
    pad, mould = ODD.get(case) or (Morphology.random(1, 3, seed=5), SETTINGS[case])
    model = judged(Plan(pad, with_settings(mould)))
    assert case in ODD or model.fit_mm == FIT_TOLERANCES_MM[0]


@pytest.mark.slow
@pytest.mark.parametrize(("grid", "knots", "seed"), [(3, 8, 0)])
def test_mould_models_of_dense_pads_match_their_meshes(grid, knots, seed):
    judged(Plan(Morphology.random(grid, knots, seed)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["5para_dis"])
def test_mould_models_of_published_pads_match_their_meshes(published, name):
    judged(Plan(Morphology.load(published / f"{name}.mat")))


def test_mould_model_has_wells():
    plan = conductive_plan(Plan(SOFT, with_settings({"conductive": True, "pins": True})))
    model = judged(plan, wells=well_outlines(plan, sides=512))
    plain = build_mould_model(plan, "mould")
    for name in ("horizontal tracks", "vertical tracks"):  # the wells belong to their tracks
        assert part(model, name).volume > part(plain, name).volume + 2 * 0.3 * math.pi * 1.5**2
    assert part(model, "numbers").volume == pytest.approx(part(plain, "numbers").volume)
    round_ = [face for face in part(model, "vertical tracks").faces() if face.geom_type.name == "CYLINDER"]
    assert sum(face.area for face in round_) == pytest.approx(2 * (2 * math.pi * 1.5 - 2 * 0.4) * 0.4, rel=0.01)


def test_mould_model_parts_are_named_coloured_and_disjoint():
    model = build_mould_model(Plan(SOFT, with_settings({"pins": True})), "mould")
    assert model.shape.label == "mould"
    children = list(model.shape.children)
    assert [child.label for child in children] == ["tray", "horizontal tracks", "vertical tracks", "numbers", "pins"]
    assert len({tuple(child.color) for child in children}) == 4  # numbers and pins are alike
    assert all(child.volume > 0 for child in children)
    for one, other in combinations(children, 2):
        for a, b in product(one.solids(), other.solids()):
            shared = a.intersect(b)
            assert sum(each.volume for each in shared.solids()) < 1e-6 if shared else True
    without = build_mould_model(Plan(SOFT, with_settings(PLAIN)), "mould").shape
    assert [child.label for child in without.children] == ["tray", "horizontal tracks", "vertical tracks"]


def test_mould_model_is_compensated_for_shrinkage():
    plan = Plan(SOFT, with_settings(silicone={"shrinkage": 0.02}))
    model = judged(plan)
    for shape in (model.shape, build_mould(SOFT, plan.settings)):
        size = np.array([*shape.bounding_box().size])
        assert size == pytest.approx(
            [2 * plan.shrinkage_compensated.tray.bounds[2]] * 2 + [2.0 + plan.shrinkage_compensated.silicone_mm]
        )


def test_assemble_places_bodies_side_by_side():
    settings = with_settings({"lid": True, "pins": True, "spout": True, "holder": True, "conductive": True})
    plan = Plan(SOFT, settings)
    wells = conductive_plan(plan)
    second = mould_body(wells, well_outlines(wells, sides=512))
    bodies = {"mould": mould_body(plan), "lid": lid_body(plan), "conductive": second, "holder": holder_body(wells)}
    made = build_models(plan, bodies)
    for name, model in zip(bodies, made, strict=True):
        assert max(model.compare(build_mesh(bodies[name]))) < 5e-4  # a lid's mesh has polygons for circles
    whole = assemble(made, plan)
    assert [child.name for child in whole.children] == list(bodies)
    shapes = {child.name: CadModel(child).shape for child in whole.children}
    low = {name: [*shape.bounding_box().min] for name, shape in shapes.items()}
    high = {name: [*shape.bounding_box().max] for name, shape in shapes.items()}
    assert low["lid"][2] == pytest.approx(8.0)
    assert high["mould"][2] == pytest.approx(10.0)
    assert low["lid"][:2] == pytest.approx(low["mould"][:2])
    assert low["conductive"][0] == pytest.approx(high["mould"][0] + 10)
    assert low["holder"][0] == pytest.approx(high["conductive"][0] + 10)
    assert CadModel(whole).shape.is_valid


def test_build_models_needs_no_room_for_absent_wells():
    """Wells would find no room there, but nobody asked for any."""
    plan = Plan(Morphology.straight(1, pitch_mm=5.0))
    with pytest.raises(InputError, match="exit_width_mm"):
        conductive_plan(plan)
    (made,) = build_models(plan, {"mould": mould_body(plan)})
    assert made.shape.is_valid


@pytest.mark.parametrize(("failures", "fit_mm"), [(1, FIT_TOLERANCES_MM[1]), (1000, None)])
def test_build_mould_model_fits_finer_curves_until_solids_are_valid(monkeypatch, failures, fit_mm):
    """Planted: the kernel fails at the first tries."""
    build, tries = of_model.build_solids, []

    def fail_first(*arguments):
        tries.append(arguments)
        if len(tries) <= failures:
            raise Standard_Failure("")
        return build(*arguments)

    monkeypatch.setattr(of_model, "build_solids", fail_first)
    if fit_mm:
        assert build_mould_model(Plan(Morphology.straight(1)), "mould").fit_mm == fit_mm
    else:
        with pytest.raises(InputError, match=r"^second: the CAD kernel finds a solid invalid; leave step out"):
            build_mould_model(Plan(Morphology.straight(1)), "second")
