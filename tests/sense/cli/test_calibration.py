import json
from pathlib import Path

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.health.fault_detector import HEALTH_FILES
from tests.helpers.folders import files_in
from tests.sense.cli.conftest import SPEC

PICTURES = [f"figures/error_{name}.png" for name in ("map", "by_loss", "by_moment")]
BARE = [word for part in ("health", "figures", "moments") for word in ("--without", part)]


def test_calibrate_writes_a_document_that_evaluate_agrees_with(few) -> None:
    code, out, _ = few("calibrate", "rec", "--test-split", "chronological", "--out", "new", "--json")
    assert code == 0
    document = json.loads(out)
    assert document == json.loads(Path("new/calibration.json").read_text())
    assert document["split"] == "chronological"
    test, row = document["test"], document["errors"][0]
    assert test["press"] == list(range(51, 60))
    pressed_mm = Recording.open("rec").presses_mm[51:]
    np.testing.assert_allclose(test["pressed_mm"], pressed_mm)
    errors_mm = np.linalg.norm(pressed_mm - test["predicted_mm"], axis=1)
    expected = [errors_mm.mean(), np.median(errors_mm), np.quantile(errors_mm, 0.95)]
    assert [row[name] for name in ("mean_mm", "median_mm", "p95_mm")] == pytest.approx(expected)
    for max_failures, levels in (("0", 1), ("8", 4)):  # of 4 fibres one is left
        code, out, _ = few("evaluate", "--model", "new", "rec", "--max-failures", max_failures, "--json")
        assert code == 0
        assert json.loads(out)["errors"] == document["errors"][:levels]


@pytest.mark.usefixtures("blank")
def test_calibrate_replaces_a_model_in_use_only_by_force_and_leaves_parts_out(few) -> None:
    before = files_in("model")
    Path("pad.toml").write_text(SPEC.replace("[rig]", "max_failures = 0\n[rig]"))
    assert few("calibrate", "rec", *BARE, "--seed", "5")[0] == 0
    assert json.loads(Path("calibration.json").read_text())["provenance"]["seed"] == 5
    assert files_in("model") == before
    provenance = json.loads(Path("localizer.json").read_text())["provenance"]
    Path("fibre_loss.json").write_text(json.dumps({"provenance": {"inputs": {"localizer": provenance}}}))
    assert few("calibrate", "rec", *BARE, "--seed", "5")[0] == 0  # the same again
    assert few("calibrate", "rec", *BARE)[0] == 2
    for name in (*HEALTH_FILES, *PICTURES):  # of an earlier calibration, which had all parts
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).touch()
    code, out, _ = few("calibrate", "rec", *BARE, "--force", "--json")
    assert (code, json.loads(out)["by_moment"]) == (0, [])
    left = {"localizer.json", "localizer.safetensors", "calibration.json", "fibre_loss.json", "pad.toml"}
    assert {name for name in files_in(".") if not name.startswith(("rec/", "model/"))} == left
