"""What a live pad tells people and programs of events that were made by hand, kept as a whole."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from padforge.sense.cli.live import EventPrinter, view_lines
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.outputs import Message, MessageBuilder
from padforge.sense.live.pipeline import Estimate, Event, OtherPad
from tests.helpers.golden import Golden

PLAIN = Estimate(0, 0.25, 0.375, "touch", 2, 0.125, False, 3.26, -4.04, 1.5, 0.5, 2.25, 4.5, (0,))
DEEP = {"depth_mm": 2.51, "depth_r90_mm": 0.26, "force_n": 1.24, "force_r90_n": 0.15}
EVENTS: tuple[Event, ...] = (
    PLAIN,
    replace(PLAIN, now_s=0.5, readings=3, since_s=0.25, x_mm=3.5, r50_mm=1.5, r90_mm=3.0, **DEEP),
    replace(PLAIN, now_s=0.75, since="lift", readings=1, since_s=0.0, final=True, unlike=True, finger=2),
    FibreFault(press=3, since=1, fibres=(1,), kind="stuck", score=8.0),
    OtherPad(4),
)


class Pipeline:
    """A pipeline whose second fibre fails, and whose pad turns out to be another."""

    pressed = is_other_pad = False
    states = ("sound", "unmonitored")

    def view(self) -> dict[str, Any]:
        return {"fibres": [{"state": state} for state in self.states]}


def messages(mirrored: bool = False) -> list[Message]:
    """The messages of three blocks of readings: before a touch, in the press, and after it."""
    pipeline: Any = Pipeline()
    builder = MessageBuilder(pipeline, mirrored)
    volts = np.array([[1.5, 2.0], [np.nan, 2.25], [1.25, 2.5]])
    sent = list(builder.build(np.array([0.125]), volts[:1], []))
    pipeline.pressed = True
    sent += builder.build(np.array([0.25, 0.375]), volts[1:], EVENTS[:2])
    pipeline.pressed, pipeline.states = False, ("missing", "stuck")
    sent += builder.build(np.array([0.75]), volts[:1], EVENTS[2:4])
    pipeline.is_other_pad = True
    return [*sent, *builder.build(np.array([1.9999999996]), volts[:1], EVENTS[4:])]


@pytest.mark.parametrize("mirrored", [False, True])
def test_lines_over_tcp(golden: Golden, mirrored: bool) -> None:
    """Covariances are shortened to what is not 0."""
    lines = [json.loads(message.to_json(number)) for number, message in enumerate(messages(mirrored))]
    for line in lines:
        if covariance := line["msg"].get("pose", {}).get("covariance"):
            line["msg"]["pose"]["covariance"] = {at: value for at, value in enumerate(covariance) if value}
    chosen = [line for line in lines if not mirrored or "pose" in line["msg"]]
    golden(f"live/lines{'_mirrored' * mirrored}.txt", "\n".join(map(json.dumps, chosen)))


def test_lines_on_a_terminal(golden: Golden, capsys: pytest.CaptureFixture[str]) -> None:
    """Of events, as text and as JSON, and of a view."""
    for as_json in (False, True):
        EventPrinter(as_json).print(EVENTS)
    fibres = [
        {"swing": swing, "state": state} for swing, state in ((0.5, "sound"), (-0.26, "stuck"), (None, "missing"))
    ]
    presses = [{"text": f"press {number}: here", "final": number == 3} for number in (3, 4, 5)]
    view = {"pressed": True, "presses": presses, "fibres": fibres, "faults": ["fibre 2 was dead", "fibre 3 is open"]}
    for shown in (view, view | {"pressed": False, "presses": [], "faults": []}):
        print("\n".join(["--", *view_lines(shown)]))
    golden("live/terminal.txt", capsys.readouterr().out)
