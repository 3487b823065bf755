"""Where live readings come from: a converter, the simulated pad of a model, or a recording that is replayed."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import read_json
from padforge.design.common.settings import validate
from padforge.design.common.validation import InputError, check_float
from padforge.design.settings import Contact, PadSettings
from padforge.sense.recordings.processing.limits import Array
from padforge.sense.recordings.recorder import FORMAT, START
from padforge.sense.recordings.recording import Recording, is_mirrored
from padforge.sense.rig.devices.protocols import Converter
from padforge.sense.rig.session.averaging import Averager
from padforge.sense.settings import RigSettings

if TYPE_CHECKING:
    from padforge.sense.rig.emulators.live_pad import SimulatedConverter

Block = tuple[Array, Array]
"""Times (n,) in s, and readings (n, C) in V."""

PAUSE_S = 0.01
"""Between two looks at a converter, or at the clock of a replay."""
MOST_ROWS = 64
"""Readings that are replayed at a time, so that a fast replay can be watched too."""
RECORDED = "recording"
"""The recording that a model was learnt from, in the folder of the model."""


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


def connected(converter: Converter, rate_hz: float) -> Source:
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
    from padforge.sense.rig.emulators.live_pad import SimulatedConverter

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
