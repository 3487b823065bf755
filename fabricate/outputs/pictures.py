"""Pictures of a mould, of the tracks in its casting, and of any mesh with findings, from above, as PNG files.

The same input gives the same bytes; files are small, for some are kept in git.
"""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import ALARM, FAINT, INK, PAPER
from padforge.design.morphology import Array
from padforge.fabricate.checks import Finding
from padforge.fabricate.mould import mould_body
from padforge.fabricate.outputs.drawings import SCALE_MM, orientation_sentence
from padforge.fabricate.plan import (
    FAMILIES,
    FAMILY_COLOURS,
    INTO_WALL_MM,
    FibreLayer,
    Plan,
    fibre_layers,
    overlap,
    polygon_rings,
)

Ints = NDArray[np.intp]
Bounds = tuple[float, float, float, float]

FLOOR, WALL, NUMBER, RIDGE = 0, 1, 2, 3
"""Classes of pixels of a mould; `RIDGE` + layer index for the ridges of a layer."""
_MAX_PIXELS = 2_000_000
"""Pixels of triangles rasterized together: bounds memory at about 200 MB for meshes of any size."""
_ROUNDING = 1e-6
"""Pixels by which triangles are enlarged: no pixel between two neighbours is lost to rounding."""
_MIN_MM = 1e-6
"""Size of smaller meshes, and slope of steeper walls."""
_SHADES = 8
"""Shades on either side of flat: enough for the eye, and small files."""


def mould_relief(plan: Plan, width: int, height: int) -> tuple[Array, Ints]:
    """Rasterize a mould seen from above in pixels of its tray.

    Returns:
        Heights above the tray's floor, mm, and classes of pixels; shape (height, width).
    """
    mould, pixels = plan.settings.mould, (width, height)
    walls = _rasterize_walls(plan, pixels)
    walls[_rasterize_area(plan.pillars, plan.tray.bounds, pixels)] = plan.silicone_mm
    heights = walls.copy()
    for prism in mould_body(plan).adds:
        mask = _rasterize_area(prism.area, plan.tray.bounds, pixels)
        heights[mask] = np.maximum(heights[mask], prism.top_mm - mould.floor_mm)
    classes = np.where(walls > 0, WALL, FLOOR)
    raised = (heights > walls) & (heights <= plan.silicone_mm)
    classes[raised] = NUMBER
    for layer, height_mm in enumerate(plan.heights_mm):  # taller ridges come later and cover lower ones
        base = plan.outline(layer, height_mm) if plan.settings.ridge_slope else plan.ridges[layer]
        classes[raised & _rasterize_area(base, plan.tray.bounds, pixels)] = RIDGE + layer
    return heights, classes


def mesh_relief(vertices: Array, triangles: Ints, pixels: int) -> tuple[Array, Bounds]:
    """Rasterize the upper surface of any mesh, closed or not, in so many pixels along the longer side.

    Returns:
        Heights at the pixels' centres in the frame of the mesh, -inf beside it, and their x_min, y_min, x_max, y_max.
    """
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    scale = pixels / max(float((high - low).max()), _MIN_MM)
    columns, rows = np.maximum(2, np.ceil((high - low) * scale - _ROUNDING)).astype(int).tolist()  # 2 have a slope
    corners = np.column_stack([(vertices[:, :2] - low) * scale - 0.5, vertices[:, 2]])[triangles]
    heights = np.full(rows * columns, -np.inf)
    # Triangles that are visible from above, a bounded number of pixels at a time
    a, b = np.moveaxis(corners[:, 1:, :2] - corners[:, :1, :2], 1, 0)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    visible = area > 0
    cost = area + np.ptp(corners[..., 1], axis=1) + 1
    batch = np.cumsum(cost[visible]) // _MAX_PIXELS
    for part in np.split(corners[visible], np.flatnonzero(np.diff(batch)) + 1):
        row, column, height = _rasterize_triangles(part, rows, columns)
        np.maximum.at(heights, row * columns + column, height)
    x_max, y_max = (low + np.array([columns, rows]) / scale).tolist()
    return heights.reshape(rows, columns)[::-1], (float(low[0]), float(low[1]), x_max, y_max)


def _shade(colours: Array, heights_mm: Array) -> Array:
    """Shade colours (r, c, 3), 0 to 1, with light from the upper left on heights (r, c); flat areas keep theirs."""
    from scipy.ndimage import uniform_filter

    # The root sets low steps off from high ones, whose colour would be lost otherwise.
    eased = uniform_filter(np.sqrt(heights_mm - heights_mm.min(), dtype=np.float32), 3, mode="nearest")
    down, across = np.gradient(eased)
    slope = np.rint(_SHADES * np.clip(down + across, -1, 1)) / _SHADES
    sloping = slope != 0
    flat, tilt = colours[sloping], slope[sloping, None]
    shaded = colours.copy()
    shaded[sloping] = flat + np.where(tilt > 0, 0.6 * tilt * (1 - flat), 0.5 * tilt * flat)
    return shaded


def _rasterize_walls(plan: Plan, pixels: tuple[int, int]) -> Array:
    """Return the heights of the walls alone, which lean outwards from the outline of the floor."""
    low, high = np.reshape(plan.tray.bounds, (2, 2))
    x, y = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, pixels, strict=True))
    distance = np.full(pixels[::-1], np.inf)  # from the floor
    for hollow in (plan.cavity, *plan.exits):
        x_min, y_min, x_max, y_max = hollow.bounds
        distance_x, distance_y = np.maximum(x_min - x, x - x_max), np.maximum(y_min - y, y - y_max)[::-1]
        rows, columns = (np.flatnonzero(side <= plan.flare_mm) for side in (distance_y, distance_x))
        window = np.ix_(rows, columns)
        distance[window] = np.minimum(distance[window], np.maximum.outer(distance_y[rows], distance_x[columns]))
    return plan.silicone_mm * np.clip(distance / max(plan.flare_mm, _MIN_MM), 0, 1)


def _rasterize_area(area: BaseGeometry, bounds: Bounds, pixels: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which pixels of the rectangle `bounds` have their centre in `area`."""
    (low, high), (width, height) = np.reshape(bounds, (2, 2)), pixels
    rings = [(ring - low) / (high - low) * pixels - 0.5 for polygon in polygon_rings(area) for ring in polygon]
    if not rings:
        return np.zeros((height, width), dtype=bool)
    # A pixel lies inside if an odd number of edges crosses its row on its left.
    starts, ends = np.concatenate(rings), np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    edge_rows = np.ceil(np.stack([starts[:, 1], ends[:, 1]])).clip(0, height).astype(np.intp)
    edge, row = _expand_ranges(edge_rows.min(axis=0), edge_rows.max(axis=0) - 1)
    (x, y), (to_x, to_y) = starts[edge].T, ends[edge].T
    column = np.ceil(x + (row - y) * (to_x - x) / (to_y - y)).clip(0, width).astype(np.intp)
    n_edges = np.bincount(row * (width + 1) + column, minlength=height * (width + 1)).reshape(height, width + 1)
    return (np.cumsum(n_edges[::-1, :-1], axis=1) % 2).astype(bool)


def _rasterize_triangles(corners: Array, rows: int, columns: int) -> tuple[Ints, Ints, Array]:
    """Return row, column and height of all pixels whose centres lie in triangles (m, 3, 3)."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    triangle, row = _expand_ranges(*_covered(low[:, 1], high[:, 1], rows))
    # The row cuts the sides of the triangle at its first and at its last column.
    x, y = np.moveaxis(corners[triangle, :, :2], 2, 0)
    run, rise = np.roll(x, -1, axis=1) - x, np.roll(y, -1, axis=1) - y
    share = np.divide(row[:, None] - y, rise, out=np.full(rise.shape, np.nan), where=rise != 0)
    meets = (share >= -_ROUNDING) & (share <= 1 + _ROUNDING)
    cuts = np.where(meets, x + np.clip(share, 0, 1) * run, np.nan)
    x_min, x_max = np.fmin.reduce(cuts, axis=1, initial=np.inf), np.fmax.reduce(cuts, axis=1, initial=-np.inf)
    line, column = _expand_ranges(*_covered(x_min, x_max, columns))
    triangle, row = triangle[line], row[line]
    origin, a, b = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    tilt = -normal[:, :2] / normal[:, 2:]
    offset = np.stack([column, row], axis=1) - origin[triangle, :2]
    height = origin[triangle, 2] + (tilt[triangle] * offset).sum(axis=1)
    return row, column, np.clip(height, low[triangle, 2], high[triangle, 2])


def _covered(start: Array, end: Array, count: int) -> tuple[Ints, Ints]:
    """Return the first and the last of the pixels 0..count-1 within start..end (n,); last < first for none."""
    first, last = np.ceil(start - _ROUNDING), np.floor(end + _ROUNDING)
    return np.clip(first, 0, count).astype(np.intp), np.clip(last, -1, count - 1).astype(np.intp)


def _expand_ranges(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Return all integers of the ranges first..last (n,), one range after the other, and before them its index."""
    lengths = np.maximum(0, last - first + 1)
    index = np.repeat(np.arange(len(lengths)), lengths)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(lengths) - lengths - first, lengths)


CARE = "#7b3fa0"
"""Colour of warnings: unlike both families, and unlike failures."""
_NUMBER, _EDGE, _GREY = "#8a867d", "#a7a49c", "#77746c"
"""Greys of the numbers on the floor, of outlines, and of text beside a picture."""
_RAMP = (PAPER, "#a9c4c9", "#4f7f8e", "#24404c")
"""Colours of a mesh from its lowest visible height to its highest."""
_DPI = 100
PIXELS = 900
"""Longer side of the axes: 14 pixels a mm for the published pad, about six for a ridge."""
_MIN_WIDTH = 600
"""Pixels, with room for a title and a legend."""
_MARGIN_LEFT, _MARGIN_RIGHT, _MARGIN_TOP, _MARGIN_BOTTOM = 66, 24, 44, 62
"""Pixels for title, ticks and axis labels; the rows of the legend come below."""
_ROW, _COLUMNS = 21, 3
"""Height of a row of the legend in pixels, and entries in a row."""
_LINE, _LETTER = 15, 6.2
"""Height of a line of the note below the legend and width of a letter in it, pixels."""
_FAIL_MARKS, _WARN_MARKS = "osp8H", "D^v<>"
"""Markers of the first checks that fail or warn; all further ones have a cross."""


def draw_mould(plan: Plan, findings: Sequence[Finding], path: Path) -> None:
    """Write the mould from above as PNG: colour stands for family and height, shade for the slope.

    Rings mark where a check fails and diamonds where it warns; with more checks come further marks.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    x_min, y_min, x_max, y_max = plan.tray.bounds
    heights, classes = mould_relief(plan, *_count_pixels(plan.tray.bounds))
    layers = fibre_layers(plan)
    colours = [PAPER, FAINT, _NUMBER, *(layer.colour for layer in reversed(layers))]
    entries = [(PAPER, "floor"), (FAINT, f"wall, {plan.silicone_mm:g} mm")]
    if any(plan.numbers):
        entries.append((_NUMBER, f"mirrored numbers, {plan.settings.mould.shallow_ridge_height_mm:g} mm"))
    entries += [(layer.colour, f"{FAMILIES[layer.family]} ridges, {layer.depth_mm:g} mm") for layer in layers]
    handles = [Patch(facecolor=colour, edgecolor=_GREY, label=label) for colour, label in entries]

    depth_mm = plan.settings.mould.floor_mm + plan.silicone_mm
    title = f"Mould from above, {x_max - x_min:.4g} x {y_max - y_min:.4g} x {depth_mm:.4g} mm"
    picture = _Picture(plan.tray.bounds, title, len(handles) + len(_remarks(findings)))
    picture.show(_shade(np.array(list(map(to_rgb, colours)))[classes], heights))
    picture.save(path, [*handles, *picture.mark(findings)])


def draw_tracks(plan: Plan, path: Path) -> None:
    """Write the fibres as they lie in the tray, from above, as PNG; the deeper of two that cross covers the other."""
    x_min, y_min, x_max, y_max = plan.silicone.bounds
    room = 0.06 * (x_max - x_min)
    layers, clashes, layout = fibre_layers(plan), plan.clash_positions_mm, plan.pad.layout
    title = f"Fibres as they lie in the tray, from above: {layout.fibres} fibres, {len(plan.crossings)} crossings"
    note = orientation_sentence(layout.counts, plan.settings.pad.leads)
    bounds = (x_min - room, y_min - room, x_max + room, y_max + room)
    picture = _Picture(bounds, title, len(layers) + (len(clashes) > 0), note)
    pillars = overlap(plan.pillars, plan.cavity)
    for area, colour in ((plan.silicone, PAPER), (plan.cavity, PAPER), (pillars, FAINT)):
        for rings in polygon_rings(area):
            for ring in rings[:1] if area is pillars else rings:
                picture.axes.fill(*ring.T, facecolor=colour, edgecolor=_EDGE, linewidth=1, zorder=1)
    handles = [handle for layer in reversed(layers) for handle in _draw_layer(picture, plan, layer)][::-1]
    if len(clashes):
        label = f"{len(clashes)} crossings of one family"
        handles += picture.axes.plot(*clashes.T, "o", mfc="none", mec=INK, ms=9, mew=1, label=label, zorder=4)
    picture.scale_bar()
    picture.save(path, handles)


def draw_findings(vertices: ArrayLike, triangles: ArrayLike, findings: Sequence[Finding], path: Path) -> None:
    """Write any mesh from above as PNG: colour stands for the height, shade for the slope, marks for findings.

    Vertices (n, 3), mm, are finite, and there is at least one triangle (m, 3).
    """
    from matplotlib.colors import LinearSegmentedColormap

    corners = np.asarray(vertices, dtype=float)
    heights, bounds = mesh_relief(corners, np.asarray(triangles, dtype=np.intp), PIXELS)
    mask = np.isfinite(heights)
    low, high = (float(heights[mask].min()), float(heights[mask].max())) if mask.any() else (0.0, 0.0)
    heights[~mask] = low
    ramp = LinearSegmentedColormap.from_list("heights", _RAMP)
    colours = _shade(ramp((heights - low) / ((high - low) or 1.0))[..., :3], heights)
    colours[~mask] = 1

    size = " x ".join(f"{side:.4g}" for side in np.ptp(corners, axis=0))
    picture = _Picture(bounds, f"Mesh from above, {size} mm", len(_remarks(findings)))
    picture.show(colours)
    ground = float(corners[:, 2].min())
    picture.colour_bar(ramp, f"{low - ground:.3g} mm", f"{high - ground:.3g} mm above the lowest point")
    picture.save(path, picture.mark(findings))


def _draw_layer(picture: "_Picture", plan: Plan, layer: FibreLayer) -> list[Any]:
    """Draw the fibres of a layer with their numbers, at both ends for leads to one side; return the legend's entry."""
    from matplotlib.patheffects import withStroke
    from shapely.ops import substring

    width = max(1.3, picture.points(plan.settings.fibre.material.diameter_mm))
    size = min(11.0, 0.5 * picture.points(plan.min_pitch_mm))
    handles = []
    for fibre in layer.fibres:
        line = substring(plan.lines[fibre], INTO_WALL_MM, plan.lines[fibre].length - INTO_WALL_MM)
        rim = [withStroke(linewidth=width + 2, foreground=PAPER)]
        style = {"linewidth": width, "color": layer.colour, "zorder": 2, "path_effects": rim}
        label = f"{FAMILIES[layer.family]}, {layer.depth_mm:g} mm deep"
        handles += picture.axes.plot(*np.array(line.coords).T, label=label, solid_capstyle="butt", **style)
        below = plan.leads.pairs[fibre][0].axis == 1
        offset, (align_x, align_y) = ((0, -5), ("center", "top")) if below else ((-5, 0), ("right", "center"))
        for x, y in (line.coords[0], line.coords[-1])[: 1 + (plan.settings.pad.leads == "one side")]:
            picture.axes.annotate(
                str(fibre + 1), (x, y), offset, textcoords="offset points", ha=align_x, va=align_y,
                color=FAMILY_COLOURS[layer.family], fontsize=size, fontweight="bold",
            )  # fmt: skip
    return handles[:1]


def _remarks(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings with positions that fail, then those that warn."""
    remarks = [finding for finding in findings if finding.status != "pass" and finding.positions_mm]
    return sorted(remarks, key=lambda finding: finding.status)


class _Picture:
    """A figure whose axes cover `bounds` (x_min, y_min, x_max, y_max), mm, in whole pixels; legend and note below."""

    def __init__(self, bounds: Bounds, title: str, n_entries: int, note: str = "") -> None:
        from matplotlib.figure import Figure

        x_min, y_min, x_max, y_max = bounds
        axes_width, axes_height = _count_pixels(bounds)
        width = _MARGIN_LEFT + max(axes_width, _MIN_WIDTH) + _MARGIN_RIGHT
        self.note = textwrap.wrap(note, int((width - _MARGIN_LEFT) / _LETTER))
        legend = _ROW * math.ceil(n_entries / _COLUMNS) + 6 * (n_entries > 0)
        bottom = _MARGIN_BOTTOM + legend + _LINE * len(self.note)
        height = bottom + axes_height + _MARGIN_TOP
        self.extent, self.pixels, self.size = (x_min, x_max, y_min, y_max), (axes_width, axes_height), (width, height)
        self.figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
        area = (_MARGIN_LEFT / width, bottom / height, axes_width / width, axes_height / height)
        self.axes = self.figure.add_axes(area)
        self.axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xlabel="x (mm)", ylabel="y (mm)")
        self.axes.set_title(title, fontsize=11, color=INK, loc="left")
        self.axes.tick_params(colors=_GREY, labelsize=9)
        self.axes.spines[:].set_color(_EDGE)

    def points(self, length_mm: float) -> float:
        """Convert a length to typographic points."""
        x_min, x_max, *_ = self.extent
        return length_mm * self.pixels[0] / (x_max - x_min) * 72 / _DPI

    def show(self, colours: Array) -> None:
        """Fill the axes with colours (rows, columns, 3), 0 to 1."""
        self.axes.imshow(colours, extent=self.extent, interpolation="nearest", aspect="auto")

    def mark(self, findings: Sequence[Finding]) -> list[Any]:
        """Mark the positions of the findings that fail or warn; return the legend's entries."""
        styles = {"fail": (ALARM, iter(_FAIL_MARKS)), "warn": (CARE, iter(_WARN_MARKS))}
        handles = []
        for finding in _remarks(findings):
            colour, markers = styles[finding.status]
            marker, positions = next(markers, "X"), np.array(finding.positions_mm).T
            label = f"{finding.status}: {finding.name} ({len(finding.positions_mm)})"
            style = {"marker": marker, "mfc": "none", "linestyle": "none", "ms": 10, "zorder": 5}
            self.axes.plot(*positions, mec="white", mew=3.4, **style)  # sets the mark off from its background
            handles += self.axes.plot(*positions, mec=colour, mew=1.5, label=label, **style)
        return handles

    def scale_bar(self) -> None:
        """Draw a scale bar under the lower right corner."""
        x_max, y = self.extent[1], -46 / self.pixels[1]
        transform = self.axes.get_xaxis_transform()
        style = {"color": INK, "clip_on": False, "transform": transform}
        self.axes.plot([x_max - SCALE_MM, x_max], [y, y], "|-", linewidth=1.2, ms=8, **style)
        self.axes.annotate(
            f"{SCALE_MM:g} mm", (x_max - SCALE_MM, y), (-8, 0), xycoords=transform,
            textcoords="offset points", ha="right", va="center", fontsize=9, color=INK, annotation_clip=False,
        )  # fmt: skip

    def colour_bar(self, colours: Any, low: str, high: str) -> None:
        """Draw the colours of heights under the lower left corner."""
        width, height = self.size
        y = self.axes.get_position().y0 * height - 52
        bar = self.figure.add_axes((_MARGIN_LEFT / width + 50 / width, y / height, 120 / width, 12 / height))
        bar.imshow(np.linspace(0, 1, 120)[None], cmap=colours, aspect="auto")
        bar.set(xticks=[], yticks=[])
        for x, align, text in ((-0.05, "right", low), (1.05, "left", high)):
            bar.text(x, 0.5, text, ha=align, va="center", fontsize=9, color=INK, transform=bar.transAxes)

    def save(self, path: Path, handles: list[Any]) -> None:
        """Write the picture with its legend and note as PNG."""
        from padforge.design.common.plotting import save_figure

        width, height = self.size
        note_height = _LINE * len(self.note)
        if handles:
            style: dict[str, Any] = {"frameon": False, "fontsize": 9, "borderaxespad": 0.2, "handlelength": 1.6}
            box = (0, note_height / height, 1, 1)
            self.figure.legend(handles=handles, loc="lower center", bbox_to_anchor=box, ncols=_COLUMNS, **style)
        for row, line in enumerate(self.note):
            position = _MARGIN_LEFT / 2 / width, (note_height - (row + 0.5) * _LINE) / height
            self.figure.text(*position, line, fontsize=8, color=_GREY, va="center")
        save_figure(self.figure, path, _DPI)


def _count_pixels(bounds: Bounds) -> tuple[int, int]:
    """Return the width and the height in pixels of x_min, y_min, x_max, y_max."""
    x_min, y_min, x_max, y_max = bounds
    scale = PIXELS / max(x_max - x_min, y_max - y_min)
    return max(1, round(scale * (x_max - x_min))), max(1, round(scale * (y_max - y_min)))
