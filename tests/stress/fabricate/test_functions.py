"""The public functions of `fabricate` given anything: a sound mould, a finding, or one line that says what is wrong."""

import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from design import InputError, Morphology
from design.settings import PadSettings
from fabricate import (
    DispenserSettings,
    FabricationSettings,
    Finding,
    MouldSettings,
    Plan,
    PrinterSettings,
    build,
    build_mould,
    check,
    check_mesh,
)
from fabricate.checks.mesh_checks import SOUND, inspect_mesh, sound
from fabricate.checks.plan_checks import meshed
from fabricate.materials import FibreSettings, SiliconeSettings
from fabricate.mesh_files import read_mesh, write_3mf, write_stl
from fabricate.report.pictures import draw_findings
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.values import LAX, Array, call_spoiled, pads

Arguments = dict[str, Any]
Verify = Callable[[Any, Arguments], None]
PAD = Morphology.straight(1)
TETRAHEDRON = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
BLOCKS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float), np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5],
     [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def findings(found: Any, given: Arguments) -> None:
    for finding in found:
        assert isinstance(finding, Finding)
        json.dumps(finding.document(), allow_nan=False)
        assert len(finding.message.splitlines()) == 1


def a_section(found: Any, given: Arguments) -> None:
    assert type(found)(**found.model_dump()) == found


def written(**given: Any) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        arguments: Arguments = {"out": Path(folder) / "mould"} | given
        document = build(**arguments)
        if "out" not in given:
            for name in document["files"]:
                assert (Path(folder) / "mould" / name).stat().st_size
    return document


def mesh_file(**given: Any) -> list[Finding]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.stl"
        write_stl(path, *TETRAHEDRON)
        return check_mesh(path, **given)


CALLS: Mapping[str, tuple[Callable[..., Any], Arguments, Verify]] = {
    "Mould": (MouldSettings, {"floor_mm": 2.0, "pins": True, "levels": "two", "tolerance_mm": 0.01}, a_section),
    "Printer": (PrinterSettings, {"nozzle_mm": 0.4, "bed_mm": [1.0, 1.0, 1.0], "resin": False}, a_section),
    "Dispenser": (DispenserSettings, {"tip_mm": 0.37, "origin_mm": [1.0, 2.0], "box_mm": [0.0, 9.0] * 3}, a_section),
    "Settings": (
        FabricationSettings,
        {"mould": MouldSettings(), "printer": PrinterSettings(), "pad": PadSettings()},
        lambda found, given: None,
    ),
    "Plan": (Plan, {"pad": PAD, "settings": FabricationSettings()}, lambda found, given: None),
    "check": (check, {"pad": PAD, "settings": FabricationSettings()}, findings),
    "build": (
        written,
        {"pad": PAD, "formats": ["svg"], "settings": FabricationSettings(), "inputs": []},
        lambda found, given: None,
    ),
    "build_mould": (build_mould, {"pad": PAD, "settings": FabricationSettings()}, lambda found, given: None),
    "check_mesh": (mesh_file, {"printer": PrinterSettings(), "min_silicone_mm": 0.4, "genus": 0}, findings),
    "check_mesh.path": (check_mesh, {"path": "nowhere.stl"}, findings),
    "inspect_mesh": (
        inspect_mesh,
        {"vertices": TETRAHEDRON[0], "triangles": TETRAHEDRON[1], "min_silicone_mm": 0.4, "genus": None},
        findings,
    ),
    "sound": (sound, {"vertices": TETRAHEDRON[0], "triangles": TETRAHEDRON[1], "genus": 0}, findings),
}


@settings(few(150), suppress_health_check=LAX)
@given(st.data())
def test_any_argument_gives_a_right_result_or_one_line(data):
    call_spoiled(CALLS, data)


@st.composite
def tables(draw: st.DrawFn) -> FabricationSettings:
    """Settings at the limits of what each key allows, some of them at a time."""
    ends: dict[str, list[Any]] = {
        "floor_mm": [0.4, 50.0],
        "wall_mm": [0.8, 50.0],
        "wall_draft_deg": [0.0, 30.0],
        "silicone_mm": [1e-300, 1e-3, 1.3, 100.0],
        "border_mm": [1e-9, 1e-5, 100.0],
        "ridge_width_mm": [0.1, 3.0, 20.0],
        "ridge_draft_deg": [1e-9, 1.0, 20.0],
        "deep_ridge_height_mm": [1e-9, 0.5, 50.0],
        "shallow_ridge_height_mm": [1e-300, 1e-6, 1.19, 1.1999999999],
        "levels": ["two"],
        "min_silicone_mm": [0.0, 1e-9, 10.0],
        "exit_mm": [0.0, 1e-9, 1e-4, 50.0],
        "exit_width_mm": [1e-9, 0.4000001, 11.0, 50.0],
        "number_mm": [0.0, 1e-9, 0.01, 20.0],
        "pins": [True],
        "lid": [True],
        "conductive": [True],
        "lead_mm": [0.0, 1000.0],
        "tolerance_mm": [1e-3, 0.1],
    }
    keys = draw(st.sets(st.sampled_from(sorted(ends)), max_size=4))
    mould = MouldSettings(**{key: draw(st.sampled_from(ends[key])) for key in sorted(keys)})
    if draw(st.booleans()):
        mould = mould.model_copy(update={"lid": True, "spout": True})
    printer = PrinterSettings(
        nozzle_mm=draw(st.sampled_from([0.4, 0.01, 5.0])),
        layer_mm=draw(st.sampled_from([0.1, 0.01, 2.0])),
        resin=draw(st.booleans()),
    )
    pad = PadSettings(deep_family=draw(st.sampled_from(["horizontal", "vertical"])))
    silicone = SiliconeSettings(shrinkage=draw(st.sampled_from([None, 1e-12, 1e-3, 0.2])))
    fibre = FibreSettings(diameter_mm=draw(st.sampled_from([None, 1e-300, 10.0])))
    return FabricationSettings(mould, printer, pad, silicone=silicone, fibre=fibre)


def of_a_sound_mould(found: list[Finding]) -> None:
    findings(found, {})
    broken = [finding.message for finding in found if finding.name in SOUND and finding.status == "fail"]
    assert not broken, broken


@settings(few(8), suppress_health_check=LAX)
@given(st.data())
def test_a_pad_however_wild_gives_a_closed_mould_or_one_line(data):
    plan_settings, pad = data.draw(tables()), data.draw(pads((1, 2), (0, 6)))
    with ends_in_time():
        try:
            plan = Plan(pad, plan_settings)
            vertices, _, found = meshed(plan)
        except InputError:
            return
    of_a_sound_mould(
        [f for f in found if pad.unit_mm < 100 or f.name != "self_intersection"]
    )  # floats are coarse there
    size = np.ptp(vertices.astype(float), axis=0)
    side = pad.layout.size_mm[0] + 2 * plan_settings.mould.border_mm
    assert size[0] > side
    assert size[1] > side
    assert size[2] > plan.settings.mould.floor_mm


@settings(few(4), suppress_health_check=LAX)
@given(st.data())
def test_whatever_is_built_is_whole_and_can_be_read_back(data):
    plan_settings, pad = data.draw(tables()), data.draw(pads((1, 2), (0, 4)))
    formats = data.draw(st.lists(st.sampled_from(["stl", "3mf", "svg", "dxf", "png"]), max_size=3))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out"
        with ends_in_time(20):
            try:
                document = build(pad, out, formats, plan_settings)
            except InputError:
                document = None
        if document is None:
            assert not out.exists()
            return
        names = {child.name for child in out.iterdir()}
        assert names == {*document["files"], "laying.md", "orientation.svg", "fabrication.json"}
        assert json.loads((out / "fabrication.json").read_text()) == json.loads(json.dumps(document))
        assert document["silicone_volume_ml"] >= 0
        for name in names:
            if name.endswith((".stl", ".3mf")):
                assert all(finding.status != "fail" for finding in sound(*read_mesh(out / name)))


@settings(few(1), suppress_health_check=LAX)
@given(st.data())
def test_the_cad_solid_of_a_wild_pad_is_valid_or_refused(data):
    plan_settings, pad = data.draw(tables()), data.draw(pads((1, 2), (0, 4)))
    with ends_in_time(30):
        try:
            solid = build_mould(pad, plan_settings)
        except InputError:
            return
    assert solid.is_valid
    assert solid.volume > 0


@st.composite
def meshes(draw: st.DrawFn) -> tuple[Any, Any]:
    """Meshes that are broken in one way or another, or sound at an odd scale."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    vertices, triangles = draw(st.sampled_from([TETRAHEDRON, BLOCKS]))
    vertices, triangles = vertices.copy(), triangles.copy()
    copies = draw(st.sampled_from([1, 1, 2, 30]))
    vertices = np.concatenate([vertices + rng.choice([0, 0.5, 1, 3], 3) for _ in range(copies)])
    triangles = np.concatenate([triangles + i * len(vertices) // copies for i in range(copies)])
    with np.errstate(all="ignore"):
        for spoil in draw(st.lists(st.sampled_from(sorted(_SPOILS)), max_size=2)):
            vertices, triangles = _SPOILS[spoil](vertices, triangles, rng)
        vertices = vertices * draw(st.sampled_from([1, 1, 20, 1e-9, 1e-4, 1e5, 1e300]))
    return vertices, triangles


def _with(vertices: Array, value: float) -> Array:
    changed = vertices.copy()
    changed[:1] = value
    return changed


_SPOILS: dict[str, Callable[..., tuple[Any, Any]]] = {
    "nan": lambda v, t, rng: (_with(v, np.nan), t),
    "inf": lambda v, t, rng: (_with(v, np.inf), t),
    "none": lambda v, t, rng: (v, t[:0]),
    "one": lambda v, t, rng: (v, t[:1]),
    "open": lambda v, t, rng: (v, t[1:]),
    "inside out": lambda v, t, rng: (v, t[:, ::-1]),
    "one turned": lambda v, t, rng: (v, np.concatenate([t[:1, ::-1], t[1:]])),
    "doubled": lambda v, t, rng: (v, np.concatenate([t, t])),
    "out of range": lambda v, t, rng: (v, t + 3),
    "below range": lambda v, t, rng: (v, t.astype(int) - 1),
    "needles": lambda v, t, rng: (v * [1, 1, 1e-9], t),
    "flat": lambda v, t, rng: (v * [1, 1, 0], t),
    "a point": lambda v, t, rng: (0 * v, t),
    "soup": lambda v, t, rng: (rng.normal(size=(300, 3)), rng.integers(0, 300, (200, 3))),
    "f4": lambda v, t, rng: (v.astype(np.float32), t.astype(np.uint32)),
    "fortran": lambda v, t, rng: (np.asfortranarray(v), np.asfortranarray(t)),
    "shuffled": lambda v, t, rng: (v, rng.permutation(t)),
    "shaken": lambda v, t, rng: (v + rng.normal(0, 1e-7, v.shape), t),
}


@settings(few(40), suppress_health_check=LAX)
@given(meshes(), st.none() | st.integers(0, 2), st.sampled_from([False] * 20 + [True]))
def test_a_broken_mesh_has_findings_or_one_line(mesh, genus, drawn):
    vertices, triangles = mesh
    with ends_in_time():
        try:
            found = inspect_mesh(vertices, triangles, genus=genus)
        except InputError:
            return
        findings(found, {})
        names = {finding.name: finding.status for finding in found}
        closed = names["watertight"] == "pass" and len(triangles) > 0
        assert closed or "fail" in names.values()
        if not drawn:
            return
        with tempfile.TemporaryDirectory() as folder:
            draw_findings(np.asarray(vertices, float), np.asarray(triangles, int), found, Path(folder) / "picture.png")


@settings(few(30), suppress_health_check=LAX)
@given(meshes(), st.sampled_from([".stl", ".3mf"]))
def test_a_broken_mesh_in_a_file_has_findings_or_one_line(mesh, suffix):
    vertices, triangles = mesh
    if not len(triangles) or triangles.min() < 0 or triangles.max() >= len(vertices):
        return
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"), ends_in_time():
        path = Path(folder) / f"mesh{suffix}"
        if suffix == ".stl":
            write_stl(path, vertices, triangles)
        else:
            write_3mf(path, vertices, triangles, name="mould", title="broken", material="PLA")
        try:
            found = check_mesh(path)
        except InputError:
            return
    findings(found, {})


def test_many_triangles_through_one_place_are_told_in_time():
    rng = np.random.default_rng(0)
    with ends_in_time():
        found = sound(rng.normal(size=(90_000, 3)), np.arange(90_000).reshape(-1, 3))
    assert {f.name for f in found if f.status == "fail"} >= {"watertight", "self_intersection"}
