"""What `--profile` tells: counters of what was skipped, held exactly; of times, only how they add up."""

import sys
import threading

import numpy as np
import pytest

from padforge.common import profiling
from padforge.design import SearchOptions, search
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings


def test_stages_are_those_of_the_main_thread_and_end_with_an_error(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(profiling.time, "perf_counter", lambda: now[0])

    def work():
        with profiling.stage("aside"):
            now[0] += 3

    with profiling.profiled() as profile, profiling.stage("main"):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert "aside" not in profile.seconds
    assert profile.seconds["main"] == 3
    finders = list(sys.meta_path)
    with pytest.raises(ValueError, match="on purpose"), profiling.profiled() as profile, profiling.stage("failing"):
        raise ValueError("on purpose")
    assert "failing" in profile.seconds
    assert sys.meta_path == finders
    profiling.add_count("nothing", 1, 2)  # no one listens
    assert not profile.counts


def test_finished_starts_are_not_repeated(tmp_path, monkeypatch):
    settings = SearchSettings(knots=1, starts=2, steps=2, max_failures=0)
    asked = (PadSettings(grid=1), PUBLISHED_CONTACT, settings, RulesSettings(enforce=False))
    monkeypatch.setattr("padforge.common.parallel.Checkpoints.clear", lambda self: None)
    with profiling.profiled() as profile:
        first = search(*asked, run=SearchOptions(keep_in=tmp_path / "search"))
    assert profile.counts["starts"] == [2, 2]
    heard = []
    resumed = SearchOptions(lambda *step: heard.append(step), keep_in=tmp_path / "search", resume=True)
    with profiling.profiled() as profile:
        again = search(*asked, run=resumed)
    assert not heard
    assert profile.counts["starts"] == [0, 2]
    np.testing.assert_array_equal(first.morphology.knots, again.morphology.knots)
