"""Streams of live readings: a board's samples averaged to the rate of readings, or the replay of a recording."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from padforge.common.files import read_json
from padforge.common.validation import check_float
from padforge.sense.arrays import Array
from padforge.sense.localizer.features import REST, SLOW, interpolate_gaps
from padforge.sense.recording.recording import Recording, is_mirrored
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig import clock
from padforge.sense.rig.devices import Board, BoardSamples
from padforge.sense.settings import RigSettings

HISTORY = SLOW[-1]  # readings before a press that the history features depend on
SLACK = 4096  # readings beyond HISTORY, since a press is detected some readings after its start
PAUSE_S = 0.01  # between two polls of a board, or of the clock of a replay
RECORDED = "recording"  # name of the training recording in the folder of a model

Block = tuple[Array, Array]  # times (n,) in s, and readings (n, C) in V


class RingBuffer:
    """The latest rows of a stream, at least HISTORY + SLACK of them; they are indexed from the start of the stream."""

    def __init__(self, n_columns: int) -> None:
        self._rows = np.empty((2 * (HISTORY + SLACK), n_columns))
        self._filled = 0
        self.end = 0  # index of the next row

    def append(self, row: Array) -> None:
        """Add a row (columns,)."""
        if self._filled == len(self._rows):
            self._filled //= 2
            self._rows[: self._filled] = self._rows[self._filled :]
        self._rows[self._filled] = row
        self._filled += 1
        self.end += 1

    def rows(self, first: int, end: int) -> Array:
        """Return the rows first <= index < end that are still stored; a view, valid until the next `append`."""
        dropped = self.end - self._filled
        return self._rows[max(first - dropped, 0) : max(min(end - dropped, self._filled), 0)]

    def baseline(self, index: int) -> Array:
        """Return the mean (columns - 1,) of the readings just before an index; column 0 of the rows are times."""
        return interpolate_gaps(self.rows(index + REST[0], index)[:, 1:]).mean(axis=0)

    def command_index(self, reading: int, delay_s: float) -> int:
        """Return the index of the first reading at most `delay_s` before `reading`: when a probe was commanded."""
        times_s = self.rows(0, reading + 1)[:, 0]
        return reading + 1 - len(times_s) + int(np.searchsorted(times_s, times_s[-1] - delay_s))


class Averager:
    """Averages blocks of `ratio` samples. Lost samples are counted, so that they do not shift the blocks.

    A reading is the mean of the samples of its block that arrived; a block without any gives no reading.
    """

    def __init__(self, ratio: int, n_channels: int) -> None:
        self._ratio, self._index = ratio, 0
        self._pending = np.empty((0, 2 + n_channels))  # block, time, volts
        self.n_missing = 0  # samples that never arrived

    def feed(self, samples: BoardSamples) -> Block:
        """Return times (n,) and volts (n, C) of the completed blocks; samples of an incomplete block are stored."""
        counts = self._index + np.arange(len(samples.times_s)) + np.cumsum(samples.missing)
        n_missing = int(samples.missing.sum())
        self._index += len(counts) + n_missing
        self.n_missing += n_missing
        new = np.column_stack([counts // self._ratio, samples.times_s, samples.volts])
        rows = np.vstack([self._pending, new])
        complete = rows[:, 0] < self._index // self._ratio
        self._pending, rows = rows[~complete], rows[complete]
        _, first, count = np.unique(rows[:, 0], return_index=True, return_counts=True)
        means = np.add.reduceat(rows[:, 1:], first) / count[:, None]
        return means[:, 0], means[:, 1:]


@dataclass(frozen=True)
class ReadingStream:
    """Readings as they arrive."""

    fibres: int
    rate_hz: float
    blocks: Iterator[Block]  # which may be empty
    board: Mapping[str, Any] = field(default_factory=dict)  # its identity, empty if there is none


def stream_board(board: Board, rate_hz: float) -> ReadingStream:
    """Connect a board, and return the endless stream of its samples, averaged to about `rate_hz`."""
    identity = board.connect()
    ratio = max(1, round(identity["rate_hz"] / rate_hz))
    averager = Averager(ratio, identity["channels"])

    def blocks() -> Iterator[Block]:
        while True:
            yield averager.feed(board.read())
            clock.sleep(PAUSE_S)

    return ReadingStream(identity["channels"], identity["rate_hz"] / ratio, blocks(), identity)


def stream_recording(recording: Recording, speed: float) -> ReadingStream:
    """Return the replay of a recording, `speed` > 0 times as fast as it was recorded; InputError for other speeds."""
    speed = check_float("speed", speed, 1e-9, np.inf)
    due_s = (recording.times_s - recording.times_s[0]) / speed

    def blocks() -> Iterator[Block]:
        started_s, done = clock.now(), 0
        while done < len(due_s):
            due = int(np.searchsorted(due_s, clock.now() - started_s, side="right"))
            end = min(due, done + 64)  # short blocks, so that a fast replay can be watched
            yield recording.times_s[done:end], recording.readings[done:end]
            if end == due:
                clock.sleep(PAUSE_S)
            done = end

    return ReadingStream(recording.fibres, recording.rate_hz, blocks())


def is_pad_mirrored(model: Path, rig: RigSettings) -> bool:
    """Return whether the pad lies with its tracks up, so that x and y of its plan are right-handed with z into it.

    If `[rig]` does not state it, the pad is assumed to lie as in the training recording; InputError if that is damaged.
    """
    if rig.mirrored is not None:
        return rig.mirrored
    path = model / RECORDED / START
    return path.is_file() and is_mirrored(read_json(path, FORMAT).get("source"))
