"""Messages for other programs: what they say agrees with what the pipeline found."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sense import Live, Localizer, Recording
from sense.health.monitor import FibreFault
from sense.live.pipeline import Estimate
from sense.live.streams.messages import FORMAT, Message, Messages
from sense.recordings.formats.ros.topics import HEALTH, KINDS, PRESSED, READINGS, TOUCHES, heights


@pytest.fixture
def told(brief: Recording, localizer: Localizer) -> list[Message]:
    pipeline = Live([localizer], None, brief.fibres, brief.rate_hz)
    messages, found = Messages(pipeline), []
    for first in range(0, len(brief.readings), 7):
        rows = slice(first, first + 7)
        events = pipeline.feed(brief.times_s[rows], brief.readings[rows])
        found += messages.of(brief.times_s[rows], brief.readings[rows], events)
    assert list(messages.of(np.empty(0), np.empty((0, brief.fibres)), [])) == []
    return found


def of(topic: str, told: list[Message]) -> list[Message]:
    return [message for message in told if message.topic == topic]


def test_every_reading_is_told(told, brief) -> None:
    readings = of(READINGS, told)
    np.testing.assert_array_equal([message.msg["data"] for message in readings], brief.readings)
    np.testing.assert_array_equal([message.pad["time_s"] for message in readings], brief.times_s)
    assert readings[0].msg["layout"]["dim"] == [{"label": "fibre", "size": brief.fibres, "stride": brief.fibres}]


def test_presses_begin_and_end_in_turn(told, brief) -> None:
    pressed = [message.msg["data"] for message in of(PRESSED, told)]
    assert pressed == [True, False] * (len(pressed) // 2) + [True] * (len(pressed) % 2)
    assert len(pressed) // 2 >= len(brief.presses_mm) - 2


def test_places_are_metres_with_variances(told) -> None:
    touches = of(TOUCHES, told)
    assert [message.pad["press"] for message in touches] == list(range(len(touches)))
    for message in touches:
        pose, pad = message.msg["pose"], message.pad
        position, covariance = pose["pose"]["position"], pose["covariance"]
        assert (position["x"] * 1000, position["y"] * 1000) == pytest.approx((pad["x_mm"], pad["y_mm"]))
        assert (covariance[0] * 1e6, covariance[7] * 1e6) == pytest.approx((pad["sd_x_mm"] ** 2, pad["sd_y_mm"] ** 2))
        assert (position["z"], covariance[14]) == (0, -1)  # depth was not learnt
        stamp = message.msg["header"]["stamp"]
        assert stamp["sec"] + stamp["nanosec"] * 1e-9 == pytest.approx(pad["time_s"], abs=1e-9)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_touch_lies_below_the_surface_in_a_right_handed_frame(
    brief: Recording, localizer: Localizer, mirrored: bool
) -> None:
    """Seen from above, y of the plan runs up and x to the right, or to the left where the pad lies with its tracks up;
    depth runs away from whoever looks."""
    pipeline = Live([localizer], None, brief.fibres, brief.rate_hz)
    estimate = Estimate(0, 1.5, "full", True, 3, 4, 1, 1, 1, 2, (), depth_mm=2.5, depth_r90_mm=0.5)
    events = Messages(pipeline, mirrored).of(brief.times_s[:1], brief.readings[:1], [estimate])
    (touch,) = of(TOUCHES, list(events))
    pose = touch.msg["pose"]
    z_axis = np.cross([-1 if mirrored else 1, 0, 0], [0, 1, 0])
    assert pose["pose"]["position"]["z"] == pytest.approx(np.dot([0, 0, -2.5e-3], z_axis))
    assert pose["covariance"][14] == pytest.approx((0.5e-3 / 1.6449) ** 2)
    exported = replace(brief, source={"rig": {"mirrored": mirrored}})
    assert pose["pose"]["position"]["z"] == heights(exported, np.array([2.5]))[0]


def test_health_is_told_first_and_with_every_fault(told, brief, localizer) -> None:
    assert told[0].topic == HEALTH
    assert told[0].pad["states"] == ["unwatched"] * brief.fibres
    pipeline = Live([localizer], None, brief.fibres, brief.rate_hz)
    messages = Messages(pipeline)
    fault = FibreFault(press=3, since=1, fibres=(2,), kind="stuck", score=8.0)
    rows = brief.readings[:2].copy()
    rows[1, 0] = np.nan
    pipeline.feed(brief.times_s[:2], rows)
    first, one, two, last = messages.of(brief.times_s[:2], rows, [fault])
    assert (first.topic, one.topic, two.topic, last.topic) == (HEALTH, READINGS, READINGS, HEALTH)
    assert two.msg["data"][0] is None
    assert last.pad["fault"]["fibres"] == (2,)
    assert [status["name"] for status in last.msg["status"]] == [f"pad: fibre {k}" for k in range(1, brief.fibres + 1)]
    assert last.msg["status"][0]["level"] == 2  # a reading is missing


def test_a_line_is_an_operation_of_rosbridge(told) -> None:
    for number, message in enumerate(told[:50]):
        line = json.loads(message.line(number))
        assert (line["op"], line["type"]) == ("publish", KINDS[line["topic"]])
        assert (line["pad"]["format"], line["pad"]["number"]) == (FORMAT, number)
        assert json.loads(json.dumps(message.msg)) == line["msg"]
