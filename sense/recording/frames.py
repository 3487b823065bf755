"""Frames: readings of any rate, averaged over intervals of `FRAME_S`.

Windows of a localizer, the health model and the press detector are counted in frames, so that they mean the same at 5
and at 1000 readings a second, and further readings reduce the noise. In a recording, frames restart at every command of
the probe, so that no frame mixes readings from before and after it. In a stream, frames are consecutive.
"""

from dataclasses import replace

import numpy as np

from padforge.sense.arrays import Array
from padforge.sense.recording.recording import Recording

FRAME_S = 0.075  # length of a frame
MIN_PRESENT = 0.25  # minimum fraction of a frame with readings of a fibre; otherwise the fibre is missing in it


def framed(recording: Recording) -> Recording:
    """Return a recording, of any rate, with frames in place of readings and the same presses."""
    rate_hz = recording.rate_hz
    if is_as_read(rate_hz):
        return recording
    pauses_s = np.append(0.0, np.cumsum(_excess_s(np.diff(recording.times_s), rate_hz)))
    clock_s = recording.times_s - pauses_s  # clock without the excess of pauses
    edges = reading_edges(clock_s)
    # 1. Segments between commands; each has at least one frame unless it has no reading.
    commands = np.stack([recording.down_command, recording.up_command], axis=1).ravel()
    starts = np.concatenate([[0], commands, [len(recording.readings)]])
    start_s = edges[starts]
    counts = np.maximum(np.round(np.diff(start_s) / FRAME_S).astype(np.int64), np.diff(starts) > 0)
    # 2. Frames of FRAME_S within each segment; the last one of a segment ends with it.
    first = np.concatenate([[0], np.cumsum(counts)])
    number = np.arange(first[-1]) - np.repeat(first[:-1], counts)
    frame_edges = np.append(np.repeat(start_s[:-1], counts) + FRAME_S * number, start_s[-1])
    middle_s = (frame_edges[:-1] + frame_edges[1:]) / 2
    return replace(
        recording,
        readings=time_means(edges, recording.readings, frame_edges),
        times_s=middle_s + np.interp(middle_s, clock_s, pauses_s),
        down_command=first[1:-1:2],
        up_command=first[2:-1:2],
    )


class FrameStream:
    """Consecutive frames of a stream of readings of C fibres, as soon as they are complete."""

    def __init__(self, rate_hz: float, fibres: int) -> None:
        self._rate_hz = rate_hz
        self._start_s = np.nan  # of the next frame, by the clock without the excess of pauses
        # The last reading of the latest frame and all n readings after it:
        self._clock_s = np.empty(0)  # time by that clock; shape (n + 1,)
        self._pauses_s = np.empty(0)  # total excess until then; shape (n + 1,)
        self._readings = np.empty((0, fibres))  # shape (n + 1, C), V

    def feed(self, times_s: Array, readings: Array) -> tuple[Array, Array]:
        """Add readings (n, C), V, at ascending times (n,); return times (N,) and means (N, C) of complete frames."""
        if is_as_read(self._rate_hz) or not len(times_s):
            return times_s, readings
        if not len(self._clock_s):  # assume a missing reading before the first one
            self._clock_s, self._pauses_s = times_s[:1] - 1 / self._rate_hz, np.zeros(1)
            self._readings = np.full((1, readings.shape[1]), np.nan)
        # 1. Subtract the excess of pauses from the times.
        last_s = self._clock_s[-1] + self._pauses_s[-1]
        pauses_s = self._pauses_s[-1] + np.cumsum(_excess_s(np.diff(times_s, prepend=last_s), self._rate_hz))
        self._clock_s = np.append(self._clock_s, times_s - pauses_s)
        self._pauses_s = np.append(self._pauses_s, pauses_s)
        self._readings = np.vstack([self._readings, readings])
        # 2. Average the readings over the frames that are complete.
        edges = (self._clock_s[:-1] + self._clock_s[1:]) / 2  # the end of the last reading is unknown
        start_s = edges[0] if np.isnan(self._start_s) else self._start_s
        count = int((edges[-1] - start_s) / FRAME_S)
        frame_edges = start_s + FRAME_S * np.arange(count + 1)
        means = time_means(edges, self._readings[1:-1], frame_edges) if count else np.empty((0, readings.shape[1]))
        middle_s = (frame_edges[:-1] + frame_edges[1:]) / 2
        frame_s = middle_s + np.interp(middle_s, self._clock_s, self._pauses_s)
        # 3. Keep the last reading before the next frame, and all later ones.
        self._start_s = frame_edges[-1]
        n_done = int(np.searchsorted(edges, self._start_s, side="right")) - 1
        self._clock_s, self._pauses_s = self._clock_s[n_done:], self._pauses_s[n_done:]
        self._readings = self._readings[n_done:]
        return frame_s, means


def _excess_s(intervals_s: Array, rate_hz: float) -> Array:
    """Return by how much intervals (n,) between readings exceed 1 s, or 3 usual intervals if these are longer; (n,), s.

    Frames leave this excess out, so that hours in which a computer slept do not become frames.
    """
    return np.maximum(intervals_s - max(1.0, 3.0 / rate_hz), 0.0)


def frame_rate_hz(rate_hz: float) -> float:
    """Return the number of frames a second of readings at a rate."""
    return rate_hz if is_as_read(rate_hz) else 1 / FRAME_S


def is_as_read(rate_hz: float) -> bool:
    """Return whether each reading at a rate is a frame."""
    return 0.9 <= rate_hz * FRAME_S <= 1.1


def reading_edges(times_s: Array) -> Array:
    """Return the edges (R + 1,) of the intervals represented by readings at times (R,), half-way to neighbours."""
    middle = (times_s[:-1] + times_s[1:]) / 2
    half = float(np.median(np.diff(times_s))) / 2
    return np.concatenate([[times_s[0] - half], middle, [times_s[-1] + half]])


def time_means(edges: Array, readings: Array, frame_edges: Array) -> Array:
    """Average readings (R, C), constant between their edges (R + 1,), over frames with edges (N + 1,).

    Returns the means (N, C), NaN if less than `MIN_PRESENT` of a frame has readings.
    """
    present = ~np.isnan(readings)
    # The means are subtracted from the readings, so that long sums keep their precision.
    mean = np.where(present, readings, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
    width = np.diff(edges)[:, None]
    row = np.clip(np.searchsorted(edges, frame_edges, side="right") - 1, 0, len(readings) - 1)
    fraction = ((frame_edges - edges[row]) / np.diff(edges)[row]).clip(0, 1)[:, None]

    def integrate(values: Array) -> Array:
        """Return the integrals (N, C) of piecewise constant values (R, C) over the frames."""
        areas = width * values
        sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])
        return np.diff(sums[row] + fraction * areas[row], axis=0)

    present_s = integrate(present.astype(np.float64))
    total = integrate(np.where(present, readings - mean, 0.0))
    is_valid = present_s >= MIN_PRESENT * np.diff(frame_edges)[:, None]
    return np.divide(total, present_s, out=np.full(total.shape, np.nan), where=is_valid) + mean
