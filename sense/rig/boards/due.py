"""The port of an Arduino Due: where it is found, and frames to and from it.

The converter of the real rig: an Arduino Due on its native USB port, with the firmware beside this module.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.rig.boards.board_reader import BlockReader, ByteStream, SampleClock, chosen_inputs
from padforge.sense.rig.boards.due_framing import (
    FULL_SCALE,
    MAX_AVERAGING,
    MAX_CHANNELS,
    Ack,
    BoardSettings,
    DueBlock,
    DueDecoder,
    Frame,
    Identity,
    Kind,
    Request,
    Status,
    encode,
)
from padforge.sense.rig.devices import BoardSamples, RigFault, host_ports
from padforge.sense.settings import RigSettings

BAUD = 115_200
"""Without meaning on a USB port, but never 1200: on a Due that erases the firmware."""

F = TypeVar("F", bound=Frame)

_RESEND_S = 0.25
_DUE_PORTS = {0x003E: "native", 0x003D: "programming"}
_VENDORS = (0x2341, 0x2A03)


@dataclass(frozen=True)
class BoardPort:
    """A port at which an Arduino Due seems to be: "native" is the one to use, "programming" cannot carry the data."""

    device: str
    kind: str
    serial_number: str


def find_ports() -> list[BoardPort]:
    """The ports of this host that look like a Due, native ones first. Raises RigFault("refused") without pyserial."""
    found = [
        BoardPort(port.device, _DUE_PORTS[port.pid], port.serial_number or "")
        for port in host_ports()
        if port.vid in _VENDORS and port.pid in _DUE_PORTS
    ]
    return sorted(found, key=lambda port: (port.kind, port.device))


def port_of(rig: RigSettings) -> str:
    """The board's port, looked for where `[rig]` does not set it; raises RigFault("refused") where none is found."""
    if rig.port != "auto":
        return rig.port
    if not (ports := find_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0].device


class SerialLink:
    """An open port that speaks frames. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str) -> None:
        """Open `port` for this process alone; raises RigFault("refused") where that cannot be."""
        self.port = port
        self.decoder = DueDecoder()
        self._stream = ByteStream(port, BAUD)

    def receive(self) -> tuple[float, list[Frame]]:
        """When bytes have come, after a short wait, and the frames they completed."""
        now_s, data = self._stream.receive()
        return now_s, self.decoder.feed(data)

    def send(self, command: Request | BoardSettings) -> None:
        """Send one command."""
        self._stream.send(encode(command))

    def ask(self, command: Request | BoardSettings, kind: type[F], fits: Callable[[F], bool], wait_s: float) -> F:
        """Send `command` until a frame of `kind` that `fits` comes; all other frames are thrown away.

        Raises:
            RigFault: "stale" where none has come after `wait_s`.
        """
        deadline = time.monotonic() + wait_s
        resend = 0.0
        while (now := time.monotonic()) < deadline:
            if now >= resend:
                self.send(command)
                resend = now + _RESEND_S
            for frame in self.receive()[1]:
                if isinstance(frame, kind) and fits(frame):
                    return frame
        raise RigFault("stale", f"{self.port}: no answer within {wait_s:g} s")

    def close(self) -> None:
        """Close the port; never raises."""
        self._stream.close()


FIRMWARE_MAJOR = 1
"""Boards with another first number of the firmware version speak another wire format."""
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_FIRMWARE = "sense/rig/boards/firmware/padforge_due"
_ANSWER_S = 1.0
_JUMP_US = 5000
"""Board time and sample index may differ by so much from block to block: interrupts come late."""

Arrival = tuple[float, DueBlock]
"""A block and the host time at which it came."""


class Arduino:
    """An Arduino Due that reads fibres every 1 / `rate_hz`; implements `Board`.

    The host time of a sample is when its last conversion was complete, apart from the least delay of the USB link.
    """

    def __init__(
        self, port: str, rate_hz: float, inputs: Sequence[int] = (), supply_v: float = 3.3, averaging: int = 1
    ) -> None:
        """Take the settings; nothing is opened before `connect`.

        Args:
            port: name of the native USB port. rate_hz: samples per second, 10 to 10 000.
            inputs: which to read, fibre by fibre, 0 for A0 to 11; all in order where empty.
            supply_v: reading at full scale, V. averaging: conversions summed to a sample, 1 to 16.

        Raises:
            InputError: a value is out of range.
            RigFault: "refused" for an input that the board has not.
        """
        _within("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        _within("averaging", averaging, 1, MAX_AVERAGING)
        self._inputs = chosen_inputs(inputs, MAX_CHANNELS, "an Arduino Due")
        self._port = port
        self._wanted = BoardSettings(round(1e9 / rate_hz), sum(1 << i for i in set(self._inputs)), averaging)
        self._supply_v = supply_v
        self._link: SerialLink | None = None
        self._reader: BlockReader[DueBlock] | None = None
        self._assembler: DueAssembler | None = None

    @classmethod
    def of(cls, rig: RigSettings, inputs: Sequence[int]) -> "Arduino":
        """The board that `[rig]` names, looked for where its port is "auto"; see `__init__` and `port_of`."""
        return cls(port_of(rig), rig.board_rate_hz, inputs)

    def connect(self) -> dict[str, Any]:
        """Open the port, check the firmware, set the board and start it; see `Board`."""
        self.close()
        self._link = link = SerialLink(self._port)
        try:
            identity = self._identify(link)
            settings = self._set(link)
            self._assembler = DueAssembler(settings, self._inputs, self._supply_v)
            self._start(link, settings)
        except BaseException:
            self.close()
            raise
        return {
            "name": identity.name,
            "firmware": ".".join(map(str, identity.firmware)),
            "serial": identity.serial.hex(),
            "channels": len(self._inputs),
            "inputs": list(self._inputs),
            "bits": identity.bits,
            "rate_hz": 1e9 / settings.period_ns,
            "averaging": settings.averaging,
            "supply_v": self._supply_v,
            "port": self._port,
        }

    def read(self) -> BoardSamples:
        """All samples since the last call, C columns of volts; see `Board`.

        Raises:
            RigFault: "stale" or "lost" once all samples that came before have been read, "data" where nobody has read
                for 60 s or the board has lost its place, "refused" before `connect`.
        """
        if self._reader is None or self._assembler is None:
            raise RigFault("refused", f"{self._port}: not connected")
        return self._assembler.samples(self._reader.take())

    def statistics(self) -> dict[str, float]:
        """Since `connect`: blocks, damaged frames, missing samples, those of them dropped by the board, clock skew.

        All but the damaged frames count what has been read.
        """
        taken = self._assembler
        return {
            "blocks": taken.blocks if taken else 0,
            "damaged": self._link.decoder.damaged if self._link else 0,
            "missing": taken.missing if taken else 0,
            "overruns": taken.overruns if taken else 0,
            "skew_ppm": taken.clock.skew_ppm if taken else 0.0,
        }

    def close(self) -> None:
        """Stop sampling and close the port; never raises."""
        if self._reader is not None:
            self._reader.stop()
        if self._link is not None:
            with suppress(RigFault):
                self._link.send(Request(Kind.STOP))
            self._link.close()
        self._reader = None

    def _identify(self, link: SerialLink) -> Identity:
        try:
            identity = link.ask(Request(Kind.IDENTIFY), Identity, lambda _: True, _ANSWER_S)
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

    def _set(self, link: SerialLink) -> BoardSettings:
        link.ask(Request(Kind.STOP), Ack, lambda ack: ack.command == Kind.STOP, _ANSWER_S)
        ack = link.ask(self._wanted, Ack, lambda ack: ack.command == Kind.SETTINGS, _ANSWER_S)
        if ack.status != Status.OK:
            wanted = self._wanted
            message = (
                f"{self._port}: the board refuses {wanted.mask.bit_count()} channels at {1e9 / wanted.period_ns:g} Hz "
                f"with {wanted.averaging} conversions a sample (status {ack.status})"
            )
            raise RigFault("refused", message, "lower the rate, the channels or the averaging")
        return ack.settings

    def _start(self, link: SerialLink, settings: BoardSettings) -> None:
        halted = False

        def receive() -> tuple[float, list[DueBlock]]:
            nonlocal halted
            if halted:
                raise RigFault("data", f"{self._port}: the board has lost conversions and stopped")
            now_s, frames = link.receive()
            halted = any(isinstance(frame, Ack) and frame.status == Status.HALTED for frame in frames)
            return now_s, [frame for frame in frames if isinstance(frame, DueBlock)]

        link.decoder.damaged = 0
        self._reader = BlockReader(self._port, receive, 1e9 / settings.period_ns)
        self._reader.begin(lambda: link.send(Request(Kind.START)))


class DueAssembler:
    """Makes `Samples` of blocks: times by a `SampleClock`, volts fibre by fibre, what is missing by the index.

    Attributes:
        blocks, missing, overruns: blocks so far, samples that are missing, those of them dropped by the board.
    """

    def __init__(self, settings: BoardSettings, inputs: Sequence[int], supply_v: float) -> None:
        self.clock = SampleClock(settings.period_ns * 1e-9)
        self.blocks = self.missing = self.overruns = 0
        self._settings = settings
        self._columns = [sorted(set(inputs)).index(i) for i in inputs]  # blocks hold the inputs in ascending order
        self._volts = supply_v / (settings.averaging * FULL_SCALE)
        self._next = 0
        self._time_us: int | None = None

    def samples(self, arrivals: Iterable[Arrival]) -> BoardSamples:
        """The samples of the blocks that have arrived since the last call.

        Raises:
            RigFault: "data" where a block cannot follow the ones before it.
        """
        placed = []
        for arrival_s, block in arrivals:
            first, lost = self._place(block)
            self.clock.observe(first + len(block.counts) - 1, arrival_s)
            placed.append((first, lost, block.counts))
        times = [self.clock.times(np.arange(first, first + len(counts))) for first, _, counts in placed]
        missing = [np.r_[lost, np.zeros(len(counts) - 1, np.int64)] for _, lost, counts in placed]
        return BoardSamples(
            np.concatenate([np.empty(0), *times]),
            np.concatenate([np.empty((0, len(self._columns))), *(counts[:, self._columns] for *_, counts in placed)])
            * self._volts,
            np.concatenate([np.empty(0, np.int64), *missing]),
        )

    def _place(self, block: DueBlock) -> tuple[int, int]:
        """Index of the first sample, counted on without wrapping, and how many are lost before it."""
        if (block.mask, block.averaging) != (self._settings.mask, self._settings.averaging):
            raise RigFault("data", "the board sends other channels than it was set to", "connect again")
        lost = (block.first - self._next) % 2**32
        samples = lost + len(block.counts)
        if self._time_us is not None:
            elapsed_us = round(samples * self._settings.period_ns / 1000)
            jump_us = (block.time_us - self._time_us - elapsed_us + 2**31) % 2**32 - 2**31
            if elapsed_us >= 2**32 or abs(jump_us) > _JUMP_US:
                message = f"sample {block.first} came {jump_us} us off its time"
                raise RigFault("data", message, "the board may have been reset; connect again")
        self._time_us = block.time_us
        first = self._next + lost
        self._next = first + len(block.counts)
        self.blocks += 1
        self.missing += lost
        self.overruns = block.overruns
        return first, lost


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise InputError(f"{name} is {value:g}, expected {least:g} to {most:g}")
