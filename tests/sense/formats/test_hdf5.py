"""Recordings from and to HDF5."""

from pathlib import Path

import h5py
import pytest

from padforge.common.validation import InputError
from padforge.sense import Recording, export_hdf5, import_hdf5

MAPPING = "time=times_s,fibres=readings_v,positions=presses_mm,down_command=down_command,up_command=up_command"


def refusal_of(path: Path, mapping: str = "") -> str:
    with pytest.raises(InputError) as refusal:
        import_hdf5(path, mapping)
    line = str(refusal.value)
    assert path.name in line
    assert "\n" not in line
    return line


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
