from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io

from padforge import InputError
from padforge.common.mat_files import load_mat
from padforge.design import Morphology


def newer(path: Path, content: dict[str, Any]) -> Path:
    """A file as MATLAB writes it from version 7.3 on: HDF5 behind 512 bytes of text, all arrays transposed."""
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


def test_load_mat_reads_every_version_and_refuses_torn_files(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "old.mat", CONTENT)
    old, new = load_mat(tmp_path / "old.mat", ("para",)), load_mat(newer(tmp_path / "new.mat", CONTENT), ("para",))
    assert set(new) == {"para", "K", "text"}
    assert isinstance(new["text"], str)
    assert np.array_equal(new["para"], old["para"])
    assert new["K"]["object_size"].item() == old["K"]["object_size"].item() == 0.6
    pads = [Morphology.load(tmp_path / name) for name in ("old.mat", "new.mat")]
    assert np.array_equal(pads[0].knots, pads[1].knots)
    content = newer(tmp_path / "new.mat", CONTENT).read_bytes()
    for torn, kind in ((content[:2000], "HDF5"), ((tmp_path / "old.mat").read_bytes()[:300], "MATLAB")):
        (tmp_path / "torn.mat").write_bytes(torn)
        with pytest.raises(InputError, match=rf"torn\.mat: not a readable {kind} file"):
            load_mat(tmp_path / "torn.mat", ())
    scipy.io.savemat(tmp_path / "old.mat", {"para": CONTENT["para"]}, format="4")
    assert np.array_equal(load_mat(tmp_path / "old.mat", ("para",))["para"], CONTENT["para"])


@pytest.mark.parametrize(("name", "knots"), [("5para_dis", 5), ("square_grid_cir", 0)])
def test_morphology_loads_published_pads_of_both_versions(published: Path, tmp_path: Path, name: str, knots: int):
    stored = scipy.io.loadmat(published / f"{name}.mat")
    known = {field: stored["K"][0, 0][field].item() for field in ("object_size", "str_shp", "fineness")}
    content = {field: stored[field] for field in ("para", "loc_all", "sens_raw_all")} | {"K": known}
    pad = Morphology.load(published / f"{name}.mat")
    assert pad.knots.shape == (8, knots + 2, 2)
    assert pad.pitch_mm == 11.25
    assert np.array_equal(pad.knots, Morphology.load(newer(tmp_path / "new.mat", content)).knots)


def test_morphology_refuses_samples_not_as_published(tmp_path: Path) -> None:
    path, known = tmp_path / "pad.mat", {"object_size": 0.6, "str_shp": 30, "fineness": 100}
    samples = CONTENT | {"K": known, "loc_all": np.ones((5, 2)), "sens_raw_all": np.ones((5, 4))}
    scipy.io.savemat(path, samples)
    assert Morphology.load(path).grid == 2
    shapes = {"sens_raw_all": np.ones((5, 7))}, {"loc_all": np.ones((2, 2, 8))}
    for change in ({"K": known | {"object_size": -1}}, {"K": known | {"str_shp": "text"}}, *shapes):
        scipy.io.savemat(path, samples | change)
        with pytest.raises(InputError, match="not as published"):
            Morphology.load(path)


def test_load_mat_refuses_external_and_virtual_values(tmp_path: Path) -> None:
    newer(tmp_path / "other.h5", {"para": CONTENT["para"]})
    layout = h5py.VirtualLayout((3, 8), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "para", (3, 8))
    spoils: tuple[Callable[[h5py.File], object], ...] = (
        lambda file: file.create_dataset("para", (3, 8), "f8", external=[("/etc/hostname", 0, 192)]),
        lambda file: file.create_virtual_dataset("para", layout),
        lambda file: file.__setitem__("para", h5py.ExternalLink("other.h5", "para")),
    )
    for spoil in spoils:
        with h5py.File(newer(tmp_path / "new.mat", {"K": {"object_size": 0.6}}), "a") as file:
            spoil(file)
        with pytest.raises(InputError, match=r"new\.mat: has no variable para"):
            Morphology.load(tmp_path / "new.mat")
