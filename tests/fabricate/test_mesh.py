import itertools
import json
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
import trimesh.exchange.stl

from padforge.common.validation import InputError
from padforge.fabricate.checks.mesh_checks import check_mesh, check_triangles
from padforge.fabricate.mesh import read_mesh, write_3mf, write_stl

BOX = trimesh.creation.box((10, 20, 5))
VERTICES, TRIANGLES = np.asarray(BOX.vertices), np.asarray(BOX.faces)
CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"


def written(path: Path, vertices: np.ndarray = VERTICES, title: str = "box") -> Path:
    if path.suffix == ".stl":
        write_stl(path, vertices, TRIANGLES)
    else:
        write_3mf(path, vertices, TRIANGLES, name="mould", title=title, material=title)
    return path


TEXT = trimesh.exchange.stl.export_stl_ascii(trimesh.Trimesh(VERTICES + 0.5, TRIANGLES, process=False)).encode()
BINARY = trimesh.exchange.stl.export_stl(trimesh.Trimesh(VERTICES + 0.5, TRIANGLES, process=False))


@pytest.mark.parametrize(
    ("content", "warning"),
    [
        (BINARY + b"\r\n", "states 12 triangles, holds 12 and 2 stray bytes"),
        (BINARY[:80] + b"\x0e\0\0\0" + BINARY[84:], "states 14 triangles, holds 12 and 0 stray bytes"),
        (TEXT.replace(b"endsolid", b""), "its end is missing, all facets before it are read"),
        (TEXT.replace(b".", b","), f"commas in {TEXT.count(b'.')} numbers are read as decimal points"),
    ],
    ids=["tail", "count", "end", "commas"],
)
def test_read_mesh_reads_what_is_whole_of_an_stl_with_a_warning(tmp_path, caplog, content, warning):
    (path := tmp_path / "defect.stl").write_bytes(content)
    vertices, triangles = read_mesh(path)
    assert vertices[triangles] == pytest.approx(VERTICES[TRIANGLES] + 0.5, abs=1e-6)
    assert caplog.messages == [f"{path}: {warning}"]


@pytest.mark.parametrize("suffix", [".stl", ".3mf"])
def test_read_mesh_returns_what_was_written(tmp_path, suffix):
    moved = VERTICES + np.array([0.1, -123.456, 7])
    vertices, triangles = read_mesh(written(tmp_path / f"box{suffix}", moved))
    assert vertices[triangles] == pytest.approx(moved[TRIANGLES].astype("f4"))
    assert {finding.status for finding in check_mesh(tmp_path / f"box{suffix}")} == {"pass"}
    if suffix == ".stl":  # of 80 bytes, then the number of triangles, then each with its normal, outwards
        triangle = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]
        records = np.frombuffer((tmp_path / "box.stl").read_bytes(), triangle, offset=84)
        np.testing.assert_allclose(records["normal"], BOX.face_normals, atol=1e-6)


def test_3mf_escapes_text_and_read_mesh_converts_units(tmp_path):
    path, hostile = tmp_path / "odd.3mf", '<a href="&amp;">"\''
    written(path, title=hostile)
    with zipfile.ZipFile(path) as archive:
        content = archive.read("3D/3dmodel.model").decode()
    model = ElementTree.fromstring(content)
    assert model.findtext(f"{{{CORE}}}metadata[@name='Title']") == hostile
    assert [base.get("name") for base in model.iter(f"{{{CORE}}}base")] == [hostile]
    packed(path, content.replace('unit="millimeter"', 'unit="inch"'))
    assert np.ptp(read_mesh(path)[0], axis=0) == pytest.approx([254, 508, 127])


def test_read_mesh_of_several_bodies_in_ascii_stl_and_3mf(tmp_path):
    far = BOX.copy().apply_translation((30, 0, 0))
    text = "\n".join(trimesh.exchange.stl.export_stl_ascii(mesh) for mesh in (BOX, far))
    (tmp_path / "two.stl").write_text(text)
    trimesh.Scene([BOX, BOX.copy().apply_translation((5, 4, 0))]).export(tmp_path / "two.3mf")
    found = (check_mesh(tmp_path / name) for name in ("two.stl", "two.3mf"))
    apart, across = ({finding.name: finding for finding in findings} for findings in found)
    assert (apart["bodies"].status, apart["bodies"].measured) == ("fail", 2)
    assert apart["self_intersection"].status == "pass"
    assert across["bodies"].status == across["self_intersection"].status == "fail"


def packed(path: Path, model: str) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return path


def model(objects: str, items: str) -> str:
    return f'<model unit="millimeter" xmlns="{CORE}"><resources>{objects}</resources><build>{items}</build></model>'


MODIFIER = (  # beside a part, as slicers write them
    '<object id="2" type="other">{}</object><object id="3"><components><component objectid="1"/>'
    '<component objectid="2"/></components></object>'
)
TRIANGLE = (
    '<mesh><vertices><vertex x="0" y="0" z="0"/><vertex x="1" y="0" z="0"/><vertex x="0" y="1" z="0"/></vertices>'
    '<triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh>'
)


@pytest.mark.parametrize(
    ("objects", "items", "n_triangles", "n_left_out"),
    [
        ('<object id="2">{}</object>', "", 1, 0),  # no item of the build
        ('<object id="2" type="model">{}</object>', '<item objectid="2" printable="1"/>', 2, 0),
        ('<object id="2">{}</object>', '<item objectid="2" printable="0"/>', 1, 1),
        ('<object id="2" type="support">{}</object>', '<item objectid="2"/>', 1, 1),
        (MODIFIER, '<item objectid="3"/>', 2, 1),
    ],
)
def test_read_mesh_leaves_out_what_is_not_printed(tmp_path, caplog, objects, items, n_triangles, n_left_out):
    content = model(f'<object id="1">{TRIANGLE}</object>{objects.format(TRIANGLE)}', f'<item objectid="1"/>{items}')
    _, triangles = read_mesh(packed(tmp_path / "model.3mf", content))
    assert len(triangles) == n_triangles
    assert ["1 objects that are not printed are left out" in line for line in caplog.messages] == [True] * n_left_out


BEYOND = TRIANGLE.replace('v3="2"', 'v3="9"')
BROKEN_FILES = {
    "missing.3mf": model("", '<item objectid="1"/>'),
    "none.3mf": model("", ""),
    "beyond.3mf": model(f'<object id="1">{BEYOND}</object>', '<item objectid="1"/>'),
    "outside.3mf": '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///dev/zero">]><model>&a;</model>',
    "text.3mf": "no model at all",
}
TORN = [None, b"", b"solid\n", b"\0" * 84, b"\xff" * 500, BINARY[: 84 + 50 * 5], b"v 1.0 2.0 3.0\n" * 40]
ODD = [BINARY[:96] + np.float32(value).tobytes() + BINARY[100:] for value in (np.nan, np.inf)]


@pytest.mark.parametrize(
    ("name", "content"),
    [*BROKEN_FILES.items(), *itertools.product(("torn.stl", "torn.3mf"), TORN), *itertools.product(["odd.stl"], ODD)],
)
def test_check_mesh_refuses_other_files_in_one_line(tmp_path, name, content):
    if isinstance(content, str):
        packed(tmp_path / name, content)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=rf"^[^\n]*{name}[^\n]*$"):
        check_mesh(tmp_path / name)


RNG = np.random.default_rng(0)
BROKEN = {
    "none": (VERTICES, TRIANGLES[:0]),
    "open": (VERTICES, TRIANGLES[1:]),
    "inside out": (VERTICES, TRIANGLES[:, ::-1]),
    "doubled": (VERTICES, np.concatenate([TRIANGLES, TRIANGLES])),
    "flat": (VERTICES * [1, 1, 0], TRIANGLES),
    "soup": (RNG.normal(size=(300, 3)), RNG.integers(0, 300, (200, 3))),
}
SOUND = {
    "shuffled": (VERTICES.astype(np.float32), RNG.permutation(TRIANGLES)),
    "shaken": (VERTICES + RNG.normal(0, 1e-7, VERTICES.shape), TRIANGLES),
}


@pytest.mark.parametrize("name", [*BROKEN, *SOUND])
def test_check_triangles_detects_broken_meshes_of_any_size(name):
    vertices, triangles = (BROKEN | SOUND)[name]
    for size in (1e-9, 1.0, 1e4):
        found = check_triangles(vertices * size, triangles)
        json.dumps([finding.to_dict() for finding in found], allow_nan=False)
        statuses = {finding.name: finding.status for finding in found}
        if name in BROKEN:
            assert "fail" in statuses.values()
        elif size == 1:
            assert statuses["watertight"] == statuses["volume"] == statuses["bodies"] == "pass"
