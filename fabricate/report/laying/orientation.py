"""Which way round: the sentence that all pages have of it, and a drawing of the pad in mould, hand and rig.

Beside the places of the plan there are no others: whoever looks at the tracks sees its x axis run to the left.
"""

import math
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import FAINT, INK, PAPER
from padforge.design.morphology import Array
from padforge.fabricate.mould.plan import Plan, polygon_rings
from padforge.fabricate.report.fibre_layers import COLOURS, FAMILIES, layers

FILE = "orientation.svg"
_TURNED = (
    "The casting is turned over, left to right, and stays so: the face with the tracks and their numbers lies up, to be"
    " laid and then to be pressed; y runs as in the mould and x the other way (mirrored = true in [rig]); "
)
_COUNTED = ("count from near to far and start", "count from right to left and start")
_STARTS = {
    "edges": ("on the right", "at the near side"),
    "one side": ("right of the pad, the first next to it", "within its width"),
}
CAPTION = "The pad in its mould, turned over, and in use, from above and from the near side."
LINK = f"![{CAPTION}]({FILE})"
"""The drawing on a page that lies beside it."""


def sentence(counts: tuple[int, int], leads: str) -> str:
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
_TITLE_MM, _TEXT_MM, _LINE_MM = 3.2, 2.6, 4.0
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
    said = sentence(plan.pad.layout.counts, plan.settings.pad.leads)
    lines = textwrap.wrap(said, _LETTERS)
    side_y = _ABOVE_MM + _TALL_MM + 6
    text_y = side_y + _SLAB_MM + 2 * _LINE_MM + 2
    width, height = 3 * _WIDE_MM, text_y + (len(lines) - 0.5) * _LINE_MM
    xlink = 'xmlns:xlink="http://www.w3.org/1999/xlink"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {xlink} width="{_mm(width)}mm" height="{_mm(height)}mm"'
            f' viewBox="0 0 {_mm(width)} {_mm(height)}" fill="none" font-family="sans-serif" font-size="{_TEXT_MM}">',
            f"<title>{CAPTION}</title>",
            f"<desc>{escape(said)}</desc>",
            f'<rect width="{_mm(width)}" height="{_mm(height)}" fill="white"/>',
            f'<defs><g id="pad">{"".join(_pad(plan, scale))}</g></defs>',
            *_above(plan, "mould", tray, plan.tray),
            *_above(plan, "turned", over, plan.silicone),
            *_above(plan, "used", used, plan.silicone),
            *_arm(used),
            *_sides(plan, (tray, over, used), side_y),
            *_titles(),
            *(_text(line, 4, text_y + row * _LINE_MM, "start") for row, line in enumerate(lines)),
            "</svg>\n",
        ]
    )


def _pad(plan: Plan, scale: float) -> Iterator[str]:
    """The silicone's edge, the tracks and the numbers cast in, mm of the plan, y downwards, to be drawn so large."""
    yield f'<path d="{_rings(plan.silicone)}" fill="{PAPER}" stroke="#888" stroke-width="{_mm(0.2 / scale)}"/>'
    width = _mm(0.35 / scale)
    for layer in layers(plan):
        for fibre in layer.fibres:
            points = shapely.get_coordinates(plan.lines[fibre].simplify(0.05)) * (1, -1)
            path = " ".join(f"{_mm(x)},{_mm(y)}" for x, y in points.tolist())
            yield f'<polyline points="{path}" stroke="{layer.colour}" stroke-width="{width}"/>'
    for fibre, number in enumerate(plan.numbers):
        if number is not None:
            yield f'<path class="cast" d="{_rings(number)}" fill="{COLOURS[plan.family(fibre)]}"/>'


def _above(plan: Plan, name: str, panel: _Panel, shown: BaseGeometry) -> Iterator[str]:
    """The pad in a panel with its axes, and the number of each fibre beside its start, beyond what is shown."""
    yield f'<g id="{name}">'
    if not panel.mirrored:
        yield f'<path d="{_rings(plan.tray)}" fill="{FAINT}" transform="{panel.transform}"/>'
    yield f'<use xlink:href="#pad" transform="{panel.transform}"/>'
    size = min(_TEXT_MM, 0.6 * plan.least_pitch_mm * panel.scale)
    for fibre, lead in enumerate(plan.ends(0)):
        start = lead.turned_mm.copy()
        start[lead.axis] = -((_BESIDE_MM + size / 2) / panel.scale - shown.bounds[lead.axis])
        colour = COLOURS[plan.family(fibre)]
        yield _text(str(fibre + 1), *panel.at(start[None])[0], colour=colour, size=size, bold=True)
    reach = 0.45 * math.sqrt(math.prod(plan.cavity.bounds[2:]))
    for axis, tip in zip("xy", np.eye(2) * reach, strict=True):
        start, end, beyond = panel.at(np.array([0 * tip, tip, 1.2 * tip]))
        yield _arrow(start, end)
        yield _text(axis, *beyond, halo=True)
    yield "</g>"


def _arm(panel: _Panel) -> Iterator[str]:
    """The axes of the arm's base, beside the pad in use and through its middle, and the angle between."""
    corner = np.array([panel.x - _WIDE_MM / 2 + 4, panel.y + _TALL_MM / 2 - 2])
    yield '<g id="arm">'
    for axis, way in zip("xy", ((9.0, 0.0), (0.0, -9.0)), strict=True):
        yield _arrow(corner, corner + way)
        yield _text(axis, *(corner + 1.2 * np.array(way)))
    yield _text("arm", corner[0] + 2, corner[1] - 2.5, "start")
    up = panel.y - 1.25 * _HALF_MM
    parallel = f"M{_mm(panel.x)},{_mm(panel.y)}V{_mm(up)}"
    yield f'<path d="{parallel}" stroke="{INK}" stroke-width="0.25" stroke-dasharray="1 1"/>'
    yield _text("pad_angle_deg", panel.x + 1, up, "start")
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
    size = min(_TEXT_MM, 0.6 * plan.least_pitch_mm * tray.scale)
    for panel, y, fill in ((tray, low - _TRACK_MM, FAINT), (over, top, "white"), (used, top, "")):
        for fibre, x_mm in starts:
            x = panel.x + (-x_mm if panel.mirrored else x_mm) * panel.scale
            colour = COLOURS[plan.family(fibre)]
            yield _box(x - 0.4, y, 0.8, _TRACK_MM, fill or colour)
            yield _text(str(fibre + 1), x, floor + size, colour=colour, size=size)
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
        yield _text(title, x, 4, "start", size=_TITLE_MM, bold=True)
        yield _text(what, x, 4 + _LINE_MM, "start")


def _text(
    text: str,
    x: float,
    y: float,
    anchor: str = "middle",
    *,
    colour: str = INK,
    size: float = _TEXT_MM,
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
