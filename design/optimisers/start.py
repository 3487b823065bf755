"""A start of either search as a chain of pure steps from state to state, to run on any executor."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from padforge.design.common.checkpoints import State
from padforge.design.common.computing import one_torch_thread
from padforge.design.pad.morphology import Morphology

from .problem import SearchProblem

if TYPE_CHECKING:
    from .genetic_search import GeneticSearch
    from .gradient_search import GradientSearch

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
        from .genetic_search import GeneticSearch

        return GeneticSearch(problem, state)
    from .gradient_search import GradientSearch

    return GradientSearch(problem, start, state)
