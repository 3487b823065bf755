"""Bags of other programs, and messages as JSON."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
PACKAGES = ("std_msgs", "geometry_msgs", "builtin_interfaces")
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
    """Write a rosbag2 folder of messages; return its file. `packed` ones of SQLite are so message by message."""
    opened = Writer(folder, version=8, storage_plugin=StoragePlugin[plugin.upper()])
    if packed:
        mode = CompressionMode.STORAGE if plugin == "mcap" else CompressionMode.MESSAGE
        opened.set_compression(mode, CompressionFormat.ZSTD)
    topics: dict[str, Any] = {}
    with opened as writer:
        for topic, time_s, message in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(topics[topic], round(time_s * 1e9), STORE.serialize_cdr(message, message.__msgtype__))
    return next(file for file in folder.iterdir() if file.suffix in (".mcap", ".db3"))


def as_json(value: Any) -> Any:
    """Return a message of rosbags as the protocol writes it."""
    if hasattr(value, "__msgtype__"):
        return {name: as_json(part) for name, part in vars(value).items() if name[0].islower()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value
