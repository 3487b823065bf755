"""`locate`, `health` and `deploy`."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.health.fault_detector import HEALTH_FILES
from padforge.sense.localizer.doubts import OTHER_PAD
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import Moment
from padforge.sense.settings import RigSettings
from padforge.sense.signals.press_detection import first_readings
from padforge.sense.simulation.simulated_recording import simulate
from tests.sense.conftest import first_presses


def test_locate_excludes_fibres_by_number(few) -> None:
    code, out, _ = few("locate", "--model", "model", "rec", "--exclude-fibres", "1,4")
    assert (code, out) == (0, "60 positions -> places.csv\n")
    table = np.genfromtxt("places.csv", delimiter=",", names=True)
    assert table.dtype.names == ("press", "x_mm", "y_mm", "std_x_mm", "std_y_mm", "r50_mm", "r90_mm", "unlike")
    assert len(table) == 60
    assert (table["r50_mm"] < table["r90_mm"]).all()
    prediction = LocalizerModel.load("model").predict(Recording.open("rec"), (0, 3))
    positions_mm = np.column_stack([table["x_mm"], table["y_mm"]])
    np.testing.assert_allclose(positions_mm, prediction.positions_mm, atol=1e-4)


def test_locate_excludes_a_faulty_fibre(enough) -> None:
    """A fibre is stuck from the 60th of the last 120 presses on."""
    code, out, _ = enough("health", "--model", "model", "rec")
    assert (code, out.strip()) == (0, "sound fibres: 1, 2, 3, 4")
    whole = Recording.open("rec")
    readings, first = np.array(whole.readings), whole.up_command[239]
    readings[whole.down_command[300] - 15 :, 2] = readings[whole.down_command[300] - 15, 2]
    edges = whole.down_command[240:] - first, whole.up_command[240:] - first
    Recording(readings[first:], whole.times_s[first:], whole.presses_mm[240:], *edges).save("stuck", {})
    code, out, _ = enough("health", "--model", "model", "stuck", "--json")
    assert code == 1
    (finding,) = json.loads(out)["findings"]
    assert finding["fibres"] == [2]
    assert finding["text"].startswith("fibre 3 reads one value")
    assert 60 <= finding["press"] <= 80
    code, out, _ = enough("health", "--model", "model", "stuck")
    assert out.splitlines()[-1] == "sound fibres: 1, 2, 4"
    code, _, err = enough("locate", "--model", "model", "stuck", "--out", "places.csv")
    assert (code, err.count("\n")) == (0, 1)
    assert err.startswith("fibre 3 reads one value")
    assert re.search(r"masked from press \d+ on", err)
    enough("locate", "--model", "model", "stuck", "--exclude-fibres", "3", "--out", "masked.csv")
    places, masked = (Path(name).read_text().splitlines() for name in ("places.csv", "masked.csv"))
    assert places[82:] == masked[82:]
    assert places[:60] != masked[:60]


def test_locate_and_health_name_what_differs_from_the_calibration(enough) -> None:
    part = first_presses(Recording.open("rec"), 120)
    part.save("part", {})
    assert enough("locate", "--model", "model", "part")[2] == ""
    readings = np.array(part.readings)
    readings[:, 2] += 0.33
    replace(part, readings=readings).save("moved", {})
    code, out, err = enough("locate", "--model", "model", "moved")
    assert (code, out) == (0, "120 positions -> places.csv\n")
    assert re.fullmatch(r"fibre 3 rests at \S+ V, usual since calibration is .* V: radii may be too small; .*\n", err)
    assert enough("locate", "--model", "model", "moved", "--exclude-fibres", "3")[2] == ""
    code, out, _ = enough("health", "--model", "model", "moved", "--json")
    (shift,) = json.loads(out)["shifts"]
    assert (shift["kind"], shift["fibres"], shift["text"]) == ("rest", [2], err.strip())
    assert shift["value"] > shift["usual"][1]


def test_a_pad_cast_again_is_said_to_be_another_and_no_fibre_is_masked(enough) -> None:
    simulate(Morphology.straight(2), RigSettings(presses=40, seed=14)).save("again", {})
    code, out, err = enough("locate", "--model", "model", "again")
    assert (code, out, err) == (1, "40 positions -> places.csv\n", f"{OTHER_PAD}\n")
    expected_mm = LocalizerModel.load("model").predict(Recording.open("again")).positions_mm
    table = np.genfromtxt("places.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.column_stack([table["x_mm"], table["y_mm"]]), expected_mm, atol=1e-4)
    code, out, _ = enough("health", "--model", "model", "again")
    assert (code, out) == (1, f"{OTHER_PAD}\n")
    code, out, _ = enough("health", "--model", "model", "again", "--json")
    document = json.loads(out)
    assert (code, document["other_pad"], document["findings"], document["shifts"]) == (1, True, [], [])
    code, out, _ = enough("evaluate", "--model", "model", "again", "--max-failures", "0")
    assert (code, out.count(f"doubtful: {OTHER_PAD}\n"), out.count("doubtful")) == (1, 1, 1)


def test_two_fingers_are_marked_in_the_table(enough) -> None:
    """A recording is superposed on itself, some presses later."""
    whole = Recording.open("rec")
    readings = whole.readings + np.roll(whole.readings, -7 * 40, axis=0) - np.median(whole.readings, axis=0)
    two = replace(whole, readings=readings)
    two.save("two", {})
    enough("locate", "--model", "model", "two")
    unlike = np.genfromtxt("places.csv", delimiter=",", names=True)["unlike"]
    assert 0 < unlike.mean() < 1
    np.testing.assert_array_equal(unlike, LocalizerModel.load("model").predict(two).unlike)


@pytest.mark.usefixtures("blank")
def test_calibrate_warns_of_too_few_presses_for_health_and_removes_the_old_model(few) -> None:
    for name in HEALTH_FILES:
        Path("model", name).touch()
    assert Path("model/health.json").exists()
    code, _, err = few("calibrate", "rec", "--out", "model")
    assert (code, err.count("\n")) == (0, 1)
    assert "health of the fibres is not monitored: 50 complete presses to learn from, expected 300 or more; 9 pr" in err
    assert not list(Path("model").glob("health.*"))


def test_deploy_writes_a_graph(few, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("padforge.sense.deploy.onnx_export.N_TRIALS", 5)
    first_presses(Recording.open("rec"), 4).save("short", {})
    code, out, _ = few("deploy", "--model", "model", "short", "localizer.onnx")
    assert code == 0
    assert "tested on 4 presses and at every moment of one, with up to 3 failed fibres: positions within " in out
    assert out.endswith(" -> localizer.onnx\n")
    assert Path("localizer.onnx").stat().st_size > 1000


@pytest.mark.parametrize("library", ["onnx", "onnxruntime"])
def test_deploy_names_a_missing_library(few, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("padforge.sense.deploy.onnx")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    code, out, err = few("deploy", "--model", "model", "localizer.onnx")
    assert (code, out) == (2, "")
    assert err == f"padforge: this needs {library}, which is not installed: pip install 'padforge[deploy]'\n"


@pytest.mark.parametrize(
    ("moment", "since", "readings"), [("lift+0.22s", "lift", 3), ("end", "lift", 0), ("0.3s", "touch", 4)]
)
def test_locate_looks_at_the_readings_nearest_to_a_moment(few, moment: str, since: str, readings: int) -> None:
    """At 13.3 readings a second, 2.9 and 4.0 of them."""
    assert few("locate", "--model", "model", "rec", "--at", moment)[0] == 0
    table, recording = np.genfromtxt("places.csv", delimiter=",", names=True), Recording.open("rec")
    touched = first_readings(recording.readings, recording.times_s, recording.down_command, recording.up_command)
    until = Moment(since, readings).until(touched, recording.up_command)  # type: ignore[arg-type]
    expected_mm = LocalizerModel.load("model").predict(recording, until=until).positions_mm
    np.testing.assert_allclose(np.column_stack([table["x_mm"], table["y_mm"]]), expected_mm, atol=1e-4)
