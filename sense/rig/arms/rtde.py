"""States of a Universal Robots arm, read by ur-rtde, and the dashboard of its controller."""

import math
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

RTDE_PORT = 30004
DASHBOARD_PORT = 29999
RUNNING = 7  # robot mode: the arm is powered on and its brakes are released
STOPPED, PLAYING = 1, 2  # runtime states of the program; others are paused, pausing and so on
PROTECTIVE_BITS = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 8 | 1 << 9 | 1 << 10
"""Protective and safeguard stop, recovery, violation, fault: the controller does not move the arm."""
EMERGENCY_BITS = 1 << 5 | 1 << 6 | 1 << 7
VARIABLES = (
    *("timestamp", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force"),
    *("robot_mode", "runtime_state", "safety_status_bits"),
)
MAX_CLOCK_SKEW = 2e-4  # relative rate difference between the controller's clock and the host's
POLL_S = 5e-4  # interval of polls for a new state; a state lasts 2 or 8 ms


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


def major_version(polyscope: str) -> int:
    """Return the first number of a version of PolyScope, such as "5.12.2 (Jan 01 2024)"; ValueError if it has none."""
    major = polyscope.partition(".")[0]
    if not major.isdecimal():
        raise ValueError(f"the dashboard says PolyScope {polyscope!r}, expected a version such as 5.12")
    return int(major)


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
    """A link to the RTDE port through which ur-rtde receives the states of the arm.

    ur-rtde stores the latest state only, so it is polled several times a control cycle. It notices a closed link at
    once, but a silent arm only after 2.5 s, which `read` notices earlier by the time stamps.
    """

    def __init__(self, host: str, major: int) -> None:
        """Connect to a controller of a major version of PolyScope; RuntimeError if none is there."""
        import rtde_receive

        self._has_sensor = major >= 5  # arms of this and later versions have a force sensor at the tool
        self.rate_hz = 500 if self._has_sensor else 125  # one state per control cycle
        self._receive: Any = rtde_receive.RTDEReceiveInterface(host, float(self.rate_hz), list(VARIABLES))
        self._clock = HostClock()
        self._stamp = 0.0  # of the latest state, s since the controller was switched on

    def read(self, timeout_s: float) -> RtdeState:
        """Return the next state; TimeoutError if there is none for `timeout_s`, ValueError if it is not finite."""
        deadline = time.monotonic() + timeout_s
        while self._receive.isConnected():
            state = self._latest()
            if state is not None:
                return state
            if time.monotonic() > deadline:
                raise TimeoutError(f"no new state for {timeout_s:g} s")
            time.sleep(POLL_S)
        raise ConnectionError("the controller closed the link")

    def _latest(self) -> RtdeState | None:
        """Return the latest state; None if it was read before, or another arrived while it was read."""
        receive = self._receive
        if (stamp := receive.getTimestamp()) == self._stamp:
            return None
        arrival_s = time.monotonic()
        pose, speed, force = receive.getActualTCPPose(), receive.getActualTCPSpeed()[:3], receive.getActualTCPForce()
        mode, runtime, safety = receive.getRobotMode(), receive.getRuntimeState(), receive.getSafetyStatusBits()
        if receive.getTimestamp() != stamp:  # ur-rtde replaces a state as a whole
            return None
        self._stamp = stamp
        if not all(map(math.isfinite, (stamp, *pose, *speed, *force[:3]))):
            raise ValueError("the controller sent a state that holds NaN or infinity")
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
        )
