"""Drawings of a mould: the tracks as exact curves, and the mould as a shaded height map."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from design.curves import beziers
from design.palette import FAINT, HORIZONTAL, PAPER, VERTICAL

from .findings import Finding
from .outlines import Plan, polygon_rings

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

FAMILIES = ("horizontal", "vertical")
_COLOURS = (HORIZONTAL, VERTICAL)
_PIXELS = 1000
"""Side of the height map, about what the page shows: 17 pixels a mm for the published pad."""


def tracks_svg(plan: Plan) -> str:
    """The fibres as an SVG of true size (1 user unit = 1 mm), seen as they lie in the tray.

    Every PCHIP span is one cubic Bezier segment, so nothing is approximated. Each family is a group, each fibre a
    path that begins and ends at the silicone's edge; the rectangle is that edge.
    """
    low, _, high, _ = plan.cavity.bounds
    side = high - low
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{side:.6g}mm" height="{side:.6g}mm" '
        f'viewBox="{low:.6g} {low:.6g} {side:.6g} {side:.6g}" fill="none" '
        f'stroke-width="{plan.settings.pad.fibre_diameter_mm:g}">',
        f'<rect id="silicone" x="{low:.6g}" y="{low:.6g}" width="{side:.6g}" height="{side:.6g}" stroke="#888"/>',
    ]
    spans = plan.pad.to_mm(beziers(plan.pad)) * (1, -1)  # y points down in SVG
    border = plan.settings.mould.border_mm
    for family, (name, colour) in enumerate(zip(FAMILIES, _COLOURS, strict=True)):
        lines.append(f'<g id="{name}" stroke="{colour}">')
        ahead = border * np.array([(1, 0), (0, -1)][family])
        for number, fibre in enumerate(spans[family * plan.pad.grid :][: plan.pad.grid], 1):
            curves = "".join(f"C{_pair(a)} {_pair(b)} {_pair(c)}" for _, a, b, c in fibre)
            start, end = f"M{_pair(fibre[0, 0] - ahead)}L{_pair(fibre[0, 0])}", f"L{_pair(fibre[-1, -1] + ahead)}"
            lines.append(f'<path id="{name}-{number}" d="{start}{curves}{end}"/>')
        lines.append("</g>")
    return "\n".join([*lines, "</svg>\n"])


def draw_mould(plan: Plan, findings: Sequence[Finding], path: Path) -> None:
    """Write the mould seen from above as PNG: colour tells the height, shade the slope, rings what failed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgb
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    names = ("tray floor", *(f"{name} ridges" for name in FAMILIES), "tray wall")
    colours = (PAPER, *_COLOURS, FAINT)
    heights = (0.0, *plan.settings.ridge_heights_mm, plan.settings.mould.silicone_mm)
    zones = _zones(plan)
    shaded = _lit(np.array([to_rgb(colour) for colour in colours])[zones], np.array(heights)[zones])
    half = plan.tray.bounds[2]

    figure = Figure(figsize=(7.5, 8.2), dpi=140, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.imshow(shaded, extent=(-half, half, -half, half), interpolation="antialiased")
    legend: list[object] = [
        Patch(facecolor=colour, edgecolor="#555", label=f"{name}, {height:g} mm")
        for name, colour, height in zip(names, colours, heights, strict=True)
    ]
    places = np.array([place for finding in findings if finding.status == "fail" for place in finding.places_mm])
    if len(places):
        label = f"{len(places)} places that fail"
        legend += axes.plot(*places.T, "o", mfc="none", mec="#c4001a", ms=9, mew=1.3, label=label)
    depth = plan.settings.mould.floor_mm + plan.settings.mould.silicone_mm
    axes.set(title=f"Mould from above, {2 * half:g} x {2 * half:g} x {depth:g} mm", xlabel="x (mm)", ylabel="y (mm)")
    figure.legend(handles=legend, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, metadata={"Software": None})


def _zones(plan: Plan) -> np.ndarray:
    """(_PIXELS, _PIXELS) what each pixel shows: 0 floor, 1 horizontal ridge, 2 vertical ridge, 3 wall; top first."""
    zone = np.full((_PIXELS, _PIXELS), 3)
    cavity = _mask(plan, plan.cavity)
    zone[cavity] = 0
    for family in np.argsort(plan.settings.ridge_heights_mm):  # the taller one shows where they cross
        zone[cavity & _mask(plan, plan.ridges[family])] = 1 + family
    return zone


def _mask(plan: Plan, area: "BaseGeometry") -> np.ndarray:
    """(_PIXELS, _PIXELS) bool: whether the pixel's centre lies in `area`."""
    from PIL import Image, ImageDraw

    image = Image.new("1", (_PIXELS, _PIXELS))
    pen = ImageDraw.Draw(image)
    low, _, high, _ = plan.tray.bounds
    polygons = sorted(polygon_rings(area), key=lambda rings: -np.ptp(rings[0], axis=0).prod())  # islands after lakes
    for rings in polygons:
        for hole, ring in enumerate(rings):
            pixels = (ring - low) / (high - low) * _PIXELS - 0.5
            pixels[:, 1] = _PIXELS - 1 - pixels[:, 1]
            pen.polygon([tuple(pixel) for pixel in pixels], fill=not hole)
    return np.array(image, dtype=bool)


def _lit(colours: np.ndarray, heights_mm: np.ndarray) -> np.ndarray:
    """(n, n, 3) colours with light from the upper left falling on heights (n, n); flat places keep theirs."""
    from scipy.ndimage import uniform_filter

    eased: np.ndarray = uniform_filter(uniform_filter(heights_mm, 3, mode="nearest"), 3, mode="nearest")
    slope = np.clip(2 * np.add(*np.gradient(eased)), -1, 1)
    lit = colours.copy()
    bright, dark = slope > 0, slope < 0
    lit[bright] += 0.6 * slope[bright, None] * (1 - lit[bright])
    lit[dark] *= 1 + 0.45 * slope[dark, None]
    return lit


def _pair(place: np.ndarray) -> str:
    return f"{place[0]:.6g},{place[1]:.6g}"
