"""Viewers get what the messages say: Foxglove through its WebSocket server, Rerun through a file."""

import base64
import contextlib
import json
import os
import socket
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from padforge.common.validation import InputError
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOUCHES
from padforge.sense.live.viewers import SCENE, FoxgloveOutput, RerunOutput
from tests.sense.live.test_outputs import DOWN, READING, STATES, TOUCH

AREA = {"centre_mm": [1.0, 2.0], "half_mm": [10.0, 5.0]}
POSE = {"pose": {"pose": {"position": {"x": 0.0015, "y": -0.00225, "z": -0.001}}}}
SENT = [
    replace(STATES, msg={"status": [{"level": 0, "name": "pad: fibre 1", "message": "sound"}]}),
    replace(READING, msg={"data": [None, 1.0]}),
    replace(DOWN, msg={"data": True}, pad={"time_s": 0.5, **DOWN.pad}),
    replace(TOUCH, msg=POSE, pad={"now_s": 0.75, **TOUCH.pad}),
]


class FoxgloveClient:
    """The little of a WebSocket client that a subscriber needs (RFC 6455)."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        self.file = self.socket.makefile("rb")
        key = base64.b64encode(os.urandom(16)).decode()
        upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13"
        protocol = "Sec-WebSocket-Protocol: foxglove.sdk.v1"
        request = (
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{upgrade}\r\nSec-WebSocket-Key: {key}\r\n{protocol}\r\n\r\n"
        )
        self.socket.sendall(request.encode())
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


def test_foxglove_gets_messages_and_a_scene() -> None:
    with FoxgloveOutput(0, **AREA) as output:
        for message in SENT:
            output.send(message)
        client = FoxgloveClient(int(output.url.rpartition(":")[2]))
        messages = client.messages({READINGS, PRESSED, TOUCHES, HEALTH, SCENE})
        channel, content = next(messages)  # the health at first, though it was sent before
        assert (channel["topic"], json.loads(content)) == (HEALTH, SENT[0].msg)
        assert (channel["schemaName"], channel["encoding"]) == ("diagnostic_msgs/msg/DiagnosticArray", "json")
        for message in SENT[1:]:
            output.send(message)
        received = [next(messages) for _ in range(4)]
        client.socket.close()
    assert [channel["topic"] for channel, _ in received] == [READINGS, PRESSED, TOUCHES, SCENE]
    for message, (channel, content) in zip(SENT[1:], received[:3], strict=True):
        assert json.loads(content) == message.msg
        assert json.loads(channel["schema"])["properties"].keys() == message.msg.keys()
    assert json.loads(received[0][0]["schema"])["properties"]["data"]["items"] == {"type": "number"}
    (entity,) = decode(*received[3]).entities
    (disc,), (area,) = entity.cylinders, entity.cubes
    assert (disc.pose.position.x, disc.pose.position.y, disc.pose.position.z) == (0.0015, -0.00225, -0.001)
    assert (disc.size.x, disc.size.y, disc.top_scale) == (0.002, 0.002, 1)
    assert (area.pose.position.x, area.pose.position.y, area.size.x, area.size.y) == (0.001, 0.002, 0.02, 0.01)


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
    with socket.create_connection(("127.0.0.1", foxglove_port), timeout=20) as client:
        lines = [
            "GET / HTTP/1.1",
            *([] if headers.startswith("Host") else [f"Host: localhost:{foxglove_port}"]),
            *("Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"),
            *("Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol: foxglove.sdk.v1"),
            *filter(None, [headers.format(port=foxglove_port)]),
        ]
        client.sendall("\r\n".join([*lines, "", ""]).encode())
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


def test_foxglove_names_a_port_in_use() -> None:
    with FoxgloveOutput(0, **AREA) as output:
        port = int(output.url.rpartition(":")[2])
        with pytest.raises(
            InputError, match=rf"^port {port} of 127.0.0.1: another program uses it; choose .*--foxglove"
        ):
            FoxgloveOutput(port, **AREA)


def test_rerun_writes_a_file(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    path = tmp_path / "pad.rrd"
    with contextlib.suppress(KeyboardInterrupt), RerunOutput(str(path), 2, **AREA) as output:
        for message in SENT:
            output.send(message)
        assert not path.exists()
        raise KeyboardInterrupt  # the usual end of a live pad
    assert [file.name for file in tmp_path.iterdir()] == ["pad.rrd"]
    chunks = {(chunk.entity_path, chunk.is_static): chunk.to_record_batch() for chunk in RrdReader(str(path)).stream()}

    def value(entity: str, column: str, is_static: bool = False) -> Any:
        return chunks[entity, is_static].column(column)[0].as_py()

    np.testing.assert_array_equal(value("/readings", "Scalars:scalars"), [1.0, np.nan])
    assert value("/readings", "SeriesLines:names", is_static=True) == ["fibre 1", "fibre 2"]
    assert chunks["/pressed", False].column("Scalars:scalars").to_pylist() == [[0.0], [1.0]]
    assert value("/health", "TextLog:text") == ["fibre 1: sound, fibre 2: stuck"]
    assert value("/pad/touch", "Ellipsoids3D:centers") == [[1.5, -2.25, -1.0]]
    assert value("/pad/touch", "Ellipsoids3D:half_sizes") == [[1.0, 1.0, 0.5]]
    assert value("/pad/area", "Boxes3D:half_sizes", is_static=True) == [[10.0, 5.0, 0.0]]
    assert chunks["/pad/touch", False].column("pad_time")[0].value == 750_000_000  # ns


@pytest.mark.parametrize(
    ("target", "error"),
    [
        (
            "localhost:9876",
            r"^--rerun is 'localhost:9876', expected an address like rerun\+http://HOST:PORT/proxy",
        ),
        ("file/pad.rrd", r"^file/pad\.rrd: cannot be written"),
    ],
)
def test_rerun_refuses_other_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, target: str, error: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    with pytest.raises(InputError, match=error):
        RerunOutput(target, 2, **AREA)
