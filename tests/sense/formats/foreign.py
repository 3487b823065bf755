"""Bags of other programs, written by rosbags and by hand."""

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
PACKAGES = ("std_msgs", "geometry_msgs", "builtin_interfaces")
MAGIC = b"\x89MCAP0\r\n"
Message = tuple[str, float, Any]
"""Topic, time in s and message."""


def make(kind: str, *fields: Any) -> Any:
    """Make a message of a type, by its short name."""
    name = next(f"{package}/msg/{kind}" for package in PACKAGES if f"{package}/msg/{kind}" in STORE.types)
    return STORE.types[name](*fields)


def header(frame: str = "map") -> Any:
    return make("Header", make("Time", 0, 0), frame)


def array(kind: str, values: Any) -> Any:
    return make(kind, make("MultiArrayLayout", [], 0), values)


def pose(x: float, y: float, frame: str = "map") -> Any:
    place = make("Pose", make("Point", x, y, 0.0), make("Quaternion", 0.0, 0.0, 0.0, 1.0))
    return make("PoseStamped", header(frame), place)


def wrench(x: float, y: float, z: float) -> Any:
    return make("WrenchStamped", header(), make("Wrench", make("Vector3", x, y, z), make("Vector3", 0.0, 0.0, 0.0)))


def write_bag(folder: Path, messages: Iterable[Message], plugin: str = "mcap", packed: bool = False) -> Path:
    """Write a rosbag2 folder of messages; return its file."""
    opened = Writer(folder, version=8, storage_plugin=StoragePlugin[plugin.upper()])
    if packed:
        opened.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    topics: dict[str, Any] = {}
    with opened as writer:
        for topic, time_s, message in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(topics[topic], round(time_s * 1e9), STORE.serialize_cdr(message, message.__msgtype__))
    return next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


def record(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def chunk(content: bytes, compression: str = "", size: int | None = None, checksum: int = 0) -> bytes:
    """Make a chunk that claims `size` bytes."""
    claimed = len(content) if size is None else size
    return record(
        6, struct.pack("<QQQI", 0, 0, claimed, checksum) + text(compression) + struct.pack("<Q", len(content)) + content
    )


def mcap_file(path: Path, records: Sequence[bytes]) -> Path:
    """Write an MCAP file of these records."""
    footer = record(2, bytes(20))
    path.write_bytes(MAGIC + record(1, text("ros2") + text("by hand")) + b"".join(records) + footer + MAGIC)
    return path


def channel(number: int, topic: str, kind: str, encoding: str = "cdr") -> bytes:
    """Make the records of a schema and a channel."""
    schema = record(3, struct.pack("<H", number) + text(kind) + text("ros2msg") + text(""))
    return schema + record(4, struct.pack("<HH", number, number) + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(number: int, stamp: int, body: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, stamp, stamp) + body)
