"""All that `padforge fabricate` prints and writes for two small pads, kept whole, and what it refuses."""

import io
import json
from typing import Any, cast

import ezdxf
import pytest
from click.testing import CliRunner

from padforge.design.morphology import Morphology
from padforge.fabricate import export
from padforge.fabricate.cli import fabricate
from padforge.fabricate.outputs.pictures import draw_crossing, draw_orientation
from tests.fabricate.planted import level_pad
from tests.helpers.golden import json_text

pytestmark = pytest.mark.usefixtures("here")  # a pad.toml in the current folder is taken for the settings

CROSSED = """
[pad]
keep_out_mm = [[-12.0, 11.0, 3.2, 6.0], [[8, 8], [9, 8], [9, 9], [8, 9]]]
bent_radius_mm = 80.0
[mould]
border_mm = 1.0
lid = true
pins = true
holder = true
conductive = true
[silicone]
name = "Dragon Skin 20"
parts = [2, 1]
[fibre]
ohm_per_mm = 14.2
min_bend_radius_mm = 1.5
[printer]
bed_mm = [40, 220, 250]
[dispenser]
origin_mm = [60, 100]
travel_height_mm = 7.5
feed_mm_s = 6
"""
SIDE = """
[pad]
leads = "one side"
deep_family = "vertical"
[mould]
lid = true
spout = true
number_mm = 0
[printer]
resin = true
nozzle_mm = 0.05
layer_mm = 0.05
"""
PADS = {
    "crossed": (lambda: level_pad(1.8, 1.2), CROSSED, ()),
    "side": (lambda: Morphology.straight((1, 2), (12.0, 10.0)), SIDE, ("build",)),
}
"""Each with its settings, and the words of the command, which may be left out."""
PICTURES = ("mould", "tracks", "toolpath", "orientation", "crossing")
VERSIONS = r'(?<="versions": \{)[^}]*'
"""What differs between releases of libraries."""


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(fabricate, [str(argument) for argument in arguments], catch_exceptions=False)


def dxf_text(text: str) -> str:
    """Layers, extents and entities of a DXF: kind, layer, and where they lie."""
    document = ezdxf.read(io.StringIO(text))  # pyright: ignore[reportPrivateImportUsage]
    header = {name: document.header[name] for name in ("$ACADVER", "$INSUNITS", "$EXTMIN", "$EXTMAX")}
    lines = [f"{name} {value}" for name, value in header.items()]
    for layer in document.layers:
        lines.append(f"layer {layer.dxf.name}: colour {layer.color}, {layer.rgb}")
    for entity in cast(Any, document.modelspace()):
        match entity.dxftype():
            case "TEXT":
                _, place, _ = entity.get_placement()
                shown = f"{entity.dxf.text!r}, {entity.dxf.height:.3f} high at {place.x:.3f} {place.y:.3f}"
            case "LINE":
                shown = f"{entity.dxf.start.round(3)} to {entity.dxf.end.round(3)}"
            case "SPLINE":
                ends = [entity.control_points[at].round(4).tolist() for at in (0, -1)]
                shown = f"{len(entity.control_points)} control points from {ends[0]} to {ends[1]}"
            case _:
                shown = " ".join(f"({x:.3f} {y:.3f})" for x, y, *_ in entity.get_points())
        lines.append(f"{entity.dxftype()} {entity.dxf.layer}: {shown}")
    return "\n".join(lines)


@pytest.mark.parametrize("name", PADS)
def test_files_and_lines_of_a_mould(name, tmp_path, golden, figures, monkeypatch):
    monkeypatch.setattr(export, "draw_orientation", draw_orientation)
    monkeypatch.setattr(export, "draw_crossing", draw_crossing)
    make_pad, settings, words = PADS[name]
    pad, spec = tmp_path / "morphology.json", tmp_path / "pad.toml"
    make_pad().save(pad)
    spec.write_text(settings)
    result = invoke(*words, pad, "--formats", "stl,svg,dxf,png,gcode", "--spec", spec, "--out", tmp_path)
    golden(f"fabricate/{name}/printed.txt", f"exit code {result.exit_code}\n{result.output}")
    document = json.loads((tmp_path / "fabrication.json").read_text())
    golden(f"fabricate/{name}/fabrication.json", json_text(document), forget=[VERSIONS])
    for file in ("laying.md", "laying.gcode", "tracks.svg"):
        golden(f"fabricate/{name}/{file}", (tmp_path / file).read_text(encoding="utf-8"))
    golden(f"fabricate/{name}/tracks.dxf.txt", dxf_text((tmp_path / "tracks.dxf").read_text(encoding="utf-8")))
    assert len(figures) == len(PICTURES)
    for figure, picture in zip(figures, PICTURES, strict=True):
        golden(f"fabricate/{name}/{picture}.txt", figure)


def test_lines_and_documents_of_checks(tmp_path, golden, figures):
    level_pad(1.8, 1.2).save(tmp_path / "crossed.json")
    (tmp_path / "two.toml").write_text('[mould]\nlevels = "two"\n[printer]\nnozzle_mm = 0.6\n')
    (tmp_path / "small.toml").write_text("[printer]\nbed_mm = [30, 30, 100]\n[mould]\nmin_silicone_mm = 3.0\n")
    lines = [invoke(tmp_path / "crossed.json", "--formats", "", "--out", tmp_path).output]
    invoke(tmp_path / "crossed.json", "--formats", "stl", "--out", tmp_path)
    (tmp_path / "plain.toml").write_text("")
    checks = (("mould.stl", "plain"), ("crossed.json", "two"), ("crossed.json", "small"), ("mould.stl", "small"))
    words: list[Any] = []
    for file, name in checks:
        spec = f"{name}.toml"
        words = ["check", tmp_path / file, "--spec", tmp_path / spec]
        result = invoke(*words, "--picture", tmp_path / "findings.png")
        lines += [f"{file} {spec}: exit code {result.exit_code}", result.output]
    golden("fabricate/checked.txt", "\n".join(lines))
    assert lines[1] == "mould.stl plain.toml: exit code 0"  # warnings alone
    assert "warn" in lines[2]
    document = json.loads(invoke(*words, "--json").output)
    golden("fabricate/checked.json", json_text(document))
    for number, figure in enumerate(figures[-3:], 1):
        golden(f"fabricate/checked_{number}.txt", figure)


def test_json_of_a_build_is_its_document(tmp_path):
    Morphology.straight(1).save(tmp_path / "morphology.json")
    result = invoke(tmp_path / "morphology.json", "--formats", "svg", "--json")
    assert json.loads(result.stdout) == json.loads((tmp_path / "fabrication.json").read_text())
