"""Recordings out of bags: exported ones that were changed since, and bags of others that a mapping tells."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

from padforge.design.common.validation import InputError
from padforge.sense import Recording, open_recording
from padforge.sense.formats.import_export import import_file
from padforge.sense.formats.ros_recording import export_bag, import_bag

from .foreign import STORE, Message, array, make, pose, wrench, write_bag

READINGS, PLACE = "/pad/readings", "/pad/place"


def changed(bag: Path, folder: Path, change: Callable[[str, float, Any], bool]) -> Path:
    """The bag with those messages that `change`, which may alter them, keeps."""

    def messages() -> Iterator[Message]:
        with Reader(bag) as reader:
            for connection, stamp, data in reader.messages():
                message = STORE.deserialize_cdr(data, connection.msgtype)
                if change(connection.topic, stamp / 1e9, message):
                    yield connection.topic, stamp / 1e9, message

    return write_bag(folder, messages())


def close(found: Recording, expected: Recording) -> None:
    """See that a recording is another one, but for what messages round off, and for depths at unknown places."""
    expected = replace(expected, depths_mm=np.where(expected.has_position, expected.depths_mm, np.nan))
    np.testing.assert_array_equal(found.readings, expected.readings)
    np.testing.assert_array_equal([found.down_command, found.up_command], [expected.down_command, expected.up_command])
    for name in ("times_s", "presses_mm", "depths_mm", "reached_mm", "forces_n"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-12, atol=1e-9)


def test_messages_alone_are_the_recording_but_for_roundings(eight: Recording, bag: Path, tmp_path: Path) -> None:
    found = import_bag(changed(bag, tmp_path / "bag", lambda topic, *_: topic != "/pad/recording"))
    close(found, eight)
    assert found.source == {"kind": "ros", "file": "bag.mcap"}
    untold = import_bag(changed(bag, tmp_path / "untold", lambda topic, *_: topic == READINGS))
    assert untold.source["presses"] == "found"
    assert len(untold.presses_mm) >= 7
    assert not untold.has_position.any()


def test_of_a_pad_that_lay_mirrored_z_points_into_it(eight: Recording, tmp_path: Path) -> None:
    mirrored = replace(eight, source={"rig": {"mirrored": True}})
    export_bag(mirrored, tmp_path / "r.mcap")
    assert import_bag(tmp_path / "r.mcap").mirrored
    heights: list[float] = []

    def seen(topic: str, _: float, message: Any) -> bool:
        heights.extend([message.pose.pose.position.z] if topic == PLACE else [])
        return topic != "/pad/recording"

    close(import_bag(changed(tmp_path / "r.mcap", tmp_path / "bag", seen)), eight)
    np.testing.assert_allclose(heights, np.nan_to_num(eight.depths_mm[eight.has_position]) / 1000)


def test_a_part_of_a_bag_is_what_its_messages_say_and_what_is_edited_counts(
    eight: Recording, bag: Path, tmp_path: Path
) -> None:
    first, end = (int(stamps) for stamps in (eight.down_command[1] + 3, eight.down_command[6] + 2))
    span = eight.times_s[[first, end]] + [-1e-6, 1e-6]
    kept = lambda topic, time, _: topic == "/pad/recording" or span[0] <= time <= span[1]  # noqa: E731
    found = import_bag(changed(bag, tmp_path / "bag", kept))
    assert found.source["note"] == "was changed since it was exported; /pad/recording is left out"
    names = ("presses_mm", "depths_mm", "reached_mm", "forces_n")
    part = replace(
        eight,
        readings=eight.readings[first : end + 1],
        times_s=eight.times_s[first : end + 1],
        down_command=eight.down_command[2:7] - first,
        up_command=np.append(eight.up_command[2:6] - first, end + 1 - first),
        **{name: getattr(eight, name)[2:7] for name in names},
    )
    close(found, part)

    def edited(topic: str, _: float, message: Any) -> bool:
        if topic == PLACE:
            message.pose.pose.position.x += moved_m
        if topic == READINGS:
            message.data = message.data + louder_v
        return True

    moved_m, louder_v = 0.001, 0.0
    found = import_bag(changed(bag, tmp_path / "moved", edited))
    np.testing.assert_allclose(found.presses_mm[:, 0], eight.presses_mm[:, 0] + 1)
    moved_m, louder_v = 0.0, 0.5
    found = import_bag(changed(bag, tmp_path / "louder", edited))
    assert found == replace(eight, readings=eight.readings + 0.5)
    assert found.source["note"] == "readings are not those that were exported"


def lab() -> Iterator[Message]:
    """Readings at 50 Hz; from 1 s on a press every second, 0.4 s long, told first, at (n, -n) cm and of 2 n newton."""
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


ALL = "fibres=/skin/all:mV,positions=/probe,force=/wrench,press=/down"


@pytest.mark.parametrize("form", ["mcap", "sqlite3", "packed", "folder", "sqlite3 folder"])
def test_a_bag_of_others_comes_in_by_a_mapping(tmp_path: Path, form: str) -> None:
    bag = write_bag(tmp_path / "lab", lab(), "sqlite3" if "sqlite3" in form else "mcap", form == "packed")
    found = import_file(bag.parent if "folder" in form else bag, ALL)
    n = np.arange(1, 6)
    np.testing.assert_allclose(found.times_s, np.arange(300) / 50)
    np.testing.assert_allclose(found.readings[123], [0.002, 0.123, 0.512])
    np.testing.assert_allclose(found.presses_mm, np.column_stack([10 * n, -10 * n]))
    np.testing.assert_allclose(found.forces_n, 2 * n)
    assert found.down_command.tolist() == (50 * n).tolist()
    assert found.up_command.tolist() == (50 * n + 20).tolist()
    assert found.source["mapping"] == ALL


def test_topics_of_one_number_are_fibres_too_and_hold_until_the_next(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "lab", lab())
    found = import_bag(bag, "fibres=/skin/?:0.01,press=/down,x=/at/x:mm,y=/at/y")
    np.testing.assert_allclose(found.readings[60], [0.01, 59 / 200])  # the second one comes after the first
    assert np.isnan(found.readings[0, 1])
    middle = (found.down_command + found.up_command) // 2
    np.testing.assert_allclose(found.presses_mm, np.column_stack([middle - 1, 1000 * (middle // 2 % 7)]))


@pytest.mark.parametrize(
    ("mapping", "reason"),
    [
        ("", r"has no topic /pad/readings; a mapping tells .* there are '/camera', '/skin/all', .* '/probe'"),
        ("fibres=/skin", r"fibres is '/skin', expected one of '/camera', '/skin/all'"),
        ("fibres=/camera", r"fibres is '/camera' of 'std_msgs/msg/String', expected std_msgs/msg/Float32MultiArray"),
        ("fibres=/skin/all,positions=/wrench", r"places is '/wrench' of .*WrenchStamped', expected geometry_msgs/"),
        ("fibres=/skin/all,press=/skin/1", r"press is '/skin/1' of 'std_msgs/msg/Int16', expected std_msgs/msg/Bool"),
        ("fibres=/skin/all,time=/skin/1", "mapping has 'time=/skin/1', expected QUANTITY=NAME"),
        ("positions=/probe", "does not name fibres, expected fibres in each"),
        ("fibres=/skin/all,fibres=/skin/1,positions=/probe:furlong", "unit of places is 'furlong'"),
    ],
)  # fmt: skip
def test_a_mapping_that_does_not_fit_is_one_clear_line(tmp_path: Path, mapping: str, reason: str) -> None:
    bag = write_bag(tmp_path / "lab", lab())
    with pytest.raises(InputError, match=reason) as refusal:
        import_bag(bag, mapping)
    assert "\n" not in str(refusal.value)


def test_arrays_that_change_their_length_and_topics_that_say_nothing_are_refused(tmp_path: Path) -> None:
    kinds = {"other": array("Float64MultiArray", np.ones(3)), "none": array("Float64MultiArray", np.ones(0))}
    for name, message in kinds.items():
        bag = write_bag(tmp_path / name, [("/f", 0.1, array("Float64MultiArray", np.ones(2))), ("/f", 0.2, message)])
        with pytest.raises(InputError, match=r"fibres is '/f': (data has 2 values in some|message 1 has no data)"):
            import_bag(bag, "fibres=/f")
    readings = [("/f", 0.1 * step, array("Float64MultiArray", np.ones(2))) for step in range(9)]
    for name, pressed in (("never", [(0.2, False)]), ("before", [(0.0, True), (0.1, False)])):
        bag = write_bag(tmp_path / name, [*readings, *(("/down", time, make("Bool", on)) for time, on in pressed)])
        with pytest.raises(InputError, match="press is nowhere true after the first reading"):
            import_bag(bag, "fibres=/f,press=/down")


def test_folders_are_bags_only_where_they_say_so_and_files_in_one_may_be_several_or_in_another_order(
    tmp_path: Path, folder: Path
) -> None:
    with pytest.raises(InputError, match=r"ends in '', allowed are \.mat, \.csv, .*or a rosbag2 folder"):
        import_file(tmp_path)
    assert open_recording(folder)
    bag = write_bag(tmp_path / "lab", lab())
    (bag.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  compression_mode: FILE\n")
    with pytest.raises(InputError, match="lab: is compressed by FILE, expected none or by chunk"):
        import_file(bag.parent, ALL)
    (bag.parent / "metadata.yaml").write_text("")
    assert import_file(bag.parent, ALL).fibres == 3
    bag.unlink()
    with pytest.raises(InputError, match=r"has metadata\.yaml, but no file that ends in \.mcap or \.db3"):
        import_file(bag.parent, ALL)
    messages = list(lab())
    mixed = [messages[at] for at in np.random.default_rng(0).permutation(len(messages))]
    for number, part in enumerate((messages[:400], messages[400:])):
        bag = write_bag(tmp_path / f"part_{number}", part)
        (tmp_path / "bag").mkdir(exist_ok=True)
        bag.rename(tmp_path / "bag" / bag.name)
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    expected = import_file(write_bag(tmp_path / "whole", messages), ALL)
    assert import_file(tmp_path / "bag", ALL) == expected
    assert import_file(write_bag(tmp_path / "mixed", mixed), ALL) == expected
