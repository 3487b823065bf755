"""Recordings on disks that are full, closed or gone in the middle: what was finished stays, nothing torn is taken."""

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import padforge
import sense
from design.common.errors import InputError
from tests.stress.clock import ends_in_time, few
from tests.stress.sense_cases import TINY, made, right_or_refused

NOBODY = 65_534
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


def in_child(work: Callable[[], None], limit: int | None = None, user: int | None = None) -> tuple[int, str]:
    """Run `work` in a child that may write files of `limit` bytes at most, as `user`; its status and stderr."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        os.dup2(write, 2)
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115  not the file that pytest has in its place
        status = 70
        try:
            if user is not None and os.getuid() == 0:
                os.setgroups([])
                os.setgid(user)
                os.setuid(user)
            if limit is not None:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            work()
            status = 0
        except InputError as error:
            os.write(2, f"{error}\n".encode())
            status = 2
        except OSError as error:
            os.write(2, f"{error}\n".encode())
            status = 3
        except BaseException as error:
            os.write(2, f"{type(error).__name__}: {error}\n".encode())
        finally:
            os._exit(status)
    os.close(write)
    with os.fdopen(read) as err:
        said = err.read()
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), said


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


SPEC = """
[localizer]
members = 1
hidden = 8
layers = 1
epochs = 2
[rig]
presses = 40
readings_per_press = 20
[pad]
grid = 2
"""
COMMANDS = {
    "record": ("sense", "record", "--out", "OUT/rec"),
    "import": ("sense", "import", "whole.csv", "--out", "OUT/rec"),
    "calibrate": ("sense", "calibrate", "whole", "--out", "OUT"),
    "export": ("sense", "export", "whole", "OUT/table.csv"),
    "locate": ("sense", "locate", "--model", "model", "whole", "--out", "OUT/places.csv"),
}


@pytest.fixture(scope="module")
def bench() -> Iterator[Path]:
    """A folder with settings, a recording, its table, and a model, that every user may look into."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield furnished(Path(name))


def furnished(folder: Path) -> Path:
    (folder / "pad.toml").write_text(SPEC)
    one = made(1, presses=40, cycle=20)
    one.save(folder / "whole", {})
    sense.export_csv(one, folder / "whole.csv")
    sense.calibrate(one, TINY)[0].save(folder / "model")
    return folder


def command(bench: Path, name: str, out: Path, limit: int | None = None, user: int | None = None) -> tuple[int, str]:
    """Run a command of padforge in a child; its exit code and stderr."""
    arguments = [part.replace("OUT", str(out)) for part in COMMANDS[name]]

    def work() -> None:
        os.chdir(bench)
        sys.argv = ["padforge", *arguments]
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        try:
            padforge.main()
        except SystemExit as end:
            sys.stderr.flush()
            os._exit(int(end.code or 0))

    return in_child(work, limit, user)


@pytest.mark.parametrize("name", ["record", "import", "export", "locate"])
@few(3)
@given(limit=st.integers(0, 60_000))
def test_commands_on_a_full_disk_leave_all_or_nothing(bench: Path, name: str, limit: int) -> None:
    out = bench / f"full_{name}_{limit}"
    out.mkdir(exist_ok=True)
    status, said = command(bench, name, out, limit)
    left = {path.name for path in out.iterdir()}
    if status == 0:
        assert len(left) == 1
        if name in ("record", "import"):
            assert len(sense.Recording.open(out / "rec").begun) == 40
        return
    assert (status, said.count("\n"), left) == (2, 1, set()), said
    out.rmdir()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can act as another user")
@pytest.mark.parametrize("name", COMMANDS)
def test_commands_in_a_folder_of_somebody_else_are_one_line(bench: Path, name: str) -> None:
    for module in ("encodings.utf_8_sig", "matplotlib.font_manager", "sense.report.calibration_figures"):
        import_module(module)  # where Python lies in a home, a child of another user cannot look there
    out = bench / f"closed_{name}"
    out.mkdir(mode=0o755, exist_ok=True)
    status, said = command(bench, name, out, user=NOBODY)
    assert (status, said.count("\n")) == (2, 1), said
    assert str(out) in said
    assert not any(out.iterdir())


def test_a_calibration_on_a_full_disk_leaves_the_older_model(bench: Path) -> None:
    out = bench / "older"
    sense.Localizer.load(bench / "model").save(out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    status, said = command(bench, "calibrate", out, limit=20_000)
    assert (status, "Traceback" in said) == (2, False), said
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


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


def test_two_imports_into_one_folder_leave_one_of_them_whole(bench: Path, tmp_path: Path) -> None:
    line = [sys.executable, "-m", "padforge", "sense", "import", "whole.csv", "--out", str(tmp_path / "rec")]
    running = [subprocess.Popen(line, cwd=bench, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) for _ in range(2)]
    said = [each.communicate()[1].decode() for each in running]
    assert sorted(each.returncode for each in running) == [0, 2], said
    assert [text.count("\n") for text in sorted(said, key=len)] == [0, 1]
    assert len(sense.Recording.open(tmp_path / "rec").begun) == 40
    assert [path.name for path in tmp_path.iterdir()] == ["rec"]
