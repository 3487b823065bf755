import numpy as np
import pytest
from click.testing import CliRunner

from design import Morphology
from design.errors import InputError
from sense import Recording, Rig, simulate
from sense.cli import sense
from sense.hdf5 import export_hdf5, import_hdf5

RECORDING = simulate(Morphology.straight(2), Rig(presses=8))


def test_an_export_reads_back_the_same_and_is_reproducible(tmp_path):
    export_hdf5(RECORDING, tmp_path / "a.h5")
    export_hdf5(RECORDING, tmp_path / "b.h5")
    again = import_hdf5(tmp_path / "a.h5")
    assert again == RECORDING
    assert again.source == RECORDING.source
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert Recording.open(tmp_path / "a.h5") == RECORDING


@pytest.mark.parametrize("keep", [0, 10, 500, -1])
def test_a_torn_file_is_one_clear_line(tmp_path, keep):
    export_hdf5(RECORDING, tmp_path / "a.h5")
    content = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "torn.h5").write_bytes(content[:keep])
    with pytest.raises(InputError, match=r"torn\.h5") as refusal:
        import_hdf5(tmp_path / "torn.h5")
    assert "\n" not in str(refusal.value)


def test_other_files_are_refused(tmp_path):
    import h5py

    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.arange(3)
    for name, reason in (("other.h5", "format is None"), ("absent.h5", "no such file")):
        with pytest.raises(InputError, match=reason):
            import_hdf5(tmp_path / name)


@pytest.mark.parametrize("suffix", ["h5", "csv"])
def test_export_and_import_by_command(tmp_path, suffix):
    RECORDING.save(tmp_path / "run", {})
    file = tmp_path / f"out.{suffix}"
    result = CliRunner().invoke(sense, ["export", str(tmp_path / "run"), str(file)])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(sense, ["import", str(file), "--out", str(tmp_path / "again")])
    assert result.exit_code == 0, result.output
    assert Recording.open(tmp_path / "again") == RECORDING
