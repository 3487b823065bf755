"""A Universal Robots arm, driven by ur-rtde in a child process, since ur-rtde can hang and crash."""

import importlib.util
import itertools
import json
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig import clock
from padforge.sense.rig.arms.rtde import stop_program
from padforge.sense.rig.devices import ArmState, Array, Cause, Pose, RigFault
from padforge.sense.rig.safety import MAX_STATE_AGE_S, check_finite_move
from padforge.sense.settings import RigSettings

SUPERVISION_S = 2.0  # heartbeats end this long after the program last asked for a state
CONNECT_S = 4.5  # longest wait for the link
MOVE_S = 1.0  # longest wait for the arm to accept a move


class RtdeWorker:
    """The parent's side of the driver's worker process: requests have a deadline, and the process can be killed."""

    def __init__(self, host: str) -> None:
        self._host = host
        self.fault: RigFault | None = None  # why the worker has ended; None while it runs
        self.latest: ArmState | None = None
        self.stopped = False  # whether the arm's dashboard confirmed a stop after the worker's end
        self._replies: dict[int, dict[str, Any]] = {}
        self._ids = itertools.count(1)
        self._states: deque[ArmState] = deque(maxlen=300_000)  # for `drain`: 10 minutes at 500 Hz
        self._received = threading.Condition()
        self._supervised_s = clock.now()
        self._killed = threading.Event()
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "padforge.sense.rig.arms.rtde_worker", host],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C does not reach it
        )
        assert self.process.stdin is not None
        os.set_blocking(self.process.stdin.fileno(), False)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._receive, self._send_heartbeats)]
        for thread in self._threads:
            thread.start()

    def request(self, command: str, *arguments: Any, timeout_s: float) -> Any:
        """Send a command and return its result; RigFault if it fails, takes too long, or the worker ends."""
        number = next(self._ids)
        self._write(json.dumps({"id": number, "command": command, "arguments": arguments}).encode())
        with self._received:
            self._received.wait_for(lambda: number in self._replies or self.fault, timeout_s)
            reply = self._replies.pop(number, None)
        if reply is None:
            raise self.fault or RigFault("deadline", f"the arm did not {command} within {timeout_s} s", "connect again")
        if "fault" in reply:
            raise RigFault(*reply["fault"])
        return reply["result"]

    def renew_watch(self) -> None:
        """Continue the heartbeats for `SUPERVISION_S`; to be called whenever the program asks for states."""
        self._supervised_s = clock.now()

    def drain(self) -> list[ArmState]:
        """Return the states since the last call."""
        with self._received:
            states = list(self._states)
            self._states.clear()
        return states

    def kill(self) -> None:
        """Kill the worker and wait for its end; never raises."""
        self._killed.set()
        self.process.kill()
        self.process.wait()
        for thread in self._threads:
            thread.join()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()

    def stop_program(self) -> bool:
        """Stop the arm through its dashboard once the worker has ended; return whether the stop is confirmed."""
        self.stopped = self.stopped or stop_program(self._host, timeout_s=0.2)
        return self.stopped

    def _write(self, line: bytes) -> None:
        assert self.process.stdin is not None
        try:
            os.write(self.process.stdin.fileno(), line + b"\n")
        except (OSError, ValueError):
            raise self.fault or RigFault("lost", f"the link to the arm {self._host} is down", "connect again") from None

    def _send_heartbeats(self) -> None:
        while not self._killed.wait(0.05) and not self.fault:
            if clock.now() < self._supervised_s + SUPERVISION_S:
                with suppress(RigFault):
                    self._write(b"")

    def _receive(self) -> None:
        assert self.process.stdout is not None
        reason: tuple[Cause, str, str] = ("lost", "the process that drives the arm has ended", "connect again")
        for line in self.process.stdout:
            try:
                message = json.loads(line)
            except ValueError:  # the worker ended in the middle of a line
                break
            with self._received:
                if "state" in message:
                    pose: Pose = tuple(message["state"].pop("pose"))
                    self.latest = ArmState(pose=pose, **message["state"])
                    self._states.append(self.latest)
                elif "exit" in message:
                    reason = message["exit"]
                else:
                    self._replies[message["id"]] = message
                    self._received.notify_all()
        with self._received:
            self.fault = RigFault(*reason)
            self._received.notify_all()
        if self.latest is not None and not self._killed.is_set():
            self.stop_program()


class UR5:
    """The arm at a network address; implements `Arm`. It needs ur-rtde and POSIX.

    During a move `state` or `drain` must be called at least every 2 s, or the arm is stopped; it also stops within
    0.5 s if this process ends or is suspended. A protective or emergency stop ends the move for good: a person has to
    unlock the arm, then `connect` opens a new link. The driver never unlocks, powers or starts an arm.
    """

    def __init__(self, host: str) -> None:
        """Describe the arm at an address."""
        self._host = host
        self._worker: RtdeWorker | None = None
        self._move_s = 0.0

    @classmethod
    def from_settings(cls, rig: RigSettings) -> "UR5":
        """Return the arm that `[rig]` names."""
        return cls(rig.host)

    def connect(self) -> Mapping[str, Any]:
        """Open the link; an earlier link of this object is closed first.

        Raises:
            RigFault: "refused" if ur-rtde is not installed, no arm answers, the arm is not powered or not in remote
                control, another program uses it, on this computer or elsewhere, or it lacks what ur-rtde needs;
                "protective_stop" or "emergency_stop" if it is stopped; "deadline" after 4.5 s.
        """
        if importlib.util.find_spec("rtde_control") is None:
            advice = "it has wheels for Linux on x86-64 and Windows, Python 3.11 and 3.12: pip install 'padforge[rig]'"
            raise RigFault("refused", "ur-rtde, which moves the arm, is not installed", advice)
        self._end_worker()
        self._worker = RtdeWorker(self._host)
        try:
            return self._worker.request("connect", timeout_s=CONNECT_S)
        except BaseException:
            self._end_worker()
            raise

    def state(self) -> ArmState:
        """Return the latest state; also RigFault("deadline") if nobody asked for one for 2 s during a move."""
        worker = self._connected()
        worker.renew_watch()
        state = worker.latest
        age_s = np.inf if state is None else clock.now() - state.time_s
        if state is None or age_s > MAX_STATE_AGE_S:
            raise RigFault("stale", f"the last state of the arm is {age_s:.2f} s old; allowed {MAX_STATE_AGE_S} s")
        return replace(state, moving=state.moving or state.time_s < self._move_s)

    def drain(self) -> Array:
        """Return the (n, 10) states since the last call; a fault is raised once those before it are returned."""
        states = self._worker.drain() if self._worker else []
        if not states:
            self._connected()
            return np.empty((0, len(STATE_COLUMNS)))
        if self._worker:
            self._worker.renew_watch()
        return np.array([state.to_row() for state in states])

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Start a straight move from rest; RigFault("refused") if it is not finite or the arm does not accept it."""
        check_finite_move(pose, speed_mm_s, acceleration_mm_s2)
        worker = self._connected()
        worker.renew_watch()
        try:
            worker.request("move", [float(value) for value in pose], speed_mm_s, acceleration_mm_s2, timeout_s=MOVE_S)
        except RigFault as fault:
            if fault.cause != "refused":
                self._abandon()
            raise
        self._move_s = clock.now()

    def stop(self) -> None:
        """Stop the arm by its driver, otherwise by its dashboard; RigFault("lost") if neither confirms the stop."""
        if self._worker is None or self._worker.stopped:
            return
        try:
            self._worker.request("stop", timeout_s=0.25)
        except RigFault:
            if not self._abandon():
                reason = f"the arm {self._host} did not confirm the stop"
                raise RigFault("lost", reason, "its watchdog stops it within 0.3 s, but look at it") from None

    def close(self) -> None:
        """Stop the arm and close the link; never raises."""
        if self._worker is not None:
            with suppress(RigFault):
                self._worker.request("close", timeout_s=MOVE_S)
            self._end_worker()

    def _connected(self) -> RtdeWorker:
        if self._worker is None:
            raise RigFault("lost", f"there is no link to the arm {self._host}", "connect first")
        if fault := self._worker.fault:
            raise fault
        return self._worker

    def _abandon(self) -> bool:
        """Kill the worker, which ends the watchdog's kicks; return whether the dashboard confirms the stop."""
        if self._worker is None:
            return False
        self._worker.kill()
        return self._worker.stop_program()

    def _end_worker(self) -> None:
        if self._worker is not None:
            self._worker.kill()
            self._worker = None
