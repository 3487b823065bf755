import numpy as np
import pytest
from click.testing import CliRunner

from design import Morphology
from design.common.errors import InputError
from sense import RigSettings, open_recording, simulate
from sense.cli.main import sense
from sense.recordings.hdf5 import export_hdf5, import_hdf5


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
        ({"readings_v": "huge"}, r"readings_v holds 1000000000000 values, allowed are 1073741824"),
        ({"readings_v": "text"}, "readings are .*expected an array of real numbers"),
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
