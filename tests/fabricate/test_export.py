import json
import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.interpolate import PchipInterpolator

from design.errors import InputError
from design.morphology import Morphology
from design.palette import HORIZONTAL, VERTICAL
from fabricate import export, printability
from fabricate.drawings import tracks_svg
from fabricate.export import FILES, build
from fabricate.outlines import Plan

from .planted import level_pad, with_settings

PAD = Morphology.random(3, 3, seed=7)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("mould")
    return out, build(PAD, out, list(FILES))


def test_all_files_are_there_and_nothing_else(built):
    out, document = built
    assert {path.name for path in out.iterdir()} == {*FILES.values(), "fabrication.json"}
    assert json.loads((out / "fabrication.json").read_text()) == document


def test_the_same_work_gives_the_same_bytes(built, tmp_path):
    out, _ = built
    build(PAD, tmp_path / "again", list(FILES))
    for name in (*FILES.values(), "fabrication.json"):
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


@pytest.mark.parametrize("border_mm", [0.0, 2.0])
def test_svg_holds_the_exact_curves(border_mm):
    root = ElementTree.fromstring(tracks_svg(Plan(PAD, with_settings({"border_mm": border_mm}))))
    side = PAD.size_mm + 2 * border_mm
    assert root.get("width") == root.get("height") == f"{side:.6g}mm"
    for family, name in enumerate(("horizontal", "vertical")):
        (group,) = (group for group in root if group.get("id") == name)
        assert len(group) == PAD.grid
        for number, path in enumerate(group):
            knots = PAD.knots[family * PAD.grid + number]
            curve = PchipInterpolator(knots[:, family], knots[:, 1 - family])
            numbers = np.array(re.findall(r"-?\d+(?:\.\d+)?(?:e-?\d+)?", path.get("d") or ""), dtype=float)
            points = PAD.to_grid(numbers.reshape(-1, 2) * (1, -1))
            ends, points = points[[0, -1]], points[1:-1]
            assert ends[:, family] == pytest.approx([-border_mm / 11.25, 4 + border_mm / 11.25], abs=1e-5)
            starts, spans = points[0::3], np.split(points[1:], len(knots) - 1)
            assert starts == pytest.approx(knots, abs=1e-5)
            for start, (b, c, d) in zip(starts[:-1], spans, strict=True):
                middle = (start + 3 * b + 3 * c + d) / 8
                digits = 1e-5 * (1 + abs(curve(middle[family], 1)))
                assert middle[1 - family] == pytest.approx(curve(middle[family]), abs=digits)


def test_png_shows_the_ridges_in_the_colours_of_their_families(built):
    out, _ = built
    with Image.open(out / "mould.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    for colour in (HORIZONTAL, VERTICAL):
        assert (np.abs(pixels - [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).max(axis=2) < 8).mean() > 0.003


def test_the_document_has_what_a_lab_needs(built):
    _, document = built
    assert document["format"] == "padforge-fabrication/1"
    assert document["size_mm"] == [49.0, 49.0, 8.0]
    assert {finding["name"] for finding in document["findings"]} >= {"watertight", "bed", "layers", "tray_wall"}
    assert set(document["provenance"]) == {"command", "seed", "versions", "inputs"}
    assert len(document["crossings"]["table"]) == document["crossings"]["total"] >= 9
    first, second, x, y = document["crossings"]["table"][0]
    assert {first.split()[0], second.split()[0]} <= {"horizontal", "vertical"}
    assert max(abs(x), abs(y)) < 22.5


def test_cut_lengths_and_silicone_of_a_straight_pad(tmp_path):
    document = build(Morphology.straight(4), tmp_path, [], with_settings({"border_mm": 1.0, "lead_mm": 20.0}))
    assert document["files"] == []
    assert [fibre["fibre"] for fibre in document["fibres"]][::7] == ["horizontal 1", "vertical 4"]
    assert {fibre["in_pad_mm"] for fibre in document["fibres"]} == {58.25}
    assert {fibre["cut_mm"] for fibre in document["fibres"]} == {98.25}
    tracks = 4 * 58.25 * 0.4 * (1.2 + 0.4) - 16 * 0.4**3
    assert document["silicone_volume_ml"] == pytest.approx((58.25**2 * 6 - tracks) / 1000, abs=1e-3)
    assert document["crossings"]["total"] == 16
    assert document["crossings"]["same_family"] == 0


def test_same_family_crossings_are_counted(tmp_path):
    assert build(level_pad(1.8, 1.2), tmp_path, [])["crossings"]["same_family"] == 2


def test_nothing_is_written_from_a_mould_in_two_pieces(tmp_path, monkeypatch):
    from manifold3d import Manifold

    boxes = Manifold.cube((1, 1, 1)) + Manifold.cube((1, 1, 1)).translate((3, 0, 0))
    monkeypatch.setattr(printability, "plan_mesh", lambda plan: boxes)
    with pytest.raises(InputError, match=r"the mesh has 2 bodies.*nothing was written"):
        build(PAD, tmp_path / "out", ["stl"])
    assert not (tmp_path / "out").exists()


def test_nothing_is_written_when_mesh_and_solid_disagree(tmp_path, monkeypatch):
    from build123d import Solid

    monkeypatch.setattr(export, "build_mould", lambda pad, settings: Solid.make_box(1, 1, 1))
    with pytest.raises(InputError, match="nothing was written"):
        build(PAD, tmp_path / "out", ["stl", "step"])
    assert not (tmp_path / "out").exists()


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="'obj', allowed are stl, 3mf, step, svg, png"):
        build(PAD, tmp_path / "out", ["obj"])
    assert not (tmp_path / "out").exists()
