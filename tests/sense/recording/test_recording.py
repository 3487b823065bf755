"""Recordings and their run directory."""

import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.sense import Recorder, Recording


def test_save_and_open_round_trip_and_torn_readings(recording: Recording, folder: Path) -> None:
    opened = Recording.open(folder)
    assert opened == recording
    assert opened.digest == recording.digest
    assert opened.source == recording.source
    assert opened.torn_presses == 0
    assert sorted(path.name for path in folder.parent.iterdir()) == ["run"]
    stream = folder / "readings.bin"
    stream.write_bytes(stream.read_bytes()[: -10 * 256 - 3])
    opened = Recording.open(folder)
    n_complete = len(opened.presses_mm)
    assert 0 < opened.torn_presses <= 2
    assert n_complete + opened.torn_presses == len(recording.presses_mm)
    assert np.array_equal(opened.presses_mm, recording.presses_mm[:n_complete])
    assert np.array_equal(opened.readings, recording.readings[: len(opened.readings)])


def test_save_fills_an_empty_folder(recording: Recording, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    recording.save(tmp_path / "empty", {})
    assert Recording.open(tmp_path / "empty") == recording
    assert [entry.name for entry in tmp_path.iterdir()] == ["empty"]


def with_value(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


def test_equality_and_digest_treat_all_nan_alike(recording: Recording) -> None:
    other_nan = -np.array([0x7FF8000000000001], dtype=np.uint64).view(np.float64)[0]
    positions = with_value(recording.presses_mm, 3, np.nan)
    one, other = (
        replace(recording, readings=with_value(recording.readings, (7, 0), nan), presses_mm=positions)
        for nan in (np.nan, other_nan)
    )
    assert one == other != recording
    assert one.digest == other.digest != recording.digest
    assert one.has_position.tolist() == [press != 3 for press in range(300)]


def test_recording_accepts_limits_and_uneven_times(recording: Recording, tmp_path: Path) -> None:
    assert replace(recording, down_command=recording.down_command.astype(float)) == recording
    for name, index, most in (("readings", (7, 0), -1e3), ("presses_mm", (3, 1), 1e5), ("times_s", -1, 1e10)):
        assert getattr(replace(recording, **{name: with_value(getattr(recording, name), index, most)}), name).size
    uneven = np.cumsum(np.random.default_rng(0).exponential(0.07, len(recording.times_s)))
    assert replace(recording, times_s=uneven).rate_hz == pytest.approx(1 / 0.07 / np.log(2), rel=0.1)
    least = Recording(np.ones((2, 1)), np.arange(2.0), np.full((1, 2), np.nan), np.array([1]), np.array([2]))
    least.save(tmp_path / "run", {})
    assert Recording.open(tmp_path / "run") == least


def test_measures_are_saved_but_not_in_the_digest(recording: Recording, tmp_path: Path) -> None:
    count = len(recording.down_command)
    unknown = replace(recording, depths_mm=np.empty(0))
    assert np.isnan([unknown.depths_mm, unknown.reached_mm, unknown.forces_n]).all()
    reached = np.where(np.arange(count) % 2 == 0, np.nan, 4.9)
    measured = replace(recording, reached_mm=reached, forces_n=np.linspace(0, 9, count))
    assert measured != recording
    assert measured.digest == recording.digest == unknown.digest
    assert measured.actual_depths_mm[:4].tolist() == [5, 4.9, 5, 4.9]
    for number, each in enumerate((unknown, measured)):
        each.save(tmp_path / str(number), {})
        assert Recording.open(tmp_path / str(number)) == each
    with pytest.raises(ValueError, match="read-only"):
        measured.forces_n[0] = 1


def test_open_while_recording(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    readings = rng.standard_normal((30, 3))
    recorder = Recorder(tmp_path / "live", 3, {}, {})
    recorder.append(np.arange(20.0), readings[:20])
    recorder.begin((1.5, -2.5), 10)
    recorder.finish(20)
    recorder.append(np.arange(20.0, 26.0), readings[20:26])
    recorder.begin((3.0, 4.0), 26)
    recorder.sync()
    recorder.append(np.arange(26.0, 30.0), readings[26:])
    opened = Recording.open(tmp_path / "live")
    recorder.__exit__(None, None, None)
    assert np.array_equal(opened.readings, readings[:26])
    assert opened.presses_mm.tolist() == [[1.5, -2.5]]
    assert (opened.down_command.tolist(), opened.up_command.tolist()) == ([10], [20])


def test_open_needs_little_more_memory_than_the_readings(tmp_path: Path) -> None:
    """Neither the content of the file nor a second copy of the readings is kept."""
    readings, down = np.random.default_rng(0).normal(size=(30_000, 60)), np.arange(1, 30_000, 40)
    recording = Recording(readings, np.arange(30_000.0), np.zeros((len(down), 2)), down, down + 20)
    recording.save(tmp_path / "recording", {})
    tracemalloc.start()
    opened = Recording.open(tmp_path / "recording")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert opened == recording
    assert peak < 1.6 * (readings.nbytes + 8 * len(readings)) + 2**23
