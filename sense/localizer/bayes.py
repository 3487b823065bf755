"""Where a press lies by what the fitted pad answers, with any fibres lost: Bayes' rule, and nothing learnt by trying.

What a fibre gives is normally distributed about what the `response_model` expects at a place, with the scatter that
the presses near it had. First the likelihood of all fibres that live is looked at on a grid over the pad, each of whose
cells counts as a whole: a mean place and its spread. From there, a few Gauss-Newton steps lead to the most likely
place, the spread being what is known beforehand. (M. S. Grewal and A. P. Andrews, Kalman filtering, 2015, has the
steps as those of an iterated filter.)"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from padforge.design.common.validation import InputError
from padforge.sense.arrays import Array, Mask
from padforge.sense.localizer.features import looked_up

COMPONENTS = 6
"""Numbers that the windows of a fibre are brought down to: those in which places differ most for their scatter."""
FINE = 2
"""Cells of the table along a side of those of the grid."""
NEAR, USUAL = 4.0, 10.0
"""Scatter is averaged over presses so many distances between neighbours around, as is that of the whole pad, which
counts as so many presses."""
LEAST_VARIANCE = 1e-4
"""Of scaled inputs, which are about 1."""
BEFOREHAND = 0.05
"""Weight of what the grid says in the steps after it, which look at the same answers: a little, lest they run away."""
LOOKS, FARTHEST, LEAST_SPREAD = 2, 0.2, 1e-2
"""Steps, how far one leads, and the least spread on the grid, a seventh of a cell; both in spans of the pad."""
TOLD = 9
"""Numbers told of a press: place, mean place on the grid, logarithms of the spreads of both, and how x goes with y."""
LEAST_EXPONENT = -60.0
"""Less counts for nothing, and its exponential takes ten times as long."""
MAX_TERM = 1e12
_VALUES = 2**15


@dataclass(frozen=True)
class BayesianLocalizer:
    """What is known of a pad, as arrays of NumPy or of torch.

    Numbers are such as single precision holds. NumPy works in double precision, since the steps are as large as they
    are sure; for training, single precision does.

    Attributes:
        projection: (C, F + G, D) from scaled inputs to components.
        grid: (P, 2) places of the grid. terms: (C (D (D + 3) / 2 + 1), P) of the logarithm of their likelihood:
            factors of the products of components, of components, and of 1, fibre by fibre.
        answers: (S, S, C (3 D + 3)) by place, over [-1, 1] in x and y: components expected, their slopes in x and in y
            weighted by their scatter, and what these say of the curvature in x, in y and between.
        bounds: (2, 2) least and greatest x and y of presses.
        turn: (2, 2), shift: (2,) what places are called now, by what they were called when all this was fitted.
    """

    projection: Any
    grid: Any
    terms: Any
    answers: Any
    bounds: Any
    turn: Any
    shift: Any

    @classmethod
    def fit(cls, table: Any, inputs: Any, fibre_mask: Mask, places: Any) -> "BayesianLocalizer":
        """From a table (S, S, C, F + G) of expected inputs, and presses: inputs (Q, C, F + G), alive, places (Q, 2)."""
        side, _, fibres, size = table.shape
        table, inputs, places = (part.astype(np.float64) for part in (table, inputs, places))
        low, high = places.min(axis=0), places.max(axis=0)
        axis = np.linspace(-1, 1, side)
        everywhere = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        coarse = everywhere[::FINE, ::FINE]
        cell = float(axis[FINE] - axis[0])
        inside = ((coarse >= low - cell) & (coarse <= high + cell)).all(axis=2)
        projection = np.zeros((fibres, size, COMPONENTS))
        rest = inputs - looked_up(table.reshape(side, side, -1), places).reshape(inputs.shape)
        for fibre in range(fibres):
            told, there = table[:, :, fibre].any(axis=(0, 1)), fibre_mask[:, fibre]
            found = _components(table[:, :, fibre, told].reshape(side * side, -1), rest[there, fibre][:, told])
            projection[fibre, told] = found
        rest = np.einsum("qcf,cfd->qcd", rest, projection) * fibre_mask[:, :, None]
        scatter = _scatter(coarse.reshape(-1, 2), places, rest, fibre_mask, max(cell, NEAR * _apart(places)))
        scatter = scatter.reshape(*coarse.shape[:2], fibres, -1)
        terms, answers, slopes, curvatures = [], [], [], []
        for fibre in range(fibres):
            expected = table[:, :, fibre] @ projection[fibre]
            own = looked_up(scatter[:, :, fibre], everywhere.reshape(-1, 2))
            own = own.reshape(side, side, COMPONENTS, COMPONENTS)
            nothing = np.flatnonzero(~projection[fibre].any(axis=0))
            own[:, :, nothing, nothing] = 1.0  # as sure of it everywhere, or it would tell where presses are dense
            slope = np.stack(np.gradient(expected, axis[1] - axis[0], axis=(0, 1)), axis=2)
            weighted = slope @ np.linalg.inv(own)
            curved = weighted @ slope.swapaxes(2, 3)
            answers.append(expected)
            slopes.append(weighted.reshape(side, side, -1))
            along = (np.maximum(curved[..., k, k], 0) for k in (0, 1))  # rounding may leave less than none
            curvatures.append(np.stack([*along, curved[..., 0, 1]], axis=2))
            at = slope[::FINE, ::FINE][inside]
            whole = own[::FINE, ::FINE][inside] + cell**2 / 12 * at.swapaxes(1, 2) @ at
            terms.append(_terms(expected[::FINE, ::FINE][inside], np.linalg.inv(whole)))
        parts = (
            projection,
            coarse[inside],
            np.concatenate(terms),
            np.concatenate([*answers, *slopes, *curvatures], axis=2),
        )
        return cls(*(_rounded(part) for part in (*parts, np.stack([low, high]), np.eye(2), np.zeros(2))))

    def __call__(self, inputs: Any, fibre_mask: Any, xp: Any = np) -> tuple[Any, Any]:
        """(Q, C, F + G) scaled inputs and (Q, C) which count, to places (Q, 2) and what is told of them (Q, `TOLD`).

        Args:
            xp: the module whose arrays all these are, numpy or torch.
        """
        fibres, _, size = self.projection.shape
        there = xp.asarray(fibre_mask, dtype=inputs.dtype)
        seen = xp.matmul(xp.where(fibre_mask[:, :, None], inputs, 0.0).swapaxes(0, 1), self.projection).swapaxes(0, 1)
        mean, variance, both = self._on_grid(seen, there, xp)
        known, place, spread = BEFOREHAND / variance, mean, variance
        for _ in range(LOOKS):
            found = looked_up(self.answers, place, xp)
            off = there[:, :, None] * (seen - found[:, : fibres * size].reshape(-1, fibres, size))
            slopes = found[:, fibres * size : 3 * fibres * size].reshape(-1, fibres, 2, size)
            curved = (there[:, :, None] * found[:, 3 * fibres * size :].reshape(-1, fibres, 3)).sum(axis=1)
            pull = (slopes * off[:, :, None, :]).sum(axis=3).sum(axis=1) + known * (mean - place)
            spread, step = _solved(curved, known, pull, xp)
            place = xp.clip(place + xp.clip(step, -FARTHEST, FARTHEST), self.bounds[0], self.bounds[1])
        told = [2 * place, 1 + 0.25 * xp.log(spread), 2 * mean, 1 + 0.25 * xp.log(variance), both[:, None]]
        return place @ self.turn.T + self.shift, xp.concat(told, axis=1)

    def _on_grid(self, seen: Any, there: Any, xp: Any) -> tuple[Any, Any, Any]:
        """Mean place (Q, 2), its variances (Q, 2) and correlation (Q,) on the grid."""
        first, second = (each.tolist() for each in np.triu_indices(seen.shape[2]))
        known = xp.concat([seen[:, :, first] * seen[:, :, second], seen, xp.ones_like(seen[:, :, :1])], axis=2)
        likely = (known * there[:, :, None]).reshape(len(seen), -1) @ self.terms
        likely -= xp.amax(likely, axis=1)[:, None]  # in place, as to fetch memory takes as long as to fill it
        share = xp.exp(xp.clip(likely, LEAST_EXPONENT, 0.0, out=likely), out=likely)
        moments = share @ xp.concat([self.grid, self.grid**2, self.grid[:, :1] * self.grid[:, 1:]], axis=1)
        moments = moments / share.sum(axis=1)[:, None]
        mean = moments[:, :2]
        variance = xp.clip(moments[:, 2:4] - mean**2, LEAST_SPREAD**2, 4.0)
        both = (moments[:, 4] - mean[:, 0] * mean[:, 1]) / xp.sqrt(variance[:, 0] * variance[:, 1])
        return mean, variance, xp.clip(both, -1, 1)

    def refuse_unsound(self, fibres: int, size: int) -> None:
        """Raise InputError unless this is what `fit` makes of `fibres` with `size` inputs each."""
        shapes = [part.shape for part in self.arrays().values()]
        places, side = (len(self.grid), len(self.answers)) if self.grid.ndim and self.answers.ndim else (0, 0)
        terms = fibres * (COMPONENTS * (COMPONENTS + 3) // 2 + 1)
        expected = [
            *((fibres, size, COMPONENTS), (places, 2), (terms, places), (side, side, fibres * 3 * (COMPONENTS + 1))),
            *((2, 2), (2, 2), (2,)),
        ]
        if shapes != expected or not places or side < 2:
            raise InputError(f"observer has shapes {shapes}, expected {expected}")
        for name, part in self.arrays().items():
            greatest = np.abs(part).max(initial=0)
            if not greatest <= MAX_TERM:
                raise InputError(f"{name} is up to {greatest:g}, allowed is up to {MAX_TERM:g}")
        curved = self.answers[:, :, 3 * fibres * COMPONENTS :].reshape(side, side, fibres, 3)[..., :2]
        if curved.min() < 0:
            raise InputError(f"observer.answers has curvatures of {curved.min():g}, expected 0 or more")

    def arrays(self) -> dict[str, Any]:
        """All of it, by the names under which it is kept, in single precision, which takes nothing off it."""
        return {PREFIX + each.name: getattr(self, each.name).astype(np.float32) for each in fields(self)}

    def moved(self, turn: Array, shift: Array) -> "BayesianLocalizer":
        """One that calls places otherwise: by turn (2, 2) and shift (2,) of what it calls them now."""
        named = (turn @ self.turn, turn @ self.shift + shift)
        return replace(self, turn=_rounded(named[0]), shift=_rounded(named[1]))

    def changed(self, change: Callable[[Any], Any]) -> "BayesianLocalizer":
        """With every array, in single precision, changed: as into one of torch."""
        return BayesianLocalizer(*map(change, self.arrays().values()))

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> "BayesianLocalizer":
        """What `arrays` gave; raises KeyError for one that is not there."""
        return cls(**{each.name: arrays[PREFIX + each.name].astype(np.float64) for each in fields(cls)})


PREFIX = "observer."
"""Of the names of its arrays."""


def _rounded(part: Array) -> Array:
    return part.astype(np.float32).astype(np.float64)


def _scatter(around: Array, places: Array, rest: Array, fibre_mask: Mask, width: float) -> Any:
    """(P, C, D, D) mean products of what is left (Q, C, D) of components, which are about 1, near places (P, 2)."""
    fibres, size = rest.shape[1:]
    sums, weights = np.zeros((len(around), fibres * size * size)), np.zeros((len(around), fibres))
    step = max(1, _VALUES // fibres)
    for first in range(0, len(rest), step):
        part = slice(first, first + step)
        apart = ((around[:, None] - places[part]) ** 2).sum(axis=2)
        near = np.exp(-0.5 * apart / width**2)
        sums += near @ (rest[part, :, :, None] * rest[part, :, None, :]).reshape(near.shape[1], -1)
        weights += near @ fibre_mask[part]
    usual = USUAL * np.eye(size)
    return (sums.reshape(-1, fibres, size, size) + usual) / (weights + USUAL)[:, :, None, None]


def _apart(places: Array) -> float:
    """Distance between neighbours, if they lay on a grid."""
    low, high = places.min(axis=0), places.max(axis=0)
    return float(np.sqrt((high - low).prod() / len(np.unique(places, axis=0))))


def _components(expected: Array, rest: Array) -> Array:
    """(F, D) directions in which (S, F) expected inputs differ most, for the scatter of (Q, F), which they make 1."""
    size = rest.shape[1]
    scatter = rest.T @ rest / max(len(rest), 1) + LEAST_VARIANCE * np.eye(size)
    whiten = np.linalg.inv(np.linalg.cholesky(scatter)).T
    differing = (expected - expected.mean(axis=0)) @ whiten
    _, directions = np.linalg.eigh(differing.T @ differing)
    found = np.zeros((size, COMPONENTS))
    found[:, : min(size, COMPONENTS)] = whiten @ directions[:, ::-1][:, :COMPONENTS]
    return found


def _terms(expected: Array, precise: Array) -> Array:
    """(D (D + 3) / 2 + 1, P) of the logarithm of a normal density about (P, D), of precision (P, D, D)."""
    first, second = np.triu_indices(expected.shape[1])
    products = -precise[:, first, second] * np.where(first == second, 0.5, 1.0)
    linear = np.einsum("pij,pj->pi", precise, expected)
    whole = 0.5 * (np.linalg.slogdet(precise)[1] - (linear * expected).sum(axis=1))
    terms = np.column_stack([products, linear, whole]).T
    return terms - terms.mean(axis=1, keepdims=True)  # what all places share says nothing, and costs digits


def _solved(curved: Any, known: Any, pull: Any, xp: Any) -> tuple[Any, Any]:
    """(Q, 2) variances and steps of (Q, 3) curvatures in x, in y and between, and (Q, 2) of what is known before."""
    x, y = curved[:, 0] + known[:, 0], curved[:, 1] + known[:, 1]
    own = xp.clip(curved[:, 0] * curved[:, 1] - curved[:, 2] ** 2, 0.0, np.inf)  # rounding may leave less than none
    whole = own + curved[:, 0] * known[:, 1] + curved[:, 1] * known[:, 0] + known[:, 0] * known[:, 1]
    step = xp.stack([y * pull[:, 0] - curved[:, 2] * pull[:, 1], x * pull[:, 1] - curved[:, 2] * pull[:, 0]], axis=1)
    return xp.stack([y, x], axis=1) / whole[:, None], step / whole[:, None]
