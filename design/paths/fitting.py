"""PCHIP curves through drawn polylines, with as few knots as keep within a tolerance.

Knots are inserted where the polyline turns and where the misfit is largest, then all are moved along and across by
damped least squares (Levenberg 1944, Marquardt 1963), and removed one by one while the others suffice.
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from padforge.design.kernels.pchip import pchip_slopes
from padforge.design.morphology import Array, Ints
from padforge.design.settings import Layout

SPARE_LENGTH = 1e-4  # length of all spare knots of a fibre, grid units: far below what can be printed
_TRIAL_POSITIONS = np.array([0.15, 0.3, 0.5, 0.7, 0.85])  # positions on a span at which a knot is tried
_LEVEL_TOLERANCE = 1e-9  # rises below this are none: positions in a file in pitches are right to rounding


def add_spare_knots(paths: Sequence[Array], layout: Layout) -> Array:
    """Give all fibres the same number of knots (F, n, 2) by adding spare ones that do not change the curve.

    Args:
        paths: knots of each fibre, as in a morphology; shape (n, 2), grid units.
        layout: layout of the fibres.
    """
    n_knots = max(map(len, paths))
    return np.stack([_add_spares(path, layout.family(i), n_knots - len(path)) for i, path in enumerate(paths)])


def remove_spare_knots(knots: Array, layout: Layout) -> list[Array]:
    """Return the knots (n, 2) of each fibre without spare ones.

    Args:
        knots: shape (F, n, 2), grid units.
        layout: layout of the fibres.
    """
    paths = []
    for fibre, line in enumerate(knots):
        step = np.abs(np.diff(line, axis=0))
        axis = layout.family(fibre)
        spare = (step[:, axis] <= SPARE_LENGTH * (1 + _LEVEL_TOLERANCE)) & (step[:, 1 - axis] <= _LEVEL_TOLERANCE)
        spare[-1] = False
        paths.append(line[np.append(True, ~spare)])
    return paths


def _add_spares(path: Array, axis: int, count: int) -> Array:
    """Return a fibre with `count` more knots."""
    if not count:
        return path
    at = _find_level_knot(path[:, axis], path[:, 1 - axis])
    if at is None:
        return _add_spares(_insert_knot_on_curve(path.tobytes(), axis), axis, count - 1)
    step = min(SPARE_LENGTH, (path[at + 1, axis] - path[at, axis]) / 4) / count
    spares = np.repeat(path[at : at + 1], count, axis=0)
    spares[:, axis] += step * np.arange(1, count + 1)
    return np.insert(path, at + 1, spares, axis=0)


def _find_level_knot(along: Array, across: Array) -> int | None:
    """Find the level knot, not next to an end, with the most room behind it; None if there is none."""
    rise, room = np.diff(across), np.diff(along)
    if not rise.any():
        return int(np.argmax(room))
    level = np.append(rise[0] == 0, rise[:-1] * rise[1:] <= 0)
    level[[1, -1]] = False
    return int(np.argmax(np.where(level, room, -1))) if level.any() else None


@lru_cache(maxsize=256)  # an editor changes one fibre and leaves the others
def _insert_knot_on_curve(path: bytes, axis: int) -> Array:
    """Insert a knot on the curve of a fibre, knots (n, 2) as bytes, near an end, where it changes the curve least."""
    from scipy.interpolate import PchipInterpolator

    knots = np.frombuffer(path).reshape(-1, 2)
    along, across = knots[:, axis], knots[:, 1 - axis]
    curve = PchipInterpolator(along, across)
    spans = sorted({0, 1, len(along) - 3, len(along) - 2} & set(range(len(along) - 1)))
    positions = np.concatenate([along[k] + (along[k + 1] - along[k]) * _TRIAL_POSITIONS for k in spans])
    dense = np.concatenate([np.linspace(along[k], along[k + 1], 33) for k in spans])
    best, least = along, np.inf
    for position in positions:
        more = np.sort(np.append(along, position))
        largest_change = float(np.abs(PchipInterpolator(more, curve(more))(dense) - curve(dense)).max())
        if largest_change < least:
            best, least = more, largest_change
    result = np.empty((len(best), 2))
    result[:, axis], result[:, 1 - axis] = best, curve(best)
    result[[0, -1]] = knots[[0, -1]]
    return result


SAMPLES = 700  # samples of a polyline
_MAX_ITERATIONS = 40  # iterations of Levenberg-Marquardt
_MAX_STEP = 0.4  # largest step of a knot, as a share of the way to its neighbour
_MAX_CANDIDATES = 4  # knots whose removal is tried, those with the smallest misfit first
_MAX_DAMPINGS = 15  # increases of the damping in one iteration
_SUPPORT = 4  # spans that depend on a knot, from two before it
_MIN_SPAN = 2e-3  # smallest distance of knots along the axis, as a share of the curve's extent


def fit_knots(points: Array, tolerance: float, max_inner: int = 64) -> Array:
    """Fit the knots (n, 2) of a PCHIP curve to a polyline; misfits are measured along the normal.

    Args:
        points: coordinates along, strictly ascending, and across; shape (m, 2).
        tolerance: largest misfit, in the unit of the points.
        max_inner: largest number of inner knots; with that many the tolerance may be exceeded.
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
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.linspace(0, arc[-1], SAMPLES)
    samples = np.stack([np.interp(at, arc, points[:, axis]) for axis in (0, 1)], axis=1)
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
    """Move the inner knots along and across by the Levenberg-Marquardt algorithm."""
    if len(knots) == 2:
        return knots
    along, across = samples.T
    min_span = _MIN_SPAN * (knots[-1, 0] - knots[0, 0])

    def residual(trial: Array) -> Array:
        return (_evaluate(trial, along) - across) * weight

    damping, current = 1e-2, residual(knots)
    for _ in range(_MAX_ITERATIONS):
        jacobian = _jacobian(along, weight, knots, current + across * weight)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ current
        room = _MAX_STEP * np.maximum(np.diff(knots[:, 0]) - min_span, 0)
        scale = np.diag(normal) + 1e-12 * max(np.trace(normal), 1e-300)
        for _ in range(_MAX_DAMPINGS):
            step = np.linalg.solve(normal + damping * np.diag(scale), -gradient).reshape(-1, 2)
            step[:, 0] = np.clip(step[:, 0], -room[:-1], room[1:])
            trial = knots.copy()
            trial[1:-1] += step
            if ((new := residual(trial)) ** 2).sum() < (current**2).sum():
                break
            damping *= 5
        else:
            return knots
        gain = 1 - (new**2).sum() / (current**2).sum()
        knots, current, damping = trial, new, damping / 5
        if gain < 1e-3:
            break
    return knots


def _jacobian(along: Array, weight: Array, knots: Array, values: Array) -> Array:
    """Compute the Jacobian (m, 2 (n - 2)) of weighted values by along and across of each inner knot, by differences.

    Knots so far apart that no span depends on two of them are perturbed at once.
    """
    count = len(knots)
    out = np.zeros((len(along), count - 2, 2))
    span = np.clip(np.searchsorted(knots[:, 0], along, side="right") - 1, 0, count - 2)
    step = 1e-4 * np.diff(knots[:, 0]).min()
    for first in range(1, min(_SUPPORT + 1, count - 1)):
        group = np.arange(first, count - 1, _SUPPORT)
        owner = (span + 2 - first) // _SUPPORT  # a knot owns the spans from two before to one behind it
        is_owned = (owner >= 0) & (owner < len(group))
        rows = np.flatnonzero(is_owned)
        for axis in (0, 1):
            trial = knots.copy()
            trial[group, axis] += step
            change = (_evaluate(trial, along) * weight - values) / step
            out[rows, group[owner[rows]] - 1, axis] = change[rows]
    return out.reshape(len(along), -1)


def _remove_redundant(samples: Array, weight: Array, knots: Array, tolerance: float) -> Array:
    """Remove knots that the others do not need."""
    while len(knots) > 2:
        fewer = [np.delete(knots, k, axis=0) for k in range(1, len(knots) - 1)]
        fewer.sort(key=lambda trial: _misfit(samples, weight, trial).max())
        for trial in fewer[:_MAX_CANDIDATES]:
            optimised = _optimise(samples, weight, trial)
            if _misfit(samples, weight, optimised).max() <= tolerance:
                knots = optimised
                break
        else:
            break
    return knots
