"""Whether a mesh is a solid that prints and lets go of its casting: what can be told from its triangles alone.

Each check is one finding with its places. Nothing here changes a mesh.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray
from shapely.geometry.base import BaseGeometry

from padforge.design.common.validation import check_float, check_int, check_type
from padforge.fabricate.checks import Finding, Place, Status, check_result
from padforge.fabricate.checks.surface import (
    Numbers,
    Slab,
    Surface,
    enclosed,
    least_width,
    section,
    slabs,
    spare_width,
    spread,
    tested_width,
    too_narrow,
)
from padforge.fabricate.checks.surface import find_self_intersections as find_self_intersections
from padforge.fabricate.checks.surface import intersection_points as intersection_points
from padforge.fabricate.mesh import read_mesh
from padforge.fabricate.plan import areas, overlap, without
from padforge.fabricate.settings import DEFAULTS, PrinterSettings

LEAST_FLOOR_MM = 0.4
"""Thinner floors bend when the casting is pulled out."""
LEAST_SILICONE_MM = 0.1
"""Silicone thinner than this does not come out of the mould in one piece."""
_WALL_LINES = 2
"""Lines side by side that make a wall hold."""
_FLOOR_LAYERS = 2
"""Layers that make a floor tight."""
_APART = 1.5
"""Ridges whose tops differ by this many least silicone walls leave tracks at two depths, which may come close."""
_STEEPEST_WALL = math.tan(math.radians(10))
"""How much a wall leans outwards per mm of height, at most; what leans more is not known for a wall."""
_RIDGE_SLOPE = math.tan(math.radians(20))
"""How much a ridge widens on either side per mm downwards, at most."""
_LEVEL = math.cos(math.radians(10))
"""Least cosine of the slope of a face that a floor may have."""
_NEAR_CORNER = 0.98
"""Share of the way from a triangle's middle to its corners where its thickness is measured too."""


def ridge_width(slices: Sequence[Slab], printer: PrinterSettings) -> Finding:
    """Whether everything that stands in a layer is as wide as what the printer draws."""
    limit, name = printer.line_mm, "two pixels" if printer.resin else "the nozzle"
    sections = [slab.cross_section for slab in slices]
    least, places = _narrowest(sections, [None] * len(sections), limit)
    if not places:
        return Finding("ridge_width", "pass", limit, limit, f"nothing is narrower than {name}, {limit:g} mm")
    message = f"the narrowest part is {least:.2f} mm wide, {name} {limit:g} mm"
    return Finding("ridge_width", "fail", least, limit, message, places)


def silicone_wall(slices: Sequence[Slab], limit: float, size: float) -> Finding:
    """Whether the silicone between tracks of one depth, and between tracks and walls, is as thick as `limit`.

    Args:
        slices: of the whole solid.
        limit: least thickness, mm.
        size: what stands for the thickness where there is nothing to cast.
    """
    cast = [slab for slab in slices if slab.void.area]
    if not cast:
        return Finding("silicone_wall", "pass", size, limit, "nothing is cast in it")
    least, places = _narrowest([_level_void(slab, slices, limit) for slab in cast], [s.void for s in cast], limit)
    if not places:
        message = f"no silicone between tracks of one depth is thinner than {limit:g} mm"
        return Finding("silicone_wall", "pass", limit, limit, message)
    status: Status = "warn" if least >= LEAST_SILICONE_MM else "fail"
    message = f"the thinnest silicone between tracks of one depth is {least:.2f} mm"
    return Finding("silicone_wall", status, least, limit, message, places)


def _level_void(slab: Slab, slices: Sequence[Slab], limit: float) -> BaseGeometry:
    """The void of a slab, together with the ridges that rise far above it; those near the walls stay solid."""
    taller = [other for other in slices if other.top_mm > slab.top_mm + _APART * limit and other.void.area]
    if not taller:
        return slab.void
    top, rim = taller[0], taller[-1]
    wall = rim.cross_section.buffer(_STEEPEST_WALL * (rim.middle_mm - slab.middle_mm), join_style="mitre")
    ridges = without(top.cross_section, wall)
    if not ridges.area:
        return slab.void
    foot = _RIDGE_SLOPE * (top.middle_mm - slab.middle_mm)
    return without(slab.frame, without(slab.cross_section, ridges.buffer(foot, join_style="mitre")))


def _narrowest(
    areas: Sequence[BaseGeometry], within: Sequence[BaseGeometry | None], limit: float
) -> tuple[float, tuple[Place, ...]]:
    """The least width in any of the areas, if less than `limit`, and the places of all that is too narrow."""
    found = [(area, too_narrow(area, limit, inside)) for area, inside in zip(areas, within, strict=True)]
    widths = [least_width(area, patches, limit) for area, patches in found if len(patches)]
    patches = shapely.union_all(np.concatenate([patches for _, patches in found]))  # some lie in several slices
    return min(widths, default=limit), spread(_points_on(shapely.get_parts(patches)))


def _points_on(patches: NDArray[np.object_]) -> NDArray[np.float64]:
    return shapely.get_coordinates(shapely.point_on_surface(patches))


def wall_thickness(slices: Sequence[Slab], printer: PrinterSettings, size: float) -> Finding:
    """Whether the walls around the casting are two lines thick where they are thinnest, just below their rim."""
    line = printer.line_mm
    limit = _WALL_LINES * printer.nozzle_mm
    cast = [slab for slab in slices if slab.void.area]
    if not cast:
        return Finding("wall_thickness", "pass", size, limit, "it has no walls around a casting")
    rim = cast[-1]
    area = section(rim.solid, rim.top_mm - min(printer.layer_mm, rim.top_mm - rim.bottom_mm) / 2)
    patches = too_narrow(area, limit)
    least = least_width(area, patches, limit) if len(patches) else spare_width(area, limit)
    status: Status = "pass" if not len(patches) else "warn" if least > tested_width(line) else "fail"
    message = f"the walls are {least:.2f} mm thick at the rim, {_WALL_LINES} lines of the printer {limit:g} mm"
    return Finding("wall_thickness", status, least, limit, message, spread(_points_on(patches)))


def floor_thickness(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether level faces have as much solid beneath them as a tight floor needs.

    Measured upright between level faces, at their middles and near their corners; towards a sharp edge between a
    level and a leaning face the thickness goes to nothing, and that is no floor.
    """
    limit = max(LEAST_FLOOR_MM, _FLOOR_LAYERS * printer.layer_mm)
    up, down = surface.rise > _LEVEL, surface.rise < -_LEVEL
    gaps, points = zip(_solid_from(surface, up, down), _solid_from(surface, down, up), strict=True)
    thick, places = np.concatenate(gaps), np.concatenate(points)
    least = float(thick.min(initial=surface.bottom_top[1, 2] - surface.bottom_top[0, 2]))
    passed = least >= tested_width(limit)
    message = f"the thinnest floor is {least:.2f} mm"
    return check_result("floor_thickness", passed, least, limit, message, spread(places[thick < tested_width(limit)]))


def _solid_from(
    surface: Surface, start: NDArray[np.bool_], end: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far solid reaches from the triangles `start` (m,) straight to those of `end`: (k,) mm, and places (k, 2)."""
    corners, middles = surface.corners[start], surface.middles[start][:, None]
    points = np.concatenate([middles, middles + _NEAR_CORNER * (corners - middles)], axis=1).reshape(-1, 3)
    inward = np.repeat(-np.sign(surface.rise[start]), len(points) // max(len(corners), 1))
    targets = np.flatnonzero(end)
    tree = shapely.STRtree(np.asarray(shapely.polygons(surface.corners[targets, :, :2])))
    point, target = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    a, b, c = np.moveaxis(surface.corners[targets[target]], 1, 0)
    normals = np.cross(b - a, c - a)
    gaps = ((a - points[point]) * normals).sum(axis=1) / normals[:, 2] * inward[point]
    return gaps[gaps > 0], points[point[gaps > 0], :2]


STEEPEST_DEG = 45.0
"""Faces that lean farther from upright than this need support."""
_SPARE_DEG = 1.0
"""By how much a face may lean more and still count as what it was drawn."""
_UPRIGHT_DEG = 0.1
"""Faces that lean by less are upright but for the rounding of their corners."""
_SPECK_MM2 = 0.01
"""Smaller faces hold nothing back and need no support."""
_OFF_FACE_MM = 5e-3
"""How far before a face it is looked whether silicone would lie there."""
_HEIGHTS = 32
"""Heights at which that is looked up, at most."""


def overhang(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether no face leans so far that it is printed on air; the first layer lies on the bed."""
    high = surface.corners[:, :, 2].max(axis=1) > surface.bottom_top[0, 2] + printer.layer_mm
    leaning = _leaning(surface, STEEPEST_DEG + _SPARE_DEG) & high
    steepest = _lean_deg(surface, high & (surface.rise < 0))
    message = f"faces lean over by up to {steepest:.0f}°, and print without support up to {STEEPEST_DEG:g}°"
    return check_result("overhang", not leaning.any(), steepest, STEEPEST_DEG, message, surface.patch_places(leaning))


def undercut(surface: Surface, slices: Sequence[Slab]) -> Finding:
    """Whether no face leans over the casting, which could not be pulled out upwards then."""
    holding = _before_void(surface, _leaning(surface, _UPRIGHT_DEG), slices[0])
    steepest = _lean_deg(surface, holding)
    message = f"faces lean over the casting by up to {steepest:.1f}°" if holding.any() else "the casting comes out"
    return check_result("undercut", not holding.any(), steepest, 0.0, message, surface.patch_places(holding))


def _leaning(surface: Surface, least_deg: float) -> NDArray[np.bool_]:
    """Which faces (m,) lean over by more than an angle from upright, patches of next to no area left out."""
    leaning = surface.rise < -math.sin(math.radians(least_deg))
    _, patch = surface.patches(leaning)
    large = np.bincount(patch, surface.areas[leaning]) > _SPECK_MM2
    leaning[leaning] = large[patch]
    return leaning


def _lean_deg(surface: Surface, which: NDArray[np.bool_]) -> float:
    """The greatest lean of the faces `which` (m,), degrees from upright; 0 without such faces."""
    return math.degrees(math.asin(np.maximum(-surface.rise[which], 0.0).max(initial=0.0)))


def _before_void(surface: Surface, which: NDArray[np.bool_], lowest: Slab) -> NDArray[np.bool_]:
    """Of the faces `which` (m,), those with silicone before their middles: surrounded by solid, a floor beneath.

    At many heights it is looked up where the faces are largest.
    """
    faces = np.flatnonzero(which & (surface.middles[:, 2] > lowest.middle_mm + _OFF_FACE_MM))
    crosses = np.cross(*np.moveaxis(np.diff(surface.corners[faces], axis=1), 1, 0))
    normals = crosses / np.linalg.norm(crosses, axis=1, keepdims=True)
    x, y, z = (surface.middles[faces] + _OFF_FACE_MM * normals).T
    which_height = np.unique(np.round(z / _OFF_FACE_MM), return_inverse=True)[1]
    largest = np.argsort(-np.bincount(which_height, surface.areas[faces]), kind="stable")[:_HEIGHTS]
    found = np.zeros(len(surface.triangles), dtype=bool)
    floor = shapely.contains_xy(lowest.base, x, y)
    for height in largest:
        here = which_height == height
        area = section(surface.solid, float(z[here].min()))
        surrounded = shapely.contains_xy(enclosed(area), x[here], y[here])
        found[faces[here]] = surrounded & ~shapely.contains_xy(area, x[here], y[here]) & floor[here]
    return found


WIDEST_MM = 10.0
"""Wider openings in a wall are no leaks but the shape of a part that is no tray."""
_LEAST_MM2 = 0.01
"""Smaller openings are what roundings leave."""
_NEAR_MM = 1e-3
"""Areas this near each other meet, but for the grid they are cut on."""
_BASIN = 0.25
"""Share of a part's outline that a tray's hollow takes up, at least: less is a funnel, or a hole."""
_FLOORLESS = 0.5
"""Where less than this share of what walls surround has a floor, they are no tray's."""


def check_leaks(slices: Sequence[Slab]) -> Finding:
    """Whether no opening in wall or floor lets silicone out of what the walls surround."""
    leaks = [place for slab in slices[1:] for place in _through_walls(slab.cross_section)]
    leaks += _through_floor(slices)
    message = f"silicone runs out at {len(leaks)} places" if leaks else "no opening lets silicone out"
    return check_result("tight", not leaks, len(leaks), 0, message, dict.fromkeys(leaks))


def _through_walls(section: BaseGeometry) -> list[tuple[float, float]]:
    """Where walls that would surround an area, were they closed, let it out."""
    closed = section.buffer(WIDEST_MM / 2, join_style="mitre").buffer(-WIDEST_MM / 2, join_style="mitre")
    basins = [shapely.Polygon(hole) for part in shapely.get_parts(areas(closed)) for hole in part.interiors]
    if not basins:
        return []
    around = shapely.box(*section.bounds).buffer(1.0, join_style="mitre")
    free = shapely.get_parts(without(around, section))
    outside = [part for part in free if part.distance(around.exterior) < _NEAR_MM]
    plugs = shapely.get_parts(overlap(without(closed, section), shapely.union_all(outside)))
    return [
        _rounded(plug)
        for basin in basins
        if any(part.intersects(basin.representative_point()) for part in outside)
        for plug in plugs
        if plug.area > _LEAST_MM2 and plug.distance(basin) < _NEAR_MM and plug.distance(around.exterior) < 1 + _NEAR_MM
    ]


def _through_floor(slices: Sequence[Slab]) -> list[tuple[float, float]]:
    """Where an area that walls surround has nothing beneath it down to the bed."""
    for number, slab in enumerate(slices):
        hollow = shapely.union_all(
            [shapely.Polygon(r) for p in shapely.get_parts(slab.cross_section) for r in p.interiors]
        )
        bare = hollow
        for below in slices[:number]:
            bare = without(bare, below.cross_section)
        if (
            number
            and hollow.area > _BASIN * slices[0].cross_section.envelope.area
            and bare.area < _FLOORLESS * hollow.area
        ):
            return [_rounded(part) for part in shapely.get_parts(bare) if part.area > _LEAST_MM2]
    return []


def _rounded(part: BaseGeometry) -> tuple[float, float]:
    """A place in a part, to the micrometre: slices of one leak above each other give one place."""
    x, y = np.round(part.representative_point().coords[0], 3).tolist()
    return x, y


SOUND = ("manifold", "watertight", "self_intersection", "bodies", "volume", "genus")
"""The checks a mesh must pass to be a solid at all."""
_MOST_PAIRS = 1000
"""Pairs of triangles that cut through each other, after which no more are looked for."""
_SHELLS = 100
"""Shells that are told apart into bodies and hollows; more are a heap of pieces, all counted as bodies."""


def inspect_mesh(
    vertices: ArrayLike,
    triangles: ArrayLike,
    printer: PrinterSettings = DEFAULTS.printer,
    min_silicone_mm: float = 0.4,
    genus: int | None = None,
    unplanned: bool = True,
) -> list[Finding]:
    """Every check on a mesh that stands on its underside as it is printed, open side up.

    Args:
        vertices: (n, 3) mm; equal ones count as one.
        triangles: (m, 3) vertex numbers, counter-clockwise seen from outside.
        printer: nozzle, layer and bed.
        min_silicone_mm: least thickness of the silicone between tracks.
        genus: how many holes must lead through the solid; None where that is not known.
        unplanned: False where the plan of the mould is at hand, which tells widths exactly and in less time.

    Returns:
        The findings of `sound`, then bed; and, if that is a solid that can be cut, wall_thickness, floor_thickness,
        overhang, undercut; and what a plan knows, ridge_width, silicone_wall and tight.
    """
    check_type("printer", printer, PrinterSettings)
    min_silicone_mm = check_float("min_silicone_mm", min_silicone_mm, 0, 10)
    surface = Surface.joined(vertices, triangles)
    genus = None if genus is None else check_int("genus", genus, 0, 10**6)
    findings = [*_sound(surface, genus), _bed(surface, printer)]
    if any(finding.name in ("manifold", "volume") and finding.status == "fail" for finding in findings):
        return findings
    slices, size = slabs(surface, printer.layer_mm), float(np.ptp(surface.bottom_top, axis=0).max())
    findings += [
        wall_thickness(slices, printer, size),
        floor_thickness(surface, printer),
        overhang(surface, printer),
        undercut(surface, slices),
    ]
    if unplanned:
        findings += [ridge_width(slices, printer), silicone_wall(slices, min_silicone_mm, size), check_leaks(slices)]
    return findings


def sound(vertices: ArrayLike, triangles: ArrayLike, genus: int | None = None) -> list[Finding]:
    """The checks of `SOUND` alone, which take a fraction of the time of all; arguments as for `inspect_mesh`."""
    genus = None if genus is None else check_int("genus", genus, 0, 10**6)
    return _sound(Surface.joined(vertices, triangles), genus)


def check_mesh(
    path: Path, printer: PrinterSettings = DEFAULTS.printer, min_silicone_mm: float = 0.4, genus: int | None = None
) -> list[Finding]:
    """Every check on a mesh file of any origin; arguments as for `read_mesh` and `inspect_mesh`."""
    return inspect_mesh(*read_mesh(path), printer, min_silicone_mm, genus)


def _sound(surface: Surface, genus: int | None) -> list[Finding]:
    status = surface.solid.status().name
    findings = [
        check_result("manifold", status == "NoError", int(status == "NoError"), 1, f"manifold3d says {status}"),
        _watertight(surface),
        _self_intersection(surface),
        _bodies(surface),
        _volume(surface),
    ]
    return findings if genus is None else [*findings, _genus(surface, genus)]


def _watertight(surface: Surface) -> Finding:
    """Every edge must be passed once each way: then the surface is closed, and its faces turn one way."""
    sides, (first, edge) = surface.sides, surface.edges
    count = np.bincount(edge, minlength=len(first))
    ahead = np.bincount(edge, sides[:, 0] < sides[:, 1], len(first))
    loose, turned = count != 2, (count == 2) & (ahead != 1)
    if loose.any():
        message = f"{loose.sum()} edges without exactly two faces"
    elif turned.any():
        message = f"faces turn both ways at {turned.sum()} edges"
    else:
        message = "every edge has two faces that turn one way"
    wrong = first[loose | turned]
    middles = surface.vertices[sides[wrong]].mean(axis=1)[:, :2]
    return check_result("watertight", not len(wrong), len(wrong), 0, message, middles)


def _self_intersection(surface: Surface) -> Finding:
    pairs = find_self_intersections(surface.corners, _MOST_PAIRS)
    places, count = spread(intersection_points(surface.corners, pairs)), len(pairs)
    many = f"{count} pairs of triangles" if count < _MOST_PAIRS else f"{count} pairs of triangles and more"
    message = f"{many} cut through each other" if count else "no triangles cut through each other"
    return check_result("self_intersection", count == 0, count, 0, message, places)


def _bodies(surface: Surface) -> Finding:
    """One body; a hollow closed off inside it is no body, but worth a warning. The places are of all but the largest.

    A shell turned inwards is a hollow if the other shells wind around it.
    """
    count, label = surface.shells
    sizes, volumes = (np.bincount(label, amounts, count) for amounts in (surface.areas, surface.volumes))
    hollow = np.zeros(count, dtype=bool)
    if 1 < count <= _SHELLS:
        inward = np.flatnonzero(volumes < 0).tolist()
        hollow[inward] = [_winding(surface, label, shell) > 0.5 for shell in inward]
    bodies, hollows = int((~hollow).sum()), int(hollow.sum())
    main = np.argsort(np.where(hollow, 0.0, sizes))[-1:]
    _, first = np.unique(label, return_index=True)
    places = spread(surface.middles[np.delete(first, main), :2])
    if bodies != 1:
        return Finding("bodies", "fail", bodies, 1, f"the mesh has {bodies} bodies", places)
    if hollows:
        message = f"one body, with {hollows} closed hollows in it that nothing can leave"
        return Finding("bodies", "warn", bodies, 1, message, places)
    return Finding("bodies", "pass", bodies, 1, "one body")


def _winding(surface: Surface, label: Numbers, shell: int) -> float:
    """How often the other shells wind around a corner of `shell`: the solid angle they take up there over 4 pi.

    A. van Oosterom and J. Strackee, The solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30 (1983) 125.
    """
    point = surface.corners[label == shell][0, 0]
    a, b, c = np.moveaxis(surface.corners[label != shell] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    ab, bc, ca = (a * b).sum(axis=1), (b * c).sum(axis=1), (c * a).sum(axis=1)
    volume = (a * np.cross(b, c)).sum(axis=1)
    return float(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * math.pi))


def _volume(surface: Surface) -> Finding:
    volume = float(surface.volumes.sum())
    return check_result("volume", volume > 0, volume, 0, f"the solid holds {volume:.1f} mm³")


def _genus(surface: Surface, expected: int) -> Finding:
    """The holes that lead through, by Euler's formula; it holds for closed surfaces."""
    corners, edges, faces = len(np.unique(surface.triangles)), len(surface.edges[0]), len(surface.triangles)
    genus = surface.shells[0] - (corners - edges + faces) / 2
    message = f"{genus:g} holes lead through the solid, expected are {expected}"
    return check_result("genus", genus == expected, genus, expected, message)


def _bed(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether it fits the printer, turned by 90 degrees if need be."""
    size, bed = np.ptp(surface.bottom_top, axis=0).tolist(), printer.bed_mm
    turned = zip([*sorted(size[:2]), size[2]], [*sorted(bed[:2]), bed[2]], strict=True)
    fits = all(extent <= room for extent, room in turned)
    return check_result("bed", fits, size, bed, f"{_by(size)} mm to print on a bed of {_by(bed)} mm")


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{math.ceil(size * 100 - 1e-3) / 100:g}" for size in sizes)
