import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from PIL import Image

from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate.cli import fabricate, mould_lines
from tests.fabricate.planted import level_pad
from tests.helpers.less import blank_pictures

FILES = {"mould.stl", "tracks.svg", "fabrication.json", "laying.md", "orientation.svg", "crossing.svg"}


@pytest.fixture(autouse=True)
def elsewhere(tmp_path_factory, monkeypatch):
    """Run in an empty folder, since a pad.toml in the current one is taken for the settings."""
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    blank_pictures(monkeypatch)


@pytest.fixture
def morphology(tmp_path):
    path = tmp_path / "morphology.json"
    Morphology.straight(2).save(path)
    return path


def invoke(*arguments):
    return CliRunner().invoke(fabricate, [str(argument) for argument in arguments])


@pytest.mark.parametrize("words", [[], ["build"]])
def test_build_is_the_default_command(morphology, tmp_path, words):
    result = invoke(*words, "--formats", "stl,svg", "--out", tmp_path / "out", morphology, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["files"] == ["mould.stl", "tracks.svg"]
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_build_prints_a_summary_with_the_findings_to_look_at(tmp_path):
    level_pad(1.8, 1.2).save(tmp_path / "crossed.json")
    result = invoke(tmp_path / "crossed.json", "--formats", "svg")
    assert result.exit_code == 0
    assert "ml of silicone" in result.output
    assert "warn same_family_crossings: 2 crossings" in result.output
    assert (tmp_path / "tracks.svg").exists()
    Morphology.straight(2, 4.0).save(tmp_path / "narrow.json")
    checked = invoke("check", tmp_path / "narrow.json")
    assert (checked.exit_code, "warn" in checked.output) == (0, True)


@pytest.mark.parametrize(
    ("file", "table", "line"),
    [
        ("pad.json", "[pad]\nfibre_diameter_mm = 0.4", "[pad] fibre_diameter_mm: no such key, allowed are grid"),
        ("pad.json", '[mould]\nlevels = "two"', "2 crossings"),
        ("absent.json", "", "absent.json"),
    ],
)
def test_build_refuses_in_one_line_and_leaves_nothing(tmp_path, file, table, line):
    level_pad(1.8, 1.2).save(tmp_path / "pad.json")
    (tmp_path / "pad.toml").write_text(table, encoding="utf-8")
    error = invoke(tmp_path / file, "--out", tmp_path / "out", "--spec", tmp_path / "pad.toml").exception
    assert isinstance(error, InputError)
    assert line in str(error)
    assert "\n" not in str(error)
    assert not (tmp_path / "out").exists()


def test_check_exits_1_when_a_check_fails(tmp_path):
    level_pad(1.8, 1.2).save(tmp_path / "crossed.json")
    (tmp_path / "pad.toml").write_text('[mould]\nlevels = "two"\n', encoding="utf-8")
    result = invoke("check", tmp_path / "crossed.json", "--spec", tmp_path / "pad.toml", "--json")
    assert result.exit_code == 1
    document = json.loads(result.stdout)
    assert not document["passed"]
    assert "same_family_crossings" in [f["name"] for f in document["findings"] if f["status"] == "fail"]


def test_check_of_a_mesh_with_the_printer_of_a_spec(morphology, tmp_path):
    invoke(morphology, "--formats", "stl", "--out", tmp_path)
    (tmp_path / "pad.toml").write_text("[printer]\nbed_mm = [30, 30, 100]\n", encoding="utf-8")
    assert invoke("check", tmp_path / "mould.stl").exit_code == 0
    result = invoke("check", tmp_path / "mould.stl", "--spec", tmp_path / "pad.toml")
    assert result.exit_code == 1
    assert "FAIL bed: 42.17 x 42.17 x 8 mm, the bed is 30 x 30 x 100 mm" in result.stdout


def test_the_spec_shapes_the_mould(morphology, tmp_path):
    (tmp_path / "pad.toml").write_text("[mould]\nborder_mm = 1.5\n", encoding="utf-8")
    result = invoke(morphology, "--formats", "svg", "--out", tmp_path, "--spec", tmp_path / "pad.toml", "--json")
    document = json.loads(result.stdout)
    assert document["sizes"]["pad_mm"] == 3 * 11.25 + 2 * 1.5
    assert set(document["provenance"]["inputs"]) == {"morphology.json", "pad.toml"}


def test_check_draws_a_picture_of_the_findings(morphology, tmp_path):
    (tmp_path / "pad.toml").write_text("[printer]\nnozzle_mm = 0.6\n", encoding="utf-8")
    picture = tmp_path / "findings.png"
    assert invoke("check", morphology, "--picture", picture, "--spec", tmp_path / "pad.toml").exit_code == 1
    with Image.open(picture) as image:
        assert image.format == "PNG"


def finding_of(status, *positions, name="wall"):
    return {"name": name, "status": status, "message": f"is {status}", "positions_mm": list(positions)}


def test_mould_lines_count_checks_that_pass_and_name_the_others():
    places = [(1.04, -2.06), (3.0, 4.0), (5.0, 6.0), (7.0, 8.0), (9.0, 0.0)]
    findings = [finding_of("pass"), finding_of("warn", *places, name="thin"), finding_of("pass"), finding_of("fail")]
    document = {"size_mm": [60.123, 50.5, 8.0], "silicone_volume_ml": 20.06, "files": ["mould.3mf", "tracks.svg"]}
    assert mould_lines(document | {"findings": findings}, Path("out")) == [
        f"mould: 60.12 x 50.5 x 8 mm, 20.1 ml of silicone -> {Path('out/mould.3mf')}",
        "  2 checks passed",
        "  warn thin: is warn at (1.0, -2.1) (3.0, 4.0) (5.0, 6.0) and 2 more places",
        "  FAIL wall: is fail",
    ]
    assert mould_lines(document | {"findings": findings[::2], "files": []}, Path("out")) == [
        f"mould: 60.12 x 50.5 x 8 mm -> {Path('out/fabrication.json')}",
        "  2 checks passed, no warnings",
    ]
