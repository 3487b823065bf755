"""What emulated devices at serial ports share: a thread at the far end of a pseudo-terminal, and noise.
POSIX only.

What emulated boards share: they sample in time, and fail on demand.

A stand-in for the Arduino Due, which speaks as its firmware does.
What it samples comes from a function of time, so that one simulated pad can be behind it and behind a simulated arm.
It samples by the host's clock at a rate that may be off by some ppm, and fails on demand. POSIX only.

A stand-in for a board that speaks the line protocol; see `due_board` for what is behind it. POSIX only.
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

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig.boards import due_framing as framing
from padforge.sense.rig.boards.due_framing import (
    FULL_SCALE,
    MAX_CHANNELS,
    Ack,
    BoardSettings,
    DueBlock,
    Identity,
    Kind,
    Status,
)
from padforge.sense.rig.boards.line_framing import ASK, LineHeader, header_line, sample_line


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


MIN_NS_PER_CONVERSION = 6000
MAX_PERIOD_NS = 1_000_000_000
BLOCK_NS = 20_000_000
"""A block is sent after so much time at the latest, or when it holds a single sample."""


class EmulatedBoard(SerialBoard):
    """The board, running from `with` to its end, at the port `port`."""

    def __init__(
        self,
        source: Source,
        *,
        supply_v: float = 3.3,
        skew_ppm: float = 0.0,
        firmware: tuple[int, int, int] = (1, 0, 0),
        silent: bool = False,
        seed: int = 0,
    ) -> None:
        """Open the pseudo-terminal.

        Args:
            source: what the inputs read. supply_v: reading at full scale. skew_ppm: how much longer a period is.
            firmware: version it says it has. silent: answer nothing. seed: of the damage by `garble`.
        """
        super().__init__(skew_ppm, seed)
        self._source, self._supply_v = source, supply_v
        serial = b"emulated board".ljust(16, b"\0")
        self._identity = Identity(firmware, framing.BITS, MAX_CHANNELS, "padforge-due", serial)
        self._silent = silent
        self._decoder = framing.DueDecoder()
        self._settings = BoardSettings(1_000_000, 0xFF, 1)
        self._sequence = self._overruns = self._overrun_asked = 0
        self._halting = False

    def halt(self) -> None:
        """Stop and say that conversions were lost."""
        self._halting = True

    def overrun(self, samples: int) -> None:
        """Drop the next `samples` samples, up to whole blocks."""
        self._overrun_asked += samples

    def _period_s(self) -> float:
        return self._settings.period_ns * 1e-9

    def _listen(self, data: bytes) -> None:
        for frame in self._decoder.feed(data):
            if not self._silent and (answer := self._answer(frame)) is not None:
                self._queue(framing.encode(answer))

    def _answer(self, frame: framing.Frame) -> Identity | Ack | None:
        status = Status.OK
        if isinstance(frame, BoardSettings):
            status = Status.RUNNING if self._started_s is not None else judge_settings(frame)
            if status == Status.OK:
                self._settings = frame
            return Ack(Kind.SETTINGS, status, self._settings)
        if not isinstance(frame, framing.Request):
            return None
        if frame.kind == Kind.IDENTIFY:
            return self._identity
        if frame.kind == Kind.STOP:
            self._started_s = None
        elif self._started_s is None:
            self._first = self._sequence = self._overruns = 0
            self._started_s = time.monotonic()
        return Ack(frame.kind, status, self._settings)

    def _sample(self) -> None:
        if self._halting:
            self._halting, self._started_s = False, None
            self._queue(framing.encode(Ack(Kind.STOP, Status.HALTED, self._settings)))
        samples = self._at_once()
        while self._started_s is not None:
            index = self._first + np.arange(samples)
            times_s = self.truth_s(index)
            if times_s[-1] > time.monotonic():
                return
            self._first += samples
            if self._overrun_asked > 0 or len(self._out) > OUT_BYTES:
                self._overrun_asked = max(self._overrun_asked - samples, 0)
                self._overruns += samples
            else:
                self._queue(framing.encode(self._block(int(index[0]), times_s)))

    def _at_once(self) -> int:
        return min(max(BLOCK_NS // self._settings.period_ns, 1), framing.MAX_SAMPLES)

    def _block(self, first: int, times_s: Array) -> DueBlock:
        mask, averaging = self._settings.mask, self._settings.averaging
        inputs = [i for i in range(MAX_CHANNELS) if mask >> i & 1]
        steps = np.clip(np.rint(self._source(times_s)[:, inputs] / self._supply_v * FULL_SCALE), 0, FULL_SCALE)
        time_us = (first + len(times_s)) * self._settings.period_ns // 1000
        numbers = (self._sequence % 2**16, first % 2**32, time_us % 2**32, self._overruns)
        self._sequence += 1
        return DueBlock((steps * averaging).astype(np.uint16), averaging, mask, *numbers)


def judge_settings(settings: BoardSettings) -> Status:
    """What the board says to settings."""
    mask, averaging, period_ns = settings.mask, settings.averaging, settings.period_ns
    possible = 0 < mask < 1 << MAX_CHANNELS and 1 <= averaging <= framing.MAX_AVERAGING
    if not (possible and 0 < period_ns <= MAX_PERIOD_NS):
        return Status.BAD_SETTINGS
    return Status.TOO_FAST if period_ns < averaging * mask.bit_count() * MIN_NS_PER_CONVERSION else Status.OK


class EmulatedLineBoard(SerialBoard):
    """The board, running from `with` to its end, at the port `port`.

    Attributes:
        dropped: lines that were left out because the host was too slow.
    """

    def __init__(
        self,
        source: Source,
        header: LineHeader,
        *,
        boot_us: int = 0,
        skew_ppm: float = 0.0,
        silent: bool = False,
        seed: int = 0,
    ) -> None:
        """Open the pseudo-terminal.

        Args:
            source: what the inputs read. header: what it says of itself. boot_us: its time as it starts.
            skew_ppm: how much longer a period is. silent: answer nothing. seed: of the damage by `garble`.
        """
        super().__init__(skew_ppm, seed)
        self._source, self._header, self._boot_us, self._silent = source, header, boot_us, silent
        self._columns, self.dropped = header.channels, 0

    def reset(self) -> None:
        """Start anew, as by its button."""
        self._started_s = None

    def send_columns(self, columns: int) -> None:
        """Send so many counts a line from now on."""
        self._columns = columns

    def _period_s(self) -> float:
        return 1 / self._header.rate_hz

    def _listen(self, data: bytes) -> None:
        if ASK in data and not self._silent:
            self._queue(header_line(self._header))

    def _sample(self) -> None:
        if self._silent:
            return
        if self._started_s is None:
            self._started_s, self._first = time.monotonic(), 0
            self._queue(header_line(self._header))
        last = int((time.monotonic() - self._started_s) / float(self.truth_s(0) - self._started_s))
        index = np.arange(self._first, last)
        if len(index) == 0:
            return
        self._first = last
        scale = self._header.full_scale
        volts = self._source(self.truth_s(index))[:, : self._columns]
        counts = np.clip(np.rint(volts / self._header.reference_v * scale), 0, scale).astype(np.int64)
        for k, row in zip(index.tolist(), counts.tolist(), strict=True):
            if len(self._out) > OUT_BYTES:
                self.dropped += 1
                continue
            time_us = self._boot_us + round((k + 1) * 1e6 * self._period_s())
            self._queue(sample_line(time_us % 2**32, row, self._header.checked))
