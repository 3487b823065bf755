"""Motions of the emulated tool, in closed form; metres, radians and seconds, poses and velocities of six numbers.

The emulated controller without its sockets: registers, the control program of ur-rtde, watchdog and safety.

Where the tip of the emulated arm really was, in a file that several processes map: one writer, any readers.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig.arms.rtde import PAUSED, PLAYING, RUNNING, STOPPED


class Trajectory(Protocol):
    """A course of the tool."""

    duration: float

    def at(self, t: float) -> tuple[Array, Array]:
        """Pose and velocity `t` seconds after the beginning."""
        ...


class Line:
    """A straight move from rest to rest with a trapezoid of speed; a pure turn takes its speed as rad/s.

    The rotation vector changes in proportion to the way, which is right for the small turns of a probe.
    """

    def __init__(self, start: Array, end: Array, speed: float, acceleration: float) -> None:
        way = end - start
        self._start, self.end = start, end
        self.speed, self.acceleration = speed, acceleration
        self._length = float(np.linalg.norm(way[:3]) or np.linalg.norm(way[3:]))
        self._way = way / self._length if self._length else way
        self._rise = min(speed / acceleration, (self._length / acceleration) ** 0.5)
        self._top = acceleration * self._rise
        self._cruise = self._length / self._top - self._rise if self._length else 0.0
        self.duration = 2 * self._rise + self._cruise

    def at(self, t: float) -> tuple[Array, Array]:
        if t >= self.duration:
            return self.end.copy(), np.zeros(6)
        left = self.duration - t
        if t < self._rise:
            gone, speed = self.acceleration * t * t / 2, self.acceleration * t
        elif left < self._rise:
            gone, speed = self._length - self.acceleration * left * left / 2, self.acceleration * left
        else:
            gone, speed = self._top * (t - self._rise / 2), self._top
        return self._start + gone * self._way, speed * self._way


class Ramp:
    """From one velocity to another, which is then kept: speedL, and braking where it is zero."""

    def __init__(self, start: Array, before: Array, after: Array, acceleration: float) -> None:
        self._start, self._before, self._after = start, before, after
        self._time = float(np.linalg.norm(after - before)) / acceleration
        self.duration = np.inf if after.any() else self._time

    def at(self, t: float) -> tuple[Array, Array]:
        change = self._after - self._before
        share = min(t / self._time, 1.0) if self._time else 1.0
        kept = max(t - self._time, 0.0)
        ramped = self._before * (t - kept) + change * share * (t - kept) / 2
        return self._start + ramped + self._after * kept, self._before + change * share


class Motion:
    """Where the tool is and how it moves.

    Attributes:
        pose, velocity: at the last update. moving: whether a path is under way.
    """

    def __init__(self, pose: Array) -> None:
        self.pose, self.velocity = pose, np.zeros(6)
        self._path: Trajectory | None = None
        self._down_command = 0.0
        self._interrupted: Line | None = None

    @property
    def moving(self) -> bool:
        return self._path is not None

    def line(self, end: Array, speed: float, acceleration: float, now: float) -> None:
        """Begin a straight move from here; the tool has to be at rest."""
        self._begin(Line(self.pose, end, speed, acceleration), now)

    def drift(self, velocity: Array, acceleration: float, now: float) -> None:
        """Go over to a velocity and keep it."""
        self._begin(Ramp(self.pose, self.velocity, velocity, acceleration), now)

    def brake(self, deceleration: float, now: float) -> None:
        """Come to rest; a second order to brake changes nothing."""
        self._interrupted = None
        if self.moving and not (isinstance(self._path, Ramp) and np.isfinite(self._path.duration)):
            self._begin(Ramp(self.pose, self.velocity, np.zeros(6), deceleration), now)

    def interrupt(self, deceleration: float, now: float) -> None:
        """Come to rest, keeping in mind the move that was under way."""
        line = self._path if isinstance(self._path, Line) else None
        self.brake(deceleration, now)
        self._interrupted = line

    def resume(self, now: float) -> None:
        """Go on with the interrupted move."""
        if line := self._interrupted:
            self._interrupted = None
            self.line(line.end, line.speed, line.acceleration, now)

    def update(self, now: float) -> None:
        """Go on to the time `now`."""
        if self._path is None:
            return
        t = now - self._down_command
        self.pose, self.velocity = self._path.at(min(t, self._path.duration))
        if t >= self._path.duration:
            self._path, self.velocity = None, np.zeros(6)

    def _begin(self, path: Trajectory, now: float) -> None:
        self._path, self._down_command = path, now


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
        self._progress(down_command=False)
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
        self._progress(down_command=True)
        yield
        self.motion.line(pose, speed, acceleration, self._now)
        while self.motion.moving:
            yield
        self._progress(down_command=False)

    def _halt(self, deceleration: float) -> Iterator[None]:
        if len(self._threads) > 1:
            self._progress(down_command=False)
        del self._threads[1:]
        self.motion.brake(deceleration, self._now)
        while self.motion.moving:
            yield

    def _progress(self, down_command: bool) -> None:
        """Register 2 as ur-rtde packs it: number of the operation, number of writes, whether it runs."""
        self._writes = (self._writes + 1) % 128
        self._operation = (self._operation + down_command) % 128
        self.outputs["output_int_register_2"] = self._operation << 24 | self._writes << 16 | down_command << 15

    def _double(self, index: int) -> float:
        return self.inputs[f"input_double_register_{index}"]

    def _doubles(self, first: int, count: int) -> Array:
        return np.array([self._double(index) for index in range(first, first + count)])


COLUMNS = 8
"""Time on the host's monotonic clock in s, pose in mm and rad, force on the tool in N."""
ROWS = 1 << 16
"""Length of the ring: 131 s at 500 Hz, 524 s at 125 Hz."""
_MARGIN = 16
"""Rows that the writer may overwrite while a reader copies."""
LOOKS = (256, 8192, ROWS)
"""So many rows are looked at in turn: who asks in real time, as a board does, asks of the newest."""


class TruthWriter:
    """Appends rows to the ring."""

    def __init__(self, path: Path) -> None:
        self._count, self._rows = _map(path, "r+")

    def append(self, time_s: float, pose: ArrayLike, force_n: float) -> None:
        """Add a row: pose in mm and rad."""
        count = int(self._count[0])
        row = self._rows[count % ROWS]
        row[0], row[1:7], row[7] = time_s, pose, force_n
        self._count[0] = count + 1


class Truth:
    """Reads the ring, from any process."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._count, self._rows = _map(path, "r")

    def rows(self, most: int = ROWS) -> Array:
        """(n, 8) rows from older ones to the newest, the last `most` of them: time, pose in mm and rad, force."""
        count = int(self._count[0])
        first = max(0, count - min(most, ROWS - _MARGIN))
        copy = self._rows[np.arange(first, count) % ROWS]
        overwritten = int(self._count[0]) - ROWS + _MARGIN
        return copy[max(0, overwritten - first) :]

    def pose_at(self, times_s: ArrayLike) -> Array:
        """(n, 6) poses in mm and rad at monotonic times, the newest one for later times.

        Raises:
            ValueError: for a time before the oldest row.
        """
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64))
        first_s, rows = np.min(times, initial=np.inf), np.empty((0, COLUMNS))
        for most in LOOKS:
            rows = self.rows(most)
            if len(rows) and rows[0, 0] <= first_s:
                return np.column_stack([np.interp(times, rows[:, 0], column) for column in rows.T[1:7]])
        raise ValueError("a time before the oldest pose that is kept")


def create(path: Path) -> None:
    """Make an empty ring."""
    with path.open("wb") as file:
        file.truncate(8 + 8 * COLUMNS * ROWS)


def _map(path: Path, mode: str) -> tuple[Indices, Array]:
    data = np.memmap(path, np.uint8, mode)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return data[:8].view(np.int64), data[8:].view(np.float64).reshape(ROWS, COLUMNS)
