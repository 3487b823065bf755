"""The converter of the real rig: an Arduino Due on its native USB port, with the firmware beside this module."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.rig.boards.block_reader import BlockReader
from padforge.sense.rig.boards.inputs import chosen_inputs
from padforge.sense.rig.boards.sample_clock import SampleClock
from padforge.sense.rig.devices.protocols import ConverterSamples, RigFault
from padforge.sense.settings import RigSettings

from padforge.sense.rig.boards.due.framing import (
    FULL_SCALE,
    MAX_AVERAGING,
    MAX_CHANNELS,
    Ack,
    BoardSettings,
    DueBlock,
    Identity,
    Kind,
    Request,
    Status,
)
from padforge.sense.rig.boards.due.serial_link import SerialLink, port_of

FIRMWARE_MAJOR = 1
"""Boards with another first number of the firmware version speak another wire format."""
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_FIRMWARE = "sense/rig/boards/due/firmware/padforge_due"
_ANSWER_S = 1.0
_JUMP_US = 5000
"""Board time and sample index may differ by so much from block to block: interrupts come late."""

Arrival = tuple[float, DueBlock]
"""A block and the host time at which it came."""


class Arduino:
    """An Arduino Due that reads fibres every 1 / `rate_hz`; implements `Converter`.

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
        return cls(port_of(rig), rig.converter_rate_hz, inputs)

    def connect(self) -> dict[str, Any]:
        """Open the port, check the firmware, set the board and start it; see `Converter`."""
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

    def read(self) -> ConverterSamples:
        """All samples since the last call, C columns of volts; see `Converter`.

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

    def samples(self, arrivals: Iterable[Arrival]) -> ConverterSamples:
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
        return ConverterSamples(
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
