"""What a live pad tells people, programs and viewers, kept as a whole; messages reach all, and wait for nobody."""

import base64
import contextlib
import json
import operator
import re
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import example, given
from hypothesis import strategies as st

from padforge.common.validation import InputError
from padforge.sense.cli.live import EventPrinter, view_lines
from padforge.sense.formats.ros_messages import HEALTH, READINGS, TOUCHES, choose_epoch, to_stamps
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live import outputs
from padforge.sense.live.outputs import JsonLines, Message, MessageBuilder
from padforge.sense.live.pipeline import Estimate, Event, OtherPad
from padforge.sense.live.viewers import SCENE, FoxgloveOutput, RerunOutput
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
    fibres = [{"swing": v, "state": state} for v, state in ((0.5, "sound"), (-0.26, "stuck"), (None, "missing"))]
    presses = [{"text": f"press {number}: here", "final": number == 3} for number in (3, 4, 5)]
    view = {"pressed": True, "presses": presses, "fibres": fibres, "faults": ["fibre 2 was dead", "fibre 3 is open"]}
    for shown in (view, view | {"pressed": False, "presses": [], "faults": []}):
        print("\n".join(["--", *view_lines(shown)]))
    golden("live/terminal.txt", capsys.readouterr().out)


AREA = {"centre_mm": [1.0, 2.0], "half_mm": [20.0, 10.0]}


def ask_to_connect(port: int, *headers: str) -> socket.socket:
    """Send the first request of a WebSocket client (RFC 6455)."""
    client = socket.create_connection(("127.0.0.1", port), timeout=20)
    lines = [
        "GET / HTTP/1.1",
        *([] if any(header.startswith("Host") for header in headers) else [f"Host: localhost:{port}"]),
        *("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"),
        *("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol: foxglove.sdk.v1"),
    ]
    client.sendall("\r\n".join([*lines, *headers, "", ""]).encode())
    return client


class FoxgloveClient:
    """The little of a WebSocket client that a subscriber needs."""

    def __init__(self, port: int) -> None:
        self.socket = ask_to_connect(port)
        self.file = self.socket.makefile("rb")
        assert b" 101 " in self.file.readline()
        while self.file.readline() != b"\r\n":
            pass

    def receive(self) -> tuple[int, bytes]:
        """Return the operation code and the content of a frame."""
        code, size = self.file.read(2)
        if size > 125:
            (size,) = struct.unpack(">H" if size == 126 else ">Q", self.file.read(2 if size == 126 else 8))
        return code & 15, self.file.read(size)

    def send(self, operation: dict[str, Any]) -> None:
        text = json.dumps(operation).encode()
        assert len(text) < 2**16
        self.socket.sendall(struct.pack(">BBH4x", 0x81, 0x80 | 126, len(text)) + text)  # masked by zeros

    def messages(self, topics: set[str]) -> Iterator[tuple[dict[str, Any], bytes]]:
        """Subscribe to all topics as they are advertised; yield their channels and messages."""
        channels: dict[int, dict[str, Any]] = {}
        while True:
            code, content = self.receive()
            if code == 1 and (advertised := json.loads(content))["op"] == "advertise":
                new = {each["id"]: each for each in advertised["channels"] if each["topic"] in topics}
                channels |= new
                self.send({"op": "subscribe", "subscriptions": [{"id": n, "channelId": n} for n in new]})
            elif code == 2 and content[0] == 1:
                (subscription,) = struct.unpack("<I", content[1:5])
                yield channels[subscription], content[13:]


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ("", 101),
        ("Origin: https://app.foxglove.dev", 101),
        ("Origin: file://", 101),
        ("Origin: https://elsewhere.example", 403),
        ("Origin: https://app.foxglove.dev.elsewhere.example", 403),
        ("Origin: null", 403),
        ("Host: elsewhere.example:{port}", 403),
    ],
)
def test_foxglove_refuses_foreign_pages(foxglove_port: int, headers: str, status: int) -> None:
    with ask_to_connect(foxglove_port, *filter(None, [headers.format(port=foxglove_port)])) as client:
        assert client.recv(100).split()[1] == str(status).encode()


@pytest.fixture(scope="module")
def foxglove_port() -> Iterator[int]:
    with FoxgloveOutput(0, **AREA) as output:
        yield int(output.url.rpartition(":")[2])


def decode(channel: dict[str, Any], content: bytes) -> Any:
    """Return a message of Protobuf by the schema of its channel."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString(content)


def test_foxglove(golden: Golden) -> None:
    """All topics with their schemas, and the messages that a client gets that subscribes to all."""
    sent = messages()
    with FoxgloveOutput(0, **AREA) as output:
        for message in sent:
            output.send(message)
        port = int(output.url.rpartition(":")[2])
        with pytest.raises(InputError, match=rf"^port {port} of .*: another program uses it; .*--foxglove"):
            FoxgloveOutput(port, **AREA)
        client = FoxgloveClient(port)
        received = client.messages({SCENE, *(message.topic for message in sent)})
        lines = ["at first " + next(received)[1].decode()]  # the latest health, though it was sent before
        for message in sent:
            output.send(message)
        for _ in range(len(sent) + 3):  # a scene with each touch
            channel, content = next(received)
            is_scene = channel["topic"] == SCENE
            text = " ".join(str(decode(channel, content)).split()) if is_scene else content.decode()
            lines += [] if is_scene else [f"schema {channel['topic']} {channel['schema']}"]
            lines.append(f"{channel['topic']} {channel['encoding']} {channel['schemaName']} {text}")
        client.socket.close()
    golden("live/foxglove.txt", "\n".join(dict.fromkeys(lines)))


def test_rerun(golden: Golden, tmp_path: Path) -> None:
    """All that the file holds but the layout of the viewer."""
    from rerun.chunk import RrdReader

    path = tmp_path / "pad.rrd"
    with contextlib.suppress(KeyboardInterrupt), RerunOutput(str(path), 2, **AREA) as output:
        for message in messages():
            output.send(message)
        assert not path.exists()
        raise KeyboardInterrupt  # the usual end of a live pad
    assert [file.name for file in tmp_path.iterdir()] == ["pad.rrd"]
    lines = []
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        names = [name for name in batch.schema.names if ":" in name or name == "pad_time"]
        if "RecordingInfo" not in names[0]:
            lines += [f"{chunk.entity_path} {name}: {batch.column(name).to_pylist()}" for name in names]
    golden("live/rerun.txt", "\n".join(sorted(lines)))


POSITION = {"press": 4, "x_mm": 1.5, "y_mm": -2.25, "r50_mm": 0.5, "r90_mm": 1.0, "final": True, "failed": []}
TOUCH = Message(TOUCHES, {}, {"event": "touch", **POSITION})
READING = Message(READINGS, {}, {"event": "readings", "time_s": 0.5, "volts": [1.0, None]})
STATES = Message(HEALTH, {}, {"event": "health", "time_s": 0.0, "states": ["sound", "stuck"]})
TOKEN = "a word of sixteen"
PROTOCOL = Path(__file__).parents[3] / "docs" / "live-protocol.md"


@given(
    st.floats(-1e10, 1e10)
    | st.floats(-1e6, 2e9)
    | st.builds(operator.sub, st.integers(-(10**6), 10**6), st.floats(0, 1e-9))
)
@example(1.9999999996)
def test_stamps_are_the_nearest_nanoseconds(time_s: float) -> None:
    """Of live messages, and of those in a bag, where they are not negative."""
    times_s = np.array([time_s])
    silent: Any = SimpleNamespace(pressed=False, is_other_pad=False, view=lambda: {"fibres": []})
    health, _ = MessageBuilder(silent).build(times_s, np.zeros((1, 1)), [])
    stamp = health.msg["header"]["stamp"]
    assert 0 <= stamp["nanosec"] < 10**9
    assert abs(10**9 * (stamp["sec"] - Fraction(time_s)) + stamp["nanosec"]) < 0.5 + 1e-6
    if -1e6 <= time_s <= 2e9:
        epoch_s = choose_epoch(times_s)
        (stamp,) = to_stamps(times_s, epoch_s).tolist()
        assert 0 <= stamp < 2**31 * 10**9
        assert abs(stamp - 10**9 * (Fraction(time_s) - Fraction(epoch_s))) < 0.5 + 1e-6


def subscribe(stack: ExitStack, lines: JsonLines) -> IO[str]:
    """What a client receives after the states, which it gets as it comes."""
    client = stack.enter_context(socket.create_connection(lines.address, timeout=20)).makefile()
    assert json.loads(client.readline())["pad"].items() >= STATES.pad.items()
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
        lines.send(Message(HEALTH, {}, {"event": "an earlier one"}))
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
