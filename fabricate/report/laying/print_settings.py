"""How to print a mould: what to set in the common slicers, by the names it has there, and why.

The names are those of PrusaSlicer 2.9, OrcaSlicer 2.3, Bambu Studio 2 and Cura 5.
"""

import math
from collections.abc import Iterator

from padforge.fabricate.settings import MouldSettings, PrinterSettings

HEAD = ("PrusaSlicer", "OrcaSlicer, Bambu Studio", "Cura", "because")
_SOLID_MM = 0.8
"""Of so much plastic above it, infill does not show."""
_MOST_WALLS = 4
_LEAST_LINE = 0.85
"""Width of a line at least, in nozzles."""


def rows(mould: MouldSettings, printer: PrinterSettings) -> Iterator[tuple[str, ...]]:
    """What to set for a printer of filament: rows below `HEAD`."""
    layer, first = f"{printer.layer_mm:g} mm", f"{_first_layer_mm(mould, printer):g} mm"
    width, lines = _line(mould, printer)
    line = f"{width:.3g} mm"
    walls = min(_MOST_WALLS, max(2, math.ceil(mould.wall_mm / 2 / width - 1e-6)))
    solid = math.ceil(_SOLID_MM / printer.layer_mm - 1e-6)
    ridge = f"a ridge {mould.ridge_width_mm:g} mm wide is {'one line' if lines == 1 else f'{lines} lines'}"
    if mould.ridge_width_mm < printer.nozzle_mm - 1e-9:
        ridge = f"a ridge {mould.ridge_width_mm:g} mm wide is narrower than the nozzle: see the checks"
    yield (
        f"Layer height: {layer}",
        f"Layer height: {layer}",
        f"Layer Height: {layer}",
        "floor and ridges are checked to be so many of these",
    )
    yield (
        f"First layer height: {first}",
        f"First (Initial) layer height: {first}",
        f"Initial Layer Height: {first}",
        f"whole layers are left of the floor, {mould.floor_mm:g} mm, so that ridges begin with one",
    )
    yield (
        f"Extrusion width, External perimeters: {line}",
        f"Line width, Outer wall: {line}",
        f"Outer Wall Line Width: {line}",
        ridge,
    )
    yield (
        "Perimeter generator: Arachne",
        "Wall generator: Arachne",
        "(no other)",
        "its lines are as wide as the ridge; Classic drops what is narrower than its line",
    )
    yield (
        "Classic only: Detect thin walls on, Fill gaps off",
        "Classic only: Detect thin wall on; in OrcaSlicer Apply gap fill: Nowhere",
        "Print Thin Walls: on",
        "a thin ridge is drawn in one go, not left out or dabbed together",
    )
    yield (
        f"Perimeters: {walls}",
        f"Wall loops: {walls}",
        f"Wall Line Count: {walls}",
        "the walls are tight, and do not give as the casting is pulled out",
    )
    yield (
        f"Solid layers, Top: {solid}; Top fill pattern: Monotonic; Fill density: 20 %",
        f"Top shell layers: {solid}; Top surface pattern: Monotonic; Sparse infill density: 20 %",
        f"Top Layers: {solid}; Monotonic Top/Bottom Order: on; Infill Density: 20 %",
        "the pad takes on the face of the floor: even, without a print of the infill",
    )
    yield from _FIXED
    yield (
        "Elephant foot compensation: 0.1 to 0.2 mm",
        "Elephant foot compensation: 0.1 to 0.2 mm",
        "Initial Layer Horizontal Expansion: -0.1 to -0.2 mm",
        ("the holes of the lid stay open" if mould.lid else "the mould stands flat") + "; no ridge is in that layer",
    )


def for_resin(mould: MouldSettings, printer: PrinterSettings) -> Iterator[str]:
    """What to set for a printer of resin: items of a list."""
    ridge, pixels = mould.ridge_width_mm, mould.ridge_width_mm / printer.nozzle_mm
    yield (
        f"- Slice it in layers of {printer.layer_mm:g} mm, flat on the plate: tilted, the floor comes out in steps, and"
        " the pad takes on its face."
    )
    yield (
        "- Turn anti-aliasing, blur and compensation of sizes off. A ridge is"
        f" {pixels:.3g} pixel{'s' * (pixels != 1)} wide: grey ones make its sides soft, and what is added on either"
        " side narrows the silicone between two."
    )
    yield (
        f"- Let the bottom layers, which are exposed longer and grow sideways, end below the ridges: the floor is"
        f" {mould.floor_mm:g} mm, {mould.floor_mm / printer.layer_mm:.3g} layers."
    )
    yield f"- Find the exposure by a trial: a wall that is {ridge:g} mm wide in the file must be so on the plate."


_FIXED = (
    (
        "Generate support material: off",
        "Enable support: off",
        "Generate Support: off",
        "no face needs them, and what is left of them shows in the pad",
    ),
    (
        "Brim type: Outer brim only; Brim width: 5 mm",
        "Brim type: Outer brim only; Brim width: 5 mm",
        "Build Plate Adhesion Type: Brim; Brim Location: Outside Only",
        "a floor whose corners lift makes a warped pad, and a brim outside touches nothing that is cast",
    ),
    (
        "Seam position: Aligned",
        "Seam position: Aligned",
        "Z Seam Alignment: Sharpest Corner",
        "at random, its lumps would narrow tracks everywhere",
    ),
    (
        "XY Size Compensation: 0",
        "X-Y contour compensation and X-Y hole compensation: 0",
        "Horizontal Expansion: 0",
        "it would be added to both sides of every ridge",
    ),
)


def _first_layer_mm(mould: MouldSettings, printer: PrinterSettings) -> float:
    """What leaves whole layers of the floor: half a nozzle at most, or else a layer and a half."""
    layers = mould.floor_mm / printer.layer_mm
    part = max(0.0, layers - math.floor(layers + 1e-6))
    most = min(max(1.5, printer.nozzle_mm / 2 / printer.layer_mm), layers)
    return round((part + math.floor(most - part + 1e-6)) * printer.layer_mm, 6)


def _line(mould: MouldSettings, printer: PrinterSettings) -> tuple[float, int]:
    """Width of a line, mm, and how many make a ridge."""
    lines = max(1, int(mould.ridge_width_mm / (_LEAST_LINE * printer.nozzle_mm) + 1e-6))
    return max(mould.ridge_width_mm / lines, _LEAST_LINE * printer.nozzle_mm), lines
