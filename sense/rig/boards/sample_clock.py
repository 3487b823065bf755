"""From the index of a sample, or the board's time of it, to the host's time, by when the blocks of samples arrived.

A block cannot arrive before its last sample was taken, and now and then one arrives with hardly any delay. The time of
a sample is therefore a straight line under all arrivals of the last minute, as high as it goes: late blocks do not
matter, and the slope is the board's clock against the host's. A delay that every block has in common cannot be seen
and stays in the times.
"""

from collections import deque

import numpy as np

from padforge.sense.recordings.processing.limits import Array, Indices

Point = tuple[float, float]

_BUCKET_S = 1.0
"""Of the arrivals in so much time only the one with the least delay is kept."""
_BUCKETS = 60
QUARTZ_SKEW = 500e-6
"""Quartz against quartz; anything beyond is noise of the first seconds."""
_SLOWEST, _FASTEST = 0.5, 1.5
"""Limits of the step between two times given out, in periods, while a changed line is caught up with."""


class SampleClock:
    """Host times of what a board counts, learnt from arrivals.

    Args:
        period_s: of one count by the board's own clock: that of a sample, or 1e-6 where it counts microseconds.
        max_skew: share by which a count may really take longer or shorter.
    """

    def __init__(self, period_s: float, max_skew: float = QUARTZ_SKEW) -> None:
        self._period_s, self._max_skew = period_s, max_skew
        self._origin: tuple[int, float] | None = None
        self._lowest: Point | None = None
        self._buckets: deque[Point] = deque(maxlen=_BUCKETS)
        self._offset = 0.0
        self._slope = 0.0
        self._given: tuple[int, float] | None = None

    @property
    def skew_ppm(self) -> float:
        """How much longer than its nominal period a sample takes by the host's clock, in millionths."""
        return self._slope * 1e6

    def observe(self, index: int, arrival_s: float) -> None:
        """A block whose last sample is `index` (counted on without wrapping) arrived at `arrival_s`, host time."""
        if self._origin is None:
            self._origin = (index, arrival_s)
        start, start_s = self._origin
        nominal = (index - start) * self._period_s
        point = (nominal, arrival_s - start_s - nominal)
        if self._lowest is None or point[0] // _BUCKET_S > self._lowest[0] // _BUCKET_S:
            self._close_bucket(point)
        elif point[1] - self._slope * point[0] < self._lowest[1] - self._slope * self._lowest[0]:
            self._lowest = point
        self._offset = min(self._offset, point[1] - self._slope * point[0])

    def times(self, indices: Indices) -> Array:
        """(n,) host times in s of the samples of these indices; above all that were given before.

        Indices must ascend, also from call to call, and at least one block have been observed.
        """
        if self._origin is None:
            raise ValueError("no block has been observed")
        start, start_s = self._origin
        first, last = int(indices[0]), int(indices[-1])
        nominal = (last - start) * self._period_s
        end = start_s + nominal * (1 + self._slope) + self._offset
        before, before_s = self._given or (first - 1, end - (last - first + 1) * self._period_s)
        span = (last - before) * self._period_s
        end = min(max(end, before_s + _SLOWEST * span), before_s + _FASTEST * span)
        self._given = (last, end)
        steps = (indices - before).astype(np.float64)
        return before_s + steps * ((end - before_s) / (last - before))

    def _close_bucket(self, point: Point) -> None:
        if self._lowest is not None:
            self._buckets.append(self._lowest)
            self._offset, self._slope = _line_under(list(self._buckets), self._max_skew)
        self._lowest = point


def _line_under(points: list[Point], steepest: float) -> tuple[float, float]:
    """Offset and slope of the line under all `points`, by ascending x, that is highest at their mean x."""
    hull: list[Point] = []
    for point in points:
        while len(hull) > 1 and _slope(hull[-2], point) <= _slope(hull[-2], hull[-1]):
            hull.pop()
        hull.append(point)
    middle = sum(x for x, _ in points) / len(points)
    edge = next((i for i in range(1, len(hull)) if hull[i][0] >= middle), 0)
    slope = _slope(hull[edge - 1], hull[edge]) if edge else 0.0
    slope = min(max(slope, -steepest), steepest)
    return min(y - slope * x for x, y in points), slope


def _slope(left: Point, right: Point) -> float:
    return (right[1] - left[1]) / (right[0] - left[0])
