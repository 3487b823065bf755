import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from click.testing import CliRunner

import sense.cli.calibration
import sense.report.calibration_figures
from design import Morphology
from design.common.files import sha256
from sense import Localizer, Recording
from sense.cli.main import sense as command


def test_a_recording_is_learnt_from_and_evaluated(few) -> None:
    code, out, _ = few("calibrate", "rec", "--test-split", "chronological", "--out", "new", "--json")
    assert code == 0
    document = json.loads(out)
    assert document == json.loads(Path("new/calibration.json").read_text())
    assert document["split"] == "chronological"
    assert document["test"]["press"] == list(range(51, 60))
    for name in ("error_map.png", "error_by_loss.png"):
        assert Path("new", name).read_bytes()[:4] == b"\x89PNG"
    for lost, levels in (("0", 1), ("2", 3), ("8", 4)):  # of 4 fibres one is left
        code, out, _ = few("evaluate", "--model", "new", "rec", "--lost", lost, "--json")
        assert code == 0
        assert json.loads(out)["errors"] == document["errors"][:levels]


def test_results_go_to_the_folder_of_the_pad(few) -> None:
    before = Path("model/localizer.json").read_bytes()
    assert few("calibrate", "rec", "--seed", "5")[0] == 0
    assert json.loads(Path("calibration.json").read_text())["provenance"]["seed"] == 5
    assert Path("localizer.json").exists()
    assert Path("model/localizer.json").read_bytes() == before


def test_interrupted_training_leaves_no_file(few, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def reported(name: str) -> Iterator[object]:
        def report(done: int, total: int) -> None:
            assert name == "training"
            raise KeyboardInterrupt

        yield report

    monkeypatch.setattr(sense.cli.calibration, "reported", reported)
    code, _, err = few("calibrate", "rec", "--out", "new")
    assert code == 130
    assert "interrupted" in err
    assert not Path("new").exists()


def test_a_torn_recording_is_said_to_be_one(few) -> None:
    content = Path("rec/readings.bin").read_bytes()
    Path("rec/readings.bin").write_bytes(content[:-100])
    code, _, err = few("evaluate", "--model", "model", "rec", "--lost", "0")
    assert code == 0
    assert "last 1 presses are left out" in err


def test_a_calibration_that_fails_at_its_last_figure_changes_nothing(few, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path.name: path.read_bytes() for path in Path("model").iterdir()}

    def full(document: object, path: Path) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(sense.report.calibration_figures, "draw_error_by_loss", full)
        code, _, err = few("calibrate", "rec", "--seed", "5", "--out", "model")
    assert code == 2
    assert "model: cannot be written (No space left on device)" in err.splitlines()[-1]
    assert {path.name: path.read_bytes() for path in Path("model").iterdir()} == before
    assert few("calibrate", "rec", "--seed", "5", "--out", "model")[0] == 0
    assert {path.name for path in Path("model").iterdir()} == set(before)
    assert Path("model/localizer.json").read_bytes() != before["localizer.json"]


def test_errors_of_depth_and_force_are_listed_where_they_were_learnt(
    deep_localizer: Localizer, deep_recording: Recording, tmp_path: Path
) -> None:
    deep_localizer.save(tmp_path)
    deep_recording.save(tmp_path / "recording", {})
    arguments = ["evaluate", "--model", str(tmp_path), str(tmp_path / "recording"), "--lost", "1"]
    lines = CliRunner().invoke(command, arguments).output.splitlines()
    depth, force = lines.index("error of depth in mm"), lines.index("error of force in N")
    rows = json.loads(CliRunner().invoke(command, [*arguments, "--json"]).output)["errors"]
    assert [float(line.split()[2]) for line in lines[depth + 2 : depth + 4]] == [
        round(row["depth_mean_mm"], 2) for row in rows
    ]
    assert force == depth + 4
    assert len(lines) == force + 4


def test_a_localizer_that_others_were_made_from_is_replaced_by_force_alone(few) -> None:
    made_by = json.loads(Path("model/localizer.json").read_text())["provenance"]
    assert made_by["recording_kind"] == "simulated"
    Path("model/fibre_loss.json").write_text(json.dumps({"provenance": {"inputs": {"localizer": made_by}}}))
    before = {path.name: path.read_bytes() for path in Path("model").iterdir()}
    words = (["calibrate", "--seed", "5"], ["calibrate", "--method", "published"], ["recalibrate", "--model", "model"])
    for name, *more in words:
        code, _, err = few(name, "rec", *more, "--out", "model")
        assert (code, err.splitlines()[-1].partition(": ")[0]) == (2, "padforge"), err
        assert "localizer.json: fibre_loss.json was made from it; choose another --out" in err
        assert {path.name: path.read_bytes() for path in Path("model").iterdir()} == before
    assert few("calibrate", "rec", "--out", "model")[0] == 0  # the same again
    assert few("calibrate", "rec", "--out", "model", "--seed", "5", "--force")[0] == 0


def test_a_twin_that_a_pad_was_designed_for_is_replaced_by_force_alone(few) -> None:
    Morphology.straight(2).save("pad.json")
    Path("twin.json").write_text('{"provenance": {"seed": 1}}')
    Path("design.json").write_text(json.dumps({"provenance": {"inputs": {"twin.json": sha256(Path("twin.json"))}}}))
    code, _, err = few("identify", "rec", "--morphology", "pad.json", "--out", ".")
    assert code == 2
    assert "twin.json: design.json was made from it; choose another --out" in err
