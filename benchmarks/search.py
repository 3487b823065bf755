"""Error of the pads found against the time spent on finding them: the published search beside the gradient search."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.design.networks import localisation_error
from padforge.design.objectives.rules import check_rules
from padforge.design.optimize.search import SearchOptions, SearchResult, search
from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_PAD, PUBLISHED_SEARCH, RulesSettings

KNOTS = (5, 20)
SEEDS = (0, 1)
GENERATIONS = (5, 20)
STEPS = (50, 150)
SUBSETS = 2
"""Sets of fibres lost of each number, of up to 56: enough to tell the ways apart, and the bench takes minutes."""


class InThisThread(Executor):
    """Does at once what is submitted: the trials have one start, and time is told by the thread that is timed."""

    def submit(self, work: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """What is done already."""
        done: Future[Any] = Future()
        done.set_result(work(*arguments, **named))
        return done


def trials() -> Iterator[BenchTrial]:
    """Every way at every budget, for N of KNOTS and each of SEEDS.

    The genetic search minimises the published objective. The gradient search minimises the expected error, without
    design rules, as the genetic one does, and with them. Both are for the published contact, between the fibres.
    """
    free = RulesSettings(enforce=False)
    ways = [("genetic", n, {"method": "genetic", "generations": n}, free) for n in GENERATIONS]
    for steps in STEPS:
        one = {"starts": 1, "steps": steps}
        ways += [("descent", steps, one, free), ("with rules", steps, one, RulesSettings())]
    for knots in KNOTS:
        for way, size, settings, rules in ways:
            for seed in SEEDS:
                chosen = PUBLISHED_SEARCH.model_copy(update={**settings, "knots": knots, "seed": seed})
                asked = PUBLISHED_PAD, PUBLISHED_CONTACT, chosen, rules
                work = partial(search, *asked, run=SearchOptions(executor=InThisThread()))
                yield BenchTrial(f"N={knots}", way, size, work, judge_pad, repetition=seed)


def judge_pad(found: SearchResult) -> Mapping[str, float]:
    """How well a pad serves: localisation errors with up to three fibres lost, their mean, and the rules it breaks."""
    errors = [level.mean for level in localisation_error(found.morphology, subsets=SUBSETS)]
    broken = len(check_rules(found.morphology, RulesSettings()))
    lost = {f"lost_{number}": error for number, error in enumerate(errors)}
    return {"error": sum(errors) / len(errors), "violations": broken, **lost}


BENCH = Bench(
    "search", trials, "localisation error (grid units)", ("genetic", GENERATIONS[-1]), ("descent", STEPS[0]), plain=()
)
