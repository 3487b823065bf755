"""The worker process that controls a UR arm: commands on stdin, states and replies on stdout, as JSON lines.

It is run as `python -m padforge.sense.rig.arms.rtde_worker HOST`, since ur-rtde can hang and crash. An empty line on
stdin is a heartbeat of the parent. Only this process kicks the arm's watchdog, so the arm stops if this process ends or
hangs. The arm is also stopped if the parent ends, or sends nothing for `HEARTBEAT_TIMEOUT_S` during a move. This
process never unlocks, powers or starts an arm.
"""

import contextlib
import errno
import json
import os
import queue
import select
import socket
import sys
import threading
import time
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any, NoReturn

from padforge.sense.rig.arms import rtde
from padforge.sense.rig.arms.rtde import RtdeReader, RtdeState, major_version

KICK_S = 0.04  # a sixth of the time after which the watchdog stops the arm
HEARTBEAT_TIMEOUT_S = 0.3  # maximum silence of the parent during a move; six times the period of its heartbeats
STREAM_TIMEOUT_S = 0.25  # maximum silence of the arm
FIRST_STATE_S = 0.05  # longest wait for a state after a stop, so that the parent does not act on an older one
HALT_S = 0.15  # longest wait for the arm, and then for the parent, before this process ends
ANSWER_S = 1.0  # longest wait for an answer of the arm while connecting
SESSION_END_S = 1.0  # longest wait for the end of another session, whose watchdog takes 0.25 s
STOP_M_S2 = 5.0  # deceleration of a stop
ARM_STATE = ("time_s", "pose", "speed_mm_s", "force_n", "sideways_n", "protective_stop", "emergency_stop")
"""Fields of an `ArmState` that the controller reports."""
UNLOCK_ADVICE = "look at the arm, unlock it at the pendant, then connect again"


class CommandRejected(Exception):  # noqa: N818  the parent raises it as a RigFault
    """A rejected command; the arguments are cause, message and advice of the fault that the parent raises."""


def _check_ready(state: RtdeState) -> None:
    if state.emergency_stop:
        raise CommandRejected("emergency_stop", "the arm is in an emergency stop", UNLOCK_ADVICE)
    if state.protective_stop:
        raise CommandRejected("protective_stop", "the arm is in a protective stop", UNLOCK_ADVICE)
    if state.mode != rtde.RUNNING:
        message = f"the arm is not ready: robot mode {state.mode}, expected {rtde.RUNNING}"
        raise CommandRejected("refused", message, UNLOCK_ADVICE)


def _wait_until_idle(reader: RtdeReader, state: RtdeState) -> RtdeState:
    """Return the first state in which no program runs on the arm; a running one belongs to another session."""
    deadline = time.monotonic() + SESSION_END_S
    while state.runtime > rtde.STOPPED:
        if time.monotonic() > deadline:
            advice = "end the other recording, or stop the program at the pendant"
            raise CommandRejected("refused", "a program runs on the arm, or is paused there", advice)
        state = reader.read(ANSWER_S)
    return state


def lock_arm(host: str) -> socket.socket:
    """Lock the arm against other processes and users of this computer until this process ends.

    The lock is the name of an abstract Unix socket, which leaves no file behind. Only Linux has such names; ur-rtde has
    no wheels for other POSIX systems.
    """
    address = socket.getaddrinfo(host, None)[0][4][0]
    lock = socket.socket(socket.AF_UNIX)
    deadline = time.monotonic() + SESSION_END_S
    while True:
        try:
            lock.bind(f"\0padforge-arm-{address}")
            return lock
        except OSError as error:
            if error.errno == errno.EADDRINUSE and time.monotonic() < deadline:
                time.sleep(KICK_S)
                continue
            lock.close()
            if error.errno != errno.EADDRINUSE:
                raise
            message = f"another program on this computer uses the arm {host}"
            raise CommandRejected("refused", message, "wait for its end, or end it") from None


class UrRtdeControl:
    """A connection to ur-rtde's program on the arm. Methods raise an error if the link is lost; lengths are m."""

    def __init__(self, host: str) -> None:
        """Send ur-rtde's program and set its watchdog; RuntimeError if there is no arm."""
        import rtde_control

        self.moving = False  # whether the last move is in progress
        self._previous_operation = 0  # number of the operation before the current move
        self._control: Any = rtde_control.RTDEControlInterface(host)
        if not self._control.setWatchdog(4.0):  # Hz, minimum rate of kicks
            raise RuntimeError("it does not take a watchdog")
        self.identity: dict[str, Any] = {"driver": f"ur-rtde {version('ur-rtde')}"}

    def tcp_offset(self) -> Sequence[float]:
        """Return the tool centre point from the flange, m and rad."""
        return self._control.getTCPOffset()

    def has_arrived(self) -> bool:
        """Return whether the last move is over."""
        status = self._control.getAsyncOperationProgressEx()
        return status.operationId() != self._previous_operation and not status.isAsyncOperationRunning()

    def kick(self) -> None:
        """Kick the watchdog, which stops the arm 0.25 s after the last kick."""
        self._control.kickWatchdog()

    def move(self, pose: Sequence[float], speed: float, acceleration: float) -> bool:
        """Start a straight move (m, rad, m/s, m/s²); return whether the arm accepts it."""
        self._previous_operation = self._control.getAsyncOperationProgressEx().operationId()
        self.moving = True
        if not (accepted := self._control.moveL(list(pose), speed, acceleration, True)):
            self.moving = False
        return accepted

    def stop(self) -> None:
        """Stop the arm, and return once it is at rest."""
        self._control.stopL(STOP_M_S2)
        self.moving = False

    def end(self) -> None:
        """Stop the arm and end the program."""
        self._control.stopL(STOP_M_S2)
        self._control.stopScript()


class WorkerProcess:
    """Executes the parent's commands and reports every state of the arm.

    The main thread reads stdin, a second one calls the driver, and a third one reads the states.
    """

    def __init__(self, host: str, out: int) -> None:
        self._host, self._out = host, out
        self._write_lock = threading.Lock()
        self._commands: queue.Queue[dict[str, Any]] = queue.Queue()
        self._control: UrRtdeControl | None = None
        self._arm_lock: socket.socket | None = None
        self._latest: RtdeState | None = None
        self._new_state = threading.Event()
        self._program_running = threading.Event()
        self._halting = False
        self._halted = threading.Event()
        self._stopped_by_arm = False

    def run(self) -> None:
        """Read commands until the parent ends."""
        threading.Thread(target=self._execute_commands, daemon=True).start()
        parent, text = os.getppid(), b""
        while True:
            ready, _, _ = select.select([0], [], [], HEARTBEAT_TIMEOUT_S)
            if not ready and self._is_moving():
                self._halt("deadline", "the program did not look at the arm during a move, so it was stopped")
            data = os.read(0, 65536) if ready else b""
            if (ready and not data) or os.getppid() != parent:
                self._halt("lost", "the program ended")
            *lines, text = (text + data).split(b"\n")
            for line in filter(None, lines):
                self._commands.put(json.loads(line))

    def _execute_commands(self) -> None:
        """Execute the commands in one thread, since the driver is not thread-safe."""
        while True:
            try:
                command = self._commands.get(timeout=KICK_S)
            except queue.Empty:
                command = {"id": 0, "command": "kick", "arguments": ()}
            try:
                result = getattr(self, f"_do_{command['command']}")(*command["arguments"])
                if command["id"]:  # 0: a command of this process itself, without a reply
                    self._send({"id": command["id"], "result": result})
            except CommandRejected as fault:
                self._send({"id": command["id"], "fault": fault.args})
            except Exception as error:
                reason = str(error).splitlines()[0] if str(error) else type(error).__name__
                if self._control is not None:
                    self._exit("lost", f"the driver lost the arm: {reason}", "connect again")
                self._send({"id": command["id"], "fault": ("refused", f"the arm refused: {reason}", "")})

    def _do_kick(self) -> None:
        if (control := self._playing()) and not self._halting and not self._stopped_by_arm:
            control.kick()

    def _do_connect(self) -> dict[str, Any]:
        try:
            self._arm_lock = lock_arm(self._host)
            identity = self._ask_identity()
            reader = RtdeReader(self._host, major_version(identity["polyscope"]))
            state = reader.read(ANSWER_S)
            _check_ready(state)
            state = _wait_until_idle(reader, state)
        except (OSError, RuntimeError, ValueError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            message = f"no arm answers at {self._host}, ports {rtde.RTDE_PORT} and {rtde.DASHBOARD_PORT}: {reason}"
            advice = "check its address, its cable and that it is switched on"
            raise CommandRejected("refused", message, advice) from None
        threading.Thread(target=self._report_states, args=(reader, state), daemon=True).start()
        control = UrRtdeControl(self._host)
        tcp = control.tcp_offset()
        self._control = control
        if not self._program_running.wait(ANSWER_S):
            raise CommandRejected("refused", "the arm's program does not run", UNLOCK_ADVICE)
        return {
            **identity,
            **control.identity,
            "host": self._host,
            "rate_hz": reader.rate_hz,
            "tcp": [*(round(1e3 * value, 3) for value in tcp[:3]), *(round(value, 6) for value in tcp[3:])],
        }

    def _ask_identity(self) -> dict[str, str]:
        """Return the arm's identity by its dashboard; reject an arm that is not in remote control."""
        questions = ["PolyscopeVersion", "get robot model", "is in remote control", "get serial number"]
        polyscope, model, remote, serial = rtde.ask_dashboard(self._host, questions, ANSWER_S)
        if remote == "false":
            raise CommandRejected("refused", "the arm is not in remote control", "switch it over at the pendant")
        answers = {"model": model, "serial": serial}
        known = {name: text for name, text in answers.items() if not text.startswith("could not")}
        return {"polyscope": polyscope.removeprefix("URSoftware "), **known}

    def _do_move(self, pose_mm: list[float], speed_mm_s: float, acceleration_mm_s2: float) -> None:
        if not (control := self._playing()):
            raise CommandRejected("refused", "the arm's program does not run, so it takes no moves", UNLOCK_ADVICE)
        if control.moving:
            raise CommandRejected("refused", "a move is under way", "wait for its end or stop it")
        pose = [*(value / 1e3 for value in pose_mm[:3]), *pose_mm[3:]]  # the arm wants m
        if not control.move(pose, speed_mm_s / 1e3, acceleration_mm_s2 / 1e3):
            message = "the arm refused the move: it is stopped, or the pose is beyond its reach or safety limits"
            raise CommandRejected("refused", message, "look at the pendant")

    def _do_stop(self) -> None:
        if control := self._playing():
            control.stop()
            self._new_state.clear()
            self._new_state.wait(FIRST_STATE_S)
        elif self._control is not None:
            if not rtde.stop_program(self._host, ANSWER_S):
                raise CommandRejected("lost", "the arm did not confirm the stop", "look at the arm")
            self._control.moving = False
        self._halted.set()

    def _do_close(self) -> None:
        self._halting = True
        if control := self._playing():
            control.end()

    def _playing(self) -> UrRtdeControl | None:
        """Return the control if its program is running, otherwise None."""
        is_playing = self._latest is not None and self._latest.runtime == rtde.PLAYING
        return self._control if is_playing else None

    def _is_moving(self) -> bool:
        return self._control is not None and self._control.moving

    def _report_states(self, reader: RtdeReader, state: RtdeState) -> None:
        """Send every state to the parent; on a lost link end before ur-rtde can reconnect and repeat a command."""
        has_arrived = False
        while True:
            self._latest = state
            self._update(state, has_arrived)
            self._new_state.set()
            stated = {name: getattr(state, name) for name in ARM_STATE}
            self._send({"state": stated | {"moving": self._is_moving()}})
            try:
                # The end of a move arrives by another link: asked before the next state, it is not ahead of that.
                control = self._control
                has_arrived = control is not None and control.moving and control.has_arrived()
                state = reader.read(STREAM_TIMEOUT_S)
            except TimeoutError:
                message = f"the arm has sent no state for {STREAM_TIMEOUT_S} s"
                self._exit("stale", message, "check the network, connect again")
            except (OSError, RuntimeError, ValueError):
                self._exit("lost", "the arm closed the link", "check that it is switched on, connect again")

    def _update(self, state: RtdeState, has_arrived: bool) -> None:
        stopped = state.protective_stop or state.emergency_stop
        if self._control is not None and (stopped or has_arrived):
            self._control.moving = False
        if stopped and not self._stopped_by_arm:
            # A paused program would resume the old move as soon as a person unlocks the arm and presses play.
            threading.Thread(target=rtde.stop_program, args=(self._host, ANSWER_S), daemon=True).start()
        elif self._stopped_by_arm and not stopped:
            self._exit("lost", "the arm was stopped and unlocked, which ends its program", "connect again")
        elif self._control is not None and state.runtime == rtde.PLAYING:
            self._program_running.set()
        elif self._program_running.is_set() and not stopped and not self._halting:
            self._exit("lost", "the arm's program has ended", "look at the arm, then connect again")
        self._stopped_by_arm = stopped

    def _halt(self, cause: str, message: str) -> None:
        """Stop the arm and end this process; if the driver does not stop the arm, the watchdog does."""
        self._halting = True
        self._commands.put({"id": 0, "command": "stop", "arguments": ()})
        self._halted.wait(HALT_S)
        self._exit(cause, message, "connect again")

    def _send(self, message: dict[str, Any]) -> None:
        data = json.dumps(message).encode() + b"\n"
        with self._write_lock:
            while data:
                data = data[os.write(self._out, data) :]

    def _exit(self, cause: str, message: str, advice: str) -> NoReturn:
        """Report the reason to the parent and end without ur-rtde's clean-up, which waits and can crash."""
        report = threading.Thread(target=self._send, args=({"exit": (cause, message, advice)},), daemon=True)
        report.start()
        report.join(HALT_S)
        os._exit(0)


def main() -> None:
    """Run the worker; stdout is reserved for the parent, and ur-rtde prints to stderr."""
    out = os.dup(1)
    os.dup2(2, 1)
    with contextlib.suppress(KeyboardInterrupt):
        WorkerProcess(sys.argv[1], out).run()


if __name__ == "__main__":
    main()
