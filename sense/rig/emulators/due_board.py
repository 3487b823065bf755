"""A stand-in for the board: a thread at the far end of a pseudo-terminal that speaks as the firmware does.

What it samples comes from a function of time, so that one simulated pad can be behind it and behind a simulated arm.
It samples by the host's clock at a rate that may be off by some ppm, and fails on demand. POSIX only.
"""

import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Self

import numpy as np

from sense.recordings.processing.limits import Array, Indices
from sense.rig.boards.due import framing
from sense.rig.boards.due.framing import FULL_SCALE, MAX_CHANNELS, Ack, Block, BoardSettings, Identity, Kind, Status

Source = Callable[[Array], Array]
"""(n,) host times in s to (n, C) volts, C the inputs of the board or more than are asked for."""

MIN_NS_PER_CONVERSION = 6000
MAX_PERIOD_NS = 1_000_000_000
BLOCK_NS = 20_000_000
"""A block is sent after so much time at the latest, or when it holds a single sample."""

_OUT_BYTES = 16_384
_PAUSE_S = 0.01


class EmulatedBoard:
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
        import tty

        self._source, self._supply_v, self._skew_ppm = source, supply_v, skew_ppm
        serial = b"emulated board".ljust(16, b"\0")
        self._identity = Identity(firmware, framing.BITS, MAX_CHANNELS, "padforge-due", serial)
        self._silent = silent
        self._rng = np.random.default_rng(seed)
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._decoder = framing.Decoder()
        self._out = bytearray()
        self._settings = BoardSettings(1_000_000, 0xFF, 1)
        self._started_s: float | None = None
        self._first = self._sequence = self._overruns = 0
        self._overrun_asked, self._garble = 0, 0.0
        self._stalled = self._halting = self._ending = False
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

    def halt(self) -> None:
        """Stop and say that conversions were lost."""
        self._halting = True

    def garble(self, probability: float) -> None:
        """Flip a bit of, drop or double each byte sent with `probability`."""
        self._garble = probability

    def overrun(self, samples: int) -> None:
        """Drop the next `samples` samples, up to whole blocks."""
        self._overrun_asked += samples

    def truth_s(self, index: int | Indices) -> Array:
        """Host times at which the samples of these indices since the last start were complete."""
        if self._started_s is None:
            raise ValueError("the board is not sampling")
        return self._started_s + (np.asarray(index) + 1) * self._period_s()

    def _period_s(self) -> float:
        return self._settings.period_ns * 1e-9 * (1 + self._skew_ppm * 1e-6)

    def _run(self) -> None:
        try:
            while not self._ending:
                ready, _, _ = select.select([self._master], [], [], self._pause_s())
                if ready:
                    self._listen()
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
        started_s = self._started_s
        if started_s is None:
            return _PAUSE_S
        due_s = started_s + (self._first + self._block_samples()) * self._period_s()
        return min(max(due_s - time.monotonic(), 0.0), _PAUSE_S)

    def _listen(self) -> None:
        frames = self._decoder.feed(os.read(self._master, 4096))
        if not self._silent and not self._stalled:
            for frame in frames:
                if (answer := self._answer(frame)) is not None:
                    self._queue(answer)

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
            self._queue(Ack(Kind.STOP, Status.HALTED, self._settings))
        samples = self._block_samples()
        while self._started_s is not None:
            index = self._first + np.arange(samples)
            times_s = self.truth_s(index)
            if times_s[-1] > time.monotonic():
                return
            self._first += samples
            if self._overrun_asked > 0 or len(self._out) > _OUT_BYTES:
                self._overrun_asked = max(self._overrun_asked - samples, 0)
                self._overruns += samples
            else:
                self._queue(self._block(int(index[0]), times_s))

    def _block_samples(self) -> int:
        return min(max(BLOCK_NS // self._settings.period_ns, 1), framing.MAX_SAMPLES)

    def _block(self, first: int, times_s: Array) -> Block:
        mask, averaging = self._settings.mask, self._settings.averaging
        inputs = [i for i in range(MAX_CHANNELS) if mask >> i & 1]
        steps = np.clip(np.rint(self._source(times_s)[:, inputs] / self._supply_v * FULL_SCALE), 0, FULL_SCALE)
        time_us = (first + len(times_s)) * self._settings.period_ns // 1000
        numbers = (self._sequence % 2**16, first % 2**32, time_us % 2**32, self._overruns)
        self._sequence += 1
        return Block((steps * averaging).astype(np.uint16), averaging, mask, *numbers)

    def _queue(self, frame: framing.Frame) -> None:
        data = framing.encode(frame)
        self._out += self._damaged(data) if self._garble else data

    def _damaged(self, data: bytes) -> bytes:
        damaged = bytearray()
        for byte, hit in zip(data, self._rng.random(len(data)) < self._garble, strict=True):
            fate = self._rng.integers(3) if hit else 3
            damaged += (bytes([byte ^ 1 << int(self._rng.integers(8))]), b"", bytes([byte, byte]), bytes([byte]))[fate]
        return bytes(damaged)

    def _send(self) -> None:
        if self._out:
            with suppress(BlockingIOError):
                del self._out[: os.write(self._master, self._out)]


def judge_settings(settings: BoardSettings) -> Status:
    """What the board says to settings."""
    mask, averaging, period_ns = settings.mask, settings.averaging, settings.period_ns
    possible = 0 < mask < 1 << MAX_CHANNELS and 1 <= averaging <= framing.MAX_AVERAGING
    if not (possible and 0 < period_ns <= MAX_PERIOD_NS):
        return Status.BAD_SETTINGS
    return Status.TOO_FAST if period_ns < averaging * mask.bit_count() * MIN_NS_PER_CONVERSION else Status.OK
