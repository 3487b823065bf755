"""A drawing as a pad: which curve is which fibre, and the knots that follow it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely

from padforge.design.common.validation import InputError, check_float
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import flatten
from padforge.design.paths.drawing_files import DrawnCurve, DrawnPlan, read_dxf, read_svg
from padforge.design.paths.fitting import add_spare_knots, fit_knots
from padforge.design.settings import Layout

READERS = {".svg": read_svg, ".dxf": read_dxf}
MAX_KNOTS = 64
"""Inner knots of a fibre at most, as of [search] knots."""
MAX_CURVES_PER_FIBRE = 8
"""Curves for every fibre at most: others are told one by one."""
_BACK_MM = 2e-4
"""A curve may go back by so much: files round."""
_BESIDE_MM = 1.0
"""What lies further beside the pad are leads to its other sides, which are left out."""
_ALIKE = 2e-3
"""Share by which the border that is drawn may differ from that of the pad in shape."""
_AIM = 0.8
"""Share of the tolerance to which is fitted."""
_FLAT_MM = 1e-3
"""Tolerance to which curves are compared."""


@dataclass(frozen=True)
class ImportedFibre:
    """A curve that became a fibre.

    Attributes:
        name: of the curve, as the drawing has it.
        moved_mm: by how much its ends were put right.
        off_mm: greatest distance of fibre and curve on the pad.
    """

    name: str
    moved_mm: float
    off_mm: float


@dataclass(frozen=True)
class ImportedPlan:
    """A drawing that became a pad.

    Attributes:
        fibres: in the order of the pad's. placed: where the drawing was taken to lie.
    """

    pad: Morphology
    fibres: tuple[ImportedFibre, ...]
    placed: str


@dataclass(frozen=True)
class _Course:
    """A curve on the pad: (n, 2) travel and cross from border to border, mm from the middle, by its own fibre."""

    name: str
    fibre: int
    points: Array
    error_mm: float


def import_plan(path: Path, layout: Layout, tolerance_mm: float) -> ImportedPlan:
    """The pad that a drawing shows: one curve a fibre, each a function of the axis it travels along.

    The curves are those whose layer, group or name begins with fibre, horizontal or vertical, or all that are open. The
    border is what is named pad, where something is; else the middle of the pad lies where the ends fit best: at the
    drawing's origin, or so that the pad begins there, or in the middle of the curves. What lies beyond it is left out.

    Args:
        layout: which fibres there are and where they end. tolerance_mm: of ends and of courses.

    Raises:
        InputError: a file that is no such drawing; curve and place are named.
    """
    tolerance_mm = check_float("tolerance_mm", tolerance_mm, 1e-3, 10)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: ends in {path.suffix or 'nothing'}, allowed are {' and '.join(READERS)}")
    try:
        drawing = reader(path)
        strokes = drawing.fibres
        if not strokes:
            raise InputError("there is no open curve in it")
        if len(strokes) > MAX_CURVES_PER_FIBRE * layout.fibres:
            raise InputError(
                f"it has {len(strokes)} open curves, expected {layout.fibres}, one a fibre; put these into a layer or"
                " group whose name begins with fibre"
            )
        courses, placed = _placed(drawing, strokes, layout)
        courses = _one_each(courses, layout, tolerance_mm)
        knots = _fitted(courses, layout, tolerance_mm)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error
    pad = Morphology.from_layout(knots, layout)
    off = [
        _apart(line, course, layout)
        for line, course in zip(flatten(pad, _FLAT_MM / layout.unit_mm), courses, strict=True)
    ]
    for course, (off_mm, place) in zip(courses, off, strict=True):
        if off_mm > max(tolerance_mm, course.error_mm) * 1.05:
            raise InputError(
                f"{path}: {course.name}: {MAX_KNOTS} knots keep within {off_mm:.3g} mm of it, at {place}; allowed is"
                f" {tolerance_mm:g} mm (--tolerance-mm)"
            )
    told = (ImportedFibre(course.name, course.error_mm, at[0]) for course, at in zip(courses, off, strict=True))
    return ImportedPlan(pad, tuple(told), placed + (f"; {drawing.note}" if drawing.note else ""))


def _placed(drawing: DrawnPlan, strokes: Sequence[DrawnCurve], layout: Layout) -> tuple[list[_Course], str]:
    """The curves on the pad, and where the drawing was taken to lie."""
    size = np.array(layout.size_mm)
    border = drawing.border
    if border is not None:
        ratio = (border[1] - border[0]) / size
        if not (ratio > 0).all() or abs(ratio[0] / ratio[1] - 1) > _ALIKE:
            width, height = border[1] - border[0]
            raise InputError(
                f"pad is drawn {width:g} by {height:g}, expected the shape of {size[0]:g} by {size[1]:g} mm"
            )
        lines = [(stroke.points - border.mean(axis=0)) / ratio for stroke in strokes]
        return _courses(strokes, lines, layout), "the border is that named pad"
    lines = [stroke.points * drawing.unit_mm for stroke in strokes]
    everything = np.vstack(lines)
    centre = (everything.min(axis=0) + everything.max(axis=0)) / 2
    ways = {
        "its origin is the middle of the pad": np.zeros(2),
        "its origin is the lower left corner of the pad": size / 2,
        "its origin is the upper left corner of the pad": size / 2 * [1, -1],
        "the middle of its curves is that of the pad": centre,
    }
    found = []
    for said, middle in ways.items():
        try:
            courses = _courses(strokes, [line - middle for line in lines], layout)
        except InputError as error:
            found.append((np.inf, said, error))
        else:
            found.append((sum(course.error_mm for course in courses), said, courses))
    least = min(cost for cost, _, _ in found)
    _, said, courses = next(each for each in found if each[0] <= least + _FLAT_MM * len(lines))
    if isinstance(courses, InputError):
        raise courses
    return courses, said


def _courses(strokes: Sequence[DrawnCurve], lines: Sequence[Array], layout: Layout) -> list[_Course]:
    courses = []
    for stroke, line in zip(strokes, lines, strict=True):
        tried, errors = [], []
        for family in (0, 1):
            if layout.counts[family]:
                try:
                    tried.append(_course(stroke.name, line, family, layout))
                except InputError as error:
                    errors.append((abs(np.diff(line[[0, -1], family])[0]), error))
        if not tried:
            raise max(errors, key=lambda each: each[0])[1]
        courses.append(min(tried, key=lambda course: course.error_mm))
    return courses


def _course(name: str, line: Array, family: int, layout: Layout) -> _Course:
    """A curve as a fibre of a family: what of it lies on the pad."""
    most, across = layout.size_mm[family] / 2, layout.size_mm[1 - family] / 2
    dense = np.empty((2 * len(line) - 1, 2))  # with middles, since a straight line may have no point on the pad
    dense[::2], dense[1::2] = line, (line[1:] + line[:-1]) / 2
    travel, cross = dense[:, family], dense[:, 1 - family]
    inside = np.flatnonzero((np.abs(travel) < most) & (np.abs(cross) <= across + _BESIDE_MM))
    if not len(inside):
        raise InputError(f"{name}: not on the pad of {layout}")
    part = slice(max(int(inside[0]) - 1, 0), int(inside[-1]) + 2)
    t, v = travel[part], cross[part]
    if t[0] > t[-1]:
        t, v = t[::-1], v[::-1]
    back = np.maximum.accumulate(t) - t
    if back.max() > _BACK_MM:
        at = int(np.argmax(back > _BACK_MM))
        place = _place(np.array([t[at], v[at]]), family)
        raise InputError(
            f"{name}: turns back at {place}, expected a curve that goes on along {'xy'[family]} as a "
            f"{('horizontal', 'vertical')[family]} fibre does"
        )
    onward = np.append(True, t[1:] > np.maximum.accumulate(t)[:-1] + 1e-7)
    t, v = t[onward], v[onward]
    short = max(t[0] + most, most - t[-1], 0.0)
    ends = np.interp([-most, most], t, v)
    within = (t > -most) & (t < most)
    points = np.column_stack([[-most, *t[within], most], [ends[0], *v[within], ends[1]]])
    levels = (layout.levels[layout.families[family]] - layout.extent[1 - family] / 2) * layout.unit_mm
    number = int(np.argmin(np.abs(levels - ends.mean())))
    error = max(short, float(np.abs(ends - levels[number]).max()))
    return _Course(name, layout.families[family].start + number, points, error)


def _one_each(courses: Sequence[_Course], layout: Layout, tolerance_mm: float) -> list[_Course]:
    """The curves by their fibres, one each, whose ends lie where they should."""
    found: dict[int, _Course] = {}
    for course in courses:
        family = layout.family(course.fibre)
        name = _fibre(course.fibre, layout)
        if course.error_mm > tolerance_mm:
            begin, end = (_place(course.points[at], family) for at in (0, -1))
            raise InputError(
                f"{course.name}: runs from {begin} to {end}, {course.error_mm:.3g} mm from where {name} ends; allowed"
                f" is {tolerance_mm:g} mm (--tolerance-mm) on a pad of {layout}"
            )
        if course.fibre in found:
            raise InputError(
                f"{found[course.fibre].name} and {course.name}: both are {name}, expected one curve a fibre"
            )
        most = layout.size_mm[1 - family] / 2 + tolerance_mm
        if np.abs(course.points[:, 1]).max() > most:
            at = int(np.argmax(np.abs(course.points[:, 1])))
            raise InputError(f"{course.name}: leaves the pad at {_place(course.points[at], family)}")
        found[course.fibre] = course
    for fibre in range(layout.fibres):
        if fibre not in found:
            raise InputError(f"no curve is {_fibre(fibre, layout)}, expected one a fibre on a pad of {layout}")
    return [found[fibre] for fibre in range(layout.fibres)]


def _fitted(courses: Sequence[_Course], layout: Layout, tolerance_mm: float) -> Array:
    """(F, n, 2) knots in grid units, as many for every fibre as the one needs that needs most."""
    fitted = []
    for fibre, course in enumerate(courses):
        family, line = layout.family(fibre), course.points.copy()
        middle = np.array(layout.extent) / 2
        line[[0, -1], 1] = (layout.levels[fibre] - middle[1 - family]) * layout.unit_mm
        # what is missed is measured where samples are, and along normals
        found = fit_knots(line, _AIM * tolerance_mm, MAX_KNOTS)
        knots = (found if family == 0 else found[:, ::-1]) / layout.unit_mm + middle
        knots[[0, -1], family] = 0, layout.extent[family]
        knots[[0, -1], 1 - family] = layout.levels[fibre]
        fitted.append(np.clip(knots, 0, layout.extent))
    return add_spare_knots(fitted, layout)


def _apart(line: Array, course: _Course, layout: Layout) -> tuple[float, str]:
    """Greatest distance of a fibre (grid units) and its curve, mm, and where the fibre is that far off."""
    family = layout.family(course.fibre)
    fitted = (line - np.array(layout.extent) / 2) * layout.unit_mm
    drawn = course.points if family == 0 else course.points[:, ::-1]
    one, other = shapely.LineString(fitted), shapely.LineString(drawn)
    to_fitted = shapely.distance(shapely.points(drawn), one)
    to_drawn = shapely.distance(shapely.points(fitted), other)
    worst = int(np.argmax(to_drawn))
    return float(max(to_fitted.max(), to_drawn.max())), "({:.1f}, {:.1f}) mm".format(*fitted[worst])


def _fibre(fibre: int, layout: Layout) -> str:
    family = layout.family(fibre)
    return f"{('horizontal', 'vertical')[family]} {fibre - layout.families[family].start + 1}"


def _place(point: Array, family: int) -> str:
    x, y = point if family == 0 else point[::-1]
    return f"({x:.1f}, {y:.1f}) mm"
