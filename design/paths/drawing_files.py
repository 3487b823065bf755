"""Curves of DXF files: lines, arcs, polylines, splines and ellipses of the modelspace, by layer."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import InputError, short_repr
from padforge.design.morphology import Array
from padforge.design.paths.curves import cubic

MOST_BYTES = 2**22
"""Of a drawing: one of more is none of fibres."""
MOST_POINTS = 200_000
MOST_PARTS = 20_000
"""Elements of a drawing that are looked at."""
MOST_CURVES = 5000
"""Before those that end in one point are put together."""
FARTHEST = 1e6
"""Greatest coordinate by amount, in units of the drawing."""
STEPS = 48
"""Straight pieces of a cubic: off by less than 5e-5 of its length."""

_LONGEST_REASON = 120
_FIBRES = re.compile(r"(fibre|fiber|horizontal|vertical)", re.IGNORECASE)
_PAD = "pad"
_TOGETHER = 1e-6
"""Share of a drawing's size within which ends are one point."""


@dataclass(frozen=True)
class DrawnCurve:
    """One piece of a drawing.

    Attributes:
        name: as the file has it, or its kind and number.
        points: (n, 2) in units of the drawing, y upwards.
        groups: names of it and of all groups or layers it lies in.
        closed: whether it ends where it begins.
    """

    name: str
    points: Array
    groups: tuple[str, ...] = ()
    closed: bool = False


@dataclass
class DrawnPlan:
    """A drawing as it is read.

    Attributes:
        unit_mm: a unit of it. note: what had to be taken for granted.
    """

    unit_mm: float = 1.0
    note: str = ""
    strokes: list[DrawnCurve] = field(default_factory=list)
    parts: int = 0
    points: int = 0

    def looked_at(self) -> None:
        """One more element.

        Raises:
            InputError: there are too many.
        """
        self.parts += 1
        if self.parts > MOST_PARTS:
            raise InputError(f"more than {MOST_PARTS} elements, which is more than a drawing of fibres has")

    def add(self, name: str, points: Array, groups: Sequence[str] = (), closed: bool = False) -> None:
        """One more stroke, unless it is but a point.

        Raises:
            InputError: coordinates that are not finite or beyond FARTHEST, or too many points.
        """
        self.points += len(points)
        if self.points > MOST_POINTS:
            raise InputError(f"more than {MOST_POINTS} points, which is more than a drawing of fibres has")
        if not (np.abs(points) <= FARTHEST).all():
            raise InputError(f"{name}: coordinates that are no numbers or beyond {FARTHEST:g}")
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]
        if len(points) > 1:
            closed = closed or bool((points[0] == points[-1]).all())
            self.strokes.append(DrawnCurve(name, points, tuple(filter(None, groups)), closed))

    @property
    def border(self) -> Array | None:
        """(2, 2) low and high corner of what is named "pad", None where nothing is."""
        found = [stroke.points for stroke in self.strokes if _PAD in (each.lower() for each in stroke.groups)]
        return np.array([np.vstack(found).min(axis=0), np.vstack(found).max(axis=0)]) if found else None

    @property
    def fibres(self) -> list[DrawnCurve]:
        """The curves that are fibres, pieces that end where another begins put together.

        They are what is named so (fibre, horizontal, vertical), or where nothing is all that is open.
        """
        named = [stroke for stroke in self.strokes if any(map(_FIBRES.match, stroke.groups))]
        for stroke in named:
            if stroke.closed:
                raise InputError(f"{stroke.name}: closed, expected a curve from one border of the pad to the other")
        open_ones = [each for each in self.strokes if not each.closed and _PAD not in map(str.lower, each.groups)]
        chosen = named or open_ones
        if len(chosen) > MOST_CURVES:
            raise InputError(f"{len(chosen)} open curves, which is more than a drawing of fibres has")
        return list(_joined(chosen))


def reason(error: Exception) -> str:
    """What a library has against a file, in one line that is not as long as the file."""
    return " ".join(str(error).split())[:_LONGEST_REASON] or type(error).__name__


class Pen:
    """Takes what a curve is made of and gives polylines."""

    def __init__(self) -> None:
        self.lines: list[tuple[Array, bool]] = []
        self._points: list[Array] = []

    def begin(self, place: Sequence[float]) -> None:
        """A new polyline begins."""
        self.end()
        self._points = [np.array([place], dtype=float)]

    def line(self, place: Sequence[float]) -> None:
        """Straight on to a place."""
        self._points.append(np.array([place], dtype=float))

    def curve(self, *control: Sequence[float]) -> None:
        """A Bezier curve on by one, two or three control points, the last of them its end."""
        points = np.array([self._points[-1][-1], *control], dtype=float)
        if len(points) == 3:
            a, b, c = points
            points = np.array([a, a + (b - a) * 2 / 3, c + (b - c) * 2 / 3, c])
        self._points.append(cubic(points, np.arange(1, STEPS + 1) / STEPS) if len(points) == 4 else points[1:])

    def end(self, closed: bool = False) -> None:
        """The polyline is done."""
        if self._points:
            points = np.vstack(self._points)
            self.lines.append((np.vstack([points, points[:1]]) if closed else points, closed))
        self._points = []


def _joined(strokes: list[DrawnCurve]) -> Iterator[DrawnCurve]:
    """Strokes, those put together whose ends are one point."""
    if not strokes:
        return
    from scipy.spatial import KDTree

    ends = np.array([stroke.points[end] for stroke in strokes for end in (0, -1)])
    near = _TOGETHER * max(float(np.ptp(ends, axis=0).max()), 1e-9)
    found = KDTree(ends).query(ends, k=min(3, len(ends)), distance_upper_bound=near)
    apart, others = (np.asarray(each).tolist() for each in found)
    partners: dict[int, int] = {}
    for end, row in enumerate(zip(apart, others, strict=True)):
        close = [other for distance, other in zip(*row, strict=True) if distance <= near and other != end]
        if len(close) > 1:
            x, y = ends[end]
            raise InputError(f"{strokes[end // 2].name}: more than two curves end at ({x:g}, {y:g})")
        if close:
            partners[end] = close[0]
    left = set(range(len(strokes)))
    free = [end for end in range(len(ends)) if end not in partners]
    for end in free:
        if end // 2 not in left:
            continue
        pieces: list[Array] = []
        names: list[DrawnCurve] = []
        at: int | None = end
        while at is not None:
            stroke = strokes[at // 2]
            left.discard(at // 2)
            names.append(stroke)
            pieces.append(stroke.points if at % 2 == 0 else stroke.points[::-1])
            at = partners.get(at ^ 1)
        name = names[0].name if len(names) == 1 else f"{names[0].name} to {names[-1].name}"
        yield DrawnCurve(name, np.vstack(pieces), names[0].groups)
    if left:
        raise InputError(
            f"{strokes[min(left)].name}: part of a ring, or drawn twice, expected curves from border to border"
        )


_UNITS_MM = {
    "": 25.4 / 96,
    "px": 25.4 / 96,
    "mm": 1.0,
    "cm": 10.0,
    "q": 0.25,
    "in": 25.4,
    "pt": 25.4 / 72,
    "pc": 25.4 / 6,
}
_NUMBER = re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?")
_LENGTH = re.compile(rf"\s*+({_NUMBER.pattern})\s*+([a-zA-Z]*+)\s*+")
_TRANSFORM = re.compile(r"\s*+,?\s*+([a-zA-Z]++)\s*+\(([^()]*+)\)\s*+")
"""A doubled + takes all it can and gives nothing back: a text of a million blanks is read once, not a million times."""
_UNSEEN = {"defs", "symbol", "clipPath", "mask", "pattern", "marker", "metadata", "style", "title", "desc", "text"}
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_LINK = "{http://www.w3.org/1999/xlink}href"
_DEEPEST_USE = 8


def read_svg(path: Path) -> DrawnPlan:
    """The curves of an SVG, y upwards. A unit without a name is a pixel of 1/96 inch.

    Raises:
        InputError: it cannot be read, or is of a kind that no drawing of fibres is.
    """
    content = read_bytes(path, MOST_BYTES)
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True
    )
    if b"<!ENTITY" in content:
        raise InputError(f"{path}: declares entities, which no drawing of fibres needs")
    try:
        root = etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(f"{path}: not an SVG file that can be read ({reason(error)})") from error
    etree.strip_tags(root, etree.Entity)  # what an external DTD may declare, which is not looked at
    if _kind(root) != "svg":
        raise InputError(f"{path}: the root is <{_kind(root)}>, expected <svg>")
    drawing = DrawnPlan()
    flip = np.diag([1.0, -1.0, 1.0])
    reader = _Reader(drawing, {each.get("id"): each for each in root.iter() if each.get("id")})
    with np.errstate(all="ignore"):  # what becomes of too large numbers is refused where it is added
        for element, matrix, groups in reader.shapes(root, flip @ _viewport(root)):
            reader.draw(element, matrix, groups)
    return drawing


class _Reader:
    """What it takes to go through a file."""

    def __init__(self, drawing: DrawnPlan, ids: Mapping[str, Any]) -> None:
        self._drawing, self._ids = drawing, ids

    def shapes(self, root: Any, matrix: Array) -> Iterator[tuple[Any, Array, tuple[str, ...]]]:
        """What is drawn, in order, with its matrix and the names of all it lies in."""
        waiting = [(child, matrix, (), 0) for child in reversed(root)]
        while waiting:
            element, matrix, groups, uses = waiting.pop()
            self._drawing.looked_at()
            kind = _kind(element)
            if kind in _UNSEEN or _is_hidden(element):
                continue
            name = element.get("id") or kind
            matrix = matrix @ _transform(element, name)
            groups = (*groups, element.get("id", ""), element.get(_LABEL, ""))
            if kind == "use":
                target = self._ids.get((element.get("href") or element.get(_LINK) or "").removeprefix("#"))
                if target is None:
                    continue
                if uses == _DEEPEST_USE:
                    raise InputError(f"{name}: <use> of <use>, deeper than {_DEEPEST_USE}")
                matrix = matrix @ _shift(*(_length(element, side, name) for side in ("x", "y")))
                inside = list(target) if _kind(target) == "symbol" else [target]
                waiting += [(child, matrix, groups, uses + 1) for child in reversed(inside)]
            elif kind in ("g", "a", "svg", "switch"):
                inner = matrix @ _viewport(element, nested=True) if kind == "svg" else matrix
                waiting += [(child, inner, groups, uses) for child in reversed(element)]
            else:
                yield element, matrix, groups

    def draw(self, element: Any, matrix: Array, groups: tuple[str, ...]) -> None:
        """Add what an element draws; what is no curve draws nothing."""
        kind = _kind(element)
        name = next((each for each in reversed(groups) if each), f"{kind} {len(self._drawing.strokes) + 1}")
        pen = Pen()
        if kind == "path":
            _draw_path(element.get("d", ""), pen, name)
        elif kind == "line":
            x1, y1, x2, y2 = (_length(element, side, name) for side in ("x1", "y1", "x2", "y2"))
            pen.begin((x1, y1))
            pen.line((x2, y2))
        elif kind in ("polyline", "polygon"):
            numbers = [float(each) for each in _NUMBER.findall(element.get("points", ""))]
            for k, place in enumerate(zip(numbers[::2], numbers[1::2], strict=False)):
                (pen.line if k else pen.begin)(place)
        elif kind == "rect":
            x, y, width, height = (_length(element, side, name) for side in ("x", "y", "width", "height"))
            pen.begin((x, y))
            for place in ((x + width, y), (x + width, y + height), (x, y + height)):
                pen.line(place)
        pen.end(closed=kind in ("polygon", "rect"))
        for points, closed in pen.lines:
            self._drawing.add(name, points @ matrix[:2, :2].T + matrix[:2, 2], groups, closed)


def _draw_path(description: str, pen: Pen, name: str) -> None:
    from fontTools.pens.basePen import AbstractPen
    from fontTools.svgLib.path.parser import parse_path

    class Taken(AbstractPen):
        """What fontTools calls a pen."""

        def moveTo(self, pt: Any) -> None:  # noqa: N802  names of fontTools
            pen.begin(pt)

        def lineTo(self, pt: Any) -> None:  # noqa: N802
            pen.line(pt)

        def curveTo(self, *points: Any) -> None:  # noqa: N802
            pen.curve(*points)

        def qCurveTo(self, *points: Any) -> None:  # noqa: N802
            pen.curve(*points)

        def closePath(self) -> None:  # noqa: N802
            pen.end(closed=True)

        def endPath(self) -> None:  # noqa: N802
            pen.end()

    try:
        parse_path(description, Taken())
    except (ValueError, ArithmeticError, LookupError, AssertionError) as error:
        raise InputError(f"{name}: no path that can be read ({reason(error)})") from error


def _kind(element: Any) -> str:
    return etree.QName(element).localname if isinstance(element.tag, str) else ""


def _is_hidden(element: Any) -> bool:
    style = element.get("style", "").replace(" ", "")
    return element.get("display") == "none" or "display:none" in style


def _length(element: Any, side: str, name: str) -> float:
    """A length in user units, 0 where there is none; shares have no meaning here."""
    text = element.get(side, "0")
    found = _LENGTH.fullmatch(text)
    if not found or found[2].lower() not in _UNITS_MM:
        raise InputError(f"{name}: {side} is {short_repr(text)}, expected a length")
    return float(found[1]) * (_UNITS_MM[found[2].lower()] / _UNITS_MM[""] if found[2] else 1)


def _shift(x: float, y: float) -> Array:
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def _viewport(element: Any, nested: bool = False) -> Array:
    """From what is inside an <svg> to mm, or, of one in another, to the units around it."""
    name = element.get("id") or "svg"
    origin = _shift(*(_length(element, side, name) for side in ("x", "y"))) if nested else np.eye(3)
    unit = np.eye(3) if nested else np.diag([_UNITS_MM[""], _UNITS_MM[""], 1.0])
    box = [float(each) for each in _NUMBER.findall(element.get("viewBox", ""))]
    if len(box) != 4:
        return unit @ origin
    if not (box[2] > 0 and box[3] > 0):
        raise InputError(
            f"{name}: viewBox is {short_repr(element.get('viewBox'))}, expected x, y, width, height above 0"
        )
    sides = [element.get(side, "100%") for side in ("width", "height")]
    shown_as = [
        inner if text.strip().endswith("%") else _length(element, side, name)
        for text, side, inner in zip(sides, ("width", "height"), box[2:], strict=True)
    ]
    scale = [outer / inner for outer, inner in zip(shown_as, box[2:], strict=True)]
    if element.get("preserveAspectRatio", "").strip() != "none":
        scale = [min(scale)] * 2
    room = [outer - inner * each for outer, inner, each in zip(shown_as, box[2:], scale, strict=True)]
    if not nested:  # its own origin is what whoever drew it counts from
        return unit @ np.diag([*scale, 1.0])
    return origin @ _shift(room[0] / 2, room[1] / 2) @ np.diag([*scale, 1.0]) @ _shift(-box[0], -box[1])


def _transform(element: Any, name: str) -> Array:
    """The matrix of the attribute `transform`."""
    text, matrix, at = element.get("transform", "").rstrip(), np.eye(3), 0
    while at < len(text):
        found = _TRANSFORM.match(text, at)
        if not found:
            raise InputError(f"{name}: transform is {short_repr(text)}, expected such as translate(1 2)")
        values = [float(each) for each in _NUMBER.findall(found[2])]
        if not all(map(math.isfinite, values)):
            raise InputError(f"{name}: transform is {short_repr(text)}, expected finite numbers")
        matrix, at = matrix @ _step(found[1], values, name), found.end()
    return matrix


def _step(kind: str, values: list[float], name: str) -> Array:
    match kind, values:
        case "matrix", [a, b, c, d, e, f]:
            return np.array([[a, c, e], [b, d, f], [0, 0, 1]])
        case "translate", [x, *rest] if len(rest) < 2:
            return _shift(x, *(rest or [0.0]))
        case "scale", [x, *rest] if len(rest) < 2:
            return np.diag([x, *(rest or [x]), 1.0])
        case "rotate", [degrees, *middle] if len(middle) in (0, 2):
            cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            x, y = middle or (0.0, 0.0)
            return _shift(x, y) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ _shift(-x, -y)
        case "skewX" | "skewY", [degrees]:
            skew = np.eye(3)
            skew[(0, 1) if kind == "skewX" else (1, 0)] = math.tan(math.radians(degrees))
            return skew
    raise InputError(f"{name}: transform {short_repr(kind)} of {len(values)} numbers, which there is not")


# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its own manual imports as exported.


_KINDS = ("LINE", "ARC", "LWPOLYLINE", "POLYLINE", "SPLINE", "ELLIPSE")
_MOST_DEGREE = 9


def read_dxf(path: Path) -> DrawnPlan:
    """The curves of a DXF; blocks, hatches and writing are left out. Its unit is that of $INSUNITS, mm without.

    Raises:
        InputError: it cannot be read, or is of a kind that no drawing of fibres is.
    """
    import ezdxf
    from ezdxf import path as paths
    from ezdxf import units

    path = check_file(path, MOST_BYTES)
    try:
        document = ezdxf.readfile(path)
        unit, millimetre = document.units, units.InsertUnits.Millimeters
        unit_mm = float(units.conversion_factor(units.InsertUnits(unit), millimetre)) if unit else 1.0
    except MemoryError:
        raise
    except Exception as error:  # ezdxf raises whatever a torn file leads it to
        raise InputError(f"{path}: not a DXF file that can be read ({reason(error)})") from error
    drawing = DrawnPlan(note="" if unit else "the file says no unit: mm")
    drawing.unit_mm = unit_mm
    for number, entity in enumerate(document.modelspace(), 1):
        drawing.looked_at()
        if entity.dxftype() not in _KINDS:
            continue
        name = f"{entity.dxftype()} {number} of layer {short_repr(entity.dxf.layer)}"
        try:
            _require_bounded(entity)
            pen = Pen()
            for part in paths.make_path(entity).sub_paths():
                _draw(part, pen)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, ezdxf.DXFError) as error:
            raise InputError(f"{name}: no curve ({reason(error)})") from error
        for points, closed in pen.lines:
            drawing.add(name, points, (str(entity.dxf.layer),), closed)
    return drawing


def _require_bounded(entity: Any) -> None:
    """Refuse what would take long to draw before it is tried."""
    kind = entity.dxftype()
    places: Any = []
    if kind == "LINE":
        places = [entity.dxf.start, entity.dxf.end]
    elif kind in ("ARC", "ELLIPSE"):
        places = [entity.dxf.center, [entity.dxf.radius] if kind == "ARC" else entity.dxf.major_axis]
    elif kind == "LWPOLYLINE":
        places = list(entity.get_points("xyb"))
    elif kind == "POLYLINE":
        places = [vertex.dxf.location for vertex in entity.vertices]
    else:
        if entity.dxf.degree > _MOST_DEGREE:
            raise InputError(f"of degree {entity.dxf.degree}, allowed are up to {_MOST_DEGREE}")
        places = [*entity.control_points, *entity.fit_points]
    if len(places) > MOST_POINTS // 10:
        raise InputError(f"it has {len(places)} points, allowed are {MOST_POINTS // 10}")
    for place in places:
        if not (np.abs(np.array(list(place), dtype=float)) <= FARTHEST).all():
            raise InputError(f"coordinates that are no numbers or beyond {FARTHEST:g}")


def _draw(part: Any, pen: Pen) -> None:
    pen.begin(part.start[:2] if isinstance(part.start, tuple) else (part.start.x, part.start.y))
    for command in part.commands():
        controls = [getattr(command, name) for name in ("ctrl", "ctrl1", "ctrl2") if hasattr(command, name)]
        pen.curve(*((place.x, place.y) for place in (*controls, command.end)))
    pen.end(False)
