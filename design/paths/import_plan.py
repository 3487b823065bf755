"""Import of a drawing as a pad: its curves are placed on the pad, and each becomes a fibre."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from padforge.common.files import check_file
from padforge.common.validation import InputError, naming_file
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import add_spare_knots, flatten
from padforge.design.paths.drawing_files import DrawnCurve, DrawnPlan, read_dxf, read_svg
from padforge.design.paths.knot_fitting import fit_knots
from padforge.design.settings import FAMILIES, Layout

READERS = {".svg": read_svg, ".dxf": read_dxf}
MAX_BYTES = 2**22  # size of a drawing; drawings of fibres are far smaller
MAX_KNOTS = 64  # maximum inner knots of a fibre, as for `[search] knots`
_MAX_BACKTRACK_MM = 2e-4  # largest step backwards along the axis: files are rounded
_MARGIN_MM = 1.0  # curves farther beyond the pad than this are leads to its other sides, which are ignored
_FLATNESS_MM = 1e-3  # tolerance to which curves are compared
_SCALES = {
    72 / 96: "points of 1/72 inch that were taken for 1/96 inch",
    96 / 72: "pixels of 1/96 inch that were taken for points",
    25.4: "it states inches and was drawn in mm",
    1 / 25.4: "it states mm and was drawn in inches",
    1000.0: "it states m and was drawn in mm",
    1 / 1000: "it states mm and was drawn in m",
    10.0: "it states cm and was drawn in mm",
    1 / 10: "it states mm and was drawn in cm",
    25.4 / 96: "it states no unit, which are pixels, and was drawn in mm",
    96 / 25.4: "it states mm and was drawn in pixels",
    90 / 96: "pixels of 1/96 inch that were drawn as 1/90 inch, by an old Inkscape",
    300 / 96: "pixels of 1/96 inch that were drawn with 300 dots an inch",
    25.4 / 72: "it states points and was drawn in mm",
}
"""Sizes of a drawing relative to the pad where a program takes its unit for another one, and the likely cause."""
_SCALE_TOLERANCE = 0.03


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
    drawn: str  # where it begins and ends in the drawing
    error_mm: float  # largest distance of its ends to the fibre's


def import_plan(path: Path, layout: Layout, tolerance_mm: float) -> ImportedPlan:
    """Import a drawing: one curve a fibre, each a function of the coordinate along its axis.

    The curves are those whose layer, group or name begins with fibre, horizontal or vertical, or else all open curves.
    The border is the curve named pad. Without one the drawing is positioned where the ends fit best: with its origin in
    the middle or in a corner of the pad, or with the middle of its curves in the middle. Leads beyond the pad are
    ignored.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: ends in {path.suffix or 'nothing'}, allowed are {' and '.join(READERS)}")
    check_file(path, MAX_BYTES)
    with naming_file(path):
        drawing = reader(path)
        curves = drawing.fibres
        if not curves:
            hidden = f" but {drawing.n_hidden} hidden ones" if drawing.n_hidden else ""
            raise InputError(f"there is no open curve in it{hidden}")
        if len(curves) > 8 * layout.fibres:  # so many that messages on single curves would not help
            hint = "put these into a layer or group whose name begins with fibre"
            raise InputError(f"it has {len(curves)} open curves, expected {layout.fibres}, one a fibre; {hint}")
        try:
            candidates, placement = _place_curves(drawing, curves, layout)
            fibre_paths = _match_fibres(candidates, layout, tolerance_mm)
        except InputError as error:
            raise InputError(f"{_describe_scale(drawing, curves, layout)}{error}") from error
        pad = Morphology.from_layout(_fit_paths(fibre_paths, layout, tolerance_mm), layout)
        lines = flatten(pad, _FLATNESS_MM / layout.unit_mm)
        fibres = [_check_fit(line, drawn, layout, tolerance_mm) for line, drawn in zip(lines, fibre_paths, strict=True)]
    hidden = [f"hidden curves, which are left out: {drawing.n_hidden}"] if drawing.n_hidden else []
    return ImportedPlan(pad, tuple(fibres), "; ".join([placement, *drawing.notes, *hidden]))


def _describe_scale(drawing: DrawnPlan, curves: Sequence[DrawnCurve], layout: Layout) -> str:
    """Describe the size of a drawing that differs from the pad's, and its likely cause; "" if they agree."""
    if drawing.border is not None:
        return ""
    drawn_mm = np.ptp(np.vstack([curve.points for curve in curves]), axis=0) * drawing.unit_mm
    ratio = float(drawn_mm.max() / max(layout.size_mm))
    if abs(ratio - 1) < _SCALE_TOLERANCE:
        return ""
    cause = next((text for scale, text in _SCALES.items() if abs(ratio / scale - 1) < _SCALE_TOLERANCE), "")
    sizes = [f"{width:.5g} by {height:.5g} mm" for width, height in (np.round(drawn_mm, 2), layout.size_mm)]
    likely = f"a factor of {ratio:.4g}" + (f" ({cause}?)" if cause else "")
    return f"its curves span {sizes[0]}, in {drawing.unit}, and the pad {sizes[1]}, {likely}; "


def _place_curves(drawing: DrawnPlan, curves: Sequence[DrawnCurve], layout: Layout) -> tuple[list[_FibrePath], str]:
    """Place the curves on the pad; return them, and a description of how the drawing was positioned."""
    size = np.array(layout.size_mm)
    if (border := drawing.border) is not None:
        width, height = drawn = border[1] - border[0]
        ratio = drawn / size
        if not (ratio > 0).all() or abs(ratio[0] / ratio[1] - 1) > 2e-3:
            shape = f"{size[0]:g} by {size[1]:g} mm"
            raise InputError(f"pad is drawn {width:g} by {height:g}, expected the shape of {shape}")
        lines = [(curve.points - border.mean(axis=0)) / ratio for curve in curves]
        return _assign_curves(drawing, curves, lines, layout), "the border is that named pad"
    lines = [curve.points * drawing.unit_mm for curve in curves]
    points = np.vstack(lines)
    origins = {
        "its origin is the middle of the pad": np.zeros(2),
        "its origin is the lower left corner of the pad": size / 2,
        "its origin is the upper left corner of the pad": size / 2 * [1, -1],
        "the middle of its curves is that of the pad": (points.min(axis=0) + points.max(axis=0)) / 2,
    }
    placements: list[tuple[float, str, list[_FibrePath]]] = []
    errors: list[InputError] = []
    for description, middle in origins.items():
        try:
            paths = _assign_curves(drawing, curves, [line - middle for line in lines], layout)
            placements.append((sum(path.error_mm for path in paths), description, paths))
        except InputError as error:
            errors.append(error)
    if not placements:
        raise errors[0]
    limit = min(error for error, _, _ in placements) + _FLATNESS_MM * len(lines)
    return next((paths, description) for error, description, paths in placements if error <= limit)


def _assign_curves(
    drawing: DrawnPlan, curves: Sequence[DrawnCurve], lines: Sequence[Array], layout: Layout
) -> list[_FibrePath]:
    """Assign each curve to the nearest fibre, of the family that it fits better."""
    paths = []
    for curve, line in zip(curves, lines, strict=True):
        drawn = drawing.describe(curve.points[[0, -1]])
        candidates, errors = [], []
        for family in (0, 1):
            if layout.counts[family]:
                try:
                    candidates.append(_assign_to_family(curve.name, drawn, line, family, layout))
                except InputError as error:
                    errors.append((abs(np.diff(line[[0, -1], family])[0]), error))
        if not candidates:
            raise max(errors, key=lambda item: item[0])[1]
        paths.append(min(candidates, key=lambda path: path.error_mm))
    return paths


def _assign_to_family(name: str, drawn: str, line: Array, family: int, layout: Layout) -> _FibrePath:
    """Clip a curve to the pad, and assign it to the nearest fibre of a family."""
    half_length, half_width = layout.size_mm[family] / 2, layout.size_mm[1 - family] / 2
    # 1. from the first to the last point on the pad
    dense = np.empty((2 * len(line) - 1, 2))  # with midpoints: a straight line may have no vertex on the pad
    dense[::2], dense[1::2] = line, (line[1:] + line[:-1]) / 2
    along, across = dense[:, family], dense[:, 1 - family]
    inside = np.flatnonzero((np.abs(along) < half_length) & (np.abs(across) <= half_width + _MARGIN_MM))
    if not len(inside):
        raise InputError(f"{name}: runs from {drawn} in the drawing, not on the pad of {layout}")
    part = slice(max(int(inside[0]) - 1, 0), int(inside[-1]) + 2)
    t, v = along[part], across[part]
    if t[0] > t[-1]:
        t, v = t[::-1], v[::-1]
    # 2. as a function of the coordinate along the axis
    backtrack = np.maximum.accumulate(t) - t
    if backtrack.max() > _MAX_BACKTRACK_MM:
        at = int(np.argmax(backtrack > _MAX_BACKTRACK_MM))
        position = _format_position(np.array([t[at], v[at]]), family)
        expected = f"a curve that goes on along {'xy'[family]} as a {FAMILIES[family]} fibre does"
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
    return _FibrePath(name, layout.families[family].start + number, points, drawn, error_mm)


def _match_fibres(paths: Sequence[_FibrePath], layout: Layout, tolerance_mm: float) -> list[_FibrePath]:
    """Return the path of each fibre, in the order of the fibres; refuse ends beyond the tolerance."""
    by_fibre: dict[int, _FibrePath] = {}
    for path in paths:
        family = layout.family(path.fibre)
        name = layout.fibre_name(path.fibre)
        if path.error_mm > tolerance_mm:
            allowed = f"{tolerance_mm:g} mm (--tolerance-mm) on a pad of {layout}"
            error = f"{path.error_mm:.3g} mm from where {name} ends; allowed is {allowed}"
            raise InputError(f"{path.name}: runs from {path.drawn} in the drawing, {error}")
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
            raise InputError(f"no curve is {layout.fibre_name(fibre)}, expected one a fibre on a pad of {layout}")
    return [by_fibre[fibre] for fibre in range(layout.fibres)]


def _fit_paths(paths: Sequence[_FibrePath], layout: Layout, tolerance_mm: float) -> Array:
    """Fit knots (F, n, 2), grid units; n is that of the fibre that needs the most."""
    fitted, middle = [], np.array(layout.extent) / 2
    for fibre, path in enumerate(paths):
        family, line = layout.family(fibre), path.points.copy()
        line[[0, -1], 1] = (layout.levels[fibre] - middle[1 - family]) * layout.unit_mm
        knots_mm = fit_knots(line, 0.8 * tolerance_mm, MAX_KNOTS)  # less, since the fit measures its misfit at samples
        knots = (knots_mm if family == 0 else knots_mm[:, ::-1]) / layout.unit_mm + middle
        knots[[0, -1], family] = 0, layout.extent[family]
        knots[[0, -1], 1 - family] = layout.levels[fibre]
        fitted.append(np.clip(knots, 0, layout.extent))
    return add_spare_knots(fitted, layout)


def _check_fit(line: Array, path: _FibrePath, layout: Layout, tolerance_mm: float) -> ImportedFibre:
    """Compare a fibre (n, 2), grid units, with its path, and refuse a difference beyond the tolerance."""
    family = layout.family(path.fibre)
    fitted = (line - np.array(layout.extent) / 2) * layout.unit_mm
    drawn = shapely.LineString(path.points if family == 0 else path.points[:, ::-1])
    error_mm = float(shapely.hausdorff_distance(shapely.LineString(fitted), drawn))
    if error_mm > max(tolerance_mm, path.error_mm) * 1.05:
        farthest = int(np.argmax(shapely.distance(shapely.points(fitted), drawn)))
        position = _format_position(fitted[farthest], 0)
        error = f"a fibre of {MAX_KNOTS} knots is {error_mm:.3g} mm off at {position}"
        raise InputError(f"{path.name}: {error}; allowed is {tolerance_mm:g} mm (--tolerance-mm)")
    return ImportedFibre(path.name, path.error_mm, error_mm)


def _format_position(point: Array, family: int) -> str:
    x, y = point if family == 0 else point[::-1]
    return f"({x:.1f}, {y:.1f}) mm"
