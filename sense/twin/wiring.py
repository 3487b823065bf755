"""Search for the wiring and pose of a pad: which fibre each channel reads, and how the pad lay under the arm.

Transforms on a grid are tried, each scored by correlations of responses with those of a Gaussian profile on the plan,
and the best are refined. If fibres run nearly straight, correlations may miss the right one. It is then one of the
`images` of the best by the symmetries of straight fibres, or the one that is `as_stated`.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize

from padforge.common.progress import OnProgress, ignore_progress
from padforge.design.settings import Layout
from padforge.design.twin import PlanTransform
from padforge.sense.arrays import Array, Indices, Mask, masked_mean
from padforge.sense.twin.as_built import PadPlan
from padforge.sense.twin.responses import Responses

PROFILE_WIDTH = 0.55  # standard deviation of the Gaussian profile that is tried first, grid units
N_SCORED = 400  # presses by which transforms are scored
SHIFTS = (-0.8, -0.4, 0.0, 0.4, 0.8)  # shifts that are tried along each axis, grid units
N_REFINED = 24  # transforms of the grid that are refined
FIRST_STEPS = np.array([0.06, 0.25, 0.25, 0.03, 0.15])
"""First steps of the refinement: turn (rad), shift (grid units), scale, and logarithm of the profile's width."""
STEP_COST = 0.002  # cost of a change of all parameters by one such step, in shares of the variance explained


@dataclass(frozen=True)
class Wiring:
    """A candidate for the wiring and pose of a pad."""

    transform: PlanTransform
    width: float  # standard deviation of the Gaussian profile, grid units
    fibres: tuple[int, ...]  # the fibre that each channel reads
    match: float  # mean squared correlation, 0 to 1


class _Scorer:
    """Finds the best wiring for a plan transform, by correlation with responses under a Gaussian profile.

    A transform is scored by the mean over channels of squared correlations of one sign, each channel assigned to a
    fibre of its own.
    """

    def __init__(self, plan: PadPlan, responses: Responses, rng: np.random.Generator) -> None:
        rows = np.sort(rng.choice(len(responses), min(N_SCORED, len(responses)), replace=False))
        self._plan, self._responses = plan, responses.select(rows)
        self._volts = _standardize(self._responses.volts, self._responses.valid)

    def __call__(self, transform: PlanTransform, width: float) -> Wiring:
        positions = self._plan.to_grid(transform.to_plan(self._responses.positions_mm))
        points = self._plan.paths.reshape(-1, 2)
        squares = (points**2).sum(axis=1) + (positions**2).sum(axis=1)[:, None] - 2 * positions @ points.T
        weights = np.exp(squares * (-0.5 / width**2)).reshape(len(positions), *self._plan.lengths.shape)
        signals, valid = np.einsum("qfi,fi->qf", weights, self._plan.lengths), self._responses.valid
        if valid.all():
            correlations = _standardize(signals, valid[:, :1]).T @ self._volts
        else:
            columns = enumerate(self._volts.T)
            correlations = np.column_stack([_standardize(signals, valid[:, c, None]).T @ volts for c, volts in columns])
        match, fibres = assign_fibres(correlations)
        return Wiring(transform, width, fibres, match)


def _standardize(values: Array, valid: Mask) -> Array:
    """Centre the columns of values (Q, n) and scale them to unit length; 0 where invalid, or all the same."""
    values = np.where(valid, values - masked_mean(values, valid), 0.0)
    norms = np.linalg.norm(values, axis=0)
    return np.divide(values, norms, out=np.zeros_like(values), where=norms > 0)


def assign_fibres(correlations: Array) -> tuple[float, tuple[int, ...]]:
    """Return the mean squared correlation and the fibre of each channel, for the largest ones (F, C) of one sign."""
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for sign in (1, -1):
        squares = np.maximum(sign * correlations, 0) ** 2
        fibres, channels = linear_sum_assignment(-squares)
        match = float(squares[fibres, channels].mean())
        if match > best[0]:
            best = match, tuple(fibres[np.argsort(channels)].tolist())
    return best


def find_wirings(
    plan: PadPlan, responses: Responses, rng: np.random.Generator, on_progress: OnProgress = ignore_progress
) -> list[Wiring]:
    """Search for wirings of the channels of `responses`, best first, each with its best transform.

    Transforms on a grid are tried, and the best refined by Nelder-Mead; there is no first guess.
    `rng` draws presses where there are many, and `on_progress` is called with (refined, total, "wiring").
    """
    scorer, unit_mm = _Scorer(plan, responses, rng), plan.layout.unit_mm
    tried = []
    for mirrored, quarter, x, y in product((False, True), range(4), SHIFTS, SHIFTS):
        transform = _centred(PlanTransform(mirrored, 90.0 * quarter), responses, unit_mm)
        shift_mm = np.array([x, y]) * unit_mm + transform.shift_mm
        tried.append(scorer(replace(transform, shift_mm=tuple(shift_mm.tolist())), PROFILE_WIDTH))
    tried.sort(key=lambda wiring: -wiring.match)
    best: dict[tuple[bool, tuple[int, ...]], Wiring] = {}
    for number, wiring in enumerate(tried[:N_REFINED]):
        on_progress(number, N_REFINED, "wiring")
        refined = _refine(scorer, wiring, unit_mm)
        key = refined.transform.mirrored, refined.fibres
        if key not in best or best[key].match < refined.match:
            best[key] = refined
    return sorted(best.values(), key=lambda wiring: -wiring.match)


def as_stated(channels: Indices, responses: Responses, unit_mm: float) -> Wiring:
    """Return the wiring of a pad that lay as planned, each of `channels` reading the fibre of its number."""
    return Wiring(_centred(PlanTransform(), responses, unit_mm), PROFILE_WIDTH, tuple(channels.tolist()), 0.0)


def _centred(transform: PlanTransform, responses: Responses, unit_mm: float) -> PlanTransform:
    """Shift what was pressed to the middle of the pad, unless the arm's frame is about that middle already."""
    middle_mm = responses.positions_mm.min(axis=0) / 2 + responses.positions_mm.max(axis=0) / 2
    if np.abs(middle_mm).max() <= unit_mm:
        return transform
    return replace(transform, shift_mm=tuple((-transform.turned(middle_mm[None])[0]).tolist()))


def images(wiring: Wiring, layout: Layout) -> list[Wiring]:
    """Return the other wirings under which a pad of straight fibres would respond alike.

    These are the wirings of the pad mirrored, rotated by 180 degrees, or by 90 if it is square.
    """
    # A fibre is mapped to the one whose middle is nearest, in the other family after a quarter turn.
    families, across = np.repeat([0, 1], layout.counts), np.array([[0.0, 1.0], [1.0, 0.0]])
    levels_mm = (layout.levels - np.repeat(layout.extent[::-1], layout.counts) / 2) * layout.unit_mm
    middles_mm = levels_mm[:, None] * across[families]
    out = []
    for mirrored, quarter in product((False, True), range(0, 4, 1 if layout.is_square else 2)):
        symmetry, old = PlanTransform(mirrored, 90.0 * quarter), wiring.transform
        distance_mm = np.hypot(*(symmetry.turned(middles_mm)[:, None] - middles_mm).T).T
        distance_mm[(families[:, None] ^ (quarter % 2)) != families] = np.inf
        transform = PlanTransform(
            mirrored != old.mirrored,
            (symmetry.turn_deg + (-old.turn_deg if mirrored else old.turn_deg) + 180) % 360 - 180,
            tuple(symmetry.turned(np.array([old.shift_mm]))[0].tolist()),
            old.scale,
        )
        fibres = tuple(distance_mm.argmin(axis=1)[list(wiring.fibres)].tolist())
        out.append(replace(wiring, transform=transform, fibres=fibres))
    return out[1:]


def planned_paths_mm(plan: PadPlan, transform: PlanTransform, fibres: tuple[int, ...]) -> Array:
    """Return the planned paths (C, E, 2) of the fibres that channels read, mm from the middle of the pad under the arm.

    Shift and scale are omitted and rotations rounded to quarter turns, so that poses which differ by less are the same.
    """
    mirrored, turn_deg = transform.mirrored, 90.0 * round(transform.turn_deg / 90)
    from_plan = PlanTransform(mirrored, turn_deg if mirrored else -turn_deg)  # the inverse of such a transform
    paths_mm = (plan.paths[list(fibres)] - np.array(plan.layout.extent) / 2) * plan.layout.unit_mm
    return from_plan.turned(paths_mm)


def _refine(scorer: _Scorer, wiring: Wiring, unit_mm: float) -> Wiring:
    start, unit = wiring.transform, FIRST_STEPS * [1, unit_mm, unit_mm, 1, 1]

    def evaluate(change: Array) -> Wiring:
        turn, x, y, scale, width = (change * unit).tolist()
        turn_deg, shift_mm = start.turn_deg + float(np.degrees(turn)), (start.shift_mm[0] + x, start.shift_mm[1] + y)
        transform = PlanTransform(start.mirrored, turn_deg, shift_mm, max(start.scale + scale, 0.5))
        return scorer(transform, wiring.width * float(np.exp(width)))

    def cost(change: Array) -> float:
        return -evaluate(change).match + STEP_COST * float(change @ change) / len(change)

    simplex = np.vstack([np.zeros(len(unit)), np.eye(len(unit))])
    options = {"maxfev": 120, "initial_simplex": simplex}
    return evaluate(minimize(cost, np.zeros(len(unit)), method="Nelder-Mead", options=options).x)
