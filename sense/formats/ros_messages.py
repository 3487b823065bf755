"""A recording as messages of ROS 2: which topics there are, and what their messages say.
Numbers are in the units that ROS has by REP 103: m, N, V. Places lie in the frame `pad`: its origin is the middle of
the pad, x and y run as on the plan, z points away from the surface; of a pad that lay mirrored into it, for the frame
to be right-handed there too. A press has its messages at the reading that follows its begin or its end.

What messages round off of a recording, in one message beside them: stamps are whole ns, places m instead of mm.

The health of a pad as `diagnostic_msgs`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, check_float
from padforge.sense.arrays import MAX_S, Array
from padforge.sense.formats.annotations import ModelFindings
from padforge.sense.formats.ros_bag import blank
from padforge.sense.recording.recording import Recording

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


READINGS, PRESSED, PLACE = "/pad/readings", "/pad/pressed", "/pad/place"
REACHED, FORCE, RECORDING = "/pad/reached", "/pad/force", "/pad/recording"
TOUCHES, HEALTH, ARM = "/pad/touches", "/pad/health", "/arm/pose"
FRAME, ARM_FRAME = "pad", "base"
KINDS = {
    READINGS: "std_msgs/msg/Float64MultiArray",
    PRESSED: "std_msgs/msg/Bool",
    PLACE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    REACHED: "geometry_msgs/msg/PointStamped",
    FORCE: "geometry_msgs/msg/WrenchStamped",
    RECORDING: "std_msgs/msg/String",
    TOUCHES: "geometry_msgs/msg/PoseWithCovarianceStamped",
    HEALTH: "diagnostic_msgs/msg/DiagnosticArray",
    ARM: "geometry_msgs/msg/PoseStamped",
}
UNITS = {
    READINGS: "V, one value for each fibre; NaN where one is missing",
    PRESSED: "true while the probe is sent down",
    PLACE: "m, z is minus the depth commanded (plus, where the pad lay mirrored: frames are right-handed); "
    "covariance 0 is as commanded, -1 not known; unknown places are left out",
    REACHED: "m, z is minus the depth that the arm found itself at",
    FORCE: "N on the probe, along z",
    RECORDING: "what the messages round off, as JSON: times in s, places and depths in mm, forces in N",
    TOUCHES: "m, places found by a model, with their variances in m^2; -1 where depth was not learnt",
    HEALTH: "which fibre is at fault, by a model",
    ARM: "m and a quaternion, pose of the tool in the frame of the arm",
}
"""What is said of each topic in the bag."""
X, Y, Z = (f"pose.pose.position.{axis}" for axis in "xyz")
COVARIANCE = "pose.covariance"
NOT_KNOWN = -1.0
"""A variance of what is not known, as in `sensor_msgs/msg/Imu`."""
R90 = 1.6449
"""Standard deviations that hold 90 % of a normal distribution, to both sides."""
_LONGEST_S = 2**31
"""Seconds that the stamp of a message can count."""


@dataclass(frozen=True)
class Stream:
    """Messages of one topic: (n,) stamps in ns, ascending, and the numbers in them, (n,) or (n, k) by their path."""

    stamps: NDArray[np.int64]
    fields: Mapping[str, NDArray[Any]]

    def same(self, other: "Stream") -> bool:
        """Whether the messages of another one say the same at the same times."""
        return np.array_equal(self.stamps, other.stamps) and all(
            np.array_equal(values, other.fields[path], equal_nan=True) for path, values in self.fields.items()
        )


def epoch_of(times_s: Array) -> float:
    """What is taken from (n,) times for stamps to count from 0: nothing, where stamps hold the times as they are.

    Raises:
        InputError: they last longer than stamps can count.
    """
    if times_s[-1] - times_s[0] >= _LONGEST_S - 2:
        raise InputError(f"recording lasts {times_s[-1] - times_s[0]:g} s, allowed in a bag are {_LONGEST_S - 2}")
    return 0.0 if times_s[0] >= 0 and times_s[-1] < _LONGEST_S - 1 else float(np.floor(times_s[0]))


def stamps_of(times_s: Array, epoch_s: float) -> NDArray[np.int64]:
    """(n,) times in ns since an epoch."""
    seconds = np.floor(times_s)
    return (seconds - epoch_s).astype(np.int64) * 10**9 + np.round((times_s - seconds) * 1e9).astype(np.int64)


def stamps_at(readings: NDArray[np.int64], indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stamps of readings by their indices; a reading that was not taken would have come one step after the last."""
    step = max(int(readings[-1] - readings[-2]), 1)
    return np.append(readings, readings[-1] + step)[indices]


def streams_of(recording: Recording, epoch_s: float) -> dict[str, Stream]:
    """What a recording says, by its topics; those without a message are left out."""
    stamps = stamps_of(recording.times_s, epoch_s)
    down_command, up_command = (
        stamps_at(stamps, indices) for indices in (recording.down_command, recording.up_command)
    )
    metres = recording.presses_mm / 1000
    deep = ~np.isnan(recording.depths_mm)
    variances = np.zeros((len(down_command), 36))
    variances[~deep, 14] = NOT_KNOWN
    places = {X: metres[:, 0], Y: metres[:, 1], Z: heights(recording, recording.depths_mm), COVARIANCE: variances}
    heights_m = heights(recording, recording.reached_mm)
    reached = {"point.x": metres[:, 0], "point.y": metres[:, 1], "point.z": heights_m}
    forces = {"wrench.force.z": _up(recording) * recording.forces_n}
    streams = {
        READINGS: Stream(stamps, {"data": recording.readings}),
        PRESSED: Stream(
            np.column_stack([down_command, up_command]).ravel(),
            {"data": np.tile(np.array([1, 0], np.uint8), len(down_command))},
        ),
        PLACE: _where(recording.known, down_command, places),
        REACHED: _where(~np.isnan(recording.reached_mm), down_command, reached),
        FORCE: _where(~np.isnan(recording.forces_n), down_command, forces),
    }
    return {topic: stream for topic, stream in streams.items() if len(stream.stamps)}


def heights(recording: Recording, depths_mm: Array) -> Array:
    """Where on z depths below the surface are, m; 0 where they are unknown."""
    return 0 - _up(recording) * np.nan_to_num(depths_mm) / 1000


def _up(recording: Recording) -> float:
    """Which way z has to point from the surface, for x and y of the plan to be right-handed with it."""
    return -1.0 if recording.mirrored else 1.0


def _where(there: NDArray[np.bool_], stamps: NDArray[np.int64], fields: Mapping[str, Array]) -> Stream:
    return Stream(stamps[there], {path: values[there] for path, values in fields.items()})


FORMAT = "padforge-ros/2"
_WHOLE = ("down_command", "up_command")
_NUMBERS = ("times_s", "presses_mm", "depths_mm", "reached_mm", "forces_n")
MOST_BYTES, MOST_PARTS = 2**26, 2**21
"""Most that the text may have, and most brackets, braces and quotes in it: Python makes much of little text."""


def written(recording: Recording, epoch_s: float, topics: Mapping[str, object]) -> str:
    """The text for a recording whose stamps count from `epoch_s`, and what is said of the `topics` of its bag.

    Raises:
        InputError: the text is too long to be read back.
    """
    arrays = {name: getattr(recording, name) for name in (*_NUMBERS, *_WHOLE)}
    document = {
        "format": FORMAT,
        "topics": {topic: UNITS[topic] for topic in topics},
        "digest": recording.digest,
        "epoch_s": epoch_s,
        "source": dict(recording.source),
        **{name: _listed(values) for name, values in arrays.items()},
    }
    text = json.dumps(document, allow_nan=False)
    if not _fits(text.encode()):
        raise InputError(
            f"recording is too long for a bag: {len(text)} characters of times, presses and source, "
            f"allowed are {MOST_BYTES}, with {MOST_PARTS} brackets and quotes"
        )
    return text


def _fits(text: bytes) -> bool:
    return len(text) <= MOST_BYTES and sum(map(text.count, (b"[", b"{", b'"'))) <= MOST_PARTS


def _listed(values: Any) -> list[Any]:
    """Numbers for JSON, which has no NaN: None."""
    missing = np.isnan(values)
    return np.where(missing, np.array(None), values).tolist() if missing.any() else values.tolist()


def read(text: bytes, readings: Array) -> tuple[Recording, float, str] | None:
    """The recording of a text, with its (R, C) readings from the messages, its epoch and the digest it had.

    None where the text is of another kind, or does not go with the readings.
    """
    if not _fits(text):
        return None
    try:
        document = json.loads(text)
        if document["format"] != FORMAT:
            return None
        arrays: dict[str, Any] = {name: np.array(document[name], np.float64) for name in (*_NUMBERS, *_WHOLE)}
        recording = Recording(readings=readings, **arrays, source=document["source"])
        epoch_s = check_float("epoch_s", document["epoch_s"], -MAX_S, MAX_S)
        return recording, epoch_s, str(document["digest"])
    except (InputError, KeyError, TypeError, ValueError, OverflowError, RecursionError):
        return None


_OK, _ERROR = 0, 2


def health_messages(
    store: "Typestore", recording: Recording, findings: ModelFindings, readings: NDArray[np.int64]
) -> tuple[NDArray[np.int64], list[NDArray[np.uint8]]]:
    """A message with the state of every fibre at the first reading, and one whenever a fault is found.

    Args:
        readings: (R,) stamps, ns.

    Returns:
        (n,) stamps and the bytes of as many messages.
    """
    bad: dict[int, tuple[str, str]] = {}
    for fibre in findings.dead:
        bad[fibre] = ("dead", "was dead in the recording that health was learnt from")
    stamps, messages = [int(readings[0])], [_message(store, recording.fibres, bad, int(readings[0]))]
    ends = stamps_at(readings, recording.up_command)
    for fault in findings.faults or ():
        bad |= dict.fromkeys(fault.fibres, (fault.kind, fault.text))
        stamps.append(int(ends[min(fault.press, len(ends) - 1)]))
        messages.append(_message(store, recording.fibres, bad, stamps[-1]))
    return np.array(stamps, np.int64), messages


def _message(store: "Typestore", fibres: int, bad: dict[int, tuple[str, str]], stamp: int) -> NDArray[np.uint8]:
    status = [_status(store, fibre, *bad.get(fibre, ("", "sound"))) for fibre in range(fibres)]
    message = blank(store, KINDS[HEALTH], status=status)
    message.header.frame_id = FRAME
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return np.frombuffer(bytes(store.serialize_cdr(message, message.__msgtype__)), np.uint8)


def _status(store: "Typestore", fibre: int, kind: str, text: str) -> Any:
    values = [blank(store, "diagnostic_msgs/msg/KeyValue", key="fault", value=kind)] if kind else []
    return blank(
        store,
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=_ERROR if kind else _OK,
        name=f"pad: fibre {fibre + 1}",
        message=text,
        hardware_id="pad",
        values=values,
    )
