"""The emulated UR controller without its sockets: motions, registers, programs, watchdog and safety.

Of ur-rtde's control program the commands are emulated that our driver uses; any other program waits until it is
stopped. Lengths are m and angles rad, poses and velocities have six numbers. The true poses are logged in mm.
"""

import itertools
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterator, Mapping
from operator import itemgetter
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.arrays import Array
from padforge.sense.rig.arms.motion import Position, TrapezoidalProfile
from padforge.sense.rig.arms.rtde import PLAYING, RUNNING, STOPPED

Series = Literal["cb3", "e"]
RATES_HZ = {"cb3": 125, "e": 500}
VERSIONS = {"cb3": (3, 15, 8, 106339), "e": (5, 12, 2, 1101534)}
START_S = 0.02  # from the last byte of a program to its first step
NORMAL, PROTECTIVE, EMERGENCY = 1 << 0, 1 << 2, 1 << 7
POWER_OFF = 3  # robot mode
PAUSED = 4  # runtime state
UR_RTDE_PROGRAM = "def rtde_control():"

MOVE_L, STOP, WATCHDOG, GET_TCP, END = 3, 33, 35, 40, 255
"""Commands of ur-rtde's control program that are emulated: those of our driver."""


class Motion:
    """Straight moves of the tool with a trapezoidal velocity profile; stops are at once. A rotation is in rad/s.

    The rotation vector changes in proportion to the distance, which is right for the small rotations of a probe.
    """

    def __init__(self, pose: Array) -> None:
        self.pose, self.velocity = pose, np.zeros(6)
        self._move: tuple[Array, Array, TrapezoidalProfile, float] | None = None  # start, end, profile, time of start
        self._interrupted: tuple[Array, float, float] | None = None  # end, speed, acceleration

    @property
    def moving(self) -> bool:
        return self._move is not None

    def move_to(self, end: Array, speed: float, acceleration: float, now: float) -> None:
        offset = end - self.pose
        length = float(np.linalg.norm(offset[:3]) or np.linalg.norm(offset[3:]))
        self._move = self.pose, end, TrapezoidalProfile(length, speed, acceleration), now

    def stop(self) -> None:
        self._move, self._interrupted, self.velocity = None, None, np.zeros(6)

    def interrupt(self) -> None:
        move = self._move
        self.stop()
        self._interrupted = move and (move[1], move[2].max_speed, move[2].acceleration)

    def resume(self, now: float) -> None:
        if move := self._interrupted:
            self._interrupted = None
            self.move_to(*move, now)

    def update(self, now: float) -> None:
        if self._move is None:
            return
        start, end, profile, start_s = self._move
        distance, speed = profile.evaluate(now - start_s)
        direction = (end - start) / (profile.length or 1.0)
        self.pose, self.velocity = start + distance * direction, speed * direction
        if now - start_s >= profile.duration_s:
            self.pose = end
            self.stop()


class Controller:
    """A controller, from one control cycle to the next; times are seconds of the host's monotonic clock."""

    def __init__(self, series: Series, pose: Array, plane: float, stiffness: float, now: float, tcp: Position) -> None:
        """Switch it on at the time `now`, its tool at `pose`, above a springy plane; its height in m and N/m."""
        self.series: Series = series
        self.tcp, self.now = tcp, now
        self.motion = Motion(pose)
        self._surface, self._stiffness = plane, stiffness
        self.remote, self.sideways_n = True, 0.0  # in remote control; the force that pushes the tool along x
        self.has_force = True  # whether the force of the states is a number
        self.dashboard_log: list[str] = []
        self.restart(now)

    def restart(self, now: float) -> None:
        """Restart as after a power failure: all state is lost but the pose."""
        self.motion = Motion(self.motion.pose)
        self.inputs: defaultdict[str, float] = defaultdict(float)  # registers that clients write
        self.outputs: dict[str, float] = {}  # registers that clients read
        self._boot = self.now = now
        self._safety, self._runtime, self._mode = NORMAL, STOPPED, RUNNING
        self._threads: list[Iterator[None]] = []
        self._program: Iterator[None] = iter(())  # that starts next
        self._program_start: float | None = None
        self._watchdog_s = np.inf
        self._kicked = now
        self._n_operations = self._n_writes = 0

    def tick(self, now: float) -> None:
        self.now = now
        self.motion.update(now)
        if self._program_start is not None and now >= self._program_start:
            self._program_start, self._runtime, self._kicked = None, PLAYING, now
            self._threads = [self._program]
        if self._runtime == PLAYING:
            if now - self._kicked > self._watchdog_s:
                self.stop_program()
            for thread in list(self._threads):
                if thread in self._threads:
                    next(thread, None)

    def write(self, values: Mapping[str, float], now: float) -> None:
        """Write input registers; the command register kicks the watchdog."""
        self.inputs.update(values)
        if "input_int_register_0" in values:
            self._kicked = now

    def upload(self, text: str) -> None:
        if self._safety != NORMAL:
            return
        self.stop_program()
        self._program = self._emulate_ur_rtde() if UR_RTDE_PROGRAM in text else itertools.repeat(None)
        self._program_start = self.now + START_S

    def stop_program(self) -> None:
        self._threads, self._program_start, self._watchdog_s = [], None, np.inf
        self._runtime = STOPPED
        self.motion.stop()

    def protective_stop(self) -> None:
        """Brake and pause: the program goes on if a person unlocks the arm and presses play."""
        self._safety = PROTECTIVE
        self.motion.interrupt()
        if self._runtime == PLAYING:
            self._runtime = PAUSED

    def emergency_stop(self) -> None:
        self.stop_program()
        self._safety, self._mode = EMERGENCY, POWER_OFF

    def clear(self) -> None:
        """Unlock, power on and release the brakes, as a person does at the pendant after a stop."""
        self._safety, self._mode = NORMAL, RUNNING

    def play(self) -> None:
        """Press play, as a person does: a paused program goes on."""
        if self._runtime == PAUSED and self._safety == NORMAL:
            self._runtime, self._kicked = PLAYING, self.now
            self.motion.resume(self.now)

    def answer_dashboard(self, line: str) -> str:
        self.dashboard_log.append(line)
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

    def surface_force(self) -> float:
        return self._stiffness * max(0.0, self._surface - float(self.motion.pose[2]))

    def state(self) -> dict[str, Any]:
        """Return the variables that are not zero, by name."""
        force = np.array([self.sideways_n, 0.0, self.surface_force(), 0.0, 0.0, 0.0])
        return self.outputs | {
            "timestamp": self.now - self._boot,
            "actual_TCP_pose": self.motion.pose,
            "target_TCP_pose": self.motion.pose,
            "actual_TCP_speed": self.motion.velocity,
            "target_TCP_speed": self.motion.velocity,
            "actual_TCP_force": force if self.has_force else np.full(6, np.nan),
            "robot_mode": self._mode,
            "runtime_state": self._runtime,
            "robot_status_bits": 1 | (self._runtime == PLAYING) << 1,
            "safety_status_bits": self._safety,
        }

    def _emulate_ur_rtde(self) -> Iterator[None]:
        """Run the loop of ur-rtde's control program: a command, then done, then ready once the client has noted it."""
        self._set_progress(moving=False)
        executed = False
        while True:
            command = int(self.inputs["input_int_register_0"])
            if command == END:
                self.stop_program()
                return
            elif command and not executed:
                yield from self._execute(command)
                self._signal(2)
                executed = True
            elif not command:
                executed = False
                self._signal(1)
            yield

    def _signal(self, value: int) -> None:
        self.outputs["output_int_register_0"] = value

    def _execute(self, command: int) -> Iterator[None]:
        if command == MOVE_L:
            *pose, speed, acceleration = map(self._read_double, range(8))
            self._halt()
            thread = self._move(np.array(pose), speed, acceleration)
            if self.inputs["input_int_register_1"]:  # asynchronous
                self._threads.append(thread)
            else:
                yield from thread
        elif command == STOP:
            self._halt()
        elif command == GET_TCP:
            tcp = (*self.tcp, 0.0, 0.0, 0.0)
            self.outputs |= {f"output_double_register_{i}": value for i, value in enumerate(tcp)}
        elif command == WATCHDOG:
            self._watchdog_s = 1 / self._read_double(0)
        else:
            self.stop_program()

    def _move(self, pose: Array, speed: float, acceleration: float) -> Iterator[None]:
        self._set_progress(moving=True)
        yield
        self.motion.move_to(pose, speed, acceleration, self.now)
        while self.motion.moving:
            yield
        self._set_progress(moving=False)

    def _halt(self) -> None:
        if len(self._threads) > 1:
            self._set_progress(moving=False)
        del self._threads[1:]
        self.motion.stop()

    def _set_progress(self, moving: bool) -> None:
        """Write register 2 as ur-rtde packs it: number of the operation, number of writes, whether it runs."""
        self._n_writes = (self._n_writes + 1) % 128
        self._n_operations = (self._n_operations + moving) % 128
        self.outputs["output_int_register_2"] = self._n_operations << 24 | self._n_writes << 16 | moving << 15

    def _read_double(self, index: int) -> float:
        return self.inputs[f"input_double_register_{index}"]


class PoseLog:
    """The true poses of the tip; threads may read while one writes."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def append(self, time_s: float, pose: ArrayLike, force_n: float) -> None:
        self._rows.append((time_s, *np.asarray(pose).tolist(), force_n))

    def rows(self, since_s: float = -np.inf) -> Array:
        """Return the (n, 8) rows from the last one before a time on, oldest first."""
        first = bisect_right(self._rows, since_s, key=itemgetter(0)) - 1
        return np.array(self._rows[max(first, 0) :])

    def poses(self, times_s: ArrayLike) -> Array:
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        rows = self.rows(np.min(times, initial=np.inf))
        return np.column_stack([np.interp(times, rows[:, 0], column) for column in rows.T[1:7]])
