"""Leads of fibres, from their ends to the edge of the silicone: straight on, or all to one side.

A pad that is wired to one connector has both ends of every fibre on its lower edge. Horizontals turn down beside the
pad, the lowest next to it. The upper ends of verticals turn above the pad, half of them to the left and half to the
right, and go down outside of the horizontals. The leads are nested and do not cross: each is offset from its neighbour
by the distance between leads or by a pitch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely

from padforge.design.morphology import Array
from padforge.design.paths.curves import bezier_lengths, cubic, flatten_beziers, quadratic
from padforge.design.settings import Layout
from padforge.fabricate.settings import WELL_SLOT_MM, FabricationSettings

_HANDLE = 4 / 3 * np.tan(np.pi / 16)  # of a cubic Bezier for an eighth of the unit circle; its error is 4.3e-6
_NO_SPANS = np.empty((0, 4, 2))


@dataclass(frozen=True, eq=False)
class Lead:
    """The path of a fibre from one of its ends to the edge: bends, if any, and a straight run."""

    end_mm: Array  # the fibre's end; shape (2,)
    spans: Array  # cubic Bezier curves from the end, mm; shape (n, 4, 2)
    outward: Array  # direction of the straight run, a unit vector along an axis; shape (2,)
    run_mm: float  # length of the straight run

    @property
    def turned_mm(self) -> Array:
        """Start of the straight run; shape (2,)."""
        return self.spans[-1, -1] if len(self.spans) else self.end_mm

    @property
    def axis(self) -> int:
        """Axis of the edge's normal: 0 for x, 1 for y."""
        return int(np.abs(self.outward).argmax())

    def point_past_edge(self, *past_mm: float) -> Array:
        """Return the point (2,) on the lead's extension, at the sum of the distances `past_mm` past the edge."""
        return self.turned_mm + sum(past_mm, self.run_mm) * self.outward

    def flatten_bends(self, tolerance_mm: float) -> Array:
        """Flatten the bends to corners (k, 2) after the fibre's end, within a tolerance."""
        return flatten_beziers(self.spans[None], tolerance_mm)[0][1:] if len(self.spans) else np.empty((0, 2))

    def trace(self, step: float, past_mm: float) -> tuple[Array, Array]:
        """Sample points (n, 2), mm, and headings (n,), at most `step` radians apart, up to `past_mm` past the edge."""
        points, directions = [], []
        for span in self.spans:
            sides = np.diff(span, axis=0)
            first, last = (side / np.linalg.norm(side) for side in (sides[0], sides[-1]))
            u = np.linspace(0, 1, 1 + max(1, int(np.ceil(np.arccos(np.clip(first @ last, -1, 1)) / step))))
            points.append(cubic(span, u))
            directions.append(quadratic(sides.T, u[:, None]))
        points.append(np.array([self.turned_mm, self.point_past_edge(past_mm)]))
        ahead = np.vstack([*directions, self.outward, self.outward])
        return np.vstack(points), np.arctan2(ahead[:, 1], ahead[:, 0])

    @cached_property
    def length_mm(self) -> float:
        """Length up to the edge."""
        return float(bezier_lengths(self.spans[None])[0]) + self.run_mm

    def scaled(self, factor: float) -> "Lead":
        """Return the lead scaled about the pad's middle."""
        return replace(self, end_mm=self.end_mm * factor, spans=self.spans * factor, run_mm=self.run_mm * factor)


@dataclass(frozen=True, eq=False)
class Leads:
    """The leads of all fibres, and the rectangle of silicone around them."""

    pairs: tuple[tuple[Lead, Lead], ...]  # leads of the start and of the end of each fibre
    bounds_mm: tuple[float, float, float, float]  # x_min, y_min, x_max and y_max of the silicone

    def edge_mm(self, lead: Lead) -> float:
        """Return the coordinate, along the lead's axis, of the edge that it reaches."""
        return self.bounds_mm[lead.axis + (2 if lead.outward[lead.axis] > 0 else 0)]

    def box_at_edge(self, lead: Lead, half_mm: float, start_mm: float, stop_mm: float) -> shapely.Polygon:
        """Return a box around a lead, `half_mm` to either side, between two distances outwards from its edge."""
        corners, out, edge = np.empty((2, 2)), lead.outward[lead.axis], self.edge_mm(lead)
        corners[:, lead.axis] = edge + out * start_mm, edge + out * stop_mm
        corners[:, 1 - lead.axis] = lead.turned_mm[1 - lead.axis] + np.array([-half_mm, half_mm])
        return shapely.box(*corners.min(axis=0), *corners.max(axis=0))

    def scaled(self, factor: float) -> "Leads":
        """Return the leads scaled about the pad's middle."""
        x_min, y_min, x_max, y_max = (factor * side for side in self.bounds_mm)
        pairs = tuple((start.scaled(factor), end.scaled(factor)) for start, end in self.pairs)
        return Leads(pairs, (x_min, y_min, x_max, y_max))


def straight_leads(ends_mm: Array, layout: Layout, border_mm: float) -> Leads:
    """Compute straight leads to the pad's four edges from fibre ends (F, 2, 2), mm."""
    pairs = []
    for fibre, (start, end) in enumerate(ends_mm):
        direction = np.eye(2)[layout.family(fibre)]
        pairs.append((Lead(start, _NO_SPANS, -direction, border_mm), Lead(end, _NO_SPANS, direction, border_mm)))
    x, y = (side / 2 + border_mm for side in layout.size_mm)
    return Leads(tuple(pairs), (-x, -y, x, y))


def lead_spacing(
    settings: FabricationSettings, max_height_mm: float, flare_mm: float
) -> tuple[float, float, float, float]:
    """Compute the dimensions of leads to one side from the tallest ridge and the outward lean of the walls.

    They are the width of the border in which leads are straight, the distance between neighbouring centre lines, the
    radius of the bends, and the distance from the outermost centre line to the silicone's edge; mm.
    """
    mould, radius = settings.mould, settings.min_bend_radius_mm
    foot = mould.ridge_width_mm + 2 * max_height_mm * settings.ridge_slope
    pitch = max(foot + mould.min_silicone_mm, settings.rules.min_gap_mm)
    if mould.exit_mm:
        width = max(mould.exit_width_mm, WELL_SLOT_MM if mould.conductive else 0)
        pitch = max(pitch, width + 2 * flare_mm + 2 * settings.printer.line_mm)
    edge = max(pitch / 2, foot / 2 + mould.min_silicone_mm)
    # A fibre may meet its lead at a corner, which the rule for bends allows only within a straight run.
    border = max(mould.border_mm, radius / 2)
    return border, pitch, max(radius, (foot + mould.min_silicone_mm) / 2), edge


def one_side_leads(ends_mm: Array, layout: Layout, spacing: tuple[float, float, float, float]) -> Leads:
    """Compute leads that all end on the lower edge from fibre ends (F, 2, 2), mm, and their `lead_spacing`."""
    (half_x, half_y), (horizontals, verticals) = (side / 2 for side in layout.size_mm), layout.counts
    border, gap, radius, edge = spacing
    # 1. x of the lead of the lowest horizontal: beside the border, and beside the lower end of the last vertical
    first_x, last_vertical_x = half_x + border + radius, half_x - layout.pitch_x_mm
    if verticals:
        first_x = max(first_x, last_vertical_x + gap)
    # 2. y of the edge, with room for the bend of the lowest horizontal
    y_min = -half_y - border
    if horizontals:
        y_min = min(y_min, layout.pitch_y_mm - half_y - radius)
    # 3. x and y of the innermost lead that turns from an upper end: outside of the horizontals, with room for two bends
    turned_x = first_x + horizontals * gap if horizontals else max(half_x + border + gap, 0.0)
    turned_x, turned_y = max(turned_x, last_vertical_x + 2 * radius), half_y + border + radius
    pairs = []
    for fibre, (start, end) in enumerate(ends_mm):
        if layout.family(fibre):
            number = fibre - horizontals
            is_left = 2 * number < verticals
            offset = (number if is_left else verticals - 1 - number) * gap
            corners = [(end[0], turned_y + offset), ((-1 if is_left else 1) * (turned_x + offset), turned_y + offset)]
            pairs.append((_down(start, [], y_min, radius), _down(end, corners, y_min, radius)))
        else:
            x = first_x + fibre * gap
            pairs.append((_down(start, [(-x, start[1])], y_min, radius), _down(end, [(x, end[1])], y_min, radius)))
    max_rank = (verticals + 1) // 2 - 1
    x_max = (turned_x + max_rank * gap if verticals else first_x + (horizontals - 1) * gap) + edge
    y_max = turned_y + max_rank * gap + edge if verticals else half_y + border
    return Leads(tuple(pairs), (-x_max, y_min, x_max, y_max))


def _down(end_mm: Array, corners: Sequence[tuple[float, float]], y_min: float, radius: float) -> Lead:
    """Return the lead from a fibre's end along rounded corners, and down from the last one to the edge."""
    spans: list[Array] = []
    position = end_mm
    stops = [np.array(corner) for corner in corners]
    stops += [np.array([stops[-1][0], y_min])] if stops else []
    for corner, following in pairwise(stops):
        incoming, outgoing = (side / np.abs(side).max() for side in (corner - position, following - corner))
        start = corner - radius * incoming
        if np.abs(start - position).max() > 0:
            spans.append(position + np.arange(4)[:, None] / 3 * (start - position))
            spans[-1][-1] = start
        spans += _quarter_circle(start, incoming, outgoing, radius)
        position = spans[-1][-1]
    return Lead(end_mm, np.array(spans) if spans else _NO_SPANS, np.array([0.0, -1.0]), float(position[1] - y_min))


def _quarter_circle(start: Array, incoming: Array, outgoing: Array, radius: float) -> list[Array]:
    """Return two cubic Bezier curves for a quarter circle from one direction (2,) to another."""
    centre, half = start + radius * outgoing, np.sqrt(0.5)
    middle, diagonal = centre + radius * half * (incoming - outgoing), half * (incoming + outgoing)
    end, handle = centre + radius * incoming, _HANDLE * radius
    return [
        np.array([start, start + handle * incoming, middle - handle * diagonal, middle]),
        np.array([middle, middle + handle * diagonal, end - handle * outgoing, end]),
    ]
