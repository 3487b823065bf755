"""Search for a pad from many starts: settings in, the best morphology with its scores and its history out.

Each start is a chain of slices, each of which takes a state of plain arrays and returns the next one. Slices run on any
`concurrent.futures` executor, here or on a cluster. Between slices a start can be logged, saved or stopped, which does
not change its result.
"""

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from padforge.common import profiling
from padforge.common.parallel import Checkpoints, State, map_threads, one_thread, run_tasks
from padforge.common.progress import OnProgress, ignore_progress
from padforge.common.settings import Spec, or_default
from padforge.common.validation import InputError, check_float, check_path, check_type, short_repr
from padforge.design.contact_comparison import errors_by_contact
from padforge.design.morphology import Array, Morphology
from padforge.design.objectives.criterion import straight_full_scale
from padforge.design.objectives.rules import Violation
from padforge.design.objectives.score import ScoredPad, terms_of
from padforge.design.optimize.gradient import GradientSearch
from padforge.design.optimize.problem import SearchProblem, build_problem
from padforge.design.paths.keep_outs import straight_paths
from padforge.design.settings import Contact, Layout, PadSettings, RulesSettings, SearchSettings
from padforge.design.twin import Twin

if TYPE_CHECKING:
    from padforge.design.optimize.genetic import GeneticSearch

SLICE_STEPS = {"descent": 20, "genetic": 2}  # steps or generations of a slice, by method: about a third of a second
SLICE_S = 1.0  # time after which a slice ends early, so that a time budget is kept even if steps are slow
GRACE_S = 10.0
"""Time after a deadline for running slices to end: a second or so, but an executor may hang."""
LAYOUT_KEYS = ("grid", "horizontals", "verticals", "pitch_mm", "size_mm")
"""Keys of `[pad]` that determine where fibres end."""
BUDGET_SHARES = {"default": 0.35, "twin": 0.4, "from default": 0.2}
"""Share of a time budget for each search for the next pad of a twin."""


@dataclass(frozen=True)
class SearchOptions:
    """How a search is run; the result depends on it only if the search is cut short.

    Attributes:
        on_progress: called in the caller's thread after each slice, with the steps done, their total, and a text such
            as "start 2: objective 0.1234, best 0.1111".
        keep_in: folder for the states of the starts; `Checkpoints.clear` removes them once the result is saved.
        resume: whether to resume from the states in `keep_in`.
        time_budget: seconds after which the search ends with the best pad so far; None for no limit.
        executor: `concurrent.futures` executor of the slices; threads of this machine if None.
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
            object.__setattr__(self, "time_budget", check_float("time_budget", self.time_budget, 0, 1e9))
        if self.executor is not None:
            check_type("executor", self.executor, Executor)


@dataclass(frozen=True)
class SearchResult:
    """The best candidate of a search.

    Attributes:
        morphology: the candidate that breaks the fewest rules, and among those the one that errs least.
            Straight fibres are a candidate, except for the published method.
        terms: every term of `score` for it.
        violations: the rules that it breaks; empty if rules are not enforced.
        candidate: name of the candidate: "start 2", "genetic", "straight fibres", or "origin", the pad to start from.
        straight: expected errors and ambiguities of straight fibres on the same pad, by name, for comparison.
        enforced: whether rules were enforced.
        history: rows with "run", "step" and "objective"; by "descent", each is a geometric mean of 10 steps.
        seconds: wall time.
        stopped: why the search ended early: "interrupted", "out of time", or "" if it did not.
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
    """Search for the fibres of a pad by the method that `settings` names.

    The same settings give the same morphology, wherever the starts run and however often they are interrupted and
    resumed; only a time budget or Ctrl-C that cuts a search short changes the result.

    Args:
        pad: settings of the pad; the defaults of `pad.toml` if None.
        contact: contact model; by default the layer, or the published contact for the published method.
        settings: settings of the search; the defaults if None.
        rules: limits of the design rules; the defaults if None.
        origin: morphology to start from, of the pad's layout and at most `settings.knots` knots; random if None.
        run: callbacks, checkpoints, time budget and executor; the whole search on this machine if None.

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
    n_finished = sum(bool(state["done"]) for state in states.values())
    profiling.add_count("starts", len(problem.starts) - n_finished, len(problem.starts))
    with profiling.stage("search"), stop_on_interrupt(stop):
        _ = problem.straight_errors  # cached in the problem before it is pickled: else every slice computes them
        _advance(problem, states, stop, run, checkpoints)
        pads = _finish_starts(problem, states, stop)
    with profiling.stage("check and score"):
        straight = Candidate("straight fibres", _straight_pad(problem, stop), problem)
        candidates = [Candidate(name, morphology, problem) for name, morphology in pads]
        if origin is not None:
            candidates.append(Candidate("origin", origin, problem))
        if problem.search.method != "genetic":  # the published method has no such candidate
            candidates.append(straight)
        best = min(candidates, key=lambda c: (len(c.violations), c.comparison))
        result = best.to_result(straight)
    history = [
        {"run": _name(problem, start), "step": int(step), "objective": value}
        for start, state in sorted(states.items())
        for step, value in state["history"].tolist()
    ]
    return replace(result, history=history, seconds=time.perf_counter() - begin, stopped=stop.reason)


@dataclass(frozen=True)
class Candidate:
    """A pad that a search may return as a solution of `problem`, with its name in `SearchResult.candidate`."""

    name: str
    pad: Morphology
    problem: SearchProblem

    @cached_property
    def violations(self) -> list[Violation]:
        """The rules that the pad breaks."""
        return self.problem.violations(self.pad)

    @cached_property
    def comparison(self) -> float:
        """The value by which the pad is compared with others."""
        return self.problem.comparison(self.pad)

    @cached_property
    def scored(self) -> ScoredPad:
        """The scores of the pad under the main contact."""
        return self.problem.scored(self.pad)

    def to_result(self, straight: "Candidate") -> SearchResult:
        """Return the result of a search that chose this candidate."""
        with one_thread():  # both at once, since they take longest; `terms` reads the cached ones
            list(map_threads(lambda each: each.scored.expected_errors, (self, straight)))
        terms = self.scored.terms(terms_of(self.problem.contacts[0]))
        straight_terms = straight.scored.terms(("expected_error_mm", "ambiguity_mm"))
        return SearchResult(self.pad, terms, self.violations, self.name, straight_terms, self.problem.rules.enforce)


class Stop:
    """True once the search is to stop: after Ctrl-C, or after a deadline of `time.perf_counter`."""

    def __init__(self, begin: float, time_budget: float | None) -> None:
        budget = math.inf if time_budget is None else time_budget
        self.deadline, self.end = begin + 0.85 * budget, begin + budget  # between them, broken rules are repaired
        self.reason, self._is_repeated = "", False

    def interrupt(self) -> None:
        """Request a stop because of Ctrl-C."""
        self._is_repeated = self.reason == "interrupted"
        self.reason = "interrupted"

    def abandoned(self, is_remote: bool) -> bool:
        """Return whether to abandon running slices: after a second Ctrl-C, or if a remote executor seems to hang."""
        return self._is_repeated or (is_remote and bool(self) and time.perf_counter() > self.deadline + GRACE_S)

    def repair_until(self) -> float:
        """Return when to end the repair of the best pad so far: with the budget, or 3 s after Ctrl-C."""
        return self.end if self.reason == "out of time" else time.perf_counter() + 3

    def __bool__(self) -> bool:
        if not self.reason and time.perf_counter() > self.deadline:
            self.reason = "out of time"
        return bool(self.reason)


@contextmanager
def stop_on_interrupt(stop: Stop) -> Iterator[None]:
    """Let Ctrl-C set `stop` instead of raising; has no effect outside the main thread, which alone receives signals."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.interrupt())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _run_slice(problem: SearchProblem, start: int, state: State | None) -> tuple[State, int, float]:
    """Run the next slice of a start, from its beginning without a `state`; return its state, step and objective."""
    run, until = _open_start(problem, start, state), time.perf_counter() + SLICE_S
    for _ in range(SLICE_STEPS[problem.search.method]):
        if run.done:
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


def _advance(
    problem: SearchProblem, states: dict[int, State], stop: Stop, run: SearchOptions, checkpoints: Checkpoints | None
) -> None:
    """Advance all starts slice by slice until their pads are repaired, or until `stop`; `states` is updated."""

    def next_slice(start: int, state: State | None) -> Callable[[], tuple[State, int, float]] | None:
        """Return the next slice of a start as a function, or None if there is none."""
        if stop or (state is not None and state["done"]):
            return None
        return partial(_run_slice, problem, start, state)

    slices = ((start, task) for start in problem.starts if (task := next_slice(start, states.get(start))))
    results = run_tasks(
        slices,
        run.executor,
        follow_up=lambda start, result: next_slice(start, result[0]),
        is_abandoned=partial(stop.abandoned, is_remote=run.executor is not None),
    )
    best = math.inf
    for start, (state, step, objective) in results:
        states[start] = state
        if checkpoints:
            checkpoints.save(start, state)
        best = min(best, objective)
        what = f"{_name(problem, start)}: objective {objective:.4f}, best {best:.4f}"
        run.on_progress(min(step, problem.steps), problem.steps, what)


def _finish_starts(problem: SearchProblem, states: dict[int, State], stop: Stop) -> list[tuple[str, Morphology]]:
    """Return the fibres of every start; after a stop, of the best one only, repaired within the remaining time."""
    if not states:
        return [(_name(problem, 0), _finish_start(problem, 0, None))]
    if not stop:
        return [
            (_name(problem, start), _finish_start(problem, start, state)) for start, state in sorted(states.items())
        ]
    objectives = {  # a start that has only just begun has no history
        start: state["history"][-1, 1] if len(state["history"]) else math.inf for start, state in states.items()
    }
    best = min(objectives, key=lambda start: objectives[start])
    return [(_name(problem, best), _finish_start(problem, best, states[best], stop.repair_until()))]


def _straight_pad(problem: SearchProblem, stop: Stop) -> Morphology:
    """Return straight fibres with as many knots as searched ones, led around keep-outs and repaired if necessary."""
    pad_settings, options = problem.pad, problem.search
    pad = Morphology.from_layout(straight_paths(pad_settings, problem.rules, options.knots), pad_settings.layout)
    if not pad_settings.keep_out_mm or not problem.violations(pad):
        return pad
    repair = replace(problem, search=options.model_copy(update={"method": "descent"}), origin=pad)
    return _finish_start(repair, 0, None, stop.repair_until() if stop else math.inf)


def _name(problem: SearchProblem, start: int) -> str:
    return "genetic" if problem.search.method == "genetic" else f"start {start + 1}"


def settings_for_twin(spec: Spec, path: Path, pad: Morphology | None = None) -> Spec:
    """Return the settings of `spec` with the sensitivity profile, the noise and the sensed rectangle of a twin.

    On a pad of another pitch, profile and rectangle keep their size in mm, and the rectangle is cut to the pad. The
    number and the pitch of the fibres are those of `pad`, by default those that `spec` states, or else the twin's.

    Raises:
        InputError: no valid twin; `spec` states another contact, or other fibres than the twin's.
    """
    twin, pad_keys = Twin.load(path), spec.stated(PadSettings)
    if spec.stated(Contact) and spec.section(Contact) != Contact():
        raise InputError(f"{spec.source}: [contact] is given beside {path}, which has one of its own; leave one out")
    layout = twin.morphology.layout
    if pad is not None:
        keys = {**pad.layout.settings}
    else:
        keys = {**layout.settings, **{key: pad_keys[key] for key in LAYOUT_KEYS if key in pad_keys}}
        if "size_mm" in pad_keys and "pitch_mm" not in pad_keys:
            del keys["pitch_mm"]  # follows from the size
    new_layout = spec.section(PadSettings, **keys, sensed_mm="beyond").layout
    if pad is None and new_layout.counts != layout.counts:
        raise InputError(f"{spec.source}: [pad] asks for {new_layout}, but {path} is of a pad of {layout}")
    sensed_mm = [min(pair) for pair in zip(twin.sensed_mm, new_layout.size_mm, strict=True)]
    search_keys = {**spec.stated(SearchSettings), **_scatter_settings(twin, new_layout)}
    contact = twin.contact().model_dump()
    return spec.replaced({"pad": keys | {"sensed_mm": sensed_mm}, "contact": contact, "search": search_keys})


def _scatter_settings(twin: Twin, layout: Layout) -> dict[str, float]:
    """Return the scatter of a held press as keys of `[search]`, relative to the full scale of straight fibres."""
    channels = [(abs(channel.gain_v), channel.noise_v) for channel in twin.channels if channel.gain_v]
    if not channels:
        raise InputError("the twin has no channel that responds, so that its noise is unknown")
    gains_v, noises_v = np.array(channels).T
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
    """Search for the next pad of a printed one, for its measured contact and scatter.

    Three searches run: "default" for the default contact, which needs no measurement; "twin" for the measured contact;
    and "from default" for the measured contact, which starts from the default pad. Among their pads and "straight
    fibres" `choose` takes the best under the measured contact; its name is the `candidate` of the result.

    `settings` are those of the searches for the measured contact; "twin" starts from `origin`, at random if that is
    None. The options `run` are those of all three searches together.
    """
    # 1. The searches; an interrupted one is the last
    run = run or SearchOptions()
    default = search(pad, None, default_settings, rules, run=_part_options(run, "default"))
    if default.stopped == "interrupted":
        return default
    twin = search(pad, contact, settings, rules, origin=origin, run=_part_options(run, "twin"))
    one_start = settings.model_copy(update={"starts": 1, "knots": max(settings.knots, default_settings.knots)})
    results = {"default": default, "twin": twin}
    if twin.stopped != "interrupted":
        options = _part_options(run, "from default")
        results["from default"] = search(pad, contact, one_start, rules, origin=default.morphology, run=options)
    # 2. The best of the pads that break no rule
    problem = build_problem(pad, contact, settings, rules)
    candidates = {"default": default.morphology, "straight fibres": Morphology.straight(pad.layout)}
    candidates |= {name: result.morphology for name, result in results.items()}
    pads = {name: each for name, each in candidates.items() if not problem.violations(each)}
    pads = pads or {"twin": twin.morphology}
    with profiling.stage("judge"):
        errors = errors_by_contact(pads, {"": contact}, pad, settings)
    name = choose({name: np.array(values) for (_, name), values in errors.items()})
    straight = Candidate("straight fibres", _straight_pad(problem, Stop(time.perf_counter(), None)), problem)
    return replace(
        Candidate(name, pads[name], problem).to_result(straight),
        history=[row | {"run": f"{part}, {row['run']}"} for part, result in results.items() for row in result.history],
        seconds=sum(result.seconds for result in results.values()),
        stopped=next((result.stopped for result in results.values() if result.stopped), ""),
    )


def choose(errors: Mapping[str, Array]) -> str:
    """Return the name of the pad of least mean log error among those that err at most 3 % more than the references.

    Errors (K,) are with 0, 1, ... failed fibres, by the name of the pad. At each of these numbers, the reference is the
    better one of "default" and "straight fibres". If no pad keeps the 3 %, the lowest limit that one keeps replaces it.
    """
    references = [errors[name] for name in ("default", "straight fibres") if name in errors]
    ratios = {name: error / np.min(references or list(errors.values()), axis=0) for name, error in errors.items()}
    # expected errors are certain to about 3 %, so a ratio of 1.03 counts as equal
    limit = max(1.03, min(float(ratio.max()) for ratio in ratios.values()))
    eligible = [name for name, ratio in ratios.items() if ratio.max() <= limit]
    return min(eligible, key=lambda name: float(np.log(ratios[name]).mean()))


def state_folders(keep_in: Path) -> dict[str, Path]:
    """Return the folder of the states of each search; none may lie in another, so they are siblings."""
    return {name: keep_in.with_name(f"{keep_in.name}-{name}".replace(" ", "-")) for name in BUDGET_SHARES}


def _part_options(run: SearchOptions, name: str) -> SearchOptions:
    """Return the options of one of the searches for a twin."""
    keep_in = None if run.keep_in is None else state_folders(run.keep_in)[name]
    budget = None if run.time_budget is None else BUDGET_SHARES[name] * run.time_budget
    report = lambda done, total, what: run.on_progress(done, total, f"{name}, {what}")  # noqa: E731
    return replace(run, keep_in=keep_in, time_budget=budget, on_progress=report)
