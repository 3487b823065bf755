"""A stand-in for the printer, which fails on demand."""

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from padforge.sense.recordings.processing.limits import Array
from padforge.sense.rig.arms.printer.motion import Place
from padforge.sense.rig.emulators.serial_device import SerialDevice

from padforge.sense.rig.emulators.printer.firmware import Firmware

_PAUSE_S = 0.005


class EmulatedPrinter(SerialDevice):
    """The printer at a serial port.

    Attributes:
        firmware: what it runs; to be looked at once the printer stands or is unplugged.
    """

    def __init__(self, at: Place, *, restarts: bool = False, seed: int = 0, **firmware: Any) -> None:
        """Open the pseudo-terminal.

        Args:
            at: where the nozzle stands. restarts: begin anew at the first sign of a host, as many boards do.
            seed: of the damage by `garble`. firmware: see `Firmware`.
        """
        super().__init__("printer", seed)
        self.firmware, self._restarts = Firmware(at, **firmware), restarts
        self._lock = threading.Lock()

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

    def _turn(self, data: bytes) -> None:
        data = self._damaged(data)
        with self._lock:
            now = time.monotonic()
            if data and self._restarts:
                self._restarts, data = False, b""
                self.firmware.restart(now)
            self.firmware.hear(data, now)
            self._out += self._damaged(self.firmware.speak(now))

    def _pause_s(self) -> float:
        return _PAUSE_S
