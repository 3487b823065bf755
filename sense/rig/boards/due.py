"""The board of the published rig: an Arduino Due on its native USB port, with the firmware beside this module."""

import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from padforge.design.common.validation import check_float
from padforge.sense.rig.boards import due_framing as framing
from padforge.sense.rig.boards.board_reader import BoardDriver, SampleClock, select_inputs
from padforge.sense.rig.boards.due_framing import Ack, BoardSettings, DueBlock, Identity, Kind, Request, Status
from padforge.sense.rig.devices import BoardSamples, RigFault, SerialStream, host_ports
from padforge.sense.settings import RigSettings

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

M = TypeVar("M", bound=framing.DueMessage)


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

    STOP_MESSAGE = framing.encode(Request(Kind.STOP))

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
        self._inputs = select_inputs(inputs, framing.MAX_CHANNELS, "an Arduino Due")
        self._settings = BoardSettings(round(1e9 / rate_hz), sum(1 << i for i in set(self._inputs)), averaging)
        self._decoder = framing.DueDecoder()
        self._halted = False

    @classmethod
    def from_settings(cls, rig: RigSettings, inputs: Sequence[int]) -> "DueBoard":
        """Return the board that `[rig]` names; see `__init__` and `find_due_port`."""
        return cls(find_due_port(rig), rig.board_rate_hz, inputs)

    def _start(self, stream: SerialStream) -> dict[str, Any]:
        self._decoder, self._halted = framing.DueDecoder(), False
        identity = self._identify(stream)
        settings = self._configure(stream)
        rate_hz, start = 1e9 / settings.period_ns, framing.encode(Request(Kind.START))
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

    def _receive(self, stream: SerialStream) -> tuple[float, list[framing.DueMessage]]:
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
        deadline = time.monotonic() + _ANSWER_S
        resend_s = 0.0
        while (now := time.monotonic()) < deadline:
            if now >= resend_s:
                stream.send(framing.encode(command))
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
        self._volts = SUPPLY_V / (settings.averaging * framing.FULL_SCALE)
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
