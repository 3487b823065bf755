"""The wire format of the Arduino Due board: messages between host and board as frames, the same both ways.

`firmware/padforge_due/README.md` describes it. A frame is checked by its CRC over the coded bytes and not the payload,
because one flipped bit among the COBS counts would alter several bytes of the payload.
"""

import struct
from binascii import crc_hqx
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

BITS = 12
FULL_SCALE = 2**BITS - 1
MAX_CHANNELS = 12
MAX_SAMPLES = 16  # samples in a block
MAX_AVERAGING = 16  # conversions summed to a sample


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

_SETTINGS = struct.Struct("<IHB")
_IDENTITY = struct.Struct("<3BBB16s16s")
_ACK = struct.Struct("<BBIHB")
_BLOCK = struct.Struct("<BBBHHIII")
_CHECK_BYTES = 3
_MAX_PAYLOAD = _BLOCK.size + 2 * MAX_SAMPLES * MAX_CHANNELS
_MAX_FRAME = _MAX_PAYLOAD + 2 + _CHECK_BYTES


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
