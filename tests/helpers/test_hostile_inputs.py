"""The hostile inputs themselves: what is told of processes that end badly, and what is drawn; see `hostile_inputs`."""

import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import click
import h5py
import numpy as np
import pytest
import safetensors.numpy

import design
import fabricate
import sense
from padforge.commands import cli
from tests.helpers.effort import LONG
from tests.helpers.hostile_inputs import command_lines
from tests.helpers.hostile_inputs.__main__ import main
from tests.helpers.hostile_inputs.calls import functions
from tests.helpers.hostile_inputs.judging import outcome, suspect, violations
from tests.helpers.hostile_inputs.limited import MIB, ROOT, Limits, fresh, limited
from tests.helpers.hostile_inputs.spoilt_files import FOLDERS, READERS, spoil
from tests.stress.door import contents

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it looks up what Linux tells of processes")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder to work in, and one for its temporary files."""
    for name in ("here", "here.tmp"):
        (tmp_path / name).mkdir()
    (tmp_path / "here" / "old.json").write_text("{}")
    return tmp_path / "here"


def refuse(*lines: str) -> None:
    print("\n".join(lines), file=sys.stderr)
    raise SystemExit(2)


def changed_and_refused() -> None:
    Path("old.json").write_text("[]")
    refuse("padforge: no")


def burn() -> None:
    while True:
        pass


WORK: dict[str, tuple[Callable[[], object], str]] = {
    "results": (lambda: Path("new.json").write_text("{}"), ""),
    "one line": (lambda: refuse("padforge: a: got b, allowed is c"), ""),
    "two lines": (lambda: refuse("padforge: a", "padforge: b"), "refused in 2 lines"),
    "no line": (lambda: refuse("a"), "refused in 0 lines"),
    "traceback": (lambda: [][0], "traceback: IndexError: list index out of range"),
    "another exit": (lambda: sys.exit(3), "ended with 3"),
    "a signal": (lambda: os.kill(os.getpid(), signal.SIGKILL), "ended with -9"),
    "refused and changed": (changed_and_refused, "refused, and changed"),
    "gone": (lambda: (Path("old.json").unlink(), refuse("padforge: no")), "refused, and changed"),
    "litter": (lambda: Path(".unfinished-1").touch(), "left "),
    "temporary litter": (lambda: Path(os.environ["TMPDIR"], "x").touch(), "left the temporary"),
    "torn": (lambda: Path("new.json").write_text('{"a":'), "torn: "),
    "computes": (burn, "ended with -"),
    "waits": (lambda: time.sleep(60), "after its time"),
    "warns": (lambda: print("/a/b.py:3: RuntimeWarning: x", file=sys.stderr), "warns"),
}


@pytest.mark.parametrize("name", WORK)
def test_what_may_not_be_is_told(folder: Path, name: str) -> None:
    work, expected = WORK[name]
    before = contents(folder)
    ended = limited(work, folder, Limits(cpu_s=1, wall_s=30 if name == "computes" else 3))
    now = contents(folder)
    changed = [Path(path) for path in now.keys() | before.keys() if now.get(path) != before.get(path)]
    found = violations(ended, changed, list(Path(f"{folder}.tmp").iterdir()))
    assert bool(found) == bool(expected), found
    assert expected in "; ".join(found)
    if name == "computes":
        assert 0.5 < ended.cpu_s < 3
    if name == "waits":
        assert outcome(ended) == "hung"


def test_memory_is_told_and_limited(folder: Path) -> None:
    taken = limited(lambda: len(bytes(range(256)) * (2 * MIB)), folder, Limits(memory=800 * MIB))
    assert 500 * MIB < taken.memory < 600 * MIB
    assert (taken.code, suspect(taken)) == (0, True)
    refused = limited(lambda: len(bytes(range(256)) * (2 * MIB)), folder, Limits(memory=300 * MIB))
    assert (refused.code, suspect(refused)) == (1, True)
    assert not suspect(limited(lambda: None, folder, Limits()))


def test_a_fresh_process_begins_with_no_memory_of_this_one(folder: Path) -> None:
    held = b"x" * (300 * MIB)
    ended = fresh(["-c", "x = b'x' * (100 << 20); raise SystemExit(2)"], folder)
    assert 100 * MIB < ended.memory < 200 * MIB < len(held)
    assert (ended.code, ended.cpu_s > 0) == (2, True)


def test_an_interrupt_comes_where_it_is_asked_for(folder: Path) -> None:
    ended = limited(lambda: time.sleep(60), folder, Limits(wall_s=30), interrupt_s=0.3)
    assert "KeyboardInterrupt" in ended.err
    assert not ended.hung


def test_root_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    with pytest.raises(SystemExit, match="not as root"):
        main(tmp_path / "new", 1, 0)
    assert list(tmp_path.iterdir()) == []


def named(words: list[str]) -> click.Command:
    """The command that a command line begins with."""
    command: click.Command = cli
    for word in words:
        inner: dict[str, click.Command] = getattr(command, "commands", {})
        if not {word, "build"} & inner.keys():  # which may be left out
            break
        command = inner[word if word in inner else "build"]
    return command


def test_every_command_and_option_is_drawn_the_same_from_the_same_seed() -> None:
    lines = [command_lines.drawn(np.random.default_rng([0, number])) for number in range(6000)]
    assert lines[:200] == [command_lines.drawn(np.random.default_rng([0, number])) for number in range(200)]
    used = {(named(words), word) for words in lines for word in words}
    for command in command_lines.commands():
        assert named(list(command.words)) in {each for each, _ in used}, command.words
        for option in command.options:
            assert (named(list(command.words)), option) in used, (command.words, option)


def test_what_reads_files_are_commands_that_there_are() -> None:
    for words in (line for lines in (*READERS.values(), *FOLDERS.values()) for line in lines):
        command = named(words.split())
        assert command.callback is not None, words
        known = {each for parameter in command.params for each in parameter.opts}
        assert {word for word in words.split() if word.startswith("--")} <= known, words


def test_every_public_function_is_called() -> None:
    handed_out = {f"{package.__name__}.{name}" for package in (design, fabricate, sense) for name in package.__all__}
    called = {".".join(name.split(".")[:2]) for name in functions()}
    results = {"SearchResult", "SearchRun", "LossError", "Violation", "Finding", "FibreFault", "Found"}
    assert {name.partition(".")[2] for name in handed_out - called} <= results | {"InputError", "Fault"}
    assert {"design.Morphology.load", "sense.Localizer.locate", "sense.Live.feed"} <= functions().keys()


NAMES = ("a.json", "a.csv", "a.h5", "a.mat", "a.npz", "b.safetensors", "a.db3", "a.bin")


@pytest.fixture(scope="module")
def good_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a file of each kind that is spoiled in a way of its own."""
    folder = tmp_path_factory.mktemp("good")
    arrays = {"a": np.ones((3, 2), np.float32), "b": np.arange(4)}
    names = [folder / name for name in NAMES]
    names[0].write_text(json.dumps({"a": [1, {"b": 2.5}], "c": "d"}))
    names[1].write_text("x,y\n1,2\n3,4e5\n")
    with h5py.File(names[2], "w") as file:
        file["g/x"], file["y"] = np.ones((4, 2)), np.arange(3)
    names[3].touch()
    np.savez(names[4], allow_pickle=False, **arrays)
    safetensors.numpy.save_file(arrays, names[5])
    names[5].with_suffix(".json").write_text("{}")
    with closing(sqlite3.connect(names[6])) as database:
        database.execute("create table messages (id integer primary key, data blob)")
        database.execute("insert into messages values (1, x'00')")
        database.commit()
    names[7].write_bytes(bytes(range(256)))
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_files_are_spoiled_the_same_from_the_same_seed(good_files: Path, tmp_path: Path, name: str) -> None:
    def spoiled(seed: int) -> str:
        folder = tmp_path / "spoiled"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(good_files, folder)
        return spoil(np.random.default_rng(seed), folder / name)

    told = [spoiled(seed) for seed in range(40)]
    assert told[:10] == [spoiled(seed) for seed in range(10)]
    assert len(set(told)) > 5


@LONG
@pytest.mark.skipif(getattr(os, "geteuid", int)() == 0, reason="it refuses to run as root")
def test_hostile_inputs_end_as_they_may(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.helpers.hostile_inputs", str(tmp_path / "new"), "300", "0"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert ended.stdout.endswith("300 inputs, 0 violations\n")
