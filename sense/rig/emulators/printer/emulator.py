"""A stand-in for the printer: a thread at the far end of a pseudo-terminal, which fails on demand. POSIX only."""

import os
import select
import threading
import time
from contextlib import suppress
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from sense.recordings.processing.limits import Array
from sense.rig.arms.printer.motion import Place

from .firmware import Firmware

_PAUSE_S = 0.005


class EmulatedPrinter:
    """The printer, running from `with` to its end, at the port `port`.

    Attributes:
        firmware: what it runs; to be looked at once the printer stands or is unplugged.
    """

    def __init__(self, at: Place, *, restarts: bool = False, seed: int = 0, **firmware: Any) -> None:
        """Open the pseudo-terminal.

        Args:
            at: where the nozzle stands. restarts: begin anew at the first sign of a host, as many boards do.
            seed: of the damage by `garble`. firmware: see `Firmware`.
        """
        import tty

        self.firmware, self._restarts = Firmware(at, **firmware), restarts
        self._rng, self._garble = np.random.default_rng(seed), 0.0
        self._lock = threading.Lock()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._out = bytearray()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name=f"printer at {self.port}", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def unplug(self) -> None:
        """Take the printer from its port, for good."""
        self._ending = True
        self._thread.join()

    def halt(self) -> None:
        """Let the firmware find something wrong and stop for good."""
        with self._lock:
            self.firmware.kill(time.monotonic())

    def restart(self) -> None:
        """Let the board begin anew: it no longer knows where it is."""
        with self._lock:
            self.firmware.restart(time.monotonic())

    def home(self) -> None:
        """What a person does at the display."""
        with self._lock:
            self.firmware.home()

    def busy(self, seconds: float) -> None:
        """Take no command for so long: somebody is at the display."""
        with self._lock:
            self.firmware.busy(time.monotonic() + seconds)

    def garble(self, probability: float) -> None:
        """Flip a bit of, drop or double each byte of both directions with `probability`."""
        self._garble = probability

    def nozzle_at(self, times_s: ArrayLike) -> Array:
        """(n, 3) true places of the nozzle at monotonic times (n,), mm."""
        times = np.atleast_1d(np.asarray(times_s, dtype=np.float64)).tolist()
        with self._lock:
            return np.array([self.firmware.at(time_s) for time_s in times]).reshape(-1, 3)

    def _run(self) -> None:
        try:
            while not self._ending:
                ready, _, _ = select.select([self._master], [], [], _PAUSE_S)
                data = self._damaged(os.read(self._master, 4096)) if ready else b""
                with self._lock:
                    now = time.monotonic()
                    if data and self._restarts:
                        self._restarts, data = False, b""
                        self.firmware.restart(now)
                    self.firmware.hear(data, now)
                    self._out += self._damaged(self.firmware.speak(now))
                if self._out:
                    with suppress(BlockingIOError):
                        del self._out[: os.write(self._master, self._out)]
        finally:
            os.close(self._slave)
            os.close(self._master)

    def _damaged(self, data: bytes) -> bytes:
        if not self._garble:
            return data
        damaged = bytearray()
        for byte, hit in zip(data, self._rng.random(len(data)) < self._garble, strict=True):
            fate = self._rng.integers(3) if hit else 3
            damaged += (bytes([byte ^ 1 << int(self._rng.integers(8))]), b"", bytes([byte, byte]), bytes([byte]))[fate]
        return bytes(damaged)
