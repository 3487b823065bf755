"""Which channel reads which fibre, and roughly how the pad lay: found by trying, without a first guess.

A frame is tried by how well the plan's answers under a Gaussian reach go with the measured ones: the mean over channels
of squared correlations of one sign, each channel given another fibre (the assignment problem).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment, minimize

from padforge.design.twin import PlanTransform
from padforge.sense.recordings.processing.limits import Array, Mask

from padforge.sense.twin.laid_pad import PadPlan
from padforge.sense.twin.responses import Responses

WIDTH = 0.55
"""Standard deviation of the Gaussian reach that is tried first, grid units."""
PRESSES = 400
"""Presses that are looked at."""
COARSE = 4
"""Of so many elements of a fibre one is looked at."""
SHIFTS = (-0.8, -0.4, 0.0, 0.4, 0.8)
"""Shifts that are tried, in grid units."""
REFINED = 24
"""Frames that are moved to where they go best."""
STEPS = np.array([0.06, 0.25, 0.25, 0.03, 0.15])
"""First steps by which a frame is moved: turn (rad), shift (grid units), scale, and logarithm of the reach's width."""
UNLIKELY = 0.002
"""Cost of a change by one such step in all, in shares of the variance explained."""


@dataclass(frozen=True)
class Wiring:
    """One way in which a pad may have lain and been wired.

    Attributes:
        frame: how it lay. width: of the Gaussian reach, grid units. fibres: (C,) what each channel reads.
        match: mean squared correlation, 0 to 1.
    """

    frame: PlanTransform
    width: float
    fibres: tuple[int, ...]
    match: float

    @property
    def kind(self) -> tuple[bool, tuple[int, ...]]:
        """What two wirings that are much alike have in common."""
        return self.frame.mirrored, self.fibres


class Matcher:
    """Says how well a frame goes with presses."""

    def __init__(self, plan: PadPlan, presses: Responses, rng: np.random.Generator) -> None:
        chosen = np.sort(rng.choice(len(presses), min(PRESSES, len(presses)), replace=False))
        self._plan, self._presses = plan, presses.of(chosen)
        self._course, self._length = plan.course[:, ::COARSE], plan.length[:, ::COARSE]
        self._there = self._presses.there
        self._volts = _centred(self._presses.volts, self._there)

    def __call__(self, frame: PlanTransform, width: float) -> Wiring:
        """The best wiring for a frame."""
        places = self._plan.to_grid(frame.to_plan(self._presses.places_mm))
        points = self._course.reshape(-1, 2)
        squares = (points**2).sum(axis=1) + (places**2).sum(axis=1)[:, None] - 2 * places @ points.T
        near = np.exp(squares * (-0.5 / width**2)).reshape(len(places), *self._length.shape)
        match, fibres = assigned(self._correlations(np.einsum("qfi,fi->qf", near, self._length)))
        return Wiring(frame, width, fibres, match)

    def _correlations(self, signals: Array) -> Array:
        """(F, C) of signals (Q, F) with the answers."""
        if self._there.all():
            return _centred(signals).T @ self._volts
        columns = [
            _centred(signals, self._there[:, c, None]).T @ self._volts[:, c] for c in range(self._volts.shape[1])
        ]
        return np.column_stack(columns)


def _centred(values: Array, there: Mask | None = None) -> Array:
    """Columns of values (Q, n), less their mean and of unit length; 0 where they are not there, or all the same."""
    if there is None:
        values = values - values.mean(axis=0)
    else:
        mean = np.where(there, values, 0).sum(axis=0) / np.maximum(np.sum(there, axis=0), 1)
        values = np.where(there, values - mean, 0.0)
    sizes = np.linalg.norm(values, axis=0)
    return np.divide(values, sizes, out=np.zeros_like(values), where=sizes > 0)


def assigned(correlations: Array) -> tuple[float, tuple[int, ...]]:
    """The best assignment for correlations (F, C) of one sign: its mean square, and what each channel reads."""
    best: tuple[float, tuple[int, ...]] = (-1.0, ())
    for sign in (1, -1):
        squares = np.maximum(sign * correlations, 0) ** 2
        fibres, channels = linear_sum_assignment(-squares)
        match = float(squares[fibres, channels].mean())
        if match > best[0]:
            best = match, tuple(fibres[np.argsort(channels)].tolist())
    return best


def wirings(
    plan: PadPlan,
    presses: Responses,
    rng: np.random.Generator,
    report: Callable[[int, int], None] = lambda done, of: None,
) -> list[Wiring]:
    """The wirings that go best with the presses, each with its best frame, best first."""
    matcher = Matcher(plan, presses, rng)
    middle = presses.places_mm.min(axis=0) / 2 + presses.places_mm.max(axis=0) / 2
    tried = []
    for mirrored, quarter, x, y in product((False, True), range(4), SHIFTS, SHIFTS):
        lying = PlanTransform(mirrored, 90.0 * quarter)
        shift = np.array([x, y]) * plan.unit_mm - _off_middle(middle, lying, plan)
        tried.append(matcher(replace(lying, shift_mm=tuple(shift.tolist())), WIDTH))
    tried.sort(key=lambda wiring: -wiring.match)
    best: dict[tuple[bool, tuple[int, ...]], Wiring] = {}
    for number, wiring in enumerate(tried[:REFINED]):
        report(number, REFINED)
        moved = _moved(matcher, wiring, plan.unit_mm)
        if moved.kind not in best or best[moved.kind].match < moved.match:
            best[moved.kind] = moved
    return sorted(best.values(), key=lambda wiring: -wiring.match)


def _off_middle(middle: Array, lying: PlanTransform, plan: PadPlan) -> Array:
    """The middle of what was pressed, as a shift that is undone where it lies far off the pad's own middle."""
    turned = lying.rotate(middle[None])[0]
    return turned if np.abs(turned).max() > plan.unit_mm else np.zeros(2)


def _moved(matcher: Matcher, wiring: Wiring, unit_mm: float) -> Wiring:
    """The best wiring near one."""
    start, unit = wiring.frame, STEPS * [1, unit_mm, unit_mm, 1, 1]

    def at(change: Array) -> Wiring:
        turn, x, y, scale, width = (change * unit).tolist()
        shift = start.shift_mm[0] + x, start.shift_mm[1] + y
        frame = PlanTransform(
            start.mirrored, start.turn_deg + float(np.degrees(turn)), shift, max(start.scale + scale, 0.5)
        )
        return matcher(frame, wiring.width * float(np.exp(width)))

    def cost(change: Array) -> float:
        return -at(change).match + UNLIKELY * float(change @ change) / len(change)

    first = np.vstack([np.zeros(len(unit)), np.eye(len(unit))])
    found = minimize(cost, np.zeros(len(unit)), method="Nelder-Mead", options={"maxfev": 120, "initial_simplex": first})
    return at(found.x)
