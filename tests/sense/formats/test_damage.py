"""Damaged files of every format: a recording, or refused in one line."""

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
def whole(eight: Recording, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What is in files of each format, and in those of a run directory."""
    folder = tmp_path_factory.mktemp("whole")
    published = {"voltage": eight.readings, "tim": eight.times_s[None], "pos": eight.presses_mm.T}
    for name in FILES[:2]:
        scipy.io.savemat(folder / name, published, do_compression=name == "packed.mat")
    for export, name in ((export_csv, "r.csv"), (export_hdf5, "r.h5"), (export_bag, "r.mcap")):
        export(eight, folder / name)
    said = [("/pad/readings", 0.1 * at, array("Float64MultiArray", np.array([1.0, at % 8 / 8]))) for at in range(60)]
    said += [("/pad/pressed", 2.0, make("Bool", True)), ("/pad/pressed", 4.0, make("Bool", False))]
    write_bag(folder / "bag", said, packed=True).rename(folder / "packed.mcap")
    write_bag(folder / "bag2", said, "sqlite3").rename(folder / "plain.db3")
    eight.save(folder / "run", {})
    assert all(len(open_recording(folder / name).down_command) for name in (*FILES, "run"))
    files = [path for path in (*folder.iterdir(), *(folder / "run").iterdir()) if path.is_file()]
    return {path.name: path.read_bytes() for path in files}


@st.composite
def damages(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Bytes that are changed, lost or added, at the begin more often than elsewhere, or an end that is missing."""
    step = st.tuples(st.integers(0, 3), st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8))
    steps = draw(st.lists(step, min_size=1, max_size=3))

    def damaged(content: bytes) -> bytes:
        found = bytearray(content)
        for kind, share, piece in steps:
            at = int(share**2 * len(found))
            end = (at + len(piece), len(found), at, at + 16)[kind]
            found[at:end] = piece if kind in (0, 2) else b""
        return bytes(found)

    return damaged


def require_recording_or_one_line(read: Callable[[], Recording]) -> None:
    refused = ""
    try:
        found = read()
        assert len(found.down_command) > 0
        assert found.up_command[-1] <= len(found.readings)
    except InputError as error:
        refused = str(error) or "nothing is said\n"
    assert "\n" not in refused


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=15)
@given(damage=st.lists(damages(), min_size=4, max_size=4))
def test_a_damaged_file_is_a_recording_or_one_line(
    whole: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory, name: str, damage: list
) -> None:
    path = tmp_path_factory.getbasetemp() / name

    def read() -> None:
        for each in damage:
            path.write_bytes(each(whole[name]))
            for mapping in {"", MAPPED.get(name, "")}:
                require_recording_or_one_line(lambda mapping=mapping: import_file(path, mapping))

    if name == "r.h5":  # what a library crashes is not this process
        child = multiprocessing.get_context("fork").Process(target=read)
        child.start()
        child.join()
        assert child.exitcode == 0
    else:
        read()


@pytest.mark.parametrize("name", ["readings.bin", "journal.ndjson", "start.json"])
@settings(max_examples=40)
@given(damage=damages())
def test_a_damaged_run_directory_gives_its_own_presses_or_one_line(
    whole: dict[str, bytes], eight: Recording, tmp_path_factory: pytest.TempPathFactory, name: str, damage: Callable
) -> None:
    folder = tmp_path_factory.mktemp("run")
    for each in ("readings.bin", "journal.ndjson", "start.json"):
        (folder / each).write_bytes(damage(whole[each]) if each == name else whole[each])
    require_recording_or_one_line(lambda: open_recording(folder))
    try:
        found = Recording.open(folder)
    except InputError:
        return
    if name == "readings.bin":
        np.testing.assert_array_equal(found.readings, eight.readings[: len(found.readings)])
        assert set(found.down_command.tolist()) <= set(eight.down_command.tolist())
    with Recorder.resume(folder):
        pass
    assert Recording.open(folder) == found
