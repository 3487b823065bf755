"""How a benchmark is taken: trials, each some work and a judge of its result, timed in rounds.

The least time counts, since whatever disturbs a measurement only adds to it; and because disturbances last, the same
trial is timed again in later rounds, with other trials between, until its two best rounds agree. The pace of the
machine is told by a fixed piece of work that is timed before and after every trial: runs are compared by times divided
by the least of all paces, and, since one that is busy throughout never shows its best, by the pace beside the trial.
"""

import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

BenchListener = Callable[[str], None]
"""Hears what is being measured."""
TrialKey = tuple[str, str, float, int]
"""Case, way, size and repetition."""

BUDGET_S = 0.2
"""How long quick work is repeated in a round."""
QUICK_S = 1.0
"""Work that takes longer is done once a round."""
PLAIN_S = 0.1
"""Plain ways that take longer are left out of later rounds: nobody asks whether they have become slower."""
AGREE = 1.04
"""A trial is settled when the times of its two best rounds are within this ratio."""


@dataclass(frozen=True)
class BenchTrial:
    """One measurement to take.

    Attributes:
        case: what is computed. way: how. size: the way's own parameter (samples, steps; 0 if it has none).
        work: what is timed.
        judge: what is to be known of its result beside time: "error", which the figure's axis explains, "visited", the
            share of the scene that was looked at, and columns of the bench's own.
        items: by which the time is divided.
        repetition: tells trials apart that differ in a seed alone; tables show the median over them.
    """

    case: str
    way: str
    size: float
    work: Callable[[], Any]
    judge: Callable[[Any], Mapping[str, float | None]] = lambda result: {}
    items: int = 1
    repetition: int = 0

    @property
    def key(self) -> TrialKey:
        """What the trial is known by in every round and every run."""
        return self.case, self.way, self.size, self.repetition


@dataclass(frozen=True)
class Bench:
    """A benchmark.

    Attributes:
        name: of its files.
        trials: makes all trials anew, always the same ones, in order.
        error: what "error" means, with its unit.
        reference: (way, size) whose time counts as 1.
        best: (way, size) the package goes by, which summaries set beside the reference.
        plain: ways that are not the package's work, there for comparison; `--against` does not ask after them.
        prepare: compiles and imports what plain ways need, before the clock.
    """

    name: str
    trials: Callable[[], Iterator[BenchTrial]]
    error: str
    reference: tuple[str, float]
    best: tuple[str, float]
    plain: Collection[str]
    prepare: Callable[[], object] = lambda: None


@dataclass
class BenchRounds:
    """What the rounds of a benchmark have given so far.

    Attributes:
        found: of every trial, what its judge says.
        times: of every trial, seconds an item in each round that it was part of.
        paces: of every trial, those times divided by the time of the fixed piece of work beside them.
        pace_s: least time of the fixed piece of work, seconds.
    """

    found: dict[TrialKey, Mapping[str, Any]] = field(default_factory=dict)
    times: dict[TrialKey, list[float]] = field(default_factory=dict)
    paces: dict[TrialKey, list[float]] = field(default_factory=dict)
    pace_s: float = np.inf

    def settled(self, key: TrialKey) -> bool:
        """Whether another round would hardly tell more of a trial's time."""
        best, *rest = sorted(self.times[key])
        return bool(rest) and rest[0] < AGREE * best


def measure_round(bench: Bench, so_far: BenchRounds, report: BenchListener, again: Callable[[TrialKey], bool]) -> int:
    """Add one round to `so_far`: trials that are new to it are timed and judged, others timed where `again` says so.

    Slow plain ways are never timed again. Returns how many trials the round had.
    """
    if not so_far.times:
        bench.prepare()
    taken = 0
    for trial in bench.trials():
        known = so_far.times.get(trial.key)
        slow = known and trial.way in bench.plain and min(known) * trial.items > PLAIN_S
        if known and (slow or not again(trial.key)):
            continue
        report(f"{trial.case}, {trial.way}" + (f" {trial.size:g}" if trial.size else ""))
        before = _fixed_work()
        result, seconds, quick = _timed(trial.work)
        paces = [*before, *_fixed_work()]
        so_far.pace_s = min(so_far.pace_s, *paces)
        so_far.times.setdefault(trial.key, []).append(seconds / trial.items)
        beside = min(paces) if quick else float(np.median(paces))
        so_far.paces.setdefault(trial.key, []).append(seconds / trial.items / beside)
        if trial.key not in so_far.found:
            so_far.found[trial.key] = trial.judge(result)
        taken += 1
    return taken


def _timed(work: Callable[[], Any]) -> tuple[Any, float, bool]:
    """What `work` returns, its least time in seconds, and whether it is quick: then its first call only warms up."""
    result, first = _once(work)
    if first > QUICK_S:
        return result, first, False
    times: list[float] = []
    while not times or (sum(times) < BUDGET_S and len(times) < 1000):
        times.append(_once(work)[1])
    return result, min(times), len(times) > 1


def _once(work: Callable[[], Any]) -> tuple[Any, float]:
    """What `work` returns, and the seconds it took, less those that this thread waited for a core others had."""
    begin = time.perf_counter()
    waited = _waited_s()
    result = work()
    waited = _waited_s() - waited
    return result, time.perf_counter() - begin - waited


@cache
def _schedule() -> int | None:
    """File descriptor of what Linux tells of this thread's turns, or None elsewhere."""
    try:
        return os.open("/proc/thread-self/schedstat", os.O_RDONLY)
    except OSError:
        return None


def _waited_s() -> float:
    """Seconds this thread has been ready to run while other programs had the cores; 0 where nobody tells."""
    file = _schedule()
    return 0.0 if file is None else int(os.pread(file, 64, 0).split()[1]) * 1e-9


_NUMBERS = np.random.default_rng(0).random(20_000)


def _fixed_work() -> list[float]:
    """Seconds that a fixed piece of work takes, in numpy and in the interpreter, ten times: under a millisecond."""
    return [_once(lambda: (np.sort(_NUMBERS), sum(i * 0.5 for i in range(5000))))[1] for _ in range(10)]
