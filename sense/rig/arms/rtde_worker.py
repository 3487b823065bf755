"""The child process that holds ur-rtde, which can hang or crash: orders on stdin, states and answers on stdout.

Run as `python -m padforge.sense.rig.arms.rtde_worker HOST`. Orders are JSON lines, an empty one a heartbeat. The
arm's
watchdog is kicked from here alone, so the arm stops by itself where this process ends or hangs. It also stops where
the parent ends, or gives no sign of life during a move. Nothing here unlocks, powers or starts an arm."""

import contextlib
import fcntl
import json
import os
import queue
import select
import socket
import sys
import tempfile
import threading
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from padforge.sense.rig.arms import rtde as frames
from padforge.sense.rig.arms.rtde import Reading, RtdeReader, StateRow, pack_answer, pack_row

WATCHDOG_HZ = 4.0
KICK_S = 0.04
"""A sixth of the time after which the watchdog stops the arm."""
HEARTBEAT_S = 0.3
"""Silence of the parent during a move after which the arm is stopped; it beats six times as often."""
STREAM_S = 0.25
"""Silence of the arm after which it counts as out of reach."""
STOP_M_S2 = 5.0
NEWS_S = 0.05
"""Longest wait for the first state after a stop, so that nobody takes an older one for it."""
HALT_S = 0.15
"""Longest wait for the arm's and then for the parent's ear when this process has to end."""
ANSWER_S = 1.0
"""Longest wait for an answer of the arm while connecting."""
PATIENCE_S = 1.0
"""Longest wait for a session that is at its end: its watchdog ends its program a quarter of a second later."""
OPERATION, UNDER_WAY = 0x7F << 24, 1 << 15
LOOK = "look at the arm, unlock it at the pendant, then connect again"


class CommandRejected(Exception):  # noqa: N818  what the parent raises is a RigFault
    """Cause, message and advice of a fault that the parent raises."""


def _require_ready(reading: Reading) -> None:
    if reading.safety & frames.EMERGENCY_BITS:
        raise CommandRejected("emergency_stop", "the arm is in an emergency stop", LOOK)
    if reading.safety & frames.PROTECTIVE_BITS:
        raise CommandRejected("protective_stop", "the arm is in a protective stop", LOOK)
    if reading.mode != frames.RUNNING:
        raise CommandRejected(
            "refused", f"the arm is not ready: robot mode {reading.mode}, expected {frames.RUNNING}", LOOK
        )


def _require_idle(reader: RtdeReader, reading: Reading) -> Reading:
    """The first state with no program on the arm; its program is another's, who may be in mid-press."""
    until = time.monotonic() + PATIENCE_S
    while reading.runtime > frames.STOPPED:
        if time.monotonic() > until:
            advice = "end the other recording, or stop the program at the pendant"
            raise CommandRejected("refused", "a program runs on the arm, or is paused there", advice)
        reading = reader.read(ANSWER_S)
    return reading


def _claim(host: str) -> int:
    """Keep other programs on this computer off an arm until the descriptor is closed or this process has ended."""
    address = socket.getaddrinfo(host, None)[0][4][0]
    path = Path(tempfile.gettempdir(), f"padforge-arm-{address}.lock")
    try:
        claim = os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDONLY, 0o644)
    except FileExistsError:  # it may be another user's, who cannot keep one from reading it
        claim = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > until:
                what = f"another program on this computer uses the arm {host}"
                raise CommandRejected("refused", what, "wait for its end, or end it") from None
            time.sleep(KICK_S)
        else:
            return claim


class Child:
    """The arm as ur-rtde and an RTDE reader know it."""

    def __init__(self, host: str, out: int) -> None:
        self._host, self._out = host, out
        self._writing = threading.Lock()
        self._orders: queue.Queue[dict[str, Any]] = queue.Queue()
        self._control: Any = None
        self._claim: int | None = None
        self._latest: Reading | None = None
        self._before: int | None = None
        """Number of the operation before the move that is under way."""
        self._news = threading.Event()
        self._running = threading.Event()
        self._halting = False
        self._halted = threading.Event()
        self._stopped_by_arm = False

    def run(self) -> None:
        """Take orders until the parent ends."""
        threading.Thread(target=self._obey, daemon=True).start()
        parent, text = os.getppid(), b""
        while True:
            ready, _, _ = select.select([0], [], [], HEARTBEAT_S)
            if not ready and self._before is not None:
                self._halt("deadline", "the program did not look at the arm during a move, so it was stopped")
            data = os.read(0, 65536) if ready else b""
            if (ready and not data) or os.getppid() != parent:
                self._halt("lost", "the program ended")
            *lines, text = (text + data).split(b"\n")
            for line in filter(None, lines):
                self._orders.put(json.loads(line))

    def _obey(self) -> None:
        """Everything that calls ur-rtde: it is not made for several threads."""
        while True:
            try:
                order = self._orders.get(timeout=KICK_S)
            except queue.Empty:
                order = {"id": 0, "do": "kick", "with": ()}
            try:
                answer = getattr(self, f"_do_{order['do']}")(*order["with"])
                if order["id"]:
                    self._say({"id": order["id"], "is": answer})
            except CommandRejected as fault:
                self._say({"id": order["id"], "fault": fault.args})
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                if self._control is not None:
                    self._end("lost", f"ur-rtde lost the arm: {reason}", "connect again")
                self._say({"id": order["id"], "fault": ("refused", f"the arm refused: {reason}", "")})

    def _do_kick(self) -> None:
        if self._playing() and not self._halting and not self._stopped_by_arm:
            self._control.kickWatchdog()

    def _do_connect(self) -> dict[str, Any]:
        import rtde_control

        try:
            self._claim = _claim(self._host)
            reader = RtdeReader(self._host, ANSWER_S)
            first = reader.read(ANSWER_S)
            _require_ready(first)
            first = _require_idle(reader, first)
            about = self._ask_about()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            what = f"no arm answers at {self._host}, ports {frames.RTDE_PORT} and {frames.DASHBOARD_PORT}: {reason}"
            raise CommandRejected("refused", what, "check its address, its cable and that it is switched on") from None
        threading.Thread(target=self._watch, args=(reader, first), daemon=True).start()
        control = rtde_control.RTDEControlInterface(self._host)
        if not control.setWatchdog(WATCHDOG_HZ):
            raise CommandRejected("refused", "the arm does not take a watchdog", "")
        tcp = control.getTCPOffset()
        self._control = control
        if not self._running.wait(ANSWER_S):
            raise CommandRejected("refused", "the arm's program does not run", LOOK)
        return about | {
            "host": self._host,
            "rate_hz": reader.rate_hz,
            "controller": ".".join(map(str, reader.version)),
            "ur_rtde": version("ur-rtde"),
            "tcp": [*(round(1e3 * value, 3) for value in tcp[:3]), *(round(value, 6) for value in tcp[3:])],
        }

    def _ask_about(self) -> dict[str, str]:
        """What the dashboard tells of the arm; faults where a person has the control."""
        polyscope, model = frames.ask_dashboard(self._host, ["PolyscopeVersion", "get robot model"], ANSWER_S)
        remote, serial = frames.ask_dashboard(self._host, ["is in remote control", "get serial number"], ANSWER_S)
        if remote == "false":
            raise CommandRejected("refused", "the arm is not in remote control", "switch it over at the pendant")
        names = {"polyscope": polyscope.removeprefix("URSoftware "), "model": model, "serial": serial}
        return {name: text for name, text in names.items() if not text.startswith("could not")}

    def _do_move(self, pose_mm: list[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        if not self._playing():
            raise CommandRejected("refused", "the arm's program does not run, so it takes no moves", LOOK)
        if self._before is not None or self._latest is None:
            raise CommandRejected("refused", "a move is under way", "wait for its end or stop it")
        self._before = self._latest.progress & OPERATION
        pose = [*(value / 1e3 for value in pose_mm[:3]), *pose_mm[3:]]
        if not self._control.moveL(pose, speed_mm_s / 1e3, acceleration_mm_s2 / 1e3, True):
            self._before = None
            raise CommandRejected("refused", "the arm refused the move", LOOK)

    def _do_stop(self) -> None:
        if self._playing():
            self._control.stopL(STOP_M_S2)
            self._news.clear()
            self._news.wait(NEWS_S)
        elif self._control is not None and not frames.stop_program(self._host, ANSWER_S):
            raise CommandRejected("lost", "the arm did not confirm the stop", "look at the arm")
        self._before = None
        self._halted.set()

    def _do_close(self) -> None:
        self._halting = True
        if self._playing():
            self._control.stopL(STOP_M_S2)
            self._control.stopScript()

    def _playing(self) -> bool:
        return self._control is not None and self._latest is not None and self._latest.runtime == frames.PLAYING

    def _watch(self, reader: RtdeReader, first: Reading) -> None:
        """Pass every state on; end the process where they stop coming or the program has ended.

        It ends at once, before ur-rtde can reconnect and repeat an old order.
        """
        reading = first
        while True:
            self._latest = reading
            self._note(reading)
            self._news.set()
            self._write(pack_row(self._row(reading)))
            try:
                reading = reader.read(STREAM_S)
            except TimeoutError:
                self._end("stale", f"the arm has sent no state for {STREAM_S} s", "check the network, connect again")
            except (OSError, ValueError):
                self._end("lost", "the arm closed the link", "check that it is switched on, connect again")

    def _note(self, reading: Reading) -> None:
        stopped = bool(reading.safety & (frames.PROTECTIVE_BITS | frames.EMERGENCY_BITS))
        if stopped and not self._stopped_by_arm:
            # A paused program would go on with the old move as soon as a person unlocks the arm and presses play.
            threading.Thread(target=frames.stop_program, args=(self._host, ANSWER_S), daemon=True).start()
        elif self._stopped_by_arm and not stopped:
            self._end("lost", "the arm was stopped and unlocked, which ends its program", "connect again")
        elif self._control is not None and reading.runtime == frames.PLAYING:
            self._running.set()
        elif self._running.is_set() and not stopped and not self._halting:
            self._end("lost", "the arm's program has ended", "look at the arm, then connect again")
        self._stopped_by_arm = stopped
        operation = reading.progress & OPERATION
        ended = self._before not in (None, operation) and not reading.progress & UNDER_WAY
        if ended or stopped:
            self._before = None

    def _row(self, reading: Reading) -> StateRow:
        emergency = bool(reading.safety & frames.EMERGENCY_BITS)
        x, y, z, *turn = reading.pose
        return StateRow(
            *(reading.time_s, 1e3 * x, 1e3 * y, 1e3 * z, *turn),
            speed_mm_s=1e3 * reading.speed,
            force_n=float("nan") if reading.force_n is None else reading.force_n,
            protective_stop=bool(reading.safety & frames.PROTECTIVE_BITS) and not emergency,
            emergency_stop=emergency,
            moving=self._before is not None,
            skipped=reading.skipped,
            sideways_n=reading.sideways_n,
        )

    def _halt(self, cause: str, message: str) -> None:
        """Stop the arm and end; the watchdog stops it where ur-rtde does not."""
        self._halting = True
        self._orders.put({"id": 0, "do": "stop", "with": ()})
        self._halted.wait(HALT_S)
        self._end(cause, message, "connect again")

    def _say(self, answer: dict[str, Any]) -> None:
        self._write(pack_answer(answer))

    def _write(self, data: bytes) -> None:
        with self._writing:
            while data:
                data = data[os.write(self._out, data) :]

    def _end(self, cause: str, message: str, advice: str) -> NoReturn:
        """Tell the parent why, if it listens, and end without ur-rtde's own clean-up, which waits and can crash."""
        telling = threading.Thread(target=self._say, args=({"ended": (cause, message, advice)},), daemon=True)
        telling.start()
        telling.join(HALT_S)
        os._exit(0)


def main() -> None:
    """Keep stdout for the parent alone: what ur-rtde prints goes to stderr."""
    out = os.dup(1)
    os.dup2(2, 1)
    with contextlib.suppress(KeyboardInterrupt):
        Child(sys.argv[1], out).run()


if __name__ == "__main__":
    main()
