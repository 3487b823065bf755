"""The converter of the real rig: an Arduino Due on its native USB port, with the firmware beside this module."""

import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from design.common.errors import InputError
from sense.rig.devices.protocols import ConverterSamples, RigFault
from sense.settings import RigSettings

from .framing import FULL_SCALE, MAX_AVERAGING, MAX_CHANNELS, Ack, Block, BoardSettings, Identity, Kind, Request, Status
from .sample_clock import SampleClock
from .serial_link import POLL_S, SerialLink, port_of

FIRMWARE_MAJOR = 1
"""Boards with another first number of the firmware version speak another wire format."""
MIN_RATE_HZ, MAX_RATE_HZ = 10.0, 10_000.0

_FIRMWARE = "sense/rig/boards/due/firmware/padforge_due"
_ANSWER_S = 1.0
_SETTLE_S = 0.5
"""Blocks gathered before the first reading is given, so that its time rests on more than one arrival."""
_START_S = 1.5
_STALL_S = 1.0
_UNREAD_S = 60.0
_JUMP_US = 5000
"""Board time and sample index may differ by so much from block to block: interrupts come late."""

Arrival = tuple[float, Block]
"""A block and the host time at which it came."""


class Arduino:
    """An Arduino Due that reads `channels` fibres, at A0 and on, every 1 / `rate_hz`; implements `Converter`.

    The host time of a sample is when its last conversion was complete, apart from the least delay of the USB link.
    """

    def __init__(self, port: str, rate_hz: float, channels: int = 8, supply_v: float = 3.3, averaging: int = 1) -> None:
        """Take the settings; nothing is opened before `connect`.

        Args:
            port: name of the native USB port. rate_hz: samples per second, 10 to 10 000. channels: 1 to 12.
            supply_v: reading at full scale, V. averaging: conversions summed to a sample, 1 to 16.

        Raises:
            InputError: a value is out of range.
        """
        _within("rate_hz", rate_hz, MIN_RATE_HZ, MAX_RATE_HZ)
        _within("channels", channels, 1, MAX_CHANNELS)
        _within("averaging", averaging, 1, MAX_AVERAGING)
        self._port = port
        self._wanted = BoardSettings(round(1e9 / rate_hz), (1 << channels) - 1, averaging)
        self._supply_v = supply_v
        self._link: SerialLink | None = None
        self._reader: _Reader | None = None
        self._assembler: Assembler | None = None

    @classmethod
    def of(cls, rig: RigSettings, inputs: Sequence[int]) -> "Arduino":
        """The board that `[rig]` names, looked for where its port is "auto"; see `__init__` and `port_of`."""
        return cls(port_of(rig), rig.converter_rate_hz, len(inputs))

    def connect(self) -> dict[str, Any]:
        """Open the port, check the firmware, set the board and start it; see `Converter`."""
        self.close()
        self._link = link = SerialLink(self._port)
        try:
            identity = self._identify(link)
            settings = self._set(link)
            self._assembler = Assembler(settings, self._supply_v)
            self._start(link, settings)
        except BaseException:
            self.close()
            raise
        return {
            "name": identity.name,
            "firmware": ".".join(map(str, identity.firmware)),
            "serial": identity.serial.hex(),
            "channels": settings.mask.bit_count(),
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
        link.decoder.damaged = 0
        self._reader = reader = _Reader(link, round(_UNREAD_S * 1e9 / settings.period_ns))
        reader.start()
        deadline = time.monotonic() + _START_S
        while reader.span_s() < _SETTLE_S:
            if reader.span_s() == 0:
                link.send(Request(Kind.START))
            reader.check()
            if time.monotonic() > deadline:
                raise RigFault("stale", f"{self._port}: the board does not send", "reset it and connect again")
            time.sleep(POLL_S)


class Assembler:
    """Makes `Samples` of blocks: times by a `SampleClock`, volts, and what is missing by the index.

    Attributes:
        blocks, missing, overruns: blocks so far, samples that are missing, those of them dropped by the board.
    """

    def __init__(self, settings: BoardSettings, supply_v: float) -> None:
        self.clock = SampleClock(settings.period_ns * 1e-9)
        self.blocks = self.missing = self.overruns = 0
        self._settings = settings
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
        times = [self.clock.times(first, len(counts)) for first, _, counts in placed]
        missing = [np.r_[lost, np.zeros(len(counts) - 1, np.int64)] for _, lost, counts in placed]
        channels = self._settings.mask.bit_count()
        return ConverterSamples(
            np.concatenate([np.empty(0), *times]),
            np.concatenate([np.empty((0, channels)), *(counts for *_, counts in placed)]) * self._volts,
            np.concatenate([np.empty(0, np.int64), *missing]),
        )

    def _place(self, block: Block) -> tuple[int, int]:
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


class _Reader(threading.Thread):
    """Drains the port into a buffer of at most `capacity` samples, until stopped or something fails."""

    def __init__(self, link: SerialLink, capacity: int) -> None:
        super().__init__(name=f"reader of {link.port}", daemon=True)
        self._link = link
        self._capacity = capacity
        self._arrivals: deque[Arrival] = deque()
        self._waiting = 0
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._fault: RigFault | None = None

    def run(self) -> None:
        try:
            self._drain()
        except RigFault as fault:
            self._fault = fault
        except Exception as error:  # a reader that dies silently would look like a pad at rest
            self._fault = RigFault("lost", f"{self._link.port}: the reader has failed ({error!r})")

    def take(self) -> list[Arrival]:
        """All that waits; raises the fault that ended the reading once nothing does."""
        with self._lock:
            arrivals = list(self._arrivals)
            self._arrivals.clear()
            self._waiting = 0
        if not arrivals:
            self.check()
        return arrivals

    def check(self) -> None:
        """Raise the fault that ended the reading, if any."""
        if self._fault is not None:
            raise self._fault

    def span_s(self) -> float:
        """Time between the first and the last arrival that wait."""
        with self._lock:
            return self._arrivals[-1][0] - self._arrivals[0][0] if self._arrivals else 0.0

    def stop(self) -> None:
        """End the reading, within `POLL_S`."""
        self._stopped.set()
        self.join()

    def _drain(self) -> None:
        silent_s, before_s = 0.0, time.monotonic()
        while not self._stopped.is_set():
            now_s, frames = self._link.receive()
            silent_s += min(now_s - before_s, 2 * POLL_S)  # a host that slept has not waited in vain
            before_s = now_s
            for frame in frames:
                if isinstance(frame, Block):
                    silent_s = 0.0
                    self._put((now_s, frame))
                elif isinstance(frame, Ack) and frame.status == Status.HALTED:
                    raise RigFault("data", f"{self._link.port}: the board has lost conversions and stopped")
            if silent_s > _STALL_S:
                raise RigFault("stale", f"{self._link.port}: no sample for {silent_s:.1f} s", "reset the board")

    def _put(self, arrival: Arrival) -> None:
        with self._lock:
            self._arrivals.append(arrival)
            self._waiting += len(arrival[1].counts)
        if self._waiting > self._capacity:
            raise RigFault("data", f"{self._link.port}: nobody has read the samples for {_UNREAD_S:g} s")


def _within(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise InputError(f"{name} is {value:g}, expected {least:g} to {most:g}")
