"""Search for a pad from many starts: settings in, the best morphology with its scores and its history out.

Each start is a chain of slices from one plain state to the next. Slices run on any executor of the
`concurrent.futures` kind, here or on a cluster; between them a start can be logged, saved or stopped, and none of that
changes what it finds.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.common import profiling
from padforge.common.parallel import Checkpoints, State, run_tasks
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import or_default
from padforge.common.validation import InputError, check_float, check_path, check_type, short_repr
from padforge.design.contact_comparison import errors_by_contact
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.expected_error import straight_full_scale
from padforge.design.objectives.rules import Violation
from padforge.design.objectives.score import ScoredPad, terms_of
from padforge.design.optimize.gradient import HISTORY_STEPS, GradientSearch, is_strict
from padforge.design.optimize.problem import SearchProblem, build_problem
from padforge.design.paths.keep_outs import straight_paths
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, SearchSettings
from padforge.design.twin import Twin

if TYPE_CHECKING:
    from padforge.common.settings import Spec
    from padforge.design.optimize.genetic import GeneticSearch

SLICE = {"descent": 20, "genetic": 2}
"""Steps or generations of a slice: about a third of a second."""
SLICE_S = 1.0
"""After which a slice ends where steps are slow, so that a time budget holds."""
MIN_STARTS, COMPARED = 2, 30
"""Half-way only the better half of the starts goes on, MIN_STARTS or more, by the geometric mean of the last COMPARED
entries of their histories: over fewer steps, what is random in each outweighs how starts differ.
"""
REPAIR_SHARE = 0.15
"""Share of a time budget reserved for repair."""
REPAIR_S = 3.0
"""Of repair after Ctrl-C."""
GRACE_S = 10.0
"""After a deadline, for running slices: one takes a second or so, but an executor may hang."""
MAX_SECONDS = 1e9
"""Longest time budget: some thirty years."""
LAYOUT_KEYS = ("grid", "horizontals", "verticals", "pitch_mm", "size_mm")
"""Keys of `[pad]` that say where fibres end."""
TOLERANCE = 1.03
"""Ratio of errors, to the better of the default pad and straight fibres, that counts as equal: expected errors are no
more certain."""
BUDGET_SHARES = {"default": 0.35, "twin": 0.4, "from default": 0.2}
"""Of a time budget, by search for the next pad of a twin."""


@dataclass(frozen=True)
class SearchOptions:
    """How a search is run; the result does not depend on it, unless it is cut short.

    Attributes:
        on_progress: called with each start's progress, in the caller's thread: steps done, in all, and in words its
            objective and the best of all so far, such as "start 2: objective 0.1234, best 0.1111".
        keep_in: folder for the states of the starts; `Checkpoints.clear` removes them once the result is saved.
        resume: whether to go on from the states in `keep_in`.
        time_budget: seconds after which the search ends with the best so far; None for no end.
        executor: of the `concurrent.futures` kind, for slices of the starts; the threads of this machine if None.
    """

    on_progress: OnProgress = ignore_progress
    keep_in: Path | None = None
    resume: bool = False
    time_budget: float | None = None
    executor: Executor | None = None

    def __post_init__(self) -> None:
        if not callable(self.on_progress):
            raise InputError(f"on_progress is {short_repr(self.on_progress)}, expected a function")
        if self.keep_in is not None:
            object.__setattr__(self, "keep_in", check_path("keep_in", self.keep_in))
        check_type("resume", self.resume, bool)
        if self.time_budget is not None:
            object.__setattr__(self, "time_budget", check_float("time_budget", self.time_budget, 0, MAX_SECONDS))
        if self.executor is not None:
            check_type("executor", self.executor, Executor)


@dataclass(frozen=True)
class SearchResult:
    """The best candidate of a search.

    Attributes:
        morphology: the best pad: fewest broken rules first, then least objective. Straight fibres are a candidate, but
            for the published method.
        terms: every term of `score` for it.
        violations: the rules it breaks; empty where rules are not enforced.
        candidate: its origin: "start 2", "genetic", "straight fibres", or "origin", the pad to start from.
        straight: expected errors and ambiguities of straight fibres on the same pad, by name, for comparison.
        history: one entry per logged step: {"run", "step", "objective"}.
        enforced: whether rules were enforced.
        seconds: wall time.
        stopped: why it ended early with the best so far: "interrupted", "out of time", or "" if it did not.
    """

    morphology: Morphology
    terms: dict[str, float]
    violations: list[Violation]
    candidate: str
    straight: dict[str, float]
    enforced: bool = True
    history: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0
    stopped: str = ""


def search(
    pad: PadSettings | None = None,
    contact: Contact | None = None,
    settings: SearchSettings | None = None,
    rules: RulesSettings | None = None,
    *,
    origin: Morphology | None = None,
    run: SearchOptions | None = None,
) -> SearchResult:
    """Find the fibres of a pad by the method that `settings` names; None stands for the defaults of `pad.toml`.

    The same settings give the same morphology, wherever the starts run and however often they are interrupted and
    resumed; only a time budget or Ctrl-C that cuts a search short changes the result.

    Args:
        pad: settings of the pad.
        contact: what a press does to a fibre; the default layer, or the published one by the published method, if None.
        settings: how to search.
        rules: the limits.
        origin: morphology to start from, of the pad's layout, of at most `settings.knots` knots; random if None.
        run: callbacks, checkpoints, time budget and executor; on this machine to its end if None.

    Raises:
        InputError: an origin that does not fit, or states of other settings.
    """
    begin = time.perf_counter()
    pad, settings = or_default("pad", pad, PadSettings), or_default("settings", settings, SearchSettings)
    contact = or_default("contact", contact, Contact, settings.default_contact)
    problem = build_problem(pad, contact, settings, or_default("rules", rules, RulesSettings), origin)
    run = SearchOptions() if run is None else check_type("run", run, SearchOptions)
    checkpoints = Checkpoints(run.keep_in, problem.settings()) if run.keep_in else None
    states = checkpoints.begin(run.resume) if checkpoints else {}
    stop = Stop(begin, run.time_budget)
    finished = sum(bool(state["done"]) for state in states.values())
    profiling.add_count("starts", len(problem.starts) - finished, len(problem.starts))
    with profiling.stage("search"), stop_on_interrupt(stop):
        _ = problem.straight_errors  # kept with the problem, else every slice on a cluster computes them
        starts, half_way = [*problem.starts], problem.steps // 2 // HISTORY_STEPS * HISTORY_STEPS
        if len(starts) > MIN_STARTS and half_way:
            _advance(problem, starts, half_way, states, stop, run, checkpoints)
            starts = starts if stop else better_half({start: states[start]["history"] for start in starts}, half_way)
        _advance(problem, starts, problem.steps, states, stop, run, checkpoints)
        pads = _finish_starts(problem, {start: states[start] for start in starts if start in states}, stop)
    with profiling.stage("check and score"):
        straight = Candidate("straight fibres", _straight_pad(problem, stop), problem)
        candidates = [Candidate(name, morphology, problem) for name, morphology in pads]
        if origin is not None:
            candidates.append(Candidate("origin", origin, problem))
        if problem.search.method != "genetic":  # the published method is left as it was published
            candidates.append(straight)
        best = min(candidates, key=lambda c: (len(c.violations), c.objective))  # fewest broken rules first
        result = best.to_result(straight)
    history = [
        {"run": _name(problem, start), "step": int(step), "objective": value}
        for start, state in sorted(states.items())
        for step, value in state["history"].tolist()
    ]
    return replace(result, history=history, seconds=time.perf_counter() - begin, stopped=stop.reason)


@dataclass(frozen=True)
class Candidate:
    """A pad that a search may return as a solution of `problem`; its name is that of `SearchResult.candidate`."""

    name: str
    pad: Morphology
    problem: SearchProblem

    @cached_property
    def violations(self) -> list[Violation]:
        """The rules that it breaks."""
        return self.problem.violations(self.pad)

    @cached_property
    def objective(self) -> float:
        """What the search minimises."""
        return self.problem.objective(self.pad)

    @cached_property
    def scored(self) -> ScoredPad:
        """Its scores under the main contact."""
        return self.problem.scored(self.pad)

    def to_result(self, straight: "Candidate") -> SearchResult:
        """Return the result of a search that ends with it."""
        terms = self.scored.terms(terms_of(self.problem.contacts[0]))
        beside = straight.scored.terms(("expected_error_mm", "ambiguity_mm"))
        return SearchResult(self.pad, terms, self.violations, self.name, beside, self.problem.rules.enforce)


class Stop:
    """Whether to stop: after Ctrl-C, or a deadline of `time.perf_counter`."""

    def __init__(self, begin: float, time_budget: float | None) -> None:
        budget = math.inf if time_budget is None else time_budget
        self.deadline, self.end = begin + (1 - REPAIR_SHARE) * budget, begin + budget
        self.reason, self._is_repeated = "", False

    def interrupt(self) -> None:
        """Stop because of Ctrl-C."""
        self._is_repeated = self.reason == "interrupted"
        self.reason = "interrupted"

    def abandoned(self, is_remote: bool) -> bool:
        """Return whether running slices are abandoned: after a second Ctrl-C, or on an executor, which may hang."""
        return self._is_repeated or (is_remote and bool(self) and time.perf_counter() > self.deadline + GRACE_S)

    def repair_until(self) -> float:
        """Return when to end the repair of the best so far."""
        return self.end if self.reason == "out of time" else time.perf_counter() + REPAIR_S

    def __bool__(self) -> bool:
        if not self.reason and time.perf_counter() > self.deadline:
            self.reason = "out of time"
        return bool(self.reason)


@contextmanager
def stop_on_interrupt(stop: Stop) -> Iterator[None]:
    """Let Ctrl-C set `stop` instead of tearing down threads; no effect outside the main thread, where none arrives."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _advance_start(problem: SearchProblem, start: int, last: int, state: State | None) -> tuple[State, int, float]:
    """Run the next slice of a start, from its beginning if `state` is None; return its state, step and objective.

    It ends at the step `last`, unless that is the last of all, which repair follows.
    """
    run, until = _open_start(problem, start, state), time.perf_counter() + SLICE_S
    for _ in range(SLICE[problem.search.method]):
        if run.done or run.step == last < problem.steps:
            break
        run.advance()
        if time.perf_counter() > until:
            break
    return run.state(), run.step, run.objective


def _finish_start(problem: SearchProblem, start: int, state: State | None, until: float = 0.0) -> Morphology:
    """Return the fibres of a start, with broken rules repaired until a time of `time.perf_counter`."""
    run = _open_start(problem, start, state)
    run.finish()
    while not run.done and time.perf_counter() < until:
        run.advance()
    return run.morphology()


def _open_start(problem: SearchProblem, start: int, state: State | None) -> "GradientSearch | GeneticSearch":
    if problem.search.method == "genetic":
        from .genetic import GeneticSearch  # pymoo takes a while to import

        return GeneticSearch(problem, state)
    return GradientSearch(problem, start, state)


def better_half(histories: Mapping[int, Array], half_way: int) -> list[int]:
    """Return the starts of lower objectives before a step, in order, among them the best of the strict ones.

    The latter may keep rules that the others break in the end. Histories are (n, 2), of step and objective.
    """
    before = {start: history[history[:, 0] <= half_way][-COMPARED:, 1] for start, history in histories.items()}
    means = {start: np.nan_to_num(np.log(values).mean(), nan=np.inf) for start, values in before.items()}
    ranked = sorted(means, key=lambda start: means[start])
    better, strict = ranked[: max(len(ranked) // 2, MIN_STARTS)], [*filter(is_strict, ranked)]
    if strict and strict[0] not in better:
        better[-1] = strict[0]
    return sorted(better)


def _advance(
    problem: SearchProblem,
    starts: Iterable[int],
    last_step: int,
    states: dict[int, State],
    stop: Stop,
    run: SearchOptions,
    checkpoints: Checkpoints | None,
) -> None:
    """Advance `starts`, slice by slice, to a step or until it is time to stop; to the last, until all are done.

    `states` is updated.
    """

    def is_over(state: State) -> bool:
        history = state["history"]
        return bool(state["done"]) or (len(history) > 0 and last_step < problem.steps and history[-1, 0] >= last_step)

    def next_slice(start: int, last: tuple[State, int, float]) -> Callable[[], tuple[State, int, float]] | None:
        return None if is_over(last[0]) or stop else partial(_advance_start, problem, start, last_step, last[0])

    slices = (
        (start, partial(_advance_start, problem, start, last_step, states.get(start)))
        for start in starts
        if not stop and (start not in states or not is_over(states[start]))
    )
    best = math.inf
    abandoned = partial(stop.abandoned, is_remote=run.executor is not None)
    for start, (state, step, objective) in run_tasks(
        slices, run.executor, follow_up=next_slice, is_abandoned=abandoned
    ):
        states[start] = state
        if checkpoints:
            checkpoints.save(start, state)
        best = min(best, objective)
        words = f"{_name(problem, start)}: objective {objective:.4f}, best {best:.4f}"
        run.on_progress(min(step, problem.steps), problem.steps, words)


def _finish_starts(problem: SearchProblem, states: dict[int, State], stop: Stop) -> list[tuple[str, Morphology]]:
    """Return the fibres of every start; after a stop, the best start's, repaired within the remaining time."""
    if not states:
        return [(_name(problem, 0), _finish_start(problem, 0, None))]
    if not stop:
        return [
            (_name(problem, start), _finish_start(problem, start, state)) for start, state in sorted(states.items())
        ]
    # a start without history has only just begun
    last = {start: state["history"][-1, 1] if len(state["history"]) else math.inf for start, state in states.items()}
    best = min(last, key=lambda start: last[start])
    return [(_name(problem, best), _finish_start(problem, best, states[best], stop.repair_until()))]


def _straight_pad(problem: SearchProblem, stop: Stop) -> Morphology:
    """Return straight fibres with as many knots as searched ones, which bow around keep-outs and are repaired there."""
    size, search = problem.pad, problem.search
    pad = Morphology.from_layout(straight_paths(size, problem.rules, search.knots), size.layout)
    if not size.keep_out_mm or not problem.violations(pad):
        return pad
    repair = replace(problem, search=search.model_copy(update={"method": "descent"}), origin=pad)
    return _finish_start(repair, 0, None, stop.repair_until() if stop else math.inf)


def _name(problem: SearchProblem, start: int) -> str:
    return "genetic" if problem.search.method == "genetic" else f"start {start + 1}"


def settings_for_twin(spec: "Spec", path: Path, pad: Morphology | None = None) -> "Spec":
    """Return the settings of `spec` with the sensitivity profile, the noise and the sensed rectangle of a twin.

    Profile and rectangle stay as they are in mm on a pad of another pitch; the rectangle is cut to the pad. Where
    `spec` states no fibres or pitch, those of the twin count, or instead of both those of `pad`.

    Raises:
        InputError: no valid twin; `spec` states another contact, or other fibres than the twin's.
    """
    twin, stated = Twin.load(path), spec.stated(PadSettings)
    if spec.stated(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    layout = twin.morphology.layout
    keys = {**layout.settings, **{key: stated[key] for key in LAYOUT_KEYS if key in stated}}
    if "size_mm" in stated and "pitch_mm" not in stated:
        del keys["pitch_mm"]  # follows from the size
    if pad is not None:
        keys = {**pad.layout.settings}
    size = spec.section(PadSettings, **keys, sensed_mm="beyond").layout
    if pad is None and size.counts != layout.counts:
        raise InputError(f"{spec.source}: [pad] asks for {size}, but {path} is of a pad of {layout}")
    sensed_mm = [min(pair) for pair in zip(twin.sensed_mm, size.size_mm, strict=True)]
    scatter = {**spec.stated(SearchSettings), **_scatter_settings(twin, size)}
    contact = twin.contact().model_dump()
    return spec.replaced({"pad": keys | {"sensed_mm": sensed_mm}, "contact": contact, "search": scatter})


def _scatter_settings(twin: Twin, layout: Layout) -> dict[str, float]:
    """Return how the responses of a held press scatter, in `[search]`'s shares of the full scale of straight fibres."""
    gains_v, noises_v = np.array([(abs(fibre.gain_v), fibre.noise_v) for fibre in twin.channels if fibre.gain_v]).T
    scale = straight_full_scale(layout, twin.contact(), "beyond")
    noise = float(np.clip(twin.scatter.floor * np.median(noises_v) / (np.median(gains_v) * scale), 1e-3, 10))
    return {"noise": noise, "scatter": twin.scatter.share, "scatter_common": twin.scatter.common}


def search_for_twin(
    pad: PadSettings,
    contact: Contact,
    settings: SearchSettings,
    rules: RulesSettings,
    default_settings: SearchSettings,
    *,
    origin: Morphology | None = None,
    run: SearchOptions | None = None,
) -> SearchResult:
    """Find the next pad of a printed one, for its measured contact and scatter.

    It searches from random starts, and from the default pad, which needs no measurement. Of these pads, the default pad
    and straight fibres it returns the one with the least expected error under the contact, and never one that locates
    less well than plain ones do. `candidate` is "twin", "from default", "default" or "straight fibres". A search that
    is stopped ends with the best so far. `default_settings` are those of the search for the default pad, which is for
    the default contact.
    """
    run = run or SearchOptions()
    plain = search(pad, None, default_settings, rules, run=_part_options(run, "default"))
    if plain.stopped == "interrupted":
        return plain
    afresh = search(pad, contact, settings, rules, origin=origin, run=_part_options(run, "twin"))
    from_plain = settings.model_copy(update={"starts": 1, "knots": max(settings.knots, default_settings.knots)})
    further = search(pad, contact, from_plain, rules, origin=plain.morphology, run=_part_options(run, "from default"))
    problem = build_problem(pad, contact, settings, rules)
    results = {"default": plain, "twin": afresh, "from default": further}
    pads = {"default": plain.morphology, "straight fibres": Morphology.straight(pad.layout)}
    pads |= {name: result.morphology for name, result in results.items()}
    # a pad that cannot be built is no use, unless none can
    sound = {name: fibres for name, fibres in pads.items() if not problem.violations(fibres)}
    pads = sound or {"twin": afresh.morphology}
    with profiling.stage("judge"):
        rows = errors_by_contact(pads, {"": contact}, pad, settings)
    name = choose({row.pad: np.array(row.errors_mm) for row in rows})
    straight = Candidate("straight fibres", _straight_pad(problem, Stop(time.perf_counter(), None)), problem)
    return replace(
        Candidate(name, pads[name], problem).to_result(straight),
        history=[row | {"run": f"{part}, {row['run']}"} for part, result in results.items() for row in result.history],
        seconds=sum(result.seconds for result in results.values()),
        stopped=next((result.stopped for result in results.values() if result.stopped), ""),
    )


def choose(errors: Mapping[str, Array]) -> str:
    """Return the pad of least mean error, among those that are worse than the plain ones with no number of failures.

    Errors are with 0, 1, ... fibres failed; "default" and "straight fibres" are the plain ones, if present.
    """
    plain = [errors[name] for name in ("default", "straight fibres") if name in errors]
    ratios = {name: error / np.min(plain or list(errors.values()), axis=0) for name, error in errors.items()}
    limit = max(TOLERANCE, min(float(ratio.max()) for ratio in ratios.values()))
    fair = [name for name, ratio in ratios.items() if ratio.max() <= limit]
    return min(fair, key=lambda name: float(np.log(ratios[name]).mean()))


def state_folders(keep_in: Path) -> dict[str, Path]:
    """Return the folder of states of each search: beside each other, as none may lie in another's."""
    return {name: keep_in.with_name(f"{keep_in.name}-{name}".replace(" ", "-")) for name in BUDGET_SHARES}


def _part_options(run: SearchOptions, name: str) -> SearchOptions:
    """Return the options of one of the searches for a twin."""
    keep_in = None if run.keep_in is None else state_folders(run.keep_in)[name]
    budget = None if run.time_budget is None else BUDGET_SHARES[name] * run.time_budget
    report = lambda done, total, what: run.on_progress(done, total, f"{name}, {what}")  # noqa: E731
    return replace(run, keep_in=keep_in, time_budget=budget, on_progress=report)
