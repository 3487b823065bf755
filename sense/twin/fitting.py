"""How a laid pad is fitted to presses: the most probable one, by the Levenberg-Marquardt method.

What is left over counts as noise of each channel's own size. A plan is right to a millimetre or so until presses say
otherwise: fibres lie beside it by smooth curves, Gaussian with a standard deviation that is learnt with all else
(MacKay's evidence, Neural Computation 4, 1992), as is that of the sensitivity along a fibre.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from padforge.sense.recordings.processing.limits import LEAST_SPREAD_V, Array, Indices, Mask

from padforge.sense.twin.kernels.response import along_fibre
from padforge.sense.twin.laid_pad import ASIDE, AWAY, COUNTS, ELEMENTS, OWN, SENSITIVITY, SHARED, SPLINES, LaidPad, own_values
from padforge.sense.twin.responses import Responses

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
        volts, self._rates = pad.parts(presses.places_mm)
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
        self.noise = np.maximum(self._caution * np.sqrt((self._left**2).sum(axis=0) / counts), LEAST_SPREAD_V)
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
