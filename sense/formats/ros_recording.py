"""Recordings out of bags of ROS 2: those that `exporting` wrote, or those of anyone that a mapping tells.

Recordings as MCAP files, for ROS 2 and whatever else reads such.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import UNFINISHED, atomic_files, reraise_write_error
from padforge.design.common.validation import InputError, short_repr
from padforge.sense.arrays import Array, Indices, check_numbers
from padforge.sense.formats import ros_messages as exact
from padforge.sense.formats import ros_messages as topics
from padforge.sense.formats.annotations import ModelFindings, export_path
from padforge.sense.formats.columns import (
    MILLIMETRES,
    UNITS,
    Part,
    assembled,
    chosen,
    file_and_mapping,
    listed,
    parse_mapping,
)
from padforge.sense.formats.hdf5_mat import NOTE
from padforge.sense.formats.ros_bag import (
    MOST_BYTES,
    MOST_MESSAGES,
    MOST_RECORDS,
    Topic,
    blank,
    numbers_in,
    read_bag,
    rows_like,
    typestore,
)
from padforge.sense.formats.ros_messages import health_messages
from padforge.sense.recording.recording import Recording
from padforge.sense.recording.run_directory import STATE_COLUMNS

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


QUANTITIES = ("fibres", "places", "x", "y", "depth", "reached", "force", "press")
"""What a topic can hold."""
_SCALARS = {
    f"std_msgs/msg/{name}{bits}": ("data",)
    for name, sizes in (("Float", (32, 64)), ("Int", (8, 16, 32, 64)), ("UInt", (8, 16, 32, 64)))
    for bits in sizes
}
_ARRAYS = {f"{name}MultiArray": paths for name, paths in _SCALARS.items()}
_POINTS = {
    f"geometry_msgs/msg/{name}": tuple(f"{path}{axis}" for axis in "xy")
    for name, path in {
        "Point": "",
        "PointStamped": "point.",
        "Pose": "position.",
        "PoseStamped": "pose.position.",
        "PoseWithCovariance": "pose.position.",
        "PoseWithCovarianceStamped": "pose.pose.position.",
    }.items()
}
_FORCES = {
    f"geometry_msgs/msg/{name}": tuple(f"{path}force.{axis}" for axis in "xyz")
    for name, path in {"Wrench": "", "WrenchStamped": "wrench."}.items()
}
_PRESSES = {"std_msgs/msg/Bool": ("data",)}
_TYPES: dict[str, Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(QUANTITIES, _SCALARS),
    "fibres": _ARRAYS | _SCALARS,
    "places": _POINTS,
    "force": _FORCES | _SCALARS,
    "press": _PRESSES,
}
"""Types of messages that may hold a quantity, and the paths of its numbers in them."""

_OWN = {
    topics.READINGS: ("data",),
    topics.PRESSED: ("data",),
    topics.PLACE: (topics.X, topics.Y, topics.Z, topics.COVARIANCE),
    topics.REACHED: ("point.x", "point.y", "point.z"),
    topics.FORCE: ("wrench.force.z",),
}
"""Topics of an exported bag that a recording is made of, and the paths of their numbers."""


def import_bag(path: str | Path, mapping: str = "") -> Recording:
    """Read a recording from an .mcap or .db3 of ROS 2, or a rosbag2 folder: one exported, or what a mapping tells.

    A mapping names topics, as `fibres=/skin/readings,places=/probe,force=/wrench`; times are those at which messages
    were logged. What is told of a press or a place holds until the next message. Places are m where no unit is said.

    Raises:
        InputError: rosbags is not installed, no bag, one that is cut off or damaged, beyond the limits of `bags.bag`,
            or messages that do not fit together; the message names the file.
    """
    path, mapping = file_and_mapping(path, mapping)
    store = typestore(f"{path}: a bag of ROS 2")
    with np.errstate(all="ignore"):  # whatever damaged numbers give is refused as such
        return _mapped(store, path, mapping) if mapping else _exported(store, path)


def _exported(store: "Typestore", path: Path) -> Recording:
    """The recording of an exported bag: as it was where all messages say so, else as they do."""
    found, kinds = read_bag(path, {*_OWN, topics.RECORDING}.__contains__)
    if topics.READINGS not in found:
        raise InputError(
            f"{path}: has no topic {topics.READINGS}; a mapping tells what other topics hold, "
            f"there are {listed(list(kinds))}"
        )
    source = {"kind": "ros", "file": path.name}
    try:
        for name, topic in found.items():
            if topic.kind != topics.KINDS[name]:
                raise InputError(f"{name} is of {short_repr(topic.kind)}, expected {topics.KINDS[name]}")
        streams = {name: _stream(store, found[name], paths) for name, paths in _OWN.items() if name in found}
        if topics.RECORDING in found:
            text = found[topics.RECORDING].rows[-1][-1].tobytes()[8:].rstrip(b"\0")
            if (as_it_was := _as_it_was(text, streams)) is not None:
                return as_it_was
            source[NOTE] = f"was changed since it was exported; {topics.RECORDING} is left out"
        arrays = _told(streams)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return assembled(path, arrays, source)


def _stream(store: "Typestore", topic: Topic, paths: Sequence[str]) -> topics.Stream:
    """Numbers of a topic in the order of their stamps."""
    order, stamps = topic.order
    if stamps.max() >= 2**63:
        raise InputError(f"a stamp is {stamps.max()} ns, allowed are {2**63 - 1}")
    values = numbers_in(store, topic.kind, topic.rows, paths)
    whole = bool((np.diff(order) == 1).all())
    return topics.Stream(
        stamps.astype(np.int64),
        {path: each if whole else each[order] for path, each in zip(paths, values, strict=True)},
    )


def _as_it_was(text: bytes, streams: Mapping[str, topics.Stream]) -> Recording | None:
    """The recording that stands beside the messages, if they say the same."""
    told = exact.read(text, streams[topics.READINGS].fields["data"])
    if told is None:
        return None
    recording, epoch_s, digest = told
    expected = topics.streams_of(recording, epoch_s)
    if expected.keys() != streams.keys() or not all(streams[topic].same(expected[topic]) for topic in expected):
        return None
    if recording.digest == digest:
        return recording
    return replace(recording, source={**recording.source, NOTE: "readings are not those that were exported"})


def _told(streams: Mapping[str, topics.Stream]) -> list[tuple[Part, NDArray[Any]]]:
    """What messages tell by themselves."""
    readings = streams[topics.READINGS]
    found: list[tuple[Part, NDArray[Any]]] = [
        (Part("time", ""), readings.stamps / 1e9),
        (Part("fibres", ""), readings.fields["data"]),
    ]
    if topics.PRESSED not in streams:
        return found
    down_command, up_command = _presses(streams[topics.PRESSED], readings.stamps)

    def of_presses(topic: str, path: str, factor: float) -> Array:
        """What the last message of a topic says in each press, NaN without one."""
        if topic not in streams:
            return np.full(len(down_command), np.nan)
        at = np.searchsorted(streams[topic].stamps, up_command) - 1
        there = (at >= 0) & (streams[topic].stamps[at] >= down_command)
        return np.where(there, streams[topic].fields[path][at] * factor, np.nan)

    x, y = (of_presses(topics.PLACE, axis, 1e3) for axis in (topics.X, topics.Y))
    heights = of_presses(topics.PLACE, topics.Z, 1e3)
    down = 1.0 if np.nansum(heights) > 0 else -1.0  # the pad lay mirrored, or not
    return [
        *found,
        *_times(down_command, up_command),
        (Part("places", ""), np.column_stack([x, y])),
        (Part("depth", ""), np.where(down * heights > 0, down * heights, np.nan)),
        (Part("reached", ""), of_presses(topics.REACHED, "point.z", down * 1e3)),
        (Part("force", ""), of_presses(topics.FORCE, "wrench.force.z", -down)),
    ]


def _times(down_command: Indices, up_command: Indices) -> list[tuple[Part, NDArray[Any]]]:
    return [(Part("down_command", "", 1.0), down_command / 1e9), (Part("up_command", "", 1.0), up_command / 1e9)]


def _presses(pressed: topics.Stream, readings: Indices) -> tuple[Indices, Indices]:
    """(Q,) stamps at which presses begin and end; one that began before the second reading is none.

    A press that is still held at the end of the bag ends with its last reading.
    """
    down = pressed.fields["data"].astype(bool)
    before = np.append(False, down[:-1])
    down_command = pressed.stamps[down & ~before]
    up_command = pressed.stamps[~down & before]
    if len(up_command) < len(down_command):
        up_command = np.append(up_command, topics.stamps_at(readings, np.array([len(readings)])))
    kept = (down_command > readings[0]) & (down_command <= readings[-1])
    if not kept.any():
        raise InputError("press is nowhere true after the first reading")
    return down_command[kept], up_command[kept]


def _mapped(store: "Typestore", path: Path, mapping: str) -> Recording:
    parts = parse_mapping(mapping, QUANTITIES)
    patterns = [part.name.replace("[", "[[]") for part in parts]
    found, kinds = read_bag(path, lambda name: any(fnmatchcase(name, pattern) for pattern in patterns))
    names = list(kinds)
    try:
        read = [(part, _typed(store, part, names[at], found)) for part, places in chosen(parts, names) for at in places]
        clock = next(stream for part, stream in read if part.quantity == "fibres").stamps
        arrays: list[tuple[Part, NDArray[Any]]] = [(Part("time", ""), clock / 1e9)]
        for part, stream in read:
            if part.quantity == "press":
                arrays += _times(*_presses(stream, clock))
            else:
                metres = part.factor is None and MILLIMETRES is UNITS[part.quantity]
                named = part._replace(factor=MILLIMETRES["m"]) if metres else part
                arrays.append((named, _held(stream.stamps, _values(part.quantity, stream), clock)))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    return assembled(path, arrays, {"kind": "ros", "file": path.name, "mapping": mapping})


def _values(quantity: str, stream: topics.Stream) -> NDArray[Any]:
    """(n, ...) what messages say of a quantity; of a force how strong it is."""
    values = list(stream.fields.values())
    if len(values) == 1:
        return values[0]
    return np.hypot(np.hypot(values[0], values[1]), values[2]) if quantity == "force" else np.column_stack(values)


def _typed(store: "Typestore", part: Part, name: str, found: Mapping[str, Topic]) -> topics.Stream:
    """The numbers of a topic, of a type that can hold the quantity."""
    if name not in found:
        raise InputError(f"{part.quantity} is {short_repr(name)}, which has no messages")
    kind, allowed = found[name].kind, _TYPES[part.quantity]
    if kind not in allowed:
        raise InputError(f"{part.quantity} is {short_repr(name)} of {short_repr(kind)}, expected {', '.join(allowed)}")
    try:
        return _stream(store, found[name], allowed[kind])
    except InputError as error:
        raise InputError(f"{part.quantity} is {short_repr(name)}: {error}") from error


def _held(stamps: Indices, values: NDArray[Any], clock: Indices) -> Array:
    """(R, ...) the last of (n, ...) values at or before each of (R,) readings, NaN before the first."""
    if len(stamps) == len(clock) and np.array_equal(stamps, clock):
        return values.astype(np.float64)
    at = np.searchsorted(stamps, clock, side="right") - 1
    held = values[np.maximum(at, 0)].astype(np.float64)
    held[at < 0] = np.nan
    return held


_Messages = NDArray[np.uint8] | list[NDArray[np.uint8]]
"""(n, size) bytes of messages, or each by itself."""
_OTHERS = 2**18
"""Room for records of a bag that are no messages."""


def export_bag(
    recording: Recording, path: Path, findings: ModelFindings | None = None, states: Array | None = None
) -> None:
    """Write a recording as an MCAP file of ROS 2, atomically; importing it gives the same numbers.

    Args:
        findings: of a model, for the topics of touches and health.
        states: (n, 10) of an arm, by `recorder.STATE_COLUMNS`; its poses become a topic.

    Raises:
        InputError: rosbags is not installed, `path` cannot be written, the recording is too long for a bag, or an
            argument is of another kind.
    """
    path = export_path(recording, path, findings)
    if states is not None and (states := check_numbers(states, np.float64, "states")).shape[1:] != (
        len(STATE_COLUMNS),
    ):
        raise InputError(f"states have shape {states.shape}, expected (n, {len(STATE_COLUMNS)})")
    store = typestore(f"{path}: MCAP")
    epoch_s = topics.epoch_of(recording.times_s)
    streams = topics.streams_of(recording, epoch_s)
    if findings is not None:
        streams[topics.TOUCHES] = _touches(recording, findings, epoch_s)
    if states is not None:
        streams |= _poses(states, epoch_s)
    stamps = {topic: stream.stamps for topic, stream in streams.items()}
    messages: dict[str, _Messages] = {
        topic: rows_like(store, _pattern(store, topic, stream), _stamped(stream)) for topic, stream in streams.items()
    }
    if findings is not None and findings.faults is not None:
        told = health_messages(store, recording, findings, stamps[topics.READINGS])
        stamps[topics.HEALTH], messages[topics.HEALTH] = told
    text = blank(store, topics.KINDS[topics.RECORDING], data=exact.written(recording, epoch_s, messages))
    messages[topics.RECORDING] = [np.frombuffer(bytes(store.serialize_cdr(text, text.__msgtype__)), np.uint8)]
    stamps[topics.RECORDING] = stamps[topics.READINGS][:1]
    _refuse_too_many(messages)
    with reraise_write_error(path), atomic_files(path.parent) as folder:
        _write(store, folder / f"{UNFINISHED}{path.stem}", stamps, messages).replace(folder / path.name)


def _refuse_too_many(messages: Mapping[str, _Messages]) -> None:
    """Refuse what `import` would not read back: it reads neither what a model says nor poses, but passes over them."""
    read = [messages[topic] for topic in messages if topic not in (topics.ARM, topics.TOUCHES, topics.HEALTH)]
    count, every = sum(map(len, read)), sum(map(len, messages.values()))
    size = sum(len(each) * len(each[0]) for each in read)
    if count > MOST_MESSAGES or size > MOST_BYTES or every > MOST_RECORDS - _OTHERS:
        raise InputError(
            f"recording would be {count} messages of {size} bytes and {every - count} of an arm or a model, allowed in "
            f"a bag are {MOST_MESSAGES} of {MOST_BYTES}, and {MOST_RECORDS - _OTHERS} in all"
        )


def _stamped(stream: topics.Stream) -> dict[str, NDArray[Any]]:
    """The numbers of messages, with their stamps where they have a header."""
    if "data" in stream.fields:
        return dict(stream.fields)
    seconds, nanoseconds = np.divmod(stream.stamps, 10**9)
    return {"header.stamp.sec": seconds, "header.stamp.nanosec": nanoseconds, **stream.fields}


def _pattern(store: "Typestore", topic: str, stream: topics.Stream) -> Any:
    """A message of a topic without its numbers."""
    message = blank(store, topics.KINDS[topic])
    if topic == topics.READINGS:
        fibres = stream.fields["data"].shape[1]
        fibre = blank(store, "std_msgs/msg/MultiArrayDimension", label="fibre", size=fibres, stride=fibres)
        message.layout.dim, message.data = [fibre], np.zeros(fibres)
    elif topic != topics.PRESSED:
        message.header.frame_id = topics.ARM_FRAME if topic == topics.ARM else topics.FRAME
    if topic in (topics.PLACE, topics.TOUCHES):
        message.pose.pose.orientation.w = 1.0
    return message


def _touches(recording: Recording, findings: ModelFindings, epoch_s: float) -> topics.Stream:
    """Places found, at the end of each press."""
    readings = topics.stamps_of(recording.times_s, epoch_s)
    x, y = (findings.positions_mm / 1000).T
    variances = np.zeros((len(x), 36))
    variances[:, [0, 7]] = (findings.std_mm / 1000) ** 2
    variances[:, 14] = np.where(
        np.isnan(findings.depths_mm), topics.NOT_KNOWN, (findings.depths_r90_mm / 1000 / topics.R90) ** 2
    )
    z = topics.heights(recording, findings.depths_mm)
    fields = {topics.X: x, topics.Y: y, topics.Z: z, topics.COVARIANCE: variances}
    return topics.Stream(topics.stamps_at(readings, recording.up_command), fields)


def _poses(states: Array, epoch_s: float) -> dict[str, topics.Stream]:
    """Poses of an arm: m, and rotation vectors as quaternions; states before the epoch are left out."""
    states = states[np.isfinite(states[:, :7]).all(axis=1) & (states[:, 0] >= epoch_s)]
    if not len(states):
        return {}
    angle = np.linalg.norm(states[:, 4:7], axis=1)
    turned = states[:, 4:7] * (np.sinc(angle / (2 * np.pi)) / 2)[:, None]  # sin(angle / 2) along the axis
    fields = {f"pose.position.{axis}": states[:, at] / 1000 for at, axis in enumerate("xyz", 1)}
    fields |= {f"pose.orientation.{axis}": turned[:, at] for at, axis in enumerate("xyz")}
    fields["pose.orientation.w"] = np.cos(angle / 2)
    return {topics.ARM: topics.Stream(topics.stamps_of(states[:, 0], epoch_s), fields)}


def _write(
    store: "Typestore",
    folder: Path,
    stamps: Mapping[str, NDArray[np.int64]],
    messages: Mapping[str, _Messages],
) -> Path:
    """Write messages into a new folder, in the order of their stamps; the file that holds them."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in messages:
            writer.set_custom_data(topic, topics.UNITS[topic])
        connections = {
            topic: writer.add_connection(
                topic, topics.KINDS[topic], typestore=store, offered_qos_profiles=_qos(topic == topics.RECORDING)
            )
            for topic in messages
        }
        for topic, at, stamp in _in_order(stamps):
            writer.write(connections[topic], stamp, messages[topic][at].data)
    return folder / f"{folder.name}.mcap"


def _in_order(stamps: Mapping[str, NDArray[np.int64]]) -> Iterator[tuple[str, int, int]]:
    """Topic, place among its messages and stamp of all messages."""
    names = [topics.RECORDING, *(name for name in stamps if name != topics.RECORDING)]
    when = np.concatenate([stamps[name] for name in names])
    topic = np.repeat(np.arange(len(names)), [len(stamps[name]) for name in names])
    place = np.concatenate([np.arange(len(stamps[name])) for name in names])
    order = np.argsort(when, kind="stable")
    for which, at, stamp in zip(topic[order].tolist(), place[order].tolist(), when[order].tolist(), strict=True):
        yield names[which], at, stamp


def _qos(latched: bool) -> list[Any]:
    """How a topic is offered: reliably, and a latched one to those who come later."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    depth = 1 if latched else 10
    return [
        Qos(
            QosHistory.KEEP_LAST, depth, QosReliability.RELIABLE, durability,
            never, never, QosLiveliness.AUTOMATIC, never, False,
        )
    ]  # fmt: skip
