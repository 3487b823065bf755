"""What of an answer is a smooth function of place, whatever kind of function: a Gaussian process of two widths.
It says which channels answer at all, and what is left over as noise where neither a pad nor place explains it.

What of the scatter of responses grows with them, told by presses that lie next to each other.
Half the squared difference of what a fitted pad leaves over of two neighbouring presses is their variance, whatever
smooth function of position is left over besides: floor^2 + share^2 x^2 for responses of x, a straight line over x^2.
Where channels share a part of it, the products of their differences are common share^2 x_c x_c'.

How a laid pad is fitted to presses: the most probable one, by the Levenberg-Marquardt method.
What is left over counts as noise of each channel's own size. A plan is right to a millimetre or so until presses say
otherwise: fibres lie beside it by smooth curves, Gaussian with a standard deviation that is learnt with all else
(MacKay's evidence, Neural Computation 4, 1992), as is that of the sensitivity along a fibre.

Which channel reads which fibre, and roughly how the pad lay: found by trying, without a first guess.
A frame is tried by how well the plan's answers under a Gaussian reach go with the measured ones: the mean over channels
of squared correlations of one sign, each channel given another fibre (the assignment problem).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import linear_sum_assignment, minimize, nnls
from scipy.spatial import KDTree

from padforge.design.twin import PlanTransform, TwinScatter
from padforge.sense.arrays import MIN_SCALE_V, Array, Indices, Mask
from padforge.sense.twin.as_built import (
    ASIDE,
    AWAY,
    COUNTS,
    ELEMENTS,
    OWN,
    SENSITIVITY,
    SHARED,
    SPLINES,
    LaidPad,
    PadPlan,
    Responses,
    along_fibre,
    own_values,
)

WIDTHS = (0.4, 0.8)
"""Standard deviations of the kernels that are tried, grid units."""
PRESSES = 800
"""Presses that are looked at, at most: the eigenvalues of a matrix of that size are found."""
RATIOS = np.append(0.0, np.geomspace(1e-2, 1e4, 61))
"""Variances of the function that are tried, as multiples of that of the noise."""


class Smooth(NamedTuple):
    """What a channel shows.

    Attributes:
        noise: (C,) standard deviation of what no smooth function of place explains, in units of the values.
        certainty: (C,) by how much a function of place is more probable than none, natural logarithm.
    """

    noise: np.ndarray
    certainty: np.ndarray


def smooth_function(values: Responses, unit_mm: float) -> Smooth:
    """The most probable smooth function of place of each channel; NaN and 0 for one with fewer than 10 answers."""
    places = values.positions_mm[:PRESSES] / unit_mm
    squares = ((places[:, None, :] - places) ** 2).sum(axis=2)

    @cache
    def eigen(rows: bytes, width: float) -> tuple[np.ndarray, np.ndarray]:
        there = np.frombuffer(rows, bool)
        return np.linalg.eigh(np.exp(squares[np.ix_(there, there)] * (-0.5 / width**2)))

    noise, certainty = np.full(values.volts.shape[1], np.nan), np.zeros(values.volts.shape[1])
    for channel in range(values.volts.shape[1]):
        there = np.ascontiguousarray(values.there[:PRESSES, channel])
        if there.sum() < 10:
            continue
        volts = values.volts[:PRESSES, channel][there]
        found = [_likeliest(*eigen(there.tobytes(), width), volts - volts.mean()) for width in WIDTHS]
        noise[channel], certainty[channel] = max(found, key=lambda pair: pair[1])
    return Smooth(noise, certainty)


def _likeliest(sizes: np.ndarray, vectors: np.ndarray, volts: np.ndarray) -> tuple[float, float]:
    """Noise, and logarithm of the likelihood against that of no function, of the likeliest of `RATIOS`."""
    turned = (vectors.T @ volts) ** 2
    spread = 1 + RATIOS[:, None] * np.maximum(sizes, 0)
    noise = np.maximum((turned / spread).mean(axis=1), 1e-300)
    likelihood = -0.5 * (len(volts) * np.log(noise) + np.log(spread).sum(axis=1))
    best = int(np.argmax(likelihood))
    return float(np.sqrt(noise[best])), float(likelihood[best] - likelihood[0])


MIN_PAIRS = 30
"""Pairs of presses from which a line is fitted."""


def response_scatter(pad: LaidPad, presses: Responses, noise_v: Array) -> TwinScatter:
    """Estimate what of the scatter of responses grows with them.

    Args:
        pad: as it was fitted to the presses.
        presses: their responses, of the live channels.
        noise_v: (C,) standard deviation of each channel's scatter in all.

    Returns:
        The scatter; none that grows where too few presses can tell.
    """
    valid = np.flatnonzero(presses.there.all(axis=1))
    if len(valid) < 2 * MIN_PAIRS:
        return TwinScatter()
    pairs = valid[KDTree(presses.positions_mm[valid]).query(presses.positions_mm[valid], 2)[1]]
    first, second = np.unique(np.sort(pairs, axis=1), axis=0).T
    expected = pad.predict(presses.positions_mm) - pad.own[:, 1]
    difference = (presses.volts - expected)[first] - (presses.volts - expected)[second]
    response = (expected[first] + expected[second]) / 2 / noise_v
    variance = (difference / noise_v) ** 2 / 2
    floor, share = 1.0, 0.0
    for _ in range(10):  # a variance of one pair scatters by about itself
        weight = 1 / (floor + share * response.ravel() ** 2).clip(1e-3)
        lines = np.column_stack([np.ones(response.size), response.ravel() ** 2])
        (floor, share), _ = nnls(weight[:, None] * lines, weight * variance.ravel())
    above = np.triu_indices(response.shape[1], 1)
    scale = 1 / (floor + share * response**2).clip(1e-3)
    alike, product = (
        np.einsum("qc,qd->qcd", each * scale**0.5, each * scale**0.5)[:, above[0], above[1]]
        for each in (response, difference / noise_v / np.sqrt(2))
    )
    squared = share * (alike**2).sum()
    common = float((alike * product).sum() / squared) if squared > 0 else 0.0
    share, floor = (float(np.sqrt(min(each, 1.0))) for each in (share, floor))
    return TwinScatter(share, float(np.clip(common, 0, 0.99)), floor)


SMOOTH = 0.3
"""Length over which ways aside and sensitivities change, as a share of the fibre."""
FRAME_SD = np.array([0.1, 5.0, 5.0, 0.05])
"""How far turn (rad), shift (mm) and scale are taken to be from a quarter turn, 0 and 1: standard deviations."""
ANGLE_SD = 0.3
"""The same of the reach's dependence on the angle, of 0."""
BEND = 0.15
"""Standard deviation of the second differences of a profile's splines, as shares of its largest weight."""
ASIDE_MM, UNEVEN = (0.1, 1.2), (0.02, 0.4)
"""Ranges of the standard deviations of the way aside, mm, and of the logarithm of the sensitivity."""
LEARNT_FROM = 3
"""Step from which these are learnt; before, a pad that fits badly would pass for one that was laid badly."""
FLAT = 1e-4
"""Relative change of the objective below which a fit is at its end."""
STIFFEST = 1e8
"""Damping at which nothing moves any more."""


@dataclass(frozen=True)
class Freedom:
    """What may differ from the plan, and how far it does: standard deviations; 0 where it may not.

    Attributes:
        aside_mm: of fibres beside their plan. uneven: of the logarithm of their sensitivity. angle: whether the reach
            may depend on the angle.
    """

    aside_mm: float = 0.0
    uneven: float = 0.0
    angle: bool = False

    def free(self, channels: int) -> Mask:
        """Which of `LaidPad.values` are fitted."""
        own = np.ones((channels, OWN), bool)
        own[:, AWAY], own[:, COUNTS] = self.aside_mm > 0, self.uneven > 0
        shared = np.ones(SHARED, bool)
        shared[4 + SPLINES :] = self.angle
        return np.concatenate([shared, own.ravel()])


@dataclass(frozen=True)
class Fit:
    """A laid pad with the certainty of what was fitted.

    Attributes:
        pad: the most probable one. freedom: as learnt. covariance: of `pad.values`.
        evidence: logarithm of how probable the presses are whatever the values, to compare fits to the same presses.
    """

    pad: LaidPad
    freedom: Freedom
    covariance: Array
    evidence: float

    def unsure(self, channel: int) -> Array:
        """(F,) standard deviation of how far each element of a channel's fibre lies beside its plan, grid units."""
        own = own_values(channel)[AWAY]
        _, first, share = along_fibre(np.zeros((1, ASIDE)), ELEMENTS)
        basis = np.zeros((ELEMENTS, ASIDE))
        np.put_along_axis(basis, first[:, None] + np.arange(4), share[0], axis=1)
        blocks = [self.covariance[np.ix_(part, part)] for part in np.split(own, 2)]
        return np.sqrt(np.maximum(sum(np.einsum("fj,jk,fk->f", basis, block, basis) for block in blocks), 0))


def fit(pad: LaidPad, presses: Responses, freedom: Freedom, steps: int = 25, caution: Array | float = 1.0) -> Fit:
    """The most probable pad, from `pad` on.

    Args:
        caution: (C,) by how much what is left over counts as more than the noise of a single press, since neighbouring
            presses share what a pad cannot explain.
    """
    free = np.flatnonzero(freedom.free(len(pad.fibres)))
    damping, now = 1e-3, _Objective(pad, presses, freedom, caution, np.sqrt(presses.spread) / 2)
    for step in range(steps):
        matrix, slope = now.normal_equations()
        ahead = None
        while ahead is None and damping < STIFFEST:
            ahead = now.moved(_solved(matrix, slope, free, damping))
            if ahead.value >= now.value:
                damping, ahead = 4 * damping, None
        if ahead is None:
            break
        gain, damping = now.value - ahead.value, max(damping / 16, 1e-7)
        now = ahead.learnt(_inverse(matrix, free) if step >= LEARNT_FROM else None)
        if gain < FLAT * abs(now.value):
            break
    matrix = now.normal_equations()[0]
    return Fit(now.pad, now.freedom, _inverse(matrix, free), now.evidence(matrix, free))


def _solved(matrix: Array, slope: Array, free: Indices, damping: float) -> Array:
    own = matrix[np.ix_(free, free)]
    out = np.zeros(len(slope))
    out[free] = cho_solve(cho_factor(own + damping * np.diag(np.diag(own))), slope[free])
    return out


def _inverse(matrix: Array, free: Indices) -> Array:
    """The inverse of the part of a matrix of values that are `free`, 0 elsewhere."""
    out = np.zeros_like(matrix)
    out[np.ix_(free, free)] = cho_solve(cho_factor(matrix[np.ix_(free, free)]), np.eye(len(free)))
    return out


def _stiffness(count: int) -> Array:
    """(count, count) inverse covariance of the coefficients of a smooth curve of unit variance along a fibre."""
    at = np.arange(count) / (count - 3)
    alike = np.exp(-0.5 * ((at[:, None] - at) / SMOOTH) ** 2) + 1e-4 * np.eye(count)
    return np.asarray(np.linalg.inv(alike), np.float64)


ASIDE_STIFFNESS = np.kron(np.eye(2), _stiffness(ASIDE)).astype(np.float64)
SENSITIVITY_STIFFNESS = _stiffness(SENSITIVITY)


def _profile_stiffness() -> Array:
    """(SPLINES, SPLINES) inverse covariance of a profile's coefficients, mirrored at 0 and 0 from their end on."""
    bends = np.diag(np.full(SPLINES, -2.0)) + np.eye(SPLINES, k=1) + np.eye(SPLINES, k=-1)
    bends[0, 1] = 2.0
    return bends.T @ bends / BEND**2


PROFILE_STIFFNESS = _profile_stiffness()


class _Objective:
    """Twice the negative logarithm of how probable a pad is, given presses; `noise` (C,) V is what is left over."""

    def __init__(
        self, pad: LaidPad, presses: Responses, freedom: Freedom, caution: Array | float, noise: Array
    ) -> None:
        self.pad, self.freedom, self.noise, self._presses, self._caution = pad, freedom, noise, presses, caution
        volts, self._rates = pad.parts(presses.positions_mm)
        self._left = np.where(presses.there, presses.volts - volts, 0.0)
        self._precision, self._off = self._prior()
        self.value = self._valued()

    def moved(self, step: Array) -> "_Objective":
        """The objective `step` further on."""
        return _Objective(self.pad.at(self.pad.values + step), self._presses, self.freedom, self._caution, self.noise)

    def normal_equations(self) -> tuple[Array, Array]:
        """The matrix J' J of all values and J' of what is left over, with what was known beforehand."""
        matrix, slope = self._precision.copy(), -self._precision @ self._off
        for c, rates in enumerate(self._rates):
            columns = np.concatenate([np.arange(SHARED), own_values(c)])
            there = rates * (self._presses.there[:, c, None] / self.noise[c])
            matrix[np.ix_(columns, columns)] += there.T @ there
            slope[columns] += there.T @ (self._left[:, c] / self.noise[c])
        reach = np.arange(4, 4 + SPLINES)
        # reach and gains share one scale, which `at` settles; this alone keeps the matrix from being singular
        matrix[reach, reach] += 1e-3 * matrix[reach, reach].max()
        return matrix, slope

    def learnt(self, covariance: Array | None) -> "_Objective":
        """The same pad with the noise, and with a covariance the freedom, that it now shows."""
        counts = np.maximum(self._presses.there.sum(axis=0), 1)
        self.noise = np.maximum(self._caution * np.sqrt((self._left**2).sum(axis=0) / counts), MIN_SCALE_V)
        if covariance is not None:
            aside = self._spread(covariance, AWAY, ASIDE_STIFFNESS) * self.pad.plan.unit_mm
            uneven = self._spread(covariance, COUNTS, SENSITIVITY_STIFFNESS)
            self.freedom = replace(
                self.freedom,
                aside_mm=float(np.clip(aside, *ASIDE_MM)) if self.freedom.aside_mm > 0 else 0.0,
                uneven=float(np.clip(uneven, *UNEVEN)) if self.freedom.uneven > 0 else 0.0,
            )
            self._precision, self._off = self._prior()
        self.value = self._valued()
        return self

    def evidence(self, matrix: Array, free: Indices) -> float:
        """Laplace's approximation, but for a constant: the objective, and by how much presses narrow the values."""
        known = free[np.diag(self._precision)[free] > 0]
        before = np.linalg.slogdet(self._precision[np.ix_(known, known)])[1]
        return -0.5 * (self.value + np.linalg.slogdet(matrix[np.ix_(free, free)])[1] - before)

    def _valued(self) -> float:
        counts = self._presses.there.sum(axis=0)
        misfit = ((self._left / self.noise) ** 2).sum() + 2 * (counts * np.log(self.noise)).sum()
        return float(misfit + self._off @ self._precision @ self._off)

    def _prior(self) -> tuple[Array, Array]:
        """The inverse covariance of all values beforehand, and how far they are from what was expected."""
        pad, size = self.pad, len(self.pad.values)
        precision, off = np.zeros((size, size)), pad.values.copy()
        quarter = np.pi / 2
        off[:4] -= [np.round(off[0] / quarter) * quarter, 0.0, 0.0, 1.0]
        diagonal = np.zeros(SHARED)
        diagonal[:4], diagonal[4 + SPLINES :] = FRAME_SD**-2.0, ANGLE_SD**-2.0
        precision[np.arange(SHARED), np.arange(SHARED)] = diagonal
        for profile in (slice(4, 4 + SPLINES), slice(4 + SPLINES, SHARED)):
            precision[profile, profile] += PROFILE_STIFFNESS
        for c in range(len(pad.fibres)):
            own = own_values(c)
            for part, stiffness, sd in (
                (own[AWAY], ASIDE_STIFFNESS, self.freedom.aside_mm / pad.plan.unit_mm),
                (own[COUNTS], SENSITIVITY_STIFFNESS, self.freedom.uneven),
            ):
                if sd > 0:
                    precision[np.ix_(part, part)] = stiffness / sd**2
        return precision, off

    def _spread(self, covariance: Array, part: slice, stiffness: Array) -> float:
        """Standard deviation that the curves of all channels show, their own uncertainty included."""
        own = self.pad.own[:, part]
        blocks = [covariance[np.ix_(rows, rows)] for c in range(len(own)) for rows in [own_values(c)[part]]]
        total = np.einsum("cj,jk,ck->", own, stiffness, own) + sum(np.trace(stiffness @ block) for block in blocks)
        return float(np.sqrt(total / own.size))


WIDTH = 0.55
"""Standard deviation of the Gaussian reach that is tried first, grid units."""
PRESSES_WIRING = 400
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
        chosen = np.sort(rng.choice(len(presses), min(PRESSES_WIRING, len(presses)), replace=False))
        self._plan, self._presses = plan, presses.of(chosen)
        self._course, self._length = plan.course[:, ::COARSE], plan.length[:, ::COARSE]
        self._there = self._presses.there
        self._volts = _centred(self._presses.volts, self._there)

    def __call__(self, frame: PlanTransform, width: float) -> Wiring:
        """The best wiring for a frame."""
        places = self._plan.to_grid(frame.to_plan(self._presses.positions_mm))
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
    middle = presses.positions_mm.min(axis=0) / 2 + presses.positions_mm.max(axis=0) / 2
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
