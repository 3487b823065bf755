"""Taking benchmarks: rounds, files, the summary, and the comparison with an earlier run. No times are asserted."""

import csv
import json

import pytest

from padforge.benchmarks import harness, suite, table
from padforge.benchmarks.comparison import read_earlier, worsenings
from padforge.benchmarks.harness import Bench, BenchRounds, BenchTrial, measure_round
from padforge.benchmarks.suite import run_benches
from padforge.benchmarks.table import bench_lines
from padforge.design.common.validation import InputError


def bench(error=0.1, work=lambda: None, name="x"):
    def trials():
        for case in ("a", "b"):
            yield BenchTrial(case, "plain", 7, lambda: None, lambda found: {"error": 0.5, "visited": 1.0})
            yield BenchTrial(case, "ours", 0, work, lambda found: {"error": error, "visited": 0.25})

    return Bench(name, trials, "error (mm)", ("plain", 7), ("ours", 0), plain=("plain",))


def document(seconds=1.0, error=0.1, visited=0.25, pace=1e-3, way="ours"):
    row = {"case": "a", "way": way, "size": 0, "repetition": 0}
    row |= {"error": error, "seconds": seconds, "paces": seconds / pace, "visited": visited, "speed": 1.0}
    return {"bench": "x", "plain": ["plain"], "pace_s": pace, "rows": [row]}


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(harness, "BUDGET_S", 0)
    monkeypatch.setattr(suite.time, "sleep", lambda seconds: None)


def test_a_later_round_times_what_it_is_asked_to_an_item_and_judges_once(monkeypatch):
    judged, so_far = [], BenchRounds()
    trial = BenchTrial("a", "ours", 3, lambda: 42, lambda found: judged.append(found) or {"error": 1.0}, items=2)
    one = Bench("x", lambda: iter([trial]), "error", ("ours", 3), ("ours", 3), plain=())
    now = iter([0.0, 0.01] * 1000)
    monkeypatch.setattr(harness.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(harness, "_waited_s", lambda: 0.0)
    for again, taken in ((False, 1), (False, 0), (True, 1)):
        assert measure_round(one, so_far, lambda step: None, lambda key, again=again: again) == taken
    assert judged == [42]
    assert so_far.times[trial.key] == pytest.approx([0.005] * 2)


def test_files_hold_what_was_measured_which_nothing_is_where_none_can_be_written(tmp_path):
    heard = []
    summary, changes = run_benches([bench()], tmp_path, heard.append, {})
    assert heard
    assert not changes
    assert {path.name for path in tmp_path.iterdir()} == {"x.json", "x.csv", "x.png", "bench.json", "bench.csv"}
    assert json.loads((tmp_path / "bench.json").read_text()) == summary
    made = summary["benches"]["x"]
    assert json.loads((tmp_path / "x.json").read_text()) == made
    assert [(row["case"], row["way"]) for row in made["rows"]] == [
        *(("a", "plain"), ("a", "ours"), ("b", "plain"), ("b", "ours"))
    ]
    assert [row["speed"] for row in made["rows"][::2]] == [1, 1]
    assert b"\r" not in (tmp_path / "x.csv").read_bytes()
    with (tmp_path / "x.csv").open() as file:
        assert [row["error"] for row in csv.DictReader(file)] == ["0.5", "0.1"] * 2
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")
    assert len(bench_lines(made)) == len(made["rows"]) + 3
    assert [(row["case"], row["reference_error"], row["error"]) for row in summary["summary"]] == [
        *(("a", 0.5, 0.1), ("b", 0.5, 0.1))
    ]
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file/out: cannot be written"):
        run_benches([bench(work=lambda: pytest.fail("measured"))], tmp_path / "file" / "out", lambda step: None, {})


@pytest.mark.parametrize(
    ("before", "now", "what"),
    [
        ({}, {"seconds": 1.3}, ["slower"]),
        ({}, {"seconds": 1.24}, []),
        ({}, {"seconds": 0.5}, []),
        ({}, {"seconds": 1.3, "pace": 1.3e-3}, []),  # the machine is slower
        ({}, {"seconds": 1.0, "pace": 0.7e-3}, ["slower"]),  # the machine is faster
        ({}, {"error": 1.0}, ["less accurate"]),
        ({}, {"error": 0.11}, []),
        ({}, {"error": float("nan")}, ["less accurate"]),
        ({}, {"visited": 0.5}, ["looks at more"]),
        ({}, {"seconds": 2.0, "error": 1.0}, ["less accurate", "slower"]),
        ({}, {"seconds": 3.0, "way": "new"}, []),
        ({"way": "plain"}, {"seconds": 3.0, "way": "plain"}, []),
        ({"seconds": 0.01}, {"seconds": 0.0121}, ["slower"]),  # quick work is from a smaller ratio on
        ({"seconds": 0.01}, {"seconds": 0.0119}, []),
        ({"error": 1e-17}, {"error": 9e-16}, []),  # of rounding
        ({"error": 0.0}, {"error": 1e-14}, ["less accurate"]),
    ],
)
def test_what_has_become_worse_is_found(before, now, what):
    assert [change.what for change in worsenings(document(**before), document(**now))] == what


def test_work_that_has_become_slower_and_worse_is_found(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "save_figure", lambda figure, path: None)

    def work(times):
        return lambda: sum(i * i for i in range(times * 5000))

    before, _ = run_benches([bench(work=work(1))], tmp_path / "a", lambda step: None, {})
    earlier = read_earlier(tmp_path / "a" / "bench.json")
    assert earlier == before["benches"] == read_earlier(tmp_path / "a" / "x.json")
    _, changes = run_benches([bench(1.0, work(4))], tmp_path / "b", lambda step: None, earlier)
    found = {(change.what, change.key[0]) for change in changes}
    assert found == {(what, case) for what in ("slower", "less accurate") for case in "ab"}


@pytest.mark.parametrize(
    "text",
    [
        *("", "[]", "{}", '{"format": "padforge-benches/1"}', '{"format": "padforge-benches/1", "benches": 3}'),
        *('{"format": "padforge-bench/1"}', '{"format": "padforge-benches/1", "benches": {"contact": {"rows": [1]}}}'),
    ],
)
def test_a_file_that_is_no_earlier_run_is_refused(tmp_path, text):
    (tmp_path / "bench.json").write_text(text)
    with pytest.raises(InputError, match=r"bench\.json"):
        read_earlier(tmp_path / "bench.json")
