"""Recordings from and to bags of ROS 2: bags that `export_bag` wrote, and any others by a mapping of their topics.

The library rosbags reads and writes them. A file without its end is refused; `ros2 bag reindex` or `mcap recover`
repairs it.
"""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.common.files import UNFINISHED, atomic_files, check_file, reraise_write_error
from padforge.common.validation import InputError, join_names, naming_file, short_repr
from padforge.sense.arrays import MAX_BYTES, Array, Indices
from padforge.sense.formats import ros_messages as ros
from padforge.sense.formats.assembly import Arrays, ForeignArrays, assemble_recording
from padforge.sense.formats.columns import (
    MILLIMETRES,
    UNITS,
    ColumnEntry,
    check_export,
    check_import,
    match_columns,
    matches,
    order_notes,
    parse_columns,
)
from padforge.sense.formats.hdf5_mat import check_no_presses
from padforge.sense.recording.recording import NOTE, Recording

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

    from padforge.sense.health.fault_detector import FibreFault
    from padforge.sense.localizer.model import Localization

SUFFIXES = (".mcap", ".db3", ".bag")
METADATA = "metadata.yaml"  # a folder with this file is a rosbag2 bag
QUANTITIES = ("fibres", "positions", "x", "y", "depth", "reached", "force", "press")  # quantities that topics may hold
_FIELDS = dict.fromkeys(QUANTITIES, "data") | {
    "positions": r"(.*\.)?(position|point)\.[xy]|[xy]",
    "force": r"(.*\.)?force\.[xyz]|data",
}
"""Patterns of the paths at which messages of std_msgs and geometry_msgs hold each quantity."""
_Arrays = list[tuple[ColumnEntry, NDArray[Any]]]


@cache
def _typestore() -> "Typestore":
    """Return one store for all files, since it compiles code for every type of message."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def load_typestore(purpose: str) -> "Typestore":
    """Return the message definitions of ROS 2; raise InputError, naming the purpose, if rosbags is not installed."""
    try:
        return _typestore()
    except ImportError as error:
        raise InputError(f"{purpose} needs rosbags: pip install 'padforge[formats]'") from error


def read_bag(
    path: Path, is_wanted: Callable[[str], bool], limit: int | None = None
) -> tuple[dict[str, ros.RawMessages], dict[str, str]]:
    """Read the topics of a bag, a file of `SUFFIXES` or a folder of such files with METADATA.

    Returns, by the names of topics, at most `limit` messages of each one for which `is_wanted` is true, and all types.
    """
    store = load_typestore(f"{path}: a bag of ROS")
    from rosbags.highlevel import AnyReader

    if not path.is_dir():
        check_file(path, MAX_BYTES)
    topics = dict[str, ros.RawMessages]()
    try:
        with AnyReader([path], default_typestore=store) as reader:
            types = {connection.topic: connection.msgtype for connection in reader.connections}
            store = reader.typestore  # has the definitions in the bag
            deserialize = store.deserialize_cdr if reader.is2 else store.deserialize_ros1
            wanted = [connection for connection in reader.connections if is_wanted(connection.topic)]
            for connection, stamp, message in reader.messages(wanted) if wanted else ():  # [] would be all topics
                if connection.topic not in topics:
                    decode = partial(deserialize, typename=connection.msgtype)
                    topics[connection.topic] = ros.RawMessages(connection.msgtype, decode, [], [])
                topic = topics[connection.topic]
                if limit is None or len(topic.stamps) < limit:
                    topic.stamps.append(stamp)
                    topic.messages.append(bytes(message))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # rosbags raises many kinds on files that are cut off
        reason = " ".join(f"{error or type(error).__name__}".replace(str(path), path.name).split())[:200]
        raise InputError(f"{path}: no bag, or cut off or damaged ({reason})") from error
    return topics, types


def import_bag(path: str | Path, columns: str = "", presses: Arrays = ()) -> Recording:
    """Read a recording from a bag of ROS.

    Args:
        path: file of `SUFFIXES`, or rosbag2 folder.
        columns: mapping of topics, such as `fibres=/skin/readings,positions=/probe,force=/wrench`, or of fields of
            their messages, such as `fibres=/synced.measurements.data`; times are those at which messages were logged, a
            press or position holds until the next message, and positions are in m by default. Without it, the bag is
            one that `export_bag` wrote.
        presses: presses from a separate table, see `read_presses`.
    """
    path, columns = check_import(path, columns)
    with np.errstate(all="ignore"):  # damaged numbers are refused later
        if columns:
            return _import_mapped(path, columns, presses)
        return _import_exported(path, presses)


def _import_exported(path: Path, presses: Arrays) -> Recording:
    """Read an exported bag: the exact recording if all messages agree with it, otherwise that of the messages."""
    number_topics = (ros.READINGS, ros.PRESSED, ros.PLACE, ros.REACHED, ros.FORCE)
    raw, types = read_bag(path, {*number_topics, ros.RECORDING}.__contains__)
    if ros.READINGS not in raw:
        raise InputError(
            f"{path}: has no topic {ros.READINGS}; columns (--columns) say what other topics hold, "
            f"there are {join_names(list(types))}"
        )
    notes = []
    with naming_file(path):
        check_no_presses(presses)
        topics = {name: ros.decode(raw[name], ros.TOPICS[name].paths) for name in number_topics if name in raw}
        if ros.RECORDING in raw:
            if (recording := _restore(raw[ros.RECORDING], topics)) is not None:
                return recording
            notes = [f"was changed since it was exported; {ros.RECORDING} is left out"]
        arrays = _to_arrays(topics)
    source = {"kind": "ros", "file": path.name}
    return assemble_recording(ForeignArrays(path, arrays, source, notes, is_own=True))


def _restore(raw: ros.RawMessages, topics: Mapping[str, ros.TopicSeries]) -> Recording | None:
    """Return the exact recording in the text of a bag; None if its messages differ from it."""
    try:
        recording, epoch_s, digest = ros.decode_recording(raw, topics[ros.READINGS].values)
    except (InputError, KeyError, TypeError, ValueError):
        return None
    expected = ros.to_topics(recording, epoch_s)
    if expected.keys() != topics.keys() or not all(topics[name].equals(expected[name]) for name in expected):
        return None
    if recording.digest == digest:
        return recording
    return replace(recording, source={**recording.source, NOTE: "readings are not those that were exported"})


def _to_arrays(topics: Mapping[str, ros.TopicSeries]) -> _Arrays:
    """Return the arrays in the messages of an exported bag, for `assemble_recording`."""
    stamps, readings = topics[ros.READINGS]
    arrays: _Arrays = [(ColumnEntry("time", ""), stamps / 1e9), (ColumnEntry("fibres", ros.READINGS), readings)]
    if ros.PRESSED not in topics:
        return arrays
    commands, down, up = _find_commands(topics[ros.PRESSED], stamps)

    def in_presses(topic: str, column: int, factor: float = 1e3) -> Array:
        """Return the number of the last message in each press; NaN without one."""
        if topic not in topics:
            return np.full(len(down), np.nan)
        last = np.searchsorted(topics[topic].stamps, up) - 1
        valid = (last >= 0) & (topics[topic].stamps[last] >= down)
        return np.where(valid, topics[topic].values[last, column] * factor, np.nan)

    z = in_presses(ros.PLACE, 2)
    downward = 1.0 if np.nansum(z) > 0 else -1.0  # z points into a pad that lay mirrored
    return [
        *arrays,
        *commands,
        (ColumnEntry("positions", ""), np.column_stack([in_presses(ros.PLACE, 0), in_presses(ros.PLACE, 1)])),
        (ColumnEntry("depth", ""), np.where(downward * z > 0, downward * z, np.nan)),
        (ColumnEntry("reached", ""), in_presses(ros.REACHED, 2, downward * 1e3)),
        (ColumnEntry("force", ""), in_presses(ros.FORCE, 0, -downward)),
    ]


def _find_commands(pressed: ros.TopicSeries, readings: Indices) -> tuple[_Arrays, Indices, Indices]:
    """Return the commands of presses that begin after the first reading, as arrays and as stamps (Q,), ns.

    A press that is held at the end of the bag ends with its last reading.
    """
    is_down = pressed.values[:, 0] != 0
    was_down = np.append(False, is_down[:-1])
    down, up = pressed.stamps[is_down & ~was_down], pressed.stamps[~is_down & was_down]
    if len(up) < len(down):
        up = np.append(up, ros.stamps_at(readings, np.array([len(readings)])))
    valid = (down > readings[0]) & (down <= readings[-1])
    if not valid.any():
        raise InputError("press is nowhere true after the first reading")
    down, up = down[valid], up[valid]
    commands = {"down_command": down, "up_command": up}
    return [(ColumnEntry(name, "", 1.0), stamps / 1e9) for name, stamps in commands.items()], down, up


def _import_mapped(path: Path, columns: str, presses: Arrays) -> Recording:
    entries = parse_columns(columns, QUANTITIES)
    # The name of a topic has no point; after a point follows the path of a field in its messages.
    wanted = [re.sub(r"\[.*", "", entry.name).partition(".")[::2] for entry in entries]
    raw, types = read_bag(path, lambda name: any(matches(name, topic) for topic, _ in wanted))
    names = sorted(types)  # the order in a bag is arbitrary
    fields = [f"{name}.{field}" for topic, field in wanted if field for name in names if matches(name, topic)]
    arrays: _Arrays = []
    with naming_file(path):
        matched = match_columns(entries, names := list(dict.fromkeys([*names, *fields])))
        series = [(entry, _decode_entry(entry, raw)) for entry, _ in matched]
        clock = next(topic.stamps for entry, topic in series if entry.quantity == "fibres")
        arrays.append((ColumnEntry("time", ""), clock / 1e9))
        for entry, topic in series:
            if entry.quantity == "press":
                arrays += _find_commands(topic, clock)[0]
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


def _decode_entry(entry: ColumnEntry, raw: Mapping[str, ros.RawMessages]) -> ros.TopicSeries:
    """Return the numbers of a topic that are a quantity, or those at a field of its messages."""
    name, _, field = entry.name.partition(".")
    what = f"{entry.quantity} is {short_repr(entry.name)}"
    if name not in raw:
        raise InputError(f"{what}, which has no messages")
    with naming_file(what):
        counts = _number_fields(raw[name], field)
        paths = [path for path in counts if re.fullmatch(_FIELDS[entry.quantity], path.removeprefix(f"{field}."))]
        paths = [field] if field in counts else paths
        is_vector = field in counts or entry.quantity == "fibres" or all(counts[path] == 1 for path in paths)
        if is_vector and 0 < len(paths) <= 3:  # of several positions or forces, the mapping must name one
            return ros.decode(raw[name], paths)
        fields = join_names(list(counts))
    has = f"name one of its fields as {name}.FIELD: {fields}" if counts else "which holds no numbers"
    raise InputError(f"{what} of {short_repr(raw[name].msgtype)}, {has}")


def _number_fields(topic: ros.RawMessages, field: str = "") -> dict[str, int]:
    """Return the paths of numbers in the first message of a topic, at or below a field, and how many are at each."""
    counts = dict[str, int]()

    def visit(value: Any, path: str) -> None:
        item = value[0] if isinstance(value, list) and value else value
        if hasattr(item, "__msgtype__"):
            for name in vars(item):
                visit(ros.get_field(value, name), f"{path}.{name}".lstrip("."))
            return
        with suppress(ValueError):  # of a list of arrays of different lengths
            numbers = np.asarray(value)
            if numbers.dtype.kind in "fiub":
                counts[path] = numbers.size

    message = topic.decode(0)
    visit(ros.get_field(message, field) if field else message, field)
    return counts


def describe_bag(path: Path) -> list[str]:
    """Return a line for each topic of a bag, with the fields of its messages."""
    topics, types = read_bag(path, lambda name: True, limit=1)
    lines = []
    for name in sorted(types):
        with naming_file(path):
            fields = _number_fields(topics[name]) if name in topics else {}
        numbers = ", ".join(f"{field} ({count})" if count != 1 else field for field, count in fields.items())
        lines.append(f"{name}: {types[name]}" + (f", fields {numbers}" if numbers else ""))
    return lines


def _hold(stamps: Indices, values: Array, clock: Indices) -> Array:
    """Return the last of the values (n, ...) at or before each reading; shape (R, ...), NaN before the first value."""
    last = np.searchsorted(stamps, clock, side="right") - 1
    if len(stamps) == len(clock) and np.array_equal(stamps, clock):
        return values  # row by row, since stamps may repeat
    held = values[np.maximum(last, 0)]
    held[last < 0] = np.nan
    return held


def export_bag(
    recording: Recording,
    path: Path,
    localization: "Localization | None" = None,
    faults: "Sequence[FibreFault] | None" = None,
    dead: Sequence[int] = (),
    states: Array | None = None,
) -> None:
    """Write a recording as an MCAP file of ROS 2, atomically; importing it gives the same numbers.

    Args:
        recording: recording to write.
        path: path of the file.
        localization: predicted positions, for the topic of touches.
        faults: in the order of presses, for the topic of health; None if there is no health model.
        dead: indices of fibres that never responded, for that topic.
        states: states of an arm, by `run_directory.STATE_COLUMNS`, whose poses become a topic; shape (n, 10).
    """
    path = check_export(recording, path, localization)
    store = load_typestore(f"{path}: MCAP")
    epoch_s = ros.choose_epoch(recording.times_s)
    topics = ros.to_topics(recording, epoch_s)
    if localization is not None:
        topics[ros.TOUCHES] = ros.touches(recording, localization, epoch_s)
    if states is not None:
        topics[ros.ARM] = ros.arm_poses(states, epoch_s)
    encoded = {topic: ros.encode(store, topic, series) for topic, series in topics.items() if len(series.stamps)}
    if faults is not None:
        encoded[ros.HEALTH] = ros.encode_health(store, recording, faults, dead, topics[ros.READINGS].stamps)
    start, document = encoded[ros.READINGS][0][0], ros.encode_recording(store, recording, epoch_s, encoded)
    encoded = {ros.RECORDING: [(start, document)], **encoded}
    messages = [(topic, *stamped) for topic in encoded for stamped in encoded[topic]]
    in_order = sorted(messages, key=itemgetter(1))
    with reraise_write_error(path), atomic_files(path.parent) as folder:
        bag = _write_mcap(folder / f"{UNFINISHED}{path.stem}", store, in_order)
        bag.replace(folder / path.name)


def _write_mcap(folder: Path, store: "Typestore", messages: Iterable[tuple[str, int, memoryview]]) -> Path:
    """Write messages (topic, stamp in ns, CDR) as a rosbag2 folder, and return its .mcap file."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections: dict[str, Connection] = {}
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, stamp, message in messages:
            if topic not in connections:
                msgtype, description, _ = ros.TOPICS[topic]
                writer.set_custom_data(topic, description)
                options = {"typestore": store, "offered_qos_profiles": [_qos(is_latched=topic == ros.RECORDING)]}
                connections[topic] = writer.add_connection(topic, msgtype, **options)
            writer.write(connections[topic], stamp, message)
    return folder / f"{folder.name}.mcap"


def _qos(is_latched: bool) -> Any:
    """Return a quality of service; subscribers that connect later get the last message of a latched topic."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=1 if is_latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if is_latched else QosDurability.VOLATILE,
        deadline=never,
        lifespan=never,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=never,
        avoid_ros_namespace_conventions=False,
    )
