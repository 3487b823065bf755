"""The emulated controller without its sockets: registers, the control program of ur-rtde, watchdog and safety."""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from padforge.sense.rig.arms.ur5.rtde_frames import PAUSED, PLAYING, RUNNING, STOPPED

from padforge.sense.rig.emulators.ur.motion import Array, Motion

Series = Literal["cb3", "e"]
RATES_HZ = {"cb3": 125, "e": 500}
VERSIONS = {"cb3": (3, 15, 8, 106339), "e": (5, 12, 2, 1101534)}
HALT_M_S2 = 4.0
"""Deceleration where the controller itself stops the arm."""
START_S = 0.02
"""From the last byte of a program to its first step."""
NORMAL, PROTECTIVE, EMERGENCY = 1 << 0, 1 << 2, 1 << 7
POWER_OFF = 3

MOVE, DRIFT, STOP_DRIFT, SET_TCP, STOP, WATCHDOG, IS_SAFE, GET_TCP, IS_STEADY, END = (
    3, 10, 15, 29, 33, 35, 36, 40, 47, 255,
)  # fmt: skip


@dataclass(frozen=True)
class SpringySurface:
    """A springy plane the tool can press on, at a height in m."""

    height: float
    stiffness: float

    def force(self, pose: Array) -> float:
        """Force on the tool, N, upwards."""
        return self.stiffness * max(0.0, self.height - float(pose[2]))


class Controller:
    """What a controller does from one control cycle to the next; times are seconds of the host's monotonic clock.

    Attributes:
        motion: of the tool. inputs: registers that clients write. outputs: registers that clients read.
        remote: whether the arm is in remote control. sideways_n: force that pushes the tool along x.
        asked: every line the dashboard was sent.
    """

    def __init__(
        self,
        series: Series,
        pose: Array,
        surface: SpringySurface | None = None,
        now: float = 0.0,
        tcp: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Switch it on with its tool where `pose` says; `tcp` is that of its installation, m."""
        self.series: Series = series
        self._installed = tcp
        self.motion = Motion(pose)
        self.surface = surface
        self.remote, self.sideways_n = True, 0.0
        self.asked: list[str] = []
        self.restart(now)

    def restart(self, now: float) -> None:
        """As after the power has come back: nothing runs, nothing is known of before but where the arm is."""
        self.motion = Motion(self.motion.pose)
        self.inputs: defaultdict[str, float] = defaultdict(float)
        self.outputs: dict[str, float] = {}
        self.tcp: Array = np.array([*self._installed, 0.0, 0.0, 0.0])
        self._boot = self._now = now
        self._safety, self._runtime, self._mode = NORMAL, STOPPED, RUNNING
        self._threads: list[Iterator[None]] = []
        self._starts: float | None = None
        self._period = np.inf
        self._kicked = now
        self._operation = self._writes = 0

    def tick(self, now: float) -> None:
        """One control cycle."""
        self._now = now
        self.motion.update(now)
        if self._starts is not None and now >= self._starts:
            self._starts, self._runtime, self._kicked = None, PLAYING, now
            self._threads = [self._program()]
        if self._runtime == PLAYING:
            if now - self._kicked > self._period:
                self.stop_program()
            for thread in list(self._threads):
                if thread in self._threads:
                    next(thread, None)

    def write(self, values: Mapping[str, float], now: float) -> None:
        """Input registers from a client; the command register is what the watchdog looks at."""
        self.inputs.update(values)
        if "input_int_register_0" in values:
            self._kicked = now

    def upload(self) -> None:
        """A whole control program has come in; it replaces a running one."""
        if self._safety == NORMAL:
            self.stop_program()
            self._starts = self._now + START_S

    def stop_program(self) -> None:
        """End the program and brake the arm."""
        self._threads, self._starts, self._period = [], None, np.inf
        self._runtime = STOPPED
        self.motion.brake(HALT_M_S2, self._now)

    def protective_stop(self) -> None:
        """Brake and pause: the program goes on if a person unlocks the arm and presses play."""
        self._safety = PROTECTIVE
        self.motion.interrupt(HALT_M_S2, self._now)
        if self._runtime == PLAYING:
            self._runtime = PAUSED

    def emergency_stop(self) -> None:
        """Brake, end the program, power off."""
        self.stop_program()
        self._safety, self._mode = EMERGENCY, POWER_OFF

    def clear(self) -> None:
        """What a person does at the pendant after a stop: unlock, power on, release the brakes."""
        self._safety, self._mode = NORMAL, RUNNING

    def play(self) -> None:
        """A person presses play: a paused program goes on."""
        if self._runtime == PAUSED and self._safety == NORMAL:
            self._runtime, self._kicked = PLAYING, self._now
            self.motion.resume(self._now)

    def dashboard(self, line: str) -> str:
        """Answer to a line sent to the dashboard."""
        self.asked.append(line)
        if line == "stop":
            self.stop_program()
        version = ".".join(map(str, VERSIONS[self.series]))
        answers = {
            "stop": "Stopped",
            "running": f"Program running: {str(self._runtime == PLAYING).lower()}",
            "PolyscopeVersion": f"URSoftware {version} (Jan 01 2024)",
            "get robot model": "UR5",
        }
        if self.series == "e":
            answers |= {"get serial number": "20185500000", "is in remote control": str(self.remote).lower()}
        return answers.get(line, f"could not understand: '{line}'")

    def state(self) -> dict[str, Any]:
        """The variables that are not zero, by name."""
        force = np.zeros(6)
        force[0], force[2] = self.sideways_n, self.surface.force(self.motion.pose) if self.surface else 0.0
        return self.outputs | {
            "timestamp": self._now - self._boot,
            "actual_TCP_pose": self.motion.pose,
            "target_TCP_pose": self.motion.pose,
            "actual_TCP_speed": self.motion.velocity,
            "target_TCP_speed": self.motion.velocity,
            "actual_TCP_force": force,
            "robot_mode": self._mode,
            "runtime_state": self._runtime,
            "robot_status_bits": 1 | (self._runtime == PLAYING) << 1,
            "safety_status_bits": self._safety,
        }

    def _program(self) -> Iterator[None]:
        """The loop of ur-rtde's control program: one command, then done, then ready when the client has taken note."""
        self._progress(begun=False)
        executed = False
        while True:
            command = int(self.inputs["input_int_register_0"])
            if command == DRIFT:
                self.motion.drift(self._doubles(0, 6), self._double(6), self._now)
                self._signal(1)
            elif command == END:
                self.stop_program()
                return
            elif command and not executed:
                yield from self._perform(command)
                self._signal(2)
                executed = True
            elif not command:
                executed = False
                self._signal(1)
            yield

    def _signal(self, what: int) -> None:
        self.outputs["output_int_register_0"] = what

    def _perform(self, command: int) -> Iterator[None]:
        if command == MOVE:
            yield from self._move()
        elif command in (STOP, STOP_DRIFT):
            yield from self._halt(self._double(0))
        elif command == SET_TCP:
            self.tcp = self._doubles(0, 6)
        elif command == GET_TCP:
            self.outputs |= {f"output_double_register_{i}": float(value) for i, value in enumerate(self.tcp)}
        elif command == WATCHDOG:
            self._period = 1 / self._double(0)
        elif command in (IS_SAFE, IS_STEADY):
            self.outputs["output_int_register_1"] = int(command == IS_SAFE or not self.motion.moving)
        else:
            self.stop_program()

    def _move(self) -> Iterator[None]:
        pose, speed, acceleration = self._doubles(0, 6), self._double(6), self._double(7)
        yield from self._halt(HALT_M_S2)
        thread = self._mover(pose, speed, acceleration)
        if self.inputs["input_int_register_1"]:
            self._threads.append(thread)
        else:
            yield from thread

    def _mover(self, pose: Array, speed: float, acceleration: float) -> Iterator[None]:
        self._progress(begun=True)
        yield
        self.motion.line(pose, speed, acceleration, self._now)
        while self.motion.moving:
            yield
        self._progress(begun=False)

    def _halt(self, deceleration: float) -> Iterator[None]:
        if len(self._threads) > 1:
            self._progress(begun=False)
        del self._threads[1:]
        self.motion.brake(deceleration, self._now)
        while self.motion.moving:
            yield

    def _progress(self, begun: bool) -> None:
        """Register 2 as ur-rtde packs it: number of the operation, number of writes, whether it runs."""
        self._writes = (self._writes + 1) % 128
        self._operation = (self._operation + begun) % 128
        self.outputs["output_int_register_2"] = self._operation << 24 | self._writes << 16 | begun << 15

    def _double(self, index: int) -> float:
        return self.inputs[f"input_double_register_{index}"]

    def _doubles(self, first: int, count: int) -> Array:
        return np.array([self._double(index) for index in range(first, first + count)])
