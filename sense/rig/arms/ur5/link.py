"""The parent's end of the link to the child that holds ur-rtde: waits have a deadline, and the child can be killed."""

import itertools
import json
import os
import subprocess
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

from padforge.sense.rig.devices.processes import start
from padforge.sense.rig.devices.protocols import Cause, RigFault

from padforge.sense.rig.arms.ur5 import messages as wire
from padforge.sense.rig.arms.ur5.rtde_frames import stop_program

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
        self.latest: wire.Row | None = None
        self.skipped = 0
        self.stopped = False
        self._answers: dict[int, dict[str, Any]] = {}
        self._numbers = itertools.count(1)
        self._rows: deque[wire.Row] = deque(maxlen=KEPT)
        self._news = threading.Condition()
        self._looked = time.monotonic()
        self._ending = threading.Event()
        self._process = start("padforge.sense.rig.arms.ur5.child_process", host, stderr=subprocess.DEVNULL)
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

    def take(self) -> list[wire.Row]:
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
                if isinstance(news, wire.Row):
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
