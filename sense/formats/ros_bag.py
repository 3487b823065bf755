"""ROS 2 bags as raw messages: MCAP by the library rosbags, SQLite by the standard library, neither trusted.

A file may claim anything. Messages are read in sequence, whatever an index says; chunks are unpacked to no more than
they claim and than MAX_CHUNK_BYTES; of a folder only the storage files directly in it are opened; SQLite files are
opened read-only, and must consist of plain tables that hold no more than the file does.
"""

import re
import sqlite3
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import quote

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import InputError, short_repr

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

MAX_FILE_BYTES, MAX_METADATA_BYTES = 2**33, 2**24
MAX_CHUNK_BYTES = 2**26
"""Unpacked size of a chunk; recorders make them of 1 to 4 MiB."""
FREE_CHUNK_BYTES, MAX_COMPRESSION = 2**22, 64
"""Unpacked size that is always allowed, and compression ratio that a larger chunk may have."""
MAX_MESSAGES, MAX_BYTES = 2**22, 2**28
"""Messages, and their bytes, of all topics that are asked for."""
MAX_TOPICS = 10_000
SUFFIXES = (".mcap", ".db3")
METADATA = "metadata.yaml"
"""The file that makes a folder a rosbag2 bag."""


class RawMessages(NamedTuple):
    """Messages of a topic in the order of the file: their type, and the log time (ns) and CDR of each."""

    msgtype: str
    stamps: list[int]
    messages: list[bytes]


def load_typestore(purpose: str) -> "Typestore":
    """Return the message definitions of ROS 2; raise InputError, naming the purpose, if rosbags is not installed."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(f"{purpose} needs rosbags: pip install 'padforge[ros]'") from error
    return get_typestore(Stores.ROS2_HUMBLE)


def read_bag(path: Path, is_wanted: Callable[[str], bool]) -> tuple[dict[str, RawMessages], dict[str, str]]:
    """Read messages of a bag: an .mcap or .db3 file, or a folder of such with METADATA.

    Returns:
        The topics asked for (by `is_wanted` of their names) that have messages, and the types of all, by name.
    """
    topics, types, n_messages, n_bytes = dict[str, RawMessages](), dict[str, str](), 0, 0
    for file in _storage_files(path):
        file = check_file(file, MAX_FILE_BYTES)
        with _one_line_errors(file), closing(_read_storage(file, types, is_wanted)) as messages:
            for name, stamp, message in messages:
                topic = topics.setdefault(name, RawMessages(types[name], [], []))
                topic.stamps.append(stamp)
                topic.messages.append(message)
                n_messages, n_bytes = n_messages + 1, n_bytes + len(message)
                if n_bytes > MAX_BYTES or n_messages > MAX_MESSAGES:
                    raise InputError(f"the topics read have more than {MAX_MESSAGES} messages or {MAX_BYTES} bytes")
    return topics, types


def _storage_files(path: Path) -> list[Path]:
    """Return the files of a bag in the order in which they were recorded."""
    if not path.is_dir():
        return [path]
    metadata = read_bytes(path / METADATA, MAX_METADATA_BYTES).decode(errors="replace")
    mode = re.search(r"^[ \t]*compression_mode:[ \t]*[\"']?(file|message)\b", metadata, re.IGNORECASE | re.MULTILINE)
    if mode:
        raise InputError(f"{path}: is compressed by {mode[1]}, expected none or by chunk (ros2 bag convert)")

    def number(file: Path) -> tuple[int, str]:
        suffix = re.search(r"_(\d{1,9})$", file.stem)
        return (int(suffix[1]) if suffix else -1, file.name)

    files = sorted((file for file in path.iterdir() if file.suffix.lower() in SUFFIXES), key=number)
    if not files:
        raise InputError(f"{path}: has {METADATA}, but no file that ends in {' or '.join(SUFFIXES)}")
    return files


@contextmanager
def _one_line_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # rosbags raises many kinds on torn files
        reason = " ".join(f"{error or type(error).__name__}".replace(str(path), path.name).split())[:200]
        raise InputError(f"{path}: no bag, or cut off or damaged ({reason})") from error


def _read_storage(
    path: Path, types: dict[str, str], is_wanted: Callable[[str], bool]
) -> Generator[tuple[str, int, bytes], None, None]:
    """Yield topic, stamp and content of the messages asked for, and add the types of all topics."""

    def is_selected(name: str, msgtype: str, encoding: str) -> bool:
        msgtype = msgtype if msgtype.count("/") == 2 else msgtype.replace("/", "/msg/")  # the short form of ROS 1
        if types.setdefault(name, msgtype) != msgtype:
            raise InputError(f"topic {short_repr(name)} is of {short_repr(types[name])} and of {short_repr(msgtype)}")
        if len(types) > MAX_TOPICS:
            raise InputError(f"it has more than {MAX_TOPICS} topics")
        if is_wanted(name) and encoding != "cdr":
            raise InputError(f"topic {short_repr(name)} is written as {short_repr(encoding)}, expected 'cdr'")
        return is_wanted(name)

    return (_read_mcap if path.suffix.lower() == ".mcap" else _read_sqlite)(path, is_selected)


def _read_mcap(
    path: Path, is_selected: Callable[[str, str, str], bool]
) -> Generator[tuple[str, int, bytes], None, None]:
    from rosbags.rosbag2 import storage_mcap

    storage = storage_mcap.McapReader(path)
    with _guarded(storage_mcap):
        storage.open()
        with closing(storage):
            selected = [
                connection
                for connection in storage.connections
                if is_selected(connection.topic, connection.msgtype, connection.ext.serialization_format)  # pyright: ignore
            ]
            n_messages, n_expected = 0, sum(connection.msgcount for connection in selected)
            for connection, stamp, message in storage.messages_scan(selected):
                n_messages += 1
                yield connection.topic, stamp, message
    if n_messages < n_expected:  # rosbags ends without an error at a record that is longer than its chunk
        raise InputError(f"is cut off or damaged ({n_messages} of {n_expected} messages can be read)")


@contextmanager
def _guarded(storage_mcap: Any) -> Iterator[None]:
    """Have rosbags unpack no more than is allowed, and leave out the YAML of QoS, which may be long."""
    decompressors, get_qos = storage_mcap.DECOMPRESSORS, storage_mcap.get_qos
    storage_mcap.DECOMPRESSORS = {name: _bounded(name) for name in decompressors}
    storage_mcap.get_qos = lambda metadata: []
    try:
        yield
    finally:
        storage_mcap.DECOMPRESSORS, storage_mcap.get_qos = decompressors, get_qos


def _bounded(compression: str) -> Callable[[bytes, int], bytes]:
    """Return a decompressor for rosbags that stops at the size that a chunk claims, and refuses large claims."""

    def decompress(packed: bytes, size: int) -> bytes:
        limit = min(MAX_CHUNK_BYTES, max(FREE_CHUNK_BYTES, MAX_COMPRESSION * len(packed)))
        if size > limit:
            raise InputError(f"a chunk claims {size} bytes in {len(packed)} of the file, allowed are {limit}")
        if compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor as Decompressor
        elif compression == "zstd":
            try:
                from compression.zstd import ZstdDecompressor as Decompressor  # pyright: ignore  from Python 3.14 on
            except ImportError:
                from backports.zstd import ZstdDecompressor as Decompressor
        else:
            return packed
        return Decompressor().decompress(packed, size + 1)

    return decompress


def _read_sqlite(
    path: Path, is_selected: Callable[[str, str, str], bool]
) -> Generator[tuple[str, int, bytes], None, None]:
    with closing(sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)) as database:
        _check_tables(database, path.stat().st_size)
        topics = {
            number: str(name)
            for number, name, *types in database.execute("SELECT id, name, type, serialization_format FROM topics")
            if is_selected(str(name), *map(str, types))
        }
        # Row by row as they are stored: to sort them, SQLite would keep all.
        for number, stamp, message in database.execute("SELECT topic_id, timestamp, data FROM messages NOT INDEXED"):
            if number in topics:
                if not isinstance(stamp, int) or not isinstance(message, bytes):
                    raise InputError(f"a message has a {type(message).__name__} where rosbag2 has bytes")
                yield topics[number], stamp, message


def _check_tables(database: sqlite3.Connection, file_bytes: int) -> None:
    """Check that a database has plain tables only: views and computed columns may take any time and memory."""
    database.execute("PRAGMA trusted_schema = OFF")
    for kind, name, sql in database.execute(
        "SELECT type, name, sql FROM sqlite_master WHERE type != 'index'"
    ).fetchall():
        is_plain = kind == "table" and str(sql).upper().startswith("CREATE TABLE")
        columns = database.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,)).fetchall() if is_plain else []
        if not is_plain or any(hidden for (hidden,) in columns):
            raise InputError(f"has {short_repr(name)}, which is computed, expected the plain tables of rosbag2")
    (size,) = database.execute("SELECT total(length(data)) FROM messages NOT INDEXED").fetchone()
    if size > file_bytes:  # rows that lack a column have its default, which may be long
        raise InputError(f"its messages claim {size:.0f} bytes in {file_bytes} of the file")


def write_mcap(
    folder: Path,
    store: "Typestore",
    topics: Mapping[str, tuple[str, str]],
    messages: Iterable[tuple[str, int, memoryview]],
    latched: str,
) -> Path:
    """Write messages (topic, stamp in ns, CDR) as a rosbag2 folder, and return the .mcap file that holds them.

    Topics have a type and a description. The last message of the `latched` one is for those that come later.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer

    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {}
        for topic, (msgtype, description) in topics.items():
            writer.set_custom_data(topic, description)
            connections[topic] = writer.add_connection(
                topic, msgtype, typestore=store, offered_qos_profiles=[_qos(topic == latched)]
            )
        for topic, stamp, message in messages:
            writer.write(connections[topic], stamp, message)
    return folder / f"{folder.name}.mcap"


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
