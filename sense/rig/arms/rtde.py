"""RTDE, the data link of Universal Robots controllers: a reader of states, and the dashboard. Frames are big-endian."""

import math
import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

RTDE_PORT = 30004
DASHBOARD_PORT = 29999
VERSION, CONTROLLER, OUTPUTS, START, DATA = b"VvOSU"  # types of frames
PROTOCOL = 2  # version of the protocol
RUNNING = 7  # robot mode: the arm is powered on and its brakes are released
STOPPED, PLAYING = 1, 2  # runtime states of the program; others are paused, pausing and so on
PROTECTIVE_BITS = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 8 | 1 << 9 | 1 << 10
"""Protective and safeguard stop, recovery, violation, fault: the controller does not move the arm."""
EMERGENCY_BITS = 1 << 5 | 1 << 6 | 1 << 7
VARIABLES = {
    "timestamp": "DOUBLE",
    "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D",
    "actual_TCP_force": "VECTOR6D",
    "robot_mode": "INT32",
    "runtime_state": "UINT32",
    "safety_status_bits": "UINT32",
    "output_int_register_2": "INT32",
}
"""Requested variables and their types; in the register ur-rtde's program reports the progress of moves."""
FORCE_SERIES = 5  # first major version of PolyScope whose arms have a force sensor at the tool
MAX_CLOCK_SKEW = 2e-4  # relative rate difference between the controller's clock and the host's

_HEADER = struct.Struct(">HB")  # size of the frame, with its header, and type
_LAYOUT = struct.Struct(">19diIIi")  # the values of `VARIABLES`; a byte, the number of the recipe, precedes them


def pack_frame(kind: int, payload: bytes = b"") -> bytes:
    """Return a frame with its header."""
    return _HEADER.pack(_HEADER.size + len(payload), kind) + payload


def ask_dashboard(host: str, questions: Sequence[str], timeout_s: float) -> list[str]:
    """Return the answer, one line, to each question; OSError if the dashboard is unreachable or one is late."""
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
    """Stop the arm's program through the dashboard; return whether the dashboard confirms that none runs."""
    try:
        return ask_dashboard(host, ["stop", "running"], timeout_s)[1].lower().endswith("false")
    except OSError:
        return False


@dataclass(frozen=True)
class RtdeState:
    """A state of the arm; mm, rad."""

    time_s: float  # time of the measurement, host's monotonic clock
    pose: tuple[float, ...]  # of the tool
    speed_mm_s: float  # of the tool
    force_n: float | None  # on the tool along z; None without a sensor
    sideways_n: float  # force across z; 0 without a sensor
    protective_stop: bool  # whether the controller has stopped the arm
    emergency_stop: bool  # whether a person has stopped the arm
    mode: int  # robot mode
    runtime: int  # runtime state of the program
    progress: int  # register in which ur-rtde's program reports its moves


class HostClock:
    """Converts controller time to host time by the minimum delay so far, which excludes the jitter of the network."""

    def __init__(self) -> None:
        self._offset = float("inf")
        self._last_stamp = self._last_s = float("-inf")

    def host_time(self, stamp: float, arrival_s: float) -> float:
        """Return the host time of a state: not after `arrival_s`, and later than all returned before."""
        drifted = self._offset + MAX_CLOCK_SKEW * max(stamp - self._last_stamp, 0.0)
        self._offset = min(drifted, arrival_s - stamp)
        self._last_stamp = stamp
        self._last_s = max(stamp + self._offset, self._last_s + 1e-6)
        return self._last_s


class RtdeReader:
    """A link to the RTDE port that reads every state of the arm.

    ur-rtde's own receiver stores the latest state only: a program that polls it misses states and cannot tell that the
    arm has fallen silent.

    Methods raise OSError if the link cannot be opened or ends, TimeoutError if nothing arrives, and ValueError for
    damaged frames.
    """

    def __init__(self, host: str, timeout_s: float) -> None:
        """Connect and start the stream; ValueError if the controller lacks the protocol or a variable."""
        self._link = socket.create_connection((host, RTDE_PORT), timeout_s)
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._stream = self._link.makefile("rb")
        self._clock = HostClock()
        if self._request(VERSION, struct.pack(">H", PROTOCOL)) != b"\x01":
            raise ValueError(f"the controller does not speak RTDE {PROTOCOL}")
        self.version: tuple[int, ...] = _unpack(struct.Struct(">4I"), self._request(CONTROLLER))  # of PolyScope
        self._has_sensor = self.version[0] >= FORCE_SERIES
        self.rate_hz = 500 if self._has_sensor else 125  # one state per control cycle
        answer = self._request(OUTPUTS, struct.pack(">d", self.rate_hz) + ",".join(VARIABLES).encode())
        types = answer[1:].decode().split(",")
        if missing := [name for name, kind in zip(VARIABLES, types, strict=False) if kind == "NOT_FOUND"]:
            raise ValueError(f"the controller has no {', '.join(missing)}")
        if types != list(VARIABLES.values()):
            raise ValueError(f"the controller would send {','.join(types)[:200]!r} for {','.join(VARIABLES)}")
        self._request(START)

    def read(self, timeout_s: float) -> RtdeState:
        """Return the next state; TimeoutError after `timeout_s` without a byte, ValueError for a damaged state."""
        self._link.settimeout(timeout_s)
        values = _unpack(_LAYOUT, self._read_frame(DATA)[1:])
        arrival_s = time.monotonic()
        if not all(map(math.isfinite, values)):
            raise ValueError("the controller sent a state that holds NaN or infinity")
        stamp, pose, speed, force = values[0], values[1:7], values[7:10], values[13:16]
        mode, runtime, safety, progress = values[19:]
        emergency_stop = bool(safety & EMERGENCY_BITS)
        return RtdeState(
            self._clock.host_time(stamp, arrival_s),
            (*(1e3 * value for value in pose[:3]), *pose[3:]),
            1e3 * math.hypot(*speed),
            force[2] if self._has_sensor else None,
            math.hypot(*force[:2]) if self._has_sensor else 0.0,
            bool(safety & PROTECTIVE_BITS) and not emergency_stop,
            emergency_stop,
            mode,
            runtime,
            progress,
        )

    def _request(self, kind: int, payload: bytes = b"") -> bytes:
        self._link.sendall(pack_frame(kind, payload))
        return self._read_frame(kind)

    def _read_frame(self, kind: int) -> bytes:
        """Return the payload of the next frame of a kind; other frames are skipped."""
        while True:
            size, received = _HEADER.unpack(self._read_bytes(_HEADER.size))
            if size < _HEADER.size:
                raise ValueError(f"a frame of {size} bytes; expected at least {_HEADER.size}")
            payload = self._read_bytes(size - _HEADER.size)
            if received == kind:
                return payload

    def _read_bytes(self, count: int) -> bytes:
        if len(data := self._stream.read(count)) < count:
            raise ConnectionError("the controller closed the link")
        return data


def _unpack(layout: struct.Struct, payload: bytes) -> tuple[Any, ...]:
    if len(payload) != layout.size:
        raise ValueError(f"the controller sent {len(payload)} bytes, expected {layout.size}")
    return layout.unpack(payload)
