"""Recordings from and to bags of ROS 2: bags that `export_bag` wrote, and any others by a mapping of their topics.

The library rosbags reads and writes them. A file without its end is refused; `ros2 bag reindex` and `mcap recover`
repair it.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from heapq import merge
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from padforge.common.files import UNFINISHED, atomic_files, check_file, reraise_write_error
from padforge.common.validation import InputError, short_repr
from padforge.sense.arrays import MAX_BYTES, Array, Indices, check_numbers
from padforge.sense.formats import ros_messages
from padforge.sense.formats.annotations import ModelAnnotations, check_export
from padforge.sense.formats.assembly import Arrays, ForeignArrays, assemble_recording
from padforge.sense.formats.columns import (
    MILLIMETRES,
    UNITS,
    ColumnEntry,
    check_import,
    join_names,
    match_columns,
    matches,
    naming_file,
    order_notes,
    parse_columns,
)
from padforge.sense.formats.hdf5_mat import check_no_presses
from padforge.sense.formats.ros_messages import (
    ARM,
    FORCE,
    HEALTH,
    PLACE,
    PRESSED,
    REACHED,
    READINGS,
    RECORDING,
    TOPICS,
    TOUCHES,
    RawMessages,
    TopicSeries,
)
from padforge.sense.formats.ros_writer import load_typestore, write_mcap
from padforge.sense.recording.recording import NOTE, Recording
from padforge.sense.recording.run_directory import STATE_COLUMNS

SUFFIXES = (".mcap", ".db3", ".bag")
METADATA = "metadata.yaml"
"""The file that makes a folder a rosbag2 bag."""

QUANTITIES = ("fibres", "positions", "x", "y", "depth", "reached", "force", "press")
"""Quantities that topics may hold."""
_NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64")
_SCALARS = {f"std_msgs/msg/{name}": ("data",) for name in _NUMBERS}
_ARRAYS = {f"{msgtype}MultiArray": paths for msgtype, paths in _SCALARS.items()}
_POSITIONS = {
    f"geometry_msgs/msg/{name}": (f"{prefix}x", f"{prefix}y")
    for name, prefix in {
        "Point": "",
        "PointStamped": "point.",
        "Pose": "position.",
        "PoseStamped": "pose.position.",
        "PoseWithCovariance": "pose.position.",
        "PoseWithCovarianceStamped": "pose.pose.position.",
    }.items()
}
_FORCES = {
    f"geometry_msgs/msg/{name}": tuple(f"{prefix}force.{axis}" for axis in "xyz")
    for name, prefix in {"Wrench": "", "WrenchStamped": "wrench."}.items()
}
_TYPES: dict[str, Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(QUANTITIES, _SCALARS),
    "fibres": _ARRAYS | _SCALARS,
    "positions": _POSITIONS,
    "force": _FORCES | _SCALARS,
    "press": {"std_msgs/msg/Bool": ("data",)},
}
"""Types of messages that may hold a quantity, and the paths of its numbers in them."""
_Arrays = list[tuple[ColumnEntry, NDArray[Any]]]


class BagContent(NamedTuple):
    """The topics of a bag that were asked for and have messages, and the types of all topics, by name."""

    topics: dict[str, RawMessages]
    types: dict[str, str]


def read_bag(path: Path, is_wanted: Callable[[str], bool], limit: int | None = None) -> BagContent:
    """Read messages of a bag: a file of `SUFFIXES`, or a folder of such with METADATA.

    Args:
        path: of the file or folder.
        is_wanted: whether a topic is asked for, by its name.
        limit: number of messages that are read of a topic; by default all.
    """
    from rosbags.highlevel import AnyReader

    if not path.is_dir():
        check_file(path, MAX_BYTES)
    topics = dict[str, RawMessages]()
    store = load_typestore(f"{path}: a bag of ROS")
    with _one_line_errors(path), AnyReader([path], default_typestore=store) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        store = reader.typestore  # of the bag's own definitions
        deserialize = store.deserialize_cdr if reader.is2 else store.deserialize_ros1
        # None at all would be all topics.
        if wanted := [connection for connection in reader.connections if is_wanted(connection.topic)]:
            for connection, stamp, message in reader.messages(wanted):
                if connection.topic not in topics:
                    decode = partial(deserialize, typename=connection.msgtype)
                    topics[connection.topic] = RawMessages(connection.msgtype, decode, [], [])
                topic = topics[connection.topic]
                if limit is None or len(topic.stamps) < limit:
                    topic.stamps.append(stamp)
                    topic.messages.append(bytes(message))
    return BagContent(topics, types)


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # rosbags raises many kinds on files that are cut off
        reason = " ".join(f"{error or type(error).__name__}".replace(str(path), path.name).split())[:200]
        raise InputError(f"{path}: no bag, or cut off or damaged ({reason})") from error


def import_bag(path: str | Path, columns: str = "", presses: Arrays = ()) -> Recording:
    """Read a recording from a bag of ROS.

    Args:
        path: file of `SUFFIXES`, or rosbag2 folder.
        columns: topics of each quantity, as `fibres=/skin/readings,positions=/probe,force=/wrench`, or fields of their
            messages, as `fibres=/synced.measurements.data`; times are those at which messages were logged, a press or
            position holds until the next message, and positions without a unit are m. Without it, the bag is one that
            `export_bag` wrote.
        presses: of a table of their own, as `read_presses` returns them.
    """
    path, columns = check_import(path, columns)
    load_typestore(f"{path}: a bag of ROS")
    with np.errstate(all="ignore"):  # damaged numbers are refused afterwards
        if columns:
            return _import_mapped(path, columns, presses)
        check_no_presses(path, presses)
        return _import_exported(path)


def _import_exported(path: Path) -> Recording:
    """Read a bag that was exported: exactly as it was if all messages still agree, else as the messages say."""
    number_topics = (READINGS, PRESSED, PLACE, REACHED, FORCE)
    raw, types = read_bag(path, {*number_topics, RECORDING}.__contains__)
    if READINGS not in raw:
        raise InputError(
            f"{path}: has no topic {READINGS}; columns (--columns) say what other topics hold, "
            f"there are {join_names(list(types))}"
        )
    notes = []
    with naming_file(path):
        for name, topic in raw.items():
            if topic.msgtype != TOPICS[name].msgtype:
                raise InputError(f"{name} is of {short_repr(topic.msgtype)}, expected {TOPICS[name].msgtype}")
        topics = {name: ros_messages.decode(raw[name], TOPICS[name].paths) for name in number_topics if name in raw}
        if RECORDING in raw:
            if (recording := _restore(ros_messages.decode_text(raw[RECORDING]), topics)) is not None:
                return recording
            notes = [f"was changed since it was exported; {RECORDING} is left out"]
        arrays = _to_arrays(topics)
    source = {"kind": "ros", "file": path.name}
    return assemble_recording(ForeignArrays(path, arrays, source, notes, is_own=True))


def _restore(text: str, topics: Mapping[str, TopicSeries]) -> Recording | None:
    """Return the exact recording of the text in a bag; None if its messages say something else."""
    restored = ros_messages.from_text(text, topics[READINGS].values)
    if restored is None:
        return None
    recording, epoch_s, digest = restored
    expected = ros_messages.to_topics(recording, epoch_s)
    if expected.keys() != topics.keys() or not all(topics[name].equals(expected[name]) for name in expected):
        return None
    if recording.digest == digest:
        return recording
    return replace(recording, source={**recording.source, NOTE: "readings are not those that were exported"})


def _to_arrays(topics: Mapping[str, TopicSeries]) -> _Arrays:
    """Return what the messages of an exported bag say by themselves."""
    stamps, readings = topics[READINGS]
    arrays: _Arrays = [(ColumnEntry("time", ""), stamps / 1e9), (ColumnEntry("fibres", READINGS), readings)]
    if PRESSED not in topics:
        return arrays
    down, up = _find_commands(topics[PRESSED], stamps)

    def in_presses(topic: str, column: int, factor: float = 1e3) -> Array:
        """Return the number of the last message in each press; NaN without one."""
        if topic not in topics:
            return np.full(len(down), np.nan)
        last = np.searchsorted(topics[topic].stamps, up) - 1
        valid = (last >= 0) & (topics[topic].stamps[last] >= down)
        return np.where(valid, topics[topic].values[last, column] * factor, np.nan)

    z = in_presses(PLACE, 2)
    downward = 1.0 if np.nansum(z) > 0 else -1.0  # z points into a pad that lay mirrored
    return [
        *arrays,
        *_commands(down, up),
        (ColumnEntry("positions", ""), np.column_stack([in_presses(PLACE, 0), in_presses(PLACE, 1)])),
        (ColumnEntry("depth", ""), np.where(downward * z > 0, downward * z, np.nan)),
        (ColumnEntry("reached", ""), in_presses(REACHED, 2, downward * 1e3)),
        (ColumnEntry("force", ""), in_presses(FORCE, 0, -downward)),
    ]


def _commands(down: Indices, up: Indices) -> _Arrays:
    return [(ColumnEntry("down_command", "", 1.0), down / 1e9), (ColumnEntry("up_command", "", 1.0), up / 1e9)]


def _find_commands(pressed: TopicSeries, readings: Indices) -> tuple[Indices, Indices]:
    """Return the (Q,) stamps at which presses begin and end; the first reading is before all presses.

    A press that is held at the end of the bag ends with its last reading.
    """
    is_down = pressed.values[:, 0] != 0
    was_down = np.append(False, is_down[:-1])
    down, up = pressed.stamps[is_down & ~was_down], pressed.stamps[~is_down & was_down]
    if len(up) < len(down):
        up = np.append(up, ros_messages.stamps_at(readings, np.array([len(readings)])))
    valid = (down > readings[0]) & (down <= readings[-1])
    if not valid.any():
        raise InputError("press is nowhere true after the first reading")
    return down[valid], up[valid]


def _import_mapped(path: Path, columns: str, presses: Arrays) -> Recording:
    entries = parse_columns(columns, QUANTITIES)
    # A topic has no point in its name: what follows one is the path of a field in its messages.
    topics = [entry.name.partition(".")[0] for entry in entries]
    raw, types = read_bag(path, lambda name: any(matches(name, re.sub(r"\[.*", "", topic)) for topic in topics))
    names = sorted(types)  # bags list topics as they were discovered, each bag in another order
    arrays: _Arrays = []
    with naming_file(path):
        matched = match_columns([entry for entry in entries if "." not in entry.name], names)
        series = [(entry, _decode_entry(entry, "", raw)) for entry, _ in matched]
        for entry in entries:
            topic, _, field = entry.name.partition(".")
            field, _, index = field.partition("[")
            if field:
                columns_of_field = match_columns([entry._replace(name=topic, index=index and f"[{index}")], names)
                matched += columns_of_field
                series += [
                    (each._replace(name=f"{each.name}.{field}"), _decode_entry(each, field, raw))
                    for each, _ in columns_of_field
                ]
        clock = next(topic.stamps for entry, topic in series if entry.quantity == "fibres")
        arrays.append((ColumnEntry("time", ""), clock / 1e9))
        for entry, topic in series:
            if entry.quantity == "press":
                arrays += _commands(*_find_commands(topic, clock))
                continue
            if entry.factor is None and UNITS[entry.quantity] is MILLIMETRES:
                entry = entry._replace(factor=MILLIMETRES["m"])
            values = topic.values
            if entry.quantity == "force" and values.shape[1] == 3:
                values = np.linalg.norm(values, axis=1, keepdims=True)
            values = values if entry.quantity in ("fibres", "positions") or entry.index else values[:, 0]
            arrays.append((entry, _hold(topic.stamps, values, clock)))
    source = {"kind": "ros", "file": path.name, "columns": columns}
    return assemble_recording(ForeignArrays(path, arrays, source, order_notes(matched), is_held=True), presses)


def _decode_entry(entry: ColumnEntry, field: str, raw: Mapping[str, RawMessages]) -> TopicSeries:
    """Return the numbers of a topic, of a type that may hold the quantity, or of a field of its messages."""
    name, types = entry.name, _TYPES[entry.quantity]
    what = f"{entry.quantity} is {short_repr(name)}"
    if name not in raw:
        raise InputError(f"{what}, which has no messages")
    topic = raw[name]
    kind = topic.msgtype
    with naming_file(what):
        if field:
            value = ros_messages.get_field(topic.decode(0), field)
            kind = getattr(value, "__msgtype__", "")
        if kind in types:
            return ros_messages.decode(topic, [f"{field}.{path}".lstrip(".") for path in types[kind]])
        if field and not kind:
            return ros_messages.decode(topic, [field])
        fields = join_names(list(_number_fields(topic)))
    has = f"name one of its fields as {name}.FIELD: {fields}" if fields != "nothing" else "which holds no numbers"
    raise InputError(f"{what} of {short_repr(kind)}, {has}")


def _number_fields(topic: RawMessages) -> dict[str, int]:
    """Return the paths of numbers in the messages of a topic, and how many numbers the first message has in each."""
    fields = dict[str, int]()

    def visit(value: Any, path: str) -> None:
        if isinstance(value, list) and value and hasattr(value[0], "__msgtype__"):
            for name in vars(value[0]):
                visit([getattr(item, name) for item in value], f"{path}.{name}")
        elif hasattr(value, "__msgtype__"):
            for name in vars(value):
                visit(getattr(value, name), f"{path}.{name}")
        elif np.asarray(value).dtype.kind in "fiub" and not path.endswith("__msgtype__"):
            fields[path.lstrip(".")] = np.size(value)

    visit(topic.decode(0), "")
    return fields


def describe_bag(path: Path) -> list[str]:
    """Return what the topics of a bag hold, each in a line, with the fields of their messages."""
    load_typestore(f"{path}: a bag of ROS")
    topics, types = read_bag(path, lambda name: True, limit=1)
    lines = []
    for name in sorted(types):
        with naming_file(path):
            fields = _number_fields(topics[name]) if name in topics else {}
        numbers = ", ".join(f"{field} ({count})" if count != 1 else field for field, count in fields.items())
        lines.append(f"{name}: {types[name]}" + (f", fields {numbers}" if numbers else ""))
    return lines


def _hold(stamps: Indices, values: Array, clock: Indices) -> Array:
    """Return the (R, ...) last of (n, ...) values at or before each of (R,) readings; NaN before the first."""
    last = np.searchsorted(stamps, clock, side="right") - 1
    if len(stamps) == len(clock) and np.array_equal(stamps, clock):
        return values  # also where stamps repeat
    held = values[np.maximum(last, 0)]
    held[last < 0] = np.nan
    return held


def export_bag(
    recording: Recording, path: Path, annotations: ModelAnnotations | None = None, states: Array | None = None
) -> None:
    """Write a recording as an MCAP file of ROS 2, atomically; importing it gives the same numbers.

    Args:
        recording: to write.
        path: of the file.
        annotations: of a model, for the topics of touches and health.
        states: (n, 10) of an arm, by `STATE_COLUMNS`; its poses become a topic.
    """
    path = check_export(recording, path, annotations)
    if states is not None:
        states = check_numbers(states, np.float64, "states")
        if states.shape[1:] != (len(STATE_COLUMNS),):
            raise InputError(f"states have shape {states.shape}, expected (n, {len(STATE_COLUMNS)})")
    store = load_typestore(f"{path}: MCAP")
    epoch_s = ros_messages.choose_epoch(recording.times_s)
    topics = ros_messages.to_topics(recording, epoch_s)
    if annotations is not None:
        topics[TOUCHES] = ros_messages.touches(recording, annotations, epoch_s)
    if states is not None:
        topics[ARM] = ros_messages.arm_poses(states, epoch_s)
    stamps = {topic: series.stamps for topic, series in topics.items()}
    messages = {
        topic: ros_messages.encode(store, topic, series) for topic, series in topics.items() if len(series.stamps)
    }
    if annotations is not None and annotations.faults is not None:
        stamps[HEALTH], messages[HEALTH] = ros_messages.encode_health(store, recording, annotations, stamps[READINGS])
    stamps[RECORDING] = stamps[READINGS][:1]
    messages = {RECORDING: [ros_messages.encode_recording(store, recording, epoch_s, messages)], **messages}
    in_order = merge(
        *(zip(repeat(topic), stamps[topic].tolist(), messages[topic]) for topic in messages), key=itemgetter(1)
    )
    with reraise_write_error(path), atomic_files(path.parent) as folder:
        bag = write_mcap(folder / f"{UNFINISHED}{path.stem}", store, in_order)
        bag.replace(folder / path.name)
