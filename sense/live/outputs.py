"""Outputs of a live pad: messages (docs/live-protocol.md), and the streams and the page that send them.

A message is a `publish` operation of the rosbridge protocol with a standard message of ROS 2, under the same topic as
in an exported bag, so that a bridge needs no conversion. It also contains the same values in mm and V.
"""

import hmac
import json
import math
import queue
import socketserver
import threading
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from padforge.common.server import HOST, ConnectionServer, LocalPage, page_text
from padforge.common.validation import InputError, short_repr
from padforge.sense.arrays import Array
from padforge.sense.formats import ros_messages as ros
from padforge.sense.formats.ros_messages import HEALTH, PRESSED, READINGS, TOPICS, TOUCHES
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.pipeline import Estimate, Event, Live, OtherPad
from padforge.sense.localizer.single_press import OTHER_PAD

FORMAT = "padforge-live/1"
MAX_QUEUED = 4096  # lines queued for a subscriber, which is disconnected if it falls further behind


@dataclass(frozen=True)
class Message:
    """A message to other programs."""

    topic: str  # a key of `TOPICS`
    msg: dict[str, Any]  # the ROS 2 message as JSON
    pad: dict[str, Any]  # the same values in mm and V, with the name of the "event"

    def to_json(self, number: int) -> str:
        """Return the message as a line of JSON, with its number in the stream, from 0."""
        operation = {"op": "publish", "topic": self.topic, "type": TOPICS[self.topic].msgtype, "msg": self.msg}
        pad = {"format": FORMAT, "number": number, **self.pad}
        return json.dumps(operation | {"pad": pad}, allow_nan=False)


class MessageBuilder:
    """Builds the messages of a pipeline; z points into a pad that is `mirrored`, that is with its tracks up."""

    def __init__(self, pipeline: Live, mirrored: bool = False) -> None:
        self._pipeline, self._pressed, self._is_first = pipeline, False, True
        self._mirrored = mirrored

    def build(self, times_s: Array, readings: Array, events: Sequence[Event]) -> Iterator[Message]:
        """Yield the messages of a block of readings, times (n,), s, and voltages (n, C), and of its events."""
        if not len(times_s):
            return
        now_s = float(times_s[-1])
        if self._is_first:
            self._is_first = False
            yield self._health(float(times_s[0]), None)
        for time_s, volts in zip(times_s.tolist(), readings.tolist(), strict=True):
            data = [None if math.isnan(value) else value for value in volts]
            yield _message(READINGS, time_s, data, {"event": "readings", "time_s": time_s, "volts": data})
        if self._pipeline.pressed != self._pressed:
            self._pressed = not self._pressed
            pad = {"event": "pressed", "time_s": now_s, "pressed": self._pressed}
            yield _message(PRESSED, now_s, [self._pressed], pad)
        for event in events:
            yield self._touch(event) if isinstance(event, Estimate) else self._health(now_s, event)

    def _touch(self, estimate: Estimate) -> Message:
        x_y_mm, std_mm = np.array([[estimate.x_mm, estimate.y_mm]]), np.array([[estimate.std_x_mm, estimate.std_y_mm]])
        depths_mm, r90_mm = (np.array([mm], float) for mm in (estimate.depth_mm, estimate.depth_r90_mm))  # None is NaN
        (values,) = ros.poses(x_y_mm, depths_mm, self._mirrored, std_mm, r90_mm).tolist()
        return _message(TOUCHES, estimate.now_s, values, {"event": "touch", **estimate.to_dict()})

    def _health(self, time_s: float, event: FibreFault | OtherPad | None) -> Message:
        states = [fibre["state"] for fibre in self._pipeline.view()["fibres"]]
        status = [
            ros.build_state(f"pad: fibre {number}", state, state not in ("sound", "unmonitored"))
            for number, state in enumerate(states, 1)
        ]
        pad: dict[str, Any] = {"event": "health", "time_s": time_s, "states": states}
        pad["other_pad"] = self._pipeline.is_other_pad
        if pad["other_pad"]:
            status.append(ros.build_state("pad", OTHER_PAD, True))
        if isinstance(event, FibreFault):
            pad["fault"] = {**asdict(event), "text": event.text}
        return _message(HEALTH, time_s, status, pad)


def _message(topic: str, time_s: float, values: Sequence[Any], pad: dict[str, Any]) -> Message:
    """Return a message whose stamp is a time by the clock of the readings."""
    whole_s = math.floor(time_s)
    stamp = whole_s * 10**9 + round((time_s - whole_s) * 1e9)
    return Message(topic, ros.build_message(topic, stamp, values), pad)


class JsonLines(ConnectionServer):
    """A TCP server of JSON lines in the `with` block: the latest state of the fibres, then all later messages.

    Raises InputError if the port (0 for any free one) cannot be used, or other machines could connect without a token,
    which a subscriber has to send as its first line.
    """

    def __init__(self, host: str, port: int, token: str = "") -> None:
        self._subscribers: set[_Subscriber] = set()
        self._health: bytes | None = None
        self._number = 0
        self._changed = threading.Condition()
        super().__init__((host, port), _Subscriber, token, "--tcp")
        self.address: tuple[str, int] = self.server_address[:2]  # type: ignore[assignment]

    def send(self, message: Message) -> None:
        line = f"{message.to_json(self._number)}\n".encode()
        self._number += 1
        with self._changed:
            if message.topic == HEALTH:
                self._health = line
            for subscriber in self._subscribers:
                subscriber.put(line)

    def end(self, timeout_s: float) -> None:
        """Stop sending, and wait until every subscriber has all messages, for at most `timeout_s`."""
        with self._changed:
            for subscriber in self._subscribers:
                subscriber.put(None)
            self._changed.wait_for(lambda: not self._subscribers, timeout_s)

    def subscribe(self, subscriber: "_Subscriber") -> None:
        with self._changed:
            self._subscribers.add(subscriber)
            if self._health is not None:
                subscriber.put(self._health)

    def unsubscribe(self, subscriber: "_Subscriber") -> None:
        with self._changed:
            self._subscribers.discard(subscriber)
            self._changed.notify_all()


class _Subscriber(socketserver.StreamRequestHandler):
    server: JsonLines  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = 10.0  # s, after which a subscriber that does not receive is disconnected

    def setup(self) -> None:
        super().setup()
        self._lines: queue.Queue[bytes | None] = queue.Queue(MAX_QUEUED)
        self._is_behind = False

    def put(self, line: bytes | None) -> None:
        try:
            self._lines.put_nowait(line)
        except queue.Full:
            self._is_behind = True

    def handle(self) -> None:
        token = self.server.token.encode()
        if token and not hmac.compare_digest(self.rfile.readline(len(token) + 2).rstrip(b"\r\n"), token):
            return
        self.server.subscribe(self)
        try:
            while not self._is_behind and (line := self._lines.get()) is not None:
                self.wfile.write(line)
        finally:
            self.server.unsubscribe(self)


class LivePage(LocalPage):
    """A page of the folder `pages`, served like a `LocalPage`, that shows a pad and may send `commands`."""

    def __init__(
        self, port: int, page: str = "live.html", commands: Collection[str] = (), *, host: str = HOST, token: str = ""
    ) -> None:
        self._allowed, self._commands = frozenset(commands), deque[str]()
        text = page_text("padforge.sense.live", f"pages/{page}", "pages/common.css", "pages/common.js")
        super().__init__(port, text, {"/command": self._on_command}, host=host, token=token)

    def read_commands(self) -> list[str]:
        """Return the commands that the page has sent since the last call, oldest first."""
        return [self._commands.popleft() for _ in range(len(self._commands))]

    def _on_command(self, body: bytes) -> None:
        command = body.decode("ascii", "replace")
        if command not in self._allowed:
            allowed = ", ".join(sorted(self._allowed)) or "none"
            raise InputError(f"command is {short_repr(command)}, allowed are {allowed}")
        self._commands.append(command)
