"""What happens to a pad, as messages that are the same over every way out (docs/live-protocol.md).

A message is a `publish` operation of the rosbridge protocol, with a standard message of ROS 2 under the same topic as
in an exported bag, so a bridge has nothing to convert; beside it stands the same in plain numbers, mm and V.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from padforge.sense.health.monitor import FibreFault
from padforge.sense.live.pipeline import Estimate, Event, Live
from padforge.sense.recordings.formats.ros.topics import (
    FRAME,
    HEALTH,
    KINDS,
    NOT_KNOWN,
    PRESSED,
    R90,
    READINGS,
    TOUCHES,
)
from padforge.sense.recordings.processing.limits import Array

FORMAT = "padforge-live/1"
_OK, _ERROR = 0, 2
"""Levels of a `DiagnosticStatus`."""
SOUND = ("sound", "unwatched")


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        topic: a key of `KINDS`. msg: the ROS message, as JSON. pad: the same in plain numbers; has "event".
    """

    topic: str
    msg: dict[str, Any]
    pad: dict[str, Any]

    def line(self, number: int) -> str:
        """The message as one line of JSON, the `number`-th that was told, from 0."""
        pad = {"format": FORMAT, "number": number, **self.pad}
        operation = {"op": "publish", "topic": self.topic, "type": KINDS[self.topic], "msg": self.msg, "pad": pad}
        return json.dumps(operation, allow_nan=False)


class Messages:
    """Makes messages of what a pipeline is fed and finds.

    Args:
        mirrored: whether the pad lies with its tracks up, so that z has to point into it, as in an exported bag.
    """

    def __init__(self, pipeline: Live, mirrored: bool = False) -> None:
        self._pipeline, self._pressed = pipeline, False
        self._inwards = 1.0 if mirrored else -1.0
        self._told_health = False

    def of(self, times_s: Array, readings: Array, events: Sequence[Event]) -> Iterator[Message]:
        """Messages of a block of readings, (n,) s and (n, C) V, and of what came to light with it."""
        if not len(times_s):
            return
        now_s = float(times_s[-1])
        if not self._told_health:
            yield self._health(float(times_s[0]), None)
        for time_s, volts in zip(times_s.tolist(), readings.tolist(), strict=True):
            yield _readings(time_s, volts)
        if self._pipeline.pressed != self._pressed:
            self._pressed = not self._pressed
            yield Message(PRESSED, {"data": self._pressed}, _plain("pressed", now_s, pressed=self._pressed))
        for event in events:
            yield _touch(event, self._inwards) if isinstance(event, Estimate) else self._health(now_s, event)

    def _health(self, time_s: float, fault: FibreFault | None) -> Message:
        self._told_health = True
        states = [fibre["state"] for fibre in self._pipeline.view()["fibres"]]
        status = [
            {
                "level": _OK if state in SOUND else _ERROR,
                "name": f"pad: fibre {fibre}",
                "message": state,
                "hardware_id": "pad",
                "values": [],
            }
            for fibre, state in enumerate(states, 1)
        ]
        told = {} if fault is None else {"fault": {**asdict(fault), "text": fault.text}}
        return Message(
            HEALTH, {"header": _header(time_s), "status": status}, _plain("health", time_s, states=states, **told)
        )


def _plain(event: str, time_s: float, **more: Any) -> dict[str, Any]:
    return {"event": event, "time_s": time_s, **more}


def _readings(time_s: float, volts: list[float]) -> Message:
    told = [None if math.isnan(each) else each for each in volts]
    dimension = {"label": "fibre", "size": len(told), "stride": len(told)}
    return Message(
        READINGS,
        {"layout": {"dim": [dimension], "data_offset": 0}, "data": told},
        _plain("readings", time_s, volts=told),
    )


def _touch(found: Estimate, inwards: float) -> Message:
    variances = [0.0] * 36
    variances[0], variances[7] = (found.sd_x_mm / 1000) ** 2, (found.sd_y_mm / 1000) ** 2
    variances[14] = (found.depth_r90_mm / 1000 / R90) ** 2 if found.depth_r90_mm is not None else NOT_KNOWN
    position = {"x": found.x_mm / 1000, "y": found.y_mm / 1000, "z": 0.0 + inwards * (found.depth_mm or 0.0) / 1000}
    pose = {"position": position, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return Message(
        TOUCHES,
        {"header": _header(found.time_s), "pose": {"pose": pose, "covariance": variances}},
        {"event": "touch", **found.document, "lost": list(found.lost)},
    )


def _header(time_s: float) -> dict[str, Any]:
    """A header of that time of the readings' clock, which begins when the readings do."""
    seconds = math.floor(time_s)
    return {"stamp": {"sec": seconds, "nanosec": round((time_s - seconds) * 1e9) % 10**9}, "frame_id": FRAME}
