"""A stand-in for a board that speaks the line protocol; see `due_board` for what is behind it. POSIX only."""

import time

import numpy as np

from padforge.sense.rig.boards.line.framing import ASK, LineHeader, header_line, sample_line

from padforge.sense.rig.emulators.serial_board import OUT_BYTES, SerialBoard, Source


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
