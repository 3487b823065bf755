"""Pictures of a mould, of tracks, toolpath and crossing, of any mesh with findings, and of a pad's orientation.

The same input gives the same bytes. Files are small, since some are kept in git.
"""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, repeat
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from padforge.common.plotting import ALARM, FAINT, FAMILY_COLOURS, INK, PAPER
from padforge.design.morphology import Array
from padforge.design.settings import FAMILIES
from padforge.fabricate.checks import Finding
from padforge.fabricate.fibre_placement import Step, mirror_x
from padforge.fabricate.mesh import unit_normals
from padforge.fabricate.outputs import drawings
from padforge.fabricate.plan import (
    INTO_WALL_MM,
    FibreLayer,
    Plan,
    fibre_layers,
    overlap,
    polygon_rings,
)

CARE = "#7b3fa0"
"""Colour of warnings, different from both families and from failures."""
_NUMBER = "#8a867d"  # colour of the numbers on the floor
_HEAD = "#b4b0a7"  # colour of the heads of screws
_EDGE = "#a7a49c"  # colour of outlines
_GREY = "#77746c"  # colour of text beside a picture
_RAMP = (PAPER, "#a9c4c9", "#4f7f8e", "#24404c")  # colours of a mesh from its lowest visible height to its highest
_DPI = 100
PIXELS = 900  # longer side of the axes: 14 pixels a mm for the published pad, about six for a ridge
_FLAT = 1e-3  # height, mm, below which a face is flat, and z of the normal below which it is vertical
_MARGIN_LEFT, _MARGIN_RIGHT, _MARGIN_TOP, _MARGIN_BOTTOM = 66, 24, 44, 62  # pixels, for title, ticks and axis labels
_COLUMNS = 3  # entries in a row of the legend
_LINE = 15  # height of a line of the note below the legend, pixels
_FAIL_MARKS = "osp8H"  # markers of the first checks that fail; further ones have a cross
_WARN_MARKS = "D^v<>"  # markers of the first checks that warn


def draw_mould(plan: Plan, vertices: ArrayLike, triangles: ArrayLike, findings: Sequence[Finding], path: Path) -> None:
    """Write a picture of a mould from above as PNG, coloured by family and height.

    Every fibre has its number on the wall at both ends; the numbers that are cast are mirrored. Rings and further
    markers show where checks fail, diamonds and further ones where they warn. `vertices` (n, 3) are in mm, `triangles`
    (m, 3) vertex indices.
    """
    from matplotlib.patches import Patch

    x_min, y_min, x_max, y_max = plan.tray.bounds
    layers = fibre_layers(plan)
    entries = [(PAPER, "floor"), (FAINT, f"wall, {plan.silicone_mm:g} mm")]
    if any(plan.numbers):
        entries.append((_NUMBER, f"mirrored numbers, {plan.settings.mould.shallow_ridge_height_mm:g} mm"))
    if plan.heads:
        entries.append((_HEAD, f"screws' heads, {plan.head_mm:g} mm"))
    entries += [(layer.colour, f"{FAMILIES[layer.family]} ridges, {layer.depth_mm:g} mm") for layer in layers]
    handles = [Patch(facecolor=colour, edgecolor=_GREY, label=label) for colour, label in entries]

    depth_mm = plan.settings.mould.floor_mm + plan.silicone_mm
    title = f"Mould from above, {x_max - x_min:.4g} x {y_max - y_min:.4g} x {depth_mm:.4g} mm"
    picture = _Picture(plan.tray.bounds, title, len(handles) + len(_remarks(findings)))
    corners = np.asarray(vertices, dtype=float)[np.asarray(triangles)]
    picture.show(corners, _mould_colours(plan, corners))
    wall_mm = plan.settings.mould.wall_mm
    past_mm, size = plan.corner_mm + plan.flare_mm - wall_mm / 2, min(0.8 * wall_mm, 0.6 * plan.min_pitch_mm)
    for fibre, pair in enumerate(plan.leads.pairs):
        colour = FAMILY_COLOURS[plan.family(fibre)]
        for lead in pair:
            picture.write(str(fibre + 1), lead.point_past_edge(past_mm), size, color=colour, weight="bold")
    picture.save(path, [*handles, *picture.mark(findings)])


def _mould_colours(plan: Plan, corners: Array) -> NDArray[np.str_]:
    """Return the colour (m,) of every triangle (m, 3, 3) of a mould: floor, walls, numbers or ridges of a layer."""
    z = corners[:, :, 2] - plan.settings.mould.floor_mm
    x, y, height = corners.mean(axis=1).T[0], corners.mean(axis=1).T[1], z.mean(axis=1)
    is_flat = np.ptp(z, axis=1) < _FLAT
    raised = is_flat & (height > _FLAT) & (height < plan.silicone_mm - _FLAT)
    colours = np.where(is_flat & (height <= _FLAT), PAPER, np.where(raised, _NUMBER, FAINT))
    for layer in reversed(fibre_layers(plan)):  # taller ridges come later and cover lower ones
        base = plan.outline(layer.fibres, plan.heights_mm[layer.index])
        colours[raised & shapely.contains_xy(base, x, y)] = layer.colour
    colours[raised & shapely.contains_xy(shapely.union_all(plan.heads), x, y)] = _HEAD
    return colours


def draw_tracks(plan: Plan, path: Path) -> None:
    """Write a picture of the fibres as they lie in the tray, from above, as PNG; deeper fibres cover shallower ones."""
    x_min, y_min, x_max, y_max = plan.silicone.bounds
    room = 0.06 * (x_max - x_min)
    layers, clashes, layout = fibre_layers(plan), plan.clash_positions_mm, plan.pad.layout
    title = f"Fibres as they lie in the tray, from above: {layout.fibres} fibres, {len(plan.crossings)} crossings"
    note = drawings.orientation_sentence(layout.counts, plan.settings.pad.leads)
    bounds = (x_min - room, y_min - room, x_max + room, y_max + room)
    picture = _Picture(bounds, title, len(layers) + (len(clashes) > 0), note)
    pillars = overlap(plan.feet, plan.cavity)
    for area, colour in ((plan.silicone, PAPER), (plan.cavity, PAPER), (pillars, FAINT)):
        for ring in (ring for rings in polygon_rings(area) for ring in (rings[:1] if area is pillars else rings)):
            picture.axes.fill(*ring.T, facecolor=colour, edgecolor=_EDGE, linewidth=1, zorder=1)
    handles = [handle for layer in reversed(layers) for handle in _draw_layer(picture, plan, layer)][::-1]
    if len(clashes):
        label = f"{len(clashes)} crossings of one family"
        handles += picture.axes.plot(*clashes.T, "o", mfc="none", mec=INK, ms=9, mew=1, label=label, zorder=4)
    picture.scale_bar()
    picture.save(path, handles)


def draw_findings(vertices: ArrayLike, triangles: ArrayLike, findings: Sequence[Finding], path: Path) -> None:
    """Write a picture of any mesh from above as PNG, coloured by height, with the positions of findings.

    `vertices` (n, 3) are in mm and finite, `triangles` (m, 3) vertex indices, m > 0.
    """
    from matplotlib.colors import LinearSegmentedColormap

    points = np.asarray(vertices, dtype=float)
    corners = points[np.asarray(triangles)]
    upwards = corners[unit_normals(corners)[:, 2] > _FLAT]
    z = (upwards if len(upwards) else corners)[:, :, 2]  # the underside, if any, is hidden
    low, high, ground = float(z.min()), float(z.max()), float(points[:, 2].min())
    ramp = LinearSegmentedColormap.from_list("heights", _RAMP)
    x_min, y_min, x_max, y_max = *points[:, :2].min(axis=0).tolist(), *points[:, :2].max(axis=0).tolist()
    bounds = (x_min, y_min, max(x_max, x_min + 1e-6), max(y_max, y_min + 1e-6))
    size = " x ".join(f"{side:.4g}" for side in np.ptp(points, axis=0))
    picture = _Picture(bounds, f"Mesh from above, {size} mm", len(_remarks(findings)))
    picture.show(corners, ramp((corners[:, :, 2].mean(axis=1) - low) / ((high - low) or 1.0)))
    picture.colour_bar(ramp, f"{low - ground:.3g} mm", f"{high - ground:.3g} mm above the lowest point")
    picture.save(path, picture.mark(findings))


def _draw_layer(picture: "_Picture", plan: Plan, layer: FibreLayer) -> list[Any]:
    """Draw the fibres of a layer with their numbers, at both ends with leads to one side; return the legend's entry."""
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


# Orientation

TURN_DEG = 20.0  # example of the angle of the pad in use under the arm
_WIDTH_MM = 64.0  # width of a panel
_HEIGHT_MM = 56.0  # height of a panel
_HALF_MM = 21.0  # half the side of the mould in a panel
_PANELS = (
    ("1  In the mould", "tracks down, numbers mirrored"),
    ("2  Turned over, left to right", "tracks up, numbers read right: lay here"),
    ("3  In use", "tracks up: this face is pressed"),
)
_NUMBER_MM = 3.6  # text height of the numbers of fibres, and minimum height of those that are cast
_TEXT_MM = 2.7  # other text height
_SLAB_MM = 6.0  # thickness of the pad in the side views, which are not to scale
_TRACK_MM = 1.6  # size of a track there
_WALL_MM = 2.0  # thickness of the mould's walls there


@dataclass(frozen=True)
class _Panel:
    """A view of the pad from above, centred at (x, 0) mm, mirrored first, then rotated counter-clockwise."""

    x: float
    scale: float
    mirrored: bool = False
    turn_deg: float = 0.0

    def project(self, points: ArrayLike) -> Array:
        """Transform points (n, 2) of the plan to points (n, 2) of the drawing, mm."""
        cos, sin = math.cos(math.radians(self.turn_deg)), math.sin(math.radians(self.turn_deg))
        scaled = self.scale * np.asarray(points) * [-1 if self.mirrored else 1, 1]
        return (self.x, 0.0) + scaled @ np.array([[cos, sin], [-sin, cos]])


def draw_orientation(plan: Plan, path: Path) -> None:
    """Draw the pad from above and from the near side: in the mould, turned over, and in use under an arm."""
    scale = _HALF_MM / np.abs(plan.tray.bounds).max()
    poses = ((False, 0.0), (True, 0.0), (True, TURN_DEG))
    panels = [_Panel((column + 0.5) * _WIDTH_MM, scale, *pose) for column, pose in enumerate(poses)]
    bounds = (0.0, -_HEIGHT_MM / 2 - 19, 3 * _WIDTH_MM, _HEIGHT_MM / 2 + 9)
    sentence = drawings.orientation_sentence(plan.pad.layout.counts, plan.settings.pad.leads)
    picture = _Picture(bounds, drawings.ORIENTATION_CAPTION, 0, sentence)
    picture.axes.set_axis_off()
    for panel, (title, note) in zip(panels, _PANELS, strict=True):
        _draw_panel(picture, plan, panel)
        for row, (text, weight) in enumerate(((title, "bold"), (note, "normal"))):
            position = panel.x - _WIDTH_MM / 2 + 4, _HEIGHT_MM / 2 + 6 - 4 * row
            picture.axes.text(*position, text, size=picture.points(_TEXT_MM), weight=weight)
    _draw_arm(picture, panels[2])
    _draw_sides(picture, plan, panels)
    picture.save(path, [])


def _draw_panel(picture: "_Picture", plan: Plan, panel: _Panel) -> None:
    """Draw the pad and its axes in a panel, with every fibre's number outside the pad, beside its start."""
    from matplotlib.patheffects import withStroke

    axes = picture.axes
    if not panel.mirrored:
        axes.fill(*panel.project(plan.tray.exterior.coords).T, color=FAINT)
    for polygon in polygon_rings(plan.silicone):
        for ring in polygon:
            axes.fill(*panel.project(ring).T, facecolor=PAPER, edgecolor=_EDGE, linewidth=0.5)
    for layer in fibre_layers(plan):
        for fibre in layer.fibres:
            line = plan.lines[fibre].simplify(0.05)
            axes.plot(*panel.project(line.coords).T, color=layer.colour, linewidth=1)
    size = min(_NUMBER_MM, 0.6 * plan.min_pitch_mm * panel.scale)
    cast_scale = max(1.0, size / (panel.scale * plan.settings.mould.number_mm)) if plan.numbers else 1.0
    starts, rim = [start for start, _ in plan.leads.pairs], [withStroke(linewidth=2.5, foreground=PAPER)]
    edges = (plan.silicone if panel.mirrored else plan.tray).bounds
    for fibre, (lead, cast) in enumerate(zip(starts, plan.numbers or repeat(None), strict=False)):
        colour = FAMILY_COLOURS[plan.family(fibre)]
        legible = cast and shapely.affinity.scale(cast, cast_scale, cast_scale)  # larger than it is cast
        for outer, *holes in polygon_rings(legible) if legible else ():
            axes.fill(*panel.project(outer).T, color=colour, linewidth=0, gid="cast", zorder=3, path_effects=rim)
            for hole in holes:
                axes.fill(*panel.project(hole).T, color=PAPER, linewidth=0, zorder=3)
        start = lead.turned_mm.copy()
        start[lead.axis] = edges[lead.axis] - (1.2 + size / 2) / panel.scale  # outside the edge
        picture.write(str(fibre + 1), panel.project([start])[0], size, color=colour, weight="bold")
    length = 0.45 * math.sqrt(math.prod(plan.cavity.bounds[2:]))
    for axis, tip in zip("xy", np.eye(2) * length, strict=True):
        start, end, label = panel.project([0 * tip, tip, 1.2 * tip])
        picture.arrow(start, end)
        picture.write(axis, label, _TEXT_MM)


def _draw_arm(picture: "_Picture", panel: _Panel) -> None:
    """Draw the axes of the arm's base beside the pad in use, and the pad's angle to them."""
    corner = np.array([panel.x - _WIDTH_MM / 2 + 4, 2 - _HEIGHT_MM / 2])
    for axis, tip in zip("xy", 9.0 * np.eye(2), strict=True):
        picture.arrow(corner, corner + tip)
        picture.write(axis, corner + 1.2 * tip, _TEXT_MM)
    picture.write("arm", corner + np.array([4.5, 2.5]), _TEXT_MM)
    top = 1.25 * _HALF_MM
    picture.axes.plot([panel.x] * 2, [0, top], ":", color=INK, linewidth=0.8)
    picture.write("pad_angle_deg", (panel.x + 10, top), _TEXT_MM)


def _draw_sides(picture: "_Picture", plan: Plan, panels: Sequence[_Panel]) -> None:
    """Draw cross-sections of all panels at the near side, where fibres start; heights are not to scale."""
    top = -_HEIGHT_MM / 2 - 6
    bottom, half = top - _SLAB_MM, plan.cavity.bounds[2] * panels[0].scale
    floor = bottom - 1.5  # the underside of the mould

    picture.box(panels[0].x - half - _WALL_MM, floor, 2 * (half + _WALL_MM), top - floor, FAINT)
    size = min(_NUMBER_MM, 0.6 * plan.min_pitch_mm * panels[0].scale)
    starts = [(fibre, lead.turned_mm[0]) for fibre, (lead, _) in enumerate(plan.leads.pairs) if lead.axis == 1]
    for panel, y, colour in zip(panels, (bottom, *[top - _TRACK_MM] * 2), (FAINT, "white", ""), strict=True):
        picture.box(panel.x - half, bottom, 2 * half, _SLAB_MM, PAPER)
        for fibre, x_mm in starts:
            x = panel.x + (-x_mm if panel.mirrored else x_mm) * panel.scale
            family = FAMILY_COLOURS[plan.family(fibre)]
            picture.box(x - 0.4, y, 0.8, _TRACK_MM, colour or family)
            picture.write(str(fibre + 1), (x, floor - size), size, color=family)
    x = panels[2].x
    turn = np.linspace(np.pi, 2 * np.pi, 20)
    probe = np.column_stack([x + 2 * np.cos(turn), top + 2 + 2 * np.sin(turn)])
    picture.axes.fill(*np.vstack([(x - 2, top + 5), probe, (x + 2, top + 5)]).T, color=INK)
    picture.axes.plot([x - half - 6, x + half + 6], [bottom] * 2, color=INK, linewidth=1.2)


# Crossing


def draw_crossing(plan: Plan, path: Path) -> None:
    """Draw the section of a pad's narrowest crossing, across the deeper fibre and along the upper one, to scale.

    The pad is turned over, and adhesive covers both fibres.
    """
    fibre_mm, width = plan.settings.fibre.material.diameter_mm, plan.settings.mould.ridge_width_mm
    pairs = [[(plan.depths_mm[plan.layer_indices[k]], k) for k in (c.first, c.second)] for c in plan.crossings]
    narrowest = min(pairs, key=lambda pair: abs(pair[0][0] - pair[1][0]))
    (upper_mm, upper), (lower_mm, lower) = sorted(narrowest)
    half, bottom = 4 * width, -plan.thickness_mm
    picture = _Picture((-2 * half, bottom, 2 * half, -bottom / 6), drawings.CROSSING_CAPTION, 4)
    axes, seal = picture.axes, "#e9dfb8"
    axes.set(xlabel="along the upper fibre (mm)", ylabel="height over the face (mm)")
    handles = picture.box(-2 * half, bottom, 4 * half, -bottom, PAPER, f"silicone, {plan.thickness_mm:g} mm")
    handles += picture.box(-2 * half, -upper_mm, 4 * half, upper_mm, seal, "adhesive")
    picture.box(-width / 2, -lower_mm, width, lower_mm, seal)
    label, colour = f"fibre {upper + 1}, in a track {upper_mm:.3g} mm deep", FAMILY_COLOURS[plan.family(upper)]
    handles += picture.box(-2 * half, -upper_mm, 4 * half, fibre_mm, colour, label)
    angle = np.linspace(0, 2 * np.pi, 60)
    circle = fibre_mm / 2 * np.column_stack([np.cos(angle), np.sin(angle)]) + (0, fibre_mm / 2 - lower_mm)
    label, colour = f"fibre {lower + 1}, in a track {lower_mm:.3g} mm deep", FAMILY_COLOURS[plan.family(lower)]
    handles += axes.fill(*circle.T, facecolor=colour, edgecolor=_EDGE, linewidth=0.5, label=label)
    gap_mm = lower_mm - upper_mm - fibre_mm
    if gap_mm > 0:
        axes.plot([width, width], [-upper_mm, -lower_mm + fibre_mm], "|-", color=INK, linewidth=1)
        axes.text(1.3 * width, (fibre_mm - upper_mm - lower_mm) / 2, f"{gap_mm:.2g} mm", va="center", color=INK)
    picture.save(path, handles)


# Toolpath


def draw_toolpath(plan: Plan, steps: Sequence[Step], path: Path) -> None:
    """Draw the toolpath of the needle on the pad turned over, and the order of the fibres.

    A ring with the fibre's number marks where it is fastened, a dot with its turn where it is cut. Travel moves are
    dashed, and the needle's box is red.
    """
    strokes, dispenser = [stroke for step in steps for stroke in step.strokes], plan.settings.dispenser
    points = np.vstack([stroke.positions_mm for stroke in strokes])
    (x_min, y_min), (x_max, y_max) = (points.min(axis=0) - 6).tolist(), (points.max(axis=0) + 6).tolist()
    note = (
        "The pad lies turned over, tracks up, seen from above. Ring: number of the fibre, fasten it. Dot: its turn, cut"
        f" it. Dashed: at z = {dispenser.travel_height_mm:g} mm. Red: the needle's box."
    )
    picture = _Picture((x_min, y_min, x_max, y_max), "The needle's toolpath, from above", len(steps), note)
    axes = picture.axes
    for ring in (ring for polygon in polygon_rings(plan.silicone) for ring in polygon):
        axes.fill(*mirror_x(ring).T, facecolor="none", edgecolor=_EDGE, linewidth=0.8)
    (x0, x1), (y0, y1) = np.reshape(dispenser.box_mm[:4], (2, 2)) - np.reshape(dispenser.origin_mm, (2, 1))
    axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=ALARM, linewidth=1.6, label="box")
    axes.plot(0, 0, "+", color=INK, ms=12)
    for cut, fastened in pairwise(strokes):
        ends = np.array([cut.positions_mm[-1], fastened.positions_mm[0]])
        axes.plot(*ends.T, "--", color=FAINT, linewidth=0.8, label="travel")
    handles = []
    for number, step in enumerate(steps, 1):
        depth, z = f"{step.layer.depth_mm:.3g} mm deep", round(step.strokes[0].z_mm, 3)
        label = f"{number}. {FAMILIES[step.layer.family]}, {depth}, z = {z:g} mm"
        style = {"color": step.layer.colour, "linewidth": 1.2, "label": label}
        lines = [axes.plot(*stroke.positions_mm.T, **style)[0] for stroke in step.strokes]
        handles.append(lines[0])
    for turn, stroke in enumerate(strokes, 1):
        start, end = stroke.positions_mm[[0, -1]]
        start_offset, end_offset = (2.5 * mirror_x(lead.outward) for lead in plan.leads.pairs[stroke.fibre])
        axes.plot(*start, "o", mfc="none", mec=INK, ms=6)
        axes.plot(*end, "o", color=INK, ms=3)
        picture.write(str(stroke.fibre + 1), start + start_offset, 2.5)
        picture.write(f"{turn}.", end + end_offset, 2.5)
    picture.save(path, handles)


def _remarks(findings: Sequence[Finding]) -> list[Finding]:
    """Return the findings with positions, failures before warnings."""
    remarks = [finding for finding in findings if finding.status != "pass" and finding.positions_mm]
    return sorted(remarks, key=lambda finding: finding.status)


class _Picture:
    """A figure whose axes cover `bounds` (x_min, y_min, x_max, y_max), mm, with a legend and a note below."""

    def __init__(self, bounds: drawings.Bounds, title: str, n_entries: int, note: str = "") -> None:
        from matplotlib.figure import Figure

        x_min, y_min, x_max, y_max = bounds
        scale = PIXELS / max(x_max - x_min, y_max - y_min)
        axes_width, axes_height = (max(1, round(scale * side)) for side in (x_max - x_min, y_max - y_min))
        width = _MARGIN_LEFT + max(axes_width, 600) + _MARGIN_RIGHT  # at least 600 pixels for title and legend
        self.note = textwrap.wrap(note, int((width - _MARGIN_LEFT) / 6.2))  # mean width of a letter, pixels
        legend = 21 * math.ceil(n_entries / _COLUMNS) + 6 * (n_entries > 0)  # 21 pixels a row
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
        x_min, x_max, *_ = self.extent
        return length_mm * self.pixels[0] / (x_max - x_min) * 72 / _DPI

    def show(self, corners: Array, colours: ArrayLike) -> None:
        """Draw triangles (m, 3, 3), mm, from above in their colours (m,); vertical ones are lines."""
        from matplotlib.collections import PolyCollection
        from matplotlib.colors import to_rgba_array

        faces = to_rgba_array(colours)
        edges = np.where(np.abs(unit_normals(corners)[:, 2:]) < _FLAT, to_rgba_array(_EDGE), faces)
        order = np.argsort(corners[:, :, 2].mean(axis=1), kind="stable")  # painter's algorithm: the lowest first
        style = {"facecolors": faces[order], "edgecolors": edges[order], "linewidths": 0.3}
        self.axes.add_collection(PolyCollection(list(corners[order, :, :2]), **style), autolim=False)

    def mark(self, findings: Sequence[Finding]) -> list[Any]:
        """Mark the positions of the findings that fail or warn; return the legend's entries."""
        styles = {"fail": (ALARM, iter(_FAIL_MARKS)), "warn": (CARE, iter(_WARN_MARKS))}
        handles = []
        for finding in _remarks(findings):
            colour, markers = styles[finding.status]
            marker, positions = next(markers, "X"), np.array(finding.positions_mm).T
            label = f"{finding.status}: {finding.name} ({len(finding.positions_mm)})"
            style = {"marker": marker, "mfc": "none", "linestyle": "none", "ms": 10, "zorder": 5}
            self.axes.plot(*positions, mec="white", mew=3.4, **style)  # a rim around the mark
            handles += self.axes.plot(*positions, mec=colour, mew=1.5, label=label, **style)
        return handles

    def write(self, text: str, position: Sequence[float] | Array, height_mm: float, **style: Any) -> None:
        x, y = position
        self.axes.text(x, y, text, **{"size": self.points(height_mm), "ha": "center", "va": "center", **style})

    def box(self, x: float, y: float, width: float, height: float, colour: str, label: str = "") -> list[Any]:
        """Draw a rectangle from its lower left corner, mm; return its entry for the legend."""
        corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]
        return self.axes.fill(*np.transpose(corners), facecolor=colour, edgecolor=_EDGE, linewidth=0.5, label=label)

    def arrow(self, start: Array, end: Array) -> None:
        for colour, width in (("white", 3.5), (INK, 1.2)):
            style = {"arrowstyle": "->", "color": colour, "linewidth": width, "shrinkA": 0, "shrinkB": 0}
            self.axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops=style)

    def scale_bar(self) -> None:
        x_max, y = self.extent[1], -46 / self.pixels[1]
        transform = self.axes.get_xaxis_transform()
        style = {"color": INK, "clip_on": False, "transform": transform}
        self.axes.plot([x_max - drawings.SCALE_MM, x_max], [y, y], "|-", linewidth=1.2, ms=8, **style)
        self.axes.annotate(
            f"{drawings.SCALE_MM:g} mm", (x_max - drawings.SCALE_MM, y), (-8, 0), xycoords=transform,
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
        from padforge.common.plotting import save_figure

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
