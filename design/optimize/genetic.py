"""The published search: a genetic algorithm, bred by pymoo, on the published objective (formula (5))."""

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

from padforge.design.common.checkpoints import State
from padforge.design.morphology import MARGIN, Array, Morphology, assemble_knots
from padforge.design.objectives.published import published_presses, published_terms
from padforge.design.optimize.problem import SearchProblem
from padforge.design.paths.curves import refine

AROUND_LEVEL, AROUND_ORIGIN = 1.0, 0.3
"""Standard deviations of the first knots about a fibre's own level, and about those of a given pad; grid units."""


class GeneticSearch:
    """Minimises the published objective, a generation of `search.population` pads at a time.

    The same problem gives the same pads, whether or not the breeding was broken off and taken up from its state. An
    origin and mutated copies of it make up half of the first generation; knots of it within MARGIN of the pad's edge
    are moved to MARGIN, the bound of the search.

    Attributes:
        step: generations done. objective: the best so far. done: whether all generations are.
    """

    def __init__(self, problem: SearchProblem, state: State | None = None) -> None:
        search, origin = problem.search, problem.origin
        self.step, self.objective = 0, math.inf
        self._history: list[tuple[int, float]] = []
        self._generations = search.generations
        self._problem = _PublishedProblem(problem)
        sampling = _FirstGeneration(
            None if origin is None else refine(origin.knots, search.knots, problem.pad.layout)[:, 1:-1]
        )
        self._algorithm: Any = GA(pop_size=search.population, sampling=sampling, repair=_InOrder())
        self._algorithm.setup(self._problem, termination=NoTermination(), seed=search.seed)
        self._algorithm.pop = Population.empty()
        if state is not None:
            self._restore(state)

    @property
    def done(self) -> bool:
        """Whether all generations are bred."""
        return self.step >= self._generations

    def advance(self, generations: int) -> None:
        """Breed up to so many generations, fewer if it is done before."""
        for _ in range(min(generations, self._generations - self.step)):
            self._algorithm.next()
            self.step += 1
            self.objective = float(self._algorithm.pop.get("F").min())
            self._history.append((self.step, self.objective))

    def finish(self) -> None:
        """Leave out the generations after the first that are not bred yet; there are no rules to repair by."""
        if self.step == 0:
            self.advance(1)
        self._generations = self.step

    def morphology(self) -> Morphology:
        """The best pad so far; there is one once the first generation is done."""
        # Survivors are the best of parents and offspring, so the best pad ever is among them.
        x, objective = self._algorithm.pop.get("X", "F")
        return Morphology.from_layout(self._problem.fibres(x[objective.argmin()][None])[0], self._problem.layout)

    def state(self) -> State:
        """All that the next generations depend on, as arrays.

        Returns:
            "done": (); "history": (k, 2) generation and best objective; "population": (P, 4MN) coordinates of the pads
            and "objectives": (P,) theirs, both empty before the first generation; "random": (), the generator's state.
        """
        x, objective = self._algorithm.pop.get("X", "F")
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
    """2 F N free coordinates within the pad, one objective, evaluated a whole generation at a time."""

    def __init__(self, problem: SearchProblem) -> None:
        self.layout = problem.pad.layout
        self.shape = (self.layout.fibres, problem.search.knots, 2)
        least, most = (
            np.broadcast_to(each, self.shape).ravel() for each in (MARGIN, np.array(self.layout.extent) - MARGIN)
        )
        self.contact, self.search = problem.contacts[0], problem.search
        self.presses = published_presses(self.layout, problem.search.presses)
        self.limits = least, most
        super().__init__(n_var=len(least), n_obj=1, xl=least, xu=most)

    def fibres(self, x: Array) -> Array:
        """(P, F, N+2, 2) knots of a generation x (P, 2FN)."""
        return assemble_knots(x.reshape(-1, *self.shape), self.layout)

    def _evaluate(self, x: Array, out: dict[str, Array], *args: object, **kwargs: object) -> None:
        terms = published_terms(
            self.fibres(x),
            self.contact,
            self.presses,
            weights=self.search.weights,
            layout=self.layout,
            levels=self.search.levels,
        )
        out["F"] = np.array([[each.objective] for each in terms])


class _FirstGeneration(FloatRandomSampling):
    """Half of the pads have knots anywhere, as the published search's; the others near a pad that is no tangle.

    Where all knots lie anywhere, fibres of a family stand in the wrong order so often, the more the more knots they
    have, that most generations go into setting that right (the C of formula (5)).

    Args:
        origin: (F, N, 2) inner knots of one pad, the others being scattered about them; None to scatter the cross
            coordinates about each fibre's own level.
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
                cross = near[:, rows, :, 1 - family]
                cross[:] = random_state.normal(level[rows], AROUND_LEVEL, cross.shape)
        else:
            near[:] = random_state.normal(self.origin, AROUND_ORIGIN, near.shape)
            near[0] = self.origin
        return x


class _InOrder(Repair):
    """Sorts the knots of every fibre along its travel axis, within the bounds.

    A pad is the same whatever the order of its knots, but crossover exchanges knots of the same number: sorted,
    these are of about the same place.
    """

    def _do(self, problem: _PublishedProblem, X: Array, **kwargs: object) -> Array:
        inner = problem.fibres(X)[..., 1:-1, :]
        return np.clip(inner.reshape(X.shape), *problem.limits)
