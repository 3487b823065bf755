"""The published search: a genetic algorithm (pymoo's) on the published objective, formula (5)."""

import json
import math
from typing import Any

import numpy as np
from pymoo.algorithms.soo.nonconvex.ga import GA
from pymoo.core.population import Population
from pymoo.core.problem import Problem as PymooProblem
from pymoo.core.repair import Repair
from pymoo.core.termination import NoTermination
from pymoo.operators.sampling.rnd import FloatRandomSampling

from padforge.common.parallel import State
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine
from padforge.design.published.objective import published_presses, published_terms


class GeneticSearch:
    """Minimise the published objective by generations of `search.population` pads.

    A problem gives the same pads whether or not the search was interrupted and resumed from its state. If the problem
    has an origin, half of the first generation are the origin and copies of it with scattered knots.
    """

    def __init__(self, problem: SearchProblem, state: State | None = None) -> None:
        search, origin = problem.search, problem.origin
        self.step = 0  # generations done
        self.objective = math.inf  # of the best pad so far
        self._history: list[tuple[int, float]] = []
        self._generations = search.generations
        self._problem = _PublishedProblem(problem)
        knots = None if origin is None else refine(origin.knots, search.knots, problem.pad.layout)[:, 1:-1]
        self._algorithm: Any = GA(pop_size=search.population, sampling=_FirstGeneration(knots), repair=_SortKnots())
        self._algorithm.setup(self._problem, termination=NoTermination(), seed=search.seed)
        self._algorithm.pop = Population.empty()
        if state is not None:
            self._restore(state)

    @property
    def done(self) -> bool:
        """Whether all generations are done."""
        return self.step >= self._generations

    def advance(self) -> None:
        """Breed one generation."""
        self._algorithm.next()
        self.step += 1
        self.objective = float(self._algorithm.pop.get("F").min())
        self._history.append((self.step, self.objective))

    def finish(self) -> None:
        """Skip the remaining generations except the first; there is no repair."""
        if self.step == 0:
            self.advance()
        self._generations = self.step

    def morphology(self) -> Morphology:
        """Return the best pad so far, after the first generation at the earliest."""
        # survivors are the best of parents and offspring, so the best pad ever is among them
        x, objective = self._algorithm.pop.get("X", "F")
        return Morphology.from_layout(self._problem.knots(x[objective.argmin()][None])[0], self._problem.layout)

    def state(self) -> State:
        """Return everything that the next generations depend on, as arrays."""
        x, objective = self._algorithm.pop.get("X", "F")  # both empty before the first generation
        return {
            "done": np.array(self.done),
            "history": np.array(self._history).reshape(-1, 2),
            "population": x,
            "objectives": objective.reshape(-1),
            "random": np.array(json.dumps(self._algorithm.random_state.bit_generator.state)),
        }

    def _restore(self, state: State) -> None:
        self._history = [(int(step), objective) for step, objective in state["history"].tolist()]
        if not self._history:
            return
        self.step, self.objective = self._history[-1]
        algorithm = self._algorithm
        algorithm.pop = Population.new(X=state["population"], F=state["objectives"][:, None])
        algorithm.random_state.bit_generator.state = json.loads(str(state["random"]))
        algorithm.n_iter = self.step + 1
        algorithm.is_initialized = True


class _PublishedProblem(PymooProblem):
    """The published objective of a generation of pads, as a function of the 2 F N coordinates of each pad's knots."""

    def __init__(self, problem: SearchProblem) -> None:
        self.layout = problem.pad.layout
        self.shape = (self.layout.fibres, problem.search.knots, 2)
        self.contact, self.search = problem.contacts[0], problem.search
        self.presses = published_presses(self.layout, problem.search.presses)
        bounds = MARGIN, np.array(self.layout.extent) - MARGIN
        self.limits = low, high = [np.broadcast_to(bound, self.shape).ravel() for bound in bounds]
        super().__init__(n_var=len(low), n_obj=1, xl=low, xu=high)

    def knots(self, x: Array) -> Array:
        """Return the knots (P, F, N + 2, 2) of a generation x (P, 2FN)."""
        return assemble_knots(x.reshape(-1, *self.shape), self.layout)

    def _evaluate(self, x: Array, out: dict[str, Array], *args: object, **kwargs: object) -> None:
        terms = published_terms(
            self.knots(x),
            self.contact,
            self.presses,
            layout=self.layout,
            weights=self.search.weights,
            levels=self.search.levels,
            entropy=self.search.entropy,
        )
        out["F"] = np.array([[pad.objective] for pad in terms])


class _FirstGeneration(FloatRandomSampling):
    """First generation: half uniformly random knots, as in the published search, and half near an untangled pad.

    Among uniformly random knots, fibres of a family are so often in the wrong order that most generations would be
    spent on sorting them (the C of formula (5)). Knots of the other half are scattered about those of the origin
    (F, N, 2) by 0.3 grid units or, without an origin, about the straight fibres by 1.
    """

    def __init__(self, origin: Array | None) -> None:
        super().__init__()
        self.origin = origin

    def _do(
        self, problem: _PublishedProblem, n_samples: int, *args: object, random_state: Any = None, **kwargs: object
    ) -> Array:
        x = super()._do(problem, n_samples, random_state=random_state)
        near = x[: n_samples // 2].reshape(-1, *problem.shape)  # a view
        if self.origin is None:
            level = problem.layout.levels[:, None]
            for family, rows in enumerate(problem.layout.families):
                across = near[:, rows, :, 1 - family]
                across[:] = random_state.normal(level[rows], 1.0, across.shape)
        else:
            near[:] = random_state.normal(self.origin, 0.3, near.shape)
            near[0] = self.origin
        return x


class _SortKnots(Repair):
    """Sort the knots along every fibre, within the bounds.

    The order of its knots does not change a pad. But crossover exchanges knots of the same number, which are at about
    the same position if knots are sorted.
    """

    def _do(self, problem: _PublishedProblem, X: Array, **kwargs: object) -> Array:
        inner = problem.knots(X)[..., 1:-1, :]
        return np.clip(inner.reshape(X.shape), *problem.limits)
