"""Measure benchmarks: trials, each some work and an evaluation of its result, timed in several rounds.

Disturbances only add to run time and last for a while. Hence the minimum over rounds counts, with other trials between.
The pace of the machine is the time of a fixed reference work, measured before and after every trial, so that two runs
can be compared by relative times. Results are written as JSON and work-precision figures.
"""

import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from padforge.common.command_line import text_table
from padforge.common.files import check_writable, provenance, read_json, write_json
from padforge.common.plotting import CURVES, FAINT, INK, add_title, save_figure, style_axes
from padforge.common.progress import OnProgress
from padforge.common.validation import InputError

ROUNDS = 3
MAX_RECHECKS = 5  # further rounds of trials that seem slower than in the earlier run
BUDGET_S = 0.2  # time for repetitions of short work in a round, s
LONG_S = 1.0  # work that takes longer is done once a round, s
MAX_BASELINE_S = 0.1
"""Baselines that take longer are measured in the first round only, since runs are not compared by them, s."""

FORMAT = "padforge-benches/1"  # format of bench.json; runs of earlier versions stay comparable, so keys must not change

Row = dict[str, Any]
"""A trial: "case", "way", "size", "repetition", "error", "seconds", "paces" and more."""
TrialKey = tuple[str, str, float, int]
Documents = Mapping[str, Mapping[str, Any]]  # results in bench.json by the name of the benchmark
KEY = ("case", "way", "size", "repetition")  # columns that identify a trial

SLOWER, LESS_ACCURATE = "slower", "less accurate"
MAX_RATIO = 1.25  # ratio beyond which a trial counts as worse
SHORT_S = 1e-3
"""The time of shorter work depends on memory layout: it counts as slower only if another trial of its way does."""
MIN_ERROR = 1e-15  # smaller errors, of rounding, count as equal


@dataclass(frozen=True)
class BenchTrial:
    """One measurement.

    `evaluate` returns the quality of the result of `work`: "error" in the unit of the bench, and columns of the bench.
    """

    case: str  # the problem
    way: str  # the method that solves it
    size: float  # parameter of the method, such as samples or steps; 0 if it has none
    work: Callable[[], Any]  # the timed function
    evaluate: Callable[[Any], Mapping[str, float | None]] = lambda result: {}
    items: int = 1  # number by which the time is divided
    repetition: int = 0  # number among trials that differ in the seed only; tables show medians

    @property
    def key(self) -> TrialKey:
        """Identity of the trial in every round and run."""
        return self.case, self.way, self.size, self.repetition


@dataclass(frozen=True)
class Bench:
    """A benchmark."""

    name: str
    trials: Callable[[], Iterator[BenchTrial]]  # all trials, in the same order every time
    error_label: str  # meaning of "error", with its unit
    reference: tuple[str, float]  # (way, size) to which speeds are relative
    default: tuple[str, float]  # (way, size) that the package uses
    baselines: Collection[str] = ()  # ways that are not the package's own; `--against` ignores them
    prepare: Callable[[], object] = lambda: None  # compiles and imports what baselines need, before anything is timed


class BenchRounds:
    """Measurements of a benchmark in all rounds so far."""

    def __init__(self) -> None:
        self.results: dict[TrialKey, Mapping[str, Any]] = {}  # evaluation of every trial
        self.seconds: defaultdict[TrialKey, list[float]] = defaultdict(list)  # per item, one a round
        self.paces: defaultdict[TrialKey, list[float]] = defaultdict(list)  # the same by the pace beside the trial
        self.pace_s = np.inf  # best pace of the machine


@dataclass(frozen=True)
class Worsening:
    """A trial that is worse than in an earlier run."""

    bench: str  # name of the benchmark
    key: TrialKey  # identity of the trial
    what: str  # SLOWER or LESS_ACCURATE
    before: float  # seconds per item, or error in the earlier run
    now: float  # the same in this run
    ratio: float  # now over before; for times, corrected for the pace of the machine

    def __str__(self) -> str:
        case, way, size, repetition = self.key
        trial = f"{self.bench}, {case}, {way}" + (f" {size:g}" if size else "") + f" #{repetition}" * bool(repetition)
        return f"{trial}: {self.what}, {self.ratio:.2f}x ({self.before:.3g} before, {self.now:.3g} now)"


def measure_round(
    bench: Bench, rounds: BenchRounds, on_progress: OnProgress, repeat: Callable[[TrialKey], bool]
) -> int:
    """Measure new trials, and again those to `repeat` except for slow baselines; return how many were measured."""
    if not rounds.seconds:
        bench.prepare()
    n_measured = 0
    for trial in bench.trials():
        earlier = rounds.seconds[trial.key]
        is_slow_baseline = earlier and trial.way in bench.baselines and min(earlier) * trial.items > MAX_BASELINE_S
        if earlier and (is_slow_baseline or not repeat(trial.key)):
            continue
        on_progress(0, 0, f"{trial.case}, {trial.way}" + (f" {trial.size:g}" if trial.size else ""))
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
    """Return the result, the minimum time in s, and whether the work was called only once or twice."""
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
    benches: Sequence[Bench], out: Path, on_progress: OnProgress, earlier: Documents
) -> tuple[dict[str, Any], list[Worsening]]:
    """Measure benchmarks, and write `bench.json` and a figure of each.

    Returns:
        The content of `bench.json`, and what is worse than in the `earlier` run; a slower trial is so in all rounds.
    """
    check_writable(out)
    rounds = {bench.name: BenchRounds() for bench in benches}
    documents: dict[str, dict[str, Any]] = {}

    def measure(bench: Bench, label: str, repeat: Callable[[TrialKey], bool]) -> None:
        measured = rounds[bench.name]
        report = lambda done, total, step: on_progress(done, total, f"{bench.name}, {label}, {step}")  # noqa: E731
        if measure_round(bench, measured, report, repeat):
            measured.pace_s = min(other.pace_s for other in rounds.values())
            documents[bench.name] = _to_document(bench, measured)
            figure = draw_times(bench.name, _medians(documents[bench.name]["rows"]), bench.error_label)
            save_figure(figure, out / f"{bench.name}.png")
            write_json(out / "bench.json", _to_content(documents))

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
    return _to_content(documents), find_worsenings(earlier, documents)


def _to_document(bench: Bench, rounds: BenchRounds) -> dict[str, Any]:
    """Return the results of a benchmark as plain data."""
    rows = [
        dict(zip(KEY, key, strict=True))
        | {"error": None, "seconds": min(rounds.seconds[key]), "paces": min(rounds.paces[key])}
        | dict(result)
        for key, result in rounds.results.items()
    ]
    return {
        "bench": bench.name,
        "reference": list(bench.reference),
        "best": list(bench.default),
        "plain": sorted(bench.baselines),
        "pace_s": rounds.pace_s,
        "rows": rows,
        "provenance": provenance(f"padforge bench {bench.name}", packages=("numba",)),
    }


def _to_content(documents: Documents) -> dict[str, Any]:
    """Return all results, with a summary of a row per case: the default way beside the reference."""
    summary: list[Row] = []
    for name, document in documents.items():
        medians = {_key(row)[:3]: row for row in _medians(document["rows"])}
        for case in dict.fromkeys(case for case, *_ in medians):
            default, reference = (medians.get((case, *document[which])) for which in ("best", "reference"))
            if default and reference:
                row = {"bench": name, "case": case, "reference": _way(*document["reference"])}
                row |= {f"reference_{column}": reference[column] for column in ("error", "seconds")}
                row |= {"way": _way(*document["best"]), "error": default["error"], "seconds": default["seconds"]}
                summary.append(row | {"speed": reference["seconds"] / default["seconds"]})
    return {"format": FORMAT, "summary": summary, "benches": dict(documents)}


def _medians(rows: Sequence[Row]) -> list[Row]:
    """Return a row per case, way and size, with medians over its repetitions."""
    groups: dict[TrialKey, list[Row]] = {}
    for row in rows:
        groups.setdefault((*_key(row)[:3], 0), []).append(row)
    medians = [dict(zip(KEY, key, strict=True)) for key in groups]
    for row, group in zip(medians, groups.values(), strict=True):
        for name in ("error", "seconds"):
            values = [trial[name] for trial in group if trial[name] is not None]
            row[name] = median(values) if values else None
    return medians


def _key(row: Row) -> TrialKey:
    return row["case"], row["way"], row["size"], row["repetition"]


def bench_lines(document: Mapping[str, Any]) -> list[str]:
    """Format a benchmark as a table of text."""
    rows, reference = _medians(document["rows"]), tuple(document["reference"])
    reference_s = {row["case"]: row["seconds"] for row in rows if (row["way"], row["size"]) == reference}
    cells = [["case", "way", "size", "error", "time", "speed"]]
    for row in rows:
        speed = f"{reference_s[row['case']] / row['seconds']:.2f}x" if row["case"] in reference_s else "-"
        quantities = f"{row['size']:g}", _error(row["error"]), _time(row["seconds"]), speed
        cells.append([row["case"], row["way"], *quantities])
    return [f"{document['bench']}: speed relative to {_way(*reference)}", "", *text_table(cells, (0, 1))]


def summary_lines(summary: Sequence[Row]) -> list[str]:
    """Format the summary as a table of text."""
    cells = [["bench", "case", "beside", "error", "time", "padforge", "error", "time", "speed"]]
    for row in summary:
        reference = row["reference"], _error(row["reference_error"]), _time(row["reference_seconds"])
        default = row["way"], _error(row["error"]), _time(row["seconds"]), f"{row['speed']:.3g}x"
        cells.append([row["bench"], row["case"], *reference, *default])
    return text_table(cells, (0, 1, 2, 5))


def _way(way: str, size: float) -> str:
    return f"{way} at {size:g}" if size else way


def _error(error: float | None) -> str:
    return "-" if error is None else f"{error:.1e}" if error < 1e-2 else f"{error:.3f}"


def _time(seconds: float) -> str:
    if seconds < 1e-3:
        return f"{1e6 * seconds:.1f} us"
    return f"{1e3 * seconds:.1f} ms" if seconds < 1 else f"{seconds:.2f} s"


def draw_times(name: str, medians: Sequence[Row], error_label: str) -> Figure:
    """Draw a work-precision diagram: error against run time, a panel per case, a curve per way."""
    rows = [row for row in medians if row["error"] is not None]
    scale, unit = (1e3, "ms") if min(row["seconds"] for row in rows) < 0.1 else (1, "s")
    cases = list(dict.fromkeys(row["case"] for row in rows))
    colours = dict(zip(dict.fromkeys(row["way"] for row in rows), cycle(CURVES), strict=False))
    figure = Figure(figsize=(4 * len(cases), 3.8), layout="constrained")
    panels = figure.subplots(1, len(cases), sharey=True, squeeze=False)[0]
    handles: dict[str, Any] = {}
    for axes, case in zip(panels, cases, strict=True):
        for way, colour in colours.items():
            group = [row for row in rows if (row["case"], row["way"]) == (case, way)]
            if group:
                times, errors = [scale * row["seconds"] for row in group], [max(row["error"], 1e-16) for row in group]
                marker, size = ("o-", 4) if len(group) > 1 else ("D", 8)
                (handles[way],) = axes.loglog(times, errors, marker, color=colour, markersize=size, linewidth=1.4)
        axes.set_title(case, loc="left", color=INK)
        axes.set_xlabel(f"run time ({unit})")
        for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())
        axes.grid(color=FAINT, linewidth=0.6)
        style_axes(axes)
    panels[0].set_ylabel(error_label)
    panels[-1].legend(list(handles.values()), list(handles), frameon=False)
    add_title(figure, f"{name}: error against run time")
    return figure


def read_earlier(path: Path) -> Documents:
    """Read the results of an earlier run from its `bench.json`."""
    content = read_json(path, FORMAT)
    try:
        documents = {document["bench"]: document for document in content["benches"].values()}
        find_worsenings(documents, documents)  # reads everything that a comparison reads
    except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: not as padforge bench writes it ({error!r})") from error
    return documents


def find_worsenings(before: Documents, now: Documents) -> list[Worsening]:
    """Return the trials of the package's own ways that are worse than before, the worst of each benchmark first."""
    worsenings: list[Worsening] = []
    for name in [name for name in now if name in before]:
        pace = before[name]["pace_s"] / now[name]["pace_s"]  # above 1 if the machine is faster now
        worse: list[Worsening] = []
        for key, (old, new) in _common_trials(before[name], now[name]).items():
            # a machine that is busy all the time never shows its best pace: the pace beside the trial counts as well
            slowdown = min(pace * new["seconds"] / old["seconds"], new["paces"] / old["paces"])
            changes = [(SLOWER, "seconds", slowdown)]
            if old["error"] is not None and new["error"] is not None:
                changes.append((LESS_ACCURATE, "error", max(new["error"], MIN_ERROR) / max(old["error"], MIN_ERROR)))
            for what, column, ratio in changes:
                if not ratio <= MAX_RATIO:  # also NaN
                    worse.append(Worsening(now[name]["bench"], key, what, old[column], new[column], ratio))
        slower_ways = [change.key[1] for change in worse if change.what == SLOWER]
        certain = [w for w in worse if w.what != SLOWER or w.before >= SHORT_S or slower_ways.count(w.key[1]) > 1]
        worsenings += sorted(certain, key=lambda change: -change.ratio)
    return worsenings


def _common_trials(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[TrialKey, tuple[Row, Row]]:
    """Return the rows of the trials of the package's own ways that both documents have."""
    old, new = ({_key(row): row for row in document["rows"]} for document in (before, now))
    return {key: (old[key], new[key]) for key in new if key in old and key[1] not in now["plain"]}


def comparison_lines(changes: Sequence[Worsening], before: Documents, now: Documents) -> list[str]:
    """Format the comparison of two runs, and what is worse, as text."""
    n_trials = sum(len(_common_trials(before[name], now[name])) for name in before.keys() & now.keys())
    if not changes:
        return [f"{n_trials} trials compared: none is slower or less accurate"]
    return [f"{n_trials} trials compared; worse than before:", *(f"  {change}" for change in changes)]
