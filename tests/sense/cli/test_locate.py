import json
from pathlib import Path

import numpy as np

from sense import Localizer, Recording
from sense.localizer.locating import locate


def test_places_without_the_fibres_masked(few) -> None:
    """A mask names fibres as people count them; arrays count from 0."""
    assert few("locate", "--model", "model", "rec", "--mask", "1,4", "--out", "places.csv")[0] == 0
    table = np.genfromtxt("places.csv", delimiter=",", names=True)
    assert table.dtype.names == ("press", "x_mm", "y_mm", "sd_x_mm", "sd_y_mm", "r50_mm", "r90_mm")
    assert len(table) == 60
    assert (table["r50_mm"] < table["r90_mm"]).all()
    found = locate(Localizer.load("model"), Recording.open("rec"), (0, 3))
    np.testing.assert_allclose(np.column_stack([table["x_mm"], table["y_mm"]]), found.places_mm, atol=1e-4)
    for number in ("0", "5", "-1", "1,0"):
        code, out, err = few("locate", "--model", "model", "rec", "--mask", number, "--out", "none.csv")
        assert (code, out) == (2, "")
        assert err == f"padforge: fibre {number[-1] if number != '-1' else number}: no such fibre, allowed are 1 to 4\n"
    assert not Path("none.csv").exists()


def test_places_go_to_the_folder_of_the_pad(few) -> None:
    code, out, _ = few("locate", "--model", "model", "rec")
    assert (code, out) == (0, "60 places -> places.csv\n")
    assert Path("places.csv").exists()


def test_a_fibre_found_at_fault_is_left_out(enough) -> None:
    """A fibre reads one value from the 60th of the last 120 presses on: health names it, and places do without it."""
    code, out, _ = enough("health", "--model", "model", "rec")
    assert (code, out.strip()) == (0, "sound fibres: 1, 2, 3, 4")
    whole = Recording.open("rec")
    readings, first = np.array(whole.readings), whole.lifted[239]
    readings[whole.begun[300] - 15 :, 2] = readings[whole.begun[300] - 15, 2]
    edges = whole.begun[240:] - first, whole.lifted[240:] - first
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
    assert "left out from there on" in err
    enough("locate", "--model", "model", "stuck", "--mask", "3", "--out", "masked.csv")
    places, masked = (Path(name).read_text().splitlines() for name in ("places.csv", "masked.csv"))
    assert places[82:] == masked[82:]
    assert places[:60] != masked[:60]


def test_too_few_presses_for_health_are_said_to_be_and_leave_no_older_one(enough) -> None:
    assert Path("model/health.json").exists()
    enough("record", "--presses", "50", "--out", "short")
    code, _, err = enough("calibrate", "short", "--out", "model")
    assert (code, err.count("\n")) == (0, 1)
    assert "no watch is kept on the fibres' health" in err
    assert not list(Path("model").glob("health.*"))
    code, _, err = enough("health", "--model", "model", "short")
    assert (code, err.count("\n")) == (2, 1)
