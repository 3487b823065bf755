"""What emulated boards share: a thread at the far end of a pseudo-terminal that samples in time and fails on demand.

POSIX only.
"""

import os
import select
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Self

import numpy as np

from sense.recordings.processing.limits import Array, Indices

Source = Callable[[Array], Array]
"""(n,) host times in s to (n, C) volts, C the inputs of the board or more than are asked for."""

OUT_BYTES = 65_536
"""So much waits for a host that is slow; what comes then is dropped, whole samples at a time."""

_PAUSE_S = 0.01


class SerialBoard(ABC):
    """A board, running from `with` to its end, at the port `port`."""

    def __init__(self, skew_ppm: float, seed: int) -> None:
        """Open the pseudo-terminal.

        Args:
            skew_ppm: how much longer a period is than it should be. seed: of the damage by `garble`.
        """
        import tty

        self._skew_ppm = skew_ppm
        self._rng = np.random.default_rng(seed)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._out = bytearray()
        self._started_s: float | None = None
        self._first = 0
        self._garble = 0.0
        self._stalled = self._ending = False
        self._thread = threading.Thread(target=self._run, name=f"board at {self.port}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def unplug(self) -> None:
        """Take the board from its port, for good."""
        self._ending = True
        self._thread.join()

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
        self._out += self._damaged(data) if self._garble else data

    def _run(self) -> None:
        try:
            while not self._ending:
                ready, _, _ = select.select([self._master], [], [], self._pause_s())
                if ready and (data := os.read(self._master, 4096)) and not self._stalled:
                    self._listen(data)
                if self._stalled:
                    self._started_s = None
                    self._out.clear()
                else:
                    self._sample()
                    self._send()
        finally:
            os.close(self._slave)
            os.close(self._master)

    def _pause_s(self) -> float:
        if self._started_s is None:
            return _PAUSE_S
        due_s = float(self.truth_s(self._first + self._at_once() - 1))
        return min(max(due_s - time.monotonic(), 0.0), _PAUSE_S)

    def _damaged(self, data: bytes) -> bytes:
        damaged = bytearray(data)
        for at in np.flatnonzero(self._rng.random(len(data)) < self._garble)[::-1].tolist():
            byte, fate = data[at], int(self._rng.integers(3))
            damaged[at : at + 1] = (bytes([byte ^ 1 << int(self._rng.integers(8))]), b"", bytes([byte, byte]))[fate]
        return bytes(damaged)

    def _send(self) -> None:
        if self._out:
            with suppress(BlockingIOError):
                del self._out[: os.write(self._master, self._out)]
