"""Messages agree with the estimates of the pipeline, reach every subscriber, and wait for nobody."""

import json
import operator
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from padforge.common.validation import InputError
from padforge.sense import Live, Recording
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOPICS, TOUCHES, depths_to_z
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live import outputs
from padforge.sense.live.outputs import FORMAT, JsonLines, Message, MessageBuilder
from padforge.sense.live.pipeline import Estimate
from padforge.sense.localizer.model import LocalizerModel
from tests.sense.conftest import first_presses

POSITION = {"press": 4, "x_mm": 1.5, "y_mm": -2.25, "r50_mm": 0.5, "r90_mm": 1.0, "final": True, "failed": []}
TOUCH = Message(TOUCHES, {}, {"event": "touch", **POSITION})
READING = Message(READINGS, {}, {"event": "readings", "time_s": 0.5, "volts": [1.0, None]})
STATES = Message(HEALTH, {}, {"event": "health", "time_s": 0.0, "states": ["sound", "stuck"]})
DOWN = Message(PRESSED, {}, {"event": "pressed", "pressed": True})
TOKEN = "a word of sixteen"
PROTOCOL = Path(__file__).parents[3] / "docs" / "live-protocol.md"


def make_pipeline(localizer: LocalizerModel, recording: Recording) -> Live:
    return Live(localizer, rate_hz=recording.rate_hz)


@pytest.fixture(scope="module")
def ten(recording: Recording) -> Recording:
    """Its first ten presses."""
    return first_presses(recording, 10)


@pytest.fixture(scope="module")
def messages(ten: Recording, localizer: LocalizerModel) -> list[Message]:
    pipeline = make_pipeline(localizer, ten)
    builder, messages = MessageBuilder(pipeline), []
    for first in range(0, len(ten.readings), 7):
        times_s, readings = ten.times_s[first : first + 7], ten.readings[first : first + 7]
        messages += builder.build(times_s, readings, pipeline.feed(times_s, readings))
    assert list(builder.build(np.empty(0), np.empty((0, ten.fibres)), [])) == []
    return messages


def of_topic(topic: str, messages: list[Message]) -> list[Message]:
    return [message for message in messages if message.topic == topic]


def test_build_gives_every_reading_and_press_as_operations_of_rosbridge(messages, ten: Recording) -> None:
    readings = of_topic(READINGS, messages)
    np.testing.assert_array_equal([message.msg["data"] for message in readings], ten.readings)
    np.testing.assert_array_equal([message.pad["time_s"] for message in readings], ten.times_s)
    pressed = [message.msg["data"] for message in of_topic(PRESSED, messages)]
    assert pressed[:2] == [True, False]
    assert len(pressed) // 2 >= len(ten.presses_mm) - 2
    for number, message in enumerate(messages[:50]):
        line = json.loads(message.to_json(number))
        assert (line["op"], line["type"]) == ("publish", TOPICS[line["topic"]].msgtype)
        assert (line["pad"]["format"], line["pad"]["number"]) == (FORMAT, number)


def test_touch_messages_are_metres_with_variances(messages) -> None:
    touches = of_topic(TOUCHES, messages)
    final = [message.pad["press"] for message in touches if message.pad["final"]]
    assert final == list(range(len(final)))
    assert {message.pad["since"] for message in touches} == {"touch", "lift"}
    for message in touches:
        pose, pad = message.msg["pose"], message.pad
        position, covariance = pose["pose"]["position"], pose["covariance"]
        assert (position["x"] * 1000, position["y"] * 1000) == pytest.approx((pad["x_mm"], pad["y_mm"]))
        variances = covariance[0] * 1e6, covariance[7] * 1e6
        assert variances == pytest.approx((pad["std_x_mm"] ** 2, pad["std_y_mm"] ** 2))
        assert (position["z"], covariance[14]) == (0, -1)  # depth was not learnt
        stamp = message.msg["header"]["stamp"]
        assert stamp["sec"] + stamp["nanosec"] * 1e-9 == pytest.approx(pad["now_s"], abs=1e-9)


@given(st.floats(-1e10, 1e10) | st.builds(operator.sub, st.integers(-(10**6), 10**6), st.floats(0, 1e-9)))
@example(1.9999999996)
def test_stamp_is_the_nearest_nanosecond(time_s: float) -> None:
    silent: Any = SimpleNamespace(pressed=False, is_other_pad=False, view=lambda: {"fibres": []})
    health, _ = MessageBuilder(silent).build(np.array([time_s]), np.zeros((1, 1)), [])
    stamp = health.msg["header"]["stamp"]
    assert 0 <= stamp["nanosec"] < 10**9
    assert abs(10**9 * (stamp["sec"] - Fraction(time_s)) + stamp["nanosec"]) < 0.5 + 1e-6


@pytest.mark.parametrize("mirrored", [False, True])
def test_touch_lies_below_the_surface_in_a_right_handed_frame(brief, localizer, mirrored: bool) -> None:
    """From above, y of the plan runs up and x to the right, or to the left if mirrored; depth runs away from above."""
    estimate = Estimate(0, 1.5, 2.0, "touch", 7, 0.5, True, 3, 4, 1, 1, 1, 2, (), depth_mm=2.5, depth_r90_mm=0.5)
    builder = MessageBuilder(make_pipeline(localizer, brief), mirrored)
    (touch,) = of_topic(TOUCHES, list(builder.build(brief.times_s[:1], brief.readings[:1], [estimate])))
    pose = touch.msg["pose"]
    z_axis = np.cross([-1 if mirrored else 1, 0, 0], [0, 1, 0])
    assert pose["pose"]["position"]["z"] == pytest.approx(np.dot([0, 0, -2.5e-3], z_axis))
    assert pose["covariance"][14] == pytest.approx((0.5e-3 / 1.6449) ** 2)
    assert pose["pose"]["position"]["z"] == depths_to_z(np.array([2.5]), mirrored)[0]


def test_health_comes_first_and_with_every_fault(messages, brief: Recording, localizer: LocalizerModel) -> None:
    assert messages[0].topic == HEALTH
    assert messages[0].pad["states"] == ["unmonitored"] * brief.fibres
    pipeline = make_pipeline(localizer, brief)
    fault, rows = FibreFault(press=3, since=1, fibres=(2,), kind="stuck", score=8.0), brief.readings[:2].copy()
    rows[1, 0] = np.nan
    pipeline.feed(brief.times_s[:2], rows)
    first, one, two, last = MessageBuilder(pipeline).build(brief.times_s[:2], rows, [fault])
    assert (first.topic, one.topic, two.topic, last.topic) == (HEALTH, READINGS, READINGS, HEALTH)
    assert two.msg["data"][0] is None
    assert last.pad["fault"]["fibres"] == (2,)
    status = last.msg["status"][0]
    assert (status["name"], status["level"]) == ("pad: fibre 1", 2)  # a reading is missing


def subscribe(stack: ExitStack, lines: JsonLines) -> IO[str]:
    """What a client receives after the states, which it gets as it comes."""
    client = stack.enter_context(socket.create_connection(lines.address, timeout=20)).makefile()
    assert json.loads(client.readline())["topic"] == HEALTH
    return client


def test_client_of_the_docs_prints_positions(tmp_path: Path) -> None:
    code = re.search(r"<!-- client -->\n```python\n(.*?)```", PROTOCOL.read_text(encoding="utf-8"), re.DOTALL)
    assert code
    printed = tmp_path / "printed"
    with JsonLines("127.0.0.1", 0) as lines, printed.open("w") as out:
        client = subprocess.Popen([sys.executable, "-uc", code[1], str(lines.address[1])], stdout=out)
        while client.poll() is None and not printed.read_text():
            lines.send(READING)
            lines.send(TOUCH)
            time.sleep(0.02)
    assert client.wait(20) == 0
    assert set(printed.read_text().splitlines()) == {"1.5, -2.2 mm, within 1.0 mm"}


def test_json_lines_sends_nothing_without_the_token() -> None:
    with pytest.raises(InputError, match="state a token"):
        JsonLines("0.0.0.0", 0)
    with JsonLines("127.0.0.1", 0, TOKEN) as lines:
        lines.send(STATES)
        for token in (b"\n", TOKEN[:-1].encode() + b"\n", TOKEN.encode() + b"x\n", b"\xff" * 4000):
            with socket.create_connection(lines.address) as client:
                client.sendall(token)
                client.shutdown(socket.SHUT_WR)
                with suppress(ConnectionResetError):
                    assert client.recv(100) == b""
        with socket.create_connection(lines.address) as client:
            client.sendall(TOKEN.encode() + b"\r\n")
            assert json.loads(client.makefile().readline())["topic"] == HEALTH


LONG = Message(READINGS, {}, {"text": "x" * 400_000})


def test_slow_subscriber_is_disconnected_and_delays_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outputs, "MAX_QUEUED", 50)
    with ExitStack() as stack, JsonLines("127.0.0.1", 0) as lines:
        lines.send(STATES)
        slow = subscribe(stack, lines)
        for _ in range(200):
            lines.send(LONG)
        subscribe(stack, lines)
        assert sum(1 for _ in slow) < 200  # the connection ends, though the server does not


def test_queued_messages_still_arrive_at_the_end_by_all_subscribers() -> None:
    with ExitStack() as stack:
        with JsonLines("127.0.0.1", 0) as lines:
            lines.send(STATES)
            clients, received = [subscribe(stack, lines) for _ in range(2)], []
            for _ in range(30):
                lines.send(LONG)
            slow = threading.Timer(0.2, lambda: received.extend(line for client in clients for line in client))
            slow.start()
        slow.join(20)
    assert [json.loads(line)["pad"]["number"] for line in received] == 2 * list(range(1, 31))
