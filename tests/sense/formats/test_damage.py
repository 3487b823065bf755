"""Damaged files of all formats: read as a recording, or refused in one line."""

import multiprocessing
from collections.abc import Callable

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import Recorder, Recording, export_bag, export_csv, export_hdf5, open_recording
from padforge.sense.formats.import_export import import_file

from .foreign import array, make, write_bag

FILES = ("plain.mat", "packed.mat", "r.csv", "r.h5", "r.mcap", "packed.mcap", "plain.db3")
MAPPED = {"r.h5": "time=times_s,fibres=readings_v,positions=presses_mm,down_command=down_command,up_command=up_command"}


@pytest.fixture(scope="module")
def stored(eight: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the content of files of all formats, and of a run directory, by name."""
    folder = tmp_path_factory.mktemp("stored")
    published = {"voltage": eight.readings, "tim": eight.times_s[None], "pos": eight.presses_mm.T}
    for name in FILES[:2]:
        scipy.io.savemat(folder / name, published, do_compression=name == "packed.mat")
    for export, name in ((export_csv, "r.csv"), (export_hdf5, "r.h5"), (export_bag, "r.mcap")):
        export(eight, folder / name)
    messages = [("/pad/readings", i / 10, array("Float64MultiArray", np.array([1.0, i % 8 / 8]))) for i in range(60)]
    messages += [("/pad/pressed", 2.0, make("Bool", True)), ("/pad/pressed", 4.0, make("Bool", False))]
    write_bag(folder / "bag", messages, packed=True).rename(folder / "packed.mcap")
    write_bag(folder / "bag2", messages, "sqlite3").rename(folder / "plain.db3")
    eight.save(folder / "run", {})
    assert all(len(open_recording(folder / name).down_command) for name in (*FILES, "run"))
    files = [path for path in (*folder.iterdir(), *(folder / "run").iterdir()) if path.is_file()]
    return {path.name: path.read_bytes() for path in files}


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Draw a function that changes, loses or adds bytes, more often at the begin, or cuts off the end."""
    step = st.tuples(st.integers(0, 3), st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8))
    steps = draw(st.lists(step, min_size=1, max_size=3))

    def damaged(content: bytes) -> bytes:
        changed = bytearray(content)
        for kind, share, piece in steps:
            at = int(share**2 * len(changed))
            end = (at + len(piece), len(changed), at, at + 16)[kind]
            changed[at:end] = piece if kind in (0, 2) else b""
        return bytes(changed)

    return damaged


def check_recording_or_one_line(read: Callable[[], Recording]) -> None:
    refusal = ""
    try:
        recording = read()
        assert len(recording.down_command) > 0
        assert recording.up_command[-1] <= len(recording.readings)
    except InputError as error:
        refusal = str(error) or "no message\n"
    assert "\n" not in refusal


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=15)
@given(damage=st.lists(damages(), min_size=4, max_size=4))
def test_import_file_of_damaged_files(
    stored: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory, name: str, damage: list
) -> None:
    path = tmp_path_factory.getbasetemp() / name

    def read() -> None:
        for each in damage:
            path.write_bytes(each(stored[name]))
            for columns in {"", MAPPED.get(name, "")}:
                check_recording_or_one_line(lambda columns=columns: import_file(path, columns))

    if name == "r.h5":  # a crash of the library is not one of this process
        child = multiprocessing.get_context("fork").Process(target=read)
        child.start()
        child.join()
        assert child.exitcode == 0
    else:
        read()


@pytest.mark.parametrize("name", ["readings.bin", "journal.ndjson", "start.json"])
@settings(max_examples=40)
@given(damage=damages())
def test_open_and_resume_of_damaged_run_directories(
    stored: dict[str, bytes], eight: Recording, tmp_path_factory: pytest.TempPathFactory, name: str, damage: Callable
) -> None:
    folder = tmp_path_factory.mktemp("run")
    for each in ("readings.bin", "journal.ndjson", "start.json"):
        (folder / each).write_bytes(damage(stored[each]) if each == name else stored[each])
    check_recording_or_one_line(lambda: open_recording(folder))
    try:
        recording = Recording.open(folder)
    except InputError:
        return
    if name == "readings.bin":
        np.testing.assert_array_equal(recording.readings, eight.readings[: len(recording.readings)])
        assert set(recording.down_command.tolist()) <= set(eight.down_command.tolist())
    with Recorder.resume(folder):
        pass
    assert Recording.open(folder) == recording
