"""Recordings from and to bags of ROS 2, also as another reader (`mcap` with `mcap-ros2-support`) sees them."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from padforge.sense import Recording
from padforge.sense.formats.import_export import import_file
from padforge.sense.formats.ros_recording import export_bag, import_bag

from .foreign import LAB_COLUMNS, STORE, Message, lab, write_bag

READINGS, PLACE = "/pad/readings", "/pad/place"


def test_export_bag_is_read_by_mcap(eight: Recording, bag: Path) -> None:
    topics: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with bag.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            topics[channel.topic].append((message.log_time, content))
    names = ("readings", "pressed", "place", "reached", "force", "recording")
    assert topics.keys() == {f"/pad/{name}" for name in names}
    stamps, messages = zip(*topics["/pad/readings"], strict=True)
    assert np.abs(np.array(stamps) - eight.times_s * 1e9).max() <= 1
    np.testing.assert_array_equal([message.data for message in messages], eight.readings)
    assert [stamp for stamp, _ in topics["/pad/pressed"]][::2] == [stamps[at] for at in eight.down_command]
    places = [[point.x, point.y, point.z] for point in (each.pose.pose.position for _, each in topics["/pad/place"])]
    expected_mm = np.column_stack([eight.presses_mm, -np.nan_to_num(eight.depths_mm)])[eight.has_position]
    np.testing.assert_allclose(places, expected_mm / 1000, rtol=1e-15)


def test_export_bag_round_trip_is_reproducible(eight: Recording, bag: Path, tmp_path: Path) -> None:
    """Also times of any clock, presses without a pause and one without an end."""
    edges = np.array([10, 21, 200]), np.array([20, 30, len(eight.readings)])
    others = [replace(eight, times_s=eight.times_s + shift) for shift in (-1e3, 1.7e9)]
    for other in (eight, *others, Recording(eight.readings, eight.times_s, np.eye(3, 2), *edges)):
        export_bag(other, tmp_path / "eight.mcap")
        assert (imported := import_bag(tmp_path / "eight.mcap")) == other
        assert (imported.digest, imported.source) == (other.digest, other.source)
        assert [file.name for file in tmp_path.iterdir()] == ["eight.mcap"]
    export_bag(eight, tmp_path / "eight.mcap")
    assert (tmp_path / "eight.mcap").read_bytes() == bag.read_bytes()
    with Reader(bag) as reader:  # rosbag2 tells whoever comes later what is in the recording
        durability = {each.topic: each.ext.offered_qos_profiles[0].durability for each in reader.connections}  # pyright: ignore
    assert {topic for topic, how in durability.items() if how == QosDurability.TRANSIENT_LOCAL} == {"/pad/recording"}


def changed(bag: Path, folder: Path, change: Callable[[str, float, Any], bool]) -> Path:
    """Write the messages of a bag for which `change`, which may alter them, returns True."""

    def messages() -> Iterator[Message]:
        with Reader(bag) as reader:
            for connection, stamp, data in reader.messages():
                message = STORE.deserialize_cdr(data, connection.msgtype)
                if change(connection.topic, stamp / 1e9, message):
                    yield connection.topic, stamp / 1e9, message

    return write_bag(folder, messages())


def check_close(recording: Recording, expected: Recording) -> None:
    """Check that recordings are equal but for rounding, and depths at unknown positions."""
    expected = replace(expected, depths_mm=np.where(expected.has_position, expected.depths_mm, np.nan))
    for name in ("readings", "down_command", "up_command"):
        np.testing.assert_array_equal(getattr(recording, name), getattr(expected, name))
    for name in ("times_s", "presses_mm", "depths_mm", "reached_mm", "forces_n"):
        np.testing.assert_allclose(getattr(recording, name), getattr(expected, name), rtol=1e-12, atol=1e-9)


def test_import_bag_from_messages_alone(eight: Recording, bag: Path, tmp_path: Path) -> None:
    imported = import_bag(changed(bag, tmp_path / "bag", lambda topic, *_: topic != "/pad/recording"))
    check_close(imported, eight)
    names = {"fibre_names": [f"/pad/readings[{i}]" for i in range(eight.fibres)]}
    assert imported.source == {"kind": "ros", "file": "bag.mcap", **names}

    def unfit(topic: str, _: float, message: Any) -> bool:
        if topic == "/pad/recording":
            message.data = '{"format": "padforge-ros/1"}'
        return True

    assert "was changed" in import_bag(changed(bag, tmp_path / "unfit", unfit)).source["note"]
    unpressed = import_bag(changed(bag, tmp_path / "unpressed", lambda topic, *_: topic == READINGS))
    assert unpressed.source["presses"] == "detected"
    assert len(unpressed.presses_mm) >= 7
    assert not unpressed.has_position.any()


def test_z_points_into_a_mirrored_pad(eight: Recording, tmp_path: Path) -> None:
    mirrored = replace(eight, source={"rig": {"mirrored": True}})
    export_bag(mirrored, tmp_path / "r.mcap")
    assert import_bag(tmp_path / "r.mcap").mirrored
    without = changed(tmp_path / "r.mcap", tmp_path / "bag", lambda topic, *_: topic != "/pad/recording")
    check_close(import_bag(without), eight)


def test_import_bag_of_a_cut_or_edited_bag(eight: Recording, bag: Path, tmp_path: Path) -> None:
    first, end = (int(stamps) for stamps in (eight.down_command[1] + 3, eight.down_command[6] + 2))
    span = eight.times_s[[first, end]] + [-1e-6, 1e-6]
    in_span = lambda topic, time, _: topic == "/pad/recording" or span[0] <= time <= span[1]  # noqa: E731
    imported = import_bag(changed(bag, tmp_path / "bag", in_span))
    assert imported.source["note"] == "was changed since it was exported; /pad/recording is left out"
    names = ("presses_mm", "depths_mm", "reached_mm", "forces_n")
    part = replace(
        eight,
        readings=eight.readings[first : end + 1],
        times_s=eight.times_s[first : end + 1],
        down_command=eight.down_command[2:7] - first,
        up_command=np.append(eight.up_command[2:6] - first, end + 1 - first),
        **{name: getattr(eight, name)[2:7] for name in names},
    )
    check_close(imported, part)

    def edited(topic: str, _: float, message: Any) -> bool:
        if topic == PLACE:
            message.pose.pose.position.x += moved_m
        if topic == READINGS:
            message.data = message.data + louder_v
        return True

    moved_m, louder_v = 0.001, 0.0
    imported = import_bag(changed(bag, tmp_path / "moved", edited))
    np.testing.assert_allclose(imported.presses_mm[:, 0], eight.presses_mm[:, 0] + 1)
    moved_m, louder_v = 0.0, 0.5
    imported = import_bag(changed(bag, tmp_path / "louder", edited))
    assert imported == replace(eight, readings=eight.readings + 0.5)
    assert imported.source["note"] == "readings are not those that were exported"


@pytest.mark.parametrize("form", ["sqlite3", "packed mcap", "mcap folder", "packed sqlite3 folder", "unsorted mcap"])
def test_bags_of_all_forms_are_read_alike(tmp_path: Path, form: str) -> None:
    messages = list(lab())
    if "unsorted" in form:
        messages = [messages[at] for at in np.random.default_rng(0).permutation(len(messages))]
    bag = write_bag(tmp_path / "lab", messages, "sqlite3" if "sqlite3" in form else "mcap", "packed" in form)
    recording = import_file(bag.parent if "folder" in form else bag, LAB_COLUMNS)
    assert recording == import_file(write_bag(tmp_path / "plain", lab()), LAB_COLUMNS)
