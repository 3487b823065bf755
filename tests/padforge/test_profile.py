"""What `--profile` tells: counters of what was skipped, held exactly; of times, only how they add up."""

import json
import sys
import threading
from importlib.machinery import PathFinder

import numpy as np
import pytest

from padforge.common import profiling
from padforge.design import Morphology, signals
from padforge.design.optimize.search import SearchOptions, search
from padforge.design.settings import PUBLISHED_CONTACT, PadSettings, RulesSettings, SearchSettings
from padforge.fabricate import build
from tests.helpers.door import called
from tests.helpers.less import blank_pictures


@pytest.fixture
def clock(monkeypatch):
    """Time that goes only when a test says so."""
    now = [0.0]
    monkeypatch.setattr(profiling.time, "perf_counter", lambda: now[0])

    def passes(seconds):
        now[0] += seconds

    return passes


def test_stage_time_excludes_nested_stages(clock):
    with profiling.profiled() as profile:
        clock(1)
        with profiling.stage("outer"):
            clock(2)
            with profiling.stage("inner"):
                clock(4)
            clock(8)
        with profiling.stage("inner"):
            clock(16)
    assert profile.seconds == {"elsewhere": 1, "outer": 10, "inner": 20}
    assert profile.lines()[:4] == [
        "where 31.00 s went",
        f"  {'inner':<24} {20:8.2f} s {20 / 31:6.1%}",
        f"  {'outer':<24} {10:8.2f} s {10 / 31:6.1%}",
        f"  {'elsewhere':<24} {1:8.2f} s {1 / 31:6.1%}",
    ]


def test_stages_of_other_threads_count_for_main_thread(clock):
    def work():
        with profiling.stage("aside"):
            clock(3)

    with profiling.profiled() as profile, profiling.stage("main"):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert "aside" not in profile.seconds
    assert profile.seconds["main"] == 3


def test_failing_stage_ends_profile():
    finders = list(sys.meta_path)
    with pytest.raises(ValueError, match="on purpose"), profiling.profiled() as profile, profiling.stage("failing"):
        raise ValueError("on purpose")
    assert "failing" in profile.seconds
    assert sys.meta_path == finders
    assert not profiling.is_profiling()
    profiling.add_count("nothing", 1, 2)  # no one listens
    assert not profile.counts


def test_import_of_heavy_library_is_a_stage(clock, monkeypatch, tmp_path):
    (tmp_path / "weighty.py").write_text("import passing\npassing.passes(5)\n")
    (tmp_path / "passing.py").write_text("passes = None\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(profiling, "HEAVY", ("weighty", "absent"))
    monkeypatch.delitem(sys.modules, "weighty", raising=False)
    import passing  # pyright: ignore[reportMissingImports]

    passing.passes = clock
    with profiling.profiled() as profile:
        import weighty  # pyright: ignore[reportMissingImports]
    assert profile.seconds["import weighty"] == 5
    assert type(weighty.__loader__) is type(PathFinder.find_spec("passing").loader)  # pyright: ignore
    assert profile.lines()[-1] == f"  {'imports':<24} 1 of 2: absent (not weighty)"
    del sys.modules["weighty"], sys.modules["passing"]


def test_press_visits_only_fibres_in_reach():
    presses = [[1, 1], [2.5, 3.0], [0.7, 2.5]]  # reaching 1 + 1, 2 + 1 and 1 + 2 of 4 + 4 fibres
    with profiling.profiled() as profile:
        signals(Morphology.straight(4), presses, PUBLISHED_CONTACT)
    assert profile.counts == {"fibres, press by press": [8, 24], "spans, press by press": [8, 24]}


def test_press_visits_only_spans_below_it():
    knots = Morphology.straight(2).knots
    line = np.linspace(0, 3, 7)
    wavy = np.empty((4, 7, 2))
    for fibre in range(4):
        wavy[fibre, :, fibre // 2] = line
        wavy[fibre, :, 1 - fibre // 2] = knots[fibre, 0, 1 - fibre // 2]
    with profiling.profiled() as profile:
        signals(Morphology(wavy), [[1.25, 1.0]], PUBLISHED_CONTACT)
    # reach 0.6: along fibre 0 over 0.65..1.85, so 3 of 6 spans; across, 1.0 is within 0.4..1.6 of both vertical fibres'
    # 1.25 only for the first one, along which 0.4..1.6 has 4
    assert profile.counts["spans, press by press"] == [3 + 4, 4 * 6]
    assert profile.counts["fibres, press by press"] == [2, 4]


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


def test_only_requested_formats_are_written(tmp_path):
    with profiling.profiled() as profile:
        build(Morphology.straight(1), tmp_path, ("svg", "dxf"))
    assert profile.counts["formats"] == [2, 7]
    assert {"write tracks.svg", "write tracks.dxf"} <= set(profile.seconds)
    assert not {"CAD solid", "write mould.stl"} & set(profile.seconds)


def test_profile_option_prints_to_stderr(tmp_path, monkeypatch):
    blank_pictures(monkeypatch)
    search = "[search]\nknots = 1\nstarts = 1\nsteps = 2\nmax_failures = 0\n"
    (tmp_path / "pad.toml").write_text(f"[pad]\ngrid = 1\n{search}")
    ended = called("design", "--profile", "--json", cwd=tmp_path)
    assert ended.code in (0, 1), ended
    assert json.loads(ended.out)["format"] == "padforge-design/1"
    told = dict(line.split(maxsplit=1) for line in ended.err.splitlines() if line.startswith("  "))
    assert told["starts"] == "0 of 1"
    assert all(name in told["imports"] for name in ("build123d", "manifold3d", "pymoo", "h5py", "torch", "trimesh"))
    assert "numba" not in told["imports"].split(" (not ")[0]
