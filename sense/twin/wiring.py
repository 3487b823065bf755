"""Search for the wiring of a pad and its rough pose under the arm, without a first guess.

A plan transform is scored by how well the planned fibres' responses under a Gaussian profile correlate with the
measured ones: the mean over channels of squared correlations of one sign, each channel assigned to another fibre.
Transforms on a grid are tried, and the best refined by Nelder-Mead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize

from padforge.design.twin import PlanTransform
from padforge.sense.arrays import Array, Mask
from padforge.sense.twin.as_built import PadPlan
from padforge.sense.twin.responses import Responses

PROFILE_WIDTH = 0.55
"""Standard deviation of the Gaussian profile that is tried first, grid units."""
MAX_PRESSES = 400
"""Presses by which transforms are scored."""
ELEMENT_STRIDE = 4
"""Every such element of a fibre is used."""
SHIFTS = (-0.8, -0.4, 0.0, 0.4, 0.8)
"""Shifts that are tried along each axis, grid units."""
N_REFINED = 24
"""Transforms of the grid that are refined."""
FIRST_STEPS = np.array([0.06, 0.25, 0.25, 0.03, 0.15])
"""First steps of the refinement: turn (rad), shift (grid units), scale, and logarithm of the profile's width."""
STEP_COST = 0.002
"""Cost of a change by one such step in all, in shares of the variance explained."""


@dataclass(frozen=True)
class Wiring:
    """A candidate for the wiring and pose of a pad.

    Attributes:
        transform: plan transform.
        width: standard deviation of the Gaussian profile, grid units.
        fibres: index of the fibre that each channel reads; C of them.
        match: mean squared correlation, 0 to 1.
    """

    transform: PlanTransform
    width: float
    fibres: tuple[int, ...]
    match: float


class _Scorer:
    """Finds the best wiring for a plan transform."""

    def __init__(self, plan: PadPlan, responses: Responses, rng: np.random.Generator) -> None:
        rows = np.sort(rng.choice(len(responses), min(MAX_PRESSES, len(responses)), replace=False))
        self._plan, self._responses = plan, responses.select(rows)
        self._paths, self._lengths = plan.paths[:, ::ELEMENT_STRIDE], plan.lengths[:, ::ELEMENT_STRIDE]
        self._valid = self._responses.valid
        self._volts = _standardize(self._responses.volts, self._valid)

    def __call__(self, transform: PlanTransform, width: float) -> Wiring:
        positions = self._plan.to_grid(transform.to_plan(self._responses.positions_mm))
        points = self._paths.reshape(-1, 2)
        squares = (points**2).sum(axis=1) + (positions**2).sum(axis=1)[:, None] - 2 * positions @ points.T
        weights = np.exp(squares * (-0.5 / width**2)).reshape(len(positions), *self._lengths.shape)
        match, fibres = assign_fibres(self._correlations(np.einsum("qfi,fi->qf", weights, self._lengths)))
        return Wiring(transform, width, fibres, match)

    def _correlations(self, signals: Array) -> Array:
        """Return the correlations (F, C) of signals (Q, F) with the responses."""
        if self._valid.all():
            return _standardize(signals).T @ self._volts
        columns = [
            _standardize(signals, self._valid[:, c, None]).T @ self._volts[:, c] for c in range(self._volts.shape[1])
        ]
        return np.column_stack(columns)


def _standardize(values: Array, valid: Mask | None = None) -> Array:
    """Centre the columns of values (Q, n) and scale them to unit length; 0 where invalid, or all the same."""
    if valid is None:
        values = values - values.mean(axis=0)
    else:
        mean = np.where(valid, values, 0).sum(axis=0) / np.maximum(np.sum(valid, axis=0), 1)
        values = np.where(valid, values - mean, 0.0)
    norms = np.linalg.norm(values, axis=0)
    return np.divide(values, norms, out=np.zeros_like(values), where=norms > 0)


def assign_fibres(correlations: Array) -> tuple[float, tuple[int, ...]]:
    """Assign each channel another fibre such that squared correlations (F, C) of one sign are largest.

    Returns:
        Mean squared correlation, and the fibre of each channel.
    """
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for sign in (1, -1):
        squares = np.maximum(sign * correlations, 0) ** 2
        fibres, channels = linear_sum_assignment(-squares)
        match = float(squares[fibres, channels].mean())
        if match > best[0]:
            best = match, tuple(fibres[np.argsort(channels)].tolist())
    return best


def find_wirings(
    plan: PadPlan,
    responses: Responses,
    rng: np.random.Generator,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Wiring]:
    """Search for wirings, each with its best transform.

    Args:
        plan: the planned fibres.
        responses: of the live channels.
        rng: draws presses where there are many.
        on_progress: called with (refined, total).

    Returns:
        Different wirings, best first.
    """
    scorer = _Scorer(plan, responses, rng)
    middle_mm = responses.positions_mm.min(axis=0) / 2 + responses.positions_mm.max(axis=0) / 2
    tried = []
    for mirrored, quarter, x, y in product((False, True), range(4), SHIFTS, SHIFTS):
        transform = PlanTransform(mirrored, 90.0 * quarter)
        pressed_mm = transform.rotate(middle_mm[None])[0]
        if np.abs(pressed_mm).max() <= plan.unit_mm:  # the arm's frame is about the pad's own middle
            pressed_mm = np.zeros(2)
        shift_mm = np.array([x, y]) * plan.unit_mm - pressed_mm
        tried.append(scorer(replace(transform, shift_mm=tuple(shift_mm.tolist())), PROFILE_WIDTH))
    tried.sort(key=lambda wiring: -wiring.match)
    best: dict[tuple[bool, tuple[int, ...]], Wiring] = {}
    for number, wiring in enumerate(tried[:N_REFINED]):
        on_progress(number, N_REFINED)
        refined = _refine(scorer, wiring, plan.unit_mm)
        key = refined.transform.mirrored, refined.fibres
        if key not in best or best[key].match < refined.match:
            best[key] = refined
    return sorted(best.values(), key=lambda wiring: -wiring.match)


def _refine(scorer: _Scorer, wiring: Wiring, unit_mm: float) -> Wiring:
    """Return the best wiring near one."""
    start, unit = wiring.transform, FIRST_STEPS * [1, unit_mm, unit_mm, 1, 1]

    def evaluate(change: Array) -> Wiring:
        turn, x, y, scale, width = (change * unit).tolist()
        transform = PlanTransform(
            start.mirrored,
            start.turn_deg + float(np.degrees(turn)),
            (start.shift_mm[0] + x, start.shift_mm[1] + y),
            max(start.scale + scale, 0.5),
        )
        return scorer(transform, wiring.width * float(np.exp(width)))

    def cost(change: Array) -> float:
        return -evaluate(change).match + STEP_COST * float(change @ change) / len(change)

    simplex = np.vstack([np.zeros(len(unit)), np.eye(len(unit))])
    options = {"maxfev": 120, "initial_simplex": simplex}
    return evaluate(minimize(cost, np.zeros(len(unit)), method="Nelder-Mead", options=options).x)
