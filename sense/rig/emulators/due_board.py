"""A stand-in for the Arduino Due, which speaks as its firmware does.

What it samples comes from a function of time, so that one simulated pad can be behind it and behind a simulated arm.
It samples by the host's clock at a rate that may be off by some ppm, and fails on demand. POSIX only.
"""

import time

import numpy as np

from padforge.sense.recordings.processing.limits import Array
from padforge.sense.rig.boards.due import framing
from padforge.sense.rig.boards.due.framing import (
    FULL_SCALE,
    MAX_CHANNELS,
    Ack,
    BoardSettings,
    DueBlock,
    Identity,
    Kind,
    Status,
)

from padforge.sense.rig.emulators.serial_board import OUT_BYTES, SerialBoard, Source

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
