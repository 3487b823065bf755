"""A recording as topics of ROS 2: their messages, and the numbers of these as arrays.

Numbers are in the units of REP 103: m, N and V. Positions are in the frame `pad`: its origin is the middle of the pad,
x and y are those of the plan, and z points away from the surface. For a pad that lay mirrored z points into it, so that
the frame is right-handed. The messages of a press have the stamp of the reading that follows its begin or its end.

Messages round a recording, to whole ns and from mm to m. RECORDING contains its exact numbers as JSON, which are used
if the other messages still agree with them.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from padforge.common.validation import InputError
from padforge.sense.arrays import Array, Indices, Mask
from padforge.sense.recording.recording import Recording

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from padforge.sense.health.fault_detector import FibreFault
    from padforge.sense.localizer.model import Localization

Stamped = tuple[int, memoryview]  # stamp of a message, ns, and the message as CDR

FORMAT = "padforge-ros/1"
READINGS, PRESSED, PLACE = "/pad/readings", "/pad/pressed", "/pad/place"
REACHED, FORCE, RECORDING = "/pad/reached", "/pad/force", "/pad/recording"
TOUCHES, HEALTH, ARM = "/pad/touches", "/pad/health", "/arm/pose"
FRAME, ARM_FRAME = "pad", "base"
_POSITION = ("pose.pose.position.x", "pose.pose.position.y", "pose.pose.position.z", "pose.covariance")
DEPTH_VARIANCE = 14  # index of the variance of z in a covariance of 6 x 6; those of x and y are 0 and 7
UNKNOWN_VARIANCE = -1.0  # variance of an unknown quantity, as in `sensor_msgs/msg/Imu`
Z90 = 1.6449  # half-width of the central 90 % of a normal distribution, in standard deviations
_INDICES = ("down_command", "up_command")
_NUMBERS = ("times_s", "presses_mm", "depths_mm", "reached_mm", "forces_n")


class TopicType(NamedTuple):
    """Type of a topic."""

    msgtype: str  # type of its messages
    description: str  # meaning of its messages
    paths: tuple[str, ...] = ()  # attributes of its messages that are numbers


TOPICS = {
    READINGS: TopicType(
        "std_msgs/msg/Float64MultiArray", "V, one value for each fibre; NaN where one is missing", ("data",)
    ),
    PRESSED: TopicType("std_msgs/msg/Bool", "true while the probe is sent down", ("data",)),
    PLACE: TopicType(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "m, z is minus the commanded depth, or plus it if the pad lay mirrored, since frames are right-handed; "
        "covariance is 0 if commanded, -1 if unknown; unknown positions are left out",
        _POSITION,
    ),
    REACHED: TopicType(
        "geometry_msgs/msg/PointStamped",
        "m, z is minus the depth that the arm measured",
        ("point.x", "point.y", "point.z"),
    ),
    FORCE: TopicType("geometry_msgs/msg/WrenchStamped", "N on the probe, along z", ("wrench.force.z",)),
    RECORDING: TopicType(
        "std_msgs/msg/String",
        "what the messages round off, as JSON: times in s, positions and depths in mm, forces in N",
    ),
    TOUCHES: TopicType(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "m, positions predicted by a model, with their variances in m^2; -1 where it predicts no depth",
        _POSITION,
    ),
    HEALTH: TopicType("diagnostic_msgs/msg/DiagnosticArray", "which fibre is at fault, by a model"),
    ARM: TopicType(
        "geometry_msgs/msg/PoseStamped",
        "m and a quaternion, pose of the tool in the frame of the arm",
        (*(f"pose.position.{axis}" for axis in "xyz"), *(f"pose.orientation.{axis}" for axis in "xyzw")),
    ),
}


class RawMessages(NamedTuple):
    """Serialized messages of a topic."""

    msgtype: str
    deserialize: Callable[[bytes], Any]  # returns a message
    stamps: list[int]  # log time of each message, ns
    messages: list[bytes]

    def decode(self, index: int) -> Any:
        """Return a message; raise InputError if it is damaged."""
        try:
            return self.deserialize(self.messages[index])
        except Exception as error:  # of damaged messages, rosbags raises many kinds
            raise InputError(f"message {index} of {self.msgtype} is damaged ({error})") from error


class TopicSeries(NamedTuple):
    """Numbers of a topic."""

    stamps: Indices  # ascending; shape (n,), ns
    values: Array  # in the order of the paths; shape (n, k)

    def equals(self, other: "TopicSeries") -> bool:
        """Return whether another topic has the same numbers at the same times."""
        return np.array_equal(self.stamps, other.stamps) and np.array_equal(self.values, other.values, equal_nan=True)


def choose_epoch(times_s: Array) -> float:
    """Return the origin of the stamps: 0 unless times (n,) are negative, since stamps are not."""
    return min(0.0, float(np.floor(times_s[0])))


def to_stamps(times_s: Array, epoch_s: float) -> Indices:
    """Convert times (n,) to ns since the epoch."""
    seconds = np.floor(times_s)
    return (seconds - epoch_s).astype(np.int64) * 10**9 + np.round((times_s - seconds) * 1e9).astype(np.int64)


def stamps_at(stamps: Indices, readings: Indices) -> Indices:
    """Return the stamps of readings by their indices; the reading after the last one is an interval later."""
    interval = max(int(stamps[-1] - stamps[-2]), 1)
    return np.append(stamps, stamps[-1] + interval)[readings]


def depths_to_z(depths_mm: Array, mirrored: bool) -> Array:
    """Convert depths below the surface to z, m; 0 for unknown ones."""
    return 0 - upward(mirrored) * np.nan_to_num(depths_mm) / 1000


def upward(mirrored: bool) -> float:
    """Return the sign of z above the surface in a right-handed frame with x and y of the plan."""
    return -1.0 if mirrored else 1.0


def poses(
    positions_mm: Array, depths_mm: Array, mirrored: bool, std_mm: Array | float = 0.0, r90_mm: Array | float = 0.0
) -> Array:
    """Return the numbers (Q, 39) of PLACE or TOUCHES; NaN is an unknown depth, `r90_mm` half its 90 % interval."""
    covariances = np.zeros((len(positions_mm), 36))
    covariances[:, [0, 7]] = (std_mm / 1000) ** 2
    covariances[:, DEPTH_VARIANCE] = np.where(np.isnan(depths_mm), UNKNOWN_VARIANCE, (r90_mm / 1000 / Z90) ** 2)
    return np.column_stack([positions_mm / 1000, depths_to_z(depths_mm, mirrored), covariances])


def to_topics(recording: Recording, epoch_s: float) -> dict[str, TopicSeries]:
    """Return the topics of a recording that have messages, except RECORDING."""
    stamps, mirrored = to_stamps(recording.times_s, epoch_s), recording.mirrored
    depths_mm, reached_mm, forces_n = recording.depths_mm, recording.reached_mm, recording.forces_n
    down, up = (stamps_at(stamps, readings) for readings in (recording.down_command, recording.up_command))
    x_y = recording.presses_mm / 1000

    def at_presses(valid: Mask, *columns: Array) -> TopicSeries:
        return TopicSeries(down[valid], np.column_stack(columns)[valid])

    topics = {
        READINGS: TopicSeries(stamps, recording.readings),
        PRESSED: TopicSeries(np.column_stack([down, up]).ravel(), np.tile([[1.0], [0.0]], (len(down), 1))),
        PLACE: at_presses(recording.has_position, poses(recording.presses_mm, depths_mm, mirrored)),
        REACHED: at_presses(~np.isnan(reached_mm), x_y, depths_to_z(reached_mm, mirrored)),
        FORCE: at_presses(~np.isnan(forces_n), upward(mirrored) * forces_n),
    }
    return {topic: series for topic, series in topics.items() if len(series.stamps)}


def touches(recording: Recording, localization: "Localization", epoch_s: float) -> TopicSeries:
    """Return TOUCHES: the predicted positions, at the end of each press."""
    depth, positions_mm = localization.measures.get("depth_mm"), localization.positions_mm
    depths_mm, r90_mm = (depth.values, depth.r90) if depth else (np.full(len(positions_mm), np.nan), 0.0)
    stamps = stamps_at(to_stamps(recording.times_s, epoch_s), recording.up_command)
    return TopicSeries(stamps, poses(positions_mm, depths_mm, recording.mirrored, localization.std_mm, r90_mm))


def arm_poses(states: Array, epoch_s: float) -> TopicSeries:
    """Return ARM from states (n, 10): m, and rotation vectors as quaternions; states before the epoch are omitted."""
    states = states[np.isfinite(states[:, :7]).all(axis=1) & (states[:, 0] >= epoch_s)]
    angle = np.linalg.norm(states[:, 4:7], axis=1)
    x_y_z = states[:, 4:7] * (np.sinc(angle / (2 * np.pi)) / 2)[:, None]  # sin(angle / 2) along the axis
    return TopicSeries(
        to_stamps(states[:, 0], epoch_s), np.column_stack([states[:, 1:4] / 1000, x_y_z, np.cos(angle / 2)])
    )


def build_message(topic: str, stamp: int, values: Sequence[Any]) -> dict[str, Any]:
    """Return a message as JSON has it; its values are numbers at the paths of the topic, or states of HEALTH."""
    seconds, nanoseconds = divmod(stamp, 10**9)
    frame = ARM_FRAME if topic == ARM else FRAME
    header = {"header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}}
    if topic == READINGS:
        dimension = {"label": "fibre", "size": len(values), "stride": len(values)}
        return {"layout": {"dim": [dimension], "data_offset": 0}, "data": values}
    if topic == PRESSED:
        return {"data": bool(values[0])}
    if topic == HEALTH:
        return header | {"status": values}
    if topic == REACHED:
        return header | {"point": _x_y_z(values)}
    if topic == FORCE:
        return header | {"wrench": {"force": _x_y_z((0.0, 0.0, values[0])), "torque": _x_y_z((0.0, 0.0, 0.0))}}
    x, y, z, w = values[3:] if topic == ARM else (0.0, 0.0, 0.0, 1.0)
    pose = {"position": _x_y_z(values[:3]), "orientation": {"x": x, "y": y, "z": z, "w": w}}
    return header | {"pose": pose if topic == ARM else {"pose": pose, "covariance": values[3:]}}


def _x_y_z(values: Sequence[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def build_state(name: str, text: str, is_fault: bool, kind: str = "") -> dict[str, Any]:
    """Return a state of HEALTH, of a fibre or of the pad."""
    values = [{"key": "fault", "value": kind}] if kind else []
    return {"level": 2 if is_fault else 0, "name": name, "message": text, "hardware_id": "pad", "values": values}


def serialize(store: "Typestore", topic: str, message: Mapping[str, Any]) -> memoryview:
    """Serialize a message of a topic."""
    from rosbags.interfaces import Nodetype

    def build(node: Any, value: Any) -> Any:
        kind, content = node
        if kind == Nodetype.BASE:
            return value
        if kind == Nodetype.NAME:
            fields = store.fielddefs[content][1]
            return store.types[content](**{name: build(field, value[name]) for name, field in fields})
        item, _ = content
        return np.array(value) if item[0] == Nodetype.BASE else [build(item, each) for each in value]

    msgtype = TOPICS[topic].msgtype
    return store.serialize_cdr(build((Nodetype.NAME, msgtype), message), msgtype)


def encode(store: "Typestore", topic: str, series: TopicSeries) -> list[Stamped]:
    """Serialize the messages of a topic."""
    rows = zip(series.stamps.tolist(), series.values.tolist(), strict=True)
    return [(stamp, serialize(store, topic, build_message(topic, stamp, row))) for stamp, row in rows]


def decode(raw: RawMessages, paths: Sequence[str]) -> TopicSeries:
    """Return the numbers at paths of attributes of the messages, sorted by stamps; InputError for damaged messages."""
    rows, width = bytearray(), 0
    for index in range(len(raw.messages)):
        message = raw.decode(index)
        try:
            row = b"".join(np.asarray(get_field(message, path), np.float64).tobytes() for path in paths)
        except (TypeError, ValueError) as error:
            raise InputError(f"message {index} has no array of numbers at {' or '.join(paths)}") from error
        if not row:
            raise InputError(f"message {index} has no {paths[0]}")
        width = width or len(row)
        if len(row) != width:
            raise InputError(f"{paths[0]} has {width // 8} values in some messages and {len(row) // 8} in others")
        rows += row
    stamps = np.array(raw.stamps, np.int64)
    order = np.argsort(stamps, kind="stable")
    return TopicSeries(stamps[order], np.frombuffer(rows, np.float64).reshape(len(stamps), -1)[order])


def get_field(message: Any, path: str) -> Any:
    """Return the field of a message at a path, or the list of fields of a list of messages."""
    for name in path.split("."):
        try:
            message = [getattr(item, name) for item in message] if isinstance(message, list) else getattr(message, name)
        except AttributeError as error:
            raise InputError(f"{path!r} is no field, expected a path of names such as header.stamp.sec") from error
    return message


def encode_recording(store: "Typestore", recording: Recording, epoch_s: float, topics: Iterable[str]) -> memoryview:
    """Serialize the message of RECORDING, with a description of each topic of the bag."""
    arrays = {name: getattr(recording, name) for name in (*_NUMBERS, *_INDICES)}
    document = {
        "format": FORMAT,
        "topics": {topic: TOPICS[topic].description for topic in topics},
        "digest": recording.digest,
        "epoch_s": epoch_s,
        "source": dict(recording.source),
        **{name: np.where(np.isnan(values), np.array(None), values).tolist() for name, values in arrays.items()},
    }
    text = json.dumps(document, allow_nan=False)
    return serialize(store, RECORDING, {"data": text})


def decode_recording(raw: RawMessages, readings: Array) -> tuple[Recording, float, str]:
    """Return the recording in RECORDING, its epoch and digest; raise an error if it does not fit readings (R, C)."""
    document = json.loads(raw.decode(-1).data)
    arrays: dict[str, Any] = {name: np.array(document[name], np.float64) for name in (*_NUMBERS, *_INDICES)}
    recording = Recording(readings=readings, **arrays, source=document["source"])
    return recording, float(document["epoch_s"]), str(document["digest"])


def encode_health(
    store: "Typestore", recording: Recording, faults: "Sequence[FibreFault]", dead: Sequence[int], stamps: Indices
) -> list[Stamped]:
    """Serialize HEALTH: the state of all fibres at the first reading, and whenever a fault was detected."""
    states: dict[int, tuple[str, str]] = dict.fromkeys(
        dead, ("dead", "was dead in the recording that health was learnt from")
    )
    detected = [(int(stamps[0]), states)]
    ends = stamps_at(stamps, recording.up_command).tolist()
    for fault in faults:
        states = states | dict.fromkeys(fault.fibres, (fault.kind, fault.text))
        detected.append((ends[min(fault.press, len(ends) - 1)], states))
    encoded = []
    for stamp, states in detected:
        of_fibres = enumerate((states.get(fibre, ("", "sound")) for fibre in range(recording.fibres)), 1)
        status = [build_state(f"pad: fibre {number}", text, bool(kind), kind) for number, (kind, text) in of_fibres]
        encoded.append((stamp, serialize(store, HEALTH, build_message(HEALTH, stamp, status))))
    return encoded
