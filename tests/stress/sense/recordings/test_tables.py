"""Tables, MATLAB and HDF5 files, spoiled: read, or refused in one line; no crash of a library either."""

from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import given

import sense
from sense.recordings.formats.hdf5 import export_hdf5, import_hdf5
from sense.recordings.press_plan import read_plan
from tests.helpers.effort import few
from tests.stress.sense.cases import made, right_or_refused, seeds
from tests.stress.sense.children import in_child
from tests.stress.sense.spoiling import SMALL, _table, flipped


@cache
def exported(tmp: Path, name: str) -> bytes:
    if name.endswith(".mat"):
        regular = made(3, presses=12)
        content = {"voltage": regular.readings, "tim": regular.times_s[None], "pos": regular.presses_mm.T}
        scipy.io.savemat(tmp / name, content, do_compression=name == "packed.mat")
    elif name.endswith(".h5"):
        export_hdf5(SMALL, tmp / name)
    else:
        sense.export_csv(SMALL, tmp / name)
    return (tmp / name).read_bytes()


def sound(found: sense.Recording | None) -> None:
    assert found is None or (len(found.begun) > 0 and found.lifted[-1] <= len(found.readings) and found.fibres <= 512)


@few(150)
@given(seed=seeds)
def test_csv_of_any_kind(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    path = tmp / "table.csv"
    path.write_bytes(_table(rng, exported(tmp, "whole.csv").decode()))
    sound(right_or_refused(lambda: sense.import_csv(path)))


@few(150)
@given(seed=seeds)
def test_csv_of_other_programs_of_any_kind(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "lab.txt"
    rows = [f"{100 * i},1.{i % 9},2,{i // 9},{i % 5},{int(i % 9 > 4)}" for i in range(40)]
    path.write_bytes(_table(rng, "\n".join(["# bench", "t_ms,ch1,ch2,px,py,down", *rows])))
    mapping = ["time=t_ms:ms,fibres=ch*,x=px,y=py,press=down", "time=t_ms:ms,fibres=*,x=p?,y=py:cm"][rng.integers(2)]
    sound(right_or_refused(lambda: sense.import_csv(path, mapping)))


@few(150)
@given(seed=seeds)
def test_plans_of_any_kind(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "plan.csv"
    path.write_bytes(_table(rng, "x_mm,y_mm,depth_mm\n1,2,3\n-4,5.5,1e-3\n0,0,5\n"))
    plan = right_or_refused(lambda: read_plan(path, 5.0))
    if plan is not None:
        assert np.isfinite(plan.places_mm).all()
        assert (plan.depths_mm > 0).all()


@pytest.mark.parametrize("name", ["plain.mat", "packed.mat"])
@few(20)
@given(seed=seeds)
def test_a_mat_with_bytes_changed(tmp_path_factory: pytest.TempPathFactory, name: str, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    path = tmp / "spoiled.mat"
    path.write_bytes(flipped(rng, exported(tmp, name)))
    sound(right_or_refused(lambda: sense.import_mat(path)))


@few(20)
@given(seed=seeds)
def test_hdf5_with_bytes_changed(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    paths = [tmp / f"spoiled_{k}.h5" for k in range(4)]
    for path in paths:
        path.write_bytes(flipped(rng, exported(tmp, "whole.h5")))

    named = "time=times_s,fibres=readings_v,places=presses_mm,begun=begun,lifted=lifted"

    def read() -> None:
        for path in paths:
            for mapping in ("", named):
                sound(right_or_refused(lambda path=path, mapping=mapping: import_hdf5(path, mapping)))

    status, said = in_child(read)
    assert status == 0, said


def test_hdf5_that_claims_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    export_hdf5(SMALL, path)
    with h5py.File(path, "a") as file:
        del file["times_s"]
        file.create_dataset("times_s", (2**29,), np.float64, chunks=(1024,), compression="gzip")
    assert path.stat().st_size < 1e6
    assert right_or_refused(lambda: import_hdf5(path), 2) is None
