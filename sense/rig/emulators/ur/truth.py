"""Where the tip of the emulated arm really was, in a file that several processes map: one writer, any readers."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.recordings.processing.limits import Array, Indices

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
