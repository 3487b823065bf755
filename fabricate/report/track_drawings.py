"""The tracks as drawings of true size, with nothing approximated: SVG and DXF, 1 unit = 1 mm.

Both show the pad as it lies in the tray, tracks down, seen from above, and say which way round it is laid and used.
"""

# pyright: reportPrivateImportUsage=false
# ezdxf does not mark what its own manual imports as exported.

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

import numpy as np

from padforge.design.morphology import Array
from padforge.fabricate.mould.plan import Plan, polygon_rings

from .fibre_layers import FAMILIES, fibre_name, layers
from .track_sheet import NOTE, SCALE_MM, Point, TrackSheet, Writing

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.layouts import Modelspace

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
    for layer in layers(sheet.plan):
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

    for layer in layers(sheet.plan):
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
