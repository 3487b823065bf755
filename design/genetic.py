"""The published search: a genetic algorithm, bred by pymoo, on the published objective (formula (5))."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymoo.algorithms.soo.nonconvex.ga import GA
from pymoo.core.problem import Problem

from .morphology import MARGIN, Morphology, assemble
from .objective import published_terms
from .settings import Contact, Pad, Search

Array = NDArray[np.float64]


class _PublishedProblem(Problem):
    """4 M N free coordinates within the pad, one objective, evaluated a whole generation at a time."""

    def __init__(self, pad: Pad, contact: Contact, search: Search) -> None:
        self.shape = (2 * pad.grid, search.knots, 2)
        self.contact = contact
        super().__init__(n_var=int(np.prod(self.shape)), n_obj=1, xl=MARGIN, xu=pad.grid + 1 - MARGIN)

    def fibres(self, x: Array) -> Array:
        """(P, 2M, N+2, 2) knots of a generation x (P, 4MN)."""
        return assemble(x.reshape(-1, *self.shape))

    def _evaluate(self, x: Array, out: dict[str, Array], *args: object, **kwargs: object) -> None:
        out["F"] = np.array([[terms.objective] for terms in published_terms(self.fibres(x), self.contact)])


def breed(
    pad: Pad, contact: Contact, search: Search, report: Callable[[int, float], bool] = lambda generation, best: True
) -> Morphology:
    """Minimise the published objective over `search.generations` generations of `search.population` pads.

    `report` hears each generation's number (from 1) and the best objective so far; if it answers False, that is it.
    """
    problem = _PublishedProblem(pad, contact, search)
    algorithm = GA(pop_size=search.population)
    algorithm.setup(problem, termination=("n_gen", search.generations), seed=search.seed)
    for generation in range(1, search.generations + 1):
        algorithm.next()
        if not report(generation, float(_best(algorithm).F[0])):
            break
    return Morphology(problem.fibres(_best(algorithm).X[None])[0], pad.pitch_mm)


def _best(algorithm: GA) -> Any:
    """The best individual so far: coordinates X, objective F."""
    return algorithm.opt[0]  # pyright: ignore[reportOptionalSubscript]
