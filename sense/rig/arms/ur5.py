"""The parent's end of the link to the child that holds ur-rtde: waits have a deadline, and the child can be killed.

A Universal Robots arm over ur-rtde, which runs in a child process that can be killed: it can hang and crash.
"""

import importlib.util
import itertools
import json
import os
import subprocess
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from padforge.sense.recording.run_directory import STATE_COLUMNS
from padforge.sense.rig.arms import rtde as wire
from padforge.sense.rig.arms.rtde import stop_program
from padforge.sense.rig.devices import ArmState, Array, Cause, RigFault, start
from padforge.sense.rig.safety import check_finite_move
from padforge.sense.settings import RigSettings

KEPT = 300_000
"""States that are kept for `take`: 10 minutes at 500 Hz."""
BEAT_S = 0.05
LOOK_S = 2.0
"""How long the heart beats on after the program last looked at the arm."""
STOP_S = 0.2
"""Longest wait for the dashboard to confirm a stop."""


class ArmLink:
    """A running child.

    Attributes:
        latest: its last state. skipped: states the arm left out.
        stopped: whether the arm's dashboard confirmed a stop after the child's end.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self._ended: tuple[Cause, str, str] | None = None
        self.latest: wire.StateRow | None = None
        self.skipped = 0
        self.stopped = False
        self._answers: dict[int, dict[str, Any]] = {}
        self._numbers = itertools.count(1)
        self._rows: deque[wire.StateRow] = deque(maxlen=KEPT)
        self._news = threading.Condition()
        self._looked = time.monotonic()
        self._ending = threading.Event()
        self._process = start("padforge.sense.rig.arms.rtde_worker", host, stderr=subprocess.DEVNULL)
        assert self._process.stdin is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._read, self._beat)]
        for thread in self._threads:
            thread.start()

    @property
    def fault(self) -> RigFault | None:
        """Why the child has ended; None while it runs."""
        return RigFault(*self._ended) if self._ended else None

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    def ask(self, what: str, *arguments: Any, timeout_s: float) -> Any:
        """Give the child an order and wait for its answer; RigFault where it fails, ends, or is late."""
        number = next(self._numbers)
        self._write(json.dumps({"id": number, "do": what, "with": arguments}).encode())
        with self._news:
            self._news.wait_for(lambda: number in self._answers or self._ended, timeout_s)
            answer = self._answers.pop(number, None)
        if answer is None:
            raise self.fault or RigFault("deadline", f"the arm did not {what} within {timeout_s} s", "connect again")
        if "fault" in answer:
            raise RigFault(*answer["fault"])
        return answer["is"]

    def look(self) -> None:
        """Note that the program looks at the arm, so that a move may go on."""
        self._looked = time.monotonic()

    def take(self) -> list[wire.StateRow]:
        """States since the last call."""
        with self._news:
            rows = list(self._rows)
            self._rows.clear()
        return rows

    def end(self) -> None:
        """Kill the child and wait for its end; never raises."""
        self._ending.set()
        self._process.kill()
        self._process.wait()
        for thread in self._threads:
            thread.join()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _write(self, line: bytes) -> None:
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), line + b"\n")
        except (OSError, ValueError):
            raise self.fault or RigFault("lost", f"the link to the arm {self._host} is down", "connect again") from None

    def _beat(self) -> None:
        while not self._ending.wait(BEAT_S) and not self._ended:
            if time.monotonic() < self._looked + LOOK_S:
                with suppress(RigFault):
                    self._write(b"")

    def _read(self) -> None:
        assert self._process.stdout is not None
        ended: tuple[Cause, str, str] = ("lost", "the process that holds ur-rtde has ended", "connect again")
        for news in wire.read(self._process.stdout.read):
            with self._news:
                if isinstance(news, wire.StateRow):
                    self.latest = news
                    self.skipped += int(news.skipped)
                    self._rows.append(news)
                elif "ended" in news:
                    ended = news["ended"]
                else:
                    self._answers[news["id"]] = news
                    self._news.notify_all()
        with self._news:
            self._ended = ended
            self._news.notify_all()
        if self.latest is not None and not self._ending.is_set():
            self.stopped = stop_program(self._host, STOP_S)


CONNECT_S = 4.5
MOVE_S = 1.0
STALE_S = 0.5
CONFIRM_S = 0.25
"""Longest wait for the child to confirm a stop; the dashboard is asked after that."""
DASHBOARD_S = 0.2


class UR5:
    """The arm at a network address. Linux and macOS.

    During a move `state` or `drain` must be called at least every 2 s, or the arm is stopped; it also stops within
    0.5 s where this process ends or is suspended. A protective or emergency stop ends the move for good: a person has
    to unlock the arm, and `connect` starts anew. Nothing here unlocks, powers or starts an arm.
    """

    def __init__(self, host: str) -> None:
        self._host = host
        self._link: ArmLink | None = None
        self._moved_s = 0.0

    @classmethod
    def of(cls, rig: RigSettings) -> "UR5":
        """The arm that `[rig]` names."""
        return cls(rig.host)

    def connect(self) -> Mapping[str, Any]:
        """Open the link, ending an earlier one of this object.

        Returns:
            host, model, polyscope, serial, controller and ur_rtde versions, rate_hz, and the tool's tcp in mm and rad.

        Raises:
            RigFault: "refused" where there is no arm, it is not in remote control or not powered, another program uses
                it, on this computer or elsewhere, or ur-rtde is missing; "protective_stop", "emergency_stop";
                "deadline" after 4.5 s.
        """
        if importlib.util.find_spec("rtde_control") is None:
            raise RigFault("refused", "the arm needs ur-rtde", "pip install 'padforge[rig]'")
        self._end()
        self._link = ArmLink(self._host)
        try:
            return self._link.ask("connect", timeout_s=CONNECT_S)
        except BaseException:
            self._end()
            raise

    @property
    def child(self) -> int | None:
        """Process id of the child, None before `connect`."""
        return self._link.pid if self._link else None

    @property
    def skipped(self) -> int:
        """How many states the controller left out since `connect`."""
        return self._link.skipped if self._link else 0

    def state(self) -> ArmState:
        """The latest state; see `Arm.state`.

        Raises:
            RigFault: "stale", "lost"; "deadline" where nobody looked for 2 s during a move.
        """
        link = self._running()
        link.look()
        row = link.latest
        age_s = np.inf if row is None else time.monotonic() - row.time_s
        if row is None or age_s > STALE_S:
            raise RigFault("stale", f"the last state of the arm is {age_s:.2f} s old; allowed {STALE_S} s")
        return ArmState(
            time_s=row.time_s,
            pose=(row.x_mm, row.y_mm, row.z_mm, row.rx, row.ry, row.rz),
            speed_mm_s=row.speed_mm_s,
            force_n=None if np.isnan(row.force_n) else row.force_n,
            protective_stop=bool(row.protective_stop),
            emergency_stop=bool(row.emergency_stop),
            moving=bool(row.moving) or row.time_s < self._moved_s,
            sideways_n=row.sideways_n,
        )

    def drain(self) -> Array:
        """(n, 10) states since the last call; those that came before the link was lost come before the fault.

        The last 300 000 states are kept: 10 minutes at 500 Hz.
        """
        rows = self._link.take() if self._link else []
        if not rows:
            self._running()
            return np.empty((0, len(STATE_COLUMNS)))
        if self._link:
            self._link.look()
        values = np.array(rows, dtype=np.float64)
        return np.column_stack([values[:, :9], (~values[:, 9:11].any(axis=1)).astype(np.float64)])

    def move(self, pose: Sequence[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        """Begin a straight move from rest.

        Args:
            pose: x, y, z in mm and a rotation vector in rad. speed_mm_s, acceleration_mm_s2: of the tool.

        Raises:
            RigFault: "refused" for what is no pose or speed, or where the arm does not take it; "lost", "deadline".
        """
        check_finite_move(pose, speed_mm_s, acceleration_mm_s2)
        link = self._running()
        link.look()
        try:
            link.ask("move", [float(value) for value in pose], speed_mm_s, acceleration_mm_s2, timeout_s=MOVE_S)
        except RigFault as fault:
            if fault.cause != "refused":
                self._abandon()
            raise
        self._moved_s = time.monotonic()

    def stop(self) -> None:
        """Stop the arm, by ur-rtde or, where that does not answer, by its dashboard and its watchdog.

        Raises:
            RigFault: "lost" where the arm did not confirm it; the watchdog stops it 0.25 s after the last sign of life.
        """
        if self._link is None or self._link.stopped:
            return
        try:
            self._link.ask("stop", timeout_s=CONFIRM_S)
        except RigFault:
            if not self._abandon():
                reason = f"the arm {self._host} did not confirm the stop"
                raise RigFault("lost", reason, "its watchdog stops it within 0.3 s, but look at it") from None

    def close(self) -> None:
        """Stop the arm and close the link; never raises."""
        if self._link is not None:
            with suppress(RigFault):
                self._link.ask("close", timeout_s=MOVE_S)
            self._end()

    def _running(self) -> ArmLink:
        if self._link is None:
            raise RigFault("lost", f"there is no link to the arm {self._host}", "connect first")
        if fault := self._link.fault:
            raise fault
        return self._link

    def _abandon(self) -> bool:
        """Kill the child, so that the watchdog is kicked no more; whether the dashboard confirms that the arm stops."""
        if self._link is not None:
            self._link.end()
            if self._link.stopped:
                return True
        return stop_program(self._host, DASHBOARD_S)

    def _end(self) -> None:
        if self._link is not None:
            self._link.end()
            self._link = None
