"""`import` and `export`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from mcap.reader import make_reader

from padforge.common.validation import InputError
from padforge.sense import Recording, export_csv, export_hdf5
from padforge.sense.cli import options


def test_import_reads_csv(padforge_sense, brief: Recording) -> None:
    export_csv(brief, "r.csv")
    code, out, _ = padforge_sense("import", "r.csv")
    assert code == 0
    assert out.endswith(" -> out/r/recording\n")
    assert Recording.open("out/r/recording") == brief
    start = json.loads(Path("out/r/recording/start.json").read_text())
    assert start["format"] == "padforge-recording/1"
    assert set(start["provenance"]["inputs"]) == {"r.csv"}


def test_import_puts_columns_to_the_fibres_they_name(padforge_sense, brief: Recording) -> None:
    """As pandas, R and spreadsheets sort columns of their names."""
    wide = replace(brief, readings=brief.readings[:, [0, 1, 2, 3] * 3] + np.arange(12) / 100)
    export_csv(wide, "r.csv")
    table = [line.split(",") for line in Path("r.csv").read_text().splitlines()]
    order = [0, *sorted(range(1, 13), key=lambda i: table[0][i]), 13, 14]
    assert [table[0][i] for i in order][2:4] == ["fibre_10_v", "fibre_11_v"]
    Path("sorted.csv").write_text("".join(",".join(row[i] for i in order) + "\n" for row in table))
    code, out, _ = padforge_sense("import", "sorted.csv")
    assert code == 0
    assert out.startswith("fibres from 1 on: 'fibre_0_v', 'fibre_1_v', 'fibre_2_v'")
    assert Recording.open("out/sorted/recording") == wide
    assert Recording.open("out/sorted/recording").fibre_names[2] == "fibre_2_v"


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


def test_note_of_a_file_is_one_line(padforge_sense, recording: Recording) -> None:
    noted = replace(recording, source={"note": "whole\x1b[1A\x1b[2K\nall fibres sound"})
    export_hdf5(noted, "noted.h5")
    line = r"noted.h5: whole\x1b[1A\x1b[2K\nall fibres sound" + "\n"
    assert padforge_sense("import", "noted.h5")[2] == line
    assert padforge_sense("export", "noted.h5", "noted.csv")[2] == line


def topics(path: str) -> dict[str, int]:
    """How many messages each topic of a bag has."""
    with Path(path).open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        counts = summary.statistics.channel_message_counts
        return {channel.topic: counts[number] for number, channel in summary.channels.items()}


def test_export_writes_a_bag_with_predictions_that_import_reads(few) -> None:
    assert few("export", "rec", "r.mcap", "--model", "model") == (0, "rec -> r.mcap\n", "")
    recording = Recording.open("rec")
    presses = {"/pad/pressed": 2 * 60, "/pad/place": 60, "/pad/touches": 60}
    assert topics("r.mcap") == {"/pad/recording": 1, "/pad/readings": len(recording.readings)} | presses
    code, out, err = few("import", "r.mcap")
    assert (code, err) == (0, "")
    assert out.startswith("60 presses over ")
    assert Recording.open("out/r/recording").digest == recording.digest
    assert few("locate", "--model", "model", "r.mcap", "--out", "places.csv")[0] == 0


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
