"""Curves of SVG and DXF drawings, as polylines."""

# pyright: reportPrivateImportUsage=false  ezdxf does not mark as exported what its manual imports
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from lxml import etree

from padforge.design.common.files import check_file, read_bytes
from padforge.design.common.validation import InputError, short_repr
from padforge.design.morphology import Array

if TYPE_CHECKING:
    from ezdxf.path import Path as BezierPath

MAX_BYTES = 2**22  # size of a drawing; drawings of fibres are far smaller
MAX_COORDINATE = 1e6  # largest absolute coordinate, in units of the drawing
FLATNESS = 1e-5  # largest distance of curve and polyline, relative to the size of the curve

_MAX_REASON = 120
_FIBRES = re.compile(r"(fibre|fiber|horizontal|vertical)", re.IGNORECASE)
_JOIN_TOLERANCE = 1e-6  # distance of ends that are one point, relative to the size of the drawing


@dataclass(frozen=True)
class DrawnCurve:
    """A curve of a drawing."""

    name: str  # in the file, or kind and number
    points: Array  # vertices; shape (n, 2), in units of the drawing, y upwards
    groups: tuple[str, ...] = ()  # names of the curve and of all groups or layers that contain it
    closed: bool = False


@dataclass
class DrawnPlan:
    """Content of a drawing."""

    unit_mm: float = 1.0  # of the drawing
    note: str = ""  # assumptions that were made
    curves: list[DrawnCurve] = field(default_factory=list)

    def add(self, name: str, points: Array, groups: Sequence[str] = (), closed: bool = False) -> None:
        """Add a `DrawnCurve` unless it is a single point; refuse coordinates beyond MAX_COORDINATE."""
        if not (np.abs(points) <= MAX_COORDINATE).all():
            raise InputError(f"{name}: coordinates that are no numbers or beyond {MAX_COORDINATE:g}")
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]
        if len(points) > 1:
            closed = closed or bool((points[0] == points[-1]).all())
            self.curves.append(DrawnCurve(name, points, tuple(filter(None, groups)), closed))

    @property
    def border(self) -> Array | None:
        """Low and high corner (2, 2) of what is named "pad"; None if nothing is."""
        outlines = [curve.points for curve in self.curves if _is_pad(curve)]
        if not outlines:
            return None
        points = np.vstack(outlines)
        return np.array([points.min(axis=0), points.max(axis=0)])

    @property
    def fibres(self) -> list[DrawnCurve]:
        """Curves named fibre, horizontal or vertical, or else all open ones, joined where one ends at another."""
        named = [curve for curve in self.curves if any(map(_FIBRES.match, curve.groups))]
        for curve in named:
            if curve.closed:
                raise InputError(f"{curve.name}: closed, expected a curve from one border of the pad to the other")
        chosen = named or [curve for curve in self.curves if not curve.closed and not _is_pad(curve)]
        return list(_join(chosen))


def _is_pad(curve: DrawnCurve) -> bool:
    return "pad" in (group.lower() for group in curve.groups)


def _join(curves: list[DrawnCurve]) -> Iterator[DrawnCurve]:
    """Join curves whose ends coincide."""
    if not curves:
        return
    from scipy.spatial import KDTree

    # 1. end 2 k is the start of curve k, end 2 k + 1 its end: which other end is each one joined to?
    ends = np.array([curve.points[end] for curve in curves for end in (0, -1)])
    tolerance = _JOIN_TOLERANCE * max(float(np.ptp(ends, axis=0).max()), 1e-9)
    nearest = KDTree(ends).query(ends, k=min(3, len(ends)), distance_upper_bound=tolerance)
    partners: dict[int, int] = {}
    for end, row in enumerate(zip(*(values.tolist() for values in nearest), strict=True)):
        close = [other for distance, other in zip(*row, strict=True) if distance <= tolerance and other != end]
        if len(close) > 1:
            x, y = ends[end]
            raise InputError(f"{curves[end // 2].name}: more than two curves end at ({x:g}, {y:g})")
        if close:
            partners[end] = close[0]
    # 2. walk from every free end to the other end of its chain
    remaining = set(range(len(curves)))
    for start in range(len(ends)):
        if start in partners or start // 2 not in remaining:
            continue
        chain: list[int] = []
        end: int | None = start
        while end is not None:
            chain.append(end)
            remaining.discard(end // 2)
            end = partners.get(end ^ 1)
        first, last = curves[chain[0] // 2], curves[chain[-1] // 2]
        points = np.vstack([curves[end // 2].points[:: 1 - 2 * (end % 2)] for end in chain])
        yield DrawnCurve(first.name if len(chain) == 1 else f"{first.name} to {last.name}", points, first.groups)
    if remaining:
        name = curves[min(remaining)].name
        raise InputError(f"{name}: part of a ring, or drawn twice, expected curves from border to border")


def _shorten(error: Exception) -> str:
    """Return a library's message in one line of limited length."""
    return " ".join(str(error).split())[:_MAX_REASON] or type(error).__name__


def _flatten(path: "BezierPath") -> Array:
    """Flatten a path of Bezier curves to a polyline (n, 2)."""
    control = np.array([vertex.xyz for vertex in path.control_vertices()])
    if not (np.abs(control) <= 1e3 * MAX_COORDINATE).all():  # a matrix may still scale it down
        raise InputError(f"coordinates that are no numbers or beyond {MAX_COORDINATE:g}")
    distance = FLATNESS * max(float(np.ptp(control, axis=0).max()), 1e-12)
    return np.array([vertex.xyz[:2] for vertex in path.flattening(distance, segments=16)])


_UNITS_MM = {
    **{"": 25.4 / 96, "px": 25.4 / 96, "mm": 1.0, "cm": 10.0, "q": 0.25, "in": 25.4},
    **{"pt": 25.4 / 72, "pc": 25.4 / 6},
}
# possessive quantifiers (++) do not backtrack: a text of a million blanks is scanned once, not a million times
_NUMBER = re.compile(r"[-+]?(?:\d++\.?\d*+|\.\d++)(?:[eE][-+]?\d++)?")
_LENGTH = re.compile(rf"\s*+({_NUMBER.pattern})\s*+([a-zA-Z]*+)\s*+")
_TRANSFORM = re.compile(r"\s*+,?\s*+([a-zA-Z]++)\s*+\(([^()]*+)\)\s*+")
_NOT_DRAWN = {"defs", "symbol", "clipPath", "mask", "pattern", "marker", "metadata", "style", "title", "desc", "text"}
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"
_LINK = "{http://www.w3.org/1999/xlink}href"
_MAX_USES = 8  # of symbols within symbols, which may be a circle


def read_svg(path: Path) -> DrawnPlan:
    """Read the curves of an SVG; lengths without a unit are pixels of 1/96 inch."""
    content = read_bytes(path, MAX_BYTES)
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False, remove_comments=True, remove_pis=True
    )
    if b"<!ENTITY" in content:
        raise InputError(f"{path}: declares entities, which no drawing of fibres needs")
    try:
        root = etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise InputError(f"{path}: not an SVG file that can be read ({_shorten(error)})") from error
    etree.strip_tags(root, etree.Entity)  # declared in an external DTD, which is not read
    if _kind(root) != "svg":
        raise InputError(f"{path}: the root is <{_kind(root)}>, expected <svg>")
    drawing = DrawnPlan()
    flip = np.diag([1.0, -1.0, 1.0])  # y of an SVG points down
    ids = {element.get("id"): element for element in root.iter() if element.get("id")}
    with np.errstate(all="ignore"):  # overflow is refused where curves are added
        for element, matrix, groups in _iterate_shapes(ids, root, flip @ _viewport(root)):
            _draw_shape(drawing, element, matrix, groups)
    return drawing


def _iterate_shapes(ids: Mapping[str, Any], root: Any, matrix: Array) -> Iterator[tuple[Any, Array, tuple[str, ...]]]:
    """Iterate over what is drawn, in order, with its matrix and the names of all that contains it."""
    stack: list[tuple[Any, Array, tuple[str, ...], int]] = [(child, matrix, (), 0) for child in reversed(root)]
    while stack:
        element, matrix, groups, uses = stack.pop()
        kind = _kind(element)
        style = element.get("style", "").replace(" ", "")
        if kind in _NOT_DRAWN or element.get("display") == "none" or "display:none" in style:
            continue
        name = element.get("id") or kind
        matrix = matrix @ _transform(element, name)
        groups = (*groups, element.get("id", ""), element.get(_LABEL, ""))
        if kind == "use":
            target = ids.get((element.get("href") or element.get(_LINK) or "").removeprefix("#"))
            if target is None:
                continue
            if uses == _MAX_USES:
                raise InputError(f"{name}: <use> of <use>, deeper than {_MAX_USES}")
            matrix = matrix @ _shift(*_lengths(element, name, "x", "y"))
            children = list(target) if _kind(target) == "symbol" else [target]
            stack += [(child, matrix, groups, uses + 1) for child in reversed(children)]
        elif kind in ("g", "a", "svg", "switch"):
            inner = matrix @ _viewport(element, nested=True) if kind == "svg" else matrix
            stack += [(child, inner, groups, uses) for child in reversed(element)]
        else:
            yield element, matrix, groups


def _draw_shape(drawing: DrawnPlan, element: Any, matrix: Array, groups: tuple[str, ...]) -> None:
    """Add the curves of an element, none if it is no curve."""
    kind, lines = _kind(element), list[tuple[Array, bool]]()
    name = next((group for group in reversed(groups) if group), f"{kind} {len(drawing.curves) + 1}")
    if kind == "path":
        lines = _parse_path(element.get("d", ""), name)
    elif kind == "line":
        lines = [(np.reshape(_lengths(element, name, "x1", "y1", "x2", "y2"), (2, 2)), False)]
    elif kind in ("polyline", "polygon"):
        numbers = [float(number) for number in _NUMBER.findall(element.get("points", ""))]
        lines = [(np.reshape(numbers[: len(numbers) // 2 * 2], (-1, 2)), kind == "polygon")]
    elif kind == "rect":
        x, y, width, height = _lengths(element, name, "x", "y", "width", "height")
        lines = [(np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]]), True)]
    for points, closed in lines:
        if len(points):
            points = np.vstack([points, points[:1]]) if closed else points
            drawing.add(name, points @ matrix[:2, :2].T + matrix[:2, 2], groups, closed)


def _parse_path(description: str, name: str) -> list[tuple[Array, bool]]:
    """Return the polylines of an SVG path, and whether each is closed."""
    from ezdxf.path import Path as BezierPath
    from fontTools.pens.recordingPen import RecordingPen
    from fontTools.svgLib.path.parser import parse_path

    pen = RecordingPen()
    try:
        parse_path(description, pen)
        path, lines = BezierPath(), []
        for command, points in pen.value:
            match command, points:
                case "moveTo", [start]:
                    path = BezierPath(start)
                case "lineTo", [end]:
                    path.line_to(end)
                case "qCurveTo", [control, end]:
                    path.curve3_to(end, control)
                case "curveTo", [first, second, end]:
                    path.curve4_to(end, first, second)
                case "closePath" | "endPath", _:
                    lines.append((_flatten(path) if len(path) else np.empty((0, 2)), command == "closePath"))
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
    except (ValueError, ArithmeticError, LookupError, AssertionError) as error:
        raise InputError(f"{name}: no path that can be read ({_shorten(error)})") from error
    return lines


def _kind(element: Any) -> str:
    return etree.QName(element).localname if isinstance(element.tag, str) else ""


def _lengths(element: Any, name: str, *attributes: str) -> list[float]:
    """Return lengths in user units, 0 where an attribute is missing; percentages have no meaning here."""
    lengths = []
    for attribute in attributes:
        text = element.get(attribute, "0")
        match = _LENGTH.fullmatch(text)
        if not match or match[2].lower() not in _UNITS_MM:
            raise InputError(f"{name}: {attribute} is {short_repr(text)}, expected a length")
        lengths.append(float(match[1]) * (_UNITS_MM[match[2].lower()] / _UNITS_MM[""] if match[2] else 1))
    return lengths


def _shift(x: float, y: float) -> Array:
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def _viewport(element: Any, nested: bool = False) -> Array:
    """Return the matrix from inside an <svg> to mm, or to the surrounding units if it is nested in another."""
    name = element.get("id") or "svg"
    origin = _shift(*_lengths(element, name, "x", "y")) if nested else np.eye(3)
    unit = np.eye(3) if nested else np.diag([_UNITS_MM[""], _UNITS_MM[""], 1.0])
    box = [float(number) for number in _NUMBER.findall(element.get("viewBox", ""))]
    if len(box) != 4:
        return unit @ origin
    if not (box[2] > 0 and box[3] > 0):
        text = short_repr(element.get("viewBox"))
        raise InputError(f"{name}: viewBox is {text}, expected x, y, width, height above 0")
    sides = [
        inner if element.get(side, "100%").strip().endswith("%") else _lengths(element, name, side)[0]
        for side, inner in zip(("width", "height"), box[2:], strict=True)
    ]
    scale = np.divide(sides, box[2:])
    if element.get("preserveAspectRatio", "").strip() != "none":
        scale[:] = scale.min()
    if not nested:  # the drawing's own origin is the one that was drawn from
        return unit @ np.diag([*scale, 1.0])
    x, y = (sides - box[2:] * scale) / 2
    return origin @ _shift(x, y) @ np.diag([*scale, 1.0]) @ _shift(-box[0], -box[1])


def _transform(element: Any, name: str) -> Array:
    """Return the matrix of the attribute `transform`."""
    text, matrix, at = element.get("transform", "").rstrip(), np.eye(3), 0
    while at < len(text):
        match = _TRANSFORM.match(text, at)
        if not match:
            raise InputError(f"{name}: transform is {short_repr(text)}, expected such as translate(1 2)")
        values = [float(number) for number in _NUMBER.findall(match[2])]
        if not all(map(math.isfinite, values)):
            raise InputError(f"{name}: transform is {short_repr(text)}, expected finite numbers")
        matrix, at = matrix @ _elementary_transform(match[1], values, name), match.end()
    return matrix


def _elementary_transform(kind: str, values: list[float], name: str) -> Array:
    match kind, values:
        case "matrix", [a, b, c, d, e, f]:
            return np.array([[a, c, e], [b, d, f], [0, 0, 1]])
        case "translate", [x, *y] if len(y) < 2:
            return _shift(x, *(y or [0.0]))
        case "scale", [x, *y] if len(y) < 2:
            return np.diag([x, *(y or [x]), 1.0])
        case "rotate", [degrees, *centre] if len(centre) in (0, 2):
            cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            x, y = centre or (0.0, 0.0)
            return _shift(x, y) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ _shift(-x, -y)
        case "skewX" | "skewY", [degrees]:
            skew = np.eye(3)
            skew[(0, 1) if kind == "skewX" else (1, 0)] = math.tan(math.radians(degrees))
            return skew
    raise InputError(f"{name}: transform {short_repr(kind)} of {len(values)} numbers is not defined")


_KINDS = ("LINE", "ARC", "LWPOLYLINE", "POLYLINE", "SPLINE", "ELLIPSE")


def read_dxf(path: Path) -> DrawnPlan:
    """Read the curves of a DXF's modelspace, in $INSUNITS or mm; blocks, hatches and text are ignored."""
    import ezdxf
    from ezdxf import path as paths
    from ezdxf import units

    path = check_file(path, MAX_BYTES)
    try:
        document = ezdxf.readfile(path)
        unit, millimetre = document.units, units.InsertUnits.Millimeters
        unit_mm = float(units.conversion_factor(units.InsertUnits(unit), millimetre)) if unit else 1.0
    except MemoryError:
        raise
    except Exception as error:  # ezdxf raises whatever a torn file leads it to
        raise InputError(f"{path}: not a DXF file that can be read ({_shorten(error)})") from error
    drawing = DrawnPlan(unit_mm, note="" if unit else "the file says no unit: mm")
    for number, entity in enumerate(document.modelspace(), 1):
        if entity.dxftype() not in _KINDS:
            continue
        name = f"{entity.dxftype()} {number} of layer {short_repr(entity.dxf.layer)}"
        try:
            _check_bounds(entity)
            lines = [_flatten(part) for part in paths.make_path(entity).sub_paths()]
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        except (ValueError, TypeError, ArithmeticError, LookupError, AttributeError, ezdxf.DXFError) as error:
            raise InputError(f"{name}: no curve ({_shorten(error)})") from error
        for points in lines:
            drawing.add(name, points, (str(entity.dxf.layer),))
    return drawing


def _check_bounds(entity: Any) -> None:
    """Refuse coordinates of what ezdxf makes a path of; `_flatten` refuses those of others."""
    points: Any = []
    match entity.dxftype():
        case "LWPOLYLINE":
            points = list(entity.get_points("xyb"))
        case "POLYLINE":
            points = [vertex.dxf.location for vertex in entity.vertices]
        case "SPLINE":
            points = [*entity.control_points, *entity.fit_points]
    if not all((np.abs(np.array(list(point), dtype=float)) <= MAX_COORDINATE).all() for point in points):
        raise InputError(f"coordinates that are no numbers or beyond {MAX_COORDINATE:g}")
