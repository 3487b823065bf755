"""Search for a pad from many starts: settings in, the best morphology with its scores and its history out.

Each start is a chain of slices from one plain state to the next. Slices run on any executor of the
`concurrent.futures` kind, here or on a cluster; between them a start can be logged, saved or stopped, and none of that
changes what it finds.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from padforge.design.common import profiling
from padforge.design.common.parallel import Checkpoints, State, one_torch_thread, run_tasks
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_float, check_path, check_type, short_repr
from padforge.design.morphology import Morphology
from padforge.design.objectives.rules import Violation
from padforge.design.objectives.score import ScoredPad
from padforge.design.optimize.problem import SearchProblem, build_problem
from padforge.design.paths.keep_outs import straight_paths
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

if TYPE_CHECKING:
    from padforge.design.optimize.genetic import GeneticSearch
    from padforge.design.optimize.gradient import GradientSearch

SLICE = {"descent": 20, "genetic": 2}
"""Steps or generations of a slice: about a third of a second."""
SLICE_S = 1.0
"""After which a slice ends where steps are slow, so that a time budget holds."""
REPAIR_SHARE = 0.15
"""Share of a time budget reserved for repair."""
REPAIR_S = 3.0
"""Of repair after Ctrl-C."""
GRACE_S = 10.0
"""After a deadline, for running slices: one takes a second or so, but an executor may hang."""
MAX_SECONDS = 1e9
"""Longest time budget: some thirty years."""

OnProgress = Callable[[str, int, int, float], None]
"""Callback of a search: what runs ("start 2"), steps done, steps in all, and its objective at that step."""


@dataclass(frozen=True)
class SearchOptions:
    """How a search is run; the result does not depend on it, unless it is cut short.

    Attributes:
        on_progress: called with each start's progress, in the caller's thread.
        keep_in: folder for the states of the starts; `Checkpoints.clear` removes them once the result is saved.
        resume: whether to go on from the states in `keep_in`.
        time_budget: seconds after which the search ends with the best so far; None for no end.
        executor: of the `concurrent.futures` kind, for slices of the starts; the threads of this machine if None.
    """

    on_progress: OnProgress = lambda run, done, total, objective: None
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
        contact: what a press does to a fibre; the measured one, or the published one by the published method, if None.
        settings: how to search.
        rules: the limits.
        origin: morphology to start from, of the pad's layout, of at most `settings.knots` knots; random if None.
        run: callbacks, checkpoints, time budget and executor; on this machine to its end if None.

    Raises:
        InputError: an origin that does not fit, a missing device, or states of other settings.
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
    with profiling.stage("search"), stop_on_interrupt(stop), one_torch_thread():
        _advance(problem, states, stop, run, checkpoints)
        pads = _finish_starts(problem, states, stop)
    with profiling.stage("check and score"):
        straight = Candidate("straight fibres", _straight_pad(problem, stop), problem)
        candidates = [Candidate(name, morphology, problem) for name, morphology in pads]
        if origin is not None:
            candidates.append(Candidate("origin", origin, problem))
        if problem.search.method != "genetic":  # the published method is left as it was published
            candidates.append(straight)
        result = _to_result(min(candidates, key=lambda candidate: candidate.rank), straight)
    history = [
        {"run": _name(problem, start), "step": int(step), "objective": value}
        for start, state in sorted(states.items())
        for step, value in state["history"].tolist()
    ]
    return replace(result, history=history, seconds=time.perf_counter() - begin, stopped=stop.reason)


def score_result(morphology: Morphology, name: str, problem: SearchProblem) -> SearchResult:
    """Return a pad as the result of a search.

    Args:
        morphology: the pad.
        name: of the candidate.
        problem: that it is a solution of.
    """
    straight = Candidate("straight fibres", _straight_pad(problem, Stop(time.perf_counter(), None)), problem)
    return _to_result(Candidate(name, morphology, problem), straight)


@dataclass(frozen=True)
class Candidate:
    """A pad that a search may return.

    Attributes:
        name: its origin, as in `SearchResult.candidate`.
        pad: the fibres.
        problem: that it is a solution of.
    """

    name: str
    pad: Morphology
    problem: SearchProblem

    @cached_property
    def violations(self) -> list[Violation]:
        """The rules that it breaks."""
        return self.problem.violations(self.pad)

    @cached_property
    def scored(self) -> list[ScoredPad]:
        """Its scores under each contact."""
        p = self.problem
        return [ScoredPad(self.pad, contact, p.search, p.rules, p.pad) for contact in p.contacts]

    @property
    def rank(self) -> tuple[int, float]:
        """Least for the best pad: fewest broken rules first, then the least objective, summed over the contacts."""
        return len(self.violations), sum(scored.objective for scored in self.scored)


def _to_result(best: Candidate, straight: Candidate) -> SearchResult:
    terms, beside = best.scored[0].terms(), straight.scored[0].terms(("expected_error_mm", "ambiguity_mm"))
    return SearchResult(best.pad, terms, best.violations, best.name, beside, best.problem.rules.enforce)


class Stop:
    """Whether to stop: after Ctrl-C, or a deadline of `time.perf_counter`."""

    def __init__(self, begin: float, time_budget: float | None) -> None:
        self.deadline = None if time_budget is None else begin + (1 - REPAIR_SHARE) * time_budget
        self.end = None if time_budget is None else begin + time_budget
        self.reason = ""
        self._is_repeated = False

    def interrupt(self) -> None:
        """Stop because of Ctrl-C."""
        self._is_repeated = self.reason == "interrupted"
        self.reason = "interrupted"

    def abandoned(self, is_remote: bool) -> bool:
        """Return whether running slices are abandoned: after a second Ctrl-C, or long after the deadline.

        Args:
            is_remote: whether they are on an executor, which may hang; here, they do end.
        """
        late = self.deadline is not None and time.perf_counter() > self.deadline + GRACE_S
        return self._is_repeated or (is_remote and bool(self) and late)

    def repair_until(self) -> float:
        """Return when to end the repair of the best so far."""
        return self.end if self.reason == "out of time" and self.end else time.perf_counter() + REPAIR_S

    def __bool__(self) -> bool:
        if not self.reason and self.deadline is not None and time.perf_counter() > self.deadline:
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


@dataclass(frozen=True)
class StartSlice:
    """A start after a slice.

    Attributes:
        state: from which it goes on.
        step: steps done.
        objective: of the last step.
        done: whether it is finished.
    """

    state: State
    step: int
    objective: float
    done: bool


@one_torch_thread()
def advance_start(problem: SearchProblem, start: int, state: State | None) -> StartSlice:
    """Run the next slice of a start, from its beginning if `state` is None."""
    run, until = _open_start(problem, start, state), time.perf_counter() + SLICE_S
    for _ in range(SLICE[problem.search.method]):
        run.advance(1)
        if run.done or time.perf_counter() > until:
            break
    return StartSlice(run.state(), run.step, run.objective, run.done)


@one_torch_thread()
def finish_start(problem: SearchProblem, start: int, state: State | None, until: float = 0.0) -> Morphology:
    """Return the fibres of a start, with broken rules repaired until a time of `time.perf_counter`."""
    run = _open_start(problem, start, state)
    run.finish()
    while not run.done and time.perf_counter() < until:
        run.advance(1)
    return run.morphology()


def _open_start(problem: SearchProblem, start: int, state: State | None) -> "GradientSearch | GeneticSearch":
    # each method needs a library that takes a while to import
    if problem.search.method == "genetic":
        from .genetic import GeneticSearch

        return GeneticSearch(problem, state)
    from .gradient import GradientSearch

    return GradientSearch(problem, start, state)


def _advance(
    problem: SearchProblem, states: dict[int, State], stop: Stop, run: SearchOptions, checkpoints: Checkpoints | None
) -> None:
    """Advance every start, slice by slice, until all are done or it is time to stop; `states` is updated."""

    def first_slices() -> Iterator[tuple[int, Callable[[], StartSlice]]]:
        for start in problem.starts:
            if not stop and (start not in states or not states[start]["done"]):
                yield start, partial(advance_start, problem, start, states.get(start))

    def next_slice(start: int, last: StartSlice) -> Callable[[], StartSlice] | None:
        return None if last.done or stop else partial(advance_start, problem, start, last.state)

    abandoned = partial(stop.abandoned, is_remote=run.executor is not None)
    for start, last in run_tasks(first_slices(), run.executor, follow_up=next_slice, is_abandoned=abandoned):
        states[start] = last.state
        if checkpoints:
            checkpoints.save(start, last.state)
        run.on_progress(_name(problem, start), min(last.step, problem.steps), problem.steps, last.objective)


def _finish_starts(problem: SearchProblem, states: dict[int, State], stop: Stop) -> list[tuple[str, Morphology]]:
    """Return the fibres of every start; after a stop, the best start's, repaired within the remaining time."""
    if not states:
        return [(_name(problem, 0), finish_start(problem, 0, None))]
    if not stop:
        return [(_name(problem, start), finish_start(problem, start, state)) for start, state in sorted(states.items())]
    # a start without history has only just begun
    last = {start: state["history"][-1, 1] if len(state["history"]) else math.inf for start, state in states.items()}
    best = min(last, key=lambda start: last[start])
    return [(_name(problem, best), finish_start(problem, best, states[best], stop.repair_until()))]


def _straight_pad(problem: SearchProblem, stop: Stop) -> Morphology:
    """Return straight fibres with as many knots as searched ones, which bow around keep-outs and are repaired there."""
    size, search = problem.pad, problem.search
    pad = Morphology.from_layout(straight_paths(size, problem.rules, search.knots), size.layout)
    if not size.keep_out_mm or not problem.violations(pad):
        return pad
    repair = replace(problem, search=search.model_copy(update={"method": "descent"}), origin=pad)
    return finish_start(repair, 0, None, stop.repair_until() if stop else math.inf)


def _name(problem: SearchProblem, start: int) -> str:
    return "genetic" if problem.search.method == "genetic" else f"start {start + 1}"
