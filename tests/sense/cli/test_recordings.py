"""`import` and `export`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from padforge.common.validation import InputError
from padforge.sense import Recording, export_csv
from padforge.sense.cli import options


def test_import_reads_csv(padforge_sense, brief: Recording) -> None:
    export_csv(brief, "r.csv")
    assert padforge_sense("import", "r.csv")[0] == 0
    assert Recording.open("out/r/recording") == brief
    start = json.loads(Path("out/r/recording/start.json").read_text())
    assert set(start["provenance"]["inputs"]) == {"r.csv"}


def test_import_notes_a_cut_end(padforge_sense, recording: Recording) -> None:
    content = {"voltage": recording.readings[:391], "tim": recording.times_s[None, :391]}
    scipy.io.savemat("cut.mat", content | {"pos": recording.presses_mm[:10].T})
    note = "cut.mat: the last of 10 presses is left out, with 31 of 40 readings\n"
    code, out, err = padforge_sense("import", "cut.mat")
    assert (code, err) == (0, note)
    assert out.startswith("9 presses over ")
    assert Recording.open("out/cut/recording").source["note"] in note
    assert padforge_sense("export", "cut.mat", "cut.csv")[2] == note
    assert padforge_sense("export", "out/cut/recording", "again.csv")[2] == ""


def test_recording_line_counts_what_is_unknown_and_missing() -> None:
    times_s = np.arange(40) / 8
    readings = np.full((40, 3), 1.5)
    readings[3:5, 1] = np.nan
    presses_mm = np.array([[1.0, 2.0], [np.nan, np.nan]])
    recording = Recording(readings, times_s, presses_mm, np.array([10, 30]), np.array([15, 35]))
    line = "2 presses (1 of unknown position), 40 readings of 3 fibres, 2 values missing, at 8.0 Hz -> out"
    assert options.recording_line(recording, Path("out")) == line
    slow = replace(recording, times_s=100 * times_s, readings=np.full((40, 3), 1.5), presses_mm=np.zeros((2, 2)))
    line = "2 presses over 0 x 0 mm, 40 readings of 3 fibres at 0.08 Hz -> out"
    assert options.recording_line(slow, Path("out")) == line
    assert options.fibre_indices((3, 1), 3) == (2, 0)
    for number in (0, 4):
        with pytest.raises(InputError, match=f"fibre {number}: no such fibre, allowed are 1 to 3"):
            options.fibre_indices((number,), 3)
