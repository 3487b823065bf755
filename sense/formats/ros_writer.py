"""MCAP files of ROS 2, written at once or press by press while a recording is made.

An MCAP file ends in an index, without which most programs do not open it. `McapFollower` writes two copies of the file
by turns, in a hidden folder: one gets what it lacks and a new index, and then takes the name of the other by a rename.
So the file of that name is whole at every moment, even if the process is killed or the disk is full.
"""

import io
import logging
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from functools import cache
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common.files import sync, temporary_folder, to_disk
from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array
from padforge.sense.formats import ros_messages
from padforge.sense.formats.ros_messages import ARM, PLACE, READINGS, RECORDING, TOPICS, TopicSeries
from padforge.sense.recording.block_file import write_at
from padforge.sense.recording.recording import is_mirrored
from padforge.sense.recording.run_directory import Press

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore

_log = logging.getLogger(__name__)


def load_typestore(purpose: str) -> "Typestore":
    """Return the message definitions of ROS 2; raise InputError, naming the purpose, if rosbags is not installed."""
    try:
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        raise InputError(f"{purpose} needs rosbags: pip install 'padforge[ros]'") from error
    return _typestore()


@cache
def _typestore() -> "Typestore":
    """One for all files: it compiles the code of a message when it first meets one."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def write_mcap(folder: Path, store: "Typestore", messages: Iterable[tuple[str, int, memoryview]]) -> Path:
    """Write messages (topic, stamp in ns, CDR) as a rosbag2 folder, and return the .mcap file that holds them."""
    with _open_writer(folder) as writer:
        _write_messages(writer, store, messages)
    return folder / f"{folder.name}.mcap"


def _open_writer(folder: Path) -> "Writer":
    from rosbags.rosbag2 import StoragePlugin, Writer

    return Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP)


def _write_messages(writer: "Writer", store: "Typestore", messages: Iterable[tuple[str, int, memoryview]]) -> None:
    """Write messages; a topic is added to the file with its first one."""
    connections = {connection.topic: connection for connection in writer.connections}
    for topic, stamp, message in messages:
        if topic not in connections:
            connections[topic] = _add_topic(writer, store, topic)
        writer.write(connections[topic], stamp, message)


def _add_topic(writer: "Writer", store: "Typestore", topic: str) -> "Connection":
    msgtype, description, _ = TOPICS[topic]
    writer.set_custom_data(topic, description)
    # The last message of a latched topic is for those that come later.
    profiles = [_qos(is_latched=topic == RECORDING)]
    return writer.add_connection(topic, msgtype, typestore=store, offered_qos_profiles=profiles)


def _qos(is_latched: bool) -> Any:
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


class McapFollower:
    """Writes an MCAP file while a run directory is recorded, see `Recorder.attach`.

    The file holds the presses that are done, with the readings and arm poses up to them. It lacks RECORDING, which
    `export_bag` adds once the recording is complete. If it cannot be written a line in the log says so, and the
    recording goes on without it.

    Args:
        path: of the file, which is replaced.

    Raises:
        InputError: rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._store = path, load_typestore(f"{path}: MCAP")
        self._mirrored, self._has_failed = False, False
        self._rows: list[Array] = []  # not yet in the file, as the two that follow
        self._states: list[Array] = []
        self._presses: dict[int, Press] = {}
        self._stamps, self._epoch_s = np.empty(0, np.int64), 0.0  # of all readings so far
        self._written: set[int] = set()  # numbers of presses
        self._stack, self._file = ExitStack(), None

    def start(self, source: Mapping[str, Any]) -> None:
        self._mirrored = is_mirrored(source)

    def append(self, rows: Array) -> None:
        if not self._has_failed:
            self._rows.append(rows)

    def append_states(self, rows: Array) -> None:
        if not self._has_failed:
            self._states.append(rows)

    def finish(self, number: int, press: Press) -> None:
        if not self._has_failed:
            self._presses[number] = press

    def sync(self) -> None:
        """Write what there is up to the presses done, if any are new."""
        if not self._presses:
            return
        try:
            if self._file is None:
                self._epoch_s = ros_messages.choose_epoch(np.concatenate(self._rows)[:, 0])
                self._file = _GrowingMcap(self._stack.enter_context(temporary_folder(self.path.parent)), self.path)
            self._file.write(self._store, self._messages())
        except Exception as error:  # whatever it is, the recording is worth more
            self._has_failed = True
            self._clear()
            self.close()
            reason = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
            reason = reason or type(error).__name__
            _log.warning(f"{self.path}: is not continued ({reason}); the recording goes on")

    def _messages(self) -> list[tuple[str, int, memoryview]]:
        """Return the messages of all that was added since the last call, by time."""
        topics = list[tuple[str, TopicSeries]]()
        if self._rows:
            rows = np.concatenate(self._rows)
            stamps = ros_messages.to_stamps(rows[:, 0], self._epoch_s)
            self._stamps = np.append(self._stamps, stamps)
            topics.append((READINGS, TopicSeries(stamps, rows[:, 1:])))
        if self._states:
            topics.append((ARM, ros_messages.arm_poses(np.concatenate(self._states), self._epoch_s)))
        repeated = [number in self._written for number in self._presses]
        presses = np.array(list(self._presses.values()), np.float64)
        if not all(repeated):
            is_new = np.logical_not(repeated)
            topics += ros_messages.press_topics(presses[is_new], self._stamps, self._mirrored).items()
        if any(repeated):
            topics.append((PLACE, ros_messages.withdrawn_places(presses[repeated], self._stamps)))
        self._written |= self._presses.keys()
        self._clear()
        messages = [
            (topic, stamp, message)
            for topic, series in topics
            for stamp, message in zip(
                series.stamps.tolist(), ros_messages.encode(self._store, topic, series), strict=True
            )
        ]
        return sorted(messages, key=itemgetter(1))

    def _clear(self) -> None:
        for pending in (self._rows, self._states, self._presses):
            pending.clear()

    def close(self) -> None:
        """Write no more, and remove the hidden copy."""
        self._stack.close()


class _GrowingMcap:
    """An MCAP file that is whole after every `write`.

    Args:
        folder: temporary, on the disk of `path`, for the hidden copy.
        path: of the file.
    """

    def __init__(self, folder: Path, path: Path) -> None:
        self._path = path
        self._writer = _open_writer(folder / path.stem)
        self._writer.open()
        self._storage: Any = self._writer.storage
        self._storage.bio.close()
        head = self._storage.path.read_bytes()
        self._next, self._copies = folder / "next.mcap", [folder / "0.mcap", folder / "1.mcap"]
        for copy in self._copies:
            copy.write_bytes(head)
        self._end, self._last = len(head), b""  # of the chunks so far; the newest ones, which one copy lacks

    def write(self, store: "Typestore", messages: Iterable[tuple[str, int, memoryview]]) -> None:
        """Add messages."""
        # 1. Chunks of messages, and the index of all so far, as rosbags writes them, into memory.
        self._storage.bio = _Part(self._end)
        _write_messages(self._writer, store, messages)
        if self._storage.chunk.bio.tell():
            self._storage.close_chunk()
        chunks = self._storage.bio.getvalue()
        self._storage.bio = _Part(self._end + len(chunks))
        self._writer.close()
        self._writer.storage = self._storage  # the writer goes on
        index = self._storage.bio.getvalue()
        # 2. Into the copy that is one write behind.
        with self._copies[0].open("r+b", buffering=0) as file:
            write_at(file, self._end - len(self._last), self._last + chunks + index)
            to_disk(file.fileno())
        # 3. It takes the name of the other one, which stays as it is until the next write.
        self._next.hardlink_to(self._copies[0])
        self._next.replace(self._path)
        sync(self._path.parent)
        self._copies.reverse()
        self._end, self._last = self._end + len(chunks), chunks


class _Part(io.BytesIO):
    """A part of a file from a position on, in memory."""

    def __init__(self, start: int) -> None:
        super().__init__()
        self._start = start

    def tell(self) -> int:
        return self._start + super().tell()

    def close(self) -> None:
        """Keep the content."""
