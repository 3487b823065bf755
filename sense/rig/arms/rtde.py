"""What the child that holds ur-rtde writes to its parent: states as numbers, answers as JSON.

Frames of RTDE, the data link of Universal Robots controllers, and their dashboard; big-endian, both ways.

Reads every state of a UR controller's RTDE stream and tells when each was taken on the host's clock.
"""

import json
import math
import re
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

_STATE = struct.Struct("<c14d")
_ANSWER = struct.Struct("<cI")


class StateRow(NamedTuple):
    """One state on the wire: mm, rad, s and N; the flags are 0 or 1, force is NaN without a sensor."""

    time_s: float
    x_mm: float
    y_mm: float
    z_mm: float
    rx: float
    ry: float
    rz: float
    speed_mm_s: float
    force_n: float
    protective_stop: float
    emergency_stop: float
    moving: float
    skipped: float
    sideways_n: float


def pack_row(row: StateRow) -> bytes:
    """Bytes of a state."""
    return _STATE.pack(b"S", *row)


def pack_answer(answer: Any) -> bytes:
    """Bytes of an answer."""
    text = json.dumps(answer).encode()
    return _ANSWER.pack(b"A", len(text)) + text


def read(source: Callable[[int], bytes]) -> Iterator[StateRow | dict[str, Any]]:
    """States and answers from a blocking `source` of bytes until it ends, be it in the middle of one."""
    while kind := source(1):
        head = kind + source((_STATE if kind == b"S" else _ANSWER).size - 1)
        try:
            if kind == b"S":
                yield StateRow._make(_STATE.unpack(head)[1:])
            else:
                yield json.loads(source(_ANSWER.unpack(head)[1]))
        except (struct.error, ValueError, RecursionError):
            return


RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION, CONTROLLER, OUTPUTS, INPUTS, START, PAUSE, DATA = b"VvOISPU"
PROTOCOL = 2
"""The only version of the protocol that is spoken here."""
RUNNING = 7
"""Robot mode of an arm that is powered on and has its brakes released."""
STOPPED, PLAYING, PAUSED = 1, 2, 4
"""Runtime states of the program."""
PROTECTIVE_BITS = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 8 | 1 << 9 | 1 << 10
"""Protective and safeguard stop, recovery, violation, fault: the controller does not move the arm."""
EMERGENCY_BITS = 1 << 5 | 1 << 6 | 1 << 7

_HEADER = struct.Struct(">HB")
_CODES = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "UINT64": "Q"}
_CODES |= {"VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i"}
_TYPES = (
    (r"robot_mode|safety_mode|(input|output)_int_register_\d+", "INT32"),
    (r"runtime_state|robot_status_bits|safety_status_bits|output_bit_registers\d+_to_\d+", "UINT32"),
    (r"actual_digital_(in|out)put_bits", "UINT64"),
    (r"actual_tool_accelerometer|payload_cog", "VECTOR3D"),
    (r"joint_mode", "VECTOR6INT32"),
    (r"actual_robot_(current|voltage)|actual_main_voltage", "DOUBLE"),
    (r"(actual|target)_(q|qd|qdd|current|moment|TCP_\w+)|actual_current_as_torque|actual_joint_voltage", "VECTOR6D"),
    (r"joint_(control_output|temperatures)|ft_raw_wrench|payload_inertia", "VECTOR6D"),
    (r"\w+", "DOUBLE"),
)


def type_of(name: str) -> str:
    """Type of a variable by its name, as ur-rtde decodes it."""
    return next(kind for pattern, kind in _TYPES if re.fullmatch(pattern, name))


def layout(types: Sequence[str]) -> struct.Struct:
    """Layout of the values of a recipe; KeyError for a type that a controller gives to a variable it does not have."""
    return struct.Struct(">" + "".join(_CODES[kind] for kind in types))


def width(kind: str) -> int:
    """How many values a variable of a type has."""
    return int(_CODES[kind][:-1] or 1)


def frame(kind: int, payload: bytes = b"") -> bytes:
    """A frame with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


class Splitter:
    """Cuts a stream of bytes into frames."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Kind and payload of every frame that `data` completes; ValueError for a size no frame can have."""
        self._bytes += data
        while len(self._bytes) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._bytes)
            if size < _HEADER.size:
                raise ValueError(f"a frame of {size} bytes; expected at least {_HEADER.size}")
            if len(self._bytes) < size:
                return
            payload = bytes(self._bytes[_HEADER.size : size])
            del self._bytes[:size]
            yield kind, payload


def ask_dashboard(host: str, questions: Sequence[str], timeout_s: float) -> list[str]:
    """One line of answer to each question; OSError where the dashboard does not answer within `timeout_s` each."""
    with socket.create_connection((host, DASHBOARD_PORT), timeout_s) as link, link.makefile("rb") as lines:
        lines.readline()
        answers = []
        for question in questions:
            link.sendall(question.encode() + b"\n")
            if not (answer := lines.readline()):
                raise ConnectionError("the dashboard closed the link")
            answers.append(answer.decode(errors="replace").strip())
        return answers


def stop_program(host: str, timeout_s: float) -> bool:
    """Stop the program of the arm, and with it the arm, by the dashboard; whether none runs any more.

    A stopped program cannot go on when a person unlocks the arm, a paused one can.
    """
    try:
        return ask_dashboard(host, ["stop", "running"], timeout_s)[1].lower().endswith("false")
    except OSError:
        return False


VARIABLES = (
    *("timestamp", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force"),
    *("robot_mode", "runtime_state", "safety_status_bits", "output_int_register_2"),
)
FORCE_SERIES = 5
"""First major version of PolyScope whose arms have a force sensor at the tool."""
DRIFT = 2e-4
"""How fast the controller's clock may run against the host's, as a share."""


@dataclass(frozen=True)
class Reading:
    """One state as the controller sends it.

    Attributes:
        time_s: when it was taken, on the host's monotonic clock. skipped: how many states are missing before it.
        pose: m and rad. speed: of the tool, m/s. force_n: on the tool along z, None without a sensor.
        sideways_n: across z, 0 without one.
        mode: of the robot. runtime: state of the program. safety: bits. progress: ur-rtde's register of moves.
    """

    time_s: float
    skipped: int
    pose: tuple[float, ...]
    speed: float
    force_n: float | None
    sideways_n: float
    mode: int
    runtime: int
    safety: int
    progress: int


class HostClock:
    """Controller time to host time by the shortest delay seen, so that a late arrival is not taken for a late state."""

    def __init__(self) -> None:
        self._offset = float("inf")
        self._before = self._last = float("-inf")

    def host_time(self, stamp: float, arrived: float) -> float:
        """Host time of the state stamped `stamp` that arrived at `arrived`: no later than that, always ascending."""
        grown = self._offset + DRIFT * max(stamp - self._before, 0.0)
        self._offset = min(grown, arrived - stamp)
        self._before = stamp
        self._last = max(stamp + self._offset, self._last + 1e-6)
        return self._last


class RtdeReader:
    """A link to the RTDE port; OSError where there is none or it ends, TimeoutError where nothing comes.

    Attributes:
        version: of the controller, four numbers. rate_hz: of the stream.
    """

    def __init__(self, host: str, timeout_s: float) -> None:
        """Connect and agree on what is sent; ValueError where the controller lacks the protocol or a variable."""
        self._link = socket.create_connection((host, RTDE_PORT), timeout_s)
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._splitter = Splitter()
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._clock = HostClock()
        self._stamp: float | None = None
        if self._ask(VERSION, struct.pack(">H", PROTOCOL)) != b"\x01":
            raise ValueError(f"the controller does not speak RTDE {PROTOCOL}")
        self.version: tuple[int, ...] = _unpacked(struct.Struct(">4I"), self._ask(CONTROLLER))
        self.rate_hz = 500 if self.version[0] >= FORCE_SERIES else 125
        names = ",".join(VARIABLES).encode()
        types = self._ask(OUTPUTS, struct.pack(">d", self.rate_hz) + names)[1:].decode().split(",")
        if "NOT_FOUND" in types:
            raise ValueError(f"the controller has no {VARIABLES[types.index('NOT_FOUND') % len(VARIABLES)]}")
        if types != [type_of(name) for name in VARIABLES]:
            raise ValueError(f"the controller would send {','.join(types)[:200]!r} for {','.join(VARIABLES)}")
        self._layout = layout(types)
        self._ask(START)

    def read(self, timeout_s: float) -> Reading:
        """The next state; TimeoutError after `timeout_s` without a byte, ValueError for one that is none."""
        self._link.settimeout(timeout_s)
        while not self._waiting:
            self._receive()
        arrived, payload = self._waiting.popleft()
        return self._reading(arrived, _unpacked(self._layout, payload[1:]))

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _ask(self, kind: int, payload: bytes = b"") -> bytes:
        self._link.sendall(frame(kind, payload))
        while True:
            for got, answer in self._receive():
                if got == kind:
                    return answer

    def _receive(self) -> list[tuple[int, bytes]]:
        """Wait for bytes; queues the states among the frames they complete and returns the others."""
        data = self._link.recv(65536)
        if not data:
            raise ConnectionError("the controller closed the link")
        now = time.monotonic()
        others = []
        for kind, payload in self._splitter.feed(data):
            if kind == DATA:
                self._waiting.append((now, payload))
            else:
                others.append((kind, payload))
        return others

    def _reading(self, arrived: float, values: tuple[float, ...]) -> Reading:
        stamp, pose, speed, force = values[0], values[1:7], values[7:10], values[13:16]
        felt = self.version[0] >= FORCE_SERIES
        if not all(map(math.isfinite, values)):
            raise ValueError("the controller sent a state that holds NaN or infinity")
        skipped = 0 if self._stamp is None else max(0, round((stamp - self._stamp) * self.rate_hz) - 1)
        self._stamp = stamp
        return Reading(
            time_s=self._clock.host_time(stamp, arrived),
            skipped=skipped,
            pose=pose,
            speed=sum(value * value for value in speed) ** 0.5,
            force_n=force[2] if felt else None,
            sideways_n=math.hypot(*force[:2]) if felt else 0.0,
            **dict(zip(("mode", "runtime", "safety", "progress"), map(int, values[19:]), strict=True)),
        )


def _unpacked(layout: struct.Struct, payload: bytes) -> tuple[Any, ...]:
    """The values of a payload; ValueError where it is of another size."""
    if len(payload) != layout.size:
        raise ValueError(f"the controller sent {len(payload)} bytes, expected {layout.size}")
    return layout.unpack(payload)
