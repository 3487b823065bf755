"""What emulated boards share: they sample in time, and fail on demand."""

import time
from abc import abstractmethod
from collections.abc import Callable

import numpy as np

from padforge.sense.recordings.processing.limits import Array, Indices

from padforge.sense.rig.emulators.serial_device import SerialDevice

Source = Callable[[Array], Array]
"""(n,) host times in s to (n, C) volts, C the inputs of the board or more than are asked for."""

OUT_BYTES = 65_536
"""So much waits for a host that is slow; what comes then is dropped, whole samples at a time."""

_PAUSE_S = 0.01


class SerialBoard(SerialDevice):
    """A board at a serial port."""

    def __init__(self, skew_ppm: float, seed: int) -> None:
        """Open the pseudo-terminal.

        Args:
            skew_ppm: how much longer a period is than it should be. seed: of the damage by `garble`.
        """
        super().__init__("board", seed)
        self._skew_ppm = skew_ppm
        self._started_s: float | None = None
        self._first = 0
        self._stalled = False

    def stall(self, stalled: bool = True) -> None:
        """Neither sample nor answer any more, as firmware that hangs; False is the restart of the board."""
        self._stalled = stalled

    def garble(self, probability: float) -> None:
        """Flip a bit of, drop or double each byte sent with `probability`."""
        self._garble = probability

    def truth_s(self, index: int | Indices) -> Array:
        """Host times at which the samples of these indices since the last start were complete."""
        if self._started_s is None:
            raise ValueError("the board is not sampling")
        return self._started_s + (np.asarray(index) + 1) * self._period_s() * (1 + self._skew_ppm * 1e-6)

    @abstractmethod
    def _period_s(self) -> float:
        """From sample to sample, by the board's clock."""

    @abstractmethod
    def _listen(self, data: bytes) -> None:
        """Take what the host sends."""

    @abstractmethod
    def _sample(self) -> None:
        """Queue the samples that are due, and count them in `_first`."""

    def _at_once(self) -> int:
        """Samples that are sent together."""
        return 1

    def _queue(self, data: bytes) -> None:
        self._out += self._damaged(data)

    def _turn(self, data: bytes) -> None:
        if self._stalled:
            self._started_s = None
            self._out.clear()
        else:
            if data:
                self._listen(data)
            self._sample()

    def _pause_s(self) -> float:
        if self._started_s is None:
            return _PAUSE_S
        due_s = float(self.truth_s(self._first + self._at_once() - 1))
        return min(max(due_s - time.monotonic(), 0.0), _PAUSE_S)
