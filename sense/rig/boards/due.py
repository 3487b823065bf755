"""The board of the published rig: an Arduino Due on its native USB port, its messages and its driver.

`firmware/padforge_due/README.md` describes the wire format. A frame is checked by its CRC over the coded bytes and not
the payload, because one flipped bit among the COBS counts would alter several bytes of the payload.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import check_float
from padforge.sense.rig import clock
from padforge.sense.rig.boards.board_reader import BoardDriver, SampleClock, select_inputs
from padforge.sense.rig.devices import BoardSamples, RigFault, SerialStream, host_ports
from padforge.sense.settings import RigSettings

BITS = 12
FULL_SCALE = 2**BITS - 1
MAX_CHANNELS = 12
MAX_SAMPLES = 16  # samples in a block
MAX_AVERAGING = 16  # conversions summed to a sample
BAUD = 115_200  # without meaning on a USB port, but never 1200: on a Due that erases the firmware
FIRMWARE_MAJOR = 1  # boards with another first number of the firmware version speak another wire format
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0
SUPPLY_V = 3.3  # reading at full scale

_FIRMWARE = "sense/rig/boards/firmware/padforge_due"
_RESEND_S = 0.25
_ANSWER_S = 1.0
_MAX_JUMP_US = 5000  # of board time against sample index from block to block: interrupts come late
_VENDORS = (0x2341, 0x2A03)
_PRODUCTS = (0x003E, 0x003D)  # the native port, and the programming port, which cannot carry the data

_SETTINGS = struct.Struct("<IHB")
_IDENTITY = struct.Struct("<3BBB16s16s")
_ACK = struct.Struct("<BBIHB")
_BLOCK = struct.Struct("<BBBHHIII")
_CHECK_BYTES = 3
_MAX_PAYLOAD = _BLOCK.size + 2 * MAX_SAMPLES * MAX_CHANNELS
_MAX_FRAME = _MAX_PAYLOAD + 2 + _CHECK_BYTES


class Kind(IntEnum):
    """First byte of a payload."""

    IDENTIFY = 0x01
    SETTINGS = 0x02
    START = 0x03
    STOP = 0x04
    IDENTITY = 0x81
    ACK = 0x82
    BLOCK = 0x90


class Status(IntEnum):
    """Answer to a command."""

    OK = 0
    BAD_SETTINGS = 1
    TOO_FAST = 2
    RUNNING = 3
    HALTED = 4  # not an answer: the board has stopped by itself because conversions were lost


@dataclass(frozen=True)
class Request:
    """A command without a body: IDENTIFY, START or STOP."""

    kind: Kind

    def pack(self) -> bytes:
        """Return the payload."""
        return bytes([self.kind])


@dataclass(frozen=True)
class BoardSettings:
    """How to sample."""

    period_ns: int  # from sample to sample
    mask: int  # of inputs, bit 0 is A0
    averaging: int  # conversions summed to a sample

    def pack(self) -> bytes:
        """Return the payload."""
        return bytes([Kind.SETTINGS]) + self.body()

    def body(self) -> bytes:
        """Return the payload without its kind, which is also a part of an `Ack`."""
        return _SETTINGS.pack(self.period_ns, self.mask, self.averaging)


@dataclass(frozen=True)
class Identity:
    """Identity of a board; `name` has up to 16 ASCII characters, `serial` 16 bytes."""

    firmware: tuple[int, int, int]
    bits: int
    channels: int
    name: str
    serial: bytes

    def pack(self) -> bytes:
        """Return the payload."""
        fields = (*self.firmware, self.bits, self.channels, self.name.encode("ascii"), self.serial)
        return bytes([Kind.IDENTITY]) + _IDENTITY.pack(*fields)


@dataclass(frozen=True)
class Ack:
    """The answer to a command, with the settings in force after it."""

    command: int
    status: int
    settings: BoardSettings

    def pack(self) -> bytes:
        """Return the payload."""
        return bytes([Kind.ACK, self.command, self.status]) + self.settings.body()


@dataclass(frozen=True, eq=False)
class DueBlock:
    """Consecutive samples."""

    counts: NDArray[np.uint16]  # (n, C) sums of `averaging` conversions, n up to 16, one column for every bit of `mask`
    averaging: int  # conversions summed to a sample
    mask: int  # of inputs
    sequence: int  # number of the block since the start
    first: int  # index of the first sample since the start
    time_us: int  # board time when the last sample was complete
    overruns: int  # samples that the board has dropped since the start

    def __len__(self) -> int:
        return len(self.counts)

    def pack(self) -> bytes:
        """Return the payload."""
        fields = (self.averaging, self.mask, self.sequence, self.first, self.time_us, self.overruns)
        return _BLOCK.pack(Kind.BLOCK, len(self.counts), *fields) + self.counts.astype("<u2").tobytes()


DueMessage = Request | BoardSettings | Identity | Ack | DueBlock
M = TypeVar("M", bound=DueMessage)


def encode(message: DueMessage) -> bytes:
    """Return the frame of a message, with the zeros at both ends."""
    coded = cobs_encode(message.pack())
    return b"\0" + coded + _check(coded) + b"\0"


def cobs_encode(payload: bytes) -> bytes:
    """Return `payload` without zeros: every run between them after a count, 255 where a run of 254 goes on.

    Like the firmware, and unlike the package `cobs`, a run of 254 at the very end is followed by an empty one.
    """
    coded = bytearray()
    for run in payload.split(b"\0"):
        while len(run) >= 254:
            coded += b"\xff" + run[:254]
            run = run[254:]
        coded.append(len(run) + 1)
        coded += run
    return bytes(coded)


def cobs_decode(coded: bytes) -> bytes:
    """Return the payload of `coded`, the inverse of `cobs_encode`; ValueError if there is none."""
    payload = bytearray()
    at = 0
    while at < len(coded):
        count = coded[at]
        payload += coded[at + 1 : at + count]
        at += count
        if count == 0 or at > len(coded):
            raise ValueError(f"COBS count {count} does not fit in {len(coded)} bytes")
        if count < 255 and at < len(coded):
            payload.append(0)
    return bytes(payload)


def unpack(payload: bytes) -> DueMessage:
    """Return the message of a payload; ValueError if it is none."""
    kind = payload[0] if payload else None
    try:
        if kind in (Kind.IDENTIFY, Kind.START, Kind.STOP) and len(payload) == 1:
            return Request(Kind(payload[0]))
        if kind == Kind.SETTINGS:
            return BoardSettings(*_SETTINGS.unpack(payload[1:]))
        if kind == Kind.IDENTITY:
            major, minor, patch, bits, channels, name, serial = _IDENTITY.unpack(payload[1:])
            return Identity((major, minor, patch), bits, channels, name.rstrip(b"\0").decode("ascii"), serial)
        if kind == Kind.ACK:
            command, status, *settings = _ACK.unpack(payload[1:])
            return Ack(command, status, BoardSettings(*settings))
    except struct.error as error:
        raise ValueError(f"kind {kind} of {len(payload)} bytes ({error})") from error
    if kind == Kind.BLOCK:
        return _unpack_block(payload)
    raise ValueError(f"kind {kind} of {len(payload)} bytes, expected one of {[int(member) for member in Kind]}")


def _unpack_block(payload: bytes) -> DueBlock:
    if len(payload) < _BLOCK.size:
        raise ValueError(f"a block of {len(payload)} bytes, expected at least {_BLOCK.size}")
    _, samples, averaging, mask, *numbers = _BLOCK.unpack_from(payload)
    channels = mask.bit_count()
    valid = 1 <= samples <= MAX_SAMPLES and 1 <= averaging <= MAX_AVERAGING and 0 < mask < 1 << MAX_CHANNELS
    if not valid or len(payload) != _BLOCK.size + 2 * samples * channels:
        raise ValueError(f"a block of {len(payload)} bytes with {samples} samples of {channels} channels")
    counts = np.frombuffer(payload, "<u2", offset=_BLOCK.size).reshape(samples, channels)
    if counts.max() > averaging * FULL_SCALE:
        raise ValueError(f"a count of {counts.max()}, expected at most {averaging * FULL_SCALE}")
    return DueBlock(counts, averaging, mask, *numbers)


class DueDecoder:
    """Decodes the messages in a stream of bytes that comes in any portions."""

    def __init__(self) -> None:
        self._tail = b""

    def decode(self, data: bytes) -> list[DueMessage]:
        """Return the messages that `data` completes, in order."""
        *pieces, tail = (self._tail + data).split(b"\0")
        self._tail = tail[: _MAX_FRAME + 1]  # one byte too long is damaged whatever follows
        messages = []
        for piece in pieces:
            coded, check = piece[:-_CHECK_BYTES], piece[-_CHECK_BYTES:]
            if coded and len(piece) <= _MAX_FRAME and check == _check(coded):
                with suppress(ValueError):  # what passes the check by chance, and is no message
                    messages.append(unpack(cobs_decode(coded)))
        return messages


def _check(coded: bytes) -> bytes:
    crc = crc_hqx(coded, 0xFFFF)
    return bytes([0x80 | crc >> 14, 0x80 | crc >> 7 & 0x7F, 0x80 | crc & 0x7F])


def list_due_ports() -> list[str]:
    """Return the ports of this host that look like a Due, native ones first; RigFault("refused") without pyserial."""
    ports = [port for port in host_ports() if port.vid in _VENDORS and port.pid in _PRODUCTS]
    return [port.device for port in sorted(ports, key=lambda port: (_PRODUCTS.index(port.pid), port.device))]


def find_due_port(rig: RigSettings) -> str:
    """Return the board's port: that of `[rig]`, or the first Due if it is "auto"; RigFault("refused") if none is."""
    if rig.port != "auto":
        return rig.port
    if not (ports := list_due_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0]


class DueBoard(BoardDriver):
    """An Arduino Due that samples the fibres at a fixed rate; implements `Board`.

    The host time of a sample is when its last conversion was complete, but for the least delay of the USB link.
    """

    STOP_MESSAGE = encode(Request(Kind.STOP))

    def __init__(self, port: str, rate_hz: float, inputs: Sequence[int] = (), averaging: int = 1) -> None:
        """Take the settings; nothing is opened before `connect`.

        Args:
            port: name of the native USB port.
            rate_hz: samples a second, 10 to 10 000.
            inputs: which to read, fibre by fibre, 0 for A0 to 11; all in order if empty.
            averaging: conversions summed to a sample, 1 to 16.
        """
        super().__init__(port, BAUD)
        check_float("board_rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        self._inputs = select_inputs(inputs, MAX_CHANNELS, "an Arduino Due")
        self._settings = BoardSettings(round(1e9 / rate_hz), sum(1 << i for i in set(self._inputs)), averaging)
        self._decoder = DueDecoder()
        self._halted = False

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "DueBoard":
        """Return the board that `[rig]` names; see `__init__` and `find_due_port`."""
        return cls(find_due_port(rig), rig.board_rate_hz, inputs)

    def _start(self, stream: SerialStream) -> dict[str, Any]:
        self._decoder, self._halted = DueDecoder(), False
        identity = self._identify(stream)
        settings = self._configure(stream)
        rate_hz, start = 1e9 / settings.period_ns, encode(Request(Kind.START))
        assembler = DueAssembler(settings, self._inputs)
        receive = partial(self._receive_blocks, stream)
        self._read_blocks(receive, rate_hz, assembler.assemble, lambda: stream.send(start))
        return {
            "name": identity.name,
            "firmware": ".".join(map(str, identity.firmware)),
            "serial": identity.serial.hex(),
            "channels": len(self._inputs),
            "inputs": list(self._inputs),
            "bits": identity.bits,
            "rate_hz": rate_hz,
            "averaging": settings.averaging,
            "supply_v": SUPPLY_V,
            "port": self._port,
        }

    def _receive(self, stream: SerialStream) -> tuple[float, list[DueMessage]]:
        """Wait shortly for bytes; return the host time and the messages that they complete."""
        now_s, data = stream.receive()
        return now_s, self._decoder.decode(data)

    def _receive_blocks(self, stream: SerialStream) -> tuple[float, list[DueBlock]]:
        if self._halted:
            raise RigFault("data", f"{self._port}: the board has lost conversions and stopped")
        now_s, messages = self._receive(stream)
        self._halted = any(isinstance(message, Ack) and message.status == Status.HALTED for message in messages)
        return now_s, [message for message in messages if isinstance(message, DueBlock)]

    def _request(
        self,
        stream: SerialStream,
        command: Request | BoardSettings,
        kind: type[M],
        matches: Callable[[M], bool] = lambda message: True,
    ) -> M:
        """Send a command until a message of this kind that matches comes; RigFault("stale") after a second without."""
        deadline = clock.now() + _ANSWER_S
        resend_s = 0.0
        while (now := clock.now()) < deadline:
            if now >= resend_s:
                stream.send(encode(command))
                resend_s = now + _RESEND_S
            for message in self._receive(stream)[1]:
                if isinstance(message, kind) and matches(message):
                    return message
        raise RigFault("stale", f"{self._port}: no answer within {_ANSWER_S:g} s")

    def _identify(self, stream: SerialStream) -> Identity:
        try:
            identity = self._request(stream, Request(Kind.IDENTIFY), Identity)
        except RigFault as fault:
            if fault.cause != "stale":
                raise
            advice = f"is it the native USB port, and the firmware flashed? see {_FIRMWARE}/README.md"
            raise RigFault("refused", f"{self._port}: no padforge board answers", advice) from fault
        if identity.firmware[0] != FIRMWARE_MAJOR:
            version = ".".join(map(str, identity.firmware))
            message = f"{self._port}: the board has firmware {version}, expected {FIRMWARE_MAJOR}.x"
            raise RigFault("refused", message, f"flash it anew, see {_FIRMWARE}/README.md")
        return identity

    def _configure(self, stream: SerialStream) -> BoardSettings:
        self._request(stream, Request(Kind.STOP), Ack, lambda ack: ack.command == Kind.STOP)
        settings = self._settings
        ack = self._request(stream, settings, Ack, lambda ack: ack.command == Kind.SETTINGS)
        if ack.status != Status.OK:
            message = (
                f"{self._port}: the board refuses {settings.mask.bit_count()} channels at {1e9 / settings.period_ns:g} "
                f"Hz with {settings.averaging} conversions a sample (status {ack.status})"
            )
            raise RigFault("refused", message, "lower the rate, the channels or the averaging")
        return ack.settings


class DueAssembler:
    """Makes `BoardSamples` of blocks: host times by a `SampleClock`, volts by fibre, missing samples by the index."""

    def __init__(self, settings: BoardSettings, inputs: Sequence[int]) -> None:
        self._clock = SampleClock(settings.period_ns * 1e-9)
        self._settings = settings
        self._columns = [sorted(set(inputs)).index(i) for i in inputs]  # blocks hold the inputs in ascending order
        self._volts = SUPPLY_V / (settings.averaging * FULL_SCALE)
        self._next = 0
        self._time_us: int | None = None

    def assemble(self, arrivals: Iterable[tuple[float, DueBlock]]) -> BoardSamples:
        """Return the samples of blocks with their arrival times; RigFault("data") if one cannot follow those before."""
        placed = []
        for arrival_s, block in arrivals:
            first, missing = self._place(block)
            self._clock.observe(first + len(block) - 1, arrival_s)
            placed.append((first, missing, block.counts))
        times = [self._clock.times(np.arange(first, first + len(counts))) for first, _, counts in placed]
        gaps = [np.r_[missing, np.zeros(len(counts) - 1, np.int64)] for _, missing, counts in placed]
        volts = [counts[:, self._columns] * self._volts for *_, counts in placed]
        return BoardSamples(
            np.concatenate([np.empty(0), *times]),
            np.concatenate([np.empty((0, len(self._columns))), *volts]),
            np.concatenate([np.empty(0, np.int64), *gaps]),
        )

    def _place(self, block: DueBlock) -> tuple[int, int]:
        """Return the unwrapped index of the first sample, and how many are missing before it."""
        if (block.mask, block.averaging) != (self._settings.mask, self._settings.averaging):
            raise RigFault("data", "the board sends other channels than it was set to", "connect again")
        missing = (block.first - self._next) % 2**32
        samples = missing + len(block)
        if self._time_us is not None:
            elapsed_us = round(samples * self._settings.period_ns / 1000)
            jump_us = (block.time_us - self._time_us - elapsed_us + 2**31) % 2**32 - 2**31
            if elapsed_us >= 2**32 or abs(jump_us) > _MAX_JUMP_US:
                message = f"sample {block.first} came {jump_us} us off its time"
                raise RigFault("data", message, "the board may have been reset; connect again")
        self._time_us = block.time_us
        first = self._next + missing
        self._next = first + len(block)
        return first, missing
