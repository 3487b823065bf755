"""Drawings of the tracks of a pad at true size, 1 unit = 1 mm, as SVG and DXF, and the sentence on its orientation."""

# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its manual imports as exported.

import io
import textwrap
from collections.abc import Sequence
from contextlib import ExitStack
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from padforge.common.plotting import FAMILY_COLOURS
from padforge.design.morphology import Array
from padforge.design.paths.curves import beziers
from padforge.design.settings import FAMILIES
from padforge.fabricate.plan import Plan, fibre_layers, polygon_rings

Bounds = tuple[float, float, float, float]

_NAMESPACES = {"xmlns": "http://www.w3.org/2000/svg", "xmlns:inkscape": "http://www.inkscape.org/namespaces/inkscape"}
_NOTE = "#555555"  # colour of notes
ORIENTATION_FILE = "figures/orientation.svg"
ORIENTATION_CAPTION = "The pad in its mould, turned over, and in use, from above and from the near side."
ORIENTATION_LINK = f"![{ORIENTATION_CAPTION}]({ORIENTATION_FILE})"  # link to the drawing from `laying.md`
CROSSING_FILE = "figures/crossing.svg"
CROSSING_CAPTION = "The two fibres that cross nearest to each other, in section: the pad lies turned over, to scale."
CROSSING_LINK = f"![{CROSSING_CAPTION}]({CROSSING_FILE})"
MIRRORED = "Its numbers are mirrored on purpose: on the casting they read the right way."
_TURNED = (
    "The casting is turned over, left to right, and stays so: the face with the tracks and their numbers lies up, to be"
    " laid and then to be pressed; y runs as in the mould and x the other way (mirrored = true in [rig]); "
)
_NUMBERING = ("count from near to far and start", "count from right to left and start")
_STARTS = {
    "edges": ("on the right", "at the near side"),
    "one side": ("right of the pad, the first next to it", "within its width"),
}


def orientation_sentence(counts: tuple[int, int], leads: str) -> str:
    """Return the sentence on the orientation of a pad of horizontal and vertical fibres, and of their numbers."""
    rules = [f"{numbering} {start}" for numbering, start in zip(_NUMBERING, _STARTS[leads], strict=True)]
    fibres = f"horizontal fibres {rules[0]}, vertical ones {rules[1]}"
    if 0 in counts:
        family = int(counts[0] == 0)
        fibres = f"all fibres are {FAMILIES[family]}: they {rules[family]}"
    return _TURNED + ("all leads leave at the near side: " if leads == "one side" else "") + fibres + "."


SCALE_MM = 10.0  # length of the scale bar, which verifies the size of a print
_TEXT_MM = 2.5  # maximum text height, by drawing standards; smaller for a narrow pitch
_GAP_MM = 1.0  # gap between the silicone and the text beside it
_LETTER_WIDTH = 0.6  # mean width of a letter, in text heights
_VIEW = "as it lies in the tray, seen from above"
_DESCRIPTION = (
    "True size, 1 unit = 1 mm. Seen from above as the pad lies in the tray, tracks down: the mould's ridges lie as"
    " drawn. {} Layers are in laying order, the deepest first."
)
_ACI = (5, 30)  # blue and orange of the AutoCAD Color Index, for readers without true colour


class _Label(NamedTuple):
    """A line of text, aligned to (x, y) mm by `anchor`: "start", "middle" or "end"."""

    text: str
    x: float
    y: float
    anchor: str
    colour: str


class _TrackSheet:
    """Layout of the drawing of the tracks, mm, y upwards."""

    def __init__(self, plan: Plan) -> None:
        layout, pairs = plan.pad.layout, plan.leads.pairs
        x_min, y_min, x_max, y_max = plan.silicone.bounds
        self.text_mm = min(_TEXT_MM, 0.6 * plan.min_pitch_mm)
        self.sentence = orientation_sentence(layout.counts, plan.settings.pad.leads)
        # Bezier control points of every fibre and its leads, each (n, 4, 2)
        self.spans = [
            np.concatenate([start.spans[::-1, ::-1], plan.pad.to_mm(curve), end.spans])
            for (start, end), curve in zip(pairs, beziers(plan.pad), strict=True)
        ]
        self.ends = np.array([[lead.point_past_edge(plan.settings.mould.exit_mm) for lead in pair] for pair in pairs])

        # Numbers lie outside the silicone, at the starts; with leads to one side, at both ends.
        self.numbers: list[_Label] = []
        for ends in self.ends.swapaxes(0, 1)[: 1 + (plan.settings.pad.leads == "one side")].tolist():
            for fibre, (x, y) in enumerate(ends):
                below = pairs[fibre][0].axis == 1
                position = (x, y - _GAP_MM - self.text_mm / 2) if below else (x - _GAP_MM, y)
                anchor, colour = "middle" if below else "end", FAMILY_COLOURS[plan.family(fibre)]
                self.numbers.append(_Label(str(fibre + 1), *position, anchor, colour))

        bar_y = y_min - 4 * _GAP_MM - self.text_mm
        ticks = [(x_min + fraction * SCALE_MM, bar_y + mm) for fraction, mm in ((0, 1.5), (0.5, 0.8), (1, 1.5))]
        bar = [((x_min, bar_y), (x_min + SCALE_MM, bar_y)), *(((x, bar_y), (x, y)) for x, y in ticks)]
        self.scale_bar = np.array(bar)
        # The notes are as wide as the silicone, or as the scale bar with the two texts beside it.
        width = max(x_max - x_min, SCALE_MM + _GAP_MM + (5 + _LETTER_WIDTH * len(_VIEW)) * self.text_mm)
        lines, line_mm = textwrap.wrap(self.sentence, int(width / (_LETTER_WIDTH * self.text_mm))), 1.4 * self.text_mm
        x, y, first_y = x_min + SCALE_MM + _GAP_MM, bar_y + self.text_mm / 4, bar_y - _GAP_MM - line_mm / 2
        texts = [(f"{SCALE_MM:g} mm", x, y), (_VIEW, x + 5 * self.text_mm, y)]
        texts += [(line, x_min, first_y - row * line_mm) for row, line in enumerate(lines)]
        self.notes = [_Label(*text, "start", _NOTE) for text in texts]

        numbers_mm = 2 * _GAP_MM + len(str(layout.fibres)) * self.text_mm
        y_low = bar_y - 3 * _GAP_MM - len(lines) * line_mm
        self.frame: Bounds = (x_min - numbers_mm, y_low, x_min + width + 2 * _GAP_MM, y_max + 2 * _GAP_MM)


def _number(value: float) -> str:
    return f"{round(float(value), 4) + 0.0:.10g}"  # + 0.0 turns -0.0 into 0.0


def _pair(point: Sequence[float] | Array) -> str:
    """Return the coordinates of a point, y upwards, in SVG, where y points downwards."""
    return f"{_number(point[0])},{_number(-point[1])}"


def _path(points: Sequence[Array] | Array) -> str:
    """Return the path data of a polyline through points (n, 2)."""
    return "M" + "L".join(map(_pair, points))


def tracks_svg(plan: Plan) -> str:
    """Return an SVG of the fibres at true size, every PCHIP span as one cubic Bezier segment.

    Every depth is a layer, and every fibre a path with its leads, from edge to edge of the silicone. Further layers
    contain that edge, the sensor numbers beside the starts, and a scale bar.
    """
    sheet = _TrackSheet(plan)
    x_min, y_min, x_max, y_max = sheet.frame
    size = [_number(side) for side in (x_max - x_min, y_max - y_min)]
    frame = {"width": f"{size[0]}mm", "height": f"{size[1]}mm"}
    frame["viewBox"] = f"{_number(x_min)} {_number(-y_max)} {' '.join(size)}"
    style = {"fill": "none", "font-family": "sans-serif", "font-size": _number(sheet.text_mm)}
    root = Element("svg", _NAMESPACES | frame | style)
    SubElement(root, "title").text = f"Fibre tracks of a pad, {_VIEW}"
    SubElement(root, "desc").text = _DESCRIPTION.format(sheet.sentence)

    def add_layer(name: str, label: str, labels: Sequence[_Label] = (), **style: str) -> Element:
        names = {"id": name, "inkscape:groupmode": "layer", "inkscape:label": label}
        layer = SubElement(root, "g", names | {key.replace("_", "-"): value for key, value in style.items()})
        for text in labels:
            position = {"x": _number(text.x), "y": _number(-text.y), "dy": "0.35em"}  # centred in every viewer
            attributes = position | {"text-anchor": text.anchor, "fill": text.colour}
            SubElement(layer, "text", attributes).text = text.text
        return layer

    edge = "".join(f"{_path(ring)}Z" for polygon in polygon_rings(plan.silicone) for ring in polygon)
    silicone = add_layer("silicone", "silicone's edge", stroke="#888", stroke_width="0.2")
    SubElement(silicone, "path", {"id": "edge", "d": edge})
    for depth in fibre_layers(plan):
        width = f"{plan.settings.fibre.material.diameter_mm:g}"
        label = f"{FAMILIES[depth.family]}, {depth.depth_mm:g} mm deep"
        layer = add_layer(depth.name, label, stroke=depth.colour, stroke_width=width)
        for fibre in depth.fibres:
            start, end = map(_pair, sheet.ends[fibre])
            spans = [list(map(_pair, span)) for span in sheet.spans[fibre]]
            curves = "".join(f"C{' '.join(span[1:])}" for span in spans)
            name = plan.pad.layout.fibre_name(fibre).replace(" ", "-")
            SubElement(layer, "path", {"id": name, "d": f"M{start}L{spans[0][0]}{curves}L{end}"})
    add_layer("numbers", "sensor numbers", sheet.numbers)
    scale = add_layer("scale", f"scale bar, {SCALE_MM:g} mm", sheet.notes)
    bar = {"d": "".join(map(_path, sheet.scale_bar)), "stroke": _NOTE, "stroke-width": "0.2"}
    scale.insert(0, Element("path", bar))
    indent(root, "")
    return tostring(root, "unicode") + "\n"


def tracks_dxf(plan: Plan) -> str:
    """Return a DXF R2010 of the fibres, mm, every fibre as one cubic spline whose spans are the PCHIP's.

    Layers are those of the SVG. The same plan gives the same bytes.
    """
    import ezdxf
    from ezdxf.colors import RGB
    from ezdxf.enums import TextEntityAlignment as Alignment

    anchors = {"start": Alignment.MIDDLE_LEFT, "middle": Alignment.MIDDLE_CENTER, "end": Alignment.MIDDLE_RIGHT}
    sheet, stream = _TrackSheet(plan), io.StringIO()
    with ExitStack() as stack:  # excludes the time and random ids from the file
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
                # Knots at distances of 1, whatever the length of spans: some readers merge close knots.
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
        for kind in sorted(document.entitydb.dxf_types_in_use()):  # the order of the set varies
            document.classes.add_class(kind)
        document.write(stream)
    return stream.getvalue()


def _spline_points(sheet: _TrackSheet, fibre: int) -> Array:
    """Return the control points (3 n + 1, 2) of a fibre's n spans, with straight ones to the silicone's edge."""
    spans, (start, end) = sheet.spans[fibre], sheet.ends[fibre]
    points = np.vstack([spans[0, :1], *spans[:, 1:]])
    if (start == points[0]).all():
        return points
    thirds = np.arange(3)[:, None] / 3
    return np.vstack([start + thirds * (points[0] - start), points, end + thirds[::-1] * (points[-1] - end)])
