# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math

import numpy as np
import pytest
import shapely
from build123d import Axis, Compound, Solid
from OCP.Standard import Standard_Failure
from scipy.spatial import KDTree

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate.cad import model as of_model
from padforge.fabricate.cad.curves import fit_spline
from padforge.fabricate.cad.model import FIT_TOLERANCES_MM, CadPart, assemble, build_mould, mould_parts
from padforge.fabricate.cad.step_file import write_step
from padforge.fabricate.mesh import build_mesh
from padforge.fabricate.mould import conductive_plan, mould_body
from padforge.fabricate.plan import Plan
from tests.fabricate.planted import exact_fibre, level_pad, winding_pad, with_settings

PLAIN: dict[str, object] = {"wall_draft_deg": 0.0, "exit_mm": 0.0, "number_mm": 0.0}
SOFT = winding_pad((0.3, 1.0), (0.6, 1.5), (0.9, 1.35), (1.3, 0.6), (1.7, 1.0))
"""A fibre without tight bends that leaves the pad straight on."""


def judged_parts(plan: Plan, name: str = "mould") -> list[CadPart]:
    """The parts of a plan's mould: valid solids of the mesh's volumes."""
    parts = mould_parts(plan.shrinkage_compensated, name)
    assert all(solid.is_valid for part in parts for solid in part.shape.solids())
    assert max(part.deviation for part in parts) < 2e-4
    return parts


def judged(plan: Plan, name: str = "mould") -> dict[str, Solid | Compound]:
    return {part.shape.label: part.shape for part in judged_parts(plan, name)}


@pytest.mark.parametrize(("draft_deg", "deep"), [(0.0, "vertical"), (20.0, "horizontal")])
def test_mould_of_a_straight_pad_has_closed_form_volumes(draft_deg, deep):
    """Ridges reach 0.2 mm into the floor, 0.5 mm into the walls, and through each other."""
    plan = Plan(Morphology.straight(2), with_settings(PLAIN | {"wall_draft_deg": draft_deg}, pad={"deep_family": deep}))
    inner, lean = 33.75, 2 * 6 * math.tan(math.radians(draft_deg))
    rim = inner + lean
    tray = (rim + 4) ** 2 * 8 - 6 * (inner**2 + inner * rim + rim**2) / 3
    heights = {family: 1.2 if family == deep else 0.4 for family in ("horizontal", "vertical")}
    ridges = {
        f"{family} {number}": (inner + 2 * 0.5) * 0.4 * (height + 0.2)
        for family, height in heights.items()
        for number in (1, 2)
    }
    shapes = judged(plan)
    assert {name: shape.volume for name, shape in shapes.items()} == pytest.approx({"tray": tray} | ridges, rel=1e-9)
    assert all(face.geom_type.name == "PLANE" for shape in shapes.values() for face in shape.faces())


@pytest.mark.slow
def test_fused_mould_is_one_solid_of_the_volume_of_the_mesh():
    """The kernel works in a process of its own."""
    plan = Plan(Morphology.straight(1), with_settings(PLAIN))
    fused = build_mould(plan.pad, plan.settings, fused=True)
    assert isinstance(fused, Solid)
    assert fused.volume == pytest.approx(build_mesh(mould_body(plan)).volume(), rel=1e-6)


@pytest.mark.parametrize(
    ("pad", "mould"),
    [
        (SOFT, {}),
        (Morphology.random(2, 3, seed=3), {"ridge_width_mm": 1.5}),
        pytest.param(Morphology.random(1, 6, seed=3), {"ridge_width_mm": 0.8}, marks=pytest.mark.slow),
    ],
)
def test_ridge_edges_are_half_a_width_from_exact_fibres(pad, mould):
    """Thousands of places on the kernel's own curves, against scipy's own PCHIP."""
    plan = Plan(pad, with_settings(PLAIN | mould))
    points = []
    for edge in judged(plan)["horizontal 1"].edges():
        if edge.geom_type.name != "LINE":
            points += [(p.X, p.Y) for p in edge.positions(np.linspace(0, 1, 400).tolist())]
    inside = np.array(points)
    inside = inside[np.abs(inside[:, 0]) < plan.cavity.bounds[2] - 1.0]
    distance, _ = KDTree(exact_fibre(pad, 0)).query(inside)
    assert len(inside) > 2000
    assert np.abs(distance - plan.settings.mould.ridge_width_mm / 2).max() < 3e-3


@pytest.mark.parametrize("leads", ["edges", "one side"])
@pytest.mark.parametrize(("knots", "seed"), [(1, 0), (8, 2), pytest.param(20, 3, marks=pytest.mark.slow)])
def test_walls_of_ridges_go_straight_on_but_for_their_corners(knots, seed, leads):
    """Right ones at both ends, and flatter ones where folds merge."""
    settings = with_settings({"border_mm": 2.0}, pad={"leads": leads})
    shapes = judged(Plan(Morphology.random(1, knots, seed), settings))
    for ridge in (shapes["horizontal 1"], shapes["vertical 1"]):
        for wire in (wire for face in ridge.faces() if face.normal_at().Z > 0.5 for wire in face.wires()):
            steps = [(edge, 1e-5 / edge.length) for edge in wire.edges()]
            places = [[tuple(edge @ at) for at in (0, step, 1, 1 - step)] for edge, step in steps]
            ends, beside = np.array(places).reshape(-1, 2, 3).swapaxes(0, 1)
            away = (beside - ends) / np.linalg.norm(beside - ends, axis=1, keepdims=True)
            near = np.asarray(KDTree(ends).query(ends, k=2)[1])
            other = np.where(near[:, 0] == np.arange(len(ends)), near[:, 1], near[:, 0])
            turned = np.degrees(np.arccos(np.clip(-(away * away[other]).sum(axis=1), -1, 1)))
            assert not ((turned > 0.1) & (turned < 5)).any()
            assert (np.abs(turned - 90) < 1e-3).sum() in (0, 2 * 4)  # none round a hole that folds leave


@pytest.mark.parametrize("far", [[19, 5], [10, 10, 10], [25]])
def test_fit_spline_stays_near_sparse_vertices(far):
    """A bend of 3 mm radius, drawn finely, and a run out of it that hardly bends, of few vertices."""
    angle = np.linspace(0, 0.3, 10)
    bend = 3 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    out, aside = np.array([np.cos(0.3), np.sin(0.3)]), np.array([-np.sin(0.3), np.cos(0.3)])
    run = bend[-1] + np.outer(np.cumsum(far), out) + np.outer([1e-3, 1.5e-3, 0][: len(far)], aside)
    points = np.vstack([bend, run])
    end = (points[-1] - points[-2]) / np.linalg.norm(points[-1] - points[-2])
    curve = fit_spline(points, [np.array([1.0, 0.0]), end], 2e-3)
    places = shapely.points(curve(np.linspace(curve.t[0], curve.t[-1], 5000)))
    assert shapely.distance(places, shapely.LineString(points)).max() <= 2.2e-3


@pytest.mark.slow
def test_ridge_can_be_filleted_and_shelled():
    """As whoever opens the mould in CAD does first: its upper edges rounded, its inside taken out."""
    ridge = judged(Plan(SOFT, with_settings({"ridge_width_mm": 1.0})))["horizontal 1"]
    assert isinstance(ridge, Solid)
    top = ridge.faces().sort_by(Axis.Z)[-1]
    rounded = ridge.fillet(0.05, [*top.edges()])
    assert rounded.is_valid
    lost = (1 - math.pi / 4) * 0.05**2 * sum(edge.length for edge in top.edges())
    assert ridge.volume - rounded.volume == pytest.approx(lost, rel=0.02)
    shell = ridge.hollow([ridge.faces().sort_by(Axis.Z)[0]], -0.2)
    assert shell.is_valid
    assert 0.3 * ridge.volume < shell.volume < 0.7 * ridge.volume


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
def test_moulds_are_valid_and_match_their_meshes(case):
    pad, mould = ODD.get(case) or (Morphology.random(1, 3, seed=5), SETTINGS[case])
    judged(Plan(pad, with_settings(mould)))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bytes_"), [("5para_dis", 1_000_000), ("20para", 4_000_000)])
def test_moulds_of_published_pads_match_their_meshes_in_small_files(published, tmp_path, name, bytes_):
    plan = Plan(Morphology.load(published / f"{name}.mat"))
    mould = assemble({"mould": judged_parts(plan)}, plan.shrinkage_compensated)
    write_step(tmp_path / "mould.step", mould)
    assert (tmp_path / "mould.step").stat().st_size < bytes_


def test_mould_for_conductive_material_has_wells():
    plan = conductive_plan(Plan(SOFT, with_settings({"conductive": True, "pins": True})))
    wells, plain = judged(plan, "conductive"), judged(plan)
    for name in ("horizontal 1", "vertical 1"):  # the wells belong to their ridges
        assert wells[name].volume > plain[name].volume + 2 * 0.48 * math.pi * 1.5**2
    assert wells["numbers"].volume == pytest.approx(plain["numbers"].volume)
    round_ = [face for face in wells["vertical 1"].faces() if face.geom_type.name == "CYLINDER"]
    assert sum(face.area for face in round_) == pytest.approx(2 * (2 * math.pi * 1.5 - 2 * 0.4) * 0.6, rel=0.01)


def test_build_mould_is_compensated_for_shrinkage():
    plan = Plan(SOFT, with_settings(silicone={"shrinkage": 0.02}))
    size = np.array([*build_mould(SOFT, plan.settings).bounding_box().size])
    printed = plan.shrinkage_compensated
    assert size == pytest.approx([2 * printed.tray.bounds[2]] * 2 + [2.0 + printed.silicone_mm])


def test_ridges_are_fitted_finer_until_they_are_valid(monkeypatch):
    """Planted: the kernel fails at the first try, and then at all."""
    extrude, fails = Solid.extrude, iter([True])

    def fail_first(face, direction):
        if next(fails, False):
            raise Standard_Failure("")
        return extrude(face, direction)

    monkeypatch.setattr(Solid, "extrude", fail_first)
    monkeypatch.setattr(of_model, "body_solid", lambda body: Solid.make_box(1, 1, build_mesh(body).volume()))
    assert mould_parts(Plan(SOFT), "mould")[1].fit_mm == FIT_TOLERANCES_MM[1]
    fails = iter([True] * 1000)
    with pytest.raises(InputError, match=r"^second: the CAD kernel finds the ridge of horizontal 1 invalid; leave"):
        mould_parts(Plan(SOFT), "second")
