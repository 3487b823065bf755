"""Straight moves from rest to rest with a trapezoidal velocity profile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

Position = tuple[float, float, float]  # x, y and z, mm


@dataclass(frozen=True)
class TrapezoidalProfile:
    """Distance and speed of a move from rest to rest over time."""

    length: float  # distance from start to end, >= 0; mm, m or rad
    max_speed: float  # cruising speed if the move is long enough, > 0; that unit per s
    acceleration: float  # of the ramps at both ends, > 0; that unit per s²

    @property
    def duration_s(self) -> float:
        """Time from rest to rest, s."""
        cruise_s = self.length / (self.acceleration * self._rise_s) - self._rise_s if self._rise_s else 0.0
        return 2 * self._rise_s + cruise_s

    @property
    def _rise_s(self) -> float:
        return min(self.max_speed / self.acceleration, math.sqrt(self.length / self.acceleration))

    def evaluate(self, t_s: float) -> tuple[float, float]:
        """Return distance and speed `t_s` seconds after the start; before and after the move it is at rest."""
        t_s, remaining_s, rise_s = max(t_s, 0.0), max(self.duration_s - t_s, 0.0), self._rise_s
        if remaining_s == 0:
            return self.length, 0.0
        if t_s < rise_s:
            return self.acceleration * t_s**2 / 2, self.acceleration * t_s
        if remaining_s < rise_s:
            return self.length - self.acceleration * remaining_s**2 / 2, self.acceleration * remaining_s
        return self.acceleration * rise_s * (t_s - rise_s / 2), self.acceleration * rise_s


@dataclass(frozen=True)
class StraightMove:
    """A straight move of a nozzle."""

    start: Position
    end: Position
    speed: float  # maximum, > 0, mm/s
    acceleration: float  # > 0, mm/s²

    @property
    def length_mm(self) -> float:
        """Distance from start to end."""
        return math.dist(self.start, self.end)

    @property
    def duration_s(self) -> float:
        """Time from rest to rest, s."""
        return self._profile.duration_s

    @property
    def _profile(self) -> TrapezoidalProfile:
        return TrapezoidalProfile(self.length_mm, self.speed, self.acceleration)

    def limit_axes(self, max_speeds: Sequence[float], max_accelerations: Sequence[float]) -> "StraightMove":
        """Return the same move, slowed down until no axis exceeds its own speed and acceleration."""
        if not self.length_mm:
            return self
        direction = [abs(b - a) / self.length_mm for a, b in zip(self.start, self.end, strict=True)]
        speed, acceleration = (
            min([requested, *(limit / cosine for limit, cosine in zip(limits, direction, strict=True) if cosine)])
            for requested, limits in ((self.speed, max_speeds), (self.acceleration, max_accelerations))
        )
        return replace(self, speed=speed, acceleration=acceleration)

    def position(self, t_s: float) -> Position:
        """Return the position `t_s` seconds after the start; `start` before the move, `end` after it."""
        if t_s >= self.duration_s:
            return self.end
        fraction = self._profile.evaluate(t_s)[0] / self.length_mm
        x, y, z = (a + fraction * (b - a) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z

    def distance_mm(self, position: Position) -> float:
        """Return the distance of a position from the path."""
        path = [b - a for a, b in zip(self.start, self.end, strict=True)]
        offset = [b - a for a, b in zip(self.start, position, strict=True)]
        fraction = sum(a * b for a, b in zip(path, offset, strict=True)) / self.length_mm**2 if self.length_mm else 0.0
        fraction = min(max(fraction, 0.0), 1.0)  # of the path, at its point nearest to the position
        return math.dist(offset, [fraction * value for value in path])
