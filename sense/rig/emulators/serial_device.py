"""What emulated devices at serial ports share: a thread at the far end of a pseudo-terminal, and noise.

POSIX only.
"""

import os
import select
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Self

import numpy as np


class SerialDevice(ABC):
    """A device, running from `with` to its end, at the port `port`."""

    def __init__(self, name: str, seed: int) -> None:
        """Open the pseudo-terminal; `seed` is of the damage by `garble`."""
        import tty

        self._rng, self._garble = np.random.default_rng(seed), 0.0
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._out: bytearray = bytearray()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name=f"{name} at {self.port}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def unplug(self) -> None:
        """Take the device from its port, for good."""
        self._ending = True
        self._thread.join()

    @abstractmethod
    def _turn(self, data: bytes) -> None:
        """Take what the host has sent, which may be nothing, and add to `_out` what is to be sent."""

    @abstractmethod
    def _pause_s(self) -> float:
        """Longest wait for the host before the next turn."""

    def _run(self) -> None:
        try:
            while not self._ending:
                ready, _, _ = select.select([self._master], [], [], self._pause_s())
                self._turn(os.read(self._master, 4096) if ready else b"")
                if self._out:
                    with suppress(BlockingIOError):
                        del self._out[: os.write(self._master, self._out)]
        finally:
            os.close(self._slave)
            os.close(self._master)

    def _damaged(self, data: bytes) -> bytes:
        if not self._garble:
            return data
        damaged = bytearray(data)
        for at in np.flatnonzero(self._rng.random(len(data)) < self._garble)[::-1].tolist():
            byte, fate = data[at], int(self._rng.integers(3))
            damaged[at : at + 1] = (bytes([byte ^ 1 << int(self._rng.integers(8))]), b"", bytes([byte, byte]))[fate]
        return bytes(damaged)
