"""Recordings out of bags of ROS 2: those that `exporting` wrote, or those of anyone that a mapping tells."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.validation import InputError, short_repr
from padforge.sense.recordings.formats.assembly import assembled
from padforge.sense.recordings.formats.mapping import (
    MILLIMETRES,
    UNITS,
    Part,
    chosen,
    file_and_mapping,
    listed,
    parse_mapping,
)
from padforge.sense.recordings.formats.published_mat import NOTE
from padforge.sense.recordings.processing.limits import Array, Indices
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.ros import exact, topics
from padforge.sense.recordings.formats.ros.bags.bag import Topic
from padforge.sense.recordings.formats.ros.bags.reading import read_bag
from padforge.sense.recordings.formats.ros.cdr import numbers_in, typestore

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
    begun, lifted = _presses(streams[topics.PRESSED], readings.stamps)

    def of_presses(topic: str, path: str, factor: float) -> Array:
        """What the last message of a topic says in each press, NaN without one."""
        if topic not in streams:
            return np.full(len(begun), np.nan)
        at = np.searchsorted(streams[topic].stamps, lifted) - 1
        there = (at >= 0) & (streams[topic].stamps[at] >= begun)
        return np.where(there, streams[topic].fields[path][at] * factor, np.nan)

    x, y = (of_presses(topics.PLACE, axis, 1e3) for axis in (topics.X, topics.Y))
    heights = of_presses(topics.PLACE, topics.Z, 1e3)
    down = 1.0 if np.nansum(heights) > 0 else -1.0  # the pad lay mirrored, or not
    return [
        *found,
        *_times(begun, lifted),
        (Part("places", ""), np.column_stack([x, y])),
        (Part("depth", ""), np.where(down * heights > 0, down * heights, np.nan)),
        (Part("reached", ""), of_presses(topics.REACHED, "point.z", down * 1e3)),
        (Part("force", ""), of_presses(topics.FORCE, "wrench.force.z", -down)),
    ]


def _times(begun: Indices, lifted: Indices) -> list[tuple[Part, NDArray[Any]]]:
    return [(Part("begun", "", 1.0), begun / 1e9), (Part("lifted", "", 1.0), lifted / 1e9)]


def _presses(pressed: topics.Stream, readings: Indices) -> tuple[Indices, Indices]:
    """(Q,) stamps at which presses begin and end; one that began before the second reading is none.

    A press that is still held at the end of the bag ends with its last reading.
    """
    down = pressed.fields["data"].astype(bool)
    before = np.append(False, down[:-1])
    begun = pressed.stamps[down & ~before]
    lifted = pressed.stamps[~down & before]
    if len(lifted) < len(begun):
        lifted = np.append(lifted, topics.stamps_at(readings, np.array([len(readings)])))
    kept = (begun > readings[0]) & (begun <= readings[-1])
    if not kept.any():
        raise InputError("press is nowhere true after the first reading")
    return begun[kept], lifted[kept]


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
