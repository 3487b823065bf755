"""Pictures of a mould, of the tracks it leaves, and of any mesh with what the checks found on it: PNGs.

All are seen from above. The same input gives the same bytes; files are small, for some are kept in git.
"""

import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

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

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Ints = NDArray[np.intp]

FLOOR, WALL, NUMBER, RIDGE = 0, 1, 2, 3
"""What a pixel of a mould shows; `RIDGE` + level for the ridges of a level."""
_AT_ONCE = 2_000_000
"""Pixels of triangles worked on together: bounds memory at about 200 MB, however large the mesh."""
_RELIEF_EDGE = 1e-6
"""Pixels by which a triangle reaches over its edges: no pixel between two neighbours is lost to rounding."""
_SMALLEST_MM = 1e-6
"""What is smaller is drawn as a dot of this size."""
_STEPS = 8
"""Steps of shade on either side: enough for the eye, and small files."""


def mould_relief(plan: Plan, wide: int, tall: int) -> tuple[Array, Ints]:
    """Heights (tall, wide) above the tray's floor, and what each pixel shows, over the tray."""
    mould, pixels = plan.settings.mould, (wide, tall)
    walls = _walls(plan, pixels)
    walls[_inside(plan.pillars, plan.tray.bounds, pixels)] = plan.silicone_mm
    heights = walls.copy()
    for prism in mould_body(plan).adds:
        inside = _inside(prism.area, plan.tray.bounds, pixels)
        heights[inside] = np.maximum(heights[inside], prism.top_mm - mould.floor_mm)
    shown = np.where(walls > 0, WALL, FLOOR)
    standing = (heights > walls) & (heights <= plan.silicone_mm)
    shown[standing] = NUMBER
    for level, height in enumerate(plan.heights_mm):  # what a taller ridge covers, it shows
        base = plan.outline(level, height) if plan.settings.ridge_slope else plan.ridges[level]
        shown[standing & _inside(base, plan.tray.bounds, pixels)] = RIDGE + level
    return heights, shown


def mesh_relief(vertices: Array, triangles: Ints, pixels: int) -> tuple[Array, tuple[float, float, float, float]]:
    """The upper surface of a mesh of any kind, closed or not.

    Args:
        vertices: (n, 3) mm. triangles: (m, 3) vertex numbers.
        pixels: along the longer side.

    Returns:
        Heights at the pixels' middles in the frame of the mesh, -inf where there is none; and what they cover:
        left, right, low, high.
    """
    low, high = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
    scale = pixels / max(float((high - low).max()), _SMALLEST_MM)
    columns, rows = np.maximum(2, np.ceil((high - low) * scale - _RELIEF_EDGE)).astype(int).tolist()  # 2 have a slope
    corners = np.column_stack([(vertices[:, :2] - low) * scale - 0.5, vertices[:, 2]])[triangles]
    heights = np.full(rows * columns, -np.inf)
    for part in _portions(corners):
        row, column, height = _pixels_of(part, rows, columns)
        np.maximum.at(heights, row * columns + column, height)
    right, top = (low + np.array([columns, rows]) / scale).tolist()
    return heights.reshape(rows, columns)[::-1], (float(low[0]), right, float(low[1]), top)


def lit(colours: Array, heights_mm: Array) -> Array:
    """Colours (r, c, 3), 0..1, with light from the upper left on heights (r, c); flat places keep theirs."""
    from scipy.ndimage import uniform_filter

    # the root tells low steps from high ones without the high ones drowning their own colour
    eased = uniform_filter(np.sqrt(heights_mm - heights_mm.min(), dtype=np.float32), 3, mode="nearest")
    down, across = np.gradient(eased)
    slope = np.rint(_STEPS * np.clip(down + across, -1, 1)) / _STEPS
    sloping = slope != 0
    chosen, tilt = colours[sloping], slope[sloping, None]
    out = colours.copy()
    out[sloping] = chosen + np.where(tilt > 0, 0.6 * tilt * (1 - chosen), 0.5 * tilt * chosen)
    return out


def _walls(plan: Plan, pixels: tuple[int, int]) -> Array:
    """(tall, wide) height of the walls alone, which lean outwards from the outline of the floor."""
    low, high = np.reshape(plan.tray.bounds, (2, 2))
    x, y = (a + (np.arange(n) + 0.5) * (b - a) / n for a, b, n in zip(low, high, pixels, strict=True))
    outside = np.full(pixels[::-1], np.inf)
    for hollow in (plan.cavity, *plan.exits):
        left, bottom, right, top = hollow.bounds
        across = np.maximum(left - x, x - right)
        up = np.maximum(bottom - y, y - top)[::-1]
        columns, rows = _near(across, plan.flare_mm), _near(up, plan.flare_mm)
        window = outside[rows, columns]
        np.minimum(window, np.maximum(up[rows, None], across[None, columns]), out=window)
    return plan.silicone_mm * np.clip(outside / max(plan.flare_mm, _SMALLEST_MM), 0, 1)


def _near(away: Array, reach_mm: float) -> slice:
    """The stretch of pixels no further away than `reach_mm`."""
    near = np.flatnonzero(away <= reach_mm)
    return slice(near[0], near[-1] + 1) if len(near) else slice(0)


def _inside(area: BaseGeometry, bounds: tuple[float, ...], pixels: tuple[int, int]) -> NDArray[np.bool_]:
    """(tall, wide) whether the pixel's middle lies in `area`, over the rectangle `bounds`."""
    (low, high), (wide, tall) = np.reshape(bounds, (2, 2)), pixels
    rings = [(ring - low) / (high - low) * pixels - 0.5 for polygon in polygon_rings(area) for ring in polygon]
    if not rings:
        return np.zeros((tall, wide), dtype=bool)
    starts, ends = np.concatenate(rings), np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    ends_at = np.ceil(np.stack([starts[:, 1], ends[:, 1]])).clip(0, tall).astype(np.intp)
    edge, row = _runs(ends_at.min(axis=0), ends_at.max(axis=0) - 1)
    (x, y), (to_x, to_y) = starts[edge].T, ends[edge].T
    column = np.ceil(x + (row - y) * (to_x - x) / (to_y - y)).clip(0, wide).astype(np.intp)
    passed = np.bincount(row * (wide + 1) + column, minlength=tall * (wide + 1)).reshape(tall, wide + 1)
    return (np.cumsum(passed[::-1, :-1], axis=1) % 2).astype(bool)


def _portions(corners: Array) -> Iterable[Array]:
    """Triangles (m, 3, 3) that are seen from above, a bounded number of pixels at a time."""
    first, second, third = np.moveaxis(corners[..., :2], 1, 0)
    a, b = second - first, third - first
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    seen = area > 0
    cost = area + np.ptp(corners[..., 1], axis=1) + 1
    portion = np.cumsum(cost[seen]) // _AT_ONCE
    return np.split(corners[seen], np.flatnonzero(np.diff(portion)) + 1)


def _pixels_of(corners: Array, rows: int, columns: int) -> tuple[Ints, Ints, Array]:
    """Row, column and height of every pixel whose middle lies in a triangle (m, 3, 3), row by row of each."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    triangle, row = _runs(*_between(low[:, 1], high[:, 1], rows))
    left, right = _crossed(corners[triangle, :, :2], row)
    line, column = _runs(*_between(left, right, columns))
    triangle, row = triangle[line], row[line]
    origin, a, b = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    tilt = -normal[:, :2] / normal[:, 2:]
    away = np.stack([column, row], axis=1) - origin[triangle, :2]
    height = origin[triangle, 2] + (tilt[triangle] * away).sum(axis=1)
    return row, column, np.clip(height, low[triangle, 2], high[triangle, 2])


def _between(start: Array, end: Array, count: int) -> tuple[Ints, Ints]:
    """First and last of the whole numbers 0..count-1 within start..end (n,); the last below the first for none."""
    first, last = np.ceil(start - _RELIEF_EDGE), np.floor(end + _RELIEF_EDGE)
    return np.clip(first, 0, count).astype(np.intp), np.clip(last, -1, count - 1).astype(np.intp)


def _runs(first: Ints, last: Ints) -> tuple[Ints, Ints]:
    """Every whole number from first to last (n,), run after run, behind the number of its run."""
    lengths = np.maximum(0, last - first + 1)
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths - first, lengths)


def _crossed(corners: Array, row: Ints) -> tuple[Array, Array]:
    """Left and right end of the line at height `row` (n,) within the triangles (n, 3, 2)."""
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for edge in range(3):
        (x, y), (to_x, to_y) = corners[:, edge].T, corners[:, (edge + 1) % 3].T
        rise = to_y - y
        share = np.divide(row - y, rise, out=np.full(len(row), np.nan), where=rise != 0)
        met = (share >= -_RELIEF_EDGE) & (share <= 1 + _RELIEF_EDGE)
        place = np.where(met, x + np.clip(share, 0, 1) * (to_x - x), np.nan)
        left, right = np.fmin(left, place), np.fmax(right, place)
    return left, right


CARE = "#7b3fa0"
"""Colour of what a check warns of: unlike both families, and unlike what fails."""
_NUMBER, _EDGE, _GREY = "#8a867d", "#a7a49c", "#77746c"
"""Greys of the numbers on the floor, of outlines, and of what stands beside a picture."""
_RAMP = (PAPER, "#a9c4c9", "#4f7f8e", "#24404c")
"""Colours of a mesh from its lowest visible height to its highest."""
_DPI = 100

_PIXELS = 900
"""Longer side of what is shown: 14 pixels a mm for the published pad, about six for a ridge."""
_NARROWEST = 600
"""Least width in pixels: room for a title and a legend."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 24, 44, 62
"""Pixels around it for title, ticks and axis labels; the rows of the legend come below."""
_ROW, _COLUMNS = 21, 3
"""Height of a row of the legend in pixels, and entries in one."""
_LINE, _LETTER = 15, 6.2
"""Height of a line of the note below the legend and width of a letter in it, pixels."""
_FAIL_MARKS, _CARE_MARKS = "osp8H", "D^v<>"
"""A mark of its own for every check, as long as they last."""


def draw_mould(plan: Plan, findings: Sequence[Finding], path: Path) -> None:
    """Write the mould from above as PNG: colour tells family and height, shade the slope.

    Rings mark where a check fails and diamonds where it warns; with more checks come further marks.
    """
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    left, low, right, high = plan.tray.bounds
    wide, tall = _pixels(right - left, high - low)
    heights, shown = mould_relief(plan, wide, tall)
    order = fibre_layers(plan)
    tints = [PAPER, FAINT, _NUMBER, *[PAPER] * len(plan.heights_mm)]
    for layer in order:
        tints[RIDGE + layer.index] = layer.colour
    entries = [(PAPER, "floor"), (FAINT, f"wall, {plan.silicone_mm:g} mm")]
    if any(plan.numbers):
        entries.append((_NUMBER, f"mirrored numbers, {plan.settings.mould.shallow_ridge_height_mm:g} mm"))
    entries += [(layer.colour, f"{FAMILIES[layer.family]} ridges, {layer.depth_mm:g} mm") for layer in order]
    handles = [Patch(facecolor=colour, edgecolor=_GREY, label=label) for colour, label in entries]

    depth_mm = plan.settings.mould.floor_mm + plan.silicone_mm
    title = f"Mould from above, {right - left:.4g} x {high - low:.4g} x {depth_mm:.4g} mm"
    sheet = _sheet((left, right, low, high), title, len(handles) + len(_marked(findings)))
    sheet.show(lit(np.array(list(map(to_rgb, tints)))[shown], heights))
    sheet.save(path, [*handles, *sheet.mark(findings)])


def draw_tracks(plan: Plan, path: Path) -> None:
    """Write the plan of the fibres as PNG, as they lie in the tray, seen from above.

    Where two cross, the deeper one, which is nearer to whoever looks down into the tray, interrupts the other.
    """
    left, low, right, high = plan.silicone.bounds
    room = 0.06 * (right - left)
    order = fibre_layers(plan)
    places = plan.clash_positions_mm
    title = (
        f"Fibres as they lie in the tray, from above: {plan.pad.layout.fibres} fibres, {len(plan.crossings)} crossings"
    )
    bounds = (left - room, right + room, low - room, high + room)
    sheet = _sheet(
        bounds,
        title,
        len(order) + (len(places) > 0),
        orientation_sentence(plan.pad.layout.counts, plan.settings.pad.leads),
    )
    for area in (plan.silicone, plan.cavity):
        for ring in (ring for polygon in polygon_rings(area) for ring in polygon):
            sheet.axes.fill(*ring.T, facecolor=PAPER, edgecolor=_EDGE, linewidth=1, zorder=1)
    for hole, *_ in polygon_rings(overlap(plan.pillars, plan.cavity)):
        sheet.axes.fill(*hole.T, facecolor=FAINT, edgecolor=_EDGE, linewidth=1, zorder=1)
    handles = [h for layer in reversed(order) for h in _draw_layer(sheet, plan, layer)][::-1]
    if len(places):
        label = f"{len(places)} crossings of one family"
        handles += sheet.axes.plot(*places.T, "o", mfc="none", mec=INK, ms=9, mew=1, label=label, zorder=4)
    sheet.scale_bar()
    sheet.save(path, handles)


def draw_findings(vertices: ArrayLike, triangles: ArrayLike, findings: Sequence[Finding], path: Path) -> None:
    """Write any mesh from above as PNG: colour tells the height, shade the slope, marks what the checks found.

    Args:
        vertices: (n, 3) mm, finite. triangles: (m, 3) vertex numbers, m >= 1.
        findings: with places in the frame of the mesh. path: to write to.
    """
    from matplotlib.colors import LinearSegmentedColormap

    corners = np.asarray(vertices, dtype=float)
    heights, extent = mesh_relief(corners, np.asarray(triangles, dtype=np.intp), _PIXELS)
    seen = np.isfinite(heights)
    low, high = (float(heights[seen].min()), float(heights[seen].max())) if seen.any() else (0.0, 0.0)
    heights[~seen] = low
    ramp = LinearSegmentedColormap.from_list("heights", _RAMP)
    colours = lit(ramp((heights - low) / ((high - low) or 1.0))[..., :3], heights)
    colours[~seen] = 1

    size = " x ".join(f"{side:.4g}" for side in np.ptp(corners, axis=0))
    sheet = _sheet(extent, f"Mesh from above, {size} mm", len(_marked(findings)))
    sheet.show(colours)
    ground = float(corners[:, 2].min())
    sheet.ramp(ramp, f"{low - ground:.3g} mm", f"{high - ground:.3g} mm above the lowest point")
    sheet.save(path, sheet.mark(findings))


def _draw_layer(sheet: "_Sheet", plan: Plan, layer: FibreLayer) -> list[Any]:
    """Draw the fibres of a depth with their numbers, at both ends where these lie side by side.

    The first of their lines stands for them in the legend.
    """
    from matplotlib.patheffects import withStroke
    from shapely.ops import substring

    width = max(1.3, sheet.points(plan.settings.fibre.material.diameter_mm))
    size = min(11.0, 0.5 * sheet.points(plan.min_pitch_mm))
    drawn = []
    for fibre in layer.fibres:
        line = substring(plan.lines[fibre], INTO_WALL_MM, plan.lines[fibre].length - INTO_WALL_MM)
        edged = [withStroke(linewidth=width + 2, foreground=PAPER)]
        style = {"linewidth": width, "color": layer.colour, "zorder": 2, "path_effects": edged}
        label = f"{FAMILIES[layer.family]}, {layer.depth_mm:g} mm deep"
        drawn += sheet.axes.plot(*np.array(line.coords).T, label=label, solid_capstyle="butt", **style)
        below = plan.leads.pairs[fibre][0].axis == 1
        away, place = ((0, -5), ("center", "top")) if below else ((-5, 0), ("right", "center"))
        for x, y in (line.coords[0], line.coords[-1])[: 1 + (plan.settings.pad.leads == "one side")]:
            sheet.axes.annotate(
                str(fibre + 1), (x, y), away, textcoords="offset points", ha=place[0], va=place[1],
                color=FAMILY_COLOURS[layer.family], fontsize=size, fontweight="bold",
            )  # fmt: skip
    return drawn[:1]


def _marked(findings: Sequence[Finding]) -> list[Finding]:
    """The findings that have something to show, those that fail first."""
    worth = [finding for finding in findings if finding.status != "pass" and finding.positions_mm]
    return sorted(worth, key=lambda finding: finding.status)


@dataclass(frozen=True)
class _Sheet:
    """A picture in the making: its axes are in mm and cover whole pixels.

    Attributes:
        extent: left, right, low and high of the axes, mm. pixels: their width and height.
        note: lines below the legend.
    """

    figure: "Figure"
    axes: "Axes"
    extent: tuple[float, float, float, float]
    pixels: tuple[int, int]
    note: tuple[str, ...] = ()

    def points(self, length_mm: float) -> float:
        """A length on the picture in typographic points."""
        left, right, *_ = self.extent
        return length_mm * self.pixels[0] / (right - left) * 72 / _DPI

    def show(self, colours: np.ndarray) -> None:
        """Fill the axes with colours (rows, columns, 3), 0..1."""
        self.axes.imshow(colours, extent=self.extent, interpolation="nearest", aspect="auto")

    def mark(self, findings: Sequence[Finding]) -> list[Any]:
        """Mark the places of the findings that fail or warn; what explains the marks in the legend."""
        marks = {"fail": (ALARM, iter(_FAIL_MARKS)), "warn": (CARE, iter(_CARE_MARKS))}
        handles = []
        for finding in _marked(findings):
            colour, shapes = marks[finding.status]
            shape, places = next(shapes, "X"), np.array(finding.positions_mm).T
            label = f"{finding.status}: {finding.name} ({len(finding.positions_mm)})"
            style = {"marker": shape, "mfc": "none", "linestyle": "none", "ms": 10, "zorder": 5}
            self.axes.plot(*places, mec="white", mew=3.4, **style)  # keeps the mark off whatever it lies on
            handles += self.axes.plot(*places, mec=colour, mew=1.5, label=label, **style)
        return handles

    def scale_bar(self) -> None:
        """Put a bar of known length under the lower right corner."""
        right, y = self.extent[1], -46 / self.pixels[1]
        style = {"color": INK, "clip_on": False, "transform": self.axes.get_xaxis_transform()}
        self.axes.plot([right - SCALE_MM, right], [y, y], "|-", linewidth=1.2, ms=8, **style)
        self.axes.annotate(
            f"{SCALE_MM:g} mm", (right - SCALE_MM, y), (-8, 0), xycoords=self.axes.get_xaxis_transform(),
            textcoords="offset points", ha="right", va="center", fontsize=9, color=INK, annotation_clip=False,
        )  # fmt: skip

    def ramp(self, colours: Any, low: str, high: str) -> None:
        """Put a bar of the colours of heights under the lower left corner."""
        width, height = self.figure.get_size_inches() * _DPI
        y = self.axes.get_position().y0 * height - 52
        bar = self.figure.add_axes((_LEFT / width + 50 / width, y / height, 120 / width, 12 / height))
        bar.imshow(np.linspace(0, 1, 120)[None], cmap=colours, aspect="auto")
        bar.set(xticks=[], yticks=[])
        bar.text(-0.05, 0.5, low, ha="right", va="center", fontsize=9, color=INK, transform=bar.transAxes)
        bar.text(1.05, 0.5, high, ha="left", va="center", fontsize=9, color=INK, transform=bar.transAxes)

    def save(self, path: Path, handles: list[Any]) -> None:
        """Write the picture with its legend as PNG."""
        from padforge.design.common.plotting import save_figure

        width, height = self.figure.get_size_inches() * _DPI
        below = _LINE * len(self.note)
        if handles:
            style: dict[str, Any] = {"frameon": False, "fontsize": 9, "borderaxespad": 0.2, "handlelength": 1.6}
            room = (0, below / height, 1, 1)
            self.figure.legend(handles=handles, loc="lower center", bbox_to_anchor=room, ncols=_COLUMNS, **style)
        for row, line in enumerate(self.note):
            place = _LEFT / 2 / width, (below - (row + 0.5) * _LINE) / height
            self.figure.text(*place, line, fontsize=8, color=_GREY, va="center")
        save_figure(self.figure, path, _DPI)


def _pixels(width_mm: float, height_mm: float) -> tuple[int, int]:
    """Width and height in pixels of what is so large."""
    scale = _PIXELS / max(width_mm, height_mm)
    return max(1, round(scale * width_mm)), max(1, round(scale * height_mm))


def _sheet(extent: tuple[float, float, float, float], title: str, entries: int, note: str = "") -> _Sheet:
    """An empty picture of `extent` (left, right, low, high) mm with room for the legend's entries and a note."""
    from matplotlib.figure import Figure

    left, right, low, high = extent
    wide, tall = _pixels(right - left, high - low)
    width = _LEFT + max(wide, _NARROWEST) + _RIGHT
    lines = tuple(textwrap.wrap(note, int((width - _LEFT) / _LETTER)))
    below = _BOTTOM + _ROW * math.ceil(entries / _COLUMNS) + 6 * (entries > 0) + _LINE * len(lines)
    height = below + tall + _TOP
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    axes = figure.add_axes((_LEFT / width, below / height, wide / width, tall / height))
    axes.set(xlim=(left, right), ylim=(low, high), xlabel="x (mm)", ylabel="y (mm)")
    axes.set_title(title, fontsize=11, color=INK, loc="left")
    axes.tick_params(colors=_GREY, labelsize=9)
    axes.spines[:].set_color(_EDGE)
    return _Sheet(figure, axes, extent, (wide, tall), lines)
