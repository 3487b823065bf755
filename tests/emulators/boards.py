"""Emulated boards at pseudo-terminals, which speak the line protocol and fail on demand. POSIX only.

What they sample is a function of time, so that one simulated pad can be behind a board and an emulated arm.
"""

import os
import select
import threading
from abc import ABC, abstractmethod
from binascii import crc32
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Self

import numpy as np

from padforge.sense.arrays import Array, Indices
from padforge.sense.rig import clock
from padforge.sense.rig.boards.line_board import HEADER_REQUEST, LineHeader
from padforge.sense.simulation.pad_model import SUPPLY_V

SampleSource = Callable[[Array], Array]
"""(n,) host times in s to (n, C) volts, C the number of inputs of the board or more."""

MAX_OUT_BYTES = 65_536  # bytes that wait for a slow host; what comes then is dropped, whole samples at a time

_POLL_S = 0.01


def emulated_header(rate_hz: float, channels: int) -> LineHeader:
    return LineHeader(rate_hz, 12, SUPPLY_V, channels, extra=(("name", "emulated"), ("serial", "0")))


def format_header(header: LineHeader) -> bytes:
    numbers = ((name, f"{getattr(header, name):g}") for name in ("rate_hz", "bits", "reference_v", "channels"))
    words = [*header.extra, *numbers, *([("check", "crc32")] if header.checked else [])]
    return _format_line("# padforge-line 1 " + " ".join(map("=".join, words)), header.checked)


def format_sample(time_us: int, counts: Sequence[int], checked: bool) -> bytes:
    return _format_line(",".join(map(str, (time_us, *counts))), checked)


def _format_line(text: str, checked: bool) -> bytes:
    body = text.encode("ascii")
    return body + (b"*%08x\n" % crc32(body) if checked else b"\n")


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


class EmulatedLineBoard(SerialDevice):
    """A board that speaks the line protocol; the noise of `garble` is on what it sends."""

    def __init__(
        self, source: SampleSource, header: LineHeader, skew_ppm: float = 0.0, silent: bool = False, seed: int = 0
    ) -> None:
        """Open the pseudo-terminal; a period is longer than the header says by `skew_ppm`."""
        super().__init__("board", seed)
        self._source, self._header, self._skew_ppm, self._silent = source, header, skew_ppm, silent
        self._start_s: float | None = None
        self._first = 0  # index of the next sample
        self._stalled = self._resetting = False

    def stall(self, stalled: bool = True) -> None:
        """Neither sample nor answer any more, as firmware that hangs; False restarts the board."""
        self._stalled = stalled

    def true_times(self, index: int | Indices) -> Array:
        """Return the host times at which samples since the last start were complete."""
        assert self._start_s is not None
        period_s = (1 + self._skew_ppm * 1e-6) / self._header.rate_hz
        return self._start_s + (np.asarray(index) + 1) * period_s

    def reset(self) -> None:
        self._resetting = True  # done by the board's own thread, for which the start must not vanish within a step

    def _step(self, data: bytes) -> None:
        if self._stalled:
            self._start_s = None
            self._out.clear()
            return
        if HEADER_REQUEST in data and not self._silent:
            self._send(format_header(self._header))
        self._sample()

    def _wait_s(self) -> float:
        if self._start_s is None:
            return _POLL_S
        return min(max(float(self.true_times(self._first)) - clock.now(), 0.0), _POLL_S)

    def _send(self, data: bytes) -> None:
        self._out += self._add_noise(data)

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
        volts = self._source(self.true_times(index))[:, : self._header.channels]
        counts = np.clip(np.rint(volts / self._header.reference_v * scale), 0, scale).astype(np.int64)
        for k, row in zip(index.tolist(), counts.tolist(), strict=True):
            if len(self._out) > MAX_OUT_BYTES:
                break
            time_us = round((k + 1) * 1e6 / self._header.rate_hz)
            self._send(format_sample(time_us % 2**32, row, self._header.checked))
