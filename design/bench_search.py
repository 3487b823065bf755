"""Error of the pads found against the time spent on finding them: the published search beside the gradient search."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .bench_table import Row, write_bench
from .evaluation import evaluate
from .rules import check
from .search import search
from .settings import Contact, Pad, Rules, Search

KNOTS = (5, 10, 20)
SEEDS = (0, 1, 2)
GENERATIONS = (10, 50)
STEPS = (100, 400)
SUBSETS = 2
"""Sets of fibres lost of each number, of up to 56: enough to tell the ways apart, and the bench takes minutes."""


@dataclass(frozen=True)
class SearchRow(Row):
    """One search, and how well the pad it found serves.

    `error` is the mean of the four that follow, `size` the generations or steps.

    Attributes:
        seed: of the search.
        violations: design rules the pad breaks, whether or not the search was told of them.
        lost_0, lost_1, lost_2, lost_3: localisation error with so many fibres lost, grid units (`evaluate`).
    """

    seed: int
    violations: int
    lost_0: float
    lost_1: float
    lost_2: float
    lost_3: float


def bench_search(out: Path, report: Callable[[str], None]) -> dict[str, Any]:
    """Every way at every budget, for N of KNOTS and each of SEEDS; files in `out`.

    The genetic search minimises the published objective; the gradient search runs without design rules, as the genetic
    one does, and with them. Times are those of searches alone on the machine, networks trained between them.
    """
    ways = [
        ("genetic", Search(method="genetic", generations=generations), Rules(enforce=False), generations)
        for generations in GENERATIONS
    ]
    for steps in STEPS:
        descent = Search(method="descent", starts=1, steps=steps)
        ways += [("descent", descent, Rules(enforce=False), steps), ("with rules", descent, Rules(), steps)]
    for way, (settings, rules) in {way: (settings, rules) for way, settings, rules, _ in ways}.items():
        report(f"search, {way} before the clock")
        search(Pad(), Contact(), settings.model_copy(update={"generations": 1, "steps": 1, "knots": 3}), rules)
    rows = []
    for knots in KNOTS:
        for way, settings, rules, size in ways:
            for seed in SEEDS:
                report(f"search, N = {knots}, {way} {size}, seed {seed}")
                chosen = settings.model_copy(update={"knots": knots, "seed": seed})
                rows.append(_row(f"N={knots}", way, size, chosen, rules))
    return write_bench("search", rows, out, "localisation error (grid units)", reference=("genetic", GENERATIONS[-1]))


def _row(case: str, way: str, size: int, settings: Search, rules: Rules) -> SearchRow:
    """Search and measure."""
    found = search(Pad(), Contact(), settings, rules)
    errors = [level.mean for level in evaluate(found.morphology, Contact(), subsets=SUBSETS)]
    broken = len(check(found.morphology, Rules()))
    return SearchRow(case, way, size, sum(errors) / len(errors), found.seconds, None, settings.seed, broken, *errors)
