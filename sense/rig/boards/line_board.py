"""A converter that sends lines of text: any board that speaks the protocol of `framing`."""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from padforge.sense.rig.boards.board_reader import BlockReader, ByteStream, SampleClock, chosen_inputs
from padforge.sense.rig.boards.line_framing import ASK, LineDecoder, LineHeader, Sample
from padforge.sense.rig.devices import BoardSamples, RigFault, host_ports
from padforge.sense.settings import RigSettings

RESONATOR_SKEW = 5e-3
"""Small boards have a ceramic resonator in place of a quartz."""

_ANSWER_S = 3.0
"""Opening their port resets many boards, and some wait for a new program before they start."""
_ASK_AGAIN_S = 0.5
_SAME_RATE = 1e-3
_BAD_S, _BAD_LINES = 0.5, 5
"""Half a second of nothing but damaged lines is no noise, and told before it counts as silence."""
_MAX_GAP_US = 2_000_000
"""A board that is silent for a second is stale, so no sound time jumps so far."""
_FOLLOW = 0.1
"""Share by which the times to come follow a line that is a little early or late."""
_MISPLACED, _FORGIVEN = 8, 0.1
"""So many lines whose time cannot be are a fault; one that can be makes up for a tenth of one."""


@dataclass(frozen=True)
class LineReader:
    """Samples that came together: their times by the board, and (n, C) counts."""

    times_us: list[int]
    counts: list[tuple[int, ...]]


class LineBoard:
    """A board at a serial port that sends samples as lines; implements `Board`.

    The host time of a sample is when it was taken by the board's clock, apart from the least delay of the port.
    """

    def __init__(self, port: str, baud: int, rate_hz: float, inputs: Sequence[int] = ()) -> None:
        """Take the settings; nothing is opened before `connect`.

        Args:
            port, baud: of the board. rate_hz: samples a second, which the board must say it takes.
            inputs: which to read, fibre by fibre, from 0; all in order where empty.
        """
        self._port, self._baud, self._rate_hz, self._inputs = port, baud, rate_hz, inputs
        self._stream: ByteStream | None = None
        self._decoder = LineDecoder()
        self._reader: BlockReader[LineReader] | None = None
        self._assembler: LineAssembler | None = None

    @classmethod
    def of(cls, rig: RigSettings, inputs: Sequence[int]) -> "LineBoard":
        """The board that `[rig]` names; where its port is "auto", at the only serial port there is."""
        return cls(port_of(rig), rig.baud, rig.board_rate_hz, inputs)

    def connect(self) -> dict[str, Any]:
        """Open the port, ask the board what it is and begin to read; see `Board`."""
        self.close()
        self._stream, self._decoder = ByteStream(self._port, self._baud), LineDecoder()
        try:
            header = self._identify(self._stream)
            inputs = chosen_inputs(self._inputs, header.channels, "the board")
            self._assembler = LineAssembler(header, inputs)
            self._start(self._stream, header)
        except BaseException:
            self.close()
            raise
        return {
            **dict(header.said),
            "channels": len(inputs),
            "inputs": list(inputs),
            "bits": header.bits,
            "rate_hz": header.rate_hz,
            "supply_v": header.reference_v,
            "port": self._port,
            **({} if header.checked else {"warning": "its lines have no check: a damaged one may pass for a sample"}),
        }

    def read(self) -> BoardSamples:
        """All samples since the last call, C columns of volts; see `Board`.

        Raises:
            RigFault: "stale" or "lost" once all samples that came before have been read, "data" where nobody has read
                for 60 s, the board was reset or its lines are no samples, "refused" before `connect`.
        """
        if self._reader is None or self._assembler is None:
            raise RigFault("refused", f"{self._port}: not connected")
        return self._assembler.samples(self._reader.take())

    def statistics(self) -> dict[str, float]:
        """Since `connect`: samples, damaged lines, samples that are missing, clock skew; what has been read counts."""
        taken = self._assembler
        return {
            "samples": taken.taken if taken else 0,
            "damaged": self._decoder.damaged,
            "missing": taken.missing if taken else 0,
            "skew_ppm": taken.clock.skew_ppm if taken else 0.0,
        }

    def close(self) -> None:
        """Close the port; never raises."""
        if self._reader is not None:
            self._reader.stop()
        if self._stream is not None:
            self._stream.close()
        self._reader = None

    def _identify(self, stream: ByteStream) -> LineHeader:
        deadline, again = time.monotonic() + _ANSWER_S, 0.0
        while self._decoder.header is None:
            if (now := time.monotonic()) > deadline:
                found = self._decoder.complaint or "no board that speaks the line protocol answers"
                raise RigFault("refused", f"{self._port}: {found}", "is [rig] baud that of the board?")
            if now >= again:
                stream.send(ASK)
                again = now + _ASK_AGAIN_S
            self._decoder.feed(stream.receive()[1])
        header = self._decoder.header
        if abs(header.rate_hz / self._rate_hz - 1) > _SAME_RATE:
            message = f"{self._port}: the board takes {header.rate_hz:g} samples a second, [rig] says {self._rate_hz:g}"
            raise RigFault("refused", message, f"set board_rate_hz = {header.rate_hz:g}")
        return header

    def _start(self, stream: ByteStream, header: LineHeader) -> None:
        settled, good_s = False, time.monotonic()

        def receive() -> tuple[float, list[LineReader]]:
            nonlocal good_s
            now_s, data = stream.receive()
            found = self._decoder.feed(data)
            headers = [each for each in found if isinstance(each, LineHeader)]
            if headers and (settled or headers[-1] != header):  # before, it answers a question that was asked again
                raise RigFault("data", f"{self._port}: the board was reset", "see why and connect again")
            if self._decoder.in_a_row >= _BAD_LINES and now_s - good_s > _BAD_S:
                raise RigFault("data", f"{self._port}: {self._decoder.complaint}", "line after line; look at the board")
            samples = [each for each in found if isinstance(each, Sample)]
            if not samples:
                return now_s, []
            good_s = now_s
            return now_s, [LineReader([each.time_us for each in samples], [each.counts for each in samples])]

        self._reader = BlockReader(self._port, receive, header.rate_hz)
        self._reader.begin()
        settled = True


class LineAssembler:
    """Makes `BoardSamples` of lines: times by a `SampleClock`, volts fibre by fibre, what is missing by the times.

    Every sample has its slot, a period after the one before; the slots follow the board, whose rate need not be quite
    what it says. A line that fits into no slot, by its time, is no sample.

    Attributes:
        taken, missing: samples so far, and those that are missing.
    """

    def __init__(self, header: LineHeader, inputs: Sequence[int]) -> None:
        self.clock = SampleClock(1e-6, RESONATOR_SKEW)
        self.taken = self.missing = 0
        self._columns = list(inputs)
        self._volts = header.reference_v / header.full_scale
        self._period_us = 1e6 / header.rate_hz
        self._last_us: int | None = None
        self._slot_us = 0.0
        self._misplaced = 0.0

    def samples(self, arrivals: Iterable[tuple[float, LineReader]]) -> BoardSamples:
        """The samples of the lines that have arrived since the last call.

        Raises:
            RigFault: "data" where the times of the lines cannot be.
        """
        times_us, counts, missing = [], [], []
        for arrival_s, lines in arrivals:
            for time_us, row in zip(lines.times_us, lines.counts, strict=True):
                if (lost := self._place(time_us)) is not None:
                    times_us.append(self._last_us)
                    counts.append(row)
                    missing.append(lost)
            if times_us:
                self.clock.observe(times_us[-1], arrival_s)
        self.taken += len(counts)
        self.missing += sum(missing)
        volts = (
            np.array(counts, np.float64).reshape(len(counts), -1) if counts else np.empty((0, 1 + max(self._columns)))
        )
        return BoardSamples(
            self.clock.times(np.array(times_us)) if times_us else np.empty(0),
            volts[:, self._columns] * self._volts,
            np.array(missing, np.int64),
        )

    def _place(self, time_us: int) -> int | None:
        """How many samples are lost before one of this time; None where it cannot be that time."""
        if self._last_us is None:
            self._last_us, self._slot_us = time_us, float(time_us)
            return 0
        elapsed_us = (time_us - self._last_us + 2**31) % 2**32 - 2**31
        now_us = self._last_us + elapsed_us
        steps = round((now_us - self._slot_us) / self._period_us)
        if not 0 < elapsed_us <= _MAX_GAP_US or steps < 1:
            self._misplaced += 1
            if self._misplaced >= _MISPLACED:
                message = f"a line came {elapsed_us} us after another by the board's clock, not {self._period_us:g}"
                raise RigFault("data", message, "it was reset, or its rate is not that of its header; connect again")
            return None
        self._misplaced = max(self._misplaced - _FORGIVEN, 0.0)
        self._slot_us += steps * self._period_us
        self._slot_us += _FOLLOW * (now_us - self._slot_us)
        self._last_us = now_us
        return steps - 1


def port_of(rig: RigSettings) -> str:
    """The board's port: that of `[rig]`, or the only one on USB; raises RigFault("refused") where that is not one."""
    if rig.port != "auto":
        return rig.port
    ports = [port.device for port in host_ports() if port.vid is not None]
    if len(ports) != 1:
        message = f'[rig] port is "auto", and there are {len(ports)} serial ports on USB'
        raise RigFault("refused", message, f"name one of {', '.join(sorted(ports))}" if ports else "plug the board in")
    return ports[0]
