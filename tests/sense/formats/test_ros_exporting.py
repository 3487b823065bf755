"""What a reader of others, `mcap` with `mcap-ros2-support`, finds in a bag that was exported."""

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.formats import ros_recording as exporting
from padforge.sense.formats.annotations import FaultAnnotation, ModelAnnotations
from padforge.sense.formats.import_export import export_file
from padforge.sense.formats.ros_recording import export_bag, import_bag


def others_read(path: Path) -> tuple[dict[str, list[tuple[int, Any]]], dict[str, str]]:
    """Stamps and messages by topic, in the order of the file, and the types of topics."""
    found, kinds = defaultdict(list), {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, content in reader.iter_decoded_messages():
            assert schema is not None
            found[channel.topic].append((message.log_time, content))
            kinds[channel.topic] = schema.name
    return found, kinds


def xyz(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def test_an_independent_reader_finds_types_frames_stamps_and_values(eight: Recording, bag: Path) -> None:
    found, kinds = others_read(bag)
    assert kinds == {
        "/pad/readings": "std_msgs/msg/Float64MultiArray",
        "/pad/pressed": "std_msgs/msg/Bool",
        "/pad/place": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "/pad/reached": "geometry_msgs/msg/PointStamped",
        "/pad/force": "geometry_msgs/msg/WrenchStamped",
        "/pad/recording": "std_msgs/msg/String",
    }
    stamps, messages = zip(*found["/pad/readings"], strict=True)
    assert np.abs(np.array(stamps) - eight.times_s * 1e9).max() <= 1
    np.testing.assert_array_equal([message.data for message in messages], eight.readings)
    (dim,) = messages[0].layout.dim
    assert (dim.label, dim.size, dim.stride) == ("fibre", 4, 4)
    assert [content.data for _, content in found["/pad/pressed"]] == [True, False] * 8
    assert [stamp for stamp, _ in found["/pad/pressed"]][::2] == [stamps[at] for at in eight.down_command]
    places = dict(zip(np.flatnonzero(eight.has_position).tolist(), found["/pad/place"], strict=True))
    for press, (stamp, place) in places.items():
        assert place.header.frame_id == "pad"
        assert place.header.stamp.sec * 10**9 + place.header.stamp.nanosec == stamp == stamps[eight.down_command[press]]
        depth = 0.0 if press == 3 else -eight.depths_mm[press]
        expected = np.append(eight.presses_mm[press], depth) / 1000
        np.testing.assert_allclose(xyz(place.pose.pose.position), expected, rtol=1e-15)
        assert place.pose.pose.orientation.w == 1
        assert [at for at, value in enumerate(place.pose.covariance) if value] == ([14] if press == 3 else [])
    assert places[3][1].pose.covariance[14] == -1
    reached = [content.point.z for _, content in found["/pad/reached"]]
    np.testing.assert_allclose(reached, -np.delete(eight.reached_mm, 3) / 1000, rtol=1e-15)
    forces = [content.wrench.force.z for _, content in found["/pad/force"]]
    np.testing.assert_array_equal(forces, np.delete(eight.forces_n, 4))
    about = json.loads(found["/pad/recording"][0][1].data)
    assert about["format"] == "padforge-ros/2"
    assert about["digest"] == eight.digest
    assert about["topics"]["/pad/readings"].startswith("V, ")
    assert set(about["topics"]) | {"/pad/recording"} == set(kinds)


def test_an_export_reads_back_the_same_and_is_reproducible(eight: Recording, bag: Path, tmp_path: Path) -> None:
    """Also times of any clock, presses on end and one that is never lifted."""
    edges = np.array([10, 21, 200]), np.array([20, 30, len(eight.readings)])
    others = [replace(eight, times_s=eight.times_s + shift) for shift in (-1e3, 1.7e9, 5e9, 0.1234567890123)]
    for other in (eight, *others, Recording(eight.readings, eight.times_s, np.eye(3, 2), *edges)):
        export_bag(other, tmp_path / "eight.mcap")
        assert (found := import_bag(tmp_path / "eight.mcap")) == other
        assert (found.digest, found.source) == (other.digest, other.source)
        assert [file.name for file in tmp_path.iterdir()] == ["eight.mcap"]
    export_bag(eight, tmp_path / "eight.mcap")
    assert (tmp_path / "eight.mcap").read_bytes() == bag.read_bytes()
    with Reader(bag) as reader:  # rosbag2 tells whoever comes later what is in the recording
        durability = {each.topic: each.ext.offered_qos_profiles[0].durability for each in reader.connections}  # pyright: ignore
    assert {topic for topic, how in durability.items() if how == QosDurability.TRANSIENT_LOCAL} == {"/pad/recording"}


def test_what_a_model_says_is_there_with_its_spread(eight: Recording, tmp_path: Path) -> None:
    depth = np.where(np.arange(8) < 4, 2.0, np.nan)
    places = np.full((8, 2), 3.0), np.full((8, 2), [0.5, 0.25])
    faults = [FaultAnnotation(5, (1,), "open", "fibre 2 is open")]
    findings = ModelAnnotations(*places, np.ones(8), depth, depth / 4, faults, (3,))
    export_bag(eight, tmp_path / "r.mcap", findings)
    found, kinds = others_read(tmp_path / "r.mcap")
    assert kinds["/pad/touches"] == "geometry_msgs/msg/PoseWithCovarianceStamped"
    stamp, first = found["/pad/touches"][0]
    assert stamp == found["/pad/readings"][eight.up_command[0]][0]
    np.testing.assert_allclose(xyz(first.pose.pose.position), [0.003, 0.003, -0.002])
    spread = np.sqrt([first.pose.covariance[at] for at in (0, 7, 14)])
    np.testing.assert_allclose(spread, [5e-4, 2.5e-4, 5e-4 / 1.6449])
    assert found["/pad/touches"][7][1].pose.covariance[14] == -1
    levels = [[status.level for status in content.status] for _, content in found["/pad/health"]]
    numbers = [[level if isinstance(level, int) else level[0] for level in each] for each in levels]
    assert numbers == [[0, 0, 0, 2], [0, 2, 0, 2]]
    told = found["/pad/health"][1][1].status[1]
    assert (told.name, told.message, told.values[0].value) == ("pad: fibre 2", "fibre 2 is open", "open")
    assert import_bag(tmp_path / "r.mcap") == eight
    with pytest.raises(InputError, match=r"what a model says can be written as \.mcap"):
        export_file(eight, tmp_path / "r.csv", annotations=findings)


def test_poses_of_an_arm_are_metres_and_quaternions(eight: Recording, tmp_path: Path) -> None:
    states = np.zeros((3, 10))
    states[:, 0] = [-5, 1, 2]
    states[:, 1:4] = [100, 200, 300]
    states[1, 4:7] = [0, np.pi, 0]
    export_bag(eight, tmp_path / "r.mcap", states=states)
    found, _ = others_read(tmp_path / "r.mcap")
    (_, turned), (stamp, straight) = found["/arm/pose"]
    assert stamp == 2 * 10**9
    assert straight.header.frame_id == "base"
    np.testing.assert_allclose(xyz(turned.pose.position), [0.1, 0.2, 0.3])
    np.testing.assert_allclose([turned.pose.orientation.y, turned.pose.orientation.w], [1, 0], atol=1e-15)
    assert straight.pose.orientation.w == 1
    assert import_bag(tmp_path / "r.mcap") == eight


def test_what_import_would_not_take_or_nothing_can_write_is_not_written(
    eight: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "MAX_MESSAGES", 100)
    with pytest.raises(InputError, match=r"would be \d+ messages .* allowed in a bag are 100"):
        export_bag(eight, tmp_path / "r.mcap")
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"too long for a bag: \d+ characters of times, presses and source"):
        export_bag(replace(eight, source={"lists": [[]] * 2**21}), tmp_path / "r.mcap")
    assert not list(tmp_path.iterdir())
    (tmp_path / "there.mcap").mkdir()
    with pytest.raises(InputError, match=r"there\.mcap: is a folder, expected a file or nothing"):
        export_bag(eight, tmp_path / "there.mcap")
    assert [file.name for file in tmp_path.iterdir()] == ["there.mcap"]
    monkeypatch.setitem(__import__("sys").modules, "rosbags.typesys", None)
    for run in (lambda: export_bag(eight, tmp_path / "r.mcap"), lambda: import_bag(tmp_path / "r.mcap")):
        with pytest.raises(InputError, match=r"r\.mcap: .* needs rosbags: pip install 'padforge\[ros\]'"):
            run()
