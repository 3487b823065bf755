"""Curves of SVG files: paths, lines, polylines and rectangles, as transforms, `use`, viewBox and units place them."""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]  it is compiled
from padforge.design.common.errors import InputError, shown
from padforge.design.common.files import read_bytes
from padforge.design.pad.knots import Array

from .strokes import MOST_BYTES, Drawing, Pen, reason

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


def read_svg(path: Path) -> Drawing:
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
    drawing = Drawing()
    flip = np.diag([1.0, -1.0, 1.0])
    reader = _Reader(drawing, {each.get("id"): each for each in root.iter() if each.get("id")})
    with np.errstate(all="ignore"):  # what becomes of too large numbers is refused where it is added
        for element, matrix, groups in reader.shapes(root, flip @ _viewport(root)):
            reader.draw(element, matrix, groups)
    return drawing


class _Reader:
    """What it takes to go through a file."""

    def __init__(self, drawing: Drawing, ids: Mapping[str, Any]) -> None:
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
        raise InputError(f"{name}: {side} is {shown(text)}, expected a length")
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
        raise InputError(f"{name}: viewBox is {shown(element.get('viewBox'))}, expected x, y, width, height above 0")
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
            raise InputError(f"{name}: transform is {shown(text)}, expected such as translate(1 2)")
        values = [float(each) for each in _NUMBER.findall(found[2])]
        if not all(map(math.isfinite, values)):
            raise InputError(f"{name}: transform is {shown(text)}, expected finite numbers")
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
    raise InputError(f"{name}: transform {shown(kind)} of {len(values)} numbers, which there is not")
