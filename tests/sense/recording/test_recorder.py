"""Whatever is left of a run directory, it goes on from there: no finished press lost, nothing else taken for one."""

import json
import os
import resource
import shutil
import signal
import time
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from padforge.design.common.validation import InputError
from padforge.sense import Recorder, Recording
from padforge.sense.recording.block_file import block_dtype
from tools.kills import killed

START, JOURNAL, READINGS, STATES = "start.json", "journal.ndjson", "readings.bin", "states.bin"
FIBRES = 3


def record(recorder: Recorder, presses: range, time_s: float) -> float:
    """Twenty readings a press at 10 Hz, and as many states."""
    for press in presses:
        times = time_s + np.arange(20) / 10
        recorder.append(times[:10], np.full((10, FIBRES), press + 0.25))
        recorder.append_states(np.column_stack([times[:10], np.full((10, 9), float(press))]))
        recorder.begin((press, -press), recorder.n_readings, press)
        recorder.append(times[10:], np.full((10, FIBRES), press + 0.5))
        recorder.finish(recorder.n_readings)
        recorder.sync()
        time_s += 2
    return time_s


def made(folder, presses=5):
    with Recorder(folder / "run", FIBRES, {"kind": "made"}, {}) as recorder:
        record(recorder, range(presses), 0.0)
    return folder / "run"


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    """The files of a run directory of five presses."""
    path = made(tmp_path_factory.mktemp("five"))
    return {file.name: file.read_bytes() for file in path.iterdir()}


def require_as_recorded(recording):
    """See that every press has its place and the readings that `record` gave it."""
    for (x, y), down_command, up_command in zip(
        recording.presses_mm, recording.down_command, recording.up_command, strict=True
    ):
        assert x == -y
        assert (recording.readings[down_command:up_command] == x + 0.5).all()
    assert (np.diff(recording.times_s) > 0).all()


def test_a_recording_that_was_not_broken_off_resumes_as_it_is(tmp_path):
    path = made(tmp_path)
    before = {name: (path / name).read_bytes() for name in (READINGS, STATES, JOURNAL)}
    with Recorder.resume(path) as recorder:
        assert recorder.done == set(range(5))
        assert recorder.n_readings == 100
        assert recorder.last_s == pytest.approx(9.9)
    assert {name: (path / name).read_bytes() for name in before} == before


@settings(max_examples=15)
@given(st.data())
def test_a_kill_at_any_byte_loses_no_finished_press(five, tmp_path_factory, data):
    """Files grow in the order readings, states, journal; a kill leaves any prefix of what came after the last sync."""
    path = tmp_path_factory.mktemp("killed")
    (path / START).write_bytes(five[START])
    lines = five[JOURNAL].splitlines(keepends=True)
    finished = data.draw(st.integers(0, 4))
    synced = {JOURNAL: sum(map(len, lines[: 2 * finished]))}
    for name, columns, rows in ((READINGS, FIBRES, 20), (STATES, 9, 10)):
        dtype = block_dtype(columns)
        blocks = np.frombuffer(five[name], dtype)
        kept = int(np.searchsorted(np.cumsum(blocks["count"]), rows * finished, side="right")) if finished else 0
        synced[name] = kept * dtype.itemsize
    for name in (READINGS, STATES, JOURNAL):
        cut = data.draw(st.integers(synced[name], len(five[name])))
        (path / name).write_bytes(five[name][: cut if name != JOURNAL else min(cut, synced[name] + 40)])
    with Recorder.resume(path) as recorder:
        assert recorder.done >= set(range(finished))
        assert len(recorder.done) <= finished + 1
        left = [press for press in range(5) if press not in recorder.done]
        for press in left:
            record(recorder, range(press, press + 1), max(recorder.last_s, 0.0) + 1)
    recording = Recording.open(path)
    assert recording.presses_mm[:, 0].tolist() == list(range(5))
    require_as_recorded(recording)


def in_a_child(work):
    """Do `work` in another process; its number."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        except (OSError, InputError):
            code = 2
        finally:
            os._exit(code)
    return child


@pytest.mark.parametrize("limit", [100, 300, 700, 2000, 5200, 6000])
def test_a_full_disk_loses_no_finished_press(tmp_path, limit):
    """What was told to be done before the disk was full is there, and the rest can be recorded when it is not."""
    told = tmp_path / "told"
    told.touch()

    def work():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
            for press in range(12):
                record(recorder, range(press, press + 1), 2.0 * press)
                os.truncate(told, press + 1)

    code = os.waitstatus_to_exitcode(os.waitpid(in_a_child(work), 0)[1])
    done = told.stat().st_size
    assert (code, done < 12) == (2, True)
    if not (tmp_path / "run" / START).exists():
        assert done == 0
        return
    with Recorder.resume(tmp_path / "run") as recorder:
        assert set(range(done)) <= recorder.done
        record(recorder, range(20, 22), max(recorder.last_s, 0.0) + 1)
        there = recorder.done
    found = Recording.open(tmp_path / "run")
    require_as_recorded(found)
    assert set(found.presses_mm[:, 0]) == there


@pytest.mark.parametrize("pause_s", [0.01, pytest.param(0.1, marks=pytest.mark.slow)])
def test_a_kill_in_the_middle_loses_no_finished_press(tmp_path, pause_s):
    told = tmp_path / "told"
    told.touch()

    def work():
        with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
            for press in range(10_000):
                record(recorder, range(press, press + 1), 2.0 * press)
                os.truncate(told, press + 1)

    child = in_a_child(work)
    while not told.stat().st_size:
        time.sleep(0.001)
    time.sleep(pause_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    done = told.stat().st_size
    found = Recording.open(tmp_path / "run")
    require_as_recorded(found)
    assert found.presses_mm[:, 0].tolist()[:done] == list(range(done))
    with Recorder.resume(tmp_path / "run") as recorder:
        assert set(range(done)) <= recorder.done


def test_an_aborted_press_is_made_again(tmp_path):
    with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
        time_s = record(recorder, range(2), 0.0)
        recorder.append([time_s], np.zeros((1, FIBRES)))
        recorder.begin((2, -2), recorder.n_readings, 2)
        recorder.abort("the arm was stopped")
        recorder.abort("told twice")
    events = [json.loads(line)["event"] for line in (tmp_path / "run" / JOURNAL).read_text().splitlines()]
    assert events[-2:] == ["started", "aborted"]
    assert len(Recording.open(tmp_path / "run").presses_mm) == 2
    with Recorder.resume(tmp_path / "run") as recorder:
        assert recorder.done == {0, 1}
        record(recorder, range(2, 4), time_s + 1)
    assert len(Recording.open(tmp_path / "run").presses_mm) == 4


@pytest.mark.parametrize("name", [READINGS, JOURNAL])
def test_damage_in_the_middle_is_told_not_repaired(tmp_path, name):
    path = made(tmp_path)
    content = bytearray((path / name).read_bytes())
    content[len(content) // 3] ^= 0xFF
    (path / name).write_bytes(bytes(content))
    with pytest.raises(InputError, match=name):
        Recorder.resume(path)
    assert (path / name).read_bytes() == bytes(content)


def test_presses_whose_readings_were_torn_off_never_count_again(tmp_path):
    """The journal says they are done; once other readings fill the gap, it must not say so any more."""
    path = made(tmp_path)
    content = (path / READINGS).read_bytes()
    (path / READINGS).write_bytes(content[: len(content) // 2])
    with Recorder.resume(path) as recorder:
        kept = set(recorder.done)
        assert kept < set(range(5))
        times = recorder.last_s + 1 + np.arange(100) / 10
        recorder.append(times, np.zeros((100, FIBRES)))
    with Recorder.resume(path) as recorder:
        assert recorder.done == kept
        recorder.begin((9, 9), recorder.n_readings, max(kept) + 1)
        recorder.abort("broken off")
    assert len(Recording.open(path).presses_mm) == len(kept)


def test_two_programs_cannot_record_into_one_folder(tmp_path):
    path = made(tmp_path)
    with Recorder.resume(path) as first:
        before = (path / READINGS).read_bytes()
        with pytest.raises(InputError, match="another program is recording"):
            Recorder.resume(path)
        with pytest.raises(InputError, match="never written over"):
            Recorder(path, FIBRES, {}, {})
        assert (path / READINGS).read_bytes() == before
        record(first, range(5, 7), 10.0)
    assert len(Recording.open(path).down_command) == 7


def test_a_full_disk_leaves_nothing_of_a_birth_and_on_closing_does_not_hide_what_went_wrong(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    def broken():
        with Recorder(tmp_path / "run", FIBRES, {}, {}) as recorder:
            recorder.sync = full
            raise RuntimeError("the first thing")

    with pytest.raises(RuntimeError, match="the first thing"):
        broken()
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left"):
            Recorder(tmp_path / "born" / "run", FIBRES, {}, {})
    assert list((tmp_path / "born" / "run").iterdir()) == []
    made(tmp_path / "born")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.append([0.0], [[1.0, 2.0]]), r"expected \(n,\) finite numbers and \(n, 3\)"),
        (lambda r: r.append([0.0, 1.0], [[1.0, 2.0, 3.0]]), "times have shape"),
        (lambda r: r.append([np.nan], [[1.0, 2.0, 3.0]]), "finite numbers"),
        (lambda r: r.finish(100), "press 5 was not begun"),
        (lambda r: r.begin((1.0, np.nan), 100), "place is .*, expected x and y up to"),
        (lambda r: r.begin((1e6, 0.0), 100), "place is"),
        (lambda r: r.begin((0.0, 0.0), -1), "reading is -1"),
        (lambda r: r.begin((0.0, 0.0), 100, press=-1), "press is -1"),
        (lambda r: r.begin((0.0, 0.0), 100, depth_mm=np.nan), "expected what JSON can hold"),
        (lambda r: r.begin((0.0, 0.0), 100, tip=object()), "expected what JSON can hold"),
    ],
)
def test_what_would_spoil_a_recording_is_refused_and_leaves_it_as_it_was(tmp_path, call, message):
    """A line of the journal that is none would make all of it one that nobody can read."""
    path = made(tmp_path)
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    with Recorder.resume(path) as recorder, pytest.raises(InputError, match=message):
        call(recorder)
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


def test_presses_without_a_number_count_on_from_the_last(tmp_path):
    """One that was aborted is made again under its number; after a break the count goes on."""
    with Recorder(tmp_path / "run", FIBRES, {"kind": "made"}, {}) as recorder:
        recorder.append(np.arange(5) / 10, np.zeros((5, FIBRES)))
        for press in (None, None, "aborted", None, 7):
            recorder.begin((0, 0), recorder.n_readings, press=None if press == "aborted" else press)
            if press == "aborted":
                recorder.abort("the arm stopped")
            else:
                recorder.finish(recorder.n_readings)
        assert recorder.done == {0, 1, 2, 7}
        with pytest.raises(InputError, match="press 8 was not begun"):
            recorder.finish(recorder.n_readings)
    with Recorder.resume(tmp_path / "run") as recorder:
        recorder.begin((0, 0), recorder.n_readings)
        recorder.finish(recorder.n_readings)
        assert recorder.done == {0, 1, 2, 7, 8}


def die_being_born(path, step):
    """Begin a recording in a process that ends where it puts something on the disk for the `step`th time."""
    if os.fork() == 0:
        left = iter(range(step))
        os.fsync = lambda file: None if next(left, None) is not None else os._exit(0)
        Recorder(path, FIBRES, {}, {})
        os._exit(0)
    os.wait()


def test_a_recording_that_was_killed_while_being_born_can_be_made_again(tmp_path):
    """Until `start.json` is there it begins anew, then it goes on."""
    down_command = []
    for step in range(4):
        path = tmp_path / str(step) / "run"
        path.parent.mkdir()
        die_being_born(path, step)
        down_command.append((path / START).exists())
        if down_command[-1]:
            with pytest.raises(InputError, match="never written over"):
                Recorder(path, FIBRES, {}, {})
        with Recorder.resume(path) if down_command[-1] else Recorder(path, FIBRES, {}, {}) as recorder:
            record(recorder, range(2), 0.0)
        assert len(Recording.open(path).presses_mm) == 2
        assert {file.name for file in path.iterdir()} == {START, READINGS, STATES, JOURNAL}
    assert down_command == [False, True, True, True]


@pytest.mark.parametrize("name", [READINGS, "notes.txt", ".unfinished-0123456789abcdef.json"])
def test_what_another_left_is_in_the_way_and_stays(tmp_path, name):
    (tmp_path / name).write_text("mine")
    (tmp_path / JOURNAL).touch()
    with pytest.raises(InputError, match="exists and is not empty"):
        Recorder(tmp_path, FIBRES, {}, {})
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {name: "mine", JOURNAL: ""}


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="what is open is told on Linux")
def test_what_a_recording_needs_to_be_opened_outlasts_a_power_cut(tmp_path, monkeypatch):
    """Files before the folder that names them, and that before the one above; also where it is renamed into place."""
    synced = []
    fsync, rename = os.fsync, os.rename

    def traced(file):
        synced.append(Path(f"/proc/self/fd/{file}").readlink())
        fsync(file)

    monkeypatch.setattr(os, "fsync", traced)
    monkeypatch.setattr(os, "rename", lambda old, new: (synced.append("renamed"), rename(old, new)))
    recorder = Recorder(tmp_path / "run", FIBRES, {"kind": "made"}, {})
    assert [path.name for path in synced] == [".unfinished-start.json", "run", tmp_path.name]
    synced.clear()
    record(recorder, range(1), 0.0)
    assert {path.name for path in synced} == {READINGS, STATES, JOURNAL}
    recorder.__exit__(None, None, None)
    synced.clear()
    Recording.open(tmp_path / "run").save(tmp_path / "copy", {})
    renamed = synced.index("renamed")
    assert {path.name for path in synced[:renamed]} >= {".unfinished-start.json", READINGS, JOURNAL, "copy"}
    assert tmp_path in synced[renamed:]


@pytest.mark.skipif(os.name != "posix", reason="kills and locks as POSIX has them")
@pytest.mark.parametrize("step", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_a_recording_that_gives_way_is_there_whole_or_not_at_all(tmp_path, step):
    """Killed between two file operations, any in the slow tier; and what is left goes with the next."""
    new = replace(Recording.open(made(tmp_path, presses=2)), source={"kind": "simulated"})
    with Recorder(tmp_path / "old", FIBRES, {"kind": "simulated"}, {}) as recorder:
        record(recorder, range(3), 0.0)
    found = []
    for number in count(step=step):
        folder = tmp_path / str(number)
        shutil.copytree(tmp_path / "old", folder / "run")
        (folder / ".run-mine").mkdir()
        ended = not killed(lambda folder=folder: new.save(folder / "run", {}, replacing=True), number, folder)
        found.append(len(Recording.open(folder / "run").presses_mm) if (folder / "run").exists() else 0)
        if not ended:
            new.save(folder / "run", {}, replacing=True)
        assert {path.name for path in folder.iterdir()} == {"run", ".run-mine"}
        if ended:
            break
    assert set(found) <= {3, 0, 2}
    assert found == sorted(found, key=[3, 0, 2].index)
    assert step > 1 or set(found) == {3, 0, 2}
