"""Plan of a mould: centre lines, ridge outlines, fibre layers, numbers, pillars and tray, in mm.

The frame is the pad's: x and y from its centre (`Morphology.to_mm`), as it lies in the tray with its tracks down. When
the pad is turned over for fibre placement and use, the tracks are the mirror image of the plan. Lengths are the nominal
ones of the finished pad; if the silicone shrinks, the mould has another plan (`Plan.shrinkage_compensated`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from padforge.common.plotting import FAMILY_COLOURS
from padforge.common.validation import InputError, check_type
from padforge.design.morphology import Array, Morphology
from padforge.design.paths import curves
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import FAMILIES, Layout, is_hole
from padforge.fabricate.leads import Leads, lead_spacing, one_side_leads, straight_leads
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

INTO_WALL_MM = 0.5
"""Depth of ridges in the walls: the tracks open to the pad's sides, and no two faces of the mould coincide."""
COVER_MM = 1.0
"""Minimum silicone between the deepest track and the far face; a pad of more than two layers is made thicker for it."""
SNAP_MM = 1e-4
"""Grid to which areas are snapped by Boolean operations, mm.

No edge of the solid is shorter; and without a grid, outlines that almost coincide can defeat the operation."""
_CENTRE_SHARE = 0.2  # fraction of the tolerance for centre lines
_ARC_SHARE = 0.2  # fraction of the tolerance for arcs
_OUTLINE_SHARE = 0.6  # fraction for simplifying outlines, the largest since it determines the size of all files
_NUMBER_STEP_MM = 0.5  # grid of candidate positions for a number
_NUMBER_TRIES = 50  # candidates that are tested together; most numbers fit at one of the first
_AT_WALL_MM = 1e-3  # distance up to which a pillar touches a wall


def assign_layers(
    counts: tuple[int, int], clashes: Sequence[curves.Crossing], deep_horizontal: bool
) -> tuple[int, ...]:
    """Compute the layer index of every fibre, 0 the shallowest, by colouring the graph of crossings within a family.

    If `deep_horizontal`, horizontals get the higher indices, otherwise verticals.
    """
    horizontal, vertical = range(counts[0]), range(counts[0], sum(counts))
    layers: dict[int, int] = {}
    for family in (vertical, horizontal) if deep_horizontal else (horizontal, vertical):
        first = 1 + max(layers.values(), default=-1)
        colours = dict.fromkeys(family, 0)
        edges = {(c.first, c.second) for c in clashes if c.first in colours and c.second in colours}
        if edges:
            import networkx

            colours |= networkx.greedy_color(networkx.Graph(sorted(edges)), strategy="DSATUR")
        layers |= {fibre: first + colour for fibre, colour in colours.items()}
    return tuple(layers[fibre] for fibre in range(sum(counts)))


_TOP = ((0.0, 0.82), (0.13, 1.0), (0.37, 1.0), (0.5, 0.82))
_BOTTOM = ((0.5, 0.18), (0.37, 0.0), (0.13, 0.0), (0.0, 0.18))
_MIDDLE = ((0.5, 0.66), (0.36, 0.53), (0.5, 0.4))
_DIGITS = (
    ((*_TOP, *_BOTTOM, (0.0, 0.82)),),
    (((0.02, 0.78), (0.28, 1.0), (0.28, 0.0)),),
    ((*_TOP, (0.5, 0.66), (0.0, 0.0), (0.5, 0.0)),),
    ((*_TOP, *_MIDDLE, *_BOTTOM), ((0.2, 0.53), (0.36, 0.53))),
    (((0.36, 0.0), (0.36, 1.0), (0.0, 0.3), (0.5, 0.3)),),
    (((0.46, 1.0), (0.04, 1.0), (0.0, 0.55), (0.14, 0.63), (0.36, 0.63), (0.5, 0.46), *_BOTTOM),),
    (((0.36, 1.0), (0.0, 0.42), (0.0, 0.18), *_BOTTOM[2:0:-1], (0.5, 0.18), (0.5, 0.42), (0.37, 0.56), (0.18, 0.56)),),
    (((0.0, 1.0), (0.5, 1.0), (0.16, 0.0)),),
    ((*_TOP, *_MIDDLE, *_BOTTOM, (0.0, 0.4), (0.14, 0.53), (0.0, 0.66), (0.0, 0.82)), ((0.14, 0.53), (0.36, 0.53))),
    (((0.5, 0.0), *_TOP[::-1], (0.0, 0.6), (0.13, 0.44), (0.35, 0.44), (0.43, 0.52)),),
)
"""Strokes of digits, 1 high and 0.5 wide; no digit equals another one mirrored or upside down."""


def draw_number(number: int, height_mm: float, width_mm: float) -> BaseGeometry:
    """Return the outline of a number, centred, and mirrored so that it is legible on the casting.

    A bar under the digits shows their foot and connects them; `height_mm` is from the centre lines of the top
    strokes to that of the bar.
    """
    digit_mm = max(height_mm - width_mm, height_mm / 2)
    advance_mm = digit_mm / 2 + width_mm + max(width_mm, 0.25 * digit_mm)
    digits = str(number)
    strokes = [
        digit_mm * np.array(stroke) + [position * advance_mm, 0]
        for position, digit in enumerate(digits)
        for stroke in _DIGITS[int(digit)]
    ]
    bar = np.array([(0, -width_mm), ((len(digits) - 1) * advance_mm + digit_mm / 2, -width_mm)])
    lines = list(map(shapely.LineString, [*strokes, bar]))
    style: dict[str, Any] = {"cap_style": "square", "join_style": "mitre", "mitre_limit": 1.5}
    outline = shapely.union_all(shapely.buffer(lines, width_mm / 2, **style))
    x_min, y_min, x_max, y_max = outline.bounds
    centred = affinity.translate(outline, -(x_min + x_max) / 2, -(y_min + y_max) / 2)
    return affinity.scale(centred, xfact=-1, origin=(0, 0))


def _position_numbers(plan: "Plan", numbers: Sequence[BaseGeometry]) -> list[BaseGeometry | None]:
    """Move each centred number to the nearest free position beside its fibre's start; None if there is none.

    Candidates lie on a grid in the cavity, inwards from the start and half as far to either side of it, up to a pitch
    or five heights of a number. They are free if clear of walls, pillars, ridges and other numbers.
    """
    mould, lines = plan.settings.mould, plan.lines
    clearance = mould.ridge_width_mm / 2 + plan.heights_mm[-1] * plan.settings.ridge_slope + mould.min_silicone_mm
    reach = min(plan.min_pitch_mm, 5 * mould.number_mm)
    floor, occupied = plan.cavity.difference(plan.feet).buffer(-clearance, join_style="mitre"), []
    shapely.prepare([*lines, floor])
    positioned: list[BaseGeometry | None] = []
    depths, shifts = np.arange(0, reach, _NUMBER_STEP_MM), np.arange(-reach / 2, reach / 2, _NUMBER_STEP_MM)
    depth, shift = (grid.ravel() for grid in np.meshgrid(depths, shifts))
    nearest_first = np.argsort(np.hypot(depth, shift), kind="stable")
    for number, line in zip(numbers, lines, strict=True):
        start, second = np.array(line.coords[:2])
        inward = np.sign(second - start)  # along an axis: lines leave the walls at right angles
        start = np.where(inward > 0, plan.cavity.bounds[:2], start)
        middles = (start + depth[:, None] * inward + shift[:, None] * inward[::-1])[nearest_first]
        half = np.array(number.bounds[2:])
        middle = _find_free(middles, half, floor, [*lines, *occupied], clearance)
        if middle is not None:
            occupied.append(shapely.box(*(middle - half), *(middle + half)))
        positioned.append(None if middle is None else affinity.translate(number, *middle))
    return positioned


def _find_free(
    middles: Array, half: Array, floor: BaseGeometry, obstacles: Sequence[BaseGeometry], clearance: float
) -> Array | None:
    """Return the first of `middles` (n, 2) whose box, with half sides (2,), is on the floor and clear, or None."""
    for batch in np.split(middles, range(_NUMBER_TRIES, len(middles), _NUMBER_TRIES)):
        boxes = shapely.box(*(batch - half).T, *(batch + half).T)
        is_free = shapely.contains(floor, boxes)
        for obstacle in obstacles:
            is_free[is_free] = ~shapely.dwithin(obstacle, boxes[is_free], clearance)
        if is_free.any():
            return batch[np.argmax(is_free)]
    return None


class CommonTrack(NamedTuple):
    """A stretch of a track that lies over a deeper one, so that it has no floor of silicone."""

    shallow: int  # index of the upper fibre
    deep: int  # index of the fibre below it
    length_mm: float  # over which the centre lines are closer than a track's width
    position_mm: tuple[float, float]  # middle of the stretch


@dataclass(frozen=True)
class Plan:
    """A morphology with the settings of its mould; derived quantities are computed on first use.

    Attributes:
        pad: morphology of the pad.
        settings: tray, ridges, printer and materials.
        nominal: plan of the finished pad, if this one is compensated for shrinkage.

    Raises:
        InputError: settings contradict each other or the pitch, or keep-outs do not fit the pad.
    """

    pad: Morphology
    settings: FabricationSettings = DEFAULTS
    nominal: "Plan | None" = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_type("pad", self.pad, Morphology)
        check_type("settings", self.settings, FabricationSettings).require_consistent(self.pad.layout)
        if self.settings.pad.keep_out_mm and self.nominal is None:
            keep_outs(self.settings.pad.for_layout(self.pad.layout))  # raises

    @cached_property
    def shrinkage_compensated(self) -> "Plan":
        """The plan of the printed mould, enlarged by the silicone's shrinkage; this plan if there is none.

        Heights are whole layers; see `FabricationSettings.shrinkage_compensated`.
        """
        factor = self.settings.shrinkage_factor
        if factor == 1:
            return self
        layout = self.pad.layout
        larger = Layout(*layout.counts, layout.pitch_x_mm / factor, layout.pitch_y_mm / factor)
        pad = Morphology.from_dict({**self.pad.to_dict(), "pitch_mm": larger.pitch_mm})
        return Plan(pad, self.settings.shrinkage_compensated(), self)

    @cached_property
    def depths_mm(self) -> tuple[float, ...]:
        """Depth of the tracks of every layer in the finished pad, ascending, mm."""
        factor = self.settings.shrinkage_factor
        return tuple(round(factor * height, 9) for height in self.shrinkage_compensated.heights_mm)

    @property
    def thickness_mm(self) -> float:
        """Thickness of the finished pad, mm."""
        return round(self.settings.shrinkage_factor * self.shrinkage_compensated.silicone_mm, 9)

    @cached_property
    def lines(self) -> list[shapely.LineString]:
        """Centre line of every fibre with its leads into the wall, within a fifth of the tolerance, mm."""
        tolerance_mm = _CENTRE_SHARE * self.settings.mould.tolerance_mm
        return [shapely.LineString(path) for path in self.paths(tolerance_mm, INTO_WALL_MM)]

    def paths(self, tolerance_mm: float, past_mm: float) -> list[Array]:
        """Flatten every fibre with its leads; corners (n, 2), mm.

        Args:
            tolerance_mm: tolerance against the curves.
            past_mm: length of the paths beyond the outer ends of the exits.
        """
        past = self.settings.mould.exit_mm, past_mm
        lines = curves.flatten(self.pad, tolerance_mm / self.pad.unit_mm)
        paths = []
        for (start, end), line in zip(self.leads.pairs, lines, strict=True):
            bends = start.flatten_bends(tolerance_mm)[::-1], end.flatten_bends(tolerance_mm)
            ends = start.point_past_edge(*past), end.point_past_edge(*past)
            paths.append(np.vstack([ends[0], bends[0], self.pad.to_mm(line), bends[1], ends[1]]))
        return paths

    def trace(self, step: float, past_mm: float) -> list[tuple[Array, Array]]:
        """Sample every fibre with its leads: points (n, 2), mm, and exact headings (n,), radians, unwrapped.

        A point at which a fibre turns abruptly, where it meets a lead, occurs twice.

        Args:
            step: maximum turn between successive points, radians.
            past_mm: length beyond the outer ends of the exits.
        """
        out = self.settings.mould.exit_mm + past_mm
        traces = []
        shapes = zip(curves.beziers(self.pad), curves.slope_beziers(self.pad), strict=True)
        for fibre, (spans, slopes) in enumerate(shapes):
            points, headings = curves.trace_curve(spans, slopes, step)
            (start, start_headings), (end, end_headings) = (lead.trace(step, out) for lead in self.leads.pairs[fibre])
            headings = np.pi / 2 - headings if self.family(fibre) else headings
            headings = np.concatenate([start_headings[::-1] + np.pi, headings, end_headings])
            traces.append((np.vstack([start[::-1], self.pad.to_mm(points), end]), np.unwrap(headings)))
        return traces

    @cached_property
    def leads(self) -> Leads:
        """The leads of every fibre from its ends to the silicone's edge."""
        pad, mould = self.pad, self.settings.mould
        ends = pad.to_mm(pad.knots[:, [0, -1]])
        if self.settings.pad.leads == "edges":
            return straight_leads(ends, pad.layout, mould.border_mm)
        if self.nominal is not None:
            return self.nominal.leads.scaled(1 / self.nominal.settings.shrinkage_factor)
        return one_side_leads(ends, pad.layout, lead_spacing(self.settings, self.heights_mm[-1], self.flare_mm))

    @cached_property
    def lengths_mm(self) -> Array:
        """Length of every fibre within the silicone, exits included; shape (F,)."""
        leads = [start.length_mm + end.length_mm for start, end in self.leads.pairs]
        return curves.lengths(self.pad) * self.pad.unit_mm + leads + 2 * self.settings.mould.exit_mm

    @property
    def min_pitch_mm(self) -> float:
        """The smaller of the two pitches."""
        return min(self.pad.layout.pitch_x_mm, self.pad.layout.pitch_y_mm)

    def family(self, fibre: int) -> int:
        """Return the family of a fibre: 0 horizontal, 1 vertical.

        Args:
            fibre: index among all fibres.
        """
        return self.pad.layout.family(fibre)

    @cached_property
    def crossings(self) -> list[curves.Crossing]:
        """Crossings of all fibres, with positions in grid units."""
        return curves.crossings(self.pad, self.settings.mould.tolerance_mm / self.pad.unit_mm)

    @cached_property
    def clashes(self) -> list[curves.Crossing]:
        """The crossings within a family."""
        return [c for c in self.crossings if self.family(c.first) == self.family(c.second)]

    @property
    def clash_positions_mm(self) -> Array:
        """Positions of the clashes; shape (n, 2)."""
        return self.pad.to_mm(np.array([c.position for c in self.clashes]).reshape(-1, 2))

    def require_levels(self) -> None:
        """Check that `[mould] levels` allows for the crossings of the pad.

        Raises:
            InputError: lists the crossings of fibres of one family.
        """
        if self.clashes and self.settings.mould.levels == "two":
            listed = ", ".join(
                f"{c.first + 1} x {c.second + 1} at ({x:z.1f}, {y:z.1f}) mm"
                for c, (x, y) in zip(self.clashes, self.clash_positions_mm.tolist(), strict=True)
            )
            raise InputError(
                f'[mould] levels: got "two", allowed for pads without crossings of one family, or "as_needed"; '
                f"{len(self.clashes)} crossings: fibres {listed}"
            )

    @cached_property
    def layer_indices(self) -> tuple[int, ...]:
        """Layer of every fibre, 0 the shallowest; different for fibres that cross, if the settings allow that."""
        clashes = self.clashes if self.settings.mould.levels == "as_needed" else []
        return assign_layers(self.pad.layout.counts, clashes, self.settings.pad.deep_family == "horizontal")

    @cached_property
    def layers(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the fibres of every layer, ascending, the shallowest layer first."""
        fibres = list(enumerate(self.layer_indices))
        layers = range(1 + max(self.layer_indices))
        return tuple(tuple(fibre for fibre, index in fibres if index == layer) for layer in layers)

    @cached_property
    def common_tracks(self) -> list[CommonTrack]:
        """Stretches in which tracks of different depths lie over each other, leads included."""
        stretches = []
        for layer, shallow in enumerate(self.layers[:-1]):
            deep = [fibre for fibre, index in enumerate(self.layer_indices) if index > layer]
            lines = [[shapely.get_coordinates(self.lines[fibre]) for fibre in fibres] for fibres in (shallow, deep)]
            shared = curves.common_stretches(*lines, self.settings.mould.ridge_width_mm)
            for line, other, start, end in zip(shared.line, shared.other, shared.begin, shared.end, strict=True):
                middle = self.lines[shallow[line]].interpolate((start + end) / 2)
                stretches.append(CommonTrack(shallow[line], deep[other], float(end - start), (middle.x, middle.y)))
        return stretches

    @cached_property
    def heights_mm(self) -> tuple[float, ...]:
        """Ridge height of every layer, ascending, mm above the tray's floor.

        The lowest is that of the shallow family if the pad has one, else that of the deep one: a design assumes the
        same depth of a family with and without the other.
        """
        mould = self.settings.mould
        has_shallow = self.pad.layout.counts[self.settings.pad.deep_family == "horizontal"] > 0
        lowest_mm = mould.shallow_ridge_height_mm if has_shallow else mould.deep_ridge_height_mm
        return tuple(round(lowest_mm + layer * mould.level_step_mm, 9) for layer in range(len(self.layers)))

    @cached_property
    def silicone_mm(self) -> float:
        """Thickness of the cast silicone, mm: as set, or more if many layers need it."""
        mould, highest_mm = self.settings.mould, self.heights_mm[-1]
        return max(mould.silicone_mm, highest_mm + COVER_MM if highest_mm > mould.deep_ridge_height_mm else 0)

    def outline(self, fibres: Sequence[int], below_mm: float = 0.0, tolerance_mm: float | None = None) -> BaseGeometry:
        """Return the outline of the ridges of some fibres, mm, with their ends inside the walls.

        Args:
            fibres: indices of the fibres.
            below_mm: distance of the outline below the ridges' tops.
            tolerance_mm: maximum deviation; None for that of the settings.
        """
        mould = self.settings.mould
        tolerance = mould.tolerance_mm if tolerance_mm is None else tolerance_mm
        half = mould.ridge_width_mm / 2 + below_mm * self.settings.ridge_slope
        chord = 2 * math.acos(1 - _ARC_SHARE * tolerance / half)
        lines = self.lines
        if tolerance_mm is not None:
            lines = [shapely.LineString(path) for path in self.paths(_CENTRE_SHARE * tolerance_mm, INTO_WALL_MM)]
        lines = [lines[fibre] for fibre in fibres]
        bands = shapely.buffer(lines, half, quad_segs=math.ceil(math.pi / 2 / chord), cap_style="flat")
        return shapely.union_all(bands).simplify(_OUTLINE_SHARE * tolerance)

    @cached_property
    def ridges(self) -> tuple[BaseGeometry, ...]:
        """Outlines of the tops of the ridges of every layer, mm."""
        return tuple(map(self.outline, self.layers))

    @cached_property
    def numbers(self) -> list[BaseGeometry | None]:
        """Mirrored number of every fibre, from 1, beside its start; None if it does not fit; [] if disabled."""
        height, width = self.settings.mould.number_mm, self.settings.mould.ridge_width_mm
        numbers = range(1, self.pad.layout.fibres + 1)
        return _position_numbers(self, [draw_number(n, height, width) for n in numbers]) if height else []

    @cached_property
    def cavity(self) -> shapely.Polygon:
        """Rectangle between the walls at the floor, without the exits, mm; pillars stand in it."""
        return shapely.box(*self.leads.bounds_mm)

    @cached_property
    def exits(self) -> list[shapely.Polygon]:
        """Slots in the wall around both ends of every fibre, mm: in the order of the fibres, starts first.

        They begin inside the cavity, so that no faces coincide.
        """
        mould = self.settings.mould
        half = mould.exit_width_mm / 2
        leads = [pair[end] for end in (0, 1) for pair in self.leads.pairs] if mould.exit_mm else []
        return [self.leads.box_at_edge(lead, half, -half, mould.exit_mm) for lead in leads]

    @cached_property
    def pillars(self) -> BaseGeometry:
        """Outlines of the keep-outs' pillars, up to the rim, mm, extended into the walls that they touch.

        Since walls lean outwards, a film of silicone would remain between a wall and a pillar that ends at its foot.
        """
        if not self.settings.pad.keep_out_mm:
            return shapely.MultiPolygon()
        into_mm = self.flare_mm + INTO_WALL_MM
        shapes = self.settings.pad.keep_out_mm
        discs = [self._disc(*each[:3]) if is_hole(each) else shapely.Polygon(each) for each in shapes]
        outlines = shapely.union_all(discs).intersection(self.cavity.buffer(into_mm, join_style="mitre"))
        low, high = np.reshape(self.cavity.bounds, (2, 2))
        for axis in (0, 1):  # in sequence, so that corners are filled as well
            outlines = shapely.union_all([outlines, *_wall_extensions(outlines, low, high, axis, into_mm)])
            low[axis], high[axis] = low[axis] - into_mm, high[axis] + into_mm
        return areas(shapely.set_precision(outlines, SNAP_MM))

    def _disc(self, x: float, y: float, diameter_mm: float) -> shapely.Polygon:
        """Return the outline of a round hole, mm."""
        radius = diameter_mm / 2
        chord = 2 * math.acos(max(0.5, 1 - _ARC_SHARE * self.settings.mould.tolerance_mm / radius))
        return shapely.Point(x, y).buffer(radius, quad_segs=math.ceil(math.pi / 2 / chord))

    @cached_property
    def heads(self) -> list[shapely.Polygon]:
        """Outlines of the countersunk heads of screws, mm."""
        holes = [keep_out for keep_out in self.settings.pad.keep_out_mm if is_hole(keep_out)]
        return [self._disc(hole[0], hole[1], hole[3]) for hole in holes if len(hole) > 3]

    @property
    def head_mm(self) -> float:
        """Depth to which the heads of screws sink into the pad, mm: half of its thickness."""
        return self.silicone_mm / 2

    @cached_property
    def feet(self) -> BaseGeometry:
        """Outlines of the pillars at the floor, mm, widened by the heads of screws."""
        return shapely.union_all([self.pillars, *self.heads])

    @cached_property
    def silicone(self) -> BaseGeometry:
        """Area that the silicone fills at the floor, exits included, mm."""
        area = shapely.union_all([self.cavity, *self.exits])
        return without(area, self.feet) if self.feet.area else area

    @property
    def flare_mm(self) -> float:
        """Outward lean of the walls from the floor to their top, mm."""
        return self.silicone_mm * math.tan(math.radians(self.settings.mould.wall_draft_deg))

    @property
    def corner_mm(self) -> float:
        """Side of the solid square between a corner of the cavity's rim and that of the tray, mm."""
        return self.settings.mould.exit_mm + self.settings.mould.wall_mm

    @cached_property
    def tray(self) -> shapely.Polygon:
        """Outline of the mould, walls included, mm."""
        return offset_box(self.cavity, self.flare_mm, self.corner_mm)


def _wall_extensions(
    outlines: BaseGeometry, low: Array, high: Array, axis: int, into_mm: float
) -> list[shapely.Polygon]:
    """Return boxes that extend outlines into the walls they touch, at `low` and `high` (2,) along an axis."""
    extensions = []
    for edge, outward in ((low[axis], -1), (high[axis], 1)):
        strip = np.stack([low, high])
        strip[:, axis] = sorted((edge - outward * _AT_WALL_MM, edge))
        for contact in shapely.get_parts(outlines.intersection(shapely.box(*strip.ravel()))):
            box = np.reshape(contact.bounds, (2, 2))
            box[:, axis] = sorted((edge - outward * _AT_WALL_MM, edge + outward * into_mm))
            extensions.append(shapely.box(*box.ravel()))
    return extensions


def overlap(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """Compute the intersection of two areas, snapped to `SNAP_MM`."""
    return areas(shapely.intersection(first, second, grid_size=SNAP_MM))


def without(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """Compute the difference of two areas, snapped to `SNAP_MM`."""
    return areas(shapely.difference(first, second, grid_size=SNAP_MM))


def areas(shape: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a shape; snapping creates lines and points where areas barely touch."""
    parts = shapely.get_parts(shape)
    return shapely.MultiPolygon(parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON].tolist())


def polygon_rings(area: BaseGeometry) -> list[list[np.ndarray]]:
    """Return the rings (n, 2) of each polygon of an area, outer first, without the repeated last point.

    Outer rings run counter-clockwise and holes clockwise: the polygon lies to the left of every edge.
    """
    polygons = shapely.orient_polygons(shapely.get_parts(area))
    return [[shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(polygon)] for polygon in polygons]


def offset_box(area: BaseGeometry, *out_mm: float) -> shapely.Polygon:
    """Return the bounding rectangle of an area, offset outwards by one distance after the other, mm."""
    x_min, y_min, x_max, y_max = area.bounds
    for out in out_mm:
        x_min, y_min, x_max, y_max = x_min - out, y_min - out, x_max + out, y_max + out
    return shapely.box(x_min, y_min, x_max, y_max)


@dataclass(frozen=True)
class FibreLayer:
    """The fibres of one depth, all of one family."""

    family: int  # 0 horizontal, 1 vertical
    index: int  # of the layer, as in `Plan.layer_indices`
    depth_mm: float  # of the tracks in the casting
    fibres: tuple[int, ...]  # indices, 0..F-1
    colour: str  # "#rrggbb", that of the family for its deepest layer, and paler for shallower ones

    @property
    def name(self) -> str:
        """Id of the layer in a drawing, such as "horizontal-1.2"."""
        return f"{FAMILIES[self.family]}-{self.depth_mm:g}"


def fibre_layers(plan: Plan) -> list[FibreLayer]:
    """Return the layers of a plan in the order of fibre placement, the deepest first."""
    families = [plan.family(fibres[0]) for fibres in plan.layers]
    layers = []
    for index, family in enumerate(families):
        white = 0.7 * families[index + 1 :].count(family) / families.count(family)  # lines must not be too pale
        tint = bytes(round(value + white * (255 - value)) for value in bytes.fromhex(FAMILY_COLOURS[family][1:]))
        colour = f"#{tint.hex()}"
        layers.append(FibreLayer(family, index, plan.depths_mm[index], plan.layers[index], colour))
    return layers[::-1]
