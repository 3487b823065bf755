import json
import os
import signal
import sys
import threading
from concurrent.futures import Executor, Future
from dataclasses import replace

import click
import numpy as np
import pytest

from padforge import InputError
from padforge.common import parallel as computing
from padforge.common.command_line import run_to_end
from padforge.common.files import UNFINISHED
from padforge.common.parallel import Checkpoints
from padforge.design import Morphology, PadSettings, RulesSettings, SearchOptions, SearchSettings, design_run, search
from padforge.design.optimize import search as stopping
from padforge.design.optimize.problem import build_problem
from tests.helpers.door import called, refused

PAD = PadSettings(grid=1)
SMALL = SearchSettings(knots=3, starts=2, steps=30, population=10, generations=5, max_failures=1, contacts="assumed")
FREE = RulesSettings(enforce=False)
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")


class KilledError(Exception):
    """Stands for a kill in mid-search."""


def test_checkpoints_of_other_searches_and_files_of_others_are_refused_and_stay(tmp_path):
    folder, quick = tmp_path / "search", SMALL.model_copy(update={"starts": 1, "steps": 2})
    run = SearchOptions(keep_in=folder, resume=True)
    first = search(PAD, None, quick, FREE, run=run)
    assert search(PAD, None, quick, FREE, run=run).morphology == first.morphology
    with pytest.raises(InputError, match="begun with search seed 0, now 5"):
        search(PAD, None, quick.model_copy(update={"seed": 5}), FREE, run=run)
    (folder / f"{UNFINISHED}killed").mkdir()  # left by a save that was killed
    Checkpoints(folder, {}).clear()
    assert not list(tmp_path.iterdir())
    names = ["search.json", "start_0.npz", "start_0_notes.npz", "other"]
    for name in names:
        (tmp_path / name).write_text('{"format": "somebody/1"}')
    with pytest.raises(InputError, match=r"search\.json: "):
        Checkpoints(tmp_path, {}).begin(resume=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    Checkpoints(tmp_path / "own", {}).save(0, {"done": np.array(True)})
    (tmp_path / "own" / "start_0_notes.npz").write_text("notes")
    Checkpoints(tmp_path / "own", {}).begin(resume=False)
    assert [path.name for path in (tmp_path / "own").iterdir()] == ["start_0_notes.npz"]


def test_stopped_search_repairs_the_start_that_is_best_now(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept, repaired = Checkpoints(tmp_path, build_problem(PAD, SMALL.default_contact, SMALL, FREE).settings()), []
    for start, history in enumerate([[(1, 3.0), (9, 1.0)], [(1, 2.0), (9, 1.5)]]):  # steps and objectives
        kept.save(start, {"history": np.array(history), "done": np.array(False)})
    straight = Morphology.straight(PAD.layout)
    monkeypatch.setattr(stopping, "_finish_start", lambda problem, start, *_: repaired.append(start) or straight)
    search(PAD, None, SMALL, FREE, run=SearchOptions(keep_in=tmp_path, resume=True, time_budget=0))
    assert repaired == [0]


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_search_returns_the_best_so_far_on_ctrl_c(method):
    """The signal comes from the first report; what was found by then is returned, and says so."""
    settings = SMALL.model_copy(update={"method": method, "steps": 100_000, "generations": 100_000})
    result = search(PAD, None, settings, run=SearchOptions(lambda *progress: signal.raise_signal(signal.SIGINT)))
    assert result.stopped == "interrupted"
    assert len(result.morphology.knots) == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("time_budget", [0.3, 1e-6])
def test_search_within_a_time_budget_returns_the_best_so_far(time_budget):
    result = search(PAD, None, SMALL.model_copy(update={"steps": 10**6}), run=SearchOptions(time_budget=time_budget))
    assert (result.stopped, result.violations) == ("out of time", [])
    assert result.morphology.knots.shape == (2, 5, 2)
    assert result.seconds < 30


def test_search_out_of_time_returns_the_start_that_is_best_by_now(tmp_path):
    """Not the one that was best at first; both are read from the states that an earlier run has kept."""
    folder, settings = tmp_path / "search", SMALL.model_copy(update={"steps": 2})
    search(PAD, None, settings, FREE, run=SearchOptions(keep_in=folder))
    kept = Checkpoints(folder, json.loads((folder / "search.json").read_text())["settings"])
    states = kept.begin(resume=True)
    for best in (0, 1):
        for start, state in states.items():
            last = 0.2 if start == best else 0.3
            kept.save(start, state | {"history": np.array([[1, 0.5 - last], [2, last]])})
        result = search(PAD, None, settings, FREE, run=SearchOptions(keep_in=folder, resume=True, time_budget=1e-6))
        assert (result.stopped, result.candidate) == ("out of time", f"start {best + 1}")


class Hung(Executor):
    """Takes work and never does it; Ctrl-C is pressed so many seconds after it has taken the first."""

    def __init__(self, *interrupts_s):
        self.interrupts_s = list(interrupts_s)

    def submit(self, fn, /, *args, **kwargs):
        while self.interrupts_s:
            threading.Timer(self.interrupts_s.pop(), os.kill, (os.getpid(), signal.SIGINT)).start()
        future = Future()
        future.set_running_or_notify_cancel()
        return future


@POSIX
def test_command_ignores_a_hangup_under_nohup(monkeypatch):
    @click.command()
    def work():
        signal.raise_signal(signal.SIGHUP)

    handlers = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGTERM)}
    monkeypatch.setattr(sys, "argv", ["padforge"])
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        assert run_to_end(work, "padforge", {}) == 0
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        assert run_to_end(work, "padforge", {}) == 130
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def test_executor_that_hangs_is_left_at_the_end_of_the_budget_or_on_a_second_ctrl_c(monkeypatch):
    monkeypatch.setattr(stopping, "GRACE_S", 0.1)
    result = search(PAD, None, SMALL, run=SearchOptions(time_budget=0.1, executor=Hung()))
    assert result.stopped == "out of time"
    assert len(result.morphology.knots) == 2
    if os.name == "posix":
        assert search(PAD, None, SMALL, run=SearchOptions(executor=Hung(0.2, 0.4))).stopped == "interrupted"


@pytest.mark.parametrize("method", ["descent", "genetic"])
def test_search_broken_off_anywhere_resumes_as_if_unbroken(method, tmp_path, monkeypatch):
    """The report raises, as a kill would end it, again and again; every attempt goes on from the last state.

    Also if the state of the first start is lost, which then comes to its end after the others.
    """
    settings = SMALL.model_copy(update={"method": method, "steps": 10})
    unbroken, kills, resumed = search(PAD, None, settings, FREE), 0, None
    monkeypatch.setattr(stopping, "SLICE_S", -1.0)  # a state is kept after every step

    def report(*progress):
        reported.append(progress)
        if len(reported) == 2:
            raise KilledError

    while resumed is None:
        reported = []
        try:
            resumed = search(PAD, None, settings, FREE, run=SearchOptions(report, tmp_path / "search", resume=True))
        except KilledError:
            kills += 1
            assert kills < 30, "it does not get on"
    assert kills > 0
    (tmp_path / "search" / "start_0000.npz").unlink()
    again = search(PAD, None, settings, FREE, run=SearchOptions(keep_in=tmp_path / "search", resume=True))
    for result in (resumed, again):
        assert (result.morphology, result.history) == (unbroken.morphology, unbroken.history)


SETTINGS = """
[pad]
grid = 1
[search]
knots = 2
starts = 2
steps = 60
max_failures = 1
contacts = "assumed"
[rules]
enforce = false
"""


@pytest.mark.parametrize(("why", "code"), [("interrupted", 130), ("out of time", 0)])
def test_design_that_is_cut_short_says_so_and_keeps_its_states(why, code, tmp_path, monkeypatch):
    """Until it comes to its end."""

    def cut_short(*asked, run, **others):
        def report(*progress):
            if why == "interrupted":
                signal.raise_signal(signal.SIGINT)

        return replace(search(*asked, run=replace(run, on_progress=report), **others), stopped=why)

    (tmp_path / "pad.toml").write_text(SETTINGS)
    with monkeypatch.context() as patch:
        patch.setattr(design_run, "search", cut_short)
        ended = called("design", "--out", "pad", cwd=tmp_path)
    assert (ended.code, f"{why}: the best so far" in ended.out) == (code, True)
    assert json.loads((tmp_path / "pad" / "design.json").read_text())["stopped"] == why
    assert (tmp_path / "pad" / "search" / "start_0000.npz").exists()
    assert called("design", "--out", "pad", "--resume", cwd=tmp_path).code == 0
    assert not (tmp_path / "pad" / "search").exists()


@pytest.mark.filterwarnings("ignore")
def test_absent_scheduler_is_refused_in_one_line(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(computing, "SCHEDULER_S", 0.2)
    (tmp_path / "pad.toml").write_text(SETTINGS)
    said = refused("design", "--scheduler", "tcp://127.0.0.1:9", cwd=tmp_path)
    assert "--scheduler is tcp://127.0.0.1:9: no Dask scheduler answers there" in said
