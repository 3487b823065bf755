"""The board of the published rig: an Arduino Due on its native USB port, with the firmware beside this module."""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.rig.boards import due_framing as framing
from padforge.sense.rig.boards.board_reader import POLL_S, BlockReader, SampleClock, select_inputs
from padforge.sense.rig.boards.due_framing import Ack, BoardSettings, DueBlock, Identity, Kind, Request, Status
from padforge.sense.rig.devices import BoardSamples, RigFault, SerialStream, host_ports
from padforge.sense.settings import RigSettings

BAUD = 115_200  # without meaning on a USB port, but never 1200: on a Due that erases the firmware
FIRMWARE_MAJOR = 1  # boards with another first number of the firmware version speak another wire format
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_FIRMWARE = "sense/rig/boards/firmware/padforge_due"
_RESEND_S = 0.25
_ANSWER_S = 1.0
_MAX_JUMP_US = 5000  # of board time against sample index from block to block: interrupts come late
_DUE_PORTS = {0x003E: "native", 0x003D: "programming"}
_VENDORS = (0x2341, 0x2A03)

M = TypeVar("M", bound=framing.DueMessage)


@dataclass(frozen=True)
class BoardPort:
    """A port of an Arduino Due: "native" is the one to use, "programming" cannot carry the data."""

    device: str
    kind: str
    serial_number: str


def list_due_ports() -> list[BoardPort]:
    """Return the ports of this host that look like a Due, native ones first; RigFault("refused") without pyserial."""
    ports = [
        BoardPort(port.device, _DUE_PORTS[port.pid], port.serial_number or "")
        for port in host_ports()
        if port.vid in _VENDORS and port.pid in _DUE_PORTS
    ]
    return sorted(ports, key=lambda port: (port.kind, port.device))


def find_due_port(rig: RigSettings) -> str:
    """Return the board's port: that of `[rig]`, or the first Due if it is "auto"; RigFault("refused") if none is."""
    if rig.port != "auto":
        return rig.port
    if not (ports := list_due_ports()):
        raise RigFault("refused", '[rig] port is "auto" and no board is found', "plug it in, or name its port")
    return ports[0].device


class DueLink:
    """An open port that carries messages. Any method but `close` raises RigFault("lost") once the board is gone."""

    def __init__(self, port: str) -> None:
        """Open `port` exclusively; raises RigFault("refused") if that fails."""
        self.decoder = framing.DueDecoder()
        self._stream = SerialStream(port, BAUD, POLL_S)

    def receive(self) -> tuple[float, list[framing.DueMessage]]:
        """Wait shortly for bytes; return the host time and the messages that they complete."""
        now_s, data = self._stream.receive()
        return now_s, self.decoder.decode(data)

    def send(self, command: Request | BoardSettings) -> None:
        """Send one command."""
        self._stream.send(framing.encode(command))

    def request(self, command: Request | BoardSettings, kind: type[M], matches: Callable[[M], bool] | None = None) -> M:
        """Send a command until a message of this kind that matches comes; RigFault("stale") after a second without."""
        deadline = time.monotonic() + _ANSWER_S
        resend_s = 0.0
        while (now := time.monotonic()) < deadline:
            if now >= resend_s:
                self.send(command)
                resend_s = now + _RESEND_S
            for message in self.receive()[1]:
                if isinstance(message, kind) and (matches is None or matches(message)):
                    return message
        raise RigFault("stale", f"{self._stream.port}: no answer within {_ANSWER_S:g} s")

    def close(self) -> None:
        """Close the port; never raises."""
        self._stream.close()


class DueBoard:
    """An Arduino Due that samples the fibres at a fixed rate; implements `Board`.

    The host time of a sample is when its last conversion was complete, but for the least delay of the USB link.
    """

    def __init__(
        self, port: str, rate_hz: float, inputs: Sequence[int] = (), supply_v: float = 3.3, averaging: int = 1
    ) -> None:
        """Take the settings; nothing is opened before `connect`.

        Args:
            port: name of the native USB port.
            rate_hz: samples a second, 10 to 10 000.
            inputs: which to read, fibre by fibre, 0 for A0 to 11; all in order if empty.
            supply_v: reading at full scale, V.
            averaging: conversions summed to a sample, 1 to 16.
        """
        limits = ("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ), ("averaging", averaging, 1, framing.MAX_AVERAGING)
        for name, value, low, high in limits:
            if not low <= value <= high:
                raise InputError(f"{name} is {value:g}, expected {low:g} to {high:g}")
        self._inputs = select_inputs(inputs, framing.MAX_CHANNELS, "an Arduino Due")
        self._port = port
        self._settings = BoardSettings(round(1e9 / rate_hz), sum(1 << i for i in set(self._inputs)), averaging)
        self._supply_v = supply_v
        self._link: DueLink | None = None
        self._reader: BlockReader[DueBlock] | None = None
        self._assembler: DueAssembler | None = None

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "DueBoard":
        """Return the board that `[rig]` names; see `__init__` and `find_due_port`."""
        return cls(find_due_port(rig), rig.board_rate_hz, inputs)

    def connect(self) -> dict[str, Any]:
        """Open the port, check the firmware, configure the board and start it; see `Board`."""
        self.close()
        self._link = link = DueLink(self._port)
        try:
            identity = self._identify(link)
            settings = self._configure(link)
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
        """Return all samples since the last call, volts; see `Board`. RigFault("data") if overfull or out of step."""
        if self._reader is None or self._assembler is None:
            raise RigFault("refused", f"{self._port}: not connected")
        return self._assembler.assemble(self._reader.drain())

    def statistics(self) -> dict[str, float]:
        """Return counts since `connect`, of what has been read; overruns are missing samples that the board dropped."""
        assembler = self._assembler
        return {
            "blocks": assembler.blocks if assembler else 0,
            "damaged": self._link.decoder.damaged if self._link else 0,
            "missing": assembler.missing if assembler else 0,
            "overruns": assembler.overruns if assembler else 0,
            "skew_ppm": assembler.clock.skew_ppm if assembler else 0.0,
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

    def _identify(self, link: DueLink) -> Identity:
        try:
            identity = link.request(Request(Kind.IDENTIFY), Identity)
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

    def _configure(self, link: DueLink) -> BoardSettings:
        link.request(Request(Kind.STOP), Ack, lambda ack: ack.command == Kind.STOP)
        ack = link.request(self._settings, Ack, lambda ack: ack.command == Kind.SETTINGS)
        if ack.status != Status.OK:
            settings = self._settings
            message = (
                f"{self._port}: the board refuses {settings.mask.bit_count()} channels at {1e9 / settings.period_ns:g} "
                f"Hz with {settings.averaging} conversions a sample (status {ack.status})"
            )
            raise RigFault("refused", message, "lower the rate, the channels or the averaging")
        return ack.settings

    def _start(self, link: DueLink, settings: BoardSettings) -> None:
        halted = False

        def receive() -> tuple[float, list[DueBlock]]:
            nonlocal halted
            if halted:
                raise RigFault("data", f"{self._port}: the board has lost conversions and stopped")
            now_s, messages = link.receive()
            halted = any(isinstance(message, Ack) and message.status == Status.HALTED for message in messages)
            return now_s, [message for message in messages if isinstance(message, DueBlock)]

        link.decoder.damaged = 0
        self._reader = BlockReader(self._port, receive, 1e9 / settings.period_ns)
        self._reader.start_settled(lambda: link.send(Request(Kind.START)))


class DueAssembler:
    """Makes `BoardSamples` of blocks: host times by a `SampleClock`, volts by fibre, missing samples by the index."""

    def __init__(self, settings: BoardSettings, inputs: Sequence[int], supply_v: float) -> None:
        self.clock = SampleClock(settings.period_ns * 1e-9)
        self.blocks = self.missing = self.overruns = 0  # overruns: missing samples that the board dropped
        self._settings = settings
        self._columns = [sorted(set(inputs)).index(i) for i in inputs]  # blocks hold the inputs in ascending order
        self._volts = supply_v / (settings.averaging * framing.FULL_SCALE)
        self._next = 0
        self._time_us: int | None = None

    def assemble(self, arrivals: Iterable[tuple[float, DueBlock]]) -> BoardSamples:
        """Return the samples of blocks with their arrival times; RigFault("data") if one cannot follow those before."""
        placed = []
        for arrival_s, block in arrivals:
            first, missing = self._place(block)
            self.clock.observe(first + len(block.counts) - 1, arrival_s)
            placed.append((first, missing, block.counts))
        times = [self.clock.times(np.arange(first, first + len(counts))) for first, _, counts in placed]
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
        samples = missing + len(block.counts)
        if self._time_us is not None:
            elapsed_us = round(samples * self._settings.period_ns / 1000)
            jump_us = (block.time_us - self._time_us - elapsed_us + 2**31) % 2**32 - 2**31
            if elapsed_us >= 2**32 or abs(jump_us) > _MAX_JUMP_US:
                message = f"sample {block.first} came {jump_us} us off its time"
                raise RigFault("data", message, "the board may have been reset; connect again")
        self._time_us = block.time_us
        first = self._next + missing
        self._next = first + len(block.counts)
        self.blocks += 1
        self.missing += missing
        self.overruns = block.overruns
        return first, missing
