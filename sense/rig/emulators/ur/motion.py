"""Motions of the emulated tool, in closed form; metres, radians and seconds, poses and velocities of six numbers."""

from typing import Protocol

import numpy as np

from padforge.sense.recordings.processing.limits import Array


class Path(Protocol):
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
        self._path: Path | None = None
        self._begun = 0.0
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
        t = now - self._begun
        self.pose, self.velocity = self._path.at(min(t, self._path.duration))
        if t >= self._path.duration:
            self._path, self.velocity = None, np.zeros(6)

    def _begin(self, path: Path, now: float) -> None:
        self._path, self._begun = path, now
