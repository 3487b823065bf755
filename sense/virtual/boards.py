"""Emulated boards at pseudo-terminals: an Arduino Due, and a board that speaks the line protocol. POSIX only.

What they sample is a function of time, so that one simulated pad can be behind a board and an emulated arm. They sample
by the host's clock, at a rate that may be off by some ppm, and fail on demand.
"""

import os
import select
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Self

import numpy as np

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig import clock
from padforge.sense.rig.boards import due as framing
from padforge.sense.rig.boards.due import SUPPLY_V, Ack, BoardSettings, DueBlock, Identity, Kind, Status
from padforge.sense.rig.boards.line_board import HEADER_REQUEST, LineHeader, format_header, format_sample

SampleSource = Callable[[Array], Array]
"""(n,) host times in s to (n, C) volts, C the number of inputs of the board or more."""

MAX_OUT_BYTES = 65_536  # bytes that wait for a slow host; what comes then is dropped, whole samples at a time
MIN_NS_PER_CONVERSION = 6000
MAX_PERIOD_NS = 1_000_000_000
BLOCK_NS = 20_000_000  # A block of the Due holds this much time, or a single sample

_POLL_S = 0.01


class SerialDevice(ABC):
    """A device at the port `port`, a pseudo-terminal, from `with` to its end."""

    def __init__(self, name: str, seed: int) -> None:
        """Open the pseudo-terminal; `seed` is of the noise of `garble`."""
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
        """Remove the device from its port, for good."""
        self._ending = True
        self._thread.join()

    def garble(self, probability: float) -> None:
        """Flip a bit of, drop or double each byte with `probability`."""
        self._garble = probability

    @abstractmethod
    def _step(self, data: bytes) -> None:
        """Process what the host has sent, possibly nothing, and add to `_out` what is to be sent."""

    def _wait_s(self) -> float:
        """Return the longest wait for the host before the next step."""
        return _POLL_S

    def _run(self) -> None:
        try:
            while not self._ending:
                ready, _, _ = select.select([self._master], [], [], self._wait_s())
                self._step(os.read(self._master, 4096) if ready else b"")
                if self._out:
                    with suppress(BlockingIOError):
                        del self._out[: os.write(self._master, self._out)]
        finally:
            os.close(self._slave)
            os.close(self._master)

    def _add_noise(self, data: bytes) -> bytes:
        if not self._garble:
            return data
        noisy = bytearray(data)
        for at in np.flatnonzero(self._rng.random(len(data)) < self._garble)[::-1].tolist():
            byte, kind = data[at], int(self._rng.integers(3))
            noisy[at : at + 1] = (bytes([byte ^ 1 << int(self._rng.integers(8))]), b"", bytes([byte, byte]))[kind]
        return bytes(noisy)


class SerialBoard(SerialDevice):
    """A board at a serial port; the noise of `garble` is on what it sends."""

    def __init__(self, skew_ppm: float, seed: int) -> None:
        """Open the pseudo-terminal; `skew_ppm` is how much longer a period is than nominal."""
        super().__init__("board", seed)
        self._skew_ppm = skew_ppm
        self._start_s: float | None = None
        self._first = 0  # index of the next sample
        self._stalled = False

    def stall(self, stalled: bool = True) -> None:
        """Neither sample nor answer any more, as firmware that hangs; False restarts the board."""
        self._stalled = stalled

    def true_times(self, index: int | Indices) -> Array:
        """Return the host times at which samples since the last start were complete."""
        if self._start_s is None:
            raise ValueError("the board is not sampling")
        return self._start_s + (np.asarray(index) + 1) * self._period_s() * (1 + self._skew_ppm * 1e-6)

    @abstractmethod
    def _period_s(self) -> float:
        """Return the sampling period by the board's clock."""

    @abstractmethod
    def _process(self, data: bytes) -> None:
        """Process what the host sends."""

    @abstractmethod
    def _sample(self) -> None:
        """Send the samples that are due, and advance `_first`."""

    def _block_size(self) -> int:
        """Return the number of samples that are sent together."""
        return 1

    def _send(self, data: bytes) -> None:
        self._out += self._add_noise(data)

    def _step(self, data: bytes) -> None:
        if self._stalled:
            self._start_s = None
            self._out.clear()
        else:
            if data:
                self._process(data)
            self._sample()

    def _wait_s(self) -> float:
        if self._start_s is None:
            return _POLL_S
        due_s = float(self.true_times(self._first + self._block_size() - 1))
        return min(max(due_s - clock.now(), 0.0), _POLL_S)


class EmulatedDue(SerialBoard):
    """An Arduino Due with padforge's firmware."""

    def __init__(
        self,
        source: SampleSource,
        *,
        skew_ppm: float = 0.0,
        firmware: tuple[int, int, int] = (1, 0, 0),
        silent: bool = False,
        seed: int = 0,
    ) -> None:
        """Open the pseudo-terminal; a `silent` board answers nothing."""
        super().__init__(skew_ppm, seed)
        self._source = source
        serial = b"emulated board".ljust(16, b"\0")
        self._identity = Identity(firmware, framing.BITS, framing.MAX_CHANNELS, "padforge-due", serial)
        self._silent = silent
        self._decoder = framing.DueDecoder()
        self._settings = BoardSettings(1_000_000, 0xFF, 1)
        self._sequence = self._overruns = self._n_to_drop = 0
        self._halting = False

    def halt(self) -> None:
        """Stop and report that conversions were lost."""
        self._halting = True

    def overrun(self, samples: int) -> None:
        """Drop the next samples, rounded up to blocks."""
        self._n_to_drop += samples

    def _period_s(self) -> float:
        return self._settings.period_ns * 1e-9

    def _process(self, data: bytes) -> None:
        for message in self._decoder.decode(data):
            if not self._silent and (answer := self._answer(message)) is not None:
                self._send(framing.encode(answer))

    def _answer(self, message: framing.DueMessage) -> Identity | Ack | None:
        if isinstance(message, BoardSettings):
            status = Status.RUNNING if self._start_s is not None else check_settings(message)
            if status == Status.OK:
                self._settings = message
            return Ack(Kind.SETTINGS, status, self._settings)
        if not isinstance(message, framing.Request):
            return None
        if message.kind == Kind.IDENTIFY:
            return self._identity
        if message.kind == Kind.STOP:
            self._start_s = None
        elif self._start_s is None:
            self._first = self._sequence = self._overruns = 0
            self._start_s = clock.now()
        return Ack(message.kind, Status.OK, self._settings)

    def _sample(self) -> None:
        if self._halting:
            self._halting, self._start_s = False, None
            self._send(framing.encode(Ack(Kind.STOP, Status.HALTED, self._settings)))
        samples = self._block_size()
        while self._start_s is not None:
            index = self._first + np.arange(samples)
            times_s = self.true_times(index)
            if times_s[-1] > clock.now():
                return
            self._first += samples
            if self._n_to_drop > 0 or len(self._out) > MAX_OUT_BYTES:
                self._n_to_drop = max(self._n_to_drop - samples, 0)
                self._overruns += samples
            else:
                self._send(framing.encode(self._block(int(index[0]), times_s)))

    def _block_size(self) -> int:
        return min(max(BLOCK_NS // self._settings.period_ns, 1), framing.MAX_SAMPLES)

    def _block(self, first: int, times_s: Array) -> DueBlock:
        mask, averaging = self._settings.mask, self._settings.averaging
        inputs = [i for i in range(framing.MAX_CHANNELS) if mask >> i & 1]
        volts, full_scale = self._source(times_s)[:, inputs], framing.FULL_SCALE
        steps = np.clip(np.rint(volts / SUPPLY_V * full_scale), 0, full_scale)
        time_us = (first + len(times_s)) * self._settings.period_ns // 1000
        numbers = (self._sequence % 2**16, first % 2**32, time_us % 2**32, self._overruns)
        self._sequence += 1
        return DueBlock((steps * averaging).astype(np.uint16), averaging, mask, *numbers)


def check_settings(settings: BoardSettings) -> Status:
    """Return the status with which the firmware answers settings."""
    mask, averaging, period_ns = settings.mask, settings.averaging, settings.period_ns
    valid = 0 < mask < 1 << framing.MAX_CHANNELS and 1 <= averaging <= framing.MAX_AVERAGING
    if not (valid and 0 < period_ns <= MAX_PERIOD_NS):
        return Status.BAD_SETTINGS
    return Status.TOO_FAST if period_ns < averaging * mask.bit_count() * MIN_NS_PER_CONVERSION else Status.OK


class EmulatedLineBoard(SerialBoard):
    """A board that speaks the line protocol."""

    def __init__(
        self,
        source: SampleSource,
        header: LineHeader,
        *,
        skew_ppm: float = 0.0,
        silent: bool = False,
        seed: int = 0,
    ) -> None:
        """Open the pseudo-terminal; a `silent` board sends nothing."""
        super().__init__(skew_ppm, seed)
        self._source, self._header, self._silent = source, header, silent
        self._columns = header.channels
        self._resetting = False

    def reset(self) -> None:
        """Start anew, as by its button."""
        self._resetting = True  # done by the board's own thread, for which the start must not vanish within a step

    def send_columns(self, columns: int) -> None:
        """Send this number of counts a line from now on."""
        self._columns = columns

    def _period_s(self) -> float:
        return 1 / self._header.rate_hz

    def _process(self, data: bytes) -> None:
        if HEADER_REQUEST in data and not self._silent:
            self._send(format_header(self._header))

    def _sample(self) -> None:
        if self._silent:
            return
        if self._start_s is None or self._resetting:
            self._resetting = False
            self._start_s, self._first = clock.now(), 0
            self._send(format_header(self._header))
        end = int((clock.now() - self._start_s) / float(self.true_times(0) - self._start_s))
        index = np.arange(self._first, end)
        if len(index) == 0:
            return
        self._first = end
        scale = self._header.full_scale
        volts = self._source(self.true_times(index))[:, : self._columns]
        counts = np.clip(np.rint(volts / self._header.reference_v * scale), 0, scale).astype(np.int64)
        for k, row in zip(index.tolist(), counts.tolist(), strict=True):
            if len(self._out) > MAX_OUT_BYTES:
                break
            time_us = round((k + 1) * 1e6 * self._period_s())
            self._send(format_sample(time_us % 2**32, row, self._header.checked))
