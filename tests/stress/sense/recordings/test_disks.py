"""Recordings on disks that are full, closed or gone in the middle: what was finished stays, nothing torn is taken."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sense
from tests.helpers.effort import few
from tests.stress.clock import ends_in_time
from tests.stress.sense.cases import made, right_or_refused
from tests.stress.sense.children import in_child

PRESSES, CYCLE, FIBRES = 12, 40, 4


def rows_of(press: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and readings of the cycle of a press; every value is told apart from every other."""
    index = CYCLE * press + np.arange(CYCLE)
    return index / 13.3, 1 + 1e-4 * (index[:, None] * FIBRES + np.arange(FIBRES))


def record(recorder: sense.Recorder, presses: range, tell: Callable[[int], None] = lambda press: None) -> None:
    """Record presses as a rig does, each on the disk before it is told to be done."""
    for press in presses:
        recorder.append(*rows_of(press))
        recorder.begin([float(press), 0.0], CYCLE * press + CYCLE // 2, press)
        recorder.finish(CYCLE * press + CYCLE)
        recorder.sync()
        tell(press)


def whole(found: sense.Recording) -> None:
    """Every reading and every press is one that was recorded."""
    for press in range(-(-len(found.readings) // CYCLE)):
        times_s, readings = rows_of(press)
        part = slice(CYCLE * press, min(CYCLE * press + CYCLE, len(found.readings)))
        np.testing.assert_array_equal(found.readings[part], readings[: part.stop - part.start])
        np.testing.assert_array_equal(found.times_s[part], times_s[: part.stop - part.start])
    np.testing.assert_array_equal(found.begun, CYCLE * found.presses_mm[:, 0] + CYCLE // 2)


@few(12)
@given(limit=st.integers(0, 25_000))
def test_a_full_disk_loses_no_finished_press(tmp_path_factory: pytest.TempPathFactory, limit: int) -> None:
    """What was told to be done before the disk was full is there, and the rest can be recorded when it is not."""
    folder = tmp_path_factory.mktemp("full") / "rec"
    told = folder.parent / "told"
    told.touch()

    def work() -> None:
        with sense.Recorder(folder, FIBRES, {}, {}) as recorder:
            record(recorder, range(PRESSES), lambda press: os.truncate(told, press + 1))

    status, said = in_child(work, limit)
    done = told.stat().st_size
    assert status == 0 or (status in (2, 3) and said.count("\n") == 1), said
    if done == 0 and status == 2:
        assert not folder.exists() or not any(folder.iterdir()), "a part of a recording is left"
        return
    if done:
        found = sense.Recording.open(folder)
        whole(found)
        assert len(found.begun) >= done
    with sense.Recorder.resume(folder) as recorder:
        assert set(range(done)) <= recorder.done
        recorder.append(*(part[recorder.readings % CYCLE :] for part in rows_of(recorder.readings // CYCLE)))
        first = recorder.readings // CYCLE
        if first <= PRESSES:
            record(recorder, range(first, PRESSES + 1))
    found = sense.Recording.open(folder)
    whole(found)
    assert set(range(done)) <= set(found.presses_mm[:, 0].astype(int).tolist())


@few(12)
@given(fails=st.lists(st.integers(0, 40), max_size=4), share=st.floats(0, 1))
def test_a_disk_that_fails_now_and_then_never_tears_the_stream(
    tmp_path_factory: pytest.TempPathFactory, fails: list[int], share: float
) -> None:
    """Writes that fail half done, and are tried again by the next press, leave a stream that can be read."""
    folder = tmp_path_factory.mktemp("flaky") / "rec"
    recorder = sense.Recorder(folder, FIBRES, {}, {})
    stream = recorder._stream  # pyright: ignore[reportPrivateUsage]
    writes, write = iter(range(10**6)), stream.write

    class Flaky:
        def __getattr__(self, name: str):
            return getattr(stream, name)

        def write(self, data: bytes) -> int:
            if next(writes) in fails:
                write(data[: int(share * len(data))])
                stream.flush()
                raise OSError(28, "No space left on device")
            return write(data)

    recorder._blocks._file = Flaky()  # pyright: ignore[reportPrivateUsage, reportAttributeAccessIssue]
    done: list[int] = []
    for press in range(PRESSES):
        while recorder.readings < CYCLE * (press + 1):
            try:
                recorder.append(*(part[recorder.readings % CYCLE :] for part in rows_of(press)))
            except OSError:
                continue
        recorder.begin([float(press), 0.0], CYCLE * press + CYCLE // 2, press)
        recorder.finish(CYCLE * press + CYCLE)
        for _ in range(9):
            try:
                recorder.sync()
                done.append(press)
                break
            except OSError:
                continue
    recorder.__exit__(None, None, None)
    found = sense.Recording.open(folder)
    whole(found)
    assert found.presses_mm[:, 0].tolist() == done == list(range(PRESSES))


@pytest.mark.parametrize("pause_s", [0.0, 0.01, 0.03, 0.1])
def test_a_kill_in_the_middle_loses_no_finished_press(tmp_path: Path, pause_s: float) -> None:
    folder, told = tmp_path / "rec", tmp_path / "told"
    told.touch()
    child = os.fork()
    if child == 0:
        try:
            with sense.Recorder(folder, FIBRES, {}, {}) as recorder:
                record(recorder, range(100_000), lambda press: os.truncate(told, press + 1))
        finally:
            os._exit(0)
    with ends_in_time():
        while not told.stat().st_size:
            time.sleep(0.001)
    time.sleep(pause_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    done = told.stat().st_size
    found = sense.Recording.open(folder)
    whole(found)
    assert len(found.begun) >= done
    with sense.Recorder.resume(folder) as recorder:
        assert set(range(done)) <= recorder.done


def test_of_two_programs_in_one_folder_one_records_and_the_other_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    with sense.Recorder(folder, FIBRES, {}, {}) as recorder:
        record(recorder, range(2))
        for begin in (lambda: sense.Recorder.resume(folder), lambda: sense.Recorder(folder, FIBRES, {}, {})):
            status, said = in_child(lambda begin=begin: begin() and None)
            assert (status, said.count("\n")) == (2, 1)
        record(recorder, range(2, 4))
    whole(sense.Recording.open(folder))


@pytest.mark.parametrize("pause_s", [0.0, 0.05])
def test_a_save_that_is_killed_leaves_no_recording_by_its_name(tmp_path: Path, pause_s: float) -> None:
    one = made(1, presses=2000)
    child = os.fork()
    if child == 0:
        try:
            one.save(tmp_path / "rec", {})
        finally:
            os._exit(0)
    time.sleep(pause_s)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    if (tmp_path / "rec").exists():
        assert sense.Recording.open(tmp_path / "rec") == one
    else:
        one.save(tmp_path / "rec", {})
        assert right_or_refused(lambda: sense.Recording.open(tmp_path / "rec")) == one
