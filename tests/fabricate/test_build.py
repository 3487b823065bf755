import errno
import json
import logging
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import shapely
import trimesh
from build123d import Compound, Solid
from matplotlib.colors import to_hex

from padforge.common import plotting
from padforge.common.files import sha256
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate import export, mould
from padforge.fabricate.cad import model, step_file
from padforge.fabricate.export import FORMATS, Build, build
from padforge.fabricate.mould import LID_MM, Body, Prism
from padforge.fabricate.outputs import pictures
from tests.fabricate.planted import level_pad, with_settings
from tests.helpers.folders import files_in
from tests.helpers.less import small_pictures
from tests.helpers.refusals import refusal_table

PAD = Morphology.random((1, 2), 2, seed=7, pitch_mm=(12.0, 10.0))
FILES = {f"{body}.{suffix}" for body in ("mould", "lid", "conductive", "holder") for suffix in ("stl", "3mf")}
FILES |= {f"figures/{name}" for name in ("mould.png", "tracks.png", "toolpath.svg")}
FILES |= {"mould.step", "tracks.svg", "tracks.dxf", "laying.gcode"}
BESIDE = {"laying.md", "figures/orientation.svg", "figures/crossing.svg"}
FILES |= {"fabrication.json", *BESIDE}
SETTINGS = with_settings({"lid": True, "pins": True, "conductive": True, "holder": True})


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Build]:
    out = tmp_path_factory.mktemp("mould")
    with pytest.MonkeyPatch.context() as patch:
        small_pictures(patch)
        return out, build(PAD, out, tuple(FORMATS), SETTINGS)


def test_build_writes_all_files_with_their_digests_and_no_others(built):
    out, result = built
    assert files_in(out).keys() == FILES
    assert {*result.files} == FILES - {"fabrication.json", *BESIDE}
    assert json.loads((out / "fabrication.json").read_text()) == json.loads(json.dumps(result.to_dict()))
    assert result.sha256 == {name: sha256(out / name) for name in FILES - {"fabrication.json"}}


AGAIN = """
import sys
from pathlib import Path
sys.path.append(sys.argv[1])
from padforge.common import plotting
from padforge.fabricate.outputs import pictures
from tests.fabricate.test_build import FORMATS, PAD, SETTINGS, build
plotting.DPI, pictures.PIXELS = map(int, sys.argv[3:])
build(PAD, Path(sys.argv[2]), tuple(FORMATS), SETTINGS)
"""


@pytest.mark.slow
def test_build_is_reproducible_to_the_byte(built, tmp_path, monkeypatch):
    """In another process, where shapes have other addresses, and sets of strings another order."""
    small_pictures(monkeypatch)
    arguments = [Path(__file__).parents[2], tmp_path / "again", plotting.DPI, pictures.PIXELS]
    command = [sys.executable, "-c", AGAIN, *map(str, arguments)]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONHASHSEED": "1"})
    for name in FILES:
        assert (tmp_path / "again" / name).read_bytes() == (built[0] / name).read_bytes(), name


@pytest.mark.parametrize("name", ["mould.stl", "mould.3mf"])
def test_meshes_read_back_closed(built, name):
    out, result = built
    mesh = trimesh.load_mesh(out / name)
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.extents == pytest.approx(result.size_mm, abs=1e-4)
    assert mesh.volume / 1000 == pytest.approx(result.mould_volume_ml, abs=1e-3)


def test_3mf_is_one_named_object_of_one_material_in_strict_mode(built, golden):
    out, _ = built
    texts = []
    for body in ("mould", "lid", "conductive", "holder"):
        model = zipfile.ZipFile(out / f"{body}.3mf").read("3D/3dmodel.model").decode()
        texts.append(re.sub(r"<(vertices|triangles)>.*?</\1>", r"<\1/>", model))
    golden("fabricate/models.3mf.txt", "\n".join(texts).replace("><", ">\n<"), forget=[r"(?<=>padforge )[^<]*"])
    lib3mf = pytest.importorskip("lib3mf")
    reader = lib3mf.get_wrapper().CreateModel().QueryReader("3mf")
    reader.SetStrictModeActive(True)
    reader.ReadFromFile(str(out / "mould.3mf"))
    assert reader.GetWarningCount() == 0


def step_lines(part: Any, indent: str = "") -> Iterator[str]:
    """The parts of a STEP file by name, with colour, solids, faces and volume."""
    colour = "-" if part.color is None else to_hex(tuple(part.color))
    counts, low = f"{len(part.solids())} solids, {len(part.faces())} faces", part.bounding_box().min
    yield f"{indent}{part.label}: {colour}, {counts}, {part.volume:.2f} mm³ from {low.X:.2f} {low.Y:.2f} {low.Z:.2f}"
    for child in part.children:
        yield from step_lines(child, f"{indent}  ")


def test_step_reads_back_as_valid_solids_of_the_volumes_of_the_meshes(built, golden):
    from build123d import import_step  # takes seconds, also in workers that run other tests

    out, result = built
    whole = import_step(out / "mould.step")
    assert whole.is_valid
    head, _, data = (out / "mould.step").read_text().partition("DATA;")
    golden("fabricate/mould.step.txt", head + "\n".join(step_lines(whole)), forget=[r"(?<=processor )[\d.]+"])
    points = re.findall(r"CARTESIAN_POINT\(([^;]*)\)", data)
    assert len(set(points)) <= len(points) < 1.02 * len(set(points))  # each is written once
    volume = {part.label: part.volume for part in whole.children}
    for name in ("lid", "holder"):  # the mesh has polygons for circles
        assert volume[name] == pytest.approx(trimesh.load_mesh(out / f"{name}.stl").volume, rel=1e-4)
    (finding,) = (finding for finding in result.findings if finding.name == "cad_solid")
    assert finding.status == "pass"
    assert 0 < finding.measured < 2e-4 == finding.limit
    volumes = f"16 solids, their volumes within {100 * finding.measured:.3f} % of the mesh's"
    assert finding.message == f"{volumes}, curves within 2 µm"


def test_refused_builds_write_nothing(tmp_path, monkeypatch, golden):
    """For what is asked, or for what is planted in a sound mould with a lid."""
    out, two_levels, right = tmp_path / "out", with_settings({"levels": "two"}), model.body_solid
    pieces = Body((Prism(shapely.box(0, 0, 9, 9), 0, 1), Prism(shapely.box(10, 0, 19, 9), 0, 1)))

    def planted(module: Any, name: str, value: object, *formats: str) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(module, name, value)
            build(Morphology.straight(1), out, formats, with_settings({"lid": True}))

    def other_lid(solid: Any) -> Any:
        return lambda body: solid if body.base[0].top_mm == LID_MM else right(body)

    box = Solid.make_box(1, 1, 1)
    rows = {
        "a format": partial(build, level_pad(1.8, 1.2), out, ["obj"], two_levels),
        "crossings of two levels": partial(build, level_pad(1.8, 1.2), out, ["svg"], two_levels),
        "a lid in pieces": partial(planted, mould, "lid_body", lambda plan: pieces, "stl"),
        "another solid": partial(planted, model, "body_solid", other_lid(box), "step"),
        "an invalid solid": partial(planted, model, "body_solid", other_lid(Compound([box])), "step"),
        "no file": partial(planted, step_file.STEPCAFControl_Writer, "Write", lambda *_: None, "stl", "step"),
    }
    golden("fabricate/refusals_of_builds.txt", refusal_table(rows))
    assert not out.exists() or not files_in(out)


def test_interrupted_build_keeps_the_old_mould(tmp_path, monkeypatch):
    """At its last file, when all others are written."""
    build(PAD, tmp_path, ["stl", "svg"])
    before = files_in(tmp_path)

    def stopped(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(export.files, "write_json", stopped)
    with pytest.raises(InputError):
        build(Morphology.straight(2), tmp_path, ["stl", "svg"])
    assert files_in(tmp_path) == before


def test_build_deletes_earlier_files_unless_they_were_changed(tmp_path, caplog):
    caplog.set_level(logging.INFO, "padforge")
    build(PAD, tmp_path, ["3mf", "stl", "svg", "dxf"])
    (tmp_path / "tracks.dxf").write_text("drawn upon")
    for name in ("mine.stl", "mould.step"):
        (tmp_path / name).write_text("somebody's own")
    result = build(Morphology.straight(2), tmp_path, ["stl"])
    left = {"mine.stl", "mould.step", "tracks.dxf"}
    assert files_in(tmp_path).keys() == {*result.sha256, "fabrication.json"} | left
    assert result.sha256.keys() == {"mould.stl", *BESIDE}
    deleted = "deleted, it belonged to the previous mould"
    assert caplog.messages == [
        *(f"{tmp_path / name}: {deleted}" for name in ("mould.3mf", "tracks.svg")),
        f"{tmp_path / 'tracks.dxf'}: kept, it belongs to the previous mould but was changed since",
    ]


def test_provenance_is_of_the_input_at_the_start(tmp_path, monkeypatch):
    """A search that writes into the folder of the pad meanwhile must not make it one of the new fibres."""
    pad = tmp_path / "morphology.json"
    PAD.save(pad)
    read, check = sha256(pad), export.check_plan

    def meanwhile(*arguments):
        Morphology.straight(2).save(pad)
        return check(*arguments)

    monkeypatch.setattr(export, "check_plan", meanwhile)
    assert build(PAD, tmp_path, [], inputs=[pad]).provenance["inputs"] == {"morphology.json": read}
