"""Error of optimised pads against the time of the search: the published search beside the gradient search."""

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from padforge.benchmarks.harness import Bench, BenchTrial
from padforge.common.parallel import one_thread
from padforge.design.contact import signals
from padforge.design.objectives.fibre_loss import failure_subsets
from padforge.design.objectives.rules import check_rules
from padforge.design.optimize.search import SearchResult, search
from padforge.design.published.networks import SimulatedPresses
from padforge.design.settings import PUBLISHED_CONTACT, PUBLISHED_PAD, PUBLISHED_SEARCH, RulesSettings

KNOTS = (5, 20)
SEEDS = (0, 1)
GENERATIONS = (5, 20)
STEPS = (50, 150)
SUBSETS = 2  # evaluated sets of failed fibres of each size, of which there are up to 56: enough to distinguish the ways


def trials() -> Iterator[BenchTrial]:
    """Yield searches by all ways and budgets, for the published contact on the area between the fibres.

    The genetic search minimises the published objective without design rules; the gradient search minimises the
    expected error, without and with them.
    """
    unconstrained = RulesSettings(enforce=False)
    ways = [("genetic", n, {"method": "genetic", "generations": n}, unconstrained) for n in GENERATIONS]
    for n in STEPS:
        for way, rules in (("descent", unconstrained), ("with rules", RulesSettings())):
            ways.append((way, n, {"starts": 1, "steps": n}, rules))
    for knots in KNOTS:
        for way, size, changes, rules in ways:
            for seed in SEEDS:
                settings = PUBLISHED_SEARCH.model_copy(update={**changes, "knots": knots, "seed": seed})
                work = partial(search, PUBLISHED_PAD, PUBLISHED_CONTACT, settings, rules)
                yield BenchTrial(f"N={knots}", way, size, work, evaluate_pad, repetition=seed)


def evaluate_pad(result: SearchResult) -> Mapping[str, float]:
    """Return the localisation errors with up to three failed fibres, their mean, and the number of broken rules."""
    pad, errors = result.morphology, []
    presses = SimulatedPresses.simulate(pad, 32, 2000, 0, partial(signals, pad, contact=PUBLISHED_CONTACT))
    for n_failed in range(4):
        failures = failure_subsets(len(pad.knots), n_failed, SUBSETS)
        with one_thread():
            networks = presses.fit(failures, 50)
        errors.append(float(np.mean([presses.test_errors(*pair) for pair in zip(networks, failures, strict=True)])))
    row = {"error": sum(errors) / len(errors), "violations": len(check_rules(pad, RulesSettings()))}
    return row | {f"failed_{number}": error for number, error in enumerate(errors)}


BENCH = Bench(
    "search",
    trials,
    "localisation error (grid units)",
    reference=("genetic", GENERATIONS[-1]),
    default=("descent", STEPS[0]),
)
