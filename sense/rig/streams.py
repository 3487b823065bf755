"""The press under way, and the latest readings it is told from; by the indices of readings in their stream.

Where live readings come from: a converter, the simulated pad of a model, or a recording that is replayed.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from padforge.design.common.files import read_json
from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError, check_float
from padforge.design.settings import Contact, PadSettings
from padforge.sense.arrays import Array
from padforge.sense.health.trace_model import RELEASED
from padforge.sense.localizer.features import DOWN, FEATURES, SLOW, UP
from padforge.sense.recording.recording import Recording, is_mirrored
from padforge.sense.recording.run_directory import FORMAT, START
from padforge.sense.rig.devices import Board, BoardSamples
from padforge.sense.settings import RigSettings

if TYPE_CHECKING:
    from padforge.sense.virtual.virtual_pad import SimulatedConverter


HISTORY = SLOW[-1]
"""Readings before a press that its localizer looks at, as far as there are so many."""
SUNK = DOWN[-1][1]
"""Readings after the probe was sent down that are looked at; of the others until it is sent up, none is."""
NEEDS = {name: each.readings_needed for name, each in FEATURES.items()}
"""Readings that features take after the probe was sent down, and after it was sent up."""
DONE = max(UP[-1][1], RELEASED)
"""Readings after the probe was sent up with which a press is done."""
SLACK = 4096
"""Readings kept beyond `HISTORY`: a press is found only some readings after it began."""


class Ring:
    """The latest rows of a stream, at least `HISTORY` + `SLACK` of them.

    Attributes:
        end: how many rows there have been.
    """

    def __init__(self, columns: int) -> None:
        self._rows = np.empty((2 * (HISTORY + SLACK), columns))
        self._filled = 0
        self.end = 0

    def append(self, row: Array) -> None:
        """Add a row (columns,)."""
        if self._filled == len(self._rows):
            self._filled //= 2
            self._rows[: self._filled] = self._rows[self._filled :]
        self._rows[self._filled] = row
        self._filled += 1
        self.end += 1

    def rows(self, first: int, end: int) -> Array:
        """(n, columns) those of `first` <= index < `end` that are there still; a view, good until the next `append`."""
        gone = self.end - self._filled
        return self._rows[max(first - gone, 0) : max(min(end - gone, self._filled), 0)]

    def sent(self, reading: int, delay_s: float) -> int:
        """Index of the reading, times being column 0, at which a probe would have been sent that shows `delay_s` later.

        Args:
            reading: index of the first one that shows it.
        """
        times_s = self.rows(0, reading + 1)[:, 0]
        return reading + 1 - len(times_s) + int(np.searchsorted(times_s, times_s[-1] - delay_s))


class Excerpt(NamedTuple):
    """The readings (n, C) V that tell of a press, and at which of them it begins and ends, and the one before ended."""

    readings: Array
    down_command: int
    up_command: int
    free: int


@dataclass
class BufferedPress:
    """A press under way.

    Attributes:
        number: counted from 0. time_s: when the pad was touched. touched: index of the first reading that shows it.
        down_command: index of the first reading after the probe was sent down, or would have been.
        free: index of the reading at which the press before was let go, < begun.
        rest: (C,) V before it.
        up_command: index of the first reading after it was let go; None while it is held.
        told: how many localizers have told its place.
    """

    number: int
    time_s: float
    touched: int
    down_command: int
    free: int
    rest: Array
    up_command: int | None = None
    told: int = 0
    _opening: Array | None = None

    def let_go(self, up_command: int) -> None:
        """It was let go by the reading of index `up_command`."""
        self.up_command = max(up_command, self.down_command + 1)

    def enough(self, features: str) -> int | None:
        """Index of the first reading that `features` can do without; None while that is not known."""
        down, up = NEEDS[features]
        if up == 0:
            return (
                self.down_command + down if self.up_command is None else min(self.down_command + down, self.up_command)
            )
        return None if self.up_command is None else self.up_command + up

    def keep_opening(self, ring: Ring) -> None:
        """Keep what was before it and its first readings, once these are there, however long it will be held."""
        if self._opening is None and self.up_command is None and ring.end >= self.down_command + SUNK:
            self._opening = ring.rows(self.down_command - HISTORY, self.down_command + SUNK)[:, 1:].copy()

    def excerpt(self, ring: Ring, end: int) -> Excerpt:
        """Its readings up to index `end`; of a press that was held for long, without those that nobody looks at."""
        up_command = end if self.up_command is None else min(self.up_command, end)
        if self._opening is None or up_command <= self.down_command + SUNK:
            readings = ring.rows(self.down_command - HISTORY, end)[:, 1:]
            down_command = len(readings) - (end - self.down_command)
            up = down_command + up_command - self.down_command
        else:
            readings = np.concatenate([self._opening, ring.rows(up_command, end)[:, 1:]])
            up = len(self._opening)
            down_command = up - SUNK
        return Excerpt(readings, down_command, up, max(down_command - (self.down_command - self.free), 0))


Block = tuple[Array, Array]
"""Times (n,) in s, and readings (n, C) in V."""

PAUSE_S = 0.01
"""Between two looks at a converter, or at the clock of a replay."""
MOST_ROWS = 64
"""Readings that are replayed at a time, so that a fast replay can be watched too."""
RECORDED = "recording"
"""The recording that a model was learnt from, in the folder of the model."""


class Averager:
    """Means over `ratio` samples by the converter's own count, so that a lost sample shifts nothing.

    A mean is over the samples of its stretch that came; where none came there is no reading.

    Attributes:
        lost: samples that never came.
    """

    def __init__(self, ratio: int, channels: int) -> None:
        self._ratio = ratio
        self._index = 0
        self._waiting = np.empty((0, 2 + channels))  # stretch, time, volts
        self.lost = 0

    def feed(self, samples: BoardSamples) -> tuple[Array, Array]:
        """Times (n,) and volts (n, C) of the stretches that are complete now; the others wait for more samples."""
        if len(samples.times_s) == 0:
            return np.empty(0), np.empty((0, self._waiting.shape[1] - 2))
        counts = self._index + np.arange(len(samples.times_s)) + np.cumsum(samples.missing)
        self._index = int(counts[-1]) + 1
        self.lost += int(samples.missing.sum())
        fresh = np.column_stack([counts // self._ratio, samples.times_s, samples.volts])
        rows = np.vstack([self._waiting, fresh])
        complete = rows[:, 0] < self._index // self._ratio
        self._waiting = rows[~complete]
        rows = rows[complete]
        stretches, first, count = np.unique(rows[:, 0], return_index=True, return_counts=True)
        if len(stretches) == 0:
            return np.empty(0), np.empty((0, rows.shape[1] - 2))
        means = np.add.reduceat(rows[:, 1:], first) / count[:, None]
        return means[:, 0], means[:, 1:]


@dataclass(frozen=True)
class Source:
    """Readings as they come.

    Attributes:
        fibres: C. rate_hz: readings a second. blocks: of readings, as they come; they may be empty.
        converter: what it says of itself, if it is one.
    """

    fibres: int
    rate_hz: float
    blocks: Iterator[Block]
    converter: Mapping[str, Any] = field(default_factory=dict)


def connected(converter: Board, rate_hz: float) -> Source:
    """The readings of a converter, which is connected now, averaged to about `rate_hz`; without end.

    Raises:
        RigFault: as the converter does, now or while its readings are taken.
    """
    identity = converter.connect()
    ratio = max(1, round(identity["rate_hz"] / rate_hz))
    averager = Averager(ratio, identity["channels"])

    def blocks() -> Iterator[Block]:
        while True:
            yield averager.feed(converter.read())
            time.sleep(PAUSE_S)

    return Source(identity["channels"], identity["rate_hz"] / ratio, blocks(), identity)


def replayed(recording: Recording, speed: float) -> Source:
    """The readings of a recording, `speed` times as fast as they were taken; InputError for a speed that is none."""
    speed = check_float("speed", speed, 1e-9, np.inf)
    due_s = (recording.times_s - recording.times_s[0]) / speed

    def blocks() -> Iterator[Block]:
        started_s, done = time.monotonic(), 0
        while done < len(due_s):
            due = int(np.searchsorted(due_s, time.monotonic() - started_s, side="right"))
            end = min(due, done + MOST_ROWS)
            yield recording.times_s[done:end], recording.readings[done:end]
            if end == due:
                time.sleep(PAUSE_S)
            done = end

    return Source(recording.fibres, recording.rate_hz, blocks())


def lies_mirrored(model: Path, rig: RigSettings) -> bool:
    """Return whether the pad lies with its tracks up, so that x and y of its plan are right-handed with z into it.

    `[rig]` says so. Where it leaves that open, the pad lies as it did when the model was learnt: in a holder, perhaps,
    which only the recording tells of.

    Args:
        model: folder of the model.
        rig: settings of the rig that reads the pad.

    Raises:
        InputError: the recording beside the model is damaged.
    """
    if rig.mirrored is not None:
        return rig.mirrored
    path = model / RECORDED / START
    return path.is_file() and is_mirrored(read_json(path, FORMAT).get("source"))


def simulated(model: Path) -> "SimulatedConverter":
    """The pad that the model in this folder was learnt from, where that was a simulated one.

    Raises:
        InputError: its recording is not beside it, or of another kind.
    """
    from padforge.design.morphology import Morphology  # needs what only other jobs need
    from padforge.sense.virtual.virtual_pad import SimulatedConverter

    path = model / RECORDED / START
    if not path.is_file():
        raise InputError(f"{path}: not there, though it says which pad to simulate; name a model of `padforge run`")
    source = read_json(path, FORMAT).get("source")
    if not isinstance(source, dict) or source.get("kind") != "simulated":
        raise InputError(f"{path}: of no simulated pad, but --rig simulated needs one; --replay shows a recording")
    if "twin" in source:
        raise InputError(f"{path}: of a pad simulated by its twin, which is not live; --replay shows a recording")
    try:
        pad = Morphology.from_dict(source["morphology"])
        contact, rig = dict(source["contact"]), dict(source["rig"])
        rig.pop("channels", None)  # of no simulated pad; once it was a number
        size = {key: source[key] for key in ("sensed_mm", "keep_out_mm") if key in source}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: says of no pad that can be simulated ({error})") from error
    return SimulatedConverter(
        pad,
        validate(RigSettings, rig, f"{path}: rig"),
        validate(Contact, contact, f"{path}: contact"),
        size=validate(PadSettings, {**pad.layout.settings, **size}, f"{path}: pad"),
    )
