"""Knots of a fibre fitted to a drawn curve.

Knots are inserted where a curve turns and where the misfit is largest, then all are moved along and across by
non-linear least squares (SciPy's), and removed one by one while the others suffice.
"""

from typing import Any

import numpy as np

from padforge.design.kernels.pchip import pchip_slopes
from padforge.design.morphology import Array, Ints
from padforge.design.paths.curves import arc_lengths, interpolate

SAMPLES = 700  # samples of a polyline
_MAX_STEP = 0.4  # largest shift of a knot along the axis in one fit, as a share of the way to its neighbour
_TINY = 1e-12  # minimum room of a knot, since bounds must differ
_SUPPORT = 3  # spans on either side of a knot that depend on it: two by PCHIP, and one more as it moves
_MIN_SPAN = 2e-3  # smallest distance of knots along the axis, as a share of the curve's extent


def fit_knots(points: Array, tolerance: float, max_inner: int = 64) -> Array:
    """Fit the knots (n, 2) of a PCHIP curve to a polyline (m, 2); misfits are measured along the normal.

    Coordinates along ascend strictly. If `max_inner` inner knots do not suffice, the misfit exceeds the tolerance.
    """
    samples, weight = _sample(points)
    knots = samples[_find_turns(samples, tolerance)]
    if len(knots) > max_inner + 2:  # more turns than knots
        return np.vstack([knots[: max_inner + 1], knots[-1:]])
    while True:
        knots = _optimise(samples, weight, knots)
        misfit = _misfit(samples, weight, knots)
        if misfit.max() <= tolerance or len(knots) >= max_inner + 2:
            break
        knots = _insert_knots(samples, knots, misfit, tolerance, max_inner + 2 - len(knots))
    return _remove_redundant(samples, weight, knots, tolerance)


def _sample(points: Array) -> tuple[Array, Array]:
    """Sample a polyline evenly (m, 2), and return the ratio of misfit along the normal to that across."""
    arc = arc_lengths(points)
    samples = interpolate(points, arc, np.linspace(0, arc[-1], SAMPLES))
    samples[-1] = points[-1]
    samples = samples[np.append(True, samples[1:, 0] > np.maximum.accumulate(samples[:, 0])[:-1])]
    slope = np.gradient(samples[:, 1], samples[:, 0]) if len(samples) > 1 else np.zeros(1)
    return samples, 1 / np.sqrt(1 + slope**2)


def _find_turns(samples: Array, tolerance: float) -> Ints:
    """Find the samples at which the polyline turns back by more than the tolerance, and its ends.

    A PCHIP curve turns only at knots.
    """
    across, turns, direction, extreme = samples[:, 1], [0], 0, 0
    for k, value in enumerate(across):
        further = value - across[extreme]
        if direction == 0 and abs(value - across[0]) > tolerance:
            direction, extreme = (1 if value > across[0] else -1), k
        elif direction and further * direction >= 0:
            extreme = k
        elif direction and -further * direction > tolerance:
            turns.append(extreme)
            direction, extreme = -direction, k
    return np.unique([*turns, len(samples) - 1])


def _evaluate(knots: Array, along: Array) -> Array:
    """Evaluate the PCHIP curve through knots at ascending coordinates."""
    t, v = np.ascontiguousarray(knots[:, 0]), np.ascontiguousarray(knots[:, 1])
    d = np.empty(len(t))
    pchip_slopes(t, v, d)
    span = np.clip(np.searchsorted(t, along, side="right") - 1, 0, len(t) - 2)
    h = t[span + 1] - t[span]
    s, rise = (along - t[span]) / h, v[span + 1] - v[span]
    a, b = h * d[span], h * d[span + 1]
    return v[span] + s * (a + s * (3 * rise - 2 * a - b + s * (a + b - 2 * rise)))


def _misfit(samples: Array, weight: Array, knots: Array) -> Array:
    """Return the misfit along the normal at each sample."""
    return np.abs(_evaluate(knots, samples[:, 0]) - samples[:, 1]) * weight


def _insert_knots(samples: Array, knots: Array, misfit: Array, tolerance: float, limit: int) -> Array:
    """Insert up to `limit` knots, the worst first, each where a span's misfit is largest and above the tolerance."""
    span = np.clip(np.searchsorted(knots[:, 0], samples[:, 0], side="right") - 1, 0, len(knots) - 2)
    worst = []
    for k in range(len(knots) - 1):
        inside = np.flatnonzero(span == k)[1:]
        if len(inside) and misfit[inside].max() > tolerance:
            worst.append(int(inside[np.argmax(misfit[inside])]))
    new = samples[sorted(worst, key=lambda at: -misfit[at])[:limit]]
    if not len(new):  # spans shorter than the distance of samples
        longest = int(np.argmax(np.diff(knots[:, 0])))
        new = knots[longest : longest + 2].mean(axis=0, keepdims=True)
    combined = np.vstack([knots, new])
    return combined[np.argsort(combined[:, 0], kind="stable")]


def _optimise(samples: Array, weight: Array, knots: Array) -> Array:
    """Move the inner knots along and across by fits within the room between them, while the misfit falls by 1 %."""
    cost = np.inf
    for _ in range(20 if len(knots) > 2 else 0):
        fit = _fit_within_room(samples, weight, knots)
        knots = np.vstack([knots[:1], fit.x.reshape(-1, 2), knots[-1:]])
        if fit.cost > 0.99 * cost:
            break
        cost = fit.cost
    return knots


def _fit_within_room(samples: Array, weight: Array, knots: Array) -> Any:
    """Fit inner knots that stay within a share of the way to their neighbours, so that they keep their order."""
    from scipy.optimize import least_squares

    along, across = samples.T

    def residual(inner: Array) -> Array:
        return (_evaluate(np.vstack([knots[:1], inner.reshape(-1, 2), knots[-1:]]), along) - across) * weight

    min_span = _MIN_SPAN * (knots[-1, 0] - knots[0, 0])
    room = _MAX_STEP * np.maximum(np.diff(knots[:, 0]) - min_span, 0) + _TINY
    bounds = np.full((2, len(knots) - 2, 2), np.inf) * [[[-1]], [[1]]]
    bounds[:, :, 0] = knots[1:-1, 0] - room[:-1], knots[1:-1, 0] + room[1:]
    span = np.clip(np.searchsorted(knots[:, 0], along, side="right") - 1, 0, len(knots) - 2)
    depends = np.abs(span[:, None] - np.arange(1, len(knots) - 1) + 0.5) < _SUPPORT
    return least_squares(
        residual,
        knots[1:-1].ravel(),
        bounds=bounds.reshape(2, -1),
        jac_sparsity=np.repeat(depends, 2, axis=1),  # knots that share no span are differentiated together
        x_scale="jac",
        ftol=1e-3,
        max_nfev=8,
    )


def _remove_redundant(samples: Array, weight: Array, knots: Array, tolerance: float) -> Array:
    while len(knots) > 2:
        fewer = [np.delete(knots, k, axis=0) for k in range(1, len(knots) - 1)]
        fewer.sort(key=lambda trial: _misfit(samples, weight, trial).max())
        for trial in fewer[:4]:  # without the knots whose removal gives the smallest misfit
            optimised = _optimise(samples, weight, trial)
            if _misfit(samples, weight, optimised).max() <= tolerance:
                knots = optimised
                break
        else:
            break
    return knots
