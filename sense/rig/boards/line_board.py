"""A board that sends samples in a plain line protocol, which any board can implement; see docs/howto-boards.md."""

from binascii import crc32
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from padforge.sense.arrays import MAX_FIBRES
from padforge.sense.rig import clock
from padforge.sense.rig.boards.board_reader import BlockReader, SampleAssembler, SampleClock, SerialBoard, select_inputs
from padforge.sense.rig.devices import RigFault, SerialStream, host_ports
from padforge.sense.settings import RigSettings

HEADER_REQUEST = b"?"
RESONATOR_SKEW = 5e-3  # relative error of a ceramic resonator, which small boards have instead of a quartz

_MAGIC = "# padforge-line"
_VERSION = "1"
_LIMITS = {  # of header fields; integer limits mean an integer field
    "rate_hz": (10.0, 10_000.0),
    "bits": (1, 24),
    "reference_v": (0.1, 100),
    "channels": (1, MAX_FIBRES),
}
_ANSWER_S = 3.0  # longest wait for a header: opening the port resets many boards, and their boot loaders wait first
_BAD_S = 0.5  # time of damaged lines only that is a fault; below the time after which a board is stale
_MIN_BAD_LINES = 5  # damaged lines in that time; fewer are noise
_MAX_GAP_US = 2_000_000  # between valid lines: a board is stale after 1 s of silence


@dataclass(frozen=True)
class LineHeader:
    """The header of a board."""

    rate_hz: float  # samples a second
    bits: int  # resolution of the counts
    reference_v: float  # voltage at the maximum count
    channels: int  # number of inputs
    checked: bool = True  # whether its lines have a check
    extra: tuple[tuple[str, str], ...] = ()  # further fields and their values

    @property
    def full_scale(self) -> int:
        """The maximum count."""
        return 2**self.bits - 1


@dataclass(frozen=True)
class LineSample:
    """A sample: the board's time in us, which may wrap at 32 bits, and (C,) counts."""

    time_us: int
    counts: tuple[int, ...]


class LineDecoder:
    """Decodes headers and samples from a stream of bytes that arrives in arbitrary chunks."""

    def __init__(self) -> None:
        self.header: LineHeader | None = None  # the latest; samples before the first are ignored
        self._errors: Counter[str] = Counter()
        self._tail = b""

    @property
    def n_errors(self) -> int:
        """Number of damaged lines since the last sample or header."""
        return self._errors.total()

    @property
    def error(self) -> str:
        """The most frequent error of these lines, or ""."""
        return max(self._errors, key=self._errors.__getitem__, default="")

    def decode(self, data: bytes) -> list[LineHeader | LineSample]:
        """Return the headers and samples that `data` completes, in order."""
        *lines, self._tail = (self._tail + data).split(b"\n")
        return [item for line in lines if (item := self._decode_line(line.removesuffix(b"\r"))) is not None]

    def _decode_line(self, line: bytes) -> LineHeader | LineSample | None:
        try:
            if line.startswith(_MAGIC.encode()):
                item = self.header = _parse_header(_verify(line).decode("ascii"))
            elif self.header is None or not line or line.startswith(b"#"):
                return None
            else:
                item = _parse_sample(line, self.header)
        except ValueError as error:
            self._errors[str(error)] += 1
            return None
        self._errors.clear()
        return item


def _verify(line: bytes) -> bytes:
    """Return the line without its check (CRC-32), if it has one; ValueError if the check does not fit."""
    body, star, check = line.rpartition(b"*")
    if not star:
        return line
    if check.lower() != b"%08x" % crc32(body):
        raise ValueError("the check does not fit")
    return body


def _parse_header(text: str) -> LineHeader:
    version, *words = text.removeprefix(_MAGIC).split()
    if version != _VERSION:
        raise ValueError(f"it speaks version {version} of the line protocol, expected {_VERSION}")
    values = dict(word.split("=", 1) for word in words if "=" in word)
    if (check := values.pop("check", "none")) not in ("crc32", "none"):
        raise ValueError(f"check is {check[:20]!r}, allowed are crc32 and none")
    rate_hz, bits, reference_v, channels = (_parse_number(name, values.pop(name, "missing")) for name in _LIMITS)
    return LineHeader(rate_hz, int(bits), reference_v, int(channels), check == "crc32", tuple(values.items()))


def _parse_number(name: str, text: str) -> float:
    low, high = _LIMITS[name]
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high or (isinstance(low, int) and value != int(value)):
        raise ValueError(f"{name} of its header is {text[:20]!r}, allowed is {low:g} to {high:g}")
    return value


def _parse_sample(line: bytes, header: LineHeader) -> LineSample:
    if header.checked and b"*" not in line:
        raise ValueError("a line has no check")
    numbers = _verify(line).split(b",")
    if len(numbers) != 1 + header.channels:
        raise ValueError(f"a line has {len(numbers)} numbers, expected {1 + header.channels}: the time and the inputs")
    if not all(map(bytes.isdigit, numbers)):
        raise ValueError(f"a line begins {line[:20].decode('ascii', 'replace')!r}, expected whole numbers only")
    time_us, *counts = map(int, numbers)
    if max(counts) > header.full_scale:
        raise ValueError(f"a count is {max(counts)}, its header allows {header.full_scale}")
    return LineSample(time_us, tuple(counts))


def describe_lines(received: bytes) -> tuple[str, str]:
    """Describe a stream that is not the line protocol; return problem and advice."""
    if not received:
        return "nothing comes from it", "check that it is the board's port, its cable, and that its program runs"
    text = sum(byte in b"\t\r\n" or 32 <= byte < 127 for byte in received)
    if text < 0.9 * len(received):  # text at the right speed has more
        return f"{len(received) - text} of {len(received)} bytes are no text", "is [rig] baud that of the board?"
    lines = [line.strip() for line in received.split(b"\n")[1:-1] if line.strip()] or [received.strip()]
    excerpt = repr(lines[-1][:60].decode("ascii", "replace"))
    what = f"it sends lines such as {excerpt} without the header of docs/howto-boards.md"
    return what, 'add the header to its program, or set [rig] board = "csv", which is weaker'


def find_line_port(rig: RigSettings) -> str:
    """Return the port of `[rig]`, or the only one on USB if it is "auto"; RigFault("refused") unless there is one."""
    if rig.port != "auto":
        return rig.port
    ports = [port.device for port in host_ports() if port.vid is not None]
    if len(ports) != 1:
        message = f'[rig] port is "auto", and there are {len(ports)} serial ports on USB'
        raise RigFault("refused", message, f"name one of {', '.join(sorted(ports))}" if ports else "plug the board in")
    return ports[0]


class LineBoard(SerialBoard):
    """A board at a serial port that sends samples as lines; implements `Board`.

    Its header must state the `rate_hz` of `[rig]`. The host time of a sample is its time by the board's clock, plus the
    minimum delay of the port.
    """

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "LineBoard":
        """Return the board that `[rig]` names; see `find_line_port`."""
        return cls(find_line_port(rig), rig.baud, rig.board_rate_hz, inputs)

    def _start(self, stream: SerialStream) -> dict[str, Any]:
        self._decoder, self._settled = LineDecoder(), False
        header = self._identify(stream)
        inputs = select_inputs(self._inputs, header.channels)
        self._assembler = LineAssembler(header, inputs)
        self._last_sample_s = clock.now()
        self._reader = BlockReader(self._port, lambda: self._receive_blocks(stream, header), header.rate_hz)
        self._reader.start_settled()
        self._settled = True
        return {
            **dict(header.extra),
            "channels": len(inputs),
            "inputs": list(inputs),
            "bits": header.bits,
            "rate_hz": header.rate_hz,
            "supply_v": header.reference_v,
            "port": self._port,
            **({} if header.checked else {"warning": "its lines have no check: a damaged one may pass for a sample"}),
        }

    def _identify(self, stream: SerialStream) -> LineHeader:
        deadline, resend_s = clock.now() + _ANSWER_S, 0.0
        received = b""
        while self._decoder.header is None:
            if (now := clock.now()) > deadline:
                reason, advice = describe_lines(received)
                if self._decoder.error:
                    reason, advice = self._decoder.error, "check the port, the firmware and [rig] baud"
                raise RigFault("refused", f"{self._port}: {reason}", advice)
            if now >= resend_s:
                stream.send(HEADER_REQUEST)
                resend_s = now + 0.5
            data = stream.receive()[1]
            received = (received + data)[-1000:]  # for the description of a wrong stream
            self._decoder.decode(data)
        header = self._decoder.header
        if abs(header.rate_hz / self._rate_hz - 1) > 1e-3:
            message = f"{self._port}: the board takes {header.rate_hz:g} samples a second, [rig] says {self._rate_hz:g}"
            raise RigFault("refused", message, f"set board_rate_hz = {header.rate_hz:g}")
        return header

    def _receive_blocks(self, stream: SerialStream, header: LineHeader) -> tuple[float, list[list[LineSample]]]:
        now_s, data = stream.receive()
        items = self._decoder.decode(data)
        headers = [item for item in items if isinstance(item, LineHeader)]
        if headers and (self._settled or headers[-1] != header):  # an equal one at first answers a repeated request
            raise RigFault("data", f"{self._port}: the board was reset", "see why and connect again")
        if self._decoder.n_errors >= _MIN_BAD_LINES and now_s - self._last_sample_s > _BAD_S:
            raise RigFault("data", f"{self._port}: {self._decoder.error}", "line after line; look at the board")
        samples = [item for item in items if isinstance(item, LineSample)]
        if not samples:
            return now_s, []
        self._last_sample_s = now_s
        return now_s, [samples]


class LineAssembler(SampleAssembler):
    """Assembles the samples of lines by the board's clock.

    Every sample has a time slot, one period after the previous one; empty slots are lost samples. The slots track the
    board's actual rate, which may differ slightly from its header's. A line that fits no slot is dropped.
    """

    def __init__(self, header: LineHeader, inputs: Sequence[int]) -> None:
        super().__init__(SampleClock(1e-6, RESONATOR_SKEW), inputs, header.reference_v / header.full_scale)
        self._period_us = 1e6 / header.rate_hz
        self._last_us: int | None = None
        self._slot_us = 0.0
        self._n_misplaced = 0.0

    def _place(self, sample: LineSample) -> tuple[int, Sequence[float], int] | None:
        if self._last_us is None:
            self._last_us, self._slot_us = sample.time_us, float(sample.time_us)
            return sample.time_us, sample.counts, 0
        elapsed_us = (sample.time_us - self._last_us + 2**31) % 2**32 - 2**31  # the board's time wraps at 32 bits
        now_us = self._last_us + elapsed_us
        steps = round((now_us - self._slot_us) / self._period_us)
        if not 0 < elapsed_us <= _MAX_GAP_US or steps < 1:
            self._n_misplaced += 1
            if self._n_misplaced >= 8:
                message = f"a line came {elapsed_us} us after another by the board's clock, not {self._period_us:g}"
                is_ms = 0.5 < 1000 * elapsed_us / self._n_misplaced / self._period_us < 2
                advice = "it was reset, or its rate is not that of its header; connect again"
                raise RigFault("data", message, "are its times ms? they must be us" if is_ms else advice)
            return None
        self._n_misplaced = max(self._n_misplaced - 0.1, 0.0)  # ten lines in their slots compensate a misplaced one
        self._slot_us += steps * self._period_us
        self._slot_us += 0.1 * (now_us - self._slot_us)  # low-pass: the slots follow the board slowly
        self._last_us = now_us
        return now_us, sample.counts, steps - 1
