"""What happens to a pad, as messages that are the same over every way out (docs/live-protocol.md).
A message is a `publish` operation of the rosbridge protocol, with a standard message of ROS 2 under the same topic as
in an exported bag, so a bridge has nothing to convert; beside it stands the same in plain numbers, mm and V.

Ways out of this program: lines over TCP, OSC over UDP, and streams of the Lab Streaming Layer.

The page of a pad that is pressed: it shows what happens as it happens, and may say a few words itself.
"""

import contextlib
import hmac
import json
import math
import queue
import socket
import socketserver
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Protocol, Self

from padforge.design.common.server import HOST, ConnectionServer, LocalPage, page_text
from padforge.design.common.validation import InputError, short_repr
from padforge.sense.arrays import Array
from padforge.sense.formats.ros_messages import (
    FRAME,
    HEALTH,
    PRESSED,
    READINGS,
    TOPICS,
    TOUCHES,
    UNKNOWN_VARIANCE,
    Z90,
)
from padforge.sense.health.fault_detector import FibreFault
from padforge.sense.live.pipeline import Estimate, Event, Live

FORMAT = "padforge-live/2"
_OK, _ERROR = 0, 2
"""Levels of a `DiagnosticStatus`."""
SOUND = ("sound", "unwatched")


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        topic: one of `TOPICS`. msg: the ROS message, as JSON. pad: the same in plain numbers; has "event".
    """

    topic: str
    msg: dict[str, Any]
    pad: dict[str, Any]

    def line(self, number: int) -> str:
        """The message as one line of JSON, the `number`-th that was told, from 0."""
        pad = {"format": FORMAT, "number": number, **self.pad}
        operation = {"op": "publish", "topic": self.topic, "type": TOPICS[self.topic].msgtype, "msg": self.msg, "pad": pad}
        return json.dumps(operation, allow_nan=False)


class Messages:
    """Makes messages of what a pipeline is fed and finds.

    Args:
        mirrored: whether the pad lies with its tracks up, so that z has to point into it, as in an exported bag.
    """

    def __init__(self, pipeline: Live, mirrored: bool = False) -> None:
        self._pipeline, self._pressed = pipeline, False
        self._inwards = 1.0 if mirrored else -1.0
        self._told_health = False

    def of(self, times_s: Array, readings: Array, events: Sequence[Event]) -> Iterator[Message]:
        """Messages of a block of readings, (n,) s and (n, C) V, and of what came to light with it."""
        if not len(times_s):
            return
        now_s = float(times_s[-1])
        if not self._told_health:
            yield self._health(float(times_s[0]), None)
        for time_s, volts in zip(times_s.tolist(), readings.tolist(), strict=True):
            yield _readings(time_s, volts)
        if self._pipeline.pressed != self._pressed:
            self._pressed = not self._pressed
            yield Message(PRESSED, {"data": self._pressed}, _plain("pressed", now_s, pressed=self._pressed))
        for event in events:
            yield _touch(event, self._inwards) if isinstance(event, Estimate) else self._health(now_s, event)

    def _health(self, time_s: float, fault: FibreFault | None) -> Message:
        self._told_health = True
        states = [fibre["state"] for fibre in self._pipeline.view()["fibres"]]
        status = [
            {
                "level": _OK if state in SOUND else _ERROR,
                "name": f"pad: fibre {fibre}",
                "message": state,
                "hardware_id": "pad",
                "values": [],
            }
            for fibre, state in enumerate(states, 1)
        ]
        told = {} if fault is None else {"fault": {**asdict(fault), "text": fault.text}}
        return Message(
            HEALTH, {"header": _header(time_s), "status": status}, _plain("health", time_s, states=states, **told)
        )


def _plain(event: str, time_s: float, **more: Any) -> dict[str, Any]:
    return {"event": event, "time_s": time_s, **more}


def _readings(time_s: float, volts: list[float]) -> Message:
    told = [None if math.isnan(each) else each for each in volts]
    dimension = {"label": "fibre", "size": len(told), "stride": len(told)}
    return Message(
        READINGS,
        {"layout": {"dim": [dimension], "data_offset": 0}, "data": told},
        _plain("readings", time_s, volts=told),
    )


def _touch(found: Estimate, inwards: float) -> Message:
    variances = [0.0] * 36
    variances[0], variances[7] = (found.sd_x_mm / 1000) ** 2, (found.sd_y_mm / 1000) ** 2
    variances[14] = (found.depth_r90_mm / 1000 / Z90) ** 2 if found.depth_r90_mm is not None else UNKNOWN_VARIANCE
    position = {"x": found.x_mm / 1000, "y": found.y_mm / 1000, "z": 0.0 + inwards * (found.depth_mm or 0.0) / 1000}
    pose = {"position": position, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return Message(
        TOUCHES,
        {"header": _header(found.time_s), "pose": {"pose": pose, "covariance": variances}},
        {"event": "touch", **found.document, "failed": list(found.lost)},
    )


def _header(time_s: float) -> dict[str, Any]:
    """A header of that time of the readings' clock, which begins when the readings do."""
    seconds = math.floor(time_s)
    return {"stamp": {"sec": seconds, "nanosec": round((time_s - seconds) * 1e9) % 10**9}, "frame_id": FRAME}


MOST_BEHIND = 4096
"""Lines that wait for a client; one that is further behind is let go, so that nobody else waits for it."""
MOST_CLIENTS = 32
TAKEN_S = 10.0
"""A client that takes nothing for so long is let go."""
PLACE = {"press": "", "x_mm": "mm", "y_mm": "mm", "r50_mm": "mm", "r90_mm": "mm"}
"""What of a touch OSC and LSL tell, and its units."""


class Outlet(Protocol):
    """Something that messages go out by."""

    def tell(self, message: Message) -> None:
        """Send one message; never waits for who listens."""
        ...


def tell_all(outlets: Iterable[Outlet], messages: Iterable[Message]) -> None:
    """Send messages by all ways out, in their order."""
    for message in messages:
        for outlet in outlets:
            outlet.tell(message)


class Lines:
    """A server that tells every client all messages from when it came, a line of JSON each, from `with` to its end.

    The first is the fibres' state as it is then.

    Attributes:
        address: host and port.
    """

    def __init__(self, host: str, port: int, token: str = "") -> None:
        """Take `port` of `host`, or any that is free if 0; a client's first line must be `token` if there is one.

        Raises:
            InputError: the port is taken, or not for this user, or others could listen without a token.
        """
        self._server = _LineServer((host, port), token)
        self.address: tuple[str, int] = self._server.server_address[:2]  # type: ignore[assignment]
        self._number = 0

    def tell(self, message: Message) -> None:
        """Send one message to all who listen."""
        line = f"{message.line(self._number)}\n".encode()
        self._number += 1
        self._server.tell(line, kept=message.topic == HEALTH)

    def __enter__(self) -> Self:
        self._server.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.__exit__()


class _LineServer(ConnectionServer):
    def __init__(self, address: tuple[str, int], token: str) -> None:
        self._clients: set[_Client] = set()
        self._kept: bytes | None = None
        self._changed = threading.Condition()
        super().__init__(address, _Client, token, "--tcp")

    def tell(self, line: bytes, kept: bool = False) -> None:
        """Give a line to all who listen, and if it is `kept` to those who come later."""
        with self._changed:
            self._kept = line if kept else self._kept
            for client in self._clients:
                client.take(line)

    def end(self, timeout_s: float) -> None:
        """There will be no more; waits until all who listen have been sent all, for `timeout_s` at most."""
        with self._changed:
            for client in self._clients:
                client.take(None)
            self._changed.wait_for(lambda: not self._clients, timeout_s)

    def join(self, client: "_Client") -> bool:
        with self._changed:
            if len(self._clients) >= MOST_CLIENTS:
                return False
            self._clients.add(client)
            if self._kept is not None:
                client.take(self._kept)
            return True

    def leave(self, client: "_Client") -> None:
        with self._changed:
            self._clients.discard(client)
            self._changed.notify_all()


class _Client(socketserver.StreamRequestHandler):
    server: _LineServer  # pyright: ignore[reportIncompatibleVariableOverride]
    timeout = TAKEN_S

    def setup(self) -> None:
        super().setup()
        self._waiting: queue.Queue[bytes | None] = queue.Queue(MOST_BEHIND)
        self._behind = False

    def take(self, line: bytes | None) -> None:
        try:
            self._waiting.put_nowait(line)
        except queue.Full:
            self._behind = True

    def handle(self) -> None:
        token = self.server.token.encode()
        if token and not hmac.compare_digest(self.rfile.readline(len(token) + 2).rstrip(b"\r\n"), token):
            return
        self.server.admit(self.request)
        if not self.server.join(self):
            return
        try:
            while not self._behind and (line := self._waiting.get()) is not None:
                self.wfile.write(line)
        finally:
            self.server.leave(self)


class Osc:
    """Open Sound Control over UDP: /pad/touches, /pad/readings, /pad/pressed and /pad/health."""

    def __init__(self, address: str) -> None:
        """Send to `address`, HOST:PORT.

        Raises:
            InputError: no such address, or one that nothing can be sent to.
            ModuleNotFoundError: python-osc is not installed.
        """
        from pythonosc.udp_client import SimpleUDPClient

        host, _, port = address.rpartition(":")
        if not (host and port.isascii() and port.isdigit() and 0 < int(port) < 2**16):
            raise InputError(f"--osc is {address!r}, expected HOST:PORT")
        try:
            family, *_, there = socket.getaddrinfo(host, int(port), type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            raise InputError(f"--osc is {address!r}: no such host ({error})") from error
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as asking:
                asking.connect(there)
        except OSError as error:
            raise InputError(f"--osc is {address!r}: nothing can be sent there ({error})") from error
        # By its number: a name would be looked up for every message, and all wait for that.
        self._client = SimpleUDPClient(str(there[0]), int(port), family=family)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._client.close()

    def tell(self, message: Message) -> None:
        """Send one message."""
        with suppress(OSError):  # nobody listens, or too slowly, or a cable is out: as UDP has it, that is lost
            self._client.send_message(message.topic, _osc_values(message))


def _osc_values(message: Message) -> list[Any]:
    pad = message.pad
    if message.topic == READINGS:
        return [float("nan") if each is None else each for each in pad["volts"]]
    if message.topic == TOUCHES:
        return [pad[name] for name in PLACE]
    return [pad["pressed"]] if message.topic == PRESSED else list(pad["states"])


class Lsl:
    """Two streams of the Lab Streaming Layer: readings at their rate in V, and touches as they are found."""

    def __init__(self, name: str, fibres: int, rate_hz: float) -> None:
        """Offer "NAME readings" and "NAME touches" to all who look for streams in this network.

        Raises:
            ModuleNotFoundError: pylsl is not installed.
            InputError: a name that is no text.
        """
        if any("\ud800" <= letter <= "\udfff" for letter in name):  # bytes of a command line that are no text
            raise InputError(f"the name of a stream is {short_repr(name)}, expected text")
        volts = {f"fibre {fibre}": "V" for fibre in range(1, fibres + 1)}
        self._readings = _outlet(f"{name} readings", volts, rate_hz)
        self._touches = _outlet(f"{name} touches", PLACE, 0.0)

    def tell(self, message: Message) -> None:
        """Send one message, if it is of readings or of a touch."""
        if message.topic == READINGS:
            self._readings.push_sample([float("nan") if each is None else each for each in message.pad["volts"]])
        elif message.topic == TOUCHES:
            self._touches.push_sample([float(message.pad[name]) for name in PLACE])


def _outlet(name: str, units: Mapping[str, str], rate_hz: float) -> Any:
    """A stream whose channels have names and units; of no steady rate if it is 0."""
    from pylsl import IRREGULAR_RATE, StreamInfo, StreamOutlet, cf_double64

    info = StreamInfo(name, "Tactile", len(units), rate_hz or IRREGULAR_RATE, cf_double64, f"padforge {name}")
    listed = info.desc().append_child("channels")
    for label, unit in units.items():
        listed.append_child("channel").append_child_value("label", label).append_child_value("unit", unit)
    return StreamOutlet(info)


_MOST_WORDS = 16
"""That wait to be taken: a button may be hit again and again."""


class LivePage(LocalPage):
    """The page, served from `with` to its end."""

    def __init__(
        self, port: int, page: str = "live.html", words: Collection[str] = (), *, host: str = HOST, token: str = ""
    ) -> None:
        """Take `port`, or any that is free if 0.

        Args:
            page: file among `pages`. words: what the page may say, see `said`. host, token: see `LocalPage`.

        Raises:
            InputError: as `LocalPage`.
        """
        self._words, self._said = frozenset(words), queue.Queue[str](_MOST_WORDS)
        text = page_text("padforge.sense.live", f"pages/{page}", "pages/common.css", "pages/common.js")
        super().__init__(port, text, {"/say": self._hear}, host=host, token=token)

    def said(self) -> list[str]:
        """The words that the page has said since the last call, oldest first."""
        return [self._said.get_nowait() for _ in range(self._said.qsize())]

    def _hear(self, body: bytes) -> None:
        word = body.decode("ascii", "replace")
        if word not in self._words:
            raise InputError("no word that was agreed on")
        with contextlib.suppress(queue.Full):
            self._said.put_nowait(word)
