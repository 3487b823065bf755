"""Files that a crash or a broken copy cut off or changed: read as a recording, or refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.common.validation import InputError
from padforge.sense import Recorder, Recording, export_bag, export_hdf5, import_bag
from padforge.sense.formats.import_export import import_file

from .foreign import array, write_bag

RUN = ("readings.bin", "journal.ndjson", "start.json")


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


def test_import_bag_refuses_damaged_messages(tmp_path: Path) -> None:
    body = array("Float64MultiArray", np.arange(50.0))
    path = write_bag(tmp_path / "bag", [("/f", i / 10, body) for i in range(9)])
    content = path.read_bytes()
    numbers = np.arange(50.0).tobytes()
    end = content.index(numbers)
    path.write_bytes(content[: end - 8] + b"\xff\xff\xff\x7f" + content[end - 4 :])  # the length of the array
    with pytest.raises(InputError, match=r"fibres is '/f': message 0 of .* is damaged"):
        import_bag(path, "fibres=/f")


@pytest.mark.parametrize("name", RUN)
@settings(max_examples=15)
@given(share=st.floats(0, 1, exclude_max=True), piece=st.binary(min_size=1, max_size=8), is_cut=st.booleans())
def test_open_and_resume_of_damaged_run_directories(
    eight: Recording, tmp_path_factory: pytest.TempPathFactory, name: str, share: float, piece: bytes, is_cut: bool
) -> None:
    folder = tmp_path_factory.mktemp("run") / "run"
    eight.save(folder, {})
    content = (folder / name).read_bytes()
    at = int(share**2 * len(content))
    (folder / name).write_bytes(content[:at] + (b"" if is_cut else piece + content[at + len(piece) :]))
    refusal = ""
    try:
        recording = Recording.open(folder)
    except InputError as error:
        recording, refusal = None, str(error)
    assert "\n" not in refusal
    if recording is None:
        return
    if name == "readings.bin":
        np.testing.assert_array_equal(recording.readings, eight.readings[: len(recording.readings)])
        assert set(recording.down_command.tolist()) <= set(eight.down_command.tolist())
    with Recorder.resume(folder):
        pass
    assert Recording.open(folder) == recording
