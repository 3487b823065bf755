import errno
import json
import math
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
import trimesh

from design.common.errors import InputError
from design.common.files import sha256
from design.pad.morphology import Morphology
from fabricate import export
from fabricate.export import FORMATS, build
from fabricate.mesh_files import COLOURS, write_3mf
from fabricate.mould.prisms import Body, Prism
from fabricate.settings import DEFAULTS, DispenserSettings
from tests.fabricate.planted import level_pad, with_settings

PAD = Morphology.random(1, 2, seed=7)


FILES = {
    *(f"{body}.{suffix}" for body in ("mould", "lid", "conductive", "holder") for suffix in ("stl", "3mf")),
    "mould.step",
    *("tracks.svg", "tracks.dxf", "mould.png", "tracks.png", "laying.md", "orientation.svg", "fabrication.json"),
    *("laying.gcode", "laying.script", "dispensing.svg"),
}
SETTINGS = with_settings({"lid": True, "pins": True, "conductive": True, "holder": True})


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("mould")
    return out, build(PAD, out, FORMATS, SETTINGS)


def test_all_files_are_there_and_nothing_else(built):
    out, document = built
    assert {path.name for path in out.iterdir()} == FILES
    assert {*document["files"]} == FILES - {"fabrication.json", "laying.md", "orientation.svg"}
    assert json.loads((out / "fabrication.json").read_text()) == document


def test_the_document_has_the_digest_of_every_other_file(built):
    out, document = built
    assert document["sha256"] == {name: sha256(out / name) for name in FILES - {"fabrication.json"}}


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


@pytest.mark.parametrize("body", ["mould", "lid", "conductive", "holder"])
def test_3mf_is_strictly_one_named_object_of_one_material(built, body):
    lib3mf = pytest.importorskip("lib3mf")
    out, document = built
    model = lib3mf.get_wrapper().CreateModel()
    reader = model.QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(out / f"{body}.3mf"))
    assert reader.GetWarningCount() == 0
    assert model.GetUnit() == lib3mf.ModelUnit.MilliMeter
    (item,) = listed(model.GetBuildItems(), "GetCurrent")
    (found,) = listed(model.GetMeshObjects(), "GetCurrentMeshObject")
    assert found.GetName() == body
    assert found.GetType() == lib3mf.ObjectType.Model
    assert found.IsManifoldAndOriented()
    assert item.GetObjectResourceID() == found.GetResourceID()
    (group,) = listed(model.GetBaseMaterialGroups(), "GetCurrentBaseMaterialGroup")
    (material,) = group.GetAllPropertyIDs()
    colour = group.GetDisplayColor(material)
    assert group.GetName(material) == "PLA"
    assert f"#{colour.Red:02X}{colour.Green:02X}{colour.Blue:02X}" == COLOURS[body]
    assert found.GetObjectLevelProperty() == (group.GetUniqueResourceID(), material, True)
    told = [model.GetMetaDataGroup().GetMetaData(k) for k in range(model.GetMetaDataGroup().GetMetaDataCount())]
    version = document["provenance"]["versions"]["padforge"]
    assert {each.GetName(): each.GetValue() for each in told} == {
        "Title": f"{body}, for a pad of 1 + 1 fibres 11.25 mm apart",
        "Application": f"padforge {version}",
    }


def listed(iterator, current: str) -> list:
    """All that an iterator of lib3mf goes through."""
    found = []
    while iterator.MoveNext():
        found.append(getattr(iterator, current)())
    return found


def test_3mf_opens_in_cad_by_its_name_and_colour(built):
    from build123d import Mesher

    out, _ = built
    (solid,) = Mesher().read(out / "lid.3mf")
    assert solid.label == "lid"
    assert solid.color
    assert solid.is_valid
    red, green, blue, _ = solid.color
    assert "#{:02X}{:02X}{:02X}".format(*(round(255 * part) for part in (red, green, blue))) == COLOURS["lid"]


def test_words_of_a_3mf_are_text(tmp_path):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    path, hostile = tmp_path / "odd.3mf", '<a href="&amp;">"\''
    write_3mf(path, corners, triangles, name="mould", title=hostile, material=hostile)
    with zipfile.ZipFile(path) as archive:
        model = ElementTree.fromstring(archive.read("3D/3dmodel.model"))
    core = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    assert model.findtext(f"{core}metadata[@name='Title']") == hostile
    assert [base.get("name") for base in model.iter(f"{core}base")] == [hostile]


def test_the_document_has_what_a_lab_needs(built):
    _, document = built
    assert document["format"] == "padforge-fabrication/1"
    side = 22.5 + 2 * (2 + 2 + 6 * math.tan(math.radians(2)))
    assert document["size_mm"] == pytest.approx([side, side, 8.0 + 2.0], abs=1e-4)  # pins stand above the walls
    assert document["sizes"]["tray_mm"] == pytest.approx(side)
    assert document["frame"]["centre_mm"] == [110, 110]
    assert document["frame"]["mirrored"] is True
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


def test_a_pad_the_settings_refuse_writes_nothing(tmp_path):
    with pytest.raises(InputError, match="2 crossings"):
        build(level_pad(1.8, 1.2), tmp_path / "out", ["svg"], with_settings({"levels": "two"}))
    assert not (tmp_path / "out").exists()


def test_what_stops_the_needle_is_told(tmp_path):
    settings = replace(DEFAULTS, dispenser=DispenserSettings(origin_mm=(10.0, 110.0)))
    by_hand, by_machine = build(PAD, tmp_path, [], settings), build(PAD, tmp_path, ["urscript"], settings)
    found = {finding["name"]: finding["status"] for finding in by_machine["findings"]}
    assert (found.pop("dispenser_box"), found.pop("dispenser_tip")) == ("fail", "pass")
    assert [*found] == [finding["name"] for finding in by_hand["findings"]]
    assert "dispenser" not in by_hand["settings"]
    assert by_machine["settings"]["dispenser"]["origin_mm"] == [10.0, 110.0]
    assert by_machine["files"] == ["laying.script", "dispensing.svg"]


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="'obj', allowed are stl, 3mf, step, svg, dxf, png, gcode, urscript"):
        build(PAD, tmp_path / "out", ["obj"])
    assert not (tmp_path / "out").exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def full_disk(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("last", "stop"), [("draw_tracks", full_disk), ("draw_tracks", KeyboardInterrupt), ("write_json", full_disk)]
)
def test_a_stop_in_midway_leaves_the_old_mould_whole(tmp_path, monkeypatch, last, stop):
    build(PAD, tmp_path, ["stl", "svg", "png"])
    before = contents(tmp_path)

    def stopped(*arguments):
        raise stop if stop is KeyboardInterrupt else stop()

    monkeypatch.setattr(export, last, stopped)
    with pytest.raises(KeyboardInterrupt if stop is KeyboardInterrupt else InputError) as told:
        build(Morphology.straight(2), tmp_path, ["stl", "png"])
    assert contents(tmp_path) == before
    if last == "draw_tracks" and stop is full_disk:
        assert str(told.value) == f"{tmp_path / 'tracks.png'}: cannot be written (No space left on device)"


def test_a_folder_in_the_way_leaves_the_old_mould_whole(tmp_path):
    build(PAD, tmp_path, ["stl"])
    (tmp_path / "tracks.svg").mkdir()
    before = (tmp_path / "mould.stl").read_bytes()
    with pytest.raises(InputError, match=r"tracks\.svg: is a folder, expected a file or nothing"):
        build(Morphology.straight(2), tmp_path, ["stl", "svg"])
    assert (tmp_path / "mould.stl").read_bytes() == before


def test_a_step_file_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    def full(*_, **__):
        raise RuntimeError("Failed to write STEP file")  # what build123d makes of a full disk

    monkeypatch.setattr("build123d.export_step", full)
    with pytest.raises(InputError, match=r"mould\.step: cannot be written \(the CAD kernel could not write it"):
        build(PAD, tmp_path, ["stl", "step"])
    assert contents(tmp_path) == {}


def test_files_of_the_mould_before_go_unless_they_were_changed(tmp_path):
    build(PAD, tmp_path, ["stl", "svg", "dxf", "png"])
    (tmp_path / "tracks.dxf").write_text("drawn upon")
    for name in ("mine.stl", "mould.step"):
        (tmp_path / name).write_text("somebody's own")
    told: list[str] = []
    document = build(Morphology.straight(2), tmp_path, ["stl"], warn=told.append)
    left = {"mine.stl", "mould.step", "tracks.dxf"}
    assert {path.name for path in tmp_path.iterdir()} == {*document["sha256"], "fabrication.json"} | left
    assert document["sha256"].keys() == {"mould.stl", "laying.md", "orientation.svg"}
    gone = "is gone: it was of the mould before this one"
    assert told == [
        *(f"{tmp_path / name} {gone}" for name in ("mould.png", "tracks.png", "tracks.svg")),
        f"{tmp_path / 'tracks.dxf'} is left from the mould before this one: it is not as it was written",
    ]


@pytest.mark.parametrize("text", ["", "[]", '{"format": "padforge-fabrication/1", "sha256": ["mould.step"]}'])
def test_nothing_goes_by_a_document_that_says_nothing(tmp_path, text):
    (tmp_path / "fabrication.json").write_text(text)
    (tmp_path / "mould.step").write_text("somebody's own")
    build(PAD, tmp_path, [], warn=pytest.fail)
    assert (tmp_path / "mould.step").exists()


def test_a_mould_is_of_the_file_that_was_there_as_it_was_begun(tmp_path, monkeypatch):
    """A search that writes into the folder of the pad meanwhile must not make it one of the new fibres."""
    pad = tmp_path / "morphology.json"
    PAD.save(pad)
    read, inspect = sha256(pad), export.inspect

    def meanwhile(*arguments):
        Morphology.straight(2).save(pad)
        return inspect(*arguments)

    monkeypatch.setattr(export, "inspect", meanwhile)
    assert build(PAD, tmp_path, [], inputs=[pad])["provenance"]["inputs"] == {"morphology.json": read}
