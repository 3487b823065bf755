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


def framed(recording: Recording) -> Recording:
    """Return a recording of frames in place of readings, with the same presses.

    Args:
        recording: of any rate.
    """
    if is_as_read(recording.rate_hz):
        return recording
    edges = reading_edges(recording.times_s)
    commands = np.stack([recording.down_command, recording.up_command], axis=1).ravel()
    starts = np.concatenate([[0], commands, [len(recording.readings)]])
    begin = edges[starts]
    counts = np.maximum(np.round(np.diff(begin) / FRAME_S).astype(np.int64), np.diff(starts) > 0)
    first = np.concatenate([[0], np.cumsum(counts)])
    number = np.arange(first[-1]) - np.repeat(first[:-1], counts)
    frame_edges = np.append(np.repeat(begin[:-1], counts) + FRAME_S * number, begin[-1])
    return replace(
        recording,
        readings=time_means(edges, recording.readings, frame_edges),
        times_s=(frame_edges[:-1] + frame_edges[1:]) / 2,
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
        self._is_as_read, self._interval_s = is_as_read(rate_hz), 1 / rate_hz
        self._times, self._rows = np.empty(0), np.empty((0, fibres))  # readings of frames that are to come
        self._before_s = self._begin_s = np.nan  # time of the reading before these, and begin of the next frame

    def feed(self, times_s: Array, readings: Array) -> tuple[Array, Array]:
        """Take further readings; return the times (N,), s, and the means (N, C), V, of the frames that are complete.

        Args:
            times_s: ascending; shape (n,).
            readings: NaN where missing; shape (n, C), V.
        """
        if self._is_as_read or not len(times_s):
            return times_s, readings
        if np.isnan(self._begin_s):
            self._before_s = times_s[0] - self._interval_s
            self._begin_s = times_s[0] - self._interval_s / 2
        self._times, self._rows = np.concatenate([self._times, times_s]), np.concatenate([self._rows, readings])
        first_s = (self._times[0] + self._before_s) / 2
        edges = np.concatenate([[first_s], (self._times[:-1] + self._times[1:]) / 2])  # the last reading has no end yet
        count = int((edges[-1] - self._begin_s) / FRAME_S)
        frame_edges = self._begin_s + FRAME_S * np.arange(count + 1)
        means = time_means(edges, self._rows[:-1], frame_edges) if count else self._rows[:0]
        self._begin_s = frame_edges[-1]
        used = int(np.searchsorted(edges, self._begin_s, side="right")) - 1  # readings that are over before it
        if used:
            self._before_s = self._times[used - 1]
            self._times, self._rows = self._times[used:], self._rows[used:]
        return (frame_edges[:-1] + frame_edges[1:]) / 2, means


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
