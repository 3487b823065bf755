"""Plan of a mould: centre lines, ridge outlines, layers of fibres, numbers, pillars and tray, in mm.

The frame is the pad's: x and y from its centre (`Morphology.to_mm`), as it lies in the tray with its tracks down.
Turned over for fibre placement and use, the tracks are the mirror image of the plan. Lengths are those of the pad as it
is used; where the silicone shrinks, the mould has a plan of its own."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import HORIZONTAL, VERTICAL
from padforge.design.common.validation import InputError, check_type
from padforge.design.morphology import Array, Morphology
from padforge.design.paths.curves import (
    Crossing,
    beziers,
    common_stretches,
    crossings,
    flatten,
    lengths,
    slope_beziers,
    trace_curve,
)
from padforge.design.paths.keep_outs import keep_outs
from padforge.design.settings import Layout
from padforge.fabricate.leads import Lead, Leads, straight_on, to_one_side
from padforge.fabricate.settings import DEFAULTS, FabricationSettings


def fibre_levels(counts: tuple[int, int], clashes: Sequence[Crossing], deep_horizontal: bool) -> tuple[int, ...]:
    """(H + V,) level of every fibre, 0 the shallowest; the deep family has the upper ones.

    Args:
        counts: H and V.
        clashes: crossings of fibres of one family, in any order.
        deep_horizontal: whether horizontals are the deep family.
    """
    horizontal, vertical = range(counts[0]), range(counts[0], sum(counts))
    shallow, deep = (vertical, horizontal) if deep_horizontal else (horizontal, vertical)
    level = _coloured(shallow, clashes)
    below = 1 + max(level.values(), default=-1)
    level |= {fibre: below + colour for fibre, colour in _coloured(deep, clashes).items()}
    return tuple(level[fibre] for fibre in range(sum(counts)))


def _coloured(family: Iterable[int], clashes: Sequence[Crossing]) -> dict[int, int]:
    """A colour, 0.., for every fibre of a family, different for any two that cross."""
    colours = dict.fromkeys(family, 0)
    edges = {(c.first, c.second) for c in clashes if c.first in colours and c.second in colours}
    if edges:
        import networkx

        graph = networkx.Graph(sorted(edges))
        colours |= networkx.greedy_color(graph, strategy="DSATUR")
    return colours


_CORNERS = {"a": "TLTR", "b": "TRMR", "c": "MRBR", "d": "BLBR", "e": "MLBL", "f": "TLML", "g": "MLMR"}
_HEIGHT, _SIDE = {"T": 1.0, "M": 0.5, "B": 0.0}, {"L": 0.0, "R": 0.5}
_STROKES = ("abcdef", "bc", "abged", "abgcd", "fgbc", "afgcd", "afgedc", "abc", "abcdefg", "abcdfg")
"""The strokes of the digits 0 to 9, of seven."""
_SEARCH_MM = 0.5
"""Spacing of the places that are tried for a number."""


def number_strokes(number: int, height_mm: float, width_mm: float) -> BaseGeometry:
    """A number's outline, mm, middle at (0, 0), mirrored left to right: a casting is read from the other side.

    Args:
        height_mm: of the digits, centre line to centre line. width_mm: of their strokes.
    """
    advance = 0.5 + (width_mm + max(width_mm, 0.25 * height_mm)) / height_mm
    strokes = []
    for place, digit in enumerate(str(number)):
        for stroke in _STROKES[int(digit)]:
            ends = _CORNERS[stroke]
            points = [(place * advance + _SIDE[ends[i + 1]], _HEIGHT[ends[i]]) for i in (0, 2)]
            strokes.append(np.array(points) * height_mm)
    outline = shapely.union_all(shapely.buffer(shapely.linestrings(strokes), width_mm / 2, cap_style="square"))
    left, low, right, high = outline.bounds
    return affinity.scale(affinity.translate(outline, -(left + right) / 2, -(low + high) / 2), xfact=-1, origin=(0, 0))


def with_room(
    numbers: Sequence[BaseGeometry],
    lines: Sequence[shapely.LineString],
    area: BaseGeometry,
    bounds: tuple[float, float, float, float],
    clear_mm: float,
    reach_mm: float,
) -> list[BaseGeometry | None]:
    """The numbers on the floor, each beside the start of its own line; None where there is no room.

    Args:
        numbers: outlines with their middles at (0, 0). lines: centre lines of their ridges.
        area: that is free of walls and pillars. bounds: of what is between the walls.
        clear_mm: from a ridge's middle to writing, at least.
        reach_mm: how far into the pad, and within half of it to either side of the line's start, a number may lie.
    """
    shapely.prepare(lines)
    floor, taken = area.buffer(-clear_mm, join_style="mitre"), []
    placed: list[BaseGeometry | None] = []
    for number, line in zip(numbers, lines, strict=True):
        start, second = np.array(line.coords[:2])
        inward = np.sign(second - start)  # along an axis: lines leave the walls upright
        start = np.where(inward > 0, bounds[:2], start)
        ahead, aside = np.arange(0, reach_mm, _SEARCH_MM), np.arange(-reach_mm / 2, reach_mm / 2, _SEARCH_MM)
        depth, shift = (grid.ravel() for grid in np.meshgrid(ahead, aside))
        middles = start + depth[:, None] * inward + shift[:, None] * inward[::-1]
        middles = middles[np.argsort(np.hypot(depth, shift), kind="stable")]
        half = np.array(number.bounds[2:])
        boxes = shapely.box(*(middles - half).T, *(middles + half).T)
        free = shapely.within(boxes, floor)
        for other in (*lines, *taken):
            free[free] = ~shapely.dwithin(other, boxes[free], clear_mm)
        first = int(np.argmax(free))
        if not free[first]:
            placed.append(None)
            continue
        taken.append(boxes[first])
        placed.append(affinity.translate(number, *middles[first]))
    return placed


_AT_WALL_MM = 1e-3
"""What comes so near to a wall reaches it."""


def pillar_outlines(
    polygons_mm: Sequence[Sequence[tuple[float, float]]], cavity: shapely.Polygon, into_mm: float
) -> BaseGeometry:
    """The outlines of pillars, which reach so far into the walls of the rectangle `cavity` where they come to them.

    A wall leans outwards from there: silicone between it and a pillar that ends at its foot would be a mere film.
    """
    keep_outs = shapely.union_all([shapely.Polygon(corners) for corners in polygons_mm])
    outlines = keep_outs.intersection(cavity.buffer(into_mm, join_style="mitre"))
    low, high = np.reshape(cavity.bounds, (2, 2))
    for axis in (0, 1):  # one after the other, so that corners are filled as well
        outlines = shapely.union_all([outlines, *_into_walls(outlines, axis, low, high, into_mm)])
        low[axis], high[axis] = low[axis] - into_mm, high[axis] + into_mm
    return outlines


def _into_walls(outlines: BaseGeometry, axis: int, low: Array, high: Array, into_mm: float) -> Iterator[BaseGeometry]:
    """Boxes on what comes to the walls across an axis, between the corners `low` and `high` (2,)."""
    for edge, out in ((low[axis], -1), (high[axis], 1)):
        strip = np.stack([low, high])
        strip[:, axis] = sorted((edge - out * _AT_WALL_MM, edge))
        for part in shapely.get_parts(outlines.intersection(_corner_box(strip))):
            box = np.reshape(part.bounds, (2, 2))
            box[:, axis] = sorted((edge - out * _AT_WALL_MM, edge + out * into_mm))
            yield _corner_box(box)


def _corner_box(corners: Array) -> shapely.Polygon:
    (left, low), (right, high) = corners.tolist()
    return shapely.box(left, low, right, high)


INTO_WALL_MM = 0.5
"""How far ridges run into the walls: the tracks open to the pad's sides, and no two faces of the mould coincide."""
COVER_MM = 1.0
"""Least silicone over the deepest track; a pad of many levels is made thicker for it."""
SNAP_MM = 1e-4
"""Grid that areas are snapped to where they are cut and joined, mm.

No edge of the solid is shorter; and without a grid, outlines that almost coincide can defeat the cut."""
_BESIDE = 5
"""Further from a fibre's start than so many times its height a number is no longer seen to belong to it."""
_CENTRE_SHARE, _ARC_SHARE, _OUTLINE_SHARE = 0.2, 0.2, 0.6
"""How the tolerance is shared: most thins out the outline, which sets the size of every file."""


class CommonTrack(NamedTuple):
    """A stretch of a track that lies over a deeper one: it has no floor of silicone there.

    Attributes:
        shallow: index of the fibre of the stretch.
        deep: index of the fibre below it.
        length_mm: how long the shallow one's centre line is nearer to the deep one's than a track is wide.
        position_mm: the middle of it.
    """

    shallow: int
    deep: int
    length_mm: float
    position_mm: tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """A morphology with the settings of its mould; what is derived from them is computed when first asked for.

    Attributes:
        nominal: where this one is of what is printed, larger than the pad, the plan of the pad as it is used.

    Raises:
        InputError: settings that contradict each other or the pitch, or keep-outs that are none of this pad.
    """

    pad: Morphology
    settings: FabricationSettings = DEFAULTS
    nominal: "Plan | None" = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_type("pad", self.pad, Morphology)
        check_type("settings", self.settings, FabricationSettings).require_consistent(self.pad.layout)
        if self.settings.pad.keep_out_mm and self.nominal is None:
            keep_outs(self.settings.pad.for_layout(self.pad.layout))

    @cached_property
    def shrinkage_compensated(self) -> "Plan":
        """The plan of what is printed: larger in every direction by what the silicone shrinks; this one if it does not.

        Heights are whole layers, see `FabricationSettings.shrinkage_compensated`. Its own pad is as large as its mould.
        """
        shrunk = self.settings.shrinkage_factor
        if shrunk == 1:
            return self
        layout = self.pad.layout
        larger = Layout(*layout.counts, layout.pitch_x_mm / shrunk, layout.pitch_y_mm / shrunk)
        pad = Morphology.from_dict({**self.pad.to_dict(), "pitch_mm": larger.pitch_mm})
        return Plan(pad, self.settings.shrinkage_compensated(), self)

    @cached_property
    def depths_mm(self) -> tuple[float, ...]:
        """How deep the tracks of every level lie in the pad, ascending, mm: their ridges, shrunk."""
        return tuple(
            round(self.settings.shrinkage_factor * height, 9) for height in self.shrinkage_compensated.heights_mm
        )

    @property
    def thickness_mm(self) -> float:
        """How thick the pad comes out, mm: what the mould holds, shrunk."""
        return round(self.settings.shrinkage_factor * self.shrinkage_compensated.silicone_mm, 9)

    @cached_property
    def lines(self) -> list[shapely.LineString]:
        """Of every fibre its centre line, mm, within a fifth of the tolerance, continued by its leads into the wall."""
        return self._centre_lines(self.settings.mould.tolerance_mm)

    def _centre_lines(self, tolerance_mm: float) -> list[shapely.LineString]:
        return [shapely.LineString(course) for course in self.paths(_CENTRE_SHARE * tolerance_mm, INTO_WALL_MM)]

    def paths(self, tolerance_mm: float, past_mm: float) -> list[Array]:
        """Of every fibre (n, 2) corners of its course and its leads, until so far past its tongues' ends, mm."""
        past = self.settings.mould.exit_mm, past_mm
        curves = flatten(self.pad, tolerance_mm / self.pad.unit_mm)
        found = []
        for (start, end), curve in zip(self.leads.pairs, curves, strict=True):
            before, after = start.bends(tolerance_mm)[::-1], end.bends(tolerance_mm)
            found.append(np.vstack([start.beyond(*past), before, self.pad.to_mm(curve), after, end.beyond(*past)]))
        return found

    def trace(self, step: float, past_mm: float) -> list[tuple[Array, Array]]:
        """Of every fibre and its leads points (n, 2), mm, and the exact headings (n,) there, radians, unwrapped.

        Where it turns in one place, as it may where it meets a lead, that place stands there twice.

        Args:
            step: greatest turn from one point to the next, radians.
            past_mm: how far past its tongues' ends it goes.
        """
        past = self.settings.mould.exit_mm + past_mm
        found = []
        for fibre, (spans, slopes) in enumerate(zip(beziers(self.pad), slope_beziers(self.pad), strict=True)):
            points, headings = trace_curve(spans, slopes, step)
            (before, coming), (after, going) = (lead.trace(step, past) for lead in self.leads.pairs[fibre])
            headings = np.pi / 2 - headings if self.family(fibre) else headings
            whole = np.concatenate([coming[::-1] + np.pi, headings, going])
            found.append((np.vstack([before[::-1], self.pad.to_mm(points), after]), np.unwrap(whole)))
        return found

    @cached_property
    def leads(self) -> Leads:
        """How every fibre goes on from its ends to the silicone's edge."""
        pad, mould = self.pad, self.settings.mould
        ends = pad.to_mm(pad.knots[:, [0, -1]])
        if self.settings.pad.leads == "edges":
            return straight_on(ends, pad.layout, mould.border_mm)
        if self.nominal is not None:
            return self.nominal.leads.scaled(1 / self.nominal.settings.shrinkage_factor)
        return to_one_side(ends, pad.layout, self.settings.lead_room(self.heights_mm[-1], self.flare_mm))

    @cached_property
    def lengths_mm(self) -> Array:
        """(F,) of every fibre within the silicone, its tongues included."""
        leads = [start.length_mm + end.length_mm for start, end in self.leads.pairs]
        return lengths(self.pad) * self.pad.unit_mm + leads + 2 * self.settings.mould.exit_mm

    @property
    def least_pitch_mm(self) -> float:
        """Of the two."""
        return min(self.pad.layout.pitch_x_mm, self.pad.layout.pitch_y_mm)

    @cached_property
    def crossings(self) -> list[Crossing]:
        """Every place where two fibres meet; `place` in grid units."""
        return crossings(self.pad, self.settings.mould.tolerance_mm / self.pad.unit_mm)

    @cached_property
    def clashes(self) -> list[Crossing]:
        """The crossings of fibres of one family."""
        return [c for c in self.crossings if self.family(c.first) == self.family(c.second)]

    @property
    def clash_positions_mm(self) -> Array:
        """(n, 2) where the clashes are."""
        return self.pad.to_mm(np.array([c.position for c in self.clashes]).reshape(-1, 2))

    @cached_property
    def common_tracks(self) -> list[CommonTrack]:
        """Where tracks of different depths lie over each other, leads included; at every crossing, and alongside."""
        found = []
        for level in range(max(self.layer_indices)):
            shallow = [fibre for fibre, own in enumerate(self.layer_indices) if own == level]
            deep = [fibre for fibre, own in enumerate(self.layer_indices) if own > level]
            lines = [[shapely.get_coordinates(self.lines[fibre]) for fibre in fibres] for fibres in (shallow, deep)]
            shared = common_stretches(lines[0], lines[1], self.settings.mould.ridge_width_mm)
            for line, other, begin, end in zip(shared.line, shared.other, shared.begin, shared.end, strict=True):
                middle = self.lines[shallow[line]].interpolate((begin + end) / 2)
                found.append(CommonTrack(shallow[line], deep[other], float(end - begin), (middle.x, middle.y)))
        return found

    def family(self, fibre: int) -> int:
        """0 for a horizontal fibre, 1 for a vertical one."""
        return self.pad.layout.family(fibre)

    @cached_property
    def layer_indices(self) -> tuple[int, ...]:
        """(F,) level of every fibre, 0 the shallowest; fibres that cross differ, if the settings allow for it."""
        clashes = self.clashes if self.settings.mould.levels == "as_needed" else []
        return fibre_levels(self.pad.layout.counts, clashes, self.settings.pad.deep_family == "horizontal")

    def require_levels(self) -> None:
        """Refuse a pad whose fibres need more levels than the settings grant.

        Raises:
            InputError: lists the crossings of fibres of one family.
        """
        if self.clashes and self.settings.mould.levels == "two":
            places = self.clash_positions_mm.tolist()
            listed = ", ".join(
                f"{c.first + 1} x {c.second + 1} at ({x:.1f}, {y:.1f}) mm"
                for c, (x, y) in zip(self.clashes, places, strict=True)
            )
            raise InputError(
                f'[mould] levels: got "two", allowed for pads without crossings of one family, or "as_needed"; '
                f"{len(self.clashes)} crossings: fibres {listed}"
            )

    @cached_property
    def heights_mm(self) -> tuple[float, ...]:
        """Ridge height of every level, ascending, mm above the tray's floor."""
        mould = self.settings.mould
        return tuple(
            round(mould.shallow_ridge_height_mm + level * mould.level_step_mm, 9)
            for level in range(1 + max(self.layer_indices))
        )

    @cached_property
    def silicone_mm(self) -> float:
        """Thickness of the cast pad, mm: as set, or more where many levels need it."""
        least = self.heights_mm[-1] + COVER_MM if len(self.heights_mm) > 2 else 0
        return max(self.settings.mould.silicone_mm, least)

    def outline(self, level: int, below_mm: float = 0.0, tolerance_mm: float | None = None) -> BaseGeometry:
        """Outline of the ridges of a level `below_mm` under their tops, mm, ends inside the walls.

        Args:
            tolerance_mm: greatest deviation, where it is not to be that of the settings.
        """
        mould = self.settings.mould
        tolerance = mould.tolerance_mm if tolerance_mm is None else tolerance_mm
        half = mould.ridge_width_mm / 2 + below_mm * self.settings.ridge_slope
        chord = 2 * math.acos(1 - _ARC_SHARE * tolerance / half)
        centres = self.lines if tolerance_mm is None else self._centre_lines(tolerance)
        lines = [line for line, own in zip(centres, self.layer_indices, strict=True) if own == level]
        bands = shapely.buffer(lines, half, quad_segs=math.ceil(math.pi / 2 / chord), cap_style="flat")
        return shapely.union_all(bands).simplify(_OUTLINE_SHARE * tolerance)

    @cached_property
    def ridges(self) -> tuple[BaseGeometry, ...]:
        """Outlines of the tops of the ridges of every level, mm."""
        return tuple(map(self.outline, range(len(self.heights_mm))))

    @cached_property
    def numbers(self) -> list[BaseGeometry | None]:
        """Strokes of every fibre's number, from 1, beside its start, mirrored; None without room, empty if unwanted."""
        mould = self.settings.mould
        if not mould.number_mm:
            return []
        count = self.pad.layout.fibres
        strokes = [number_strokes(n, mould.number_mm, mould.ridge_width_mm) for n in range(1, count + 1)]
        clear = mould.ridge_width_mm / 2 + self.heights_mm[-1] * self.settings.ridge_slope + mould.min_silicone_mm
        free, reach = self.cavity.difference(self.pillars), min(self.least_pitch_mm, _BESIDE * mould.number_mm)
        return with_room(strokes, self.lines, free, self.cavity.bounds, clear, reach)

    @cached_property
    def cavity(self) -> shapely.Polygon:
        """What is between the walls on the floor but for the exits, seen from above, mm: keep-outs stand in it."""
        return shapely.box(*self.leads.bounds_mm)

    @cached_property
    def exits(self) -> list[shapely.Polygon]:
        """Slots in the wall around both ends of every fibre, mm: in the order of the fibres, starts first.

        They begin within the cavity, so that no face of theirs coincides with one of its own.
        """
        mould = self.settings.mould
        if not mould.exit_mm:
            return []
        half = mould.exit_width_mm / 2
        return [self.leads.beside(lead, half, -half, mould.exit_mm) for end in (0, 1) for lead in self.ends(end)]

    def ends(self, end: int) -> list[Lead]:
        """The leads of all fibres' starts, 0, or other ends, 1."""
        return [pair[end] for pair in self.leads.pairs]

    @cached_property
    def pillars(self) -> BaseGeometry:
        """Outlines of what stands in the cavity up to its rim where keep-outs are, mm; at an edge within the wall."""
        polygons = self.settings.pad.keep_out_mm
        outlines = pillar_outlines(polygons, self.cavity, self.flare_mm + INTO_WALL_MM)
        return areas(shapely.set_precision(outlines, SNAP_MM)) if polygons else shapely.MultiPolygon()

    @cached_property
    def silicone(self) -> BaseGeometry:
        """All that the silicone fills on the floor, exits included, seen from above, mm."""
        whole = shapely.union_all([self.cavity, *self.exits])
        return without(whole, self.pillars) if self.pillars.area else whole

    @property
    def flare_mm(self) -> float:
        """How far the walls lean outwards from the floor to their top, mm."""
        return self.silicone_mm * math.tan(math.radians(self.settings.mould.wall_draft_deg))

    @property
    def corner_mm(self) -> float:
        """Side of the solid square between a corner of the cavity's rim and that of the tray, mm."""
        return self.settings.mould.exit_mm + self.settings.mould.wall_mm

    @cached_property
    def tray(self) -> shapely.Polygon:
        """The mould seen from above, walls included, mm."""
        return offset_box(self.cavity, self.flare_mm, self.corner_mm)


def overlap(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """The area that two areas share."""
    return areas(shapely.intersection(first, second, grid_size=SNAP_MM))


def without(first: BaseGeometry, second: BaseGeometry) -> BaseGeometry:
    """What `second` leaves of the area `first`."""
    return areas(shapely.difference(first, second, grid_size=SNAP_MM))


def areas(shape: BaseGeometry) -> BaseGeometry:
    """The polygons of `shape`; snapping leaves lines and points behind where areas barely touch."""
    parts = shapely.get_parts(shape)
    return shapely.MultiPolygon(parts[shapely.get_type_id(parts) == shapely.GeometryType.POLYGON].tolist())


def polygon_rings(area: BaseGeometry) -> list[list[np.ndarray]]:
    """Each polygon of `area` as its rings (n, 2) without the repeated last point, outer first.

    Outer rings run counter-clockwise and holes clockwise: the polygon lies to the left of every edge.
    """
    polygons = shapely.orient_polygons(shapely.get_parts(area))
    return [[shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(polygon)] for polygon in polygons]


def offset_box(area: BaseGeometry, *out_mm: float) -> shapely.Polygon:
    """The rectangle around an area, so much further out on every side, mm."""
    left, low, right, high = area.bounds
    for out in out_mm:
        left, low, right, high = left - out, low - out, right + out, high + out
    return shapely.box(left, low, right, high)


FAMILIES = ("horizontal", "vertical")
COLOURS = (HORIZONTAL, VERTICAL)

_PALEST = 0.7
"""Limit of the white in a family's palest tint; more would be lost on paper."""


@dataclass(frozen=True)
class FibreLayer:
    """The fibres of one depth, all of one family.

    Attributes:
        family: 0 horizontal, 1 vertical. index: as in `Plan.layer_indices`.
        depth_mm: of their tracks in the casting.
        fibres: their numbers among all, 0..F-1.
        colour: "#rrggbb", the family's own for its deepest level and paler the shallower.
    """

    family: int
    index: int
    depth_mm: float
    fibres: tuple[int, ...]
    colour: str

    @property
    def name(self) -> str:
        """Its id in a drawing, such as "horizontal-1.2"."""
        return f"{FAMILIES[self.family]}-{self.depth_mm:g}"


def fibre_layers(plan: Plan) -> list[FibreLayer]:
    """The levels of a plan in laying order, the deepest first."""
    laid = [
        tuple(fibre for fibre, own in enumerate(plan.layer_indices) if own == level)
        for level in range(len(plan.heights_mm))
    ]
    families = [plan.family(fibres[0]) for fibres in laid]
    found = []
    for level, (family, depth_mm, fibres) in enumerate(zip(families, plan.depths_mm, laid, strict=True)):
        white = _PALEST * families[level + 1 :].count(family) / families.count(family)
        found.append(FibreLayer(family, level, depth_mm, fibres, pale(COLOURS[family], white)))
    return found[::-1]


def fibre_name(plan: Plan, fibre: int) -> str:
    """What a fibre is called, such as "horizontal 1"; each family counts from 1."""
    return f"{FAMILIES[plan.family(fibre)]} {fibre - plan.pad.layout.families[plan.family(fibre)].start + 1}"


def pale(colour: str, white: float) -> str:
    """A colour "#rrggbb" mixed with a share of white."""
    return "#" + "".join(f"{round(part + white * (255 - part)):02x}" for part in bytes.fromhex(colour[1:]))
