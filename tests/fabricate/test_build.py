import json
import math
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
import trimesh

from design.common.errors import InputError
from design.pad.morphology import Morphology
from fabricate import export
from fabricate.export import FORMATS, build
from fabricate.mould.prisms import Body, Prism
from tests.fabricate.planted import level_pad, with_settings

PAD = Morphology.random(1, 2, seed=7)


FILES = {
    *(f"{body}.{suffix}" for body in ("mould", "lid", "conductive", "holder") for suffix in ("stl", "3mf", "step")),
    *("tracks.svg", "tracks.dxf", "mould.png", "tracks.png", "laying.md", "fabrication.json"),
}
SETTINGS = with_settings({"lid": True, "pins": True, "conductive": True, "holder": True})


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("mould")
    return out, build(PAD, out, FORMATS, SETTINGS)


def test_all_files_are_there_and_nothing_else(built):
    out, document = built
    assert {path.name for path in out.iterdir()} == FILES
    assert {*document["files"]} == FILES - {"fabrication.json", "laying.md"}
    assert json.loads((out / "fabrication.json").read_text()) == document


def test_the_same_work_gives_the_same_bytes(built, tmp_path):
    out, _ = built
    build(PAD, tmp_path / "again", FORMATS, SETTINGS)
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


@pytest.mark.parametrize("name", ["mould.stl", "mould.3mf"])
def test_meshes_read_back_closed(built, name):
    if name.endswith("3mf"):
        pytest.importorskip("lxml")
    out, document = built
    mesh = trimesh.load_mesh(out / name)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.extents == pytest.approx(document["size_mm"], abs=1e-4)
    assert mesh.volume / 1000 == pytest.approx(document["mould_volume_ml"], abs=1e-3)


def test_stl_normals_point_out(built):
    out, _ = built
    layout = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
    records = np.frombuffer((out / "mould.stl").read_bytes()[84:], dtype=layout)
    a, b, c = np.moveaxis(records["corners"].astype(float), 1, 0)
    area = np.cross(b - a, c - a)
    large = np.linalg.norm(area, axis=1) > 1e-3
    assert np.linalg.norm(records["normal"], axis=1)[large] == pytest.approx(1, abs=1e-5)
    assert ((area * records["normal"]).sum(axis=1) > 0)[large].all()


def test_3mf_is_in_millimetres(built):
    out, _ = built
    with zipfile.ZipFile(out / "mould.3mf") as archive:
        assert archive.testzip() is None
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    assert model.get("unit") == "millimeter"


def test_step_reads_back_as_the_same_solid(built):
    from build123d import import_step

    out, document = built
    solid = import_step(out / "mould.step")
    assert solid.is_valid
    assert solid.volume / 1000 == pytest.approx(document["mould_volume_ml"], rel=1e-3)


def test_the_document_has_what_a_lab_needs(built):
    _, document = built
    assert document["format"] == "padforge-fabrication/1"
    side = 22.5 + 2 * (2 + 2 + 6 * math.tan(math.radians(2)))
    assert document["size_mm"] == pytest.approx([side, side, 8.0 + 2.0], abs=1e-4)  # pins stand above the walls
    assert document["sizes"]["tray_mm"] == pytest.approx(side)
    assert document["frame"]["centre_mm"] == [110, 110]
    assert {finding["name"] for finding in document["findings"]} >= {"watertight", "bed", "layers", "tray_wall"}
    assert set(document["provenance"]) == {"command", "seed", "versions", "inputs"}
    assert len(document["crossings"]["table"]) == document["crossings"]["total"] >= PAD.grid**2
    first, second, x, y, *_ = document["crossings"]["table"][0]
    assert {first.split()[0], second.split()[0]} <= {"horizontal", "vertical"}
    assert max(abs(x), abs(y)) < 22.5 / 2


def test_same_family_crossings_are_counted(tmp_path):
    assert build(level_pad(1.8, 1.2), tmp_path, [])["crossings"]["same_family"] == 2


def test_without_a_holder_nobody_knows_where_the_pad_lies(tmp_path):
    assert "frame" not in build(PAD, tmp_path, [])


def test_nothing_is_written_from_a_mould_in_two_pieces(tmp_path, monkeypatch):
    pieces = Body((Prism(shapely.box(0, 0, 9, 9), 0, 1), Prism(shapely.box(10, 0, 19, 9), 0, 1)))
    monkeypatch.setattr(export, "mould_body", lambda plan: pieces)
    with pytest.raises(InputError, match=r"the mesh has 2 bodies.*nothing was written"):
        build(PAD, tmp_path / "out", ["stl"])
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_when_mesh_and_solid_disagree(tmp_path, monkeypatch):
    from build123d import Solid

    monkeypatch.setattr(export, "valid_solid", lambda mesh, name: Solid.make_box(1, 1, 1))
    with pytest.raises(InputError, match="nothing was written"):
        build(PAD, tmp_path / "out", ["stl", "step"])
    assert not (tmp_path / "out").exists()


def test_a_pad_the_settings_refuse_writes_nothing(tmp_path):
    with pytest.raises(InputError, match="2 crossings"):
        build(level_pad(1.8, 1.2), tmp_path / "out", ["svg"], with_settings({"levels": "two"}))
    assert not (tmp_path / "out").exists()


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="'obj', allowed are stl, 3mf, step, svg, dxf, png"):
        build(PAD, tmp_path / "out", ["obj"])
    assert not (tmp_path / "out").exists()
