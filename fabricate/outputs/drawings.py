"""The ways of the needle as a drawing of true size, 1 unit = 1 mm, as whoever stands before the machine sees them."""

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import ALARM, FAINT, INK, PAPER
from padforge.design.morphology import Array
from padforge.design.paths.curves import beziers
from padforge.fabricate.fibre_placement.toolpath import Step, mirror_x
from padforge.fabricate.plan import FAMILIES, FAMILY_COLOURS, Plan, fibre_layers, fibre_name, polygon_rings

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.layouts import Modelspace

ORIENTATION_FILE = "orientation.svg"
_TURNED = (
    "The casting is turned over, left to right, and stays so: the face with the tracks and their numbers lies up, to be"
    " laid and then to be pressed; y runs as in the mould and x the other way (mirrored = true in [rig]); "
)
_COUNTED = ("count from near to far and start", "count from right to left and start")
_STARTS = {
    "edges": ("on the right", "at the near side"),
    "one side": ("right of the pad, the first next to it", "within its width"),
}
ORIENTATION_CAPTION = "The pad in its mould, turned over, and in use, from above and from the near side."
ORIENTATION_LINK = f"![{ORIENTATION_CAPTION}]({ORIENTATION_FILE})"
"""The drawing on a page that lies beside it."""


def orientation_sentence(counts: tuple[int, int], leads: str) -> str:
    """Which way round a pad of (H, V) fibres lies, whose leads are those of `[pad] leads`."""
    ways = [f"{way} {start}" for way, start in zip(_COUNTED, _STARTS[leads], strict=True)]
    fibres = f"horizontal fibres {ways[0]}, vertical ones {ways[1]}"
    if 0 in counts:
        family = int(counts[0] == 0)
        fibres = f"all fibres are {FAMILIES[family]}: they {ways[family]}"
    return _TURNED + ("all leads leave at the near side: " if leads == "one side" else "") + fibres + "."


TURN_DEG = 20.0
"""By which the pad in use is turned under the arm: as an example."""
_WIDE_MM, _TALL_MM, _HALF_MM = 64.0, 56.0, 21.0
"""Width and height of a panel, and half the side of the mould in it."""
_PANELS = (
    ("1  In the mould", "tracks down, numbers mirrored"),
    ("2  Turned over, left to right", "tracks up, numbers read right: lay here"),
    ("3  In use", "tracks up: this face is pressed"),
)
_TITLE_MM, _LABEL_MM, _LABEL_LINE_MM = 3.2, 2.6, 4.0
_ABOVE_MM, _BESIDE_MM = 11.0, 1.2
"""Room for a panel's title, and between an edge and the number beside it."""
_SLAB_MM, _TRACK_MM, _FLOOR_MM, _WALL_MM = 6.0, 1.6, 1.5, 2.0
"""In the views from the side, whose heights are of no scale: pad, track, and floor and wall of the mould."""
_LETTERS = 135
"""In a line of the sentence, at most."""


@dataclass(frozen=True)
class _Panel:
    """A way for the pad to lie on the drawing, seen from above.

    Attributes:
        x, y: of the pad's middle on the drawing, mm. scale: of the plan. mirrored, turn_deg: as the pad lies.
    """

    x: float
    y: float
    scale: float
    mirrored: bool = False
    turn_deg: float = 0.0

    @property
    def transform(self) -> str:
        """What takes the plan, y downwards as SVG has it, to its place."""
        across = -self.scale if self.mirrored else self.scale
        return (
            f"translate({_mm(self.x)} {_mm(self.y)}) rotate({_mm(-self.turn_deg)}) scale({across:.5g} {self.scale:.5g})"
        )

    def at(self, places: Array) -> Array:
        """(n, 2) places on the drawing of (n, 2) mm on the plan."""
        cos, sin = np.cos(np.radians(self.turn_deg)), np.sin(np.radians(self.turn_deg))
        lying = self.scale * np.asarray(places) * [-1 if self.mirrored else 1, 1]
        return (self.x, self.y) + lying @ np.array([[cos, -sin], [-sin, -cos]])


def orientation_svg(plan: Plan) -> str:
    """The pad from above and from the near side: in the mould, turned over, and in use under an arm; 1 unit = 1 mm."""
    scale, middle = _HALF_MM / np.abs(plan.tray.bounds).max(), _ABOVE_MM + _TALL_MM / 2
    tray, over, used = (
        _Panel((number + 0.5) * _WIDE_MM, middle, scale, mirrored, turn_deg)
        for number, (mirrored, turn_deg) in enumerate(((False, 0.0), (True, 0.0), (True, TURN_DEG)))
    )
    said = orientation_sentence(plan.pad.layout.counts, plan.settings.pad.leads)
    lines = textwrap.wrap(said, _LETTERS)
    side_y = _ABOVE_MM + _TALL_MM + 6
    text_y = side_y + _SLAB_MM + 2 * _LABEL_LINE_MM + 2
    width, height = 3 * _WIDE_MM, text_y + (len(lines) - 0.5) * _LABEL_LINE_MM
    xlink = 'xmlns:xlink="http://www.w3.org/1999/xlink"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {xlink} width="{_mm(width)}mm" height="{_mm(height)}mm"'
            f' viewBox="0 0 {_mm(width)} {_mm(height)}" fill="none" font-family="sans-serif" font-size="{_LABEL_MM}">',
            f"<title>{ORIENTATION_CAPTION}</title>",
            f"<desc>{escape(said)}</desc>",
            f'<rect width="{_mm(width)}" height="{_mm(height)}" fill="white"/>',
            f'<defs><g id="pad">{"".join(_pad(plan, scale))}</g></defs>',
            *_above(plan, "mould", tray, plan.tray),
            *_above(plan, "turned", over, plan.silicone),
            *_above(plan, "used", used, plan.silicone),
            *_arm(used),
            *_sides(plan, (tray, over, used), side_y),
            *_titles(),
            *(_orientation_text(line, 4, text_y + row * _LABEL_LINE_MM, "start") for row, line in enumerate(lines)),
            "</svg>\n",
        ]
    )


def _pad(plan: Plan, scale: float) -> Iterator[str]:
    """The silicone's edge, the tracks and the numbers cast in, mm of the plan, y downwards, to be drawn so large."""
    yield f'<path d="{_rings(plan.silicone)}" fill="{PAPER}" stroke="#888" stroke-width="{_mm(0.2 / scale)}"/>'
    width = _mm(0.35 / scale)
    for layer in fibre_layers(plan):
        for fibre in layer.fibres:
            points = shapely.get_coordinates(plan.lines[fibre].simplify(0.05)) * (1, -1)
            path = " ".join(f"{_mm(x)},{_mm(y)}" for x, y in points.tolist())
            yield f'<polyline points="{path}" stroke="{layer.colour}" stroke-width="{width}"/>'
    for fibre, number in enumerate(plan.numbers):
        if number is not None:
            yield f'<path class="cast" d="{_rings(number)}" fill="{FAMILY_COLOURS[plan.family(fibre)]}"/>'


def _above(plan: Plan, name: str, panel: _Panel, shown: BaseGeometry) -> Iterator[str]:
    """The pad in a panel with its axes, and the number of each fibre beside its start, beyond what is shown."""
    yield f'<g id="{name}">'
    if not panel.mirrored:
        yield f'<path d="{_rings(plan.tray)}" fill="{FAINT}" transform="{panel.transform}"/>'
    yield f'<use xlink:href="#pad" transform="{panel.transform}"/>'
    size = min(_LABEL_MM, 0.6 * plan.min_pitch_mm * panel.scale)
    for fibre, lead in enumerate(plan.ends(0)):
        start = lead.turned_mm.copy()
        start[lead.axis] = -((_BESIDE_MM + size / 2) / panel.scale - shown.bounds[lead.axis])
        colour = FAMILY_COLOURS[plan.family(fibre)]
        yield _orientation_text(str(fibre + 1), *panel.at(start[None])[0], colour=colour, size=size, bold=True)
    reach = 0.45 * math.sqrt(math.prod(plan.cavity.bounds[2:]))
    for axis, tip in zip("xy", np.eye(2) * reach, strict=True):
        start, end, beyond = panel.at(np.array([0 * tip, tip, 1.2 * tip]))
        yield _arrow(start, end)
        yield _orientation_text(axis, *beyond, halo=True)
    yield "</g>"


def _arm(panel: _Panel) -> Iterator[str]:
    """The axes of the arm's base, beside the pad in use and through its middle, and the angle between."""
    corner = np.array([panel.x - _WIDE_MM / 2 + 4, panel.y + _TALL_MM / 2 - 2])
    yield '<g id="arm">'
    for axis, way in zip("xy", ((9.0, 0.0), (0.0, -9.0)), strict=True):
        yield _arrow(corner, corner + way)
        yield _orientation_text(axis, *(corner + 1.2 * np.array(way)))
    yield _orientation_text("arm", corner[0] + 2, corner[1] - 2.5, "start")
    up = panel.y - 1.25 * _HALF_MM
    parallel = f"M{_mm(panel.x)},{_mm(panel.y)}V{_mm(up)}"
    yield f'<path d="{parallel}" stroke="{INK}" stroke-width="0.25" stroke-dasharray="1 1"/>'
    yield _orientation_text("pad_angle_deg", panel.x + 1, up, "start")
    yield "</g>"


def _sides(plan: Plan, panels: tuple[_Panel, _Panel, _Panel], top: float) -> Iterator[str]:
    """The three from the near side, cut where fibres start there; heights are of no scale."""
    tray, over, used = panels
    low, half = top + _SLAB_MM, plan.cavity.bounds[2] * tray.scale
    floor = low + _FLOOR_MM
    yield '<g id="sides">'
    yield _box(tray.x - half - _WALL_MM, top, 2 * (half + _WALL_MM), floor - top, FAINT)
    for panel in panels:
        yield _box(panel.x - half, top, 2 * half, _SLAB_MM, PAPER)
    starts = [(fibre, lead.turned_mm[0]) for fibre, lead in enumerate(plan.ends(0)) if lead.axis == 1]
    size = min(_LABEL_MM, 0.6 * plan.min_pitch_mm * tray.scale)
    for panel, y, fill in ((tray, low - _TRACK_MM, FAINT), (over, top, "white"), (used, top, "")):
        for fibre, x_mm in starts:
            x = panel.x + (-x_mm if panel.mirrored else x_mm) * panel.scale
            colour = FAMILY_COLOURS[plan.family(fibre)]
            yield _box(x - 0.4, y, 0.8, _TRACK_MM, fill or colour)
            yield _orientation_text(str(fibre + 1), x, floor + size, colour=colour, size=size)
    yield f'<path id="probe" d="M{_mm(used.x - 2)},{_mm(top - 7)}v4a2,2 0 0 0 4,0v-4z" fill="{INK}"/>'
    table = f"M{_mm(used.x - half - 6)},{_mm(low)}h{_mm(2 * half + 12)}"
    yield f'<path d="{table}" stroke="{INK}" stroke-width="0.4"/>'
    yield "</g>"


def _box(x: float, y: float, width: float, height: float, fill: str) -> str:
    size = f'width="{_mm(width)}" height="{_mm(height)}"'
    return f'<rect x="{_mm(x)}" y="{_mm(y)}" {size} fill="{fill}" stroke="#888" stroke-width="0.15"/>'


def _titles() -> Iterator[str]:
    for number, (title, what) in enumerate(_PANELS):
        x = number * _WIDE_MM + 4
        yield _orientation_text(title, x, 4, "start", size=_TITLE_MM, bold=True)
        yield _orientation_text(what, x, 4 + _LABEL_LINE_MM, "start")


def _orientation_text(
    text: str,
    x: float,
    y: float,
    anchor: str = "middle",
    *,
    colour: str = INK,
    size: float = _LABEL_MM,
    bold: bool = False,
    halo: bool = False,
) -> str:
    weight = ' font-weight="bold"' * bold + ' paint-order="stroke" stroke="white" stroke-width="0.8"' * halo
    place = f'x="{_mm(x)}" y="{_mm(y)}" dy="0.35em" font-size="{_mm(size)}"'
    return f'<text {place} text-anchor="{anchor}" fill="{colour}"{weight}>{escape(text)}</text>'


def _arrow(start: Array, end: Array) -> str:
    """An axis, with a white rim that keeps it off what it lies on."""
    along = (end - start) / np.hypot(*(end - start))
    across = along @ np.array([[0, 1], [-1, 0]])
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = start, end, end - 2 * along + across, end - 2 * along - across
    path = f"M{_mm(x0)},{_mm(y0)}L{_mm(x1)},{_mm(y1)}M{_mm(x2)},{_mm(y2)}L{_mm(x1)},{_mm(y1)}L{_mm(x3)},{_mm(y3)}"
    return f'<path d="{path}" stroke="white" stroke-width="1.2"/><path d="{path}" stroke="{INK}" stroke-width="0.5"/>'


def _rings(area: BaseGeometry) -> str:
    """The outline of an area as the data of a path, y downwards."""
    rings = [ring * (1, -1) for polygon in polygon_rings(area) for ring in polygon]
    return "".join(f"M{'L'.join(f'{_mm(x)},{_mm(y)}' for x, y in ring.tolist())}Z" for ring in rings)


def _mm(value: float) -> str:
    return f"{round(float(value), 2) + 0.0:g}"


Point = tuple[float, float]

SCALE_MM = 10.0
"""Length of the scale bar: whoever prints a drawing measures it."""
_TEXT_MM = 2.5
"""Height of writing, as drawing standards have it; less where the pitch is narrow."""
_ASIDE_MM = 1.0
"""Between the silicone and the writing beside it."""
NOTE = "as it lies in the tray, seen from above"
_LETTER_MM = 0.6
"""Width of a letter, at most and on average, for a height of 1."""


@dataclass(frozen=True)
class Writing:
    """Writing at (x, y) mm: `anchor` "end" ends there, "middle" has its middle there, "start" begins there."""

    text: str
    x: float
    y: float
    anchor: str
    colour: str


@dataclass(frozen=True)
class TrackSheet:
    """Where everything is on a drawing, mm, y upwards."""

    plan: Plan

    @cached_property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, low, right and high of the silicone."""
        return self.plan.silicone.bounds

    @cached_property
    def text_mm(self) -> float:
        """Height of the writing."""
        return min(_TEXT_MM, 0.6 * self.plan.min_pitch_mm)

    @cached_property
    def frame(self) -> tuple[float, float, float, float]:
        """Left, low, right and high of the drawing; the scale bar and the numbers lie outside of the silicone."""
        left, _, _, high = self.bounds
        digits = len(str(self.plan.pad.layout.fibres))
        left -= 2 * _ASIDE_MM + digits * self.text_mm
        low = self.scale_y - 3 * _ASIDE_MM - len(self.said) * self.line_mm
        return left, low, self.bounds[0] + self.room_mm + 2 * _ASIDE_MM, high + 2 * _ASIDE_MM

    @cached_property
    def spans(self) -> list[Array]:
        """Of every fibre (n, 4, 2) Bezier control points, those of the bends of its leads too."""
        return [
            np.concatenate([start.spans[::-1, ::-1], self.plan.pad.to_mm(curve), end.spans])
            for (start, end), curve in zip(self.plan.leads.pairs, beziers(self.plan.pad), strict=True)
        ]

    @cached_property
    def ends(self) -> Array:
        """(F, 2, 2) where every fibre enters and leaves the silicone."""
        past = self.plan.settings.mould.exit_mm
        return np.array([[lead.point_past_edge(past) for lead in pair] for pair in self.plan.leads.pairs])

    @cached_property
    def numbers(self) -> list[Writing]:
        """The number of every fibre, outside of the silicone where it starts, and where it ends if that is beside."""
        one_side = self.plan.settings.pad.leads == "one side"
        texts = []
        for fibre, (x, y) in [each for end in range(1 + one_side) for each in enumerate(self.ends[:, end].tolist())]:
            below = self.plan.leads.pairs[fibre][0].axis == 1
            place = (x, y - _ASIDE_MM - self.text_mm / 2) if below else (x - _ASIDE_MM, y)
            anchor, colour = "middle" if below else "end", FAMILY_COLOURS[self.plan.family(fibre)]
            texts.append(Writing(str(fibre + 1), *place, anchor, colour))
        return texts

    @cached_property
    def scale_y(self) -> float:
        """Height of the scale bar."""
        return self.bounds[1] - 4 * _ASIDE_MM - self.text_mm

    @cached_property
    def scale(self) -> list[tuple[Point, Point]]:
        """The strokes of the scale bar."""
        left, y = self.bounds[0], self.scale_y
        ticks = [(left + share * SCALE_MM, tick) for share, tick in ((0, 1.5), (0.5, 0.8), (1, 1.5))]
        return [((left, y), (left + SCALE_MM, y)), *(((x, y), (x, y + tick)) for x, tick in ticks)]

    @cached_property
    def line_mm(self) -> float:
        """From one line of writing to the next."""
        return 1.4 * self.text_mm

    @cached_property
    def room_mm(self) -> float:
        """For writing: as wide as the silicone, or as the scale bar with its two texts."""
        left, _, right, _ = self.bounds
        return max(right - left, SCALE_MM + _ASIDE_MM + (5 + _LETTER_MM * len(NOTE)) * self.text_mm)

    @property
    def sentence(self) -> str:
        """Which way round."""
        return orientation_sentence(self.plan.pad.layout.counts, self.plan.settings.pad.leads)

    @cached_property
    def said(self) -> list[str]:
        """Which way round, in lines as long as there is room for."""
        return textwrap.wrap(self.sentence, int(self.room_mm / (_LETTER_MM * self.text_mm)))

    @cached_property
    def notes(self) -> list[Writing]:
        """What is written beside the scale bar and below it."""
        left, x, y = self.bounds[0], self.bounds[0] + SCALE_MM + _ASIDE_MM, self.scale_y + self.text_mm / 4
        beside = [(f"{SCALE_MM:g} mm", x, y), (NOTE, x + 5 * self.text_mm, y)]
        first = self.scale_y - _ASIDE_MM - self.line_mm / 2
        below = [(line, left, first - row * self.line_mm) for row, line in enumerate(self.said)]
        return [Writing(*text, "start", "#555555") for text in (*beside, *below)]


# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its own manual imports as exported.


_DESCRIPTION = (
    "True size, 1 unit = 1 mm. Seen from above as the pad lies in the tray, tracks down: the mould's ridges lie as"
    " drawn. {} Layers are in laying order, the deepest first."
)
_ACI = (5, 30)
"""Blue and orange of the old CAD colour index, for readers that know no others."""


def tracks_svg(plan: Plan) -> str:
    """The fibres as an SVG of true size; every PCHIP span is one cubic Bezier segment.

    Each depth is a layer, each fibre a path that runs straight on from its ends through border and exit to the
    silicone's edge. Further layers hold that edge, the sensor numbers beside the starts, and a scale bar.
    """
    sheet = TrackSheet(plan)
    left, low, right, high = sheet.frame
    size = f"{_number(right - left)}mm", f"{_number(high - low)}mm"
    view = " ".join(map(_number, (left, -high, right - left, high - low)))
    return "\n".join(
        [
            '<svg xmlns="http://www.w3.org/2000/svg" xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape"',
            f' width="{size[0]}" height="{size[1]}" viewBox="{view}" fill="none">',
            f"<title>Fibre tracks of a pad, {NOTE}</title>",
            f"<desc>{_DESCRIPTION.format(sheet.sentence)}</desc>",
            *_svg_layer("silicone", "silicone's edge", 'stroke="#888" stroke-width="0.2"', _svg_silicone(plan)),
            *_svg_tracks(sheet),
            *_svg_layer("numbers", "sensor numbers", _svg_writing(sheet), map(_svg_text, sheet.numbers)),
            *_svg_layer("scale", f"scale bar, {SCALE_MM:g} mm", _svg_writing(sheet), _svg_scale(sheet)),
            "</svg>\n",
        ]
    )


def tracks_dxf(plan: Plan) -> str:
    """The fibres as a DXF R2010 in mm; every fibre is one cubic spline whose spans are the PCHIP's.

    Layers as in the SVG. The same plan gives the same bytes.
    """
    import ezdxf
    from ezdxf import units

    sheet = TrackSheet(plan)
    with _fixed_dates():
        document = ezdxf.new("R2010", units=units.MM)
        space = document.modelspace()
        _dxf_silicone(document, space, plan)
        _dxf_tracks(document, space, sheet)
        _dxf_writing(document, space, sheet)
        left, low, right, high = sheet.frame
        space.reset_extents((left, low, 0), (right, high, 0))
        document.set_modelspace_vport(height=high - low, center=((left + right) / 2, (low + high) / 2))
        for kind in sorted(document.entitydb.dxf_types_in_use()):  # else in the order of a set, which varies
            document.classes.add_class(kind)
        stream = io.StringIO()
        document.write(stream)
    return stream.getvalue()


def _svg_layer(name: str, label: str, style: str, content: Iterator[str]) -> list[str]:
    """A group that drawing programs show as a layer."""
    marks = f'id={quoteattr(name)} inkscape:groupmode="layer" inkscape:label={quoteattr(label)}'
    return [f"<g {marks} {style}>", *content, "</g>"]


def _svg_silicone(plan: Plan) -> Iterator[str]:
    rings = [f"M{'L'.join(map(_pair, ring))}Z" for polygon in polygon_rings(plan.silicone) for ring in polygon]
    yield f'<path id="edge" d="{"".join(rings)}"/>'


def _svg_tracks(sheet: TrackSheet) -> Iterator[str]:
    width = f'stroke-width="{sheet.plan.settings.fibre.material.diameter_mm:g}"'
    for layer in fibre_layers(sheet.plan):
        label = f"{FAMILIES[layer.family]}, {layer.depth_mm:g} mm deep"
        paths = (_svg_path(sheet, fibre) for fibre in layer.fibres)
        yield from _svg_layer(layer.name, label, f'stroke="{layer.colour}" {width}', paths)


def _svg_path(sheet: TrackSheet, fibre: int) -> str:
    spans, (start, end) = sheet.spans[fibre], sheet.ends[fibre]
    curves = "".join(f"C{_pair(a)} {_pair(b)} {_pair(c)}" for _, a, b, c in spans)
    name = fibre_name(sheet.plan, fibre).replace(" ", "-")
    return f'<path id="{name}" d="M{_pair(start)}L{_pair(spans[0, 0])}{curves}L{_pair(end)}"/>'


def _svg_scale(sheet: TrackSheet) -> Iterator[str]:
    strokes = "".join(f"M{_pair(start)}L{_pair(end)}" for start, end in sheet.scale)
    yield f'<path d="{strokes}" stroke="#555555" stroke-width="0.2"/>'
    yield from map(_svg_text, sheet.notes)


def _svg_writing(sheet: TrackSheet) -> str:
    return f'font-family="sans-serif" font-size="{_number(sheet.text_mm)}"'


def _svg_text(text: Writing) -> str:
    place = f'x="{_number(text.x)}" y="{_number(-text.y)}" dy="0.35em"'  # its middle, in every viewer
    return f'<text {place} text-anchor="{text.anchor}" fill="{text.colour}">{text.text}</text>'


def _dxf_silicone(document: "Drawing", space: "Modelspace", plan: Plan) -> None:
    document.layers.add("silicone", color=8)
    for ring in (ring for polygon in polygon_rings(plan.silicone) for ring in polygon):
        space.add_lwpolyline(np.round(ring, 6).tolist(), close=True, dxfattribs={"layer": "silicone"})


def _dxf_tracks(document: "Drawing", space: "Modelspace", sheet: TrackSheet) -> None:
    from ezdxf.colors import RGB

    for layer in fibre_layers(sheet.plan):
        document.layers.add(layer.name, color=_ACI[layer.family]).rgb = RGB.from_hex(layer.colour)
        for fibre in layer.fibres:
            points = _spline_points(sheet, fibre)
            spans = len(points) // 3
            # a step of 1 a span, however short it is: knots that nearly coincide are merged by some readers
            knots = [0, *np.repeat(np.arange(spans + 1), 3).tolist(), spans]
            space.add_open_spline(np.round(points, 6).tolist(), knots=knots, dxfattribs={"layer": layer.name})


def _spline_points(sheet: TrackSheet, fibre: int) -> Array:
    """(3 n + 1, 2) control points of a fibre's n spans, with the straight ones at its ends if there are any."""
    spans, (start, end) = sheet.spans[fibre], sheet.ends[fibre]
    points = np.vstack([spans[0, :1], *spans[:, 1:]])
    if (start == points[0]).all():
        return points
    thirds = np.arange(3)[:, None] / 3
    return np.vstack([start + thirds * (points[0] - start), points, end + thirds[::-1] * (points[-1] - end)])


def _dxf_writing(document: "Drawing", space: "Modelspace", sheet: TrackSheet) -> None:
    from ezdxf.enums import TextEntityAlignment as Alignment

    at = {"start": Alignment.MIDDLE_LEFT, "middle": Alignment.MIDDLE_CENTER, "end": Alignment.MIDDLE_RIGHT}
    for name, texts in (("numbers", sheet.numbers), ("scale", sheet.notes)):
        document.layers.add(name, color=7)
        for text in texts:
            attributes = {"layer": name, "height": 0.72 * sheet.text_mm}  # of capitals, as CAD has it
            space.add_text(text.text, dxfattribs=attributes).set_placement((text.x, text.y), align=at[text.anchor])
    for start, end in sheet.scale:
        space.add_line(start, end, dxfattribs={"layer": "scale"})


@contextmanager
def _fixed_dates() -> Iterator[None]:
    """Keep the time and random ids out of DXF files that are made and written inside."""
    import ezdxf

    before = ezdxf.options.write_fixed_meta_data_for_testing
    ezdxf.options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        ezdxf.options.write_fixed_meta_data_for_testing = before


def _pair(place: Array | Point) -> str:
    """A place as SVG has it, y downwards."""
    return f"{_number(place[0])},{_number(-place[1])}"


def _number(value: float) -> str:
    """To a tenth of a micrometre, far below any printer."""
    return f"{round(float(value), 4) + 0.0:.10g}"


_ROOM_MM = 6.0
"""Around the ways, for the numbers."""
_TOOLPATH_TEXT_MM, _TOOLPATH_LINE_MM = 2.5, 4.5
"""Height of writing, and from one line of the legend to the next."""
_LEAST_MM = 90.0
"""Width that the legend takes."""


def toolpath_svg(plan: Plan, steps: Sequence[Step]) -> str:
    """The pad turned over with every fibre as it is laid, the ways between them, and the order.

    A ring is where a fibre is fastened, beside it its number; a dot is where it is cut, beside it when its turn came.
    Dashed are the ways above the pad, red is the box, where it is near.
    """
    strokes = [stroke for step in steps for stroke in step.strokes]
    places = np.vstack([stroke.positions_mm for stroke in strokes])
    (left, low), (right, high) = places.min(axis=0) - _ROOM_MM, places.max(axis=0) + _ROOM_MM
    right = max(right, left + _LEAST_MM)
    ends = np.stack([stroke.positions_mm[[0, -1]] for stroke in strokes])
    legend = list(_legend(plan, steps))
    width, height = right - left, high - low + _TOOLPATH_LINE_MM * (len(legend) + 1)
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_um(width)}mm" height="{_um(height)}mm"'
            f' viewBox="{" ".join(map(_um, (left, -high, width, height)))}" fill="none"'
            f' font-family="sans-serif" font-size="{_TOOLPATH_TEXT_MM}">',
            "<title>The ways of the needle, from above: the pad turned over, tracks up</title>",
            f'<clipPath id="above-legend"><rect x="{_um(left)}" y="{_um(-high)}" width="{_um(width)}"'
            f' height="{_um(high - low)}"/></clipPath>',
            *_ground(plan),
            *_travels(ends),
            *_laid(steps),
            *_marks(plan, ends, [stroke.fibre for stroke in strokes]),
            *(
                _toolpath_text((left + 1, low - _TOOLPATH_LINE_MM * n), "start", text, colour)
                for n, (text, colour) in enumerate(legend, 1)
            ),
            "</svg>\n",
        ]
    )


def _ground(plan: Plan) -> Iterator[str]:
    """The silicone, and the box that the needle may not leave."""
    rings = [mirror_x(ring) for polygon in polygon_rings(plan.silicone) for ring in polygon]
    yield f'<path id="silicone" stroke="#888" stroke-width="0.2" d="{"".join(_path(ring) + "Z" for ring in rings)}"/>'
    (x0, x1, y0, y1), (x, y) = plan.settings.dispenser.box_mm[:4], plan.settings.dispenser.origin_mm
    corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]) - (x, y)
    clip = 'clip-path="url(#above-legend)"'
    yield f'<path id="box" stroke="{ALARM}" stroke-width="0.4" {clip} d="{_path(corners)}Z"/>'
    yield f'<path id="middle" stroke="{INK}" stroke-width="0.2" d="M-2,0L2,0M0,-2L0,2"/>'


def _travels(ends: Array) -> Iterator[str]:
    """From where each fibre (k, 2, 2) is cut to where the next is fastened."""
    ways = "".join(_path(np.stack([end, start])) for end, start in zip(ends[:-1, 1], ends[1:, 0], strict=True))
    yield f'<path id="travel" stroke="{FAINT}" stroke-width="0.2" stroke-dasharray="1 1" d="{ways}"/>'


def _laid(steps: Sequence[Step]) -> Iterator[str]:
    for step in steps:
        yield f'<g id="{step.layer.name}" stroke="{step.layer.colour}" stroke-width="0.3">'
        for stroke in step.strokes:
            yield f'<path id="fibre-{stroke.fibre + 1}" d="{_path(stroke.positions_mm)}"/>'
        yield "</g>"


def _marks(plan: Plan, ends: Array, fibres: Sequence[int]) -> Iterator[str]:
    for turn, (fibre, (start, end)) in enumerate(zip(fibres, ends, strict=True), 1):
        off, beyond = (2.5 * mirror_x(lead.outward) for lead in plan.leads.pairs[fibre])
        (x, y), (u, v) = start, end
        yield f'<circle cx="{_um(x)}" cy="{_um(-y)}" r="0.8" stroke="{INK}" stroke-width="0.2"/>'
        yield f'<circle cx="{_um(u)}" cy="{_um(-v)}" r="0.5" fill="{INK}"/>'
        yield _toolpath_text(start + off, "middle", str(fibre + 1), INK)
        yield _toolpath_text(end + beyond, "middle", f"{turn}.", INK)


def _legend(plan: Plan, steps: Sequence[Step]) -> Iterator[tuple[str, str]]:
    """Lines of text and their colours."""
    for number, step in enumerate(steps, 1):
        layer, z = step.layer, _um(step.strokes[0].z_mm)
        yield f"{number}. {FAMILIES[layer.family]}, {layer.depth_mm:.3g} mm deep, needle at z = {z} mm", layer.colour
    height = plan.settings.dispenser.travel_height_mm
    yield f"The pad lies turned over, tracks up, seen from above. Dashed: at z = {height:g} mm.", INK
    yield "Ring: number of the fibre, fasten it. Dot: its turn, cut it.", INK


def _path(places: Array) -> str:
    return "M" + "L".join(f"{_um(x)},{_um(-y)}" for x, y in places.tolist())


def _toolpath_text(place: Array | tuple[float, float], anchor: str, text: str, colour: str) -> str:
    at = f'x="{_um(place[0])}" y="{_um(-place[1])}" dy="0.35em"'
    return f'<text {at} text-anchor="{anchor}" fill="{colour}">{text}</text>'


def _um(value: float) -> str:
    """To a micrometre; no -0."""
    return f"{round(float(value), 3) + 0.0:.10g}"
