"""Run directories and their block files: whatever a break leaves, no finished press is lost, and no other counts."""

import io
import os
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from padforge.common.files import locked
from padforge.common.validation import InputError
from padforge.sense import Recorder, Recording
from padforge.sense.recording.block_file import BlockWriter, block_dtype, read_blocks
from tests.helpers.kills import after_kills
from tests.helpers.power_cut import ON_LINUX, Disk


def write(path: Path, rows: np.ndarray, cuts: Sequence[int] = (), flush: bool = False) -> None:
    with path.open("wb") as file:
        writer = BlockWriter(file, rows.shape[1] - 1)
        for part in np.split(rows, cuts):
            writer.append(part)
            if flush:
                writer.flush()
        writer.flush()


def some_rows(count: int, fibres: int) -> np.ndarray:
    return np.random.default_rng(count).standard_normal((count, 1 + fibres))


@settings(max_examples=25)
@given(
    count=st.integers(0, 60),
    fibres=st.integers(1, 40),
    cuts=st.lists(st.integers(0, 60), max_size=5),
    flush=st.booleans(),
)
def test_block_file_round_trip(tmp_path_factory, count: int, fibres: int, cuts: list[int], flush: bool) -> None:
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    rows = some_rows(count, fibres)
    write(path, rows, sorted(cuts), flush)
    assert np.array_equal(np.column_stack(read_blocks(path, fibres)), rows)


@settings(max_examples=25)
@given(size=st.integers(0, 10 * 256), zeros=st.sampled_from([0, 13, 700]))
def test_read_blocks_cuts_off_a_torn_tail(tmp_path_factory, size: int, zeros: int) -> None:
    """Also one of zeros, as a crashed disk leaves it. Blocks are a multiple of 256 bytes and hold four rows or more."""
    for fibres, size in ((1, 256), (6, 256), (7, 512), (128, 4352), (512, 16640)):
        assert block_dtype(fibres).itemsize == size
        assert block_dtype(fibres)["rows"].shape[0] >= 4
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    rows = some_rows(40, 6)
    write(path, rows)
    assume(not zeros or size % 256 < 248)  # the last 8 bytes of a block are zeros
    path.write_bytes(path.read_bytes()[:size] + bytes(zeros))
    assert np.array_equal(np.column_stack(read_blocks(path, 6)), rows[: size // 256 * 4])


@settings(max_examples=25)
@given(byte=st.integers(0, 9 * 256 - 1), bit=st.integers(0, 7))
def test_read_blocks_refuses_a_flipped_bit(tmp_path_factory, byte: int, bit: int) -> None:
    path = tmp_path_factory.mktemp("stream") / "readings.bin"
    write(path, some_rows(40, 6))
    content = bytearray(path.read_bytes())
    content[byte] ^= 1 << bit
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"block {byte // 256} .*damaged"):
        read_blocks(path, 6)


def test_read_blocks_refuses_a_lost_block_and_another_count(tmp_path: Path) -> None:
    write(tmp_path / "s", some_rows(40, 6))
    content = (tmp_path / "s").read_bytes()
    block = bytearray(content[8 * 256 : 9 * 256])
    block[16:20] = (3).to_bytes(4, "little")
    block[20:24] = zlib.crc32(block[24:], zlib.crc32(block[:20])).to_bytes(4, "little")
    damaged = {"2": content[:512] + content[768:], "[89]": content[: 8 * 256] + block + content[9 * 256 :]}
    for number, each in damaged.items():
        (tmp_path / "s").write_bytes(each)
        with pytest.raises(InputError, match=rf"block {number} .*damaged"):
            read_blocks(tmp_path / "s", 6)


@settings(max_examples=20)
@given(fails=st.sets(st.integers(0, 30), max_size=8), share=st.floats(0, 1))
def test_block_writer_repairs_failed_writes(tmp_path_factory, fails: set[int], share: float) -> None:
    path, rows, calls = tmp_path_factory.mktemp("flaky") / "s", some_rows(40, 6), iter(range(999))

    class Flaky(io.FileIO):
        def write(self, data) -> int:
            if next(calls) in fails:
                super().write(bytes(data)[: int(share * len(data))])
                raise OSError(28, "No space left on device")
            return super().write(data)

    with Flaky(path, "w") as file:
        writer = BlockWriter(file, 6)
        for part in np.split(rows, 8):
            for work in (lambda part=part: writer.append(part), writer.flush):
                while True:
                    try:
                        work()
                        break
                    except OSError:
                        continue
    assert np.array_equal(np.column_stack(read_blocks(path, 6)), rows)


START, JOURNAL, READINGS, STATES = "start.json", "journal.ndjson", "readings.bin", "states.bin"
FIBRES = 3


def record(recorder: Recorder, presses: range, time_s: float) -> float:
    """Record 20 readings a press at 10 Hz, and 10 states."""
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


def record_presses(folder, presses=5):
    with Recorder(folder / "run", FIBRES, {"kind": "made"}, {}) as recorder:
        record(recorder, range(presses), 0.0)
    return folder / "run"


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    """Return the files of a run directory of five presses."""
    path = record_presses(tmp_path_factory.mktemp("five"))
    return {file.name: file.read_bytes() for file in path.iterdir()}


@ON_LINUX
def test_files_outlast_a_power_cut_after_every_press_and_save(tmp_path, monkeypatch):
    disk, run = Disk(monkeypatch), tmp_path / "run"
    with Recorder(run, FIBRES, {"kind": "made"}, {}) as recorder:
        for press in range(2):
            record(recorder, range(press, press + 1), 2.0 * press)
            for path in run.glob("[!.]*"):
                assert disk.read(path) == path.read_bytes()
    Recording.open(run).save(tmp_path / "copy", {})
    for path in (tmp_path / "copy").iterdir():
        assert disk.read(path) == path.read_bytes()
    assert disk.has_name(run)
    assert disk.has_name(tmp_path / "copy")
    assert disk.torn == []


@settings(max_examples=15)
@given(st.data())
def test_resume_after_a_kill_at_any_byte(five, tmp_path_factory, data):
    """Files grow in the order readings, states, journal; a kill leaves any prefix of what came after the last sync."""
    path = tmp_path_factory.mktemp("killed")
    (path / START).write_bytes(five[START])
    lines = five[JOURNAL].splitlines(keepends=True)
    finished = data.draw(st.integers(0, 4))
    synced = {JOURNAL: sum(map(len, lines[: 2 * finished]))}
    for name, columns, rows in ((READINGS, FIBRES, 20), (STATES, 9, 10)):
        dtype = block_dtype(columns)
        blocks = np.frombuffer(five[name], dtype)
        n_synced = int(np.searchsorted(np.cumsum(blocks["count"]), rows * finished, side="right")) if finished else 0
        synced[name] = n_synced * dtype.itemsize
    for name in (READINGS, STATES, JOURNAL):
        cut = data.draw(st.integers(synced[name], len(five[name])))
        (path / name).write_bytes(five[name][: cut if name != JOURNAL else min(cut, synced[name] + 40)])
    with Recorder.resume(path) as recorder:
        assert recorder.done >= set(range(finished))
        assert len(recorder.done) <= finished + 1
        for press in sorted(set(range(5)) - recorder.done):
            record(recorder, range(press, press + 1), max(recorder.last_s, 0.0) + 1)
    recording = Recording.open(path)
    assert recording.presses_mm.tolist() == [[press, -press] for press in range(5)]
    for press, (down, up) in enumerate(zip(recording.down_command, recording.up_command, strict=True)):
        assert (recording.readings[down:up] == press + 0.5).all()  # as `record` has them
    assert (np.diff(recording.times_s) > 0).all()


def test_resume_aborts_presses_without_their_readings(tmp_path):
    """The journal says they are done; once other readings fill the gap, it must not say so any more."""
    path = record_presses(tmp_path)
    content = (path / READINGS).read_bytes()
    (path / READINGS).write_bytes(content[: len(content) // 2])
    with Recorder.resume(path) as recorder:
        done = set(recorder.done)
        assert done < set(range(5))
        times = recorder.last_s + 1 + np.arange(100) / 10
        recorder.append(times, np.zeros((100, FIBRES)))
    with Recorder.resume(path) as recorder:
        assert recorder.done == done
        recorder.begin((9, 9), recorder.n_readings, max(done) + 1)
        recorder.abort("broken off")
    assert len(Recording.open(path).presses_mm) == len(done)


def test_recorder_locks_the_folder(tmp_path):
    path = record_presses(tmp_path)
    before = {name: (path / name).read_bytes() for name in (READINGS, STATES, JOURNAL)}
    with Recorder.resume(path) as first:
        assert (first.done, first.n_readings, first.last_s) == (set(range(5)), 100, pytest.approx(9.9))
        with pytest.raises(InputError, match="another program is recording"):
            Recorder.resume(path)
        with pytest.raises(InputError, match="never written over"):
            Recorder(path, FIBRES, {}, {})
        assert {name: (path / name).read_bytes() for name in before} == before
        record(first, range(5, 7), 10.0)
    assert len(Recording.open(path).down_command) == 7


def test_recorder_on_a_full_disk_cleans_up_and_hides_no_error(tmp_path, monkeypatch):
    full = Mock(side_effect=OSError(28, "No space left on device"))

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
    record_presses(tmp_path / "born")


def test_begin_numbers_presses(tmp_path):
    """An aborted press keeps its number; after a break the count continues."""

    def press(recorder, number=None, aborted=False):
        recorder.append(recorder.n_readings / 10 + np.array([0, 0.1]), np.zeros((2, FIBRES)))
        recorder.begin((0, 0), recorder.n_readings - 1, number)
        for end in (recorder.abort, recorder.abort) if aborted else (recorder.finish,):
            end("the arm stopped" if aborted else recorder.n_readings)

    with Recorder(tmp_path / "run", FIBRES, {"kind": "made"}, {}) as recorder:
        for number, aborted in ((None, False), (None, False), (None, True), (None, False), (7, False)):
            press(recorder, number, aborted)
        assert recorder.done == {0, 1, 2, 7}
    assert (tmp_path / "run" / JOURNAL).read_text().count('"event": "aborted"') == 1
    with Recorder.resume(tmp_path / "run") as recorder:
        press(recorder)
        assert recorder.done == {0, 1, 2, 7, 8}
    assert len(Recording.open(tmp_path / "run").presses_mm) == 5


def test_recorder_after_a_kill_during_creation(tmp_path):
    """Without `start.json` it begins anew, else it is resumed."""
    has_start = []
    for folder in after_kills(lambda folder: Recorder(folder / "run", FIBRES, {}, {}), Path.mkdir, tmp_path):
        path = folder / "run"
        has_start.append((path / START).exists())
        if has_start[-1]:
            with pytest.raises(InputError, match="never written over"):
                Recorder(path, FIBRES, {}, {})
        with Recorder.resume(path) if has_start[-1] else Recorder(path, FIBRES, {}, {}) as recorder:
            record(recorder, range(2), 0.0)
        assert len(Recording.open(path).presses_mm) == 2
        left = {file.name for file in path.iterdir() if not file.match(".unfinished-*")}
        assert left == {START, READINGS, STATES, JOURNAL}
    assert has_start == sorted(has_start)
    assert set(has_start) == {False, True}


@pytest.mark.skipif(os.name != "posix", reason="kills and locks of POSIX")
def test_save_replaces_all_or_nothing(tmp_path):
    """Killed before any file operation."""
    new = replace(Recording.open(record_presses(tmp_path, presses=2)), source={"kind": "simulated"})
    with Recorder(tmp_path / "old", FIBRES, {"kind": "simulated"}, {}) as recorder:
        record(recorder, range(3), 0.0)

    def make(folder: Path) -> None:
        shutil.copytree(tmp_path / "old", folder / "run")
        (folder / ".run-mine").mkdir()

    def save(folder: Path) -> None:
        new.save(folder / "run", {}, replacing=True)

    n_presses = []
    for folder in after_kills(save, make, tmp_path):
        n_presses.append(len(Recording.open(folder / "run").presses_mm) if (folder / "run").exists() else 0)
        save(folder)
        assert {path.name for path in folder.iterdir() if not path.match(".unfinished-*")} == {"run", ".run-mine"}
    assert set(n_presses) == {3, 0, 2}
    assert n_presses == sorted(n_presses, key=[3, 0, 2].index)


def test_open_drops_presses_of_torn_and_repeated_entries(recording: Recording, folder: Path) -> None:
    journal = folder / "journal.ndjson"
    journal.write_text(journal.read_text()[:-9])
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 1
    with Recorder.resume(folder) as recorder:
        recorder.begin((0.0, 0.0), recorder.n_readings, press=7)
    assert len(Recording.open(folder).presses_mm) == len(recording.presses_mm) - 2


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 0xFF
    path.write_bytes(bytes(content))


def claim_three_fibres(path: Path) -> None:
    path.write_text(path.read_text().replace('"fibres": 4', '"fibres": 3'))


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        *((name, damage, name) for name in (JOURNAL, READINGS)),
        # Blocks of one size hold any of several numbers of fibres.
        (START, claim_three_fibres, r"readings\.bin: "),
        # No break leaves presses without any reading.
        (READINGS, lambda path: path.write_bytes(b""), r"readings\.bin: does not fit the recording, .* \d+ presses"),
    ],
)
def test_resume_refuses_damage_and_changes_nothing(folder: Path, name: str, change, message: str) -> None:
    change(folder / name)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(InputError, match=message):
        Recorder.resume(folder)
    assert {path: path.read_bytes() for path in before} == before


def test_resume_reads_the_journal_after_the_lock(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another program may finish a press before the lock."""

    def finish_before_lock(path: Path, busy: str):
        monkeypatch.undo()
        with Recorder.resume(folder) as another:
            another.append([another.last_s + 1], np.zeros((1, another.fibres)))
            another.begin((0, 0), another.n_readings, press=9999)
            another.append([another.last_s + 1], np.zeros((1, another.fibres)))
            another.finish(another.n_readings)
        return locked(path, busy)

    monkeypatch.setattr("padforge.sense.recording.run_directory.locked", finish_before_lock)
    with Recorder.resume(folder) as recorder:
        assert 9999 in recorder.done
