"""Viewers get what the messages say: Foxglove through its WebSocket server, Rerun through a file."""

import base64
import contextlib
import json
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from padforge.common.validation import InputError
from padforge.sense.live.viewers import SCENE, FoxgloveOutput, RerunOutput
from tests.helpers.golden import Golden
from tests.sense.live.test_messages import messages

AREA = {"centre_mm": [1.0, 2.0], "half_mm": [20.0, 10.0]}


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


def test_foxglove(golden: Golden) -> None:
    """All topics with their schemas, and the messages that a client gets that subscribes to all."""
    sent = messages()
    with FoxgloveOutput(0, **AREA) as output:
        for message in sent:
            output.send(message)
        client = FoxgloveClient(int(output.url.rpartition(":")[2]))
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
