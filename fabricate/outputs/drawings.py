"""Drawings of a pad at true size, 1 unit = 1 mm: its tracks as SVG and DXF, its orientation, the needle's toolpath."""

# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its manual imports as exported.

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import ALARM, FAINT, INK, PAPER
from padforge.design.morphology import Array
from padforge.design.paths.curves import beziers
from padforge.fabricate.fibre_placement import Step, mirror_x
from padforge.fabricate.plan import FAMILIES, FAMILY_COLOURS, Plan, fibre_layers, fibre_name, polygon_rings

Point = Sequence[float] | Array
Bounds = tuple[float, float, float, float]

_NAMESPACES = {
    "xmlns": "http://www.w3.org/2000/svg",
    "xmlns:xlink": "http://www.w3.org/1999/xlink",
    "xmlns:inkscape": "http://www.inkscape.org/namespaces/inkscape",
}
_TO_SVG = np.array([1, -1])
"""Turns plan coordinates into SVG coordinates, whose y runs downwards."""
_EDGE, _NOTE = "#888", "#555555"
"""Colours of outlines and of notes."""


@dataclass(frozen=True)
class _SvgWriter:
    """Writer of SVG elements in SVG coordinates, mm, with so many decimal places."""

    decimals: int

    def number(self, value: float) -> str:
        return f"{round(float(value), self.decimals) + 0.0:.10g}"  # + 0.0 turns -0.0 into 0.0

    def pair(self, point: Point) -> str:
        return f"{self.number(point[0])},{self.number(point[1])}"

    def path(self, points: Sequence[Point] | Array) -> str:
        """Return the path data of a polyline through points (n, 2)."""
        return "M" + "L".join(map(self.pair, points))

    def outline(self, area: BaseGeometry, mirrored: bool = False) -> str:
        """Return the path data of an area in plan coordinates, or of its mirror image in x."""
        scale = _TO_SVG * (-1 if mirrored else 1, 1)
        return "".join(f"{self.path(ring * scale)}Z" for polygon in polygon_rings(area) for ring in polygon)

    def element(self, tag: str, *content: str, **attributes: str | float) -> str:
        """Return an element; `_` in an attribute's name stands for `-`, and numbers are rounded."""
        texts = {k: v if isinstance(v, str) else self.number(v) for k, v in attributes.items()}
        start = " ".join([tag, *(f"{name.replace('_', '-')}={quoteattr(text)}" for name, text in texts.items())])
        inner = "\n".join(content)
        return f"<{start}>{inner}</{tag}>" if content else f"<{start}/>"

    def text(self, text: str, position: Point, anchor: str = "middle", fill: str = INK, **style: str | float) -> str:
        x, y = map(float, position)  # dy centres it vertically in every viewer
        return self.element("text", escape(text), x=x, y=y, dy="0.35em", text_anchor=anchor, fill=fill, **style)

    def document(self, bounds: Bounds, title: str, font_size: float, content: Sequence[str]) -> str:
        """Return an SVG document that shows x, y, width and height `bounds`."""
        size = dict(zip(("width", "height"), (f"{self.number(side)}mm" for side in bounds[2:]), strict=True))
        style = {"fill": "none", "font-family": "sans-serif", "font-size": font_size}
        frame = {**_NAMESPACES, **size, "viewBox": " ".join(map(self.number, bounds))}
        return self.element("svg", self.element("title", title), *content, **frame, **style) + "\n"


# Orientation

ORIENTATION_FILE = "orientation.svg"
ORIENTATION_CAPTION = "The pad in its mould, turned over, and in use, from above and from the near side."
ORIENTATION_LINK = f"![{ORIENTATION_CAPTION}]({ORIENTATION_FILE})"
"""The drawing on a page that lies beside it."""
TURN_DEG = 20.0
"""Angle of the pad in use under the arm: an example."""
_TURNED = (
    "The casting is turned over, left to right, and stays so: the face with the tracks and their numbers lies up, to be"
    " laid and then to be pressed; y runs as in the mould and x the other way (mirrored = true in [rig]); "
)
_NUMBERING = ("count from near to far and start", "count from right to left and start")
_STARTS = {
    "edges": ("on the right", "at the near side"),
    "one side": ("right of the pad, the first next to it", "within its width"),
}
_WIDTH_MM, _HEIGHT_MM, _HALF_MM = 64.0, 56.0, 21.0
"""Width and height of a panel, and half the side of the mould in it."""
_PANELS = (
    ("1  In the mould", "tracks down, numbers mirrored"),
    ("2  Turned over, left to right", "tracks up, numbers read right: lay here"),
    ("3  In use", "tracks up: this face is pressed"),
)
_TITLE_MM, _LABEL_MM, _LABEL_LINE_MM = 3.2, 2.6, 4.0
_HEAD_MM, _BESIDE_MM = 11.0, 1.2
"""Height of a panel's title, and gap between an edge and the number beside it."""
_SLAB_MM, _TRACK_MM, _FLOOR_MM, _WALL_MM = 6.0, 1.6, 1.5, 2.0
"""Pad, track, and floor and wall of the mould in the side views, which are not to scale."""
_MAX_LETTERS = 135
"""Letters in a line of the sentence."""
_SVG = _SvgWriter(decimals=2)


def orientation_sentence(counts: tuple[int, int], leads: str) -> str:
    """Return the sentence on the orientation of a pad of horizontal and vertical fibres, and of their numbers."""
    rules = [f"{numbering} {start}" for numbering, start in zip(_NUMBERING, _STARTS[leads], strict=True)]
    fibres = f"horizontal fibres {rules[0]}, vertical ones {rules[1]}"
    if 0 in counts:
        family = int(counts[0] == 0)
        fibres = f"all fibres are {FAMILIES[family]}: they {rules[family]}"
    return _TURNED + ("all leads leave at the near side: " if leads == "one side" else "") + fibres + "."


@dataclass(frozen=True)
class _Panel:
    """A view of the pad from above, its centre at (x, y) mm, turned over if `mirrored`, then counter-clockwise."""

    x: float
    y: float
    scale: float
    mirrored: bool = False
    turn_deg: float = 0.0

    @property
    def transform(self) -> str:
        """SVG transform from the plan, y downwards, to the drawing."""
        scale_x = -self.scale if self.mirrored else self.scale
        rotation = f"rotate({_SVG.number(-self.turn_deg)}) scale({scale_x:.5g} {self.scale:.5g})"
        return f"translate({_SVG.number(self.x)} {_SVG.number(self.y)}) {rotation}"

    def project(self, points: Array) -> Array:
        """Return the points (n, 2) on the drawing of points (n, 2) of the plan, mm."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        scaled = self.scale * np.asarray(points) * [-1 if self.mirrored else 1, 1]
        return (self.x, self.y) + scaled @ np.array([[cos, -sin], [-sin, -cos]])


def orientation_svg(plan: Plan) -> str:
    """Draw the pad from above and from the near side: in the mould, turned over, and in use under an arm."""
    scale, y = _HALF_MM / np.abs(plan.tray.bounds).max(), _HEAD_MM + _HEIGHT_MM / 2
    poses = ((False, 0.0), (True, 0.0), (True, TURN_DEG))
    panels = [_Panel((column + 0.5) * _WIDTH_MM, y, scale, *pose) for column, pose in enumerate(poses)]
    sentence = orientation_sentence(plan.pad.layout.counts, plan.settings.pad.leads)
    lines = textwrap.wrap(sentence, _MAX_LETTERS)
    sides_y = _HEAD_MM + _HEIGHT_MM + 6
    text_y = sides_y + _SLAB_MM + 2 * _LABEL_LINE_MM + 2
    width, height = 3 * _WIDTH_MM, text_y + (len(lines) - 0.5) * _LABEL_LINE_MM
    content = [
        _SVG.element("desc", sentence),
        _SVG.element("rect", width=width, height=height, fill="white"),
        _SVG.element("defs", _SVG.element("g", *_draw_pad(plan, scale), id="pad")),
    ]
    for name, panel in zip(("mould", "turned", "used"), panels, strict=True):
        content.append(_SVG.element("g", *_draw_panel(plan, panel), id=name))
    content.append(_SVG.element("g", *_draw_arm(panels[2]), id="arm"))
    content.append(_SVG.element("g", *_draw_sides(plan, panels, sides_y), id="sides"))
    for column, (title, note) in enumerate(_PANELS):
        x = column * _WIDTH_MM + 4
        content.append(_SVG.text(title, (x, 4), "start", font_size=_TITLE_MM, font_weight="bold"))
        content.append(_SVG.text(note, (x, 4 + _LABEL_LINE_MM), "start"))
    content += [_SVG.text(line, (4, text_y + row * _LABEL_LINE_MM), "start") for row, line in enumerate(lines)]
    return _SVG.document((0, 0, width, height), ORIENTATION_CAPTION, _LABEL_MM, content)


def _draw_pad(plan: Plan, scale: float) -> Iterator[str]:
    """Draw the silicone's edge, the tracks and the numbers cast in, mm of the plan; strokes as wide at any scale."""
    yield _SVG.element("path", d=_SVG.outline(plan.silicone), fill=PAPER, stroke=_EDGE, stroke_width=0.2 / scale)
    for layer in fibre_layers(plan):
        for fibre in layer.fibres:
            points = shapely.get_coordinates(plan.lines[fibre].simplify(0.05)) * _TO_SVG
            yield _SVG.element("path", d=_SVG.path(points), stroke=layer.colour, stroke_width=0.35 / scale)
    for fibre, number in enumerate(plan.numbers):
        if number is not None:
            fill = FAMILY_COLOURS[plan.family(fibre)]
            yield _SVG.element("path", **{"class": "cast"}, d=_SVG.outline(number), fill=fill)


def _draw_panel(plan: Plan, panel: _Panel) -> Iterator[str]:
    """Draw the pad in a panel with its axes, and every fibre's number outside the pad beside its start."""
    if not panel.mirrored:
        yield _SVG.element("path", d=_SVG.outline(plan.tray), fill=FAINT, transform=panel.transform)
    yield _SVG.element("use", **{"xlink:href": "#pad"}, transform=panel.transform)
    bounds = (plan.silicone if panel.mirrored else plan.tray).bounds
    size = min(_LABEL_MM, 0.6 * plan.min_pitch_mm * panel.scale)
    for fibre, lead in enumerate(plan.ends(0)):
        start = lead.turned_mm.copy()
        start[lead.axis] = bounds[lead.axis] - (_BESIDE_MM + size / 2) / panel.scale
        style = {"fill": FAMILY_COLOURS[plan.family(fibre)], "font_size": size, "font_weight": "bold"}
        yield _SVG.text(str(fibre + 1), panel.project(start[None])[0], **style)
    length = 0.45 * math.sqrt(math.prod(plan.cavity.bounds[2:]))
    for axis, tip in zip("xy", np.eye(2) * length, strict=True):
        start, end, label = panel.project(np.array([0 * tip, tip, 1.2 * tip]))
        yield from _draw_arrow(start, end)
        yield _SVG.text(axis, label, paint_order="stroke", stroke="white", stroke_width=0.8)


def _draw_arm(panel: _Panel) -> Iterator[str]:
    """Draw the axes of the arm's base beside the pad in use, and the pad's angle to them."""
    corner = np.array([panel.x - _WIDTH_MM / 2 + 4, panel.y + _HEIGHT_MM / 2 - 2])
    for axis, tip in zip("xy", np.array([(9.0, 0.0), (0.0, -9.0)]), strict=True):
        yield from _draw_arrow(corner, corner + tip)
        yield _SVG.text(axis, corner + 1.2 * tip)
    yield _SVG.text("arm", (corner[0] + 2, corner[1] - 2.5), "start")
    top = panel.y - 1.25 * _HALF_MM
    parallel = _SVG.path([(panel.x, panel.y), (panel.x, top)])
    yield _SVG.element("path", d=parallel, stroke=INK, stroke_width=0.25, stroke_dasharray="1 1")
    yield _SVG.text("pad_angle_deg", (panel.x + 1, top), "start")


def _draw_sides(plan: Plan, panels: Sequence[_Panel], top: float) -> Iterator[str]:
    """Draw cross-sections of all panels at the near side, where fibres start; heights are not to scale."""
    bottom, half = top + _SLAB_MM, plan.cavity.bounds[2] * panels[0].scale
    floor = bottom + _FLOOR_MM

    def box(x: float, y: float, width: float, height: float, fill: str) -> str:
        style = {"fill": fill, "stroke": _EDGE, "stroke_width": 0.15}
        return _SVG.element("rect", x=x, y=y, width=width, height=height, **style)

    yield box(panels[0].x - half - _WALL_MM, top, 2 * (half + _WALL_MM), floor - top, FAINT)
    for panel in panels:
        yield box(panel.x - half, top, 2 * half, _SLAB_MM, PAPER)
    starts = [(fibre, lead.turned_mm[0]) for fibre, lead in enumerate(plan.ends(0)) if lead.axis == 1]
    size = min(_LABEL_MM, 0.6 * plan.min_pitch_mm * panels[0].scale)
    for panel, y, fill in zip(panels, (bottom - _TRACK_MM, top, top), (FAINT, "white", ""), strict=True):
        for fibre, x_mm in starts:
            x = panel.x + (-x_mm if panel.mirrored else x_mm) * panel.scale
            colour = FAMILY_COLOURS[plan.family(fibre)]
            yield box(x - 0.4, y, 0.8, _TRACK_MM, fill or colour)
            yield _SVG.text(str(fibre + 1), (x, floor + size), fill=colour, font_size=size)
    x = panels[2].x
    yield _SVG.element("path", id="probe", d=f"M{_SVG.pair((x - 2, top - 7))}v4a2,2 0 0 0 4,0v-4z", fill=INK)
    table = f"M{_SVG.pair((x - half - 6, bottom))}h{_SVG.number(2 * half + 12)}"
    yield _SVG.element("path", d=table, stroke=INK, stroke_width=0.4)


def _draw_arrow(start: Array, end: Array) -> Iterator[str]:
    """Draw an arrow with a white rim, which sets it off from its background."""
    along = (end - start) / np.hypot(*(end - start))
    across = along @ np.array([[0, 1], [-1, 0]])
    path = _SVG.path([start, end]) + _SVG.path([end - 2 * along + across, end, end - 2 * along - across])
    for colour, width in (("white", 1.2), (INK, 0.5)):
        yield _SVG.element("path", d=path, stroke=colour, stroke_width=width)


# Tracks

SCALE_MM = 10.0
"""Length of the scale bar, which verifies the size of a print."""
_TEXT_MM = 2.5
"""Text height by drawing standards; less where the pitch is narrow."""
_GAP_MM = 1.0
"""Gap between the silicone and the text beside it."""
_LETTER_MM = 0.6
"""Width of a letter for a text height of 1, on average."""
_VIEW = "as it lies in the tray, seen from above"
_DESCRIPTION = (
    "True size, 1 unit = 1 mm. Seen from above as the pad lies in the tray, tracks down: the mould's ridges lie as"
    " drawn. {} Layers are in laying order, the deepest first."
)
_ACI = (5, 30)
"""Blue and orange of the AutoCAD Color Index, for readers without true colour."""


class _Label(NamedTuple):
    """A line of text, aligned to (x, y) mm by `anchor`: "start", "middle" or "end"."""

    text: str
    x: float
    y: float
    anchor: str
    colour: str


class _TrackSheet:
    """Layout of the drawing of the tracks, mm, y upwards.

    Attributes:
        text_mm: text height.
        sentence: on the orientation.
        spans: Bezier control points of every fibre and its leads; shape (n, 4, 2).
        ends: start and end of every fibre at the silicone's edge; shape (F, 2, 2).
        numbers: the fibres' numbers outside the silicone, at the starts, and at the ends of leads to one side.
        scale_bar: segments of the scale bar; shape (4, 2, 2).
        notes: text beside the scale bar and below it.
        frame: x_min, y_min, x_max and y_max of the drawing.
    """

    def __init__(self, plan: Plan) -> None:
        layout, pairs = plan.pad.layout, plan.leads.pairs
        x_min, y_min, x_max, y_max = plan.silicone.bounds
        self.text_mm = min(_TEXT_MM, 0.6 * plan.min_pitch_mm)
        self.sentence = orientation_sentence(layout.counts, plan.settings.pad.leads)
        self.spans = [
            np.concatenate([start.spans[::-1, ::-1], plan.pad.to_mm(curve), end.spans])
            for (start, end), curve in zip(pairs, beziers(plan.pad), strict=True)
        ]
        self.ends = np.array([[lead.point_past_edge(plan.settings.mould.exit_mm) for lead in pair] for pair in pairs])

        self.numbers: list[_Label] = []
        for ends in self.ends.swapaxes(0, 1)[: 1 + (plan.settings.pad.leads == "one side")].tolist():
            for fibre, (x, y) in enumerate(ends):
                below = pairs[fibre][0].axis == 1
                position = (x, y - _GAP_MM - self.text_mm / 2) if below else (x - _GAP_MM, y)
                anchor, colour = "middle" if below else "end", FAMILY_COLOURS[plan.family(fibre)]
                self.numbers.append(_Label(str(fibre + 1), *position, anchor, colour))

        bar_y = y_min - 4 * _GAP_MM - self.text_mm
        ticks = [(x_min + share * SCALE_MM, bar_y + mm) for share, mm in ((0, 1.5), (0.5, 0.8), (1, 1.5))]
        bar = [((x_min, bar_y), (x_min + SCALE_MM, bar_y)), *(((x, bar_y), (x, y)) for x, y in ticks)]
        self.scale_bar = np.array(bar)
        # The notes are as wide as the silicone, or as the scale bar with the two texts beside it.
        width = max(x_max - x_min, SCALE_MM + _GAP_MM + (5 + _LETTER_MM * len(_VIEW)) * self.text_mm)
        lines, line_mm = textwrap.wrap(self.sentence, int(width / (_LETTER_MM * self.text_mm))), 1.4 * self.text_mm
        x, y, first_y = x_min + SCALE_MM + _GAP_MM, bar_y + self.text_mm / 4, bar_y - _GAP_MM - line_mm / 2
        texts = [(f"{SCALE_MM:g} mm", x, y), (_VIEW, x + 5 * self.text_mm, y)]
        texts += [(line, x_min, first_y - row * line_mm) for row, line in enumerate(lines)]
        self.notes = [_Label(*text, "start", _NOTE) for text in texts]

        numbers_mm = 2 * _GAP_MM + len(str(layout.fibres)) * self.text_mm
        y_low = bar_y - 3 * _GAP_MM - len(lines) * line_mm
        self.frame: Bounds = (x_min - numbers_mm, y_low, x_min + width + 2 * _GAP_MM, y_max + 2 * _GAP_MM)


def tracks_svg(plan: Plan) -> str:
    """Draw the fibres as an SVG of true size, every PCHIP span as one cubic Bezier segment.

    Every depth is a layer, every fibre a path that runs straight on from its ends through border and exit to the
    silicone's edge. Further layers hold that edge, the sensor numbers beside the starts, and a scale bar.
    """
    sheet, svg = _TrackSheet(plan), _SvgWriter(decimals=4)  # a tenth of a micrometre, far below any printer

    def layer(name: str, label: str, content: Sequence[str], **style: str) -> str:
        inkscape = {"inkscape:groupmode": "layer", "inkscape:label": label}
        return svg.element("g", *content, id=name, **inkscape, **style)

    def labels(labels: Sequence[_Label]) -> list[str]:
        return [svg.text(label.text, (label.x, -label.y), label.anchor, label.colour) for label in labels]

    edge = svg.element("path", id="edge", d=svg.outline(plan.silicone))
    content = [
        svg.element("desc", _DESCRIPTION.format(sheet.sentence)),
        layer("silicone", "silicone's edge", [edge], stroke=_EDGE, stroke_width="0.2"),
    ]
    for depth in fibre_layers(plan):
        paths = []
        for fibre in depth.fibres:
            start, end = map(svg.pair, sheet.ends[fibre] * _TO_SVG)
            spans = [list(map(svg.pair, span)) for span in sheet.spans[fibre] * _TO_SVG]
            curves = "".join(f"C{' '.join(span[1:])}" for span in spans)
            name = fibre_name(plan, fibre).replace(" ", "-")
            paths.append(svg.element("path", id=name, d=f"M{start}L{spans[0][0]}{curves}L{end}"))
        style = {"stroke": depth.colour, "stroke_width": f"{plan.settings.fibre.material.diameter_mm:g}"}
        content.append(layer(depth.name, f"{FAMILIES[depth.family]}, {depth.depth_mm:g} mm deep", paths, **style))
    content.append(layer("numbers", "sensor numbers", labels(sheet.numbers)))
    bar = svg.element("path", d="".join(map(svg.path, sheet.scale_bar * _TO_SVG)), stroke=_NOTE, stroke_width=0.2)
    content.append(layer("scale", f"scale bar, {SCALE_MM:g} mm", [bar, *labels(sheet.notes)]))
    x_min, y_min, x_max, y_max = sheet.frame
    bounds = (x_min, -y_max, x_max - x_min, y_max - y_min)
    return svg.document(bounds, f"Fibre tracks of a pad, {_VIEW}", sheet.text_mm, content)


def tracks_dxf(plan: Plan) -> str:
    """Draw the fibres as a DXF R2010 in mm, every fibre as one cubic spline whose spans are the PCHIP's.

    Layers are those of the SVG. The same plan gives the same bytes.
    """
    import ezdxf
    from ezdxf.colors import RGB
    from ezdxf.enums import TextEntityAlignment as Alignment

    anchors = {"start": Alignment.MIDDLE_LEFT, "middle": Alignment.MIDDLE_CENTER, "end": Alignment.MIDDLE_RIGHT}
    sheet, stream = _TrackSheet(plan), io.StringIO()
    with ExitStack() as stack:  # keeps the time and random ids out of the file
        fixed = "write_fixed_meta_data_for_testing"
        stack.callback(setattr, ezdxf.options, fixed, getattr(ezdxf.options, fixed))
        setattr(ezdxf.options, fixed, True)
        document = ezdxf.new("R2010", units=ezdxf.units.MM)
        space = document.modelspace()
        document.layers.add("silicone", color=8)
        for ring in (ring for polygon in polygon_rings(plan.silicone) for ring in polygon):
            space.add_lwpolyline(np.round(ring, 6).tolist(), close=True, dxfattribs={"layer": "silicone"})
        for layer in fibre_layers(plan):
            document.layers.add(layer.name, color=_ACI[layer.family]).rgb = RGB.from_hex(layer.colour)
            for fibre in layer.fibres:
                points = _spline_points(sheet, fibre)
                n_spans = len(points) // 3
                # A step of 1 for every span, however short: some readers merge knots that nearly coincide.
                knots = [0, *np.repeat(np.arange(n_spans + 1), 3).tolist(), n_spans]
                space.add_open_spline(np.round(points, 6).tolist(), knots=knots, dxfattribs={"layer": layer.name})
        for name, labels in (("numbers", sheet.numbers), ("scale", sheet.notes)):
            document.layers.add(name, color=7)
            for label in labels:
                attributes = {"layer": name, "height": 0.72 * sheet.text_mm}  # CAD measures the height of capitals
                text = space.add_text(label.text, dxfattribs=attributes)
                text.set_placement((label.x, label.y), align=anchors[label.anchor])
        for start, end in sheet.scale_bar.tolist():
            space.add_line(start, end, dxfattribs={"layer": "scale"})
        x_min, y_min, x_max, y_max = sheet.frame
        space.reset_extents((x_min, y_min, 0), (x_max, y_max, 0))
        document.set_modelspace_vport(height=y_max - y_min, center=((x_min + x_max) / 2, (y_min + y_max) / 2))
        for kind in sorted(document.entitydb.dxf_types_in_use()):  # in the order of a set otherwise, which varies
            document.classes.add_class(kind)
        document.write(stream)
    return stream.getvalue()


def _spline_points(sheet: _TrackSheet, fibre: int) -> Array:
    """Return the control points (3 n + 1, 2) of a fibre's n spans, with the straight ones at its ends, if any."""
    spans, (start, end) = sheet.spans[fibre], sheet.ends[fibre]
    points = np.vstack([spans[0, :1], *spans[:, 1:]])
    if (start == points[0]).all():
        return points
    thirds = np.arange(3)[:, None] / 3
    return np.vstack([start + thirds * (points[0] - start), points, end + thirds[::-1] * (points[-1] - end)])


# Toolpath

_MARGIN_MM = 6.0
"""Margin around the toolpath, for the numbers."""
_LEGEND_LINE_MM, _MIN_LEGEND_MM = 4.5, 90.0
"""Line spacing and width of the legend."""


def toolpath_svg(plan: Plan, steps: Sequence[Step]) -> str:
    """Draw the toolpath of the needle on the pad turned over, and the order of the fibres.

    A ring with the fibre's number marks where it is fastened, a dot with its turn where it is cut. Travel moves above
    the pad are dashed, and the needle's box is red.
    """
    svg = _SvgWriter(decimals=3)
    strokes = [stroke for step in steps for stroke in step.strokes]
    points = np.vstack([stroke.positions_mm for stroke in strokes])
    (x_min, y_min), (x_max, y_max) = points.min(axis=0) - _MARGIN_MM, points.max(axis=0) + _MARGIN_MM
    x_max = max(x_max, x_min + _MIN_LEGEND_MM)
    dispenser, legend = plan.settings.dispenser, []
    for number, step in enumerate(steps, 1):
        layer, z = step.layer, svg.number(step.strokes[0].z_mm)
        text = f"{number}. {FAMILIES[layer.family]}, {layer.depth_mm:.3g} mm deep, needle at z = {z} mm"
        legend.append((text, layer.colour))
    travel_z = f"z = {dispenser.travel_height_mm:g} mm"
    legend.append((f"The pad lies turned over, tracks up, seen from above. Dashed: at {travel_z}.", INK))
    legend.append(("Ring: number of the fibre, fasten it. Dot: its turn, cut it.", INK))
    width, height = x_max - x_min, y_max - y_min + _LEGEND_LINE_MM * (len(legend) + 1)

    clip = svg.element("rect", x=x_min, y=-y_max, width=width, height=y_max - y_min)
    box_x, box_y, _ = np.reshape(dispenser.box_mm, (3, 2))
    box = (np.array([box_x[[0, 1, 1, 0]], box_y[[0, 0, 1, 1]]]).T - dispenser.origin_mm) * _TO_SVG
    box_style = {"stroke": ALARM, "stroke_width": 0.4, "clip_path": "url(#above-legend)"}
    travels = "".join(
        svg.path(np.array([cut.positions_mm[-1], fastened.positions_mm[0]]) * _TO_SVG)
        for cut, fastened in pairwise(strokes)
    )
    content = [
        svg.element("clipPath", clip, id="above-legend"),
        svg.element("path", id="silicone", stroke=_EDGE, stroke_width=0.2, d=svg.outline(plan.silicone, mirrored=True)),
        svg.element("path", id="box", **box_style, d=f"{svg.path(box)}Z"),
        svg.element("path", id="middle", stroke=INK, stroke_width=0.2, d="M-2,0L2,0M0,-2L0,2"),
        svg.element("path", id="travel", stroke=FAINT, stroke_width=0.2, stroke_dasharray="1 1", d=travels),
    ]
    for step in steps:
        paths = [
            svg.element("path", id=f"fibre-{stroke.fibre + 1}", d=svg.path(stroke.positions_mm * _TO_SVG))
            for stroke in step.strokes
        ]
        content.append(svg.element("g", *paths, id=step.layer.name, stroke=step.layer.colour, stroke_width=0.3))
    for turn, stroke in enumerate(strokes, 1):
        start, end = stroke.positions_mm[[0, -1]] * _TO_SVG
        before, after = (2.5 * mirror_x(lead.outward) * _TO_SVG for lead in plan.leads.pairs[stroke.fibre])
        content += [
            svg.element("circle", cx=start[0], cy=start[1], r=0.8, stroke=INK, stroke_width=0.2),
            svg.element("circle", cx=end[0], cy=end[1], r=0.5, fill=INK),
            svg.text(str(stroke.fibre + 1), start + before),
            svg.text(f"{turn}.", end + after),
        ]
    for row, (text, colour) in enumerate(legend, 1):
        content.append(svg.text(text, (x_min + 1, _LEGEND_LINE_MM * row - y_min), "start", colour))
    title = "The needle's toolpath, from above: the pad turned over, tracks up"
    return svg.document((x_min, -y_max, width, height), title, _TEXT_MM, content)
