"""MCAP files of ROS 2, written by the library rosbags."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.common.validation import InputError
from padforge.sense.formats.ros_messages import RECORDING, TOPICS

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore


def load_typestore(purpose: str) -> "Typestore":
    """Return the message definitions of ROS 2; raise InputError, naming the purpose, if rosbags is not installed."""
    try:
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        raise InputError(f"{purpose} needs rosbags: pip install 'padforge[formats]'") from error
    return _typestore()


@cache
def _typestore() -> "Typestore":
    """Return one store for all files, since it compiles code for every type of message."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def write_mcap(folder: Path, store: "Typestore", messages: Iterable[tuple[str, int, memoryview]]) -> Path:
    """Write messages (topic, stamp in ns, CDR) as a rosbag2 folder, and return its .mcap file."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    connections: dict[str, Connection] = {}
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, stamp, message in messages:
            if topic not in connections:
                msgtype, description, _ = TOPICS[topic]
                writer.set_custom_data(topic, description)
                options = {"typestore": store, "offered_qos_profiles": [_qos(is_latched=topic == RECORDING)]}
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
