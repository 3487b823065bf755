"""`locate`, `health` and `deploy`."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from padforge.sense import Recording
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import Moment
from padforge.sense.signals.press_detection import first_readings
from tests.sense.conftest import first_presses


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


def test_deploy_names_a_missing_library(few, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("padforge.sense.deploy.onnx")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "onnx", None)
    code, out, err = few("deploy", "--model", "model", "localizer.onnx")
    assert (code, out) == (2, "")
    assert err == "padforge: this needs onnx, which is not installed: pip install 'padforge[deploy]'\n"


def test_locate_looks_at_the_readings_nearest_to_a_moment(few) -> None:
    """At 13.3 readings a second, 2.9 and 4.0 of them."""
    recording, model = first_presses(Recording.open("rec"), 10), LocalizerModel.load("model")
    recording.save("short", {})
    touched = first_readings(recording.readings, recording.times_s, recording.down_command, recording.up_command)
    moments = {"lift+0.22s": Moment("lift", 3), "end": Moment("lift", 0), "0.3s": Moment("touch", 4)}
    expected_mm = np.empty((0, 2))
    for words, moment in moments.items():
        assert few("locate", "--model", "model", "short", "--at", words)[0] == 0
        table = np.genfromtxt("places.csv", delimiter=",", names=True)
        expected_mm = model.predict(recording, until=moment.until(touched, recording.up_command)).positions_mm
        np.testing.assert_allclose(np.column_stack([table["x_mm"], table["y_mm"]]), expected_mm, atol=1e-4)
    # read three times as often, it is the same moment
    commands = {name: 3 * getattr(recording, name) for name in ("down_command", "up_command")}
    times_s = (recording.times_s[:, None] + np.arange(3) / (3 * recording.rate_hz)).ravel()
    replace(recording, readings=recording.readings.repeat(3, axis=0), times_s=times_s, **commands).save("fast", {})
    assert few("locate", "--model", "model", "fast", "--at", "0.3s")[0] == 0
    table = np.genfromtxt("places.csv", delimiter=",", names=True)
    fast_mm = np.column_stack([table["x_mm"], table["y_mm"]])
    assert np.abs(fast_mm - expected_mm).mean() < 0.1
