"""Recordings and their run directory."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from design.errors import InputError
from sense import Recorder, Recording


@pytest.fixture
def folder(recording: Recording, tmp_path: Path) -> Path:
    recording.save(tmp_path / "run", {"command": "test"})
    return tmp_path / "run"


def test_a_run_directory_gives_back_the_recording(recording: Recording, folder: Path) -> None:
    found = Recording.open(folder)
    assert found == recording
    assert found.digest == recording.digest
    assert found.source == recording.source
    assert found.torn_presses == 0
    assert sorted(path.name for path in folder.parent.iterdir()) == ["run"]


def test_a_torn_stream_loses_the_presses_it_had(recording: Recording, folder: Path) -> None:
    stream = folder / "readings.bin"
    stream.write_bytes(stream.read_bytes()[: -10 * 256 - 3])
    found = Recording.open(folder)
    left = len(found.presses_mm)
    assert 0 < found.torn_presses <= 2
    assert left + found.torn_presses == len(recording.presses_mm)
    assert np.array_equal(found.presses_mm, recording.presses_mm[:left])
    assert np.array_equal(found.readings, recording.readings[: len(found.readings)])


def test_a_torn_journal_line_loses_its_press_only(recording: Recording, folder: Path) -> None:
    journal = folder / "journal.ndjson"
    journal.write_text(journal.read_text()[:-9])
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 1


def test_a_damaged_journal_is_one_clear_error(folder: Path) -> None:
    journal = folder / "journal.ndjson"
    lines = journal.read_text().splitlines(keepends=True)
    journal.write_text("".join([*lines[:4], lines[4].replace("begun", "began"), *lines[5:]]))
    with pytest.raises(InputError, match="line 5 is no journal entry"):
        Recording.open(folder)


def test_a_damaged_middle_of_the_stream_is_an_error(folder: Path) -> None:
    stream = bytearray((folder / "readings.bin").read_bytes())
    stream[len(stream) // 2] ^= 1
    (folder / "readings.bin").write_bytes(stream)
    with pytest.raises(InputError, match="damaged"):
        Recording.open(folder)


def test_a_recording_is_never_written_over(recording: Recording, folder: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match="never written over"):
        recording.save(folder, {})
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (tmp_path / "empty").mkdir()
    recording.save(tmp_path / "empty", {})
    assert Recording.open(tmp_path / "empty") == recording


@pytest.mark.parametrize("fibres", [None, 0, "6", 1e3, True])
def test_a_start_document_without_a_count_of_fibres_is_refused(folder: Path, fibres: object) -> None:
    document = json.loads((folder / "start.json").read_text())
    (folder / "start.json").write_text(json.dumps(document | {"fibres": fibres}))
    with pytest.raises(InputError, match="fibres is"):
        Recording.open(folder)


def test_what_a_live_recorder_synced_can_be_read_before_it_ends(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    readings = rng.standard_normal((30, 3))
    recorder = Recorder(tmp_path / "live", 3, {}, {})
    for i in range(30):
        recorder.append([float(i)], readings[i : i + 1])
        if i == 9:
            recorder.begin((1.5, -2.5), i + 1)
        if i == 19:
            recorder.done(i + 1)
            recorder.sync()
        if i == 25:
            recorder.begin((3.0, 4.0), i + 1)
            recorder.sync()
    found = Recording.open(tmp_path / "live")
    recorder.__exit__(None, None, None)
    assert np.array_equal(found.readings, readings[: len(found.readings)])
    assert len(found.readings) == 26
    assert found.presses_mm.tolist() == [[1.5, -2.5]]
    assert (found.begun.tolist(), found.lifted.tolist()) == ([10], [20])


def spoiled(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"readings": spoiled(r.readings, (7, 0), np.nan)}, r"readings hold NaN.*row 7"),
        (lambda r: {"presses_mm": spoiled(r.presses_mm, (3, 1), np.inf)}, r"presses hold NaN or infinity.*row 3"),
        (lambda r: {"times_s": spoiled(r.times_s, 9, 0.0)}, "do not ascend at reading 9"),
        (lambda r: {"times_s": r.times_s[:-1]}, r"times have shape"),
        (lambda r: {"readings": r.readings[:, :0]}, r"readings have shape"),
        (lambda r: {"presses_mm": r.presses_mm[:0]}, "at least one press"),
        (lambda r: {"begun": spoiled(r.begun, 2, 70)}, "press 2 goes from"),
        (lambda r: {"begun": spoiled(r.begun, 0, 0)}, "press 0 goes from reading 0"),
        (lambda r: {"lifted": spoiled(r.lifted, -1, len(r.readings) + 1)}, "press 299 goes from"),
    ],
)
def test_what_does_not_fit_together_is_refused(recording: Recording, change, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(recording, **change(recording))
