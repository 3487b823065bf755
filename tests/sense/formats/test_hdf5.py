"""Recordings from and to HDF5."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording, export_hdf5, import_hdf5, open_recording

MAPPING = "time=times_s,fibres=readings_v,positions=presses_mm,down_command=down_command,up_command=up_command"


def refusal_of(path: Path, mapping: str = "") -> str:
    with pytest.raises(InputError) as refusal:
        import_hdf5(path, mapping)
    line = str(refusal.value)
    assert path.name in line
    assert "\n" not in line
    return line


def test_export_hdf5_round_trip_is_reproducible(tmp_path: Path, eight: Recording) -> None:
    for each, measures in (
        (eight, {"depths_mm", "reached_mm", "forces_n"}),
        (replace(eight, depths_mm=np.empty(0), reached_mm=np.empty(0)), {"forces_n"}),
    ):
        for name in ("a.h5", "b.h5"):
            export_hdf5(each, tmp_path / name)
        again = import_hdf5(tmp_path / "a.h5")
        assert again == open_recording(tmp_path / "b.h5") == each
        assert again.source == each.source
        assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
        with h5py.File(tmp_path / "a.h5") as file:
            assert set(file) - {"times_s", "readings_v", "presses_mm", "down_command", "up_command"} == measures


def test_import_hdf5_refuses_other_files(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    assert "format is None" in refusal_of(tmp_path / "other.h5")
    assert "cannot be read" in refusal_of(tmp_path / "absent.h5")


def lab(folder: Path, **changes: np.ndarray) -> dict[str, Any]:
    """Write a foreign file."""
    content: dict[str, Any] = {
        "t": np.arange(40.0) * 100,
        "data/volts": np.random.default_rng(0).integers(900, 1100, (3, 40)).astype(np.int16),
        "xy": np.array([[1.0, 2], [-3, 4]]),
        "on": np.array([10, 25]),
        "off": np.array([20, 35]),
    } | changes
    with h5py.File(folder / "lab.h5", "w") as file:
        for name, values in content.items():
            file[name] = values
        file["note"] = "bench 2"
    return content


def test_import_hdf5_by_columns(tmp_path: Path) -> None:
    content = lab(tmp_path)
    mapping = "time=/t:ms,fibres=/data/volts:mV,positions=/xy:cm,down_command=/on,up_command=off"
    recording = import_hdf5(tmp_path / "lab.h5", mapping)
    assert np.array_equal(recording.times_s, content["t"] * 1e-3)
    assert np.array_equal(recording.readings, content["data/volts"].T * 1e-3)
    assert recording.presses_mm.tolist() == [[10, 20], [-30, 40]]
    assert (recording.down_command.tolist(), recording.up_command.tolist()) == ([10, 25], [20, 35])
    names = {"fibre_names": [f"data/volts[{i}]" for i in range(len(content["data/volts"]))]}
    assert recording.source == {"kind": "hdf5", "file": "lab.h5", "columns": mapping, **names}
    lab(tmp_path, on=content["t"][content["on"]], off=content["t"][content["off"]])
    assert import_hdf5(tmp_path / "lab.h5", mapping.replace("/on", "/on:ms").replace("off", "/off:ms")) == recording
    present = "there are 'data/volts', 'note', 'off', 'on', 't', 'xy'"
    assert f"(--columns) say what other datasets hold, {present}" in refusal_of(tmp_path / "lab.h5")
    assert "note holds object values" in refusal_of(tmp_path / "lab.h5", "time=t,fibres=note")


@pytest.mark.parametrize("kind", ["external link", "soft link", "virtual", "external storage"])
def test_import_hdf5_reads_nothing_from_other_files(tmp_path: Path, eight: Recording, kind: str) -> None:
    path, other = tmp_path / "r.h5", tmp_path / "other"
    other.write_bytes(eight.readings.tobytes())
    export_hdf5(eight, path)
    with h5py.File(path, "a") as file:
        del file["readings_v"]
        if kind == "external link":
            file["readings_v"] = h5py.ExternalLink(other, "/x")
        elif kind == "soft link":
            file["readings_v"] = h5py.SoftLink("/times_s")
        elif kind == "virtual":
            layout = h5py.VirtualLayout(eight.readings.shape, "f8", maxshape=(None, eight.fibres))
            source = h5py.VirtualSource(other, "x", eight.readings.shape, maxshape=(None, eight.fibres))
            layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
            file.create_virtual_dataset("readings_v", layout)
        else:
            storage = [(str(other), 0, eight.readings.nbytes)]
            file.create_dataset("readings_v", eight.readings.shape, "f8", external=storage)
    for mapping in ("", MAPPING):
        line = refusal_of(path, mapping)
        assert "readings_v" in line
        assert "expected" in line
