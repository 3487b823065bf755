"""One face for both searches: settings in, the best morphology with its scores and its history out.

A search is a number of starts, each a chain of slices from one plain state to the next. Slices run on any executor of
the `concurrent.futures` kind, here or on a cluster; between them a start can be noted, kept on disk, or stopped, and
nothing of that changes what it finds.
"""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.design.common import profiling
from padforge.design.common.checkpoints import Checkpoints, State
from padforge.design.common.parallel import one_torch_thread, run_tasks
from padforge.design.common.settings import or_default
from padforge.design.common.validation import InputError, check_float, check_type, short_repr
from padforge.design.common.validation import check_path as as_path
from padforge.design.morphology import Morphology
from padforge.design.objectives.expected_error import error_terms, expected_errors
from padforge.design.objectives.fibre_loss import loss_shares
from padforge.design.objectives.rules import Violation
from padforge.design.objectives.score import AMBIGUITY_NOISE, all_terms, ambiguities, ambiguity_terms, sharpness_of
from padforge.design.optimize.problem import SearchProblem, Stop, build_problem, stopped_by_interrupt
from padforge.design.paths.keep_outs import straight_paths
from padforge.design.settings import Contact, PadSettings, RulesSettings, SearchSettings

if TYPE_CHECKING:
    from padforge.design.optimize.genetic import GeneticSearch
    from padforge.design.optimize.gradient import GradientSearch

SLICE = {"descent": 20, "genetic": 2}  # steps or generations between two looks: about a third of a second
SLICE_S = 1.0  # where steps are slow a slice ends after this, so that a time budget holds


@dataclass(frozen=True)
class StartSlice:
    """Where a start has got to: its state, steps done, objective of the last one, and whether nothing is left to do."""

    state: State
    step: int
    objective: float
    done: bool


@one_torch_thread()
def advance_start(problem: SearchProblem, start: int, state: State | None) -> StartSlice:
    """The next slice of a start, from its beginning if `state` is None."""
    run, until = _open(problem, start, state), time.perf_counter() + SLICE_S
    for _ in range(SLICE[problem.search.method]):
        run.advance(1)
        if run.done or time.perf_counter() > until:
            break
    return StartSlice(run.state(), run.step, run.objective, run.done)


@one_torch_thread()
def finish(problem: SearchProblem, start: int, state: State | None, until: float = 0.0) -> Morphology:
    """The fibres of a start as they are, what is broken being repaired `until` then by `time.perf_counter`."""
    run = _open(problem, start, state)
    run.finish()
    while not run.done and time.perf_counter() < until:
        run.advance(1)
    return run.morphology()


def _open(problem: SearchProblem, start: int, state: State | None) -> "GradientSearch | GeneticSearch":
    if problem.search.method == "genetic":
        from .genetic import GeneticSearch

        return GeneticSearch(problem, state)
    from .gradient import GradientSearch

    return GradientSearch(problem, start, state)


OnProgress = Callable[[str, int, int, float], None]
"""Hears of a search: what runs ("start 2"), steps done, steps in all, and its objective at that step."""

MOST_SECONDS = 1e9
"""Longest time budget: some thirty years."""


@dataclass(frozen=True)
class SearchOptions:
    """How a search is run: nothing of what it finds depends on it, unless it is cut short.

    Attributes:
        report: hears of each start's progress, in the caller's thread.
        keep_in: folder for the states of the starts; `Checkpoints.clear` removes them once what was found is kept.
        resume: whether to go on from the states in `keep_in`.
        time_budget: seconds after which the search ends with the best so far; None for no end.
        executor: of the `concurrent.futures` kind, for slices of the starts; the threads of this machine if None.
    """

    report: OnProgress = lambda run, done, total, objective: None
    keep_in: Path | None = None
    resume: bool = False
    time_budget: float | None = None
    executor: Executor | None = None

    def __post_init__(self) -> None:
        if not callable(self.report):
            raise InputError(f"report is {short_repr(self.report)}, expected a function")
        if self.keep_in is not None:
            object.__setattr__(self, "keep_in", as_path("keep_in", self.keep_in))
        check_type("resume", self.resume, bool)
        if self.time_budget is not None:
            object.__setattr__(self, "time_budget", check_float("time_budget", self.time_budget, 0, MOST_SECONDS))
        if self.executor is not None:
            check_type("executor", self.executor, Executor)


@dataclass(frozen=True)
class SearchResult:
    """What a search found.

    Attributes:
        morphology: the best pad: fewest broken rules first, then least expected error over the losses. Straight fibres
            count as found, but by the published method.
        terms: every term of `score` for it, and its expected errors.
        violations: the rules it breaks; empty where rules are not enforced.
        candidate: where it is from: "start 2", "genetic", "straight fibres", or "origin", the pad it was to start from.
        straight: expected errors and ambiguities of straight fibres on the same pad, by name, to set beside its own.
        history: one entry per noted step: {"run", "step", "objective"}.
        enforced: whether it was to keep to the rules.
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
    """Find the fibres of a pad by the method `settings` names; None stands for the defaults of `pad.toml`.

    The published method has the published contact by default.

    The same settings give the same morphology, wherever the starts run and however often they are broken off and
    resumed; only a time budget or Ctrl-C that cuts a search short changes what it finds.

    Args:
        origin: morphology to start from, of the pad's layout, of at most `settings.knots` knots; random if None.
        run: whom it tells, what it keeps, how long it may take and on what it runs; on this machine to its end if None.

    Raises:
        InputError: an origin that does not fit, a device that is not there, or states of other settings.
    """
    begin = time.perf_counter()
    pad, settings = or_default("pad", pad, PadSettings), or_default("settings", settings, SearchSettings)
    contact = or_default("contact", contact, Contact, settings.default_contact)
    problem = build_problem(pad, contact, settings, or_default("rules", rules, RulesSettings), origin)
    run = SearchOptions() if run is None else check_type("run", run, SearchOptions)
    checkpoints = Checkpoints(run.keep_in, problem.settings()) if run.keep_in else None
    states = checkpoints.begin(run.resume) if checkpoints else {}
    stop = Stop(begin, run.time_budget)
    kept = sum(bool(state["done"]) for state in states.values())
    profiling.add_count("starts", len(problem.starts) - kept, len(problem.starts))
    with profiling.stage("search"), stopped_by_interrupt(stop), one_torch_thread():
        _advance(problem, states, stop, run, checkpoints)
        found = _found(problem, states, stop)
    with profiling.stage("check and score"):
        straight = _Candidate("straight fibres", _straight(problem, stop), problem)
        candidates = [_Candidate(name, pad, problem) for name, pad in found]
        if origin is not None:
            candidates.append(_Candidate("origin", origin, problem))
        if problem.search.method != "genetic":  # the published method is left as it was published
            candidates.append(straight)
        best = min(candidates, key=lambda candidate: candidate.rank)
        result = _scored(best, straight, problem)
    history, seconds = _history(problem, states), time.perf_counter() - begin
    return replace(result, history=history, seconds=seconds, stopped=stop.reason)


def score_result(
    morphology: Morphology,
    candidate: str,
    pad: PadSettings,
    contact: Contact,
    settings: SearchSettings,
    rules: RulesSettings,
) -> SearchResult:
    """Return a pad as a search by these settings would hand it back.

    Args:
        morphology: the pad.
        candidate: where it is from.
        pad, contact, settings, rules: as `search` takes them.
    """
    problem = build_problem(pad, contact, settings, rules, None)
    straight = _Candidate("straight fibres", _straight(problem, Stop(time.perf_counter(), None)), problem)
    return _scored(_Candidate(candidate, morphology, problem), straight, problem)


def _scored(best: "_Candidate", straight: "_Candidate", problem: SearchProblem) -> SearchResult:
    terms = best.errors() | all_terms(best.pad, best.ambiguities(), problem.contacts[0], problem.rules, problem.pad)
    beside = straight.errors() | ambiguity_terms(straight.ambiguities(), straight.pad.unit_mm)
    return SearchResult(best.pad, terms, best.broken, best.name, beside, problem.rules.enforce)


def _advance(
    problem: SearchProblem, states: dict[int, State], stop: Stop, run: SearchOptions, checkpoints: Checkpoints | None
) -> None:
    """Advance every start, slice by slice, until all are done or it is time to stop; `states` holds where they are."""

    def first_slices() -> Iterator[tuple[int, Callable[[], StartSlice]]]:
        for start in problem.starts:
            if not stop and (start not in states or not states[start]["done"]):
                yield start, partial(advance_start, problem, start, states.get(start))

    def next_slice(start: int, reached: StartSlice) -> Callable[[], StartSlice] | None:
        return None if reached.done or stop else partial(advance_start, problem, start, reached.state)

    given_up = partial(stop.given_up, elsewhere=run.executor is not None)
    for start, reached in run_tasks(first_slices(), run.executor, follow_up=next_slice, is_abandoned=given_up):
        states[start] = reached.state
        if checkpoints:
            checkpoints.save(start, reached.state)
        run.report(_name(problem, start), min(reached.step, problem.steps), problem.steps, reached.objective)


def _found(problem: SearchProblem, states: dict[int, State], stop: Stop) -> list[tuple[str, Morphology]]:
    """The fibres of every start; after a stop, those of the start that stands best, mended in what is left of time."""
    if not states:
        return [(_name(problem, 0), finish(problem, 0, None))]
    if not stop:
        return [(_name(problem, start), finish(problem, start, state)) for start, state in sorted(states.items())]
    # a start with nothing noted yet has only just begun
    noted = {start: state["history"][-1, 1] if len(state["history"]) else math.inf for start, state in states.items()}
    best = min(noted, key=lambda start: noted[start])
    return [(_name(problem, best), finish(problem, best, states[best], stop.mend_until()))]


class _Candidate:
    """A pad that a search may hand back: the rules it breaks, and its expected errors (contacts, losses)."""

    def __init__(self, name: str, pad: Morphology, problem: SearchProblem) -> None:
        self.name, self.pad, self._problem = name, pad, problem
        self.broken: list[Violation] = problem.broken(pad)
        self._errors = [expected_errors(pad, contact, problem.search, problem.pad) for contact in problem.contacts]

    @property
    def rank(self) -> tuple[int, float]:
        """Least for the best pad: fewest broken rules first, then the least of what is minimised."""
        search, total = self._problem.search, 0.0
        for contact, errors in zip(self._problem.contacts, self._errors, strict=True):
            shares = loss_shares(search.max_failures)[: len(errors)]
            total += float(np.exp(np.log(errors) @ shares / sum(shares)))
            if search.sharpness > 0:
                total += search.sharpness * sharpness_of(self.pad, contact, self._problem.pad)
        return len(self.broken), total

    def ambiguities(self) -> list[float]:
        """With 0, 1, ... lost, under the first contact."""
        problem = self._problem
        return ambiguities(self.pad, problem.contacts[0], problem.search.max_failures, AMBIGUITY_NOISE, problem.pad)

    def errors(self) -> dict[str, float]:
        """With 0, 1, ... lost, under the first contact, by name."""
        return error_terms(self._errors[0], self.pad.unit_mm)


def _straight(problem: SearchProblem, stop: Stop) -> Morphology:
    """Straight fibres with as many knots as those that are searched, but for bows around keep-outs, as mended."""
    size, search = problem.pad, problem.search
    pad = Morphology.from_layout(straight_paths(size, problem.rules, search.knots), size.layout)
    if not size.keep_out_mm or not problem.broken(pad):
        return pad
    from_it = replace(problem, search=search.model_copy(update={"method": "descent"}), origin=pad)
    return finish(from_it, 0, None, stop.mend_until() if stop else math.inf)


def _name(problem: SearchProblem, start: int) -> str:
    return "genetic" if problem.search.method == "genetic" else f"start {start + 1}"


def _history(problem: SearchProblem, states: dict[int, State]) -> list[dict[str, Any]]:
    return [
        {"run": _name(problem, start), "step": int(step), "objective": value}
        for start, state in sorted(states.items())
        for step, value in state["history"].tolist()
    ]
