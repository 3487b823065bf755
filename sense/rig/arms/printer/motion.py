"""Straight moves from rest to rest as a printer makes them: a trapezoid of speed, each axis within its own limits."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

Place = tuple[float, float, float]
"""x, y and z, mm."""


@dataclass(frozen=True)
class StraightMove:
    """A move of some speed, mm/s, and acceleration, mm/s², both > 0."""

    start: Place
    end: Place
    speed: float
    acceleration: float

    @property
    def length_mm(self) -> float:
        """From start to end."""
        return math.dist(self.start, self.end)

    @property
    def duration_s(self) -> float:
        """From rest to rest."""
        return 2 * self._rise_s + self._cruise_s

    def within(self, speeds: Sequence[float], accelerations: Sequence[float]) -> "StraightMove":
        """The same move, so slow that no axis exceeds its own speed and acceleration."""
        if not self.length_mm:
            return self
        shares = [abs(b - a) / self.length_mm for a, b in zip(self.start, self.end, strict=True)]
        speed, acceleration = (
            min([wanted, *(limit / share for limit, share in zip(limits, shares, strict=True) if share)])
            for wanted, limits in ((self.speed, speeds), (self.acceleration, accelerations))
        )
        return StraightMove(self.start, self.end, speed, acceleration)

    def at(self, t_s: float) -> Place:
        """Where the move is `t_s` seconds after its beginning; its start before that, its end after it."""
        t, left = max(t_s, 0.0), max(self.duration_s - t_s, 0.0)
        if left == 0:
            return self.end
        rise, top = self._rise_s, self.acceleration * self._rise_s
        if t < rise:
            gone = self.acceleration * t * t / 2
        elif left < rise:
            gone = self.length_mm - self.acceleration * left * left / 2
        else:
            gone = top * (t - rise / 2)
        share = gone / self.length_mm
        x, y, z = (a + share * (b - a) for a, b in zip(self.start, self.end, strict=True))
        return x, y, z

    def distance_mm(self, place: Place) -> float:
        """How far a place lies from the way."""
        way, to = ([b - a for a, b in zip(self.start, end, strict=True)] for end in (self.end, place))
        square = self.length_mm**2
        share = sum(a * b for a, b in zip(way, to, strict=True)) / square if square else 0.0
        share = min(max(share, 0.0), 1.0)
        return math.dist(to, [share * a for a in way])

    @property
    def _rise_s(self) -> float:
        return min(self.speed / self.acceleration, math.sqrt(self.length_mm / self.acceleration))

    @property
    def _cruise_s(self) -> float:
        return self.length_mm / (self.acceleration * self._rise_s) - self._rise_s if self._rise_s else 0.0
