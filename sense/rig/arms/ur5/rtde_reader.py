"""Reads every state of a UR controller's RTDE stream and tells when each was taken on the host's clock."""

import math
import socket
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from padforge.sense.rig.arms.ur5 import rtde_frames as frames

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
        self._link = socket.create_connection((host, frames.RTDE_PORT), timeout_s)
        self._link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._splitter = frames.Splitter()
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._clock = HostClock()
        self._stamp: float | None = None
        if self._ask(frames.VERSION, struct.pack(">H", frames.PROTOCOL)) != b"\x01":
            raise ValueError(f"the controller does not speak RTDE {frames.PROTOCOL}")
        self.version: tuple[int, ...] = _unpacked(struct.Struct(">4I"), self._ask(frames.CONTROLLER))
        self.rate_hz = 500 if self.version[0] >= FORCE_SERIES else 125
        names = ",".join(VARIABLES).encode()
        types = self._ask(frames.OUTPUTS, struct.pack(">d", self.rate_hz) + names)[1:].decode().split(",")
        if "NOT_FOUND" in types:
            raise ValueError(f"the controller has no {VARIABLES[types.index('NOT_FOUND') % len(VARIABLES)]}")
        if types != [frames.type_of(name) for name in VARIABLES]:
            raise ValueError(f"the controller would send {','.join(types)[:200]!r} for {','.join(VARIABLES)}")
        self._layout = frames.layout(types)
        self._ask(frames.START)

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
        self._link.sendall(frames.frame(kind, payload))
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
            if kind == frames.DATA:
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
