"""Recordings as MCAP files, for ROS 2 and whatever else reads such."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from padforge.design.common.files import UNFINISHED, atomic_files, reraise_write_error
from padforge.design.common.validation import InputError
from padforge.sense.recordings.formats.model_findings import ModelFindings, export_path
from padforge.sense.recordings.processing.limits import Array, as_numbers
from padforge.sense.recordings.recorder import STATE_COLUMNS
from padforge.sense.recordings.recording import Recording

from padforge.sense.recordings.formats.ros import exact, topics
from padforge.sense.recordings.formats.ros.bags.bag import MOST_BYTES, MOST_MESSAGES, MOST_RECORDS
from padforge.sense.recordings.formats.ros.cdr import blank, rows_like, typestore
from padforge.sense.recordings.formats.ros.diagnostics import health_messages

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

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
    if states is not None and (states := as_numbers(states, np.float64, "states")).shape[1:] != (len(STATE_COLUMNS),):
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
    x, y = (findings.places_mm / 1000).T
    variances = np.zeros((len(x), 36))
    variances[:, [0, 7]] = (findings.sd_mm / 1000) ** 2
    variances[:, 14] = np.where(
        np.isnan(findings.depths_mm), topics.NOT_KNOWN, (findings.depths_r90_mm / 1000 / topics.R90) ** 2
    )
    z = topics.heights(recording, findings.depths_mm)
    fields = {topics.X: x, topics.Y: y, topics.Z: z, topics.COVARIANCE: variances}
    return topics.Stream(topics.stamps_at(readings, recording.lifted), fields)


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
