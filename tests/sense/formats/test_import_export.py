"""Mappings of columns, arrays, import and export by extension, and files that a crash or a broken copy has damaged."""

import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
import pytest
import scipy.io

from padforge import sense
from padforge.common.validation import InputError
from padforge.sense import Recording, export_bag, export_hdf5, import_hdf5
from padforge.sense.formats import ros_recording
from padforge.sense.formats.assembly import ForeignArrays, assemble_recording
from padforge.sense.formats.columns import ColumnEntry, match_columns, parse_columns
from padforge.sense.formats.csv_recording import read_presses
from padforge.sense.formats.import_export import arm_states, export_file, import_file
from padforge.sense.recording.recording import PRESSES_DETECTED
from tests.helpers.door import contents
from tests.helpers.refusals import refusal_table

from .foreign import LAB_COLUMNS, array, lab, write_bag


def test_match_columns_orders_fibres_by_their_numbers() -> None:
    def order(*names: str, mapping: str = "time=t,fibres=*") -> list[str]:
        return [entry.name for entry, _ in match_columns(parse_columns(mapping), ["t", *names])[1:]]

    assert order("fibre_0_v", "fibre_10_v", "fibre_1_v") == ["fibre_0_v", "fibre_1_v", "fibre_10_v"]
    assert order("c02", "c10", "c1") == ["c1", "c02", "c10"]
    assert order("left", "back", "2nd") == ["left", "back", "2nd"]  # a table has an order of its own
    assert order("c2", "c1", mapping="time=t,fibres=c2,fibres=c1") == ["c2", "c1"]  # as stated


TIMES = np.arange(12) / 10
VOLTS = np.arange(24.0).reshape(12, 2)
PRESSED = np.array([0, 0, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0])
POSITIONS = np.array([[1.0, 2], [-3, 4]])
COMMANDS = {"down_command": np.array([2, 7]), "up_command": np.array([5, 9])}
PROBE = POSITIONS[[0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]]
"""Position of the probe at each reading."""
NUMBERED = PRESSED * np.array([5] * 6 + [3] * 6)


def assembled(arrays: Mapping[str, np.ndarray], **factors: float) -> Recording:
    content = {"time": TIMES, "fibres": VOLTS} | dict(arrays)
    entries = [(ColumnEntry(name, "?", factors.get(name)), content[name]) for name in content]
    return assemble_recording(ForeignArrays(Path("f"), entries, {}))


@pytest.mark.parametrize(
    "arrays",
    [
        COMMANDS | {"positions": POSITIONS},
        COMMANDS | {"x": POSITIONS[:, 0], "y": POSITIONS[None, :, 1]},
        {"press": PRESSED.astype(bool)[:, None], "positions": PROBE},
        {"press": np.where(PRESSED, NUMBERED, np.nan), "positions": PROBE},
        {"press": np.where(PRESSED, NUMBERED, -1), "positions": POSITIONS.T.astype(np.float32)},
        {"positions": np.where(PRESSED[:, None], PROBE, np.nan)},
    ],
)
def test_assemble_recording_finds_presses_in_any_form(arrays: dict[str, np.ndarray]) -> None:
    recording = assembled(arrays)
    assert recording.down_command.tolist() == [2, 7]
    assert recording.up_command.tolist() == [5, 9]
    # Two positions of two presses may be (2, n) or (n, 2): rows are presses.
    expected = POSITIONS.T if arrays.get("positions", PROBE).dtype == "f4" else POSITIONS
    assert recording.presses_mm.tolist() == expected.tolist()


def test_assemble_recording_detects_presses_in_the_readings(recording: Recording) -> None:
    probe = np.full((len(recording.readings), 2), np.nan)
    for position, down in zip(recording.presses_mm, recording.down_command, strict=True):
        probe[down - 10 :] = position
    probe[:10] = recording.presses_mm[0]
    content = {"time": recording.times_s[:800], "fibres": recording.readings[:800]}
    for positions in (recording.presses_mm[:20], probe[:800]):
        detected = assembled(content | {"positions": positions})
        assert np.array_equal(detected.presses_mm, recording.presses_mm[:20])
        assert np.abs(detected.down_command - recording.down_command[:20]).max() <= 3
        assert PRESSES_DETECTED.items() <= detected.source.items()
    with pytest.raises(InputError, match="positions are 19, expected one for each of 20 presses or 800 readings"):
        assembled(content | {"positions": recording.presses_mm[:19]})


def test_assemble_recording_bridges_gaps_of_positions(recording: Recording) -> None:
    """A motion capture loses 5 % of the positions for one reading."""
    positions = np.full((len(recording.times_s), 2), np.nan)
    depths = np.full(len(positions), np.nan)
    for position, down, up in zip(recording.presses_mm, recording.down_command, recording.up_command, strict=True):
        positions[down:up], depths[down:up] = position, 3.0
    lost = np.random.default_rng(0).random(len(positions)) < 0.05
    lost[[*recording.down_command, *(recording.up_command - 1)]] = False
    content = {"time": recording.times_s, "fibres": recording.readings}
    gappy = {"positions": np.where(lost[:, None], np.nan, positions), "depth": np.where(lost, np.nan, depths)}
    bridged = assembled(content | gappy)
    assert np.array_equal(bridged.down_command, recording.down_command)
    assert np.array_equal(bridged.up_command, recording.up_command)
    assert np.array_equal(bridged.presses_mm, recording.presses_mm)
    assert (bridged.depths_mm == 3).all()
    n_lost = int((lost & ~np.isnan(positions[:, 0])).sum())
    assert bridged.source["note"].startswith(f"{n_lost} readings within presses lack a position; gaps of up to 3")


@pytest.mark.parametrize(("gap", "rest", "presses"), [(2, 6, 2), (3, 6, 3), (4, 12, 3)])
def test_assemble_recording_keeps_rests_between_presses(gap: int, rest: int, presses: int) -> None:
    """Two presses on one spot are two if the pad rests as long between others."""
    x = np.array([*[np.nan] * 5, *[1.0] * 5, *[np.nan] * gap, *[1.0] * 5, *[np.nan] * rest, *[2.0] * 5, np.nan])
    content = {"time": np.arange(len(x)) / 10, "fibres": np.ones((len(x), 1)), "x": x, "y": x}
    assert len(assembled(content).down_command) == presses


@pytest.mark.parametrize("are_measured", [True, False])
@pytest.mark.parametrize("name", ["run", "run.csv", "run.h5", "run.mcap"])
def test_each_format_keeps_missing_values(eight: sense.Recording, tmp_path, name: str, are_measured: bool) -> None:
    """The same recording gives the same bytes, and tables have no column of what no press has."""
    if not are_measured:
        eight = replace(eight, depths_mm=np.empty(0), reached_mm=np.empty(0))
    paths = [tmp_path / folder / name for folder in ("one", "other")]
    for path in paths:
        path.parent.mkdir()
        eight.save(path, {}) if name == "run" else export_file(eight, path)
    imported = sense.open_recording(paths[0])
    assert imported == eight
    assert imported.digest == eight.digest
    assert imported.has_position.sum() == 7
    if name != "run":
        content, again = (path.read_bytes() for path in paths)
        assert content == again
        assert (b"reached" in content) is are_measured or name == "run.mcap"
    if name != "run.csv":
        assert imported.source == eight.source


def test_arm_states_of_a_run_directory(tmp_path: Path) -> None:
    states = np.arange(30.0).reshape(3, 10)
    with sense.Recorder(tmp_path / "run", 1, {}, {}) as recorder:
        recorder.append([0.0, 1.0], [[1.0], [2.0]])
        recorder.append_states(states)
    np.testing.assert_array_equal(arm_states(tmp_path / "run"), states)
    assert arm_states(tmp_path / "run.csv") is None


READERS = {"csv": sense.import_csv, "mat": sense.import_mat, "h5": sense.import_hdf5, "mcap": sense.import_bag}
WRITERS = (sense.export_csv, sense.export_hdf5, sense.export_bag, sense.export_lerobot)
UNRELATED = {
    "image": b"\x89PNG\r\n\x1a\n" + np.random.default_rng(1).bytes(2000),
    "empty": b"",
    "text": b"dear all,\nplease find attached\n",
    "people": b"name,age\nAda,36\n",
}


def test_what_readers_and_writers_are_asked_in_vain(eight: sense.Recording, golden, tmp_path, monkeypatch) -> None:
    """To read folders, nothing and files of another kind; to write where something is, other things, and too much."""
    for end in (*READERS, "db3"):
        (tmp_path / f"folder.{end}").mkdir()
        for name, content in UNRELATED.items():
            (tmp_path / f"{name}.{end}").write_bytes(content)
    (tmp_path / "presses.csv").write_text("x_mm,y_mm\n1,2\n")
    write_bag(tmp_path / "lab", lab()).unlink()
    ones = array("Float64MultiArray", np.ones(50))
    damaged = write_bag(tmp_path / "damaged", [("/f", i / 10, ones) for i in range(9)])
    content, length = damaged.read_bytes(), damaged.read_bytes().index(np.ones(50).tobytes()) - 8
    damaged.write_bytes(content[:length] + b"\xff\xff\xff\x7f" + content[length + 4 :])
    known, other = replace(eight, depths_mm=np.ones(8)), cast("Any", 3)
    touches = sense.Localization(np.ones((8, 2)), np.ones((8, 2)), np.ones(8), np.ones(8))
    rows = {
        **{
            f"{name}.{end}": partial(read, tmp_path / f"{name}.{end}")
            for end, read in READERS.items()
            for name in ("folder", "absent")
        },
        **{f"{name}.{end}": partial(import_file, tmp_path / f"{name}.{end}") for end in READERS for name in UNRELATED},
        **{f"{name}.db3": partial(import_file, tmp_path / f"{name}.db3") for name in ("folder", *UNRELATED)},
        "a folder of other files": lambda: import_file(tmp_path),
        "a bag without its file": lambda: import_file(tmp_path / "lab", LAB_COLUMNS),
        "an array in a bag of a damaged length": lambda: sense.import_bag(damaged, "fibres=/f"),
        "presses without times": lambda: read_presses(tmp_path / "presses.csv"),
        "arrays of fewer readings": lambda: assembled({"fibres": np.ones((11, 2))}),
        "a press in two ways": lambda: assembled({"press": np.where(PRESSED, 1, np.where(TIMES > 1, -1, 0))}),
        "a press that never ends": lambda: assembled({"press": 1 + PRESSED}),
        "positions of another press": lambda: assembled(COMMANDS | {"positions": np.ones((3, 2))}),
        "arrays without a press": lambda: assembled({}),
        "columns that are a number": lambda: sense.import_csv("file", other),
        **{f"{write.__name__} of a number": partial(write, other, tmp_path / "x") for write in WRITERS},
        "a table onto a folder": lambda: sense.export_csv(eight, tmp_path),
        "a table below a file": lambda: sense.export_csv(eight, tmp_path / "presses.csv" / "r.csv"),
        "a bag onto a folder": lambda: sense.export_bag(eight, tmp_path / "folder.mcap"),
        "a dataset among other files": lambda: sense.export_lerobot(known, tmp_path),
        "a dataset of no position": lambda: sense.export_lerobot(
            replace(known, presses_mm=np.full((8, 2), np.nan)), tmp_path / "set"
        ),
        "predictions in a table": lambda: export_file(eight, tmp_path / "r.csv", localization=touches),
    }
    before, said = contents(tmp_path), refusal_table(rows)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setattr(ros_recording, "_typestore", partial(import_module, "rosbags.missing"))
    missing = {
        "a dataset without pyarrow": lambda: sense.export_lerobot(known, tmp_path / "set"),
        "a bag without rosbags": lambda: sense.export_bag(eight, tmp_path / "r.mcap"),
        "the bag of another without rosbags": lambda: sense.import_bag(tmp_path / "people.mcap"),
    }
    reasons = [rf"(?<={words} )\(.*\)" for words in ("be read", "damaged", "file", "be written")]  # of others' words
    golden("formats/refusals.txt", f"{said}\n{refusal_table(missing)}", forget=reasons)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["r.mat", "r.h5", "r.mcap", "packed.mcap", "r.db3"])
def test_import_file_of_files_without_their_end(eight: Recording, bag: Path, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name in ("packed.mcap", "r.db3"):
        messages = [("/pad/readings", i / 10, array("Float64MultiArray", np.ones(500) + i)) for i in range(60)]
        write_bag(tmp_path / "bag", messages, "sqlite3" if name == "r.db3" else "mcap", name != "r.db3").rename(path)
    elif name == "r.mat":
        scipy.io.savemat(path, {"voltage": eight.readings, "tim": eight.times_s[None], "pos": eight.presses_mm.T})
    else:
        {"r.h5": export_hdf5, "r.mcap": export_bag}[name](eight, path)
    content = path.read_bytes()
    for share in (0.2, 0.5, 0.9):
        path.write_bytes(content[: int(share * len(content))])
        with pytest.raises(InputError) as refusal:
            import_file(path)
        assert "\n" not in str(refusal.value)
        assert name in str(refusal.value)


MAPPING = "time=times_s,fibres=readings_v,positions=presses_mm,down_command=down_command,up_command=up_command"


@pytest.mark.parametrize("kind", ["external link", "soft link", "virtual", "external storage"])
def test_import_hdf5_reads_nothing_from_other_files(tmp_path: Path, eight: Recording, kind: str) -> None:
    path, other = tmp_path / "r.h5", tmp_path / "other"
    other.write_bytes(eight.readings.tobytes())
    export_hdf5(eight, path)
    with h5py.File(path, "a") as file:
        del file["readings_v"]
        links = {"external link": h5py.ExternalLink(other, "/x"), "soft link": h5py.SoftLink("/times_s")}
        if kind in links:
            file["readings_v"] = links[kind]
        elif kind == "virtual":
            layout = h5py.VirtualLayout(eight.readings.shape, "f8", maxshape=(None, eight.fibres))
            source = h5py.VirtualSource(other, "x", eight.readings.shape, maxshape=(None, eight.fibres))
            layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
            file.create_virtual_dataset("readings_v", layout)
        else:
            storage = [(str(other), 0, eight.readings.nbytes)]
            file.create_dataset("readings_v", eight.readings.shape, "f8", external=storage)
    for mapping in ("", MAPPING):
        with pytest.raises(InputError, match=r"^.*r\.h5.*readings_v.*expected.*$"):  # in one line
            import_hdf5(path, mapping)
