"""Files that sense reads, spoiled: what was written, what is left of it, or one line; no crash of a library either."""

import hashlib
import json
import os
import shutil
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import safetensors.numpy
import scipy.io
from hypothesis import given

import padforge
import sense
from sense.recordings.hdf5 import export_hdf5, import_hdf5
from sense.rig.planning.press_plan import read_plan
from tests.stress.clock import few
from tests.stress.sense_cases import TINY, learnt, made, recorded, right_or_refused, seeds, watched

SMALL = made(3, presses=12)
NUMBERS = (
    *("0", "-1", "1e308", "1e999", "-1e999", "nan", "inf", "5e-324", "1" * 400, "0x10", "1_0", "\uff11", "1,5", ""),
)
TEXTS = (
    *("?", "a", "\x00", '"', "\n", "\r", ";", "\ufeff", "\xff", "1 2", "'1'", "--1", "1e", "\t", "\ud7ff", "=1+1"),
)
VALUES = (
    None,
    True,
    -1,
    0,
    1e308,
    10**400,
    2**64,
    "",
    "a",
    "ÿ",
    [],
    [[]],
    {},
    [None],
    [1e400],
    {"a": {}},
    1.5,
    "\ud800",
)
"""What a place in a JSON document may hold in place of what is right."""


def flipped(rng: np.random.Generator, content: bytes) -> bytes:
    """`content` with bytes changed, lost, added, doubled, or with its end torn off."""
    data, kind = bytearray(content), rng.integers(6)
    at = int(rng.integers(len(data) + 1))
    if kind == 0:
        for place in rng.integers(len(data), size=rng.integers(1, 9)):
            data[place] ^= int(rng.integers(1, 256))
    elif kind == 1:
        del data[at:]
    elif kind == 2:
        del data[at : at + int(rng.integers(1, 300))]
    elif kind == 3:
        data[at:at] = rng.bytes(int(rng.integers(1, 300)))
    elif kind == 4:
        data[at:at] = data[at : at + int(rng.integers(1, 3000))]
    else:  # a number of the format itself, as large as it may be
        data[at : at + 8] = [b"\xff" * 8, b"\x7f" + b"\xff" * 7, bytes(8), b"\xff\xff\xff\x7f"][rng.integers(4)]
    return bytes(data)


def edited(rng: np.random.Generator, document: Any) -> Any:
    """A JSON document with one place of it changed, lost or doubled."""
    document = json.loads(json.dumps(document))
    parent: Any = None
    node, key = document, 0
    while isinstance(node, dict | list) and node and (parent is None or rng.random() < 0.8):
        parent = node
        key: Any = list(node)[rng.integers(len(node))] if isinstance(node, dict) else int(rng.integers(len(node)))
        node = parent[key]
    kind = rng.integers(4)
    if kind == 0:
        del parent[key]
    elif kind == 1 and isinstance(parent, list):
        parent *= 2
    elif kind == 2 and isinstance(node, int | float):
        parent[key] = [-node, node * 1e300 if node == node else 0, node + 1, 10**30, -1e-300][rng.integers(5)]
    else:
        parent[key] = VALUES[rng.integers(len(VALUES))]
    return document


def dumped(document: Any) -> bytes:
    return json.dumps(document).encode("utf-8", "surrogatepass")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@cache
def run_directory(tmp: Path) -> dict[str, bytes]:
    SMALL.save(tmp / "rec", {"seed": 1})
    return files_of(tmp / "rec")


def put(folder: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def within(whole: sense.Recording, part: sense.Recording) -> bool:
    """Whether all presses of `part` are presses of `whole`, with the readings they had there."""
    rows = len(part.readings)
    return (
        np.array_equal(whole.readings[:rows], part.readings, equal_nan=True)
        and set(map(tuple, part.presses_mm.tolist())) <= set(map(tuple, whole.presses_mm.tolist()))
        and set(part.begun.tolist()) <= set(whole.begun.tolist())
    )


@few(80)
@given(seed=seeds)
def test_a_run_directory_gives_its_own_presses_or_one_line(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "run"
    files = dict(run_directory(tmp_path_factory.getbasetemp()))
    name = list(files)[rng.integers(len(files))]
    kind = rng.integers(4)
    if kind == 0:
        del files[name]
    elif kind == 1:
        other = list(files)[rng.integers(len(files))]
        files[name], files[other] = files[other], files[name]
    else:
        files[name] = flipped(rng, files[name])
    put(folder, files)
    found = right_or_refused(lambda: sense.Recording.open(folder))
    if found is not None and name == "readings.bin":
        assert within(SMALL, found)
    resumed = right_or_refused(lambda: sense.Recorder.resume(folder))
    if resumed is not None:
        with resumed:
            pass
        assert resumed.done <= set(range(resumed._press))  # pyright: ignore[reportPrivateUsage]
        if found is not None:
            again = right_or_refused(lambda: sense.Recording.open(folder))
            assert again == found


@few(60)
@given(seed=seeds)
def test_a_start_or_journal_of_other_values(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "run"
    files = dict(run_directory(tmp_path_factory.getbasetemp()))
    if rng.random() < 0.3:
        files["start.json"] = dumped(edited(rng, json.loads(files["start.json"])))
    else:
        lines = files["journal.ndjson"].decode().splitlines()
        at = int(rng.integers(len(lines)))
        lines[at] = dumped(edited(rng, json.loads(lines[at]))).decode()
        if rng.random() < 0.3:
            rng.shuffle(lines)
        files["journal.ndjson"] = ("\n".join(lines) + "\n").encode()
    found = right_or_refused(lambda: sense.Recording.open(put(folder, files)))
    if found is not None:
        assert np.array_equal(found.readings, SMALL.readings)
        assert 0 < len(found.begun) <= 12


@pytest.mark.parametrize("claimed", [0, 6, 2**31, 2**32 - 1])
def test_a_block_that_claims_more_readings_than_it_has_is_none(tmp_path: Path, claimed: int) -> None:
    """Even where its checksum fits."""
    SMALL.save(tmp_path / "rec", {})
    path = tmp_path / "rec" / "readings.bin"
    content = bytearray(path.read_bytes())
    block = content[-256:]
    block[16:20] = claimed.to_bytes(4, "little")
    block[20:24] = zlib.crc32(block[24:], zlib.crc32(block[:20])).to_bytes(4, "little")
    path.write_bytes(content[:-256] + block)
    found = right_or_refused(lambda: sense.Recording.open(tmp_path / "rec"))
    assert found is None or len(found.readings) < len(SMALL.readings)


def test_a_stream_of_magic_words_is_searched_in_no_time(tmp_path: Path) -> None:
    SMALL.save(tmp_path / "rec", {})
    (tmp_path / "rec" / "readings.bin").write_bytes(b"PFB1" * 2_000_000)
    assert right_or_refused(lambda: sense.Recording.open(tmp_path / "rec"), 5) is None


@cache
def model_files(tmp: Path) -> dict[str, bytes]:
    learnt().save(tmp / "model")
    watched().save(tmp / "model")
    return files_of(tmp / "model")


def rewritten(rng: np.random.Generator, files: dict[str, bytes], name: str) -> None:
    """Spoil arrays of NAME.safetensors and put the digest of the new file into NAME.json, as a forger would."""
    arrays = safetensors.numpy.load(files[f"{name}.safetensors"])
    key = list(arrays)[rng.integers(len(arrays))]
    array, kind = arrays[key].copy(), rng.integers(5)
    if kind == 0:
        array.ravel()[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e30, 0.0, -1.0])
    elif kind == 1:
        array = array.astype(rng.choice(["f2", "f4", "f8", "i4", "u1", "?"]))
    elif kind == 2:
        array = array[..., :-1] if array.ndim else array
    elif kind == 3:
        array = array * rng.choice([0.0, 1e30, -1.0, 1e-30])
    else:
        array = np.zeros((0, *array.shape))
    arrays[key] = np.ascontiguousarray(array)
    if rng.random() < 0.1:
        del arrays[key]
    content = safetensors.numpy.save(arrays)
    if rng.random() < 0.3:
        content = flipped(rng, content)
    document = json.loads(files[f"{name}.json"])
    document["weights_sha256"] = hashlib.sha256(content).hexdigest()
    files |= {f"{name}.safetensors": content, f"{name}.json": dumped(document)}


@few(60)
@given(seed=seeds)
def test_a_model_that_loads_finds_places_and_faults(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, folder = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "spoiled"
    files = dict(model_files(tmp_path_factory.getbasetemp()))
    name = ["localizer", "health"][rng.integers(2)]
    kind = rng.integers(4)
    if kind == 0:
        part = f"{name}.{rng.choice(['json', 'safetensors'])}"
        files[part] = flipped(rng, files[part])
    elif kind == 1:
        del files[f"{name}.{rng.choice(['json', 'safetensors'])}"]
    elif kind == 2:
        files[f"{name}.json"] = dumped(edited(rng, json.loads(files[f"{name}.json"])))
    else:
        with np.errstate(all="ignore"):
            rewritten(rng, files, name)
    put(folder, files)
    if name == "localizer":
        localizer = right_or_refused(lambda: sense.Localizer.load(folder))
        if localizer is not None:
            found = right_or_refused(lambda: sense.locate(localizer, SMALL))
            assert found is None or np.isfinite(np.column_stack([found.places_mm, found.r50_mm, found.r90_mm])).all()
            right_or_refused(lambda: sense.evaluate(localizer, recorded(), (0,)))
            right_or_refused(lambda: localizer.save(folder))
        return
    health = right_or_refused(lambda: sense.HealthModel.load(folder))
    if health is not None:
        edges = SMALL.begun, SMALL.lifted
        for finding in right_or_refused(lambda: sense.examine(health, SMALL.readings, SMALL.times_s, *edges)) or ():
            assert 0 <= finding.since <= finding.press < 12


def _cell(rng: np.random.Generator) -> str:
    return [*NUMBERS, *TEXTS][rng.integers(len(NUMBERS) + len(TEXTS))]


def _table(rng: np.random.Generator, text: str) -> bytes:
    """A CSV with cells, lines, its header or its coding spoiled."""
    lines = text.splitlines()
    kind = rng.integers(9)
    at = int(rng.integers(len(lines)))
    if kind in (0, 1):
        cells = lines[at].split(",")
        cells[rng.integers(len(cells))] = _cell(rng)
        lines[at] = ",".join(cells)
    elif kind == 2:  # a column is missing, or there twice
        column = int(rng.integers(lines[0].count(",") + 1))
        rows = [line.split(",") for line in lines]
        twice = rng.random() < 0.5
        lines = [",".join(row[: column + twice] + row[column + 1 - twice :]) for row in rows]
    elif kind == 3:
        lines = lines[: rng.integers(3)]
    elif kind == 4:
        other = int(rng.integers(len(lines)))
        lines[at], lines[other] = lines[other], lines[at]
    elif kind == 5:
        lines.insert(at, lines[int(rng.integers(len(lines)))])
    elif kind == 6:
        lines.insert(at, "")
    text = ["\n", "\r\n", "\r"][rng.integers(3)].join(lines) + "\n" * int(rng.integers(3))
    coding = ["utf-8", "utf-8-sig", "latin-1", "utf-16", "utf-32"][rng.integers(5)]
    content = text.encode(coding, "ignore")
    return flipped(rng, content) if content and kind == 7 else content


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
def test_plans_of_any_kind(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path_factory.getbasetemp() / "plan.csv"
    path.write_bytes(_table(rng, "x_mm,y_mm,depth_mm\n1,2,3\n-4,5.5,1e-3\n0,0,5\n"))
    plan = right_or_refused(lambda: read_plan(path, 5.0))
    if plan is not None:
        assert np.isfinite(plan.places_mm).all()
        assert (plan.depths_mm > 0).all()


@pytest.mark.parametrize("name", ["plain.mat", "packed.mat"])
@few(60)
@given(seed=seeds)
def test_a_mat_with_bytes_changed(tmp_path_factory: pytest.TempPathFactory, name: str, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    path = tmp / "spoiled.mat"
    path.write_bytes(flipped(rng, exported(tmp, name)))
    sound(right_or_refused(lambda: sense.import_mat(path)))


def in_child(work: Callable[[], None]) -> int:
    """Exit status of `work` in a child: 0, or what ended it; what a library breaks there breaks nothing here."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            work()
            status = 0
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@few(30)
@given(seed=seeds)
def test_hdf5_with_bytes_changed(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    paths = [tmp / f"spoiled_{k}.h5" for k in range(4)]
    for path in paths:
        path.write_bytes(flipped(rng, exported(tmp, "whole.h5")))

    def read() -> None:
        for path in paths:
            sound(right_or_refused(lambda path=path: import_hdf5(path)))

    assert in_child(read) == 0


def test_hdf5_that_claims_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    export_hdf5(SMALL, path)
    with h5py.File(path, "a") as file:
        del file["times_s"]
        file.create_dataset("times_s", (2**29,), np.float64, chunks=(1024,), compression="gzip")
    assert path.stat().st_size < 1e6
    assert right_or_refused(lambda: import_hdf5(path), 2) is None


@cache
def results(tmp: Path) -> dict[str, bytes]:
    """The documents of a calibration and of a robustness study, and a start of a recording."""
    _, document = sense.calibrate(made(4, presses=40), TINY)
    studied = sense.fibre_loss_study(SMALL, learnt(), lost=2)
    study = {"format": "padforge-study-x/1", "title": "A", "text": ["b"], "rows": [{"a": 1, "b": 2.5}]}
    study |= {"provenance": document["provenance"]}
    named = {"calibration.json": document, "robustness.json": studied, "x.json": study}
    return {name: dumped(content) for name, content in named.items()} | {"start.json": run_directory(tmp)["start.json"]}


@few(60)
@given(seed=seeds)
def test_reports_of_spoiled_results(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    files = dict(results(tmp))
    name = list(files)[rng.integers(len(files))]
    files[name] = flipped(rng, files[name]) if rng.random() < 0.3 else dumped(edited(rng, json.loads(files[name])))
    start = files.pop("start.json")
    folder = put(tmp / "pad", files)
    put(folder / "recording", {"start.json": start})
    page = right_or_refused(lambda: padforge.write_report(folder))
    assert (page is not None and "</html>" in page.read_text("utf-8")) or not (folder / "report.html").exists()


@few(20)
@given(seed=seeds)
def test_a_study_resumes_from_sound_networks_only(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """A robustness study that was broken off goes on from what it kept, or says what is wrong with it."""
    rng, tmp = np.random.default_rng(seed), tmp_path_factory.getbasetemp()
    files = unfinished(tmp)
    spoiled = dict(files)
    name = list(files)[rng.integers(len(files))]
    if rng.random() < 0.7:
        spoiled[name] = flipped(rng, files[name])
    else:
        spoiled[f"start_{rng.choice(['9999', 'x', '-1', '0000_1', ''])}.npz"] = files[name]
    folder = put(tmp / "unfinished", spoiled)
    retrained = {"retrain": True, "options": TINY, "lost": 0}
    found = right_or_refused(lambda: sense.fibre_loss_study(made(5, presses=60), keep_in=folder, **retrained))
    if found is not None:
        assert all(np.isfinite(row["mean_mm"]) for row in found["ways"]["retrained"]["errors"])


@cache
def unfinished(tmp: Path) -> dict[str, bytes]:
    """What a robustness study leaves that is broken off after its first network."""

    def stop(done: int, of: int) -> None:
        if done:
            raise KeyboardInterrupt

    folder, options = tmp / "kept", {"retrain": True, "options": TINY, "lost": 0}
    with pytest.raises(KeyboardInterrupt):
        sense.fibre_loss_study(made(5, presses=60), keep_in=folder, progress=stop, **options)
    return files_of(folder)
