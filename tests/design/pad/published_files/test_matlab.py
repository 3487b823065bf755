"""MATLAB files of version 7.3, which are HDF5, beside those of earlier ones."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from design import Morphology
from design.common.errors import InputError
from design.pad.published_files.matlab import load_mat


def newer(path: Path, content: dict[str, Any]) -> Path:
    """A file as MATLAB writes it from version 7.3 on: HDF5 behind 512 bytes of text, all arrays transposed."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in content.items():
            if isinstance(values, dict):
                for field, value in values.items():
                    file[f"{name}/{field}"] = np.full((1, 1), value)
            else:
                file[name] = values.T
        file["#refs#/a"] = np.ones((2, 2))
        file["text"] = h5py.Empty("S1")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + b"\x00\x02IM")
    return path


CONTENT = {"para": np.sort(np.random.default_rng(0).uniform(0.5, 2.5, (3, 8)), axis=0), "K": {"object_size": 0.6}}


def test_numbers_and_structures_are_those_of_earlier_versions(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "old.mat", CONTENT)
    old, new = load_mat(tmp_path / "old.mat", ("para",)), load_mat(newer(tmp_path / "new.mat", CONTENT), ("para",))
    assert set(new) == {"para", "K"}
    assert np.array_equal(new["para"], old["para"])
    assert new["K"][0, 0]["object_size"].item() == old["K"][0, 0]["object_size"].item() == 0.6
    pads = [Morphology.load(tmp_path / name) for name in ("old.mat", "new.mat")]
    assert np.array_equal(pads[0].knots, pads[1].knots)


@pytest.mark.parametrize("name", ["5para_dis", "square_grid_cir"])
def test_published_pads_are_the_same_in_version_7_3(published: Path, tmp_path: Path, name: str) -> None:
    stored = scipy.io.loadmat(published / f"{name}.mat")
    settings = {field: stored["K"][0, 0][field].item() for field in ("object_size", "str_shp", "fineness")}
    content = {field: stored[field] for field in ("para", "loc_all", "sens_raw_all")} | {"K": settings}
    pad = Morphology.load(newer(tmp_path / "new.mat", content))
    assert np.array_equal(pad.knots, Morphology.load(published / f"{name}.mat").knots)


def test_a_file_of_7_3_that_takes_values_from_another_is_refused(tmp_path: Path) -> None:
    import h5py

    newer(tmp_path / "new.mat", {"K": {"object_size": 0.6}})
    with h5py.File(tmp_path / "new.mat", "a") as file:
        file.create_dataset("para", (3, 8), "f8", external=[("/etc/hostname", 0, 192)])
    with pytest.raises(InputError, match=r"new\.mat: para has its values in other files"):
        Morphology.load(tmp_path / "new.mat")


def test_a_torn_file_of_7_3_is_one_line(tmp_path: Path) -> None:
    content = newer(tmp_path / "new.mat", CONTENT).read_bytes()
    for keep in (520, 600, 2000, len(content) - 8):
        (tmp_path / "torn.mat").write_bytes(content[:keep])
        with pytest.raises(InputError, match=r"torn\.mat: no HDF5 file that can be read") as refused:
            load_mat(tmp_path / "torn.mat", ())
        assert "\n" not in str(refused.value)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the system does not say how much memory is taken")
def test_a_few_bytes_cannot_ask_for_much_memory(tmp_path: Path) -> None:
    cells = 2**29
    body = struct.pack("<IIII IIII", 6, 8, 1, 0, 5, 8, cells, 1) + struct.pack("<IIQ", 1, 1, ord("a"))
    header = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "cells.mat").write_bytes(header + struct.pack("<II", 14, len(body)) + body)
    with pytest.raises(InputError, match=r"cells\.mat: .*it takes more than 2147483648 bytes to read"):
        load_mat(tmp_path / "cells.mat", ())
