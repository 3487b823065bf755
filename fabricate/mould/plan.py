"""The plan of a mould: centre lines, ridge outlines and tray in mm.

The frame is the pad's own, x and y from its centre (`Morphology.to_mm`), as it lies in the tray with its tracks
down. Turned over for laying and use, the tracks are the mirror image of the plan.

Lengths are those of the pad as it is used. Where the silicone shrinks, the mould has a plan of its own,
`Plan.enlarged`.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

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
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

from .planning.depth_levels import fibre_levels
from .planning.leads import Lead, Leads, straight_on, to_one_side
from .planning.numerals import number_strokes, with_room
from .planning.pillars import pillar_outlines

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
        place_mm: the middle of it.
    """

    shallow: int
    deep: int
    length_mm: float
    place_mm: tuple[float, float]


@dataclass(frozen=True)
class Plan:
    """A morphology with the settings of its mould; what is derived from them is computed when first asked for.

    Attributes:
        used: where this one is of what is printed, larger than the pad, the plan of the pad as it is used.

    Raises:
        InputError: settings that contradict each other or the pitch, or keep-outs that are none of this pad.
    """

    pad: Morphology
    settings: FabricationSettings = DEFAULTS
    used: "Plan | None" = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_type("pad", self.pad, Morphology)
        check_type("settings", self.settings, FabricationSettings).require_consistent(self.pad.layout)
        if self.settings.pad.keep_out_mm and self.used is None:
            keep_outs(self.settings.pad.for_layout(self.pad.layout))

    @cached_property
    def enlarged(self) -> "Plan":
        """The plan of what is printed: larger in every direction by what the silicone shrinks; this one if it does not.

        Heights are whole layers, see `FabricationSettings.enlarged`. Its own pad is as large as its mould.
        """
        shrunk = self.settings.shrunk
        if shrunk == 1:
            return self
        layout = self.pad.layout
        larger = Layout(*layout.counts, layout.pitch_x_mm / shrunk, layout.pitch_y_mm / shrunk)
        pad = Morphology.from_dict({**self.pad.to_dict(), "pitch_mm": larger.pitch_mm})
        return Plan(pad, self.settings.enlarged(), self)

    @cached_property
    def depths_mm(self) -> tuple[float, ...]:
        """How deep the tracks of every level lie in the pad, ascending, mm: their ridges, shrunk."""
        return tuple(round(self.settings.shrunk * height, 9) for height in self.enlarged.heights_mm)

    @property
    def thickness_mm(self) -> float:
        """How thick the pad comes out, mm: what the mould holds, shrunk."""
        return round(self.settings.shrunk * self.enlarged.silicone_mm, 9)

    @cached_property
    def lines(self) -> list[shapely.LineString]:
        """Of every fibre its centre line, mm, within a fifth of the tolerance, continued by its leads into the wall."""
        return self._centre_lines(self.settings.mould.tolerance_mm)

    def _centre_lines(self, tolerance_mm: float) -> list[shapely.LineString]:
        return [shapely.LineString(course) for course in self.courses(_CENTRE_SHARE * tolerance_mm, INTO_WALL_MM)]

    def courses(self, tolerance_mm: float, past_mm: float) -> list[Array]:
        """Of every fibre (n, 2) corners of its course and its leads, until so far past its tongues' ends, mm."""
        past = self.settings.mould.exit_mm, past_mm
        curves = flatten(self.pad, tolerance_mm / self.pad.unit_mm)
        found = []
        for (start, end), curve in zip(self.leads.pairs, curves, strict=True):
            before, after = start.bends(tolerance_mm)[::-1], end.bends(tolerance_mm)
            found.append(np.vstack([start.beyond(*past), before, self.pad.to_mm(curve), after, end.beyond(*past)]))
        return found

    def traced(self, step: float, past_mm: float) -> list[tuple[Array, Array]]:
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
            (before, coming), (after, going) = (lead.traced(step, past) for lead in self.leads.pairs[fibre])
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
        if self.used is not None:
            return self.used.leads.scaled(1 / self.used.settings.shrunk)
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
    def clash_places_mm(self) -> Array:
        """(n, 2) where the clashes are."""
        return self.pad.to_mm(np.array([c.position for c in self.clashes]).reshape(-1, 2))

    @cached_property
    def common_tracks(self) -> list[CommonTrack]:
        """Where tracks of different depths lie over each other, leads included; at every crossing, and alongside."""
        found = []
        for level in range(max(self.levels)):
            shallow = [fibre for fibre, own in enumerate(self.levels) if own == level]
            deep = [fibre for fibre, own in enumerate(self.levels) if own > level]
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
    def levels(self) -> tuple[int, ...]:
        """(F,) level of every fibre, 0 the shallowest; fibres that cross differ, if the settings allow for it."""
        clashes = self.clashes if self.settings.mould.levels == "as_needed" else []
        return fibre_levels(self.pad.layout.counts, clashes, self.settings.pad.deep_family == "horizontal")

    def require_levels(self) -> None:
        """Refuse a pad whose fibres need more levels than the settings grant.

        Raises:
            InputError: lists the crossings of fibres of one family.
        """
        if self.clashes and self.settings.mould.levels == "two":
            places = self.clash_places_mm.tolist()
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
            for level in range(1 + max(self.levels))
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
        lines = [line for line, own in zip(centres, self.levels, strict=True) if own == level]
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
        return box_around(self.cavity, self.flare_mm, self.corner_mm)


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


def box_around(area: BaseGeometry, *out_mm: float) -> shapely.Polygon:
    """The rectangle around an area, so much further out on every side, mm."""
    left, low, right, high = area.bounds
    for out in out_mm:
        left, low, right, high = left - out, low - out, right + out, high + out
    return shapely.box(left, low, right, high)
