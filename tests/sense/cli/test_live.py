"""`live`: what is shown of readings as they come, and to whom."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from padforge.design import Morphology
from padforge.sense import Recording
from padforge.sense.cli.live import EventPrinter
from padforge.sense.live import outputs
from padforge.sense.live.outputs import LivePage
from padforge.sense.live.pipeline import Estimate
from padforge.sense.localizer.model import LocalizerModel
from padforge.sense.localizer.single_press import OTHER_PAD
from padforge.sense.rig import simulated_board
from padforge.sense.rig.devices import RigFault
from padforge.sense.settings import RigSettings
from padforge.sense.simulation.simulated_recording import simulate
from tests.helpers.golden import Golden
from tests.helpers.page_names import names_in_view
from tests.sense.conftest import first_presses


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
    """What a page shows."""
    views: list[dict] = []
    monkeypatch.setattr(LivePage, "show", lambda page, view: views.append(view))
    return views


def test_live_replays_a_recording(replay, views: list[dict]) -> None:
    code, out, err = replay("--json")
    assert code == 0, err
    told = [json.loads(line) for line in out.splitlines()]
    assert {each["event"] for each in told} == {"estimate"}
    final = [each["press"] for each in told if each["final"]]
    assert final == list(range(len(final)))
    assert 3 <= len(final) <= 4
    assert len(told) > 20 * len(final)  # every reading
    assert {view["mirrored"] for view in views} == {True}
    assert [view["ended"] for view in views][-2:] == ["", "ended"]
    assert names_in_view("live.html") <= views[-1].keys()


def test_live_sends_to_viewers_and_programs(replay, golden: Golden) -> None:
    token = "a word of sixteen"
    code, _, err = replay("--tcp", "0", "--token", token, "--foxglove", "0", "--rerun", "pad.rrd")
    assert code == 0, err
    golden("cli/live_addresses.txt", err, forget=[r"(?<=127\.0\.0\.1:)\d+"])
    assert Path("pad.rrd").stat().st_size > 10_000


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
