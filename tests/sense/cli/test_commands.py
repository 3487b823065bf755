"""`import`, `export`, `calibrate`, `locate`, `deploy` and `live`: what they write and show."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import scipy.io

from padforge.common.files import sha256
from padforge.design import Morphology
from padforge.sense import Recording, import_mat
from padforge.sense.cli import options
from padforge.sense.cli.live import EventPrinter
from padforge.sense.health.fault_detector import HEALTH_FILES
from padforge.sense.live import outputs
from padforge.sense.live.outputs import LivePage
from padforge.sense.live.pipeline import Estimate
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.moments import Moment
from padforge.sense.localizer.single_press import OTHER_PAD
from padforge.sense.report.calibration import FILES
from padforge.sense.rig import simulated_board
from padforge.sense.rig.devices import RigFault
from padforge.sense.settings import RigSettings
from padforge.sense.signals.press_detection import first_readings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.folders import files_in
from tests.helpers.golden import Golden
from tests.helpers.page_script import names_in_view
from tests.sense.cli.conftest import SPEC
from tests.sense.conftest import first_presses


def test_import_notes_a_cut_end_and_keeps_the_digests_of_its_files(padforge_sense, recording: Recording) -> None:
    content = {"voltage": recording.readings[:391], "tim": recording.times_s[None, :391]}
    scipy.io.savemat("cut.mat", content | {"pos": recording.presses_mm[:10].T})
    note = "cut.mat: the last of 10 presses is left out, with 31 of 40 readings\n"
    code, out, err = padforge_sense("import", "cut.mat")
    assert (code, err, out[:14]) == (0, note, "9 presses over")
    imported = Recording.open("out/cut/recording")
    assert (imported, imported.source["note"] in note) == (import_mat("cut.mat"), True)
    assert padforge_sense("export", "cut.mat", "cut.csv")[2] == note
    assert padforge_sense("export", "out/cut/recording", "again.csv")[2] == ""
    np.savetxt("plain.txt", np.column_stack([recording.times_s, recording.readings])[:400])
    spans_s = recording.times_s[[recording.down_command[:9], recording.up_command[:9]]]
    np.savetxt("presses.txt", spans_s.T, header="down_s up_s", comments="")
    columns = ("--columns", "time=1,fibres=2-5", "--presses", "presses.txt")
    assert padforge_sense("import", "plain.txt", *columns)[0] == 0
    for name, files in (("cut", {"cut.mat"}), ("plain", {"plain.txt", "presses.txt"})):
        made_by = json.loads(Path(f"out/{name}/recording/start.json").read_text())["provenance"]
        assert made_by["inputs"] == {file: sha256(Path(file)) for file in files}


def test_recording_line_counts_what_is_unknown_and_missing() -> None:
    times_s = np.arange(40) / 8
    readings = np.full((40, 3), 1.5)
    readings[3:5, 1] = np.nan
    presses_mm = np.array([[1.0, 2.0], [np.nan, np.nan]])
    recording = Recording(readings, times_s, presses_mm, np.array([10, 30]), np.array([15, 35]))
    line = "2 presses (1 of unknown position), 40 readings of 3 fibres, 2 values missing, at 8.0 Hz -> out"
    assert options.recording_line(recording, Path("out")) == line
    slow = replace(recording, times_s=100 * times_s, readings=np.full((40, 3), 1.5), presses_mm=np.zeros((2, 2)))
    line = "2 presses over 0 x 0 mm, 40 readings of 3 fibres at 0.08 Hz -> out"
    assert options.recording_line(slow, Path("out")) == line


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
    for name in {*HEALTH_FILES, *FILES} - files_in(".").keys():  # of a calibration with all parts
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).touch()
    code, out, _ = few("calibrate", "rec", *BARE, "--force", "--json")
    assert (code, json.loads(out)["by_moment"]) == (0, [])
    left = {"localizer.json", "localizer.safetensors", "calibration.json", "fibre_loss.json", "pad.toml"}
    assert {name for name in files_in(".") if not name.startswith(("rec/", "model/"))} == left


def test_two_fingers_are_marked_in_the_table(enough) -> None:
    """A recording is superposed on itself, some presses later."""
    whole = Recording.open("rec")
    readings = whole.readings + np.roll(whole.readings, -7 * 40, axis=0) - np.median(whole.readings, axis=0)
    (two := replace(whole, readings=readings)).save("two", {})
    enough("locate", "--model", "model", "two")
    unlike = np.genfromtxt("places.csv", delimiter=",", names=True)["unlike"]
    assert 0 < unlike.mean() < 1
    np.testing.assert_array_equal(unlike, LocalizerModel.load("model").predict(two).unlike)


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


@pytest.fixture
def replay(few) -> Callable[..., tuple[int, str, str]]:
    """Of four presses on a pad that lay with its tracks up."""
    replace(first_presses(Recording.open("rec"), 4), source={"rig": {"mirrored": True}}).save("mirrored", {})
    command = ("live", "--port", "0", "--model", "model", "--replay", "mirrored", "--speed", "1e6")
    return lambda *words: few(*command, *words)


def test_live_says_that_another_pad_is_pressed(enough, monkeypatch: pytest.MonkeyPatch) -> None:
    """As early as after eight presses."""
    for module in ("live.pipeline", "localizer.single_press"):
        monkeypatch.setattr(f"padforge.sense.{module}.MIN_PRESSES", 8)
    simulate(Morphology.straight(2), RigSettings(presses=12, seed=14)).save("again", {})
    command = ("live", "--port", "0", "--model", "model", "--replay", "again", "--speed", "1e6", "--json")
    code, out, _ = enough(*command)
    events = [json.loads(line) for line in out.splitlines()]
    (said,) = [event for event in events if event["event"] == "otherpad"]
    assert (code, said["text"]) == (1, OTHER_PAD)
    assert said["press"] >= 7
    later = events[events.index(said) + 1 :]
    assert {(event["event"], *event["failed"]) for event in later} == {("estimate",)}


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    views: list[dict] = []
    monkeypatch.setattr(LivePage, "show", lambda page, view: views.append(view))
    return views


def test_live_replays_a_recording_to_the_page_viewers_and_programs(replay, views: list[dict], golden: Golden) -> None:
    outputs = ("--tcp", "0", "--token", "a word of sixteen", "--foxglove", "0", "--rerun", "pad.rrd")
    code, out, err = replay("--json", *outputs)
    assert code == 0, err
    golden("cli/live_addresses.txt", err, forget=[r"(?<=127\.0\.0\.1:)\d+"])
    assert Path("pad.rrd").stat().st_size > 10_000
    told = [json.loads(line) for line in out.splitlines()]
    assert {each["event"] for each in told} == {"estimate"}
    final = [each["press"] for each in told if each["final"]]
    assert final == list(range(len(final)))
    assert 3 <= len(final) <= 4
    assert len(told) > 20 * len(final)  # every reading
    assert {view["mirrored"] for view in views} == {True}
    assert [view["ended"] for view in views][-2:] == ["", "ended"]
    assert names_in_view("live.html") <= views[-1].keys()


LOST = RigFault("stale", "the board does not send", "reset it")


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [(KeyboardInterrupt(), 130, "interrupted"), (LOST, 1, "padforge: the board does not send; reset it")],
)
def test_live_shows_a_rig_until_it_ends(few, views, monkeypatch, error, code: int, said: str) -> None:
    """As the pad lay when the model was learnt: a holder had said how, so that `[rig]` leaves it open."""
    board, told = Mock(read=Mock(side_effect=error)), Mock()
    board.connect.return_value = {"channels": 4, "rate_hz": 13.3}
    LocalizerModel.load("model").save("mine")
    recording = Recording.open("rec")
    source = {**recording.source, "rig": {**recording.source["rig"], "mirrored": True}}
    replace(recording, source=source).save("mine/recording", {})
    monkeypatch.setattr(simulated_board, "SimulatedBoard", lambda *pad, **size: board)
    monkeypatch.setattr(outputs, "MessageBuilder", told)
    ended, out, err = few("live", "--port", "0", "--model", "mine", "--json")
    assert (ended, out) == (code, "")
    assert said in err.splitlines()[-1]
    assert err.count("touches are simulated") == 1
    assert {view["title"] for view in views} == {"simulated touches, mine"}
    assert views[-1]["ended"] == (str(error) or "ended")
    board.close.assert_called_once()
    assert told.call_args[0][1] is True
    assert {view["mirrored"] for view in views} == {True}


def test_printed_estimates_say_more_than_those_before(capsys: pytest.CaptureFixture[str]) -> None:
    """They are sharper by a quarter, have moved beyond both radii, or are the last."""
    printer = EventPrinter(as_json=False)
    for now_s, x_mm, y_mm, r90_mm, is_shown in (
        *((0.0, 0.0, 0.0, 8.0, True), (0.1, 1.0, 0.0, 6.1, False), (0.2, 1.0, 0.0, 6.0, True)),
        *((0.3, 1.0, 5.9, 5.0, False), (0.4, 4.7, 4.7, 5.0, False), (0.5, 4.7, 4.9, 5.0, True)),
        *((0.6, 4.7, -1.0, 6.1, False), (0.7, 4.7, -1.3, 6.1, True), (0.8, 4.7, -1.3, 6.1, True)),
    ):
        moment = ("touch", 1, now_s, now_s == 0.8, x_mm, y_mm, 1.0, 1.0, 1.0, r90_mm, ())
        printer.print([Estimate(0, 0.0, now_s, *moment)])
        assert bool(capsys.readouterr().out) == is_shown, now_s
