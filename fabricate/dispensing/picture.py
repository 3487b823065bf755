"""The ways of the needle as a drawing of true size, 1 unit = 1 mm, as whoever stands before the machine sees them."""

from collections.abc import Iterator, Sequence

import numpy as np

from padforge.design.common.plotting import ALARM, FAINT, INK
from padforge.design.morphology import Array
from padforge.fabricate.mould.plan import Plan, polygon_rings
from padforge.fabricate.report.fibre_layers import FAMILIES

from .course import Step, turned_over

_ROOM_MM = 6.0
"""Around the ways, for the numbers."""
_TEXT_MM, _LINE_MM = 2.5, 4.5
"""Height of writing, and from one line of the legend to the next."""
_LEAST_MM = 90.0
"""Width that the legend takes."""


def ways_svg(plan: Plan, steps: Sequence[Step]) -> str:
    """The pad turned over with every fibre as it is laid, the ways between them, and the order.

    A ring is where a fibre is fastened, beside it its number; a dot is where it is cut, beside it when its turn came.
    Dashed are the ways above the pad, red is the box, where it is near.
    """
    strokes = [stroke for step in steps for stroke in step.strokes]
    places = np.vstack([stroke.places_mm for stroke in strokes])
    (left, low), (right, high) = places.min(axis=0) - _ROOM_MM, places.max(axis=0) + _ROOM_MM
    right = max(right, left + _LEAST_MM)
    ends = np.stack([stroke.places_mm[[0, -1]] for stroke in strokes])
    legend = list(_legend(plan, steps))
    width, height = right - left, high - low + _LINE_MM * (len(legend) + 1)
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{_number(width)}mm" height="{_number(height)}mm"'
            f' viewBox="{" ".join(map(_number, (left, -high, width, height)))}" fill="none"'
            f' font-family="sans-serif" font-size="{_TEXT_MM}">',
            "<title>The ways of the needle, from above: the pad turned over, tracks up</title>",
            f'<clipPath id="above-legend"><rect x="{_number(left)}" y="{_number(-high)}" width="{_number(width)}"'
            f' height="{_number(high - low)}"/></clipPath>',
            *_ground(plan),
            *_travels(ends),
            *_laid(steps),
            *_marks(plan, ends, [stroke.fibre for stroke in strokes]),
            *(
                _text((left + 1, low - _LINE_MM * n), "start", text, colour)
                for n, (text, colour) in enumerate(legend, 1)
            ),
            "</svg>\n",
        ]
    )


def _ground(plan: Plan) -> Iterator[str]:
    """The silicone, and the box that the needle may not leave."""
    rings = [turned_over(ring) for polygon in polygon_rings(plan.silicone) for ring in polygon]
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
            yield f'<path id="fibre-{stroke.fibre + 1}" d="{_path(stroke.places_mm)}"/>'
        yield "</g>"


def _marks(plan: Plan, ends: Array, fibres: Sequence[int]) -> Iterator[str]:
    for turn, (fibre, (start, end)) in enumerate(zip(fibres, ends, strict=True), 1):
        off, beyond = (2.5 * turned_over(lead.outward) for lead in plan.leads.pairs[fibre])
        (x, y), (u, v) = start, end
        yield f'<circle cx="{_number(x)}" cy="{_number(-y)}" r="0.8" stroke="{INK}" stroke-width="0.2"/>'
        yield f'<circle cx="{_number(u)}" cy="{_number(-v)}" r="0.5" fill="{INK}"/>'
        yield _text(start + off, "middle", str(fibre + 1), INK)
        yield _text(end + beyond, "middle", f"{turn}.", INK)


def _legend(plan: Plan, steps: Sequence[Step]) -> Iterator[tuple[str, str]]:
    """Lines of text and their colours."""
    for number, step in enumerate(steps, 1):
        layer, z = step.layer, _number(step.strokes[0].z_mm)
        yield f"{number}. {FAMILIES[layer.family]}, {layer.depth_mm:.3g} mm deep, needle at z = {z} mm", layer.colour
    height = plan.settings.dispenser.travel_height_mm
    yield f"The pad lies turned over, tracks up, seen from above. Dashed: at z = {height:g} mm.", INK
    yield "Ring: number of the fibre, fasten it. Dot: its turn, cut it.", INK


def _path(places: Array) -> str:
    return "M" + "L".join(f"{_number(x)},{_number(-y)}" for x, y in places.tolist())


def _text(place: Array | tuple[float, float], anchor: str, text: str, colour: str) -> str:
    at = f'x="{_number(place[0])}" y="{_number(-place[1])}" dy="0.35em"'
    return f'<text {at} text-anchor="{anchor}" fill="{colour}">{text}</text>'


def _number(value: float) -> str:
    """To a micrometre; no -0."""
    return f"{round(float(value), 3) + 0.0:.10g}"
