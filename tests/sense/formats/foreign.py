"""Bags of other programs, and messages as JSON."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_HUMBLE)
PACKAGES = ("std_msgs", "geometry_msgs", "builtin_interfaces", "sensor_msgs", "nav_msgs")
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


def write_ros1_bag(path: Path, topic: str, times_s: Any, values: Any) -> Path:
    """Write a bag of ROS 1 with an array (N, C) of numbers, a message each."""
    store = get_typestore(Stores.ROS1_NOETIC)
    layout, kind = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0), "std_msgs/msg/Float64MultiArray"
    with Ros1Writer(path) as writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for time_s, row in zip(times_s, values, strict=True):
            message = store.serialize_ros1(store.types[kind](layout=layout, data=row), kind)
            writer.write(connection, round(time_s * 1e9), message)
    return path


def as_json(value: Any) -> Any:
    """Return a message of rosbags as the protocol writes it."""
    if hasattr(value, "__msgtype__"):
        return {name: as_json(part) for name, part in vars(value).items() if name[0].islower()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value


LAB_COLUMNS = "fibres=/skin/all:mV,positions=/probe,force=/wrench,press=/down"


def lab() -> Iterator[Message]:
    """Yield readings at 50 Hz; from 1 s on a press every second, 0.4 s long, at (n, -n) cm and with 2 n N."""
    yield "/camera", 0.0, make("String", "no picture")
    for step in range(300):
        time = step / 50
        number = step // 50
        if step % 50 == 0 and number:
            yield "/probe", time - 0.001, pose(number / 100, -number / 100)
            yield "/wrench", time - 0.001, wrench(0.0, 1.2 * number, -1.6 * number)
        if step % 50 in (0, 20) and number:
            yield "/down", time - 0.001, make("Bool", step % 50 == 0)
        yield "/skin/all", time, array("Float32MultiArray", np.array([number, step, 512], np.float32))
        yield "/skin/1", time, make("Int16", number)
        yield "/skin/2", time + 0.001, make("Float64", step / 2)
        if step % 2 == 0:
            yield "/at/y", time, make("UInt8", step // 2 % 7)
        yield "/at/x", time + 0.001, make("Float32", step)
