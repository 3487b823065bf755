"""What a journal that is torn or damaged tells of the presses."""

import json
from pathlib import Path

import numpy as np
import pytest

from padforge.design.common.validation import InputError
from padforge.sense import Recording
from padforge.sense.recording.run_directory import Recorder


def test_a_torn_journal_line_and_one_that_begins_again_lose_their_press_only(
    recording: Recording, folder: Path
) -> None:
    journal = folder / "journal.ndjson"
    journal.write_text(journal.read_text()[:-9])
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 1
    with Recorder.resume(folder) as recorder:
        recorder.begin((0.0, 0.0), recorder.n_readings, press=7)
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 2


@pytest.mark.parametrize(
    ("old", "new"),
    [
        *(('"reading": 20,', f'"reading": {value},') for value in ("1e30", "20.0", "true", '"20"', "-1", "NaN")),
        *(('"press": 0,', f'"press": {value},') for value in ("0.0", "false", '"0"', "null", "9" * 30)),
        *(('"x_mm": ', f'"x_mm": {value}, "was": ') for value in ("1e999", "1e6", "true", '"2"')),
        ('"event": "started", ', ""),
        ('"event": "started"', '"event": "began"'),
        ('{"event"', "[" * 100_000 + '{"event"'),
        ('{"event"', '3\n{"event"'),
        *(
            ('"event": "done",', f'"event": "done", {more},')
            for more in ('"at_mm": 3', '"at_mm": [1, 2]', '"at_mm": [1, 2, "3"]', '"force_n": true')
        ),
    ],
)
def test_a_journal_entry_of_other_values_is_refused(folder: Path, old: str, new: str) -> None:
    line = 2 if "done" in old else 1
    journal = folder / "journal.ndjson"
    text = journal.read_text()
    assert old in text
    journal.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=rf"journal\.ndjson: line {line} is no journal entry") as caught:
        Recording.open(folder)
    assert len(str(caught.value)) < 400


def test_depth_and_force_are_read_from_what_a_rig_noted(recording: Recording, folder: Path) -> None:
    journal = folder / "journal.ndjson"
    first, *others = journal.read_text().replace('"depth_mm": 5.0', '"depth_mm": null').splitlines(keepends=True)
    done = others[0].replace("}", ', "at_mm": [0.1, 0.2, 3.9], "force_n": 12.5}')
    journal.write_text("".join([first.replace("null", "4"), done, *others[1:]]))
    found = Recording.open(folder)
    assert (found.depths_mm[0], found.reached_mm[0], found.forces_n[0]) == (4.0, 3.9, 12.5)
    assert np.isnan([found.depths_mm[1:], found.reached_mm[1:], found.forces_n[1:]]).all()
    assert found.digest == recording.digest


@pytest.mark.parametrize("name", ["journal.ndjson", "readings.bin"])
def test_a_recording_is_not_gone_on_with_through_links(folder: Path, tmp_path: Path, name: str) -> None:
    elsewhere = (folder / name).rename(tmp_path / "elsewhere")
    elsewhere.write_bytes(elsewhere.read_bytes() + b"torn")
    (folder / name).symlink_to(elsewhere)
    before = {path: path.read_bytes() for path in (*folder.iterdir(), elsewhere)}
    with pytest.raises(InputError, match=rf"{name}: is a link"):
        Recorder.resume(folder)
    assert {path: path.read_bytes() for path in before} == before


def test_presses_without_any_reading_are_not_given_up(folder: Path) -> None:
    """No break leaves that: the readings are elsewhere, or not yet copied here."""
    (folder / "readings.bin").write_bytes(b"")
    before = (folder / "journal.ndjson").read_bytes()
    with pytest.raises(InputError, match=r"readings\.bin: not the readings of \d+ presses"):
        Recorder.resume(folder)
    assert (folder / "journal.ndjson").read_bytes() == before


@pytest.mark.parametrize("fibres", [1, 2, 3, 5, 6, 7, 11])
def test_readings_beside_the_document_of_other_fibres_are_not_cut(folder: Path, fibres: int) -> None:
    """Blocks of one size hold any of several numbers of fibres."""
    start = folder / "start.json"
    document = json.loads(start.read_text())
    assert document["fibres"] == 4
    start.write_text(json.dumps(document | {"fibres": fibres}))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match=r"readings\.bin: .* of \d+ fibres"):
        Recorder.resume(folder)
    assert {path: path.read_bytes() for path in before} == before


def test_presses_that_another_program_has_just_made_count(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may come to its end between the look at the journal and its lock, but not the other way round."""

    def last_made(file: object, busy: str) -> None:
        monkeypatch.undo()
        with Recorder.resume(folder) as another:
            another.append([another.last_s + 1], np.zeros((1, another.fibres)))
            another.begin((0, 0), another.n_readings, press=9999)
            another.append([another.last_s + 1], np.zeros((1, another.fibres)))
            another.finish(another.n_readings)

    monkeypatch.setattr("padforge.sense.recording.run_directory.lock", last_made)
    with Recorder.resume(folder) as recorder:
        assert 9999 in recorder.done
