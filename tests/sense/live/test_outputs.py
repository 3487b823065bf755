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

from padforge.sense.formats.ros_messages import HEALTH, READINGS, TOUCHES
from padforge.sense.live import outputs
from padforge.sense.live.outputs import JsonLines, Message, MessageBuilder

POSITION = {"press": 4, "x_mm": 1.5, "y_mm": -2.25, "r50_mm": 0.5, "r90_mm": 1.0, "final": True, "failed": []}
TOUCH = Message(TOUCHES, {}, {"event": "touch", **POSITION})
READING = Message(READINGS, {}, {"event": "readings", "time_s": 0.5, "volts": [1.0, None]})
STATES = Message(HEALTH, {}, {"event": "health", "time_s": 0.0, "states": ["sound", "stuck"]})
TOKEN = "a word of sixteen"
PROTOCOL = Path(__file__).parents[3] / "docs" / "live-protocol.md"


@given(st.floats(-1e10, 1e10) | st.builds(operator.sub, st.integers(-(10**6), 10**6), st.floats(0, 1e-9)))
@example(1.9999999996)
def test_stamp_is_the_nearest_nanosecond(time_s: float) -> None:
    silent: Any = SimpleNamespace(pressed=False, is_other_pad=False, view=lambda: {"fibres": []})
    health, _ = MessageBuilder(silent).build(np.array([time_s]), np.zeros((1, 1)), [])
    stamp = health.msg["header"]["stamp"]
    assert 0 <= stamp["nanosec"] < 10**9
    assert abs(10**9 * (stamp["sec"] - Fraction(time_s)) + stamp["nanosec"]) < 0.5 + 1e-6


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
