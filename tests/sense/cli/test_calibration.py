import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.localizer import training
from padforge.sense.localizer.moments import MOMENTS
from tests.sense.cli.conftest import SPEC


def files_in(folder: str) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file()}


def test_calibrate_writes_a_document_that_evaluate_agrees_with(few) -> None:
    code, out, _ = few("calibrate", "rec", "--test-split", "chronological", "--out", "new", "--json")
    assert code == 0
    document = json.loads(out)
    assert document == json.loads(Path("new/calibration.json").read_text())
    assert document["split"] == "chronological"
    assert document["test"]["press"] == list(range(51, 60))
    for name in ("error_map.png", "error_by_loss.png"):
        assert Path("new", name).read_bytes()[:4] == b"\x89PNG"
    for max_failures, levels in (("0", 1), ("8", 4)):  # of 4 fibres one is left
        code, out, _ = few("evaluate", "--model", "new", "rec", "--max-failures", max_failures, "--json")
        assert code == 0
        assert json.loads(out)["errors"] == document["errors"][:levels]


@pytest.mark.usefixtures("blank", "calibrate_once")
def test_calibrate_doubts_units_and_misplaced_presses(few) -> None:
    good = Recording.open("rec")
    area = r"60 presses over \d+\.\d+ x \d+\.\d+ mm, 2400 readings of 4 fibres at 13\.3 Hz"
    code, out, _ = few("calibrate", "rec", "--out", "good")
    assert (code, "doubtful" in out) == (0, False)
    assert re.fullmatch(area, out.splitlines()[0])
    replace(good, presses_mm=good.presses_mm / 1000).save("metres", {})
    code, out, _ = few("calibrate", "metres", "--out", "m", "--json")
    assert code == 1
    (doubt,) = json.loads(out)["doubts"]
    assert doubt.endswith("are they in m (x=NAME:m,y=NAME:m)?")
    presses_mm = good.presses_mm.copy()
    presses_mm[7] = 250, 3
    replace(good, presses_mm=presses_mm).save("typo", {})
    code, out, _ = few("evaluate", "--model", "model", "typo", "--max-failures", "0")
    assert code == 1
    far, misplaced = (line for line in out.splitlines() if line.startswith("doubtful: "))
    assert far.endswith(": press 7 at (250, 3) mm")
    assert misplaced == "doubtful: more than 4 r90 from where the fibres say: press 7 at (250, 3) mm"


@pytest.mark.usefixtures("blank", "calibrate_once")
def test_calibrate_replaces_a_model_in_use_only_by_force(few) -> None:
    before = files_in("model")
    Path("pad.toml").write_text(SPEC.replace("[rig]", "max_failures = 0\n[rig]"))
    assert few("calibrate", "rec", "--seed", "5")[0] == 0
    assert json.loads(Path("calibration.json").read_text())["provenance"]["seed"] == 5
    assert files_in("model") == before
    provenance = json.loads(Path("localizer.json").read_text())["provenance"]
    Path("fibre_loss.json").write_text(json.dumps({"provenance": {"inputs": {"localizer": provenance}}}))
    assert few("calibrate", "rec", "--seed", "5")[0] == 0  # the same again
    assert few("calibrate", "rec")[0] == 2
    assert few("calibrate", "rec", "--force")[0] == 0


def test_calibrate_leaves_parts_out(enough) -> None:
    """And what an earlier calibration left of them, in the folder of which it is."""
    assert {"health.json", "error_map.png"} < files_in("model").keys()
    words = [word for part in ("health", "figures", "moments") for word in ("--without", part)]
    code, out, _ = enough("calibrate", "rec", "--out", "model", *words, "--json")
    assert (code, json.loads(out)["by_moment"]) == (0, [])
    assert files_in("model").keys() == {"localizer.json", "localizer.safetensors", "calibration.json"}


def test_interrupted_calibrate_leaves_no_file(few, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def progress_bar(name: str) -> Iterator[object]:
        def interrupt(done: int, total: int, what: str) -> None:
            assert name == "training"
            raise KeyboardInterrupt

        yield interrupt

    monkeypatch.setattr("padforge.common.command_line.progress_bar", progress_bar)
    code, _, err = few("calibrate", "rec", "--out", "new")
    assert code == 130
    assert "interrupted" in err
    assert not Path("new").exists()


def test_evaluate_warns_of_a_torn_recording(few) -> None:
    content = Path("rec/readings.bin").read_bytes()
    Path("rec/readings.bin").write_bytes(content[:-100])
    code, _, err = few("evaluate", "--model", "model", "rec", "--max-failures", "0")
    assert code == 0
    assert "last 1 presses are left out" in err


def test_evaluate_lists_errors_of_depth_and_force(deep) -> None:
    words = ("evaluate", "--model", "model", "rec", "--max-failures", "1")
    lines = deep(*words)[1].splitlines()
    rows = json.loads(deep(*words, "--json")[1])["errors"]
    depth = lines.index("error of depth in mm")
    means = [float(line.split()[2]) for line in lines[depth + 2 : depth + 4]]
    assert means == [round(row["depth_mean_mm"], 2) for row in rows]
    # two lines, a row for each number of failed fibres, two on what errors and radii are, and those by moment
    assert lines.index("error of force in N") == depth + 4 == len(lines) - 6 - 2 - len(MOMENTS)


@pytest.mark.usefixtures("blank")
def test_a_drifted_pad_is_followed_into_a_new_model(few, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training, "RETRAINING_STEPS", 15)
    Morphology.straight(2).save(Path("plan.json"))
    before = files_in("model")
    assert few("record", "--presses", "20", "--seed", "2", "--out", "later/recording")[0] == 0
    assert few("recalibrate", "--model", "model", "later/recording", "--morphology", "plan.json")[0] == 0
    document = json.loads(Path("later/recalibration.json").read_text())
    assert [each["change"] for each in document["candidates"]] == [None, "corrected", "refitted"]
    assert Path("later/localizer.json").read_bytes() != before["localizer.json"]
    assert files_in("model") == before
