import os
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner

from design import Morphology
from design.common.errors import InputError
from sense import RigSettings, open_recording, simulate
from sense.cli.main import sense
from sense.recordings.formats.hdf5 import export_hdf5, import_hdf5


@pytest.fixture(scope="module")
def eight():
    """A recording of eight presses."""
    return simulate(Morphology.straight(2), RigSettings(presses=8))


def test_an_export_reads_back_the_same_and_is_reproducible(tmp_path, eight):
    export_hdf5(eight, tmp_path / "a.h5")
    export_hdf5(eight, tmp_path / "b.h5")
    again = import_hdf5(tmp_path / "a.h5")
    assert again == eight
    assert again.source == eight.source
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert open_recording(tmp_path / "a.h5") == eight


@pytest.mark.parametrize("keep", [0, 10, 500, -1])
def test_a_torn_file_is_one_clear_line(tmp_path, keep, eight):
    export_hdf5(eight, tmp_path / "a.h5")
    content = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "torn.h5").write_bytes(content[:keep])
    with pytest.raises(InputError, match=r"torn\.h5") as refusal:
        import_hdf5(tmp_path / "torn.h5")
    assert "\n" not in str(refusal.value)


def test_other_files_are_refused(tmp_path):
    import h5py

    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    for name, reason in (("other.h5", "format is None"), ("absent.h5", "cannot be read")):
        with pytest.raises(InputError, match=reason):
            import_hdf5(tmp_path / name)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"times_s": None}, "times_s"),
        ({"times_s": "group"}, "times_s is no dataset"),
        ({"times_s": "empty"}, "times_s holds None values"),
        ({"readings_v": "huge"}, r"readings_v holds 1000000000000 values, allowed are 268435456"),
        ({"readings_v": "text"}, "readings_v holds object values, expected an array of real numbers"),
        ({"readings_v": np.full((40, 2), np.inf)}, "readings hold infinity"),
        ({"presses_mm": np.array([[1.0, np.nan]])}, "press 0 has one of x and y"),
        ({"begun": np.array([20.5])}, "begun are .*whole numbers"),
        ({"times_s": np.arange(39.0)}, "times have shape"),
    ],
)
def test_datasets_that_do_not_fit_are_one_clear_line(tmp_path, change, reason):
    import h5py

    fine = {
        "times_s": np.arange(40.0),
        "readings_v": np.ones((40, 2)),
        "presses_mm": np.ones((1, 2)),
        "begun": np.array([20]),
        "lifted": np.array([40]),
    }
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.attrs["format"], file.attrs["source"] = "padforge-hdf5/1", "{}"
        for name, values in (fine | change).items():
            if isinstance(values, np.ndarray):
                file[name] = values
            elif values == "group":
                file.create_group(name)
            elif values == "empty":
                file[name] = h5py.Empty("f8")
            elif values == "huge":
                file.create_dataset(name, shape=(10**6, 10**6), dtype="f8", chunks=(100, 100))
            elif values is not None:
                file[name] = values
    with pytest.raises(InputError, match=rf"r\.h5: .*{reason}") as refusal:
        import_hdf5(tmp_path / "r.h5")
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("suffix", ["h5", "csv"])
def test_export_and_import_by_command(tmp_path, suffix, eight):
    eight.save(tmp_path / "run", {})
    file = tmp_path / f"out.{suffix}"
    result = CliRunner().invoke(sense, ["export", str(tmp_path / "run"), str(file)])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(sense, ["import", str(file), "--out", str(tmp_path / "again")])
    assert result.exit_code == 0, result.output
    assert open_recording(tmp_path / "again") == eight


def lab(folder, **changes):
    """A file of somebody's program, and what it holds; a change to None leaves a dataset out."""
    import h5py

    content = {
        "t": np.arange(40.0) * 100,
        "data/volts": np.random.default_rng(0).integers(900, 1100, (3, 40)).astype(np.int16),
        "xy": np.array([[1.0, 2], [-3, 4]]),
        "on": np.array([10, 25]),
        "off": np.array([20, 35]),
    } | changes
    with h5py.File(folder / "lab.h5", "w") as file:
        for name, values in content.items():
            if values is not None:
                file[name] = values
        file["note"] = "bench 2"
    return content


def test_a_mapping_tells_what_other_datasets_hold(tmp_path):
    content = lab(tmp_path)
    mapping = "time=/t:ms,fibres=/data/volts:mV,places=/xy:cm,begun=/on,lifted=off"
    recording = import_hdf5(tmp_path / "lab.h5", mapping)
    assert np.array_equal(recording.times_s, content["t"] * 1e-3)
    assert np.array_equal(recording.readings, content["data/volts"].T * 1e-3)
    assert recording.presses_mm.tolist() == [[10, 20], [-30, 40]]
    assert (recording.begun.tolist(), recording.lifted.tolist()) == ([10, 25], [20, 35])
    assert recording.source == {"kind": "hdf5", "file": "lab.h5", "mapping": mapping}
    lab(tmp_path, on=content["t"][content["on"]], off=content["t"][content["off"]])
    assert import_hdf5(tmp_path / "lab.h5", mapping.replace("/on", "/on:ms").replace("off", "/off:ms")) == recording
    lab(tmp_path, **{"data/volts": None, "data/ch0": content["data/volts"][0], "data/ch1": content["data/volts"][1]})
    assert import_hdf5(tmp_path / "lab.h5", mapping.replace("volts", "ch*")).fibres == 2


@pytest.mark.parametrize(
    ("mapping", "reason"),
    [
        ("", "format is None, expected 'padforge-hdf5/1'; .* there are 'data/volts', 'note', 'off', 'on', 't', 'xy'"),
        ("time=/s,fibres=data/volts", "time is 's', expected one of 'data/volts', 'note'"),
        ("time=t,fibres=data", "fibres is 'data', expected one of"),
        ("time=t,fibres=note", "note holds object values, expected an array of real numbers"),
        ("time=on,fibres=data/volts:mV", r"fibres have shape \(3, 40\), expected \(2, C\) or \(C, 2\)"),
    ],
)
def test_a_mapping_that_does_not_fit_the_file_is_one_line(tmp_path, mapping, reason):
    lab(tmp_path)
    with pytest.raises(InputError, match=rf"lab\.h5: {reason}"):
        import_hdf5(tmp_path / "lab.h5", mapping)


@pytest.mark.parametrize("kind", ["external link", "soft link", "virtual", "external storage"])
def test_nothing_is_read_from_another_file(tmp_path, eight, kind):
    """Neither a file that is there, nor a pipe that nobody writes to, which would hang."""
    import h5py

    path = tmp_path / "r.h5"
    for other in ("other", "pipe"):
        export_hdf5(eight, path)
        (tmp_path / "other").write_bytes(eight.readings.tobytes())
        if other == "pipe":
            os.mkfifo(tmp_path / "pipe")
        with h5py.File(path, "a") as file:
            del file["readings_v"]
            if kind == "external link":
                file["readings_v"] = h5py.ExternalLink(tmp_path / other, "/x")
            elif kind == "soft link":
                file["readings_v"] = h5py.SoftLink("/times_s")
            elif kind == "virtual":
                layout = h5py.VirtualLayout(eight.readings.shape, "f8", maxshape=(None, eight.fibres))
                source = h5py.VirtualSource(tmp_path / other, "x", eight.readings.shape, maxshape=(None, eight.fibres))
                layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
                file.create_virtual_dataset("readings_v", layout)
            else:
                storage = [(str(tmp_path / other), 0, eight.readings.nbytes)]
                file.create_dataset("readings_v", eight.readings.shape, "f8", external=storage)
        for mapping in ("", "time=times_s,fibres=readings_v,places=presses_mm,begun=begun,lifted=lifted"):
            with pytest.raises(InputError, match=r"r\.h5: .*readings_v") as refused:
                import_hdf5(path, mapping)
            assert "expected" in str(refused.value)


def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "pipe.h5")
    with pytest.raises(InputError, match="a pipe or device, expected a file"):
        import_hdf5(tmp_path / "pipe.h5")


def test_small_files_cannot_ask_for_much_memory(tmp_path, eight):
    import h5py

    for size, chunk, reason in (
        (2**24, 2**20, "readings_v claims 134217728 bytes of float64 in [0-9]+ of the file"),
        (16, 2**24, "readings_v claims 134217728 bytes of float64 in [0-9]+ of the file"),
        (2**29, 2**20, "readings_v holds 536870912 values, allowed are 268435456 in all that is read"),
    ):
        export_hdf5(eight, tmp_path / "r.h5")
        with h5py.File(tmp_path / "r.h5", "a") as file:
            del file["readings_v"]
            dataset = file.create_dataset(
                "readings_v", (size, 1), "f8", maxshape=(None, 1), chunks=(chunk, 1), compression="gzip"
            )
            dataset[:8] = 1
        assert (tmp_path / "r.h5").stat().st_size < 2e6
        with pytest.raises(InputError, match=reason):
            import_hdf5(tmp_path / "r.h5")


MEASURES = {"depths_mm", "reached_mm", "forces_n"}


def test_depth_and_force_are_kept_where_they_are_known(recording, tmp_path):
    count = len(recording.begun)
    known = replace(recording, reached_mm=np.linspace(4, 5, count), forces_n=np.full(count, 2.5))
    for each, names in ((replace(recording, depths_mm=np.empty(0)), set()), (known, MEASURES)):
        export_hdf5(each, tmp_path / "r.h5")
        assert import_hdf5(tmp_path / "r.h5") == each
        with h5py.File(tmp_path / "r.h5") as file:
            assert set(file) & MEASURES == names


def test_groups_within_groups_do_not_take_minutes(tmp_path):
    path = tmp_path / "deep.h5"
    with h5py.File(path, "w", libver="latest") as file:
        group = file
        for _ in range(3000):
            group = group.create_group("g")
    begin = time.process_time()
    with pytest.raises(InputError, match=r"deep\.h5: it has groups within groups, more than 64"):
        import_hdf5(path, "time=t,fibres=a")
    assert time.process_time() - begin < 1
