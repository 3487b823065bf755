"""Curves of SVG and DXF drawings, as polylines."""

# pyright: reportPrivateImportUsage=false  ezdxf does not mark as exported what its manual imports
import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from padforge.common.validation import InputError, naming_file, short_repr
from padforge.design.morphology import Array

if TYPE_CHECKING:
    from ezdxf.path import Path as BezierPath

MAX_COORDINATE = 1e6  # largest absolute coordinate, in units of the drawing
_FIBRES = re.compile(r"(fibre|fiber|horizontal|vertical)", re.IGNORECASE)
JOIN_MM = 0.01  # maximum distance of ends that are joined, since programs round where pieces of a line meet


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
    unit: str = "mm"  # name of the unit that the file states
    to_file: Callable[[Array], Array] = lambda point: point  # converts a point to the coordinates that the file has
    notes: list[str] = field(default_factory=list)  # assumptions about the drawing, and omitted curves
    curves: list[DrawnCurve] = field(default_factory=list)
    n_hidden: int = 0

    def add(self, name: str, points: Array, groups: Sequence[str], closed: bool = False) -> None:
        """Add a `DrawnCurve` unless it is a single point."""
        points = points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]
        if len(points) > 1:
            closed = closed or bool((points[0] == points[-1]).all())
            self.curves.append(DrawnCurve(name, points, tuple(filter(None, groups)), closed))

    def describe(self, points: Iterable[Array]) -> str:
        """Return the coordinates of points as the file has them: "(-20, 3) to (20, 3)"."""
        in_file = (np.round(self.to_file(point), 9) + 0.0 for point in points)  # + 0.0 removes the sign of 0
        return " to ".join(f"({x:.6g}, {y:.6g})" for x, y in in_file)

    @property
    def border(self) -> Array | None:
        """Low and high corner (2, 2) of the curves named "pad"; None if there are none."""
        outlines = [curve.points for curve in self.curves if _is_pad(curve)]
        if not outlines:
            return None
        points = np.vstack(outlines)
        return np.array([points.min(axis=0), points.max(axis=0)])

    @property
    def fibres(self) -> list[DrawnCurve]:
        """Curves named fibre, horizontal or vertical, or else all open ones, joined where one ends at another."""
        named, others = [], []
        for curve in self.curves:
            if any(map(_FIBRES.match, curve.groups)):
                named.append(curve)
            elif not curve.closed and not _is_pad(curve):
                others.append(curve)
        for curve in named:
            if curve.closed:
                raise InputError(f"{curve.name}: closed, expected a curve from one border of the pad to the other")
        if named and others:
            layers = dict.fromkeys(next(filter(_FIBRES.match, curve.groups)) for curve in named)
            where = ", ".join(map(short_repr, list(layers)[:3]))
            self.notes.append(f"open curves outside of {where}, which are left out: {len(others)}")
        return self._join(named or others)

    def _join(self, curves: Sequence[DrawnCurve]) -> list[DrawnCurve]:
        """Join curves whose ends are within JOIN_MM."""
        from ezdxf import edgeminer

        if not curves:
            return []
        size = float(np.ptp(np.vstack([curve.points[[0, -1]] for curve in curves]), axis=0).max())
        tolerance = min(JOIN_MM / self.unit_mm, 1e-3 * size)  # the latter if the unit, not stated, is m
        edges = [
            edgeminer.make_edge(curve.points[0], curve.points[-1], payload=number)
            for number, curve in enumerate(curves)
        ]
        deposit = edgeminer.Deposit(edges, gap_tol=tolerance)
        for curve in curves:
            for end in curve.points[[0, -1]]:
                if deposit.degree(end) > 2:
                    raise InputError(f"{curve.name}: more than two curves end at {self.describe([end])} in the drawing")

        def first_curve(chain: "Sequence[edgeminer.Edge]") -> int:
            return min(edge.payload for edge in chain)

        joined = []
        for chain in sorted(edgeminer.find_all_simple_chains(deposit), key=first_curve):
            if len(chain) > 1 and edgeminer.is_loop(chain, gap_tol=tolerance):
                name = curves[first_curve(chain)].name
                raise InputError(f"{name}: part of a ring, or drawn twice, expected curves from border to border")
            if chain[0].payload > chain[-1].payload:
                chain = edgeminer.reverse_chain(chain)
            first, last = curves[chain[0].payload], curves[chain[-1].payload]
            pieces = [curves[edge.payload].points[:: -1 if edge.is_reverse else 1].copy() for edge in chain]
            for before, after in pairwise(pieces):
                before[-1] = after[0] = (before[-1] + after[0]) / 2
            name = first.name if len(chain) == 1 else f"{first.name} to {last.name}"
            joined.append(DrawnCurve(name, np.vstack(pieces), first.groups))
        return joined


def _is_pad(curve: DrawnCurve) -> bool:
    return "pad" in (group.lower() for group in curve.groups)


@contextmanager
def _reraise(message: str) -> Iterator[None]:
    """Put an error of a library, which raises whatever a torn file leads it to, into one line of limited length."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{message} ({reason})") from error


def _flatten(path: "BezierPath") -> Array:
    """Flatten a path of Bezier curves to a polyline (n, 2), within 1e-5 of its size."""
    control = np.array([vertex.xyz for vertex in path.control_vertices()])
    if not (np.abs(control) <= MAX_COORDINATE).all():
        raise InputError(f"coordinates that are no numbers or beyond {MAX_COORDINATE:g}")
    distance = 1e-5 * max(float(np.ptp(control, axis=0).max()), 1e-12)
    return np.array([vertex.xyz[:2] for vertex in path.flattening(distance, segments=16)])


_MM_PER_PIXEL = 25.4 / 96
_TEMPLATES = {"symbol", "mask", "marker"}  # drawn only where they are used
_LABEL = "{http://www.inkscape.org/namespaces/inkscape}label"


def read_svg(path: Path) -> DrawnPlan:
    """Read the curves of an SVG; lengths without a unit are pixels of 1/96 inch."""
    from svgelements import SVG, Matrix

    with _reraise("not an SVG file that can be read"):
        tree = ElementTree.fromstring(path.read_bytes())
        if _kind(tree) != "svg":
            raise InputError(f"the root is <{_kind(tree)}>, expected <svg>")
        _adapt_tree(tree)
        has_unit = tree.get("width", "%").endswith(("mm", "cm", "in", "pt", "pc", "m")) and "viewBox" in tree.attrib
        unit = "mm of its width and viewBox" if has_unit else "pixels of 1/96 inch, as it states no other unit"
        # Internal entities, as Illustrator declares them, are replaced by expat, which limits them.
        root: Any = SVG.parse(io.BytesIO(ElementTree.tostring(tree)), on_error="raise", parse_display_none=True)
        # positions count from the origin of the drawing's coordinates, not from the corner of the viewBox
        to_pixels = Matrix(root.viewbox_transform)
        origin = np.array(to_pixels.point_in_matrix_space((0, 0)))
        mm = np.array([_MM_PER_PIXEL, -_MM_PER_PIXEL])  # y points down

        def to_file(point_mm: Array) -> Array:
            return np.array((~to_pixels).point_in_matrix_space(tuple(point_mm / mm + origin)))

        drawing = DrawnPlan(unit=unit, to_file=to_file)
        for shape, groups, is_hidden in _iterate_shapes(root, (), False):
            number = f"{shape.values['tag']} {len(drawing.curves) + 1}"
            name = next((group for group in reversed(groups) if group), number)
            for points, closed in _flatten_shape(shape):
                if is_hidden:
                    drawing.n_hidden += 1
                else:
                    drawing.add(name, (points - origin) * mm, groups, closed)
    return drawing


def _kind(element: Element) -> str:
    return element.tag.rpartition("}")[2]


def _adapt_tree(tree: Element) -> None:
    """Replace containers that svgelements does not know by groups, and put templates, which are not drawn, into <defs>.

    A path without data, such as that of a blank, gets an empty `d`.
    """
    for parent in list(tree.iter()):
        namespace = tree.tag.removesuffix("svg")
        for number, child in enumerate(parent):
            if _kind(child) in _TEMPLATES | {"a", "switch"}:
                if _kind(child) in _TEMPLATES:
                    parent[number] = Element(f"{namespace}defs")
                    parent[number].append(child)
                child.tag = f"{namespace}g"
            elif _kind(child) == "path" and "d" not in child.attrib:
                child.set("d", "")


def _iterate_shapes(
    container: Any, groups: tuple[str, ...], is_hidden: bool
) -> Iterator[tuple[Any, tuple[str, ...], bool]]:
    """Iterate over the shapes, in order, with the names of their groups and their own, and whether they are hidden."""
    from svgelements import Group, Path, Polygon, Polyline, Rect, SimpleLine, Use

    for element in container:
        attributes = element.values["attributes"]
        names = (*groups, attributes.get("id", ""), attributes.get(_LABEL, ""))
        # "display" hides all that a group contains, while "visibility" may be overridden within it
        is_none = is_hidden or element.values.get("display") == "none" or element.values.get("opacity") == "0"
        if isinstance(element, Group | Use):
            yield from _iterate_shapes(element, names, is_none)
        elif isinstance(element, Path | Polygon | Polyline | Rect | SimpleLine):
            yield element, names, is_none or element.values.get("visibility") in ("hidden", "collapse")


def _flatten_shape(shape: Any) -> Iterator[tuple[Array, bool]]:
    """Flatten every part of a shape to a polyline, and say whether it is closed."""
    from ezdxf.path import Path as BezierPath
    from svgelements import Close, Move, Path

    outline: Any = abs(Path(shape))
    outline.approximate_arcs_with_cubics()
    for part in outline.as_subpaths():
        path = BezierPath(tuple(part[0].end))
        segments: list[Any] = [segment for segment in part if not isinstance(segment, Move)]
        for segment in segments:
            *controls, end = [tuple(point) for point in list(segment)[1:]]
            (path.line_to, path.curve3_to, path.curve4_to)[len(controls)](end, *controls)
        if segments:
            yield _flatten(path), isinstance(segments[-1], Close)


def read_dxf(path: Path) -> DrawnPlan:
    """Read the curves of a DXF's modelspace and of blocks inserted there, in $INSUNITS or mm.

    Hatches, dimensions and text are ignored, and so are entities on layers that are off or frozen.
    """
    import ezdxf
    from ezdxf import path as paths
    from ezdxf import units

    with _reraise("not a DXF file that can be read"):
        document = ezdxf.readfile(path)
        unit, millimetre = document.units, units.InsertUnits.Millimeters
        unit_mm = float(units.conversion_factor(units.InsertUnits(unit), millimetre)) if unit else 1.0
    unit_name = f"{units.unit_name(unit).lower()}, as $INSUNITS says" if unit else "mm, as it states no unit"
    drawing = DrawnPlan(unit_mm, unit_name, notes=[] if unit else ["the file says no unit: mm"])
    hidden = {layer.dxf.name.lower() for layer in document.layers if layer.is_off() or layer.is_frozen()}
    for number, entity, layers in _iterate_entities(document.modelspace(), ()):
        name = f"{entity.dxftype()} {number} of layer {short_repr(layers[-1])}"
        if entity.dxf.get("invisible", 0) or any(layer.lower() in hidden for layer in layers):
            drawing.n_hidden += 1
            continue
        with naming_file(name), _reraise("no curve"):
            for part in paths.make_path(entity).sub_paths():
                drawing.add(name, _flatten(part), layers)
    return drawing


def _iterate_entities(entities: Iterable[Any], inserts: tuple[str, ...]) -> Iterator[tuple[int, Any, tuple[str, ...]]]:
    """Iterate over the curves of a layout and of the blocks inserted in it, to a depth of 8, with numbers and layers.

    A curve in a block is also on the layers of the references to the block, and on these alone if its own is 0.
    """
    for number, entity in enumerate(entities, 1):
        layer = str(entity.dxf.layer)
        layers = inserts if layer == "0" and inserts else (*inserts, layer)
        if entity.dxftype() == "INSERT" and len(inserts) < 8:
            for reference in entity.multi_insert():
                yield from _iterate_entities(reference.virtual_entities(), layers)
        elif entity.dxftype() in ("LINE", "ARC", "LWPOLYLINE", "POLYLINE", "SPLINE", "ELLIPSE"):
            yield number, entity, layers
