"""Searches that end before they are done."""

import os
import signal
import threading
from concurrent.futures import Executor, Future

import numpy as np
import pytest

from design import InputError, PadSettings, RulesSettings, SearchRun, SearchSettings, search
from design.common.checkpoints import Checkpoints
from design.optimisers import stopping

HERE = {"pad": PadSettings(grid=1), "settings": SearchSettings(knots=2, starts=2, steps=20), "rules": RulesSettings()}


class Hung(Executor):
    """Takes work and never does it."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_running_or_notify_cancel()
        return future


def test_the_deadline_holds_on_an_executor_that_hangs(monkeypatch):
    monkeypatch.setattr(stopping, "LATEST_S", 0.1)
    found = search(**HERE, run=SearchRun(time_budget=0.2, executor=Hung()))
    assert found.stopped == "out of time"
    assert len(found.morphology.knots) == 2


@pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
def test_the_second_ctrl_c_leaves_an_executor_that_hangs_behind():
    timers = [threading.Timer(after, os.kill, (os.getpid(), signal.SIGINT)) for after in (0.3, 0.6)]
    for timer in timers:
        timer.start()
    found = search(**HERE, run=SearchRun(executor=Hung()))
    assert found.stopped == "interrupted"


def test_states_are_kept_until_the_caller_has_what_was_found(tmp_path):
    first = search(**HERE, run=SearchRun(keep_in=tmp_path / "search"))
    again = search(**HERE, run=SearchRun(keep_in=tmp_path / "search", resume=True))
    assert np.array_equal(first.morphology.knots, again.morphology.knots)
    Checkpoints(tmp_path / "search", {}).clear()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("about", ['{"format": "somebody/1"}', "[]", "no JSON"])
def test_no_files_of_others_are_removed(tmp_path, about):
    names = ["search.json", "start_0.npz", "start_0000.npz", "start_0_notes.npz", "other"]
    for name in names:
        (tmp_path / name).write_text(about)
    with pytest.raises(InputError, match=r"search\.json: "):
        Checkpoints(tmp_path, {}).begin(resume=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)
    Checkpoints(tmp_path / "own", {}).save(0, {"done": np.array(True)})
    (tmp_path / "own" / "start_0_notes.npz").write_text("notes")
    Checkpoints(tmp_path / "own", {}).clear()
    assert [path.name for path in (tmp_path / "own").iterdir()] == ["start_0_notes.npz"]
