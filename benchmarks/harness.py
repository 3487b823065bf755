"""Measure benchmarks: trials, each some work and an evaluation of its result, timed in several rounds.

Disturbances only add to run time and last for a while. Hence the minimum over rounds counts, with other trials between.
The pace of the machine is the time of a fixed reference work, measured before and after every trial, so that two runs
can be compared by relative times.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from padforge.benchmarks.results import SLOWER, TrialKey, Worsening, find_worsenings, write_bench, write_summary
from padforge.design.common.files import check_writable

ROUNDS = 3
MAX_RECHECKS = 5
"""Further rounds of trials that seem slower than in the earlier run."""
BUDGET_S = 0.2
"""Time for repetitions of short work in a round, s."""
LONG_S = 1.0
"""Work that takes longer is done once a round, s."""
MAX_BASELINE_S = 0.1
"""Baselines that take longer are measured in the first round only, s: their run time is not compared between runs."""


@dataclass(frozen=True)
class BenchTrial:
    """One measurement.

    Attributes:
        case: the problem.
        way: the method that solves it.
        size: parameter of the method, such as samples or steps; 0 if it has none.
        work: the timed function.
        evaluate: returns the quality of its result: "error" in the unit of the bench, "visited", the share of the
            scene that was computed, and columns of the bench.
        items: number by which the time is divided.
        repetition: number among trials that differ in the seed only; tables show medians.
    """

    case: str
    way: str
    size: float
    work: Callable[[], Any]
    evaluate: Callable[[Any], Mapping[str, float | None]] = lambda result: {}
    items: int = 1
    repetition: int = 0

    @property
    def key(self) -> TrialKey:
        """Identity of the trial in every round and run."""
        return self.case, self.way, self.size, self.repetition


@dataclass(frozen=True)
class Bench:
    """A benchmark.

    Attributes:
        name: name of its files.
        trials: yields all trials, in the same order every time.
        error_label: meaning of "error", with its unit.
        reference: (way, size) to which speeds are relative.
        default: (way, size) that the package uses.
        baselines: ways that are not the package's own; `--against` ignores them.
        prepare: compiles and imports what baselines need, before anything is timed.
    """

    name: str
    trials: Callable[[], Iterator[BenchTrial]]
    error_label: str
    reference: tuple[str, float]
    default: tuple[str, float]
    baselines: Collection[str] = ()
    prepare: Callable[[], object] = lambda: None


class BenchRounds:
    """Measurements of a benchmark in all rounds so far."""

    def __init__(self) -> None:
        self.results: dict[TrialKey, Mapping[str, Any]] = {}  # evaluation of every trial
        self.seconds: defaultdict[TrialKey, list[float]] = defaultdict(list)  # per item, one a round
        self.paces: defaultdict[TrialKey, list[float]] = defaultdict(list)  # the same by the pace beside the trial
        self.pace_s = np.inf  # best pace of the machine


def measure_round(
    bench: Bench, rounds: BenchRounds, on_progress: Callable[[str], None], repeat: Callable[[TrialKey], bool]
) -> int:
    """Measure new trials, repeat others, and return how many were measured.

    Args:
        bench: the benchmark.
        rounds: measurements so far, to which this round is added.
        on_progress: receives the name of every trial.
        repeat: whether to repeat a trial; slow baselines are never repeated.
    """
    if not rounds.seconds:
        bench.prepare()
    n_measured = 0
    for trial in bench.trials():
        earlier = rounds.seconds[trial.key]
        is_slow_baseline = earlier and trial.way in bench.baselines and min(earlier) * trial.items > MAX_BASELINE_S
        if earlier and (is_slow_baseline or not repeat(trial.key)):
            continue
        on_progress(f"{trial.case}, {trial.way}" + (f" {trial.size:g}" if trial.size else ""))
        paces = _measure_pace()
        result, seconds, is_long = _measure(trial.work)
        paces += _measure_pace()
        rounds.pace_s = min(rounds.pace_s, *paces)
        earlier.append(seconds / trial.items)
        # short work meets a quiet moment, as the best pace does; long work an average one
        pace = float(np.median(paces)) if is_long else min(paces)
        rounds.paces[trial.key].append(seconds / trial.items / pace)
        if trial.key not in rounds.results:
            rounds.results[trial.key] = trial.evaluate(result)
        n_measured += 1
    return n_measured


def _measure(work: Callable[[], Any]) -> tuple[Any, float, bool]:
    """Return the result, the least time in s, and whether it was measured once or twice only."""
    result, first = _timed_call(work)
    if first > LONG_S:
        return result, first, True
    times: list[float] = []  # without the first call, which warms up
    while not times or (sum(times) < BUDGET_S and len(times) < 1000):
        times.append(_timed_call(work)[1])
    return result, min(times), len(times) == 1


def _timed_call(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result and the time in s, less the time that this thread waited for a core."""
    waited, begin = _waited_s(), time.perf_counter()
    result = work()
    seconds = time.perf_counter() - begin
    return result, seconds - min(_waited_s() - waited, seconds / 2)


def _waited_s() -> float:
    """Return how long this thread has been runnable while other programs had the cores, s; 0 except on Linux."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
    except OSError:
        return 0.0


_NUMBERS = np.random.default_rng(0).random(20_000)


def _measure_pace() -> list[float]:
    """Return ten times in s of the reference work, in NumPy and in the interpreter: less than 1 ms each."""
    return [_timed_call(lambda: (np.sort(_NUMBERS), sum(i * 0.5 for i in range(5000))))[1] for _ in range(10)]


def run_benches(
    benches: Sequence[Bench], out: Path, on_progress: Callable[[str], None], earlier: Mapping[str, Mapping[str, Any]]
) -> tuple[dict[str, Any], list[Worsening]]:
    """Measure benchmarks, write the files of each, and `bench.json` and `bench.csv` with the summary.

    Args:
        benches: benchmarks to measure.
        out: folder of the files; InputError if it is not writable.
        on_progress: receives what is being measured.
        earlier: documents of an earlier run by name of the bench, to compare with; may be empty.

    Returns:
        The content of `bench.json`, and what is worse than in the earlier run, or slower in all rounds.
    """
    check_writable(out)
    rounds = {bench.name: BenchRounds() for bench in benches}
    documents: dict[str, dict[str, Any]] = {}

    def measure(bench: Bench, label: str, repeat: Callable[[TrialKey], bool]) -> None:
        measured = rounds[bench.name]
        if measure_round(bench, measured, lambda step: on_progress(f"{bench.name}, {label}, {step}"), repeat):
            measured.pace_s = min(other.pace_s for other in rounds.values())
            documents[bench.name] = write_bench(bench, measured, out)

    def slower_trials() -> set[tuple[str, TrialKey]]:
        return {(change.bench, change.key) for change in find_worsenings(earlier, documents) if change.what == SLOWER}

    for number in range(ROUNDS):
        for bench in benches:
            measure(bench, f"round {number + 1}", lambda key: True)
    for number in range(MAX_RECHECKS):
        time.sleep(number if slower_trials() else 0)  # a disturbance may take a while
        for bench in benches:
            if slower := {key for name, key in slower_trials() if name == bench.name}:
                measure(bench, "recheck", slower.__contains__)
    return write_summary(documents, out), find_worsenings(earlier, documents)
