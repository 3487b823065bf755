"""Import of a drawing as a pad: matching curves to fibres, and fitting knots to them.

Knots are inserted where a curve turns and where the misfit is largest, then all are moved along and across by
non-linear least squares (SciPy's), and removed one by one while the others suffice.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from padforge.common.validation import InputError
from padforge.design.kernels.pchip import pchip_slopes
from padforge.design.morphology import Array, Ints, Morphology
from padforge.design.paths.curves import add_spare_knots, flatten
from padforge.design.paths.drawing_files import DrawnCurve, DrawnPlan, read_dxf, read_svg
from padforge.design.settings import Layout

READERS = {".svg": read_svg, ".dxf": read_dxf}
MAX_KNOTS = 64  # inner knots of a fibre, as of `[search] knots`
MAX_CURVES_PER_FIBRE = 8  # beyond, messages on single curves would not help
_FAMILIES = "horizontal", "vertical"
_MAX_BACKTRACK_MM = 2e-4  # largest step backwards along the axis: files are rounded
_MARGIN_MM = 1.0  # beyond this margin across the pad, curves are leads to its other sides, which are ignored
_ASPECT_TOLERANCE = 2e-3  # largest relative difference in aspect ratio of the drawn border and the pad
_FIT_SHARE = 0.8  # tolerance of the fit, relative to the stated one: the fit measures its misfit at samples only
_FLATNESS_MM = 1e-3  # tolerance to which curves are compared
SAMPLES = 700  # samples of a polyline
_MAX_ROUNDS = 20  # fits, each within the room between the knots of the last
_MIN_GAIN = 0.01  # relative gain in squared misfit from which another fit follows
_MAX_STEP = 0.4  # largest shift of a knot along the axis in one fit, as a share of the way to its neighbour
_TINY = 1e-12  # room of a knot that has none: bounds must differ
_MAX_CANDIDATES = 4  # knots whose removal is tried, those with the smallest misfit first
_SUPPORT = 3  # spans on either side of a knot that may depend on it, while it moves within one
_MIN_SPAN = 2e-3  # smallest distance of knots along the axis, as a share of the curve's extent


@dataclass(frozen=True)
class ImportedFibre:
    """A curve that became a fibre."""

    name: str  # of the curve in the drawing
    end_shift_mm: float  # distance by which its ends were moved to the fibre's
    max_error_mm: float  # largest distance of fibre and curve on the pad


@dataclass(frozen=True)
class ImportedPlan:
    """A drawing that became a pad."""

    pad: Morphology
    fibres: tuple[ImportedFibre, ...]  # in the order of the pad's fibres
    placement: str  # how the drawing was positioned on the pad


@dataclass(frozen=True)
class _FibrePath:
    """A curve on the pad."""

    name: str
    fibre: int  # the one whose ends are nearest
    points: Array  # along and across the fibre's axis, from border to border; shape (n, 2), mm from the middle
    error_mm: float  # largest distance of its ends to the fibre's


def import_plan(path: Path, layout: Layout, tolerance_mm: float) -> ImportedPlan:
    """Import a drawing: one curve a fibre, each a function of the coordinate along its axis.

    The curves are those whose layer, group or name begins with fibre, horizontal or vertical, or all open curves. The
    border is what is named pad. Without one the drawing is positioned where the ends fit best: its origin in the middle
    or in a corner of the pad, or the middle of its curves in the middle. What lies beyond the pad is ignored.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: ends in {path.suffix or 'nothing'}, allowed are {' and '.join(READERS)}")
    try:
        drawing = reader(path)
        curves = drawing.fibres
        if not curves:
            raise InputError("there is no open curve in it")
        if len(curves) > MAX_CURVES_PER_FIBRE * layout.fibres:
            hint = "put these into a layer or group whose name begins with fibre"
            raise InputError(f"it has {len(curves)} open curves, expected {layout.fibres}, one a fibre; {hint}")
        candidates, placement = _place_curves(drawing, curves, layout)
        fibre_paths = _match_fibres(candidates, layout, tolerance_mm)
        pad = Morphology.from_layout(_fit_paths(fibre_paths, layout, tolerance_mm), layout)
        lines = flatten(pad, _FLATNESS_MM / layout.unit_mm)
        fibres = [_check_fit(line, drawn, layout, tolerance_mm) for line, drawn in zip(lines, fibre_paths, strict=True)]
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    return ImportedPlan(pad, tuple(fibres), placement + (f"; {drawing.note}" if drawing.note else ""))


def _place_curves(drawing: DrawnPlan, curves: Sequence[DrawnCurve], layout: Layout) -> tuple[list[_FibrePath], str]:
    """Return the curves on the pad, and a description of how the drawing was positioned."""
    size = np.array(layout.size_mm)
    if (border := drawing.border) is not None:
        width, height = border[1] - border[0]
        ratio = (border[1] - border[0]) / size
        if not (ratio > 0).all() or abs(ratio[0] / ratio[1] - 1) > _ASPECT_TOLERANCE:
            shape = f"{size[0]:g} by {size[1]:g} mm"
            raise InputError(f"pad is drawn {width:g} by {height:g}, expected the shape of {shape}")
        lines = [(curve.points - border.mean(axis=0)) / ratio for curve in curves]
        return _assign_curves(curves, lines, layout), "the border is that named pad"
    lines = [curve.points * drawing.unit_mm for curve in curves]
    points = np.vstack(lines)
    origins = {
        "its origin is the middle of the pad": np.zeros(2),
        "its origin is the lower left corner of the pad": size / 2,
        "its origin is the upper left corner of the pad": size / 2 * [1, -1],
        "the middle of its curves is that of the pad": (points.min(axis=0) + points.max(axis=0)) / 2,
    }
    placements: list[tuple[float, str, list[_FibrePath] | InputError]] = []
    for description, middle in origins.items():
        try:
            paths = _assign_curves(curves, [line - middle for line in lines], layout)
        except InputError as error:
            placements.append((np.inf, description, error))
        else:
            placements.append((sum(path.error_mm for path in paths), description, paths))
    limit = min(error for error, _, _ in placements) + _FLATNESS_MM * len(lines)
    _, description, paths = next(placement for placement in placements if placement[0] <= limit)
    if isinstance(paths, InputError):
        raise paths
    return paths, description


def _assign_curves(curves: Sequence[DrawnCurve], lines: Sequence[Array], layout: Layout) -> list[_FibrePath]:
    """Assign each curve to the nearest fibre, of the family that it fits better."""
    paths = []
    for curve, line in zip(curves, lines, strict=True):
        candidates, errors = [], []
        for family in (0, 1):
            if layout.counts[family]:
                try:
                    candidates.append(_assign_to_family(curve.name, line, family, layout))
                except InputError as error:
                    errors.append((abs(np.diff(line[[0, -1], family])[0]), error))
        if not candidates:
            raise max(errors, key=lambda item: item[0])[1]
        paths.append(min(candidates, key=lambda path: path.error_mm))
    return paths


def _assign_to_family(name: str, line: Array, family: int, layout: Layout) -> _FibrePath:
    """Clip a curve to the pad, and assign it to the nearest fibre of a family."""
    half_length, half_width = layout.size_mm[family] / 2, layout.size_mm[1 - family] / 2
    # 1. from the first to the last point on the pad
    dense = np.empty((2 * len(line) - 1, 2))  # with midpoints: a straight line may have no vertex on the pad
    dense[::2], dense[1::2] = line, (line[1:] + line[:-1]) / 2
    along, across = dense[:, family], dense[:, 1 - family]
    inside = np.flatnonzero((np.abs(along) < half_length) & (np.abs(across) <= half_width + _MARGIN_MM))
    if not len(inside):
        raise InputError(f"{name}: not on the pad of {layout}")
    part = slice(max(int(inside[0]) - 1, 0), int(inside[-1]) + 2)
    t, v = along[part], across[part]
    if t[0] > t[-1]:
        t, v = t[::-1], v[::-1]
    # 2. as a function of the coordinate along the axis
    backtrack = np.maximum.accumulate(t) - t
    if backtrack.max() > _MAX_BACKTRACK_MM:
        at = int(np.argmax(backtrack > _MAX_BACKTRACK_MM))
        position = _format_position(np.array([t[at], v[at]]), family)
        expected = f"a curve that goes on along {'xy'[family]} as a {_FAMILIES[family]} fibre does"
        raise InputError(f"{name}: turns back at {position}, expected {expected}")
    is_ascending = np.append(True, t[1:] > np.maximum.accumulate(t)[:-1] + 1e-7)
    t, v = t[is_ascending], v[is_ascending]
    # 3. from border to border
    missing = max(t[0] + half_length, half_length - t[-1], 0.0)
    ends = np.interp([-half_length, half_length], t, v)
    within = (t > -half_length) & (t < half_length)
    points = np.column_stack([[-half_length, *t[within], half_length], [ends[0], *v[within], ends[1]]])
    # 4. the nearest fibre
    levels = (layout.levels[layout.families[family]] - layout.extent[1 - family] / 2) * layout.unit_mm
    number = int(np.argmin(np.abs(levels - ends.mean())))
    error_mm = max(missing, float(np.abs(ends - levels[number]).max()))
    return _FibrePath(name, layout.families[family].start + number, points, error_mm)


def _match_fibres(paths: Sequence[_FibrePath], layout: Layout, tolerance_mm: float) -> list[_FibrePath]:
    """Return one path for each fibre, with its ends within the tolerance."""
    by_fibre: dict[int, _FibrePath] = {}
    for path in paths:
        family = layout.family(path.fibre)
        name = _fibre_name(path.fibre, layout)
        if path.error_mm > tolerance_mm:
            begin, end = (_format_position(path.points[at], family) for at in (0, -1))
            allowed = f"{tolerance_mm:g} mm (--tolerance-mm) on a pad of {layout}"
            error = f"{path.error_mm:.3g} mm from where {name} ends; allowed is {allowed}"
            raise InputError(f"{path.name}: runs from {begin} to {end}, {error}")
        if path.fibre in by_fibre:
            both = f"{by_fibre[path.fibre].name} and {path.name}"
            raise InputError(f"{both}: both are {name}, expected one curve a fibre")
        offset = np.abs(path.points[:, 1])
        if offset.max() > layout.size_mm[1 - family] / 2 + tolerance_mm:
            position = _format_position(path.points[int(np.argmax(offset))], family)
            raise InputError(f"{path.name}: leaves the pad at {position}")
        by_fibre[path.fibre] = path
    for fibre in range(layout.fibres):
        if fibre not in by_fibre:
            raise InputError(f"no curve is {_fibre_name(fibre, layout)}, expected one a fibre on a pad of {layout}")
    return [by_fibre[fibre] for fibre in range(layout.fibres)]


def _fit_paths(paths: Sequence[_FibrePath], layout: Layout, tolerance_mm: float) -> Array:
    """Fit knots (F, n, 2), grid units; n is that of the fibre that needs the most."""
    fitted, middle = [], np.array(layout.extent) / 2
    for fibre, path in enumerate(paths):
        family, line = layout.family(fibre), path.points.copy()
        line[[0, -1], 1] = (layout.levels[fibre] - middle[1 - family]) * layout.unit_mm
        knots_mm = fit_knots(line, _FIT_SHARE * tolerance_mm, MAX_KNOTS)
        knots = (knots_mm if family == 0 else knots_mm[:, ::-1]) / layout.unit_mm + middle
        knots[[0, -1], family] = 0, layout.extent[family]
        knots[[0, -1], 1 - family] = layout.levels[fibre]
        fitted.append(np.clip(knots, 0, layout.extent))
    return add_spare_knots(fitted, layout)


def _check_fit(line: Array, path: _FibrePath, layout: Layout, tolerance_mm: float) -> ImportedFibre:
    """Compare a fibre (n, 2), grid units, with its path, and refuse a difference beyond the tolerance."""
    family = layout.family(path.fibre)
    fitted = (line - np.array(layout.extent) / 2) * layout.unit_mm
    drawn = path.points if family == 0 else path.points[:, ::-1]
    to_fitted = shapely.distance(shapely.points(drawn), shapely.LineString(fitted))
    to_drawn = shapely.distance(shapely.points(fitted), shapely.LineString(drawn))
    error_mm = float(max(to_fitted.max(), to_drawn.max()))
    if error_mm > max(tolerance_mm, path.error_mm) * 1.05:
        position = _format_position(fitted[int(np.argmax(to_drawn))], 0)
        error = f"{MAX_KNOTS} knots keep within {error_mm:.3g} mm of it, at {position}"
        raise InputError(f"{path.name}: {error}; allowed is {tolerance_mm:g} mm (--tolerance-mm)")
    return ImportedFibre(path.name, path.error_mm, error_mm)


def _fibre_name(fibre: int, layout: Layout) -> str:
    family = layout.family(fibre)
    return f"{_FAMILIES[family]} {fibre - layout.families[family].start + 1}"


def _format_position(point: Array, family: int) -> str:
    x, y = point if family == 0 else point[::-1]
    return f"({x:.1f}, {y:.1f}) mm"


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
    """Move the inner knots along and across by non-linear least squares, again and again while they gain by it."""
    cost = np.inf
    for _ in range(_MAX_ROUNDS if len(knots) > 2 else 0):
        fit = _fit_within_room(samples, weight, knots)
        knots = np.vstack([knots[:1], fit.x.reshape(-1, 2), knots[-1:]])
        if fit.cost > (1 - _MIN_GAIN) * cost:
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
        jac_sparsity=np.repeat(depends, 2, axis=1),  # derivatives by knots without a span in common at once
        x_scale="jac",
        ftol=1e-3,
        max_nfev=8,
    )


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
