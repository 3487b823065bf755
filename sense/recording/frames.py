"""Frames: readings of any rate as means over FRAME_S, the time in which the features of a press are counted.

What a localizer, the health model and the press detector learn is counted in frames, so that they mean the same at 5
and at 1000 readings a second, and more readings are less noise. Of a recording, frames begin anew at every command of
the probe: a frame never mixes what was before with what came after. Of a stream, they follow each other.
"""

from dataclasses import replace

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording

FRAME_S = 0.075
"""Length of a frame, s."""
AS_READ = 0.9, 1.1
"""Readings per frame, by the median interval, that are taken as they are: each is a frame."""
MIN_PRESENT = 0.25
"""Share of a frame in which a fibre must have been read; else it is missing there."""
MAX_PAUSE_S, MAX_PAUSE = 1.0, 3.0
"""Longest time between two readings that frames are made of, s or, if that is longer, in intervals of the rate: of a
computer that slept for a night they have no more."""


def framed(recording: Recording) -> Recording:
    """Return a recording of frames in place of readings, with the same presses.

    Args:
        recording: of any rate.
    """
    rate_hz = recording.rate_hz
    if is_as_read(rate_hz):
        return recording
    pauses_s = np.append(0.0, np.cumsum(_excess_s(np.diff(recording.times_s), rate_hz)))
    clock_s = recording.times_s - pauses_s
    edges = reading_edges(clock_s)
    commands = np.stack([recording.down_command, recording.up_command], axis=1).ravel()
    starts = np.concatenate([[0], commands, [len(recording.readings)]])
    begin = edges[starts]
    counts = np.maximum(np.round(np.diff(begin) / FRAME_S).astype(np.int64), np.diff(starts) > 0)
    first = np.concatenate([[0], np.cumsum(counts)])
    number = np.arange(first[-1]) - np.repeat(first[:-1], counts)
    frame_edges = np.append(np.repeat(begin[:-1], counts) + FRAME_S * number, begin[-1])
    middle_s = (frame_edges[:-1] + frame_edges[1:]) / 2
    return replace(
        recording,
        readings=time_means(edges, recording.readings, frame_edges),
        times_s=middle_s + np.interp(middle_s, clock_s, pauses_s),
        down_command=first[1:-1:2],
        up_command=first[2:-1:2],
    )


class FrameStream:
    """Frames of a stream, one after the other, as soon as their readings have come.

    Args:
        rate_hz: readings per second.
        fibres: number of fibres, C.
    """

    def __init__(self, rate_hz: float, fibres: int) -> None:
        self._rate_hz, self._begin_s = rate_hz, np.nan  # begin of the next frame, by the clock without pauses
        # readings of frames that are to come, and the one before: that clock, pauses until then, volts
        self._pending = np.empty((0, 2 + fibres))

    def feed(self, times_s: Array, readings: Array) -> tuple[Array, Array]:
        """Take further readings; return the times (N,), s, and the means (N, C), V, of the frames that are complete.

        Args:
            times_s: ascending; shape (n,).
            readings: NaN where missing; shape (n, C), V.
        """
        if is_as_read(self._rate_hz) or not len(times_s):
            return times_s, readings
        if not len(self._pending):  # as if there had been a reading before
            self._pending = np.full((1, self._pending.shape[1]), np.nan)
            self._pending[0, :2] = times_s[0] - 1 / self._rate_hz, 0.0
        last_s, pause_s = self._pending[-1, :2].sum(), self._pending[-1, 1]
        pauses_s = pause_s + np.cumsum(_excess_s(np.diff(times_s, prepend=last_s), self._rate_hz))
        self._pending = np.vstack([self._pending, np.column_stack([times_s - pauses_s, pauses_s, readings])])
        clock_s, pauses_s = self._pending[:, :2].T
        edges = (clock_s[:-1] + clock_s[1:]) / 2  # the last reading has no end yet
        begin_s = edges[0] if np.isnan(self._begin_s) else self._begin_s
        count = int((edges[-1] - begin_s) / FRAME_S)
        frame_edges = begin_s + FRAME_S * np.arange(count + 1)
        means = time_means(edges, self._pending[1:-1, 2:], frame_edges) if count else np.empty((0, readings.shape[1]))
        self._begin_s = frame_edges[-1]
        used = int(np.searchsorted(edges, self._begin_s, side="right")) - 1  # readings that are over before it
        self._pending = self._pending[used:]
        middle_s = (frame_edges[:-1] + frame_edges[1:]) / 2
        return middle_s + np.interp(middle_s, clock_s, pauses_s), means


def _excess_s(intervals_s: Array, rate_hz: float) -> Array:
    """Return by how much intervals between readings are longer than frames are made of; shape as the intervals, s."""
    return np.maximum(intervals_s - max(MAX_PAUSE_S, MAX_PAUSE / rate_hz), 0.0)


def frame_rate_hz(rate_hz: float) -> float:
    """Return how many frames a second readings of a rate become."""
    return rate_hz if is_as_read(rate_hz) else 1 / FRAME_S


def is_as_read(rate_hz: float) -> bool:
    """Return whether readings of a rate are frames already."""
    low, high = AS_READ
    return low <= rate_hz * FRAME_S <= high


def reading_edges(times_s: Array) -> Array:
    """Return the (R + 1,) times between which each of (R,) readings stands for the signal: half-way to the next."""
    middle = (times_s[:-1] + times_s[1:]) / 2
    half = float(np.median(np.diff(times_s))) / 2
    return np.concatenate([[times_s[0] - half], middle, [times_s[-1] + half]])


def time_means(edges: Array, readings: Array, frame_edges: Array) -> Array:
    """Return the (N, C) means over time of (R, C) readings between N + 1 edges of frames, NaN where hardly any is."""
    present = ~np.isnan(readings)
    # subtracted, so that long sums keep their digits
    level = np.where(present, readings, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
    width = np.diff(edges)[:, None]
    row = np.clip(np.searchsorted(edges, frame_edges, side="right") - 1, 0, len(readings) - 1)
    share = ((frame_edges - edges[row]) / np.diff(edges)[row]).clip(0, 1)[:, None]

    def integrals(values: Array) -> Array:
        parts = width * values
        sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(parts, axis=0)])
        return np.diff(sums[row] + share * parts[row], axis=0)

    read_s = integrals(present.astype(np.float64))
    total = integrals(np.where(present, readings - level, 0.0))
    enough = read_s >= MIN_PRESENT * np.diff(frame_edges)[:, None]
    return np.divide(total, read_s, out=np.full(total.shape, np.nan), where=enough) + level
