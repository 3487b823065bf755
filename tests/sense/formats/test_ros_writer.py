"""An MCAP file that follows a recording is whole whenever that is broken off, and holds the presses done by then."""

import logging
import os
import resource
import signal
from collections import defaultdict
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory

from padforge.sense import Recorder, Recording
from padforge.sense.formats.ros_recording import export_bag, import_bag
from padforge.sense.formats.ros_writer import McapFollower
from padforge.sense.recording.run_directory import read_journal
from tests.helpers.kills import killed
from tests.helpers.power_cut import ON_LINUX, Disk

FIBRES = 3
SOURCE = {"kind": "made", "rig": {"mirrored": True}}


def press(recorder: Recorder, number: int) -> None:
    """Record a press of 20 readings at 10 Hz, and 10 states of the arm."""
    times = max(recorder.last_s, 0.0) + 0.1 + np.arange(20) / 10
    recorder.append(times[:10], np.full((10, FIBRES), number + 0.25))
    recorder.append_states(np.column_stack([times[:10], np.full((10, 9), float(number))]))
    recorder.begin((number, -number), recorder.n_readings, number, depth_mm=2.5)
    recorder.sync()
    recorder.append(times[10:], np.full((10, FIBRES), number + 0.5))
    recorder.finish(recorder.n_readings, at_mm=[number, -number, 2.25], force_n=1.5)
    recorder.sync()


def record(folder: Path, presses: range, resume: bool = False) -> None:
    run = folder / "run"
    with Recorder.resume(run) if resume else Recorder(run, FIBRES, SOURCE, {}) as recorder:
        recorder.attach(McapFollower(folder / "run.mcap"))
        for number in presses:
            press(recorder, number)


def messages_of(path: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic by the index; and check that they are there without it, too."""
    topics = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, _, content in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            topics[channel.topic].append(content)
        file.seek(0)
        assert sum(1 for _ in NonSeekingReader(file).iter_messages()) == sum(map(len, topics.values()))
    return topics


def check_follows(folder: Path) -> int:
    """Check that the file has every press that the journal calls done; return how many it has."""
    journal = folder / "run" / "journal.ndjson"
    done = read_journal(journal) if journal.exists() else {}
    if not done and not (folder / "run.mcap").exists():
        return 0
    imported = import_bag(folder / "run.mcap")
    numbers = np.round(imported.presses_mm[:, 0]).astype(int).tolist()
    assert numbers == list(range(len(numbers)))
    assert set(done) <= set(numbers)
    for number, down, up in zip(numbers, imported.down_command, imported.up_command, strict=True):
        assert (imported.readings[down : up - 1] == number + 0.5).all()
    assert len(messages_of(folder / "run.mcap")["/pad/pressed"]) == 2 * len(numbers)
    return len(numbers)


def test_follower_writes_what_export_does(tmp_path: Path) -> None:
    record(tmp_path, range(3))
    assert [file.name for file in sorted(tmp_path.iterdir())] == ["run", "run.mcap"]
    topics = messages_of(tmp_path / "run.mcap")
    recording = Recording.open(tmp_path / "run")
    export_bag(recording, tmp_path / "exported.mcap")
    exported = messages_of(tmp_path / "exported.mcap")
    assert topics.keys() - {"/arm/pose"} == exported.keys() - {"/pad/recording"}
    for topic in topics.keys() - {"/arm/pose"}:
        assert [str(message) for message in topics[topic]] == [str(message) for message in exported[topic]]
    assert [pose.pose.position.x for pose in topics["/arm/pose"]] == pytest.approx(np.repeat([0, 0.001, 0.002], 10))
    assert topics["/pad/place"][0].pose.pose.position.z == 0.0025  # of a pad that lies mirrored
    imported = import_bag(tmp_path / "run.mcap")
    np.testing.assert_allclose(imported.forces_n, recording.forces_n)
    np.testing.assert_allclose(imported.reached_mm, recording.reached_mm)
    np.testing.assert_array_equal(imported.readings, recording.readings)


@ON_LINUX
def test_file_outlasts_a_power_cut_after_every_press(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, path = Disk(monkeypatch), tmp_path / "run.mcap"
    with Recorder(tmp_path / "run", FIBRES, SOURCE, {}) as recorder:
        recorder.attach(McapFollower(path))
        for number in range(3):
            press(recorder, number)
            assert disk.read(path) == path.read_bytes()
    assert "next.mcap" not in disk.torn


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills as POSIX has them")
def test_file_is_whole_after_a_kill_at_any_operation(tmp_path: Path) -> None:
    presses = []
    for number in count():
        (folder := tmp_path / str(number)).mkdir()
        ended = not killed(lambda folder=folder: record(folder, range(2)), number, folder)
        presses.append(check_follows(folder))
        if ended:
            break
    assert presses == sorted(presses)
    assert set(presses) == {0, 1, 2}


def test_resumed_recording_goes_on_with_its_file(tmp_path: Path) -> None:
    record(tmp_path, range(2))
    content = (tmp_path / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(content[: len(content) // 2])
    with Recorder.resume(tmp_path / "run") as recorder:
        recorder.attach(McapFollower(tmp_path / "run.mcap"))
        assert check_follows(tmp_path) == 2
        press(recorder, 2)
        assert check_follows(tmp_path) == 3
    assert check_follows(tmp_path) == 3


def test_position_that_was_taken_back_is_unknown(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
        recorder.attach(McapFollower(tmp_path / "run.mcap"))
        for number in range(3):
            press(recorder, number)
        recorder.begin((np.nan, np.nan), 30, 1)
        recorder.finish(recorder.n_readings - 20, rejected="it was taken back")
        recorder.sync()
        imported = import_bag(tmp_path / "run.mcap")
        assert imported.has_position.tolist() == [True, False, True]
        press(recorder, 3)
        imported = import_bag(tmp_path / "run.mcap")
    assert imported.has_position.tolist() == [True, False, True, True]
    assert imported.up_command.tolist() == [20, 40, 60, 80]


@pytest.mark.parametrize("limit", [20_000, 40_000])
def test_full_disk_costs_the_file_but_no_press(tmp_path: Path, limit: int, caplog: pytest.LogCaptureFixture) -> None:
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    _, hard = before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        with caplog.at_level(logging.WARNING):
            record(tmp_path, range(8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert len(Recording.open(tmp_path / "run").presses_mm) == 8
    (line,) = [entry.getMessage() for entry in caplog.records]
    assert line.endswith("run.mcap: is not continued (File too large); the recording goes on")
    written = import_bag(tmp_path / "run.mcap") if (tmp_path / "run.mcap").exists() else None
    assert (written is None) == (limit == 20_000)
    assert written is None or 1 <= len(written.presses_mm) < 8
    assert {file.name for file in tmp_path.iterdir()} <= {"run", "run.mcap"}
    record(tmp_path, range(8, 9), resume=True)
    assert check_follows(tmp_path) == 9
