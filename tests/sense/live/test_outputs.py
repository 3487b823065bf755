"""Messages for other programs: what they say agrees with what the pipeline found, who hears them, and nobody waits."""

import errno
import json
import re
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import pytest

from padforge.design.common import server as listening
from padforge.design.common.validation import InputError
from padforge.sense import Live, Recording
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOPICS, TOUCHES, depths_to_z
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live import outputs as outlets
from padforge.sense.live.outputs import FORMAT, Lines, Message, Messages, Osc
from padforge.sense.live.pipeline import Estimate
from padforge.sense.localizer.model import LocalizerModel

PLACE = {"press": 4, "x_mm": 1.5, "y_mm": -2.25, "r50_mm": 0.5, "r90_mm": 1.0, "failed": []}
TOUCH = Message(TOUCHES, {}, {"event": "touch", **PLACE})
READING = Message(READINGS, {}, {"event": "readings", "time_s": 0.5, "volts": [1.0, None]})
STATES = Message(HEALTH, {}, {"event": "health", "time_s": 0.0, "states": ["sound", "stuck"]})
DOWN = Message(PRESSED, {}, {"event": "pressed", "pressed": True})
TOKEN = "a word of sixteen"
CLIENT = Path(__file__).parents[3] / "docs" / "live-protocol.md"


def live(localizer: LocalizerModel, recording: Recording) -> Live:
    return Live([localizer], None, recording.fibres, recording.rate_hz)


@pytest.fixture(scope="module")
def told(brief: Recording, localizer: LocalizerModel) -> list[Message]:
    pipeline = live(localizer, brief)
    messages, told = Messages(pipeline), []
    for first in range(0, len(brief.readings), 7):
        rows = slice(first, first + 7)
        events = pipeline.feed(brief.times_s[rows], brief.readings[rows])
        told += messages.of(brief.times_s[rows], brief.readings[rows], events)
    assert list(messages.of(np.empty(0), np.empty((0, brief.fibres)), [])) == []
    return told


def of(topic: str, told: list[Message]) -> list[Message]:
    return [message for message in told if message.topic == topic]


def test_every_reading_and_press_is_told_in_turn(told, brief: Recording) -> None:
    readings = of(READINGS, told)
    np.testing.assert_array_equal([message.msg["data"] for message in readings], brief.readings)
    np.testing.assert_array_equal([message.pad["time_s"] for message in readings], brief.times_s)
    assert readings[0].msg["layout"]["dim"] == [{"label": "fibre", "size": brief.fibres, "stride": brief.fibres}]
    pressed = [message.msg["data"] for message in of(PRESSED, told)]
    assert pressed == [True, False] * (len(pressed) // 2) + [True] * (len(pressed) % 2)
    assert len(pressed) // 2 >= len(brief.presses_mm) - 2
    for number, message in enumerate(told[:50]):  # a line is an operation of rosbridge
        line = json.loads(message.line(number))
        assert (line["op"], line["type"]) == ("publish", TOPICS[line["topic"]].msgtype)
        assert (line["pad"]["format"], line["pad"]["number"]) == (FORMAT, number)
        assert json.loads(json.dumps(message.msg)) == line["msg"]


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
def test_a_touch_lies_below_the_surface_in_a_right_handed_frame(brief, localizer, mirrored: bool) -> None:
    """Seen from above, y of the plan runs up and x to the right, or to the left where the pad lies with its tracks up;
    depth runs away from whoever looks."""
    estimate = Estimate(0, 1.5, "press_and_release", True, 3, 4, 1, 1, 1, 2, (), depth_mm=2.5, depth_r90_mm=0.5)
    events = Messages(live(localizer, brief), mirrored).of(brief.times_s[:1], brief.readings[:1], [estimate])
    (touch,) = of(TOUCHES, list(events))
    pose = touch.msg["pose"]
    z_axis = np.cross([-1 if mirrored else 1, 0, 0], [0, 1, 0])
    assert pose["pose"]["position"]["z"] == pytest.approx(np.dot([0, 0, -2.5e-3], z_axis))
    assert pose["covariance"][14] == pytest.approx((0.5e-3 / 1.6449) ** 2)
    exported = replace(brief, source={"rig": {"mirrored": mirrored}})
    assert pose["pose"]["position"]["z"] == depths_to_z(exported, np.array([2.5]))[0]


def test_health_is_told_first_and_with_every_fault(told, brief: Recording, localizer: LocalizerModel) -> None:
    assert told[0].topic == HEALTH
    assert told[0].pad["states"] == ["unwatched"] * brief.fibres
    pipeline = live(localizer, brief)
    fault = FibreFault(press=3, since=1, fibres=(2,), kind="stuck", score=8.0)
    rows = brief.readings[:2].copy()
    rows[1, 0] = np.nan
    pipeline.feed(brief.times_s[:2], rows)
    first, one, two, last = Messages(pipeline).of(brief.times_s[:2], rows, [fault])
    assert (first.topic, one.topic, two.topic, last.topic) == (HEALTH, READINGS, READINGS, HEALTH)
    assert two.msg["data"][0] is None
    assert last.pad["fault"]["fibres"] == (2,)
    assert [status["name"] for status in last.msg["status"]] == [f"pad: fibre {k}" for k in range(1, brief.fibres + 1)]
    assert last.msg["status"][0]["level"] == 2  # a reading is missing


def listener(stack: ExitStack, lines: Lines) -> IO[str]:
    """What a client hears after the states, which are told to it as it comes."""
    client = stack.enter_context(socket.create_connection(lines.address, timeout=20)).makefile()
    assert json.loads(client.readline())["topic"] == HEALTH
    return client


def test_all_clients_hear_all_from_when_they_came_to_the_end() -> None:
    with ExitStack() as stack:
        with Lines("127.0.0.1", 0) as lines:
            lines.tell(STATES)
            lines.tell(READING)
            clients = [listener(stack, lines) for _ in range(2)]
            lines.tell(TOUCH)
        for client in clients:
            (line,) = map(json.loads, client)
            assert (line["topic"], line["pad"]["number"]) == (TOUCHES, 2)


def test_the_client_of_the_docs_prints_places(tmp_path: Path) -> None:
    code = re.search(r"<!-- client -->\n```python\n(.*?)```", CLIENT.read_text(encoding="utf-8"), re.DOTALL)
    assert code
    printed = tmp_path / "printed"
    with Lines("127.0.0.1", 0) as lines, printed.open("w") as out:
        client = subprocess.Popen([sys.executable, "-uc", code[1], str(lines.address[1])], stdout=out)
        while client.poll() is None and not printed.read_text():
            lines.tell(READING)
            lines.tell(TOUCH)
            time.sleep(0.02)
    assert client.wait(20) == 0
    assert set(printed.read_text().splitlines()) == {"1.5, -2.2 mm, within 1.0 mm"}


def test_without_the_token_nothing_is_heard() -> None:
    with pytest.raises(InputError, match="state a token"):
        Lines("0.0.0.0", 0)
    with Lines("127.0.0.1", 0, TOKEN) as lines:
        lines.tell(STATES)
        for said in (b"\n", TOKEN[:-1].encode() + b"\n", TOKEN.encode() + b"x\n", b"\xff" * 4000):
            with socket.create_connection(lines.address) as client:
                client.sendall(said)
                client.shutdown(socket.SHUT_WR)
                with suppress(ConnectionResetError):
                    assert client.recv(100) == b""
        with socket.create_connection(lines.address) as client:
            client.sendall(TOKEN.encode() + b"\r\n")
            assert json.loads(client.makefile().readline())["topic"] == HEALTH


class Long(Message):
    """A message whose line is long, and made beforehand."""

    text = '"' + "x" * 400_000 + '"'

    def line(self, number: int) -> str:
        return self.text


def test_one_that_does_not_listen_holds_up_nobody_and_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outlets, "MOST_BEHIND", 50)
    with ExitStack() as stack, Lines("127.0.0.1", 0) as lines:
        lines.tell(STATES)
        deaf = listener(stack, lines)
        for _ in range(200):
            lines.tell(Long(READINGS, {}, {}))
        listener(stack, lines)
        assert sum(1 for _ in deaf) < 200  # it hears the end, though nobody ended it


def test_what_was_told_before_the_end_still_arrives_at_one_that_is_slow() -> None:
    """The end of the program would cut it off."""
    with ExitStack() as stack:
        with Lines("127.0.0.1", 0) as lines:
            lines.tell(STATES)
            client, heard = listener(stack, lines), []
            for _ in range(30):
                lines.tell(Long(READINGS, {}, {}))
            slow = threading.Timer(0.2, lambda: heard.extend(client))
            slow.start()
        slow.join(20)
    assert len(heard) == 30


def test_a_stranger_has_a_moment_to_say_the_token_however_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "ADMIT_S", 0.5)
    with ExitStack() as stack:
        lines = stack.enter_context(Lines("127.0.0.1", 0, "long" * 60))
        lines.tell(STATES)
        known, stranger = (stack.enter_context(socket.create_connection(lines.address)) for _ in range(2))
        known.sendall(b"long" * 60 + b"\n")
        down_command = time.monotonic()
        with suppress(OSError):
            while time.monotonic() < down_command + 10:
                stranger.sendall(b"x")
                time.sleep(0.1)
        assert time.monotonic() < down_command + 5
        lines.tell(TOUCH)
        told = known.makefile()
        assert [json.loads(told.readline())["topic"] for _ in range(2)] == [HEALTH, TOUCHES]


def test_osc_tells_numbers() -> None:
    from pythonosc.osc_message import OscMessage

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard:
        heard.bind(("127.0.0.1", 0))
        heard.settimeout(20)
        with Osc(f"127.0.0.1:{heard.getsockname()[1]}") as osc:
            for message in (TOUCH, DOWN, STATES, READING):
                osc.tell(message)
        told = [OscMessage(heard.recv(4096)) for _ in range(4)]
    assert [each.address for each in told] == [TOUCHES, PRESSED, HEALTH, READINGS]
    assert [each.params for each in told[:3]] == [[4, 1.5, -2.25, 0.5, 1.0], [True], ["sound", "stuck"]]
    np.testing.assert_array_equal(told[3].params, [1.0, np.nan])


def test_osc_goes_on_while_its_network_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """And looks no name up again, which may take long then."""
    from pythonosc.udp_client import UDPClient

    def away(client: UDPClient, content: object) -> None:
        sent_to.append(client._address)  # noqa: SLF001
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    sent_to: list[str] = []
    monkeypatch.setattr(UDPClient, "send", away)
    with Osc("localhost:9") as osc:
        osc.tell(TOUCH)
    assert sent_to[0] in ("127.0.0.1", "::1")


def test_a_stream_whose_name_is_no_text_is_refused() -> None:
    from padforge.sense.live.outputs import Lsl

    with pytest.raises(InputError, match="the name of a stream is"):
        Lsl("\udc80", 2, 13.0)


def test_lsl_tells_readings_and_touches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a process of its own, which looks for streams on this machine alone."""
    (tmp_path / "lsl.cfg").write_text("[multicast]\nResolveScope = machine\n[log]\nlevel = -3\n")
    code = """
import pylsl
from padforge.sense.live.outputs import Lsl
from tests.sense.live.test_outputs import READING, TOUCH
lsl = Lsl("a pad", 2, 13.0)
found = [pylsl.resolve_byprop("name", f"a pad {what}", timeout=20)[0] for what in ("readings", "touches")]
readings, touches = (pylsl.StreamInlet(info) for info in found)
for inlet in (readings, touches):
    inlet.open_stream(timeout=20)
channel = readings.info().desc().child("channels").child("channel")
print(channel.child_value("label"), channel.child_value("unit"), found[0].nominal_srate(), found[0].channel_count())
lsl.tell(READING)
lsl.tell(TOUCH)
print(readings.pull_sample(timeout=20)[0], touches.pull_sample(timeout=20)[0])
"""
    monkeypatch.setenv("LSLAPICFG", str(tmp_path / "lsl.cfg"))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout.splitlines() == ["fibre 1 V 13.0 2", "[1.0, nan] [4.0, 1.5, -2.25, 0.5, 1.0]"], done.stderr
