import json

import pytest

from padforge.benchmarks import harness
from padforge.common.progress import ignore_progress
from padforge.common.validation import InputError
from tests.helpers.less import blank_pictures


def bench(error=0.1, work=lambda: None, name="x"):
    def trials():
        for case in ("a", "b"):
            yield harness.BenchTrial(case, "plain", 7, lambda: None, lambda result: {"error": 0.5})
            yield harness.BenchTrial(case, "ours", 0, work, lambda result: {"error": error})

    return harness.Bench(name, trials, "error (mm)", ("plain", 7), ("ours", 0), baselines=("plain",))


def document(seconds=1.0, error=0.1, pace=1e-3, way="ours"):
    row = {"case": "a", "way": way, "size": 0, "repetition": 0}
    row |= {"error": error, "seconds": seconds, "paces": seconds / pace, "speed": 1.0}
    return {"bench": "x", "plain": ["plain"], "pace_s": pace, "rows": [row]}


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    monkeypatch.setattr(harness.time, "sleep", lambda seconds: None)
    blank_pictures(monkeypatch)


def test_measure_round_repeats_requested_trials_and_evaluates_once(monkeypatch):
    evaluated, rounds = [], harness.BenchRounds()

    def evaluate(result):
        evaluated.append(result)
        return {"error": 1.0}

    trial = harness.BenchTrial("a", "ours", 3, lambda: 42, evaluate, items=2)
    one = harness.Bench("x", lambda: iter([trial]), "error", ("ours", 3), ("ours", 3))
    now = iter([0.0, 0.01] * 1000)
    monkeypatch.setattr(harness.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(harness, "_waited_s", lambda: 0.0)
    for repeat, n_measured in ((False, 1), (False, 0), (True, 1)):
        assert harness.measure_round(one, rounds, ignore_progress, lambda key, repeat=repeat: repeat) == n_measured
    assert evaluated == [42]
    assert rounds.seconds[trial.key] == pytest.approx([0.005] * 2)


def test_run_benches_writes_measurements(tmp_path):
    steps = []
    summary, changes = harness.run_benches([bench()], tmp_path, lambda *step: steps.append(step[2]), {})
    assert steps
    assert not changes
    assert {path.name for path in tmp_path.iterdir()} == {"x.png", "bench.json"}
    assert json.loads((tmp_path / "bench.json").read_text()) == summary
    assert harness.read_earlier(tmp_path / "bench.json") == summary["benches"]
    written = summary["benches"]["x"]
    rows = [(row["case"], row["way"], row["error"]) for row in written["rows"]]
    assert rows == [(case, way, error) for case in "ab" for way, error in (("plain", 0.5), ("ours", 0.1))]
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert len(harness.bench_lines(written)) == len(written["rows"]) + 3
    rows = [(row["case"], row["reference_error"], row["error"]) for row in summary["summary"]]
    assert rows == [("a", 0.5, 0.1), ("b", 0.5, 0.1)]


def test_run_benches_refuses_an_unwritable_folder_before_measuring(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file/out: cannot be written"):
        harness.run_benches([bench(work=pytest.fail)], tmp_path / "file" / "out", ignore_progress, {})


@pytest.mark.parametrize(
    ("before", "now", "what"),
    [
        ({}, {"seconds": 1.3}, ["slower"]),
        ({}, {"seconds": 1.24}, []),
        ({}, {"seconds": 1.3, "pace": 1.3e-3}, []),  # the machine is slower
        ({}, {"seconds": 1.0, "pace": 0.7e-3}, ["slower"]),  # the machine is faster
        ({}, {"error": float("nan")}, ["less accurate"]),
        ({"way": "plain"}, {"seconds": 3.0, "way": "plain"}, []),
        ({"seconds": 1e-4}, {"seconds": 3e-4}, []),  # no other trial of this way is slower
        ({"error": 1e-17}, {"error": 9e-16}, []),  # rounding
    ],
)
def test_find_worsenings_reports_worse_trials(before, now, what):
    benches = {"x": document(**before)}, {"x": document(**now)}
    changes = harness.find_worsenings(*benches)
    assert [change.what for change in changes] == what
    lines = harness.comparison_lines(changes, *benches)
    if what:
        assert (lines[0], len(lines)) == ("1 trials compared; worse than before:", 1 + len(what))


def test_read_earlier_refuses_other_files(tmp_path):
    for benches in ("", "3", '{"contact": {"rows": [1]}}'):
        (tmp_path / "bench.json").write_text(f'{{"format": "padforge-benches/1", "benches": {benches}}}')
        with pytest.raises(InputError, match=r"bench\.json"):
            harness.read_earlier(tmp_path / "bench.json")
