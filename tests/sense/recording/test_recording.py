"""Recordings and their run directory."""

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from padforge.common.validation import InputError
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


def test_save_refuses_existing_and_unwritable_paths(recording: Recording, folder: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match="never written over"):
        recording.save(folder, {})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (tmp_path / "empty").mkdir()
    recording.save(tmp_path / "empty", {})
    assert Recording.open(tmp_path / "empty") == recording
    (tmp_path / "file").write_text("content")
    for path in (tmp_path / "file", tmp_path / "file" / "below" / "run"):
        for write in (lambda path: recording.save(path, {}), lambda path: Recorder(path, 3, {}, {})):
            with pytest.raises(InputError, match="file is a file, expected a folder"):
                write(path)
    with pytest.raises(InputError, match=r"cannot be written \(File name too long\)"):
        recording.save(tmp_path / ("n" * 300), {})
    assert (tmp_path / "file").read_text() == "content"
    assert {entry.name for entry in tmp_path.iterdir()} == {"run", "empty", "file"}


@pytest.mark.parametrize("change", [{"fibres": 513}, {"source": [1]}, {"format": "padforge-recording/0"}])
def test_open_refuses_other_values_in_the_start_document(folder: Path, change: dict[str, object]) -> None:
    document = json.loads((folder / "start.json").read_text())
    (folder / "start.json").write_text(json.dumps(document | change))
    with pytest.raises(InputError, match=f"{next(iter(change))} is"):
        Recording.open(folder)


def with_value(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"readings": np.full_like(r.readings, np.nan)}, "readings are all missing"),
        (lambda r: {"presses_mm": with_value(r.presses_mm, (3, 1), np.nan)}, "press 3 has one of x and y"),
        (lambda r: {"times_s": with_value(r.times_s, 9, 0.0)}, "do not ascend at reading 9"),
        (lambda r: {"down_command": with_value(r.down_command, 2, 70)}, "press 2 goes from"),
        (lambda r: {"up_command": with_value(r.up_command, -1, len(r.readings) + 1)}, "press 299 goes from"),
        (lambda r: {"forces_n": np.full(300, -1.0)}, "forces_n of press 0 is -1 N, allowed is 0 or more"),
        (lambda r: {"readings": with_value(r.readings, (7, 0), -1e30)}, r"readings hold -1e\+30 V \(first in row 7\)"),
        (lambda r: {"source": {"gain": np.nan}}, "source is .*expected what JSON can hold"),
    ],
)
def test_recording_refuses_invalid_arrays(recording: Recording, change, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        replace(recording, **change(recording))
    assert "\n" not in str(caught.value)


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


def test_open_refuses_other_folders(folder: Path, tmp_path: Path) -> None:
    for path in (tmp_path / "absent", tmp_path, folder / "start.json"):
        with pytest.raises(InputError, match=r"no recording, expected a folder with start\.json, journal\.ndjson and"):
            Recording.open(path)
    (folder / "journal.ndjson").unlink()
    (folder / "journal.ndjson").mkdir()
    with pytest.raises(InputError, match=r"journal\.ndjson: cannot be read \(Is a directory\)"):
        Recording.open(folder)


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
