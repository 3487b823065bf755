"""Checks on a triangle mesh without its plan: whether it is a solid that can be printed and releases its casting."""

import math
from collections.abc import Sequence
from functools import reduce
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely.geometry.base import BaseGeometry

from padforge.common.validation import check_float, check_int, check_type
from padforge.design.morphology import Array
from padforge.fabricate.checks import Finding, Status, check_result, surface
from padforge.fabricate.checks.surface import SPECK_MM2, FaceMask, Slab, TriangleMesh, tested_width
from padforge.fabricate.mesh import read_mesh, unit_normals
from padforge.fabricate.plan import areas, overlap, without
from padforge.fabricate.settings import DEFAULTS, PrinterSettings

SOLID_CHECKS = ("manifold", "watertight", "bodies", "volume", "genus")  # the checks that any solid must pass
_MIN_SIDE_MM = 5.0  # longest side of the smallest mould; smaller meshes are in another unit
_MAX_METRES_MM = 0.5  # longest side, read as mm, of a mesh in metres; other meshes that are too small are in inches
_POSES = {
    "down": np.diag([1, -1, -1]),
    "to the left": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "to the right": np.array([[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "to the near side": np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "to the far side": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
}
"""Directions that the open side of a mould may face by mistake, and the rotations that correct it."""
_MIN_CAST_SHARE = 0.3  # minimum fraction of a mould's footprint that is cast in; funnels and holes have less
_MAX_SHELLS = 100  # shells that are classified as bodies or hollows; more are debris, and all count as bodies


def check_mesh(
    path: Path, printer: PrinterSettings = DEFAULTS.printer, min_silicone_mm: float = 0.4, genus: int | None = None
) -> list[Finding]:
    """Run all checks on a mesh file of any origin, which stands as it is printed, open side up.

    Args:
        path: STL or 3MF file.
        printer: nozzle, layer and bed.
        min_silicone_mm: minimum thickness of the silicone between tracks.
        genus: required number of through holes; None if unknown.

    Returns:
        `SOLID_CHECKS` and bed; for a solid that can be cut wall_thickness, floor_thickness, overhang, undercut,
        self_intersection, ridge_width, silicone_wall and tight. If the mesh is too small to be in mm, only unit; if a
        mould faces the wrong way, pose in place of the checks that need its orientation.

    Raises:
        InputError: the file cannot be read, or an argument is out of range.
    """
    return check_triangles(*read_mesh(path), printer, min_silicone_mm, genus)


def check_triangles(
    vertices: ArrayLike,
    triangles: ArrayLike,
    printer: PrinterSettings = DEFAULTS.printer,
    min_silicone_mm: float = 0.4,
    genus: int | None = None,
    has_plan: bool = False,
) -> list[Finding]:
    """Run all checks of `check_mesh` on vertices (n, 3), mm, and triangles (m, 3), counter-clockwise from outside.

    A mesh that `has_plan` was built from it by manifold3d: it is tight and does not intersect itself, and `check_plan`
    checks the widths of ridges and of silicone faster and exactly.
    """
    check_type("printer", printer, PrinterSettings)
    min_silicone_mm = check_float("min_silicone_mm", min_silicone_mm, 0, 10)
    genus = None if genus is None else check_int("genus", genus, 0, 10**6)
    mesh = TriangleMesh.weld(vertices, triangles)
    if not has_plan and (unit := _check_unit(mesh)).status == "fail":
        return [unit]
    findings = [*check_solid(mesh, genus), _check_bed(mesh, printer)]
    if any(finding.name in ("manifold", "volume") and finding.status == "fail" for finding in findings):
        return findings
    slabs, size = surface.build_slabs(mesh, printer.layer_mm), float(np.ptp(mesh.bounds, axis=0).max())
    cast = [slab for slab in slabs if slab.void.area]
    if not has_plan and (side := _find_open_side(mesh, slabs, printer.layer_mm)):
        message = f"it lies with its open side {side}: turn it up"
        return [*findings, check_result("pose", False, side, "up", message)]
    findings += [
        _check_wall_thickness(cast, printer, size),
        _check_floor_thickness(mesh, printer),
        _check_overhang(mesh, printer),
        _check_undercut(mesh, slabs[0]),
    ]
    if not has_plan:
        findings += [
            _check_self_intersection(mesh, slabs),
            _check_ridge_width(slabs, printer),
            _check_silicone_wall(cast, min_silicone_mm, size),
            _check_leaks(slabs),
        ]
    return findings


def _check_unit(mesh: TriangleMesh) -> Finding:
    """Check that a mesh is large enough for a mould, since most files do not state their unit."""
    sides = np.ptp(mesh.bounds, axis=0)
    side = float(sides.max())
    unit, factor = ("metres", 1000) if side < _MAX_METRES_MM else ("inches", 25.4)
    size = " x ".join(f"{length:.3g}" for length in sides)
    message = f"{size} mm is too small for a mould; in {unit} it would be {factor * side:.3g} mm: export it in mm"
    return check_result("unit", not 0 < side < _MIN_SIDE_MM, side, _MIN_SIDE_MM, message)


def _find_open_side(mesh: TriangleMesh, slabs: Sequence[Slab], layer_mm: float) -> str:
    """Return where the open side of a mould faces if that is not up; "" for other meshes."""

    def is_tray(mesh: TriangleMesh, slabs: Sequence[Slab]) -> bool:
        width, depth, _ = np.ptp(mesh.bounds, axis=0)
        return max(slab.void.area for slab in slabs) > _MIN_CAST_SHARE * width * depth

    if is_tray(mesh, slabs):
        return ""
    for side, rotation in _POSES.items():
        turned = TriangleMesh.weld(mesh.vertices @ rotation.T, mesh.triangles)
        if is_tray(turned, surface.build_slabs(turned, layer_mm)):
            return side
    return ""


def check_solid(mesh: TriangleMesh, genus: int | None = None) -> list[Finding]:
    """Run only the `SOLID_CHECKS`, which are fast; `genus` is the required number of through holes."""
    status, volume = mesh.solid.status().name, float(mesh.signed_volumes.sum())
    findings = [
        check_result("manifold", status == "NoError", int(status == "NoError"), 1, f"status of manifold3d: {status}"),
        _check_edges(mesh),
        _check_bodies(mesh),
        check_result("volume", volume > 0, volume, 0, f"the volume is {volume:.1f} mm³"),
    ]
    return findings if genus is None else [*findings, _check_genus(mesh, genus)]


def _deduplicate(positions: Array) -> Array:
    """Return the first of the positions (k, 2), mm, in every cell of 1 mm."""
    return positions[np.sort(np.unique(np.round(positions), axis=0, return_index=True)[1])]


def _check_edges(mesh: TriangleMesh) -> Finding:
    """Check that every edge has two faces, in opposite directions: a closed and consistently oriented surface."""
    half_edges, (first, edge) = mesh.half_edges, mesh.edges
    count = np.bincount(edge, minlength=len(first))
    forward = np.bincount(edge, half_edges[:, 0] < half_edges[:, 1], len(first))
    loose, flipped = count != 2, (count == 2) & (forward != 1)
    message = "every edge has two consistently oriented faces"
    if loose.any():
        message = f"{loose.sum()} edges without exactly two faces"
    elif flipped.any():
        message = f"faces turn both ways at {flipped.sum()} edges"
    wrong = half_edges[first[loose | flipped]]
    return check_result("watertight", not len(wrong), len(wrong), 0, message, mesh.vertices[wrong].mean(axis=1)[:, :2])


def _check_bodies(mesh: TriangleMesh) -> Finding:
    """Check that there is one body and no hollow, which is a shell facing inwards and enclosed by another one.

    The positions are on all shells except the largest body.
    """
    labels, first = np.unique(mesh.shells, return_index=True)
    sizes, volumes = (np.bincount(mesh.shells, x, len(labels)) for x in (mesh.areas, mesh.signed_volumes))
    hollow = np.zeros(len(labels), dtype=bool)
    if 1 < len(labels) <= _MAX_SHELLS:
        hollow = np.array([volumes[shell] < 0 and _winding_number(mesh, shell) > 0.5 for shell in labels])
    bodies, hollows = int((~hollow).sum()), int(hollow.sum())
    largest = np.argsort(np.where(hollow, 0.0, sizes))[-1:]
    status: Status = "fail" if bodies != 1 else "warn" if hollows else "pass"
    message = "one body" if bodies == 1 else f"the mesh has {bodies} bodies"
    if status == "warn":
        message += f", with {hollows} closed hollows in it that nothing can leave"
    positions = _deduplicate(mesh.centroids[np.delete(first, largest), :2])
    return check_result("bodies", status, bodies, 1, message, positions)


def _winding_number(mesh: TriangleMesh, shell: int) -> float:
    """Compute the winding number, solid angle over 4 pi, of the other shells around a corner of `shell`.

    A. van Oosterom and J. Strackee, The solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30 (1983) 125.
    """
    point = mesh.corners[mesh.shells == shell][0, 0]
    a, b, c = np.moveaxis(mesh.corners[mesh.shells != shell] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    ab, bc, ca = (a * b).sum(axis=1), (b * c).sum(axis=1), (c * a).sum(axis=1)
    volume = (a * np.cross(b, c)).sum(axis=1)
    return float(np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * math.pi))


def _check_genus(mesh: TriangleMesh, expected: int) -> Finding:
    """Check the number of through holes by Euler's formula for closed surfaces."""
    corners, edges, faces = len(np.unique(mesh.triangles)), len(mesh.edges[0]), len(mesh.triangles)
    genus = len(np.unique(mesh.shells)) - (corners - edges + faces) / 2
    message = f"{genus:g} holes lead through the solid, expected are {expected}"
    return check_result("genus", genus == expected, genus, expected, message)


def _check_bed(mesh: TriangleMesh, printer: PrinterSettings) -> Finding:
    """Check that the body fits the printer, if necessary turned by 90 degrees."""
    size, bed = np.ptp(mesh.bounds, axis=0).tolist(), printer.bed_mm
    fits = all(a <= b for a, b in zip([*sorted(size[:2]), size[2]], [*sorted(bed[:2]), bed[2]], strict=True))
    body, room = (" x ".join(f"{math.ceil(x * 100 - 1e-3) / 100:g}" for x in sizes) for sizes in (size, bed))
    return check_result("bed", fits, size, bed, f"{body} mm, the bed is {room} mm")


def _check_self_intersection(mesh: TriangleMesh, slabs: Sequence[Slab]) -> Finding:
    """Check that no cross section half way up a slab overlaps itself."""
    overlaps = np.vstack([surface.find_overlaps(mesh, slab.middle_mm) for slab in slabs])
    positions = _deduplicate(overlaps)
    count = len(positions)
    where = f"{count} position{'s' * (count > 1)}"
    message = f"the solid overlaps itself at {where}" if count else "no cross section overlaps itself"
    return check_result("self_intersection", not count, count, 0, message, positions)


MIN_FLOOR_MM = 0.4  # thinner floors bend when the casting is pulled out
MIN_SILICONE_MM = 0.1  # thinner silicone tears in demoulding
_WALL_LINES = 2  # minimum thickness of a stable wall, in printed lines
_DEPTH_STEP = 1.5  # difference of heights, in minimum silicone walls, above which tracks of two depths may come close
_MAX_WALL_SLOPE = math.tan(math.radians(10))  # outward lean of a wall per mm of height
_MAX_RIDGE_SLOPE = math.tan(math.radians(20))  # widening of a ridge on either side per mm downwards
_MIN_FLOOR_COSINE = math.cos(math.radians(10))  # cosine of the slope of a floor
_NEAR_CORNER = 0.98  # thickness is also measured at this fraction of the way from a triangle's middle to its corners


def _check_ridge_width(slabs: Sequence[Slab], printer: PrinterSettings) -> Finding:
    """Check that all parts of a layer are at least as wide as the printer's line."""
    limit, name = printer.line_mm, "two pixels" if printer.resin else "the nozzle"
    width, positions = _find_narrowest([(slab.cross_section, None) for slab in slabs], limit)
    message = f"nothing is narrower than {name}, {limit:g} mm"
    if len(positions):
        message = f"the narrowest part is {width:.2f} mm wide, {name} {limit:g} mm"
    return check_result("ridge_width", not len(positions), width, limit, message, positions)


def _check_silicone_wall(cast: Sequence[Slab], limit: float, size: float) -> Finding:
    """Check the thickness of silicone between tracks of one depth, and between tracks and walls."""
    if not cast:
        return Finding("silicone_wall", "pass", size, limit, "nothing is cast in it")
    width, positions = _find_narrowest([(_silicone_area(slab, cast, limit), slab.void) for slab in cast], limit)
    message = f"no silicone between tracks of one depth is thinner than {limit:g} mm"
    if len(positions):
        message = f"the thinnest silicone between tracks of one depth is {width:.2f} mm"
    status: Status = "pass" if not len(positions) else "warn" if width >= MIN_SILICONE_MM else "fail"
    return check_result("silicone_wall", status, width, limit, message, positions)


def _silicone_area(slab: Slab, cast: Sequence[Slab], limit: float) -> BaseGeometry:
    """Return the void of a slab including the ridges that rise far above it, except those near the walls."""
    taller = [other for other in cast if other.top_mm > slab.top_mm + _DEPTH_STEP * limit]
    if not taller:
        return slab.void
    top, rim = taller[0], taller[-1]
    wall = rim.cross_section.buffer(_MAX_WALL_SLOPE * (rim.middle_mm - slab.middle_mm), join_style="mitre")
    ridges = without(top.cross_section, wall)
    if not ridges.area:
        return slab.void
    feet = ridges.buffer(_MAX_RIDGE_SLOPE * (top.middle_mm - slab.middle_mm), join_style="mitre")
    return without(slab.interior, without(slab.cross_section, feet))


def _find_narrowest(sections: Sequence[tuple[BaseGeometry, BaseGeometry | None]], limit: float) -> tuple[float, Array]:
    """Return the minimum width of areas, at most `limit`, and the positions of all parts below it.

    `sections` are pairs of an area and of an area to which its narrow parts are clipped, or None.
    """
    parts, widths = zip(*(surface.find_narrow_parts(area, limit, within) for area, within in sections), strict=True)
    merged = shapely.get_parts(shapely.union_all(np.concatenate(parts)))  # some lie in several slabs
    return min(widths), _deduplicate(shapely.get_coordinates(shapely.point_on_surface(merged)))


def _check_wall_thickness(cast: Sequence[Slab], printer: PrinterSettings, size: float) -> Finding:
    """Check that the walls around the casting are two lines thick just below the rim, where they are thinnest."""
    limit = _WALL_LINES * printer.line_mm
    if not cast:
        return Finding("wall_thickness", "pass", size, limit, "it has no walls around a casting")
    rim = cast[-1]
    area = surface.cut_solid(rim.solid, rim.top_mm - min(printer.layer_mm, rim.top_mm - rim.bottom_mm) / 2)
    width, positions = _find_narrowest([(area, None)], limit)
    if not len(positions):
        width = surface.compute_min_width(area, limit)
    status: Status = "pass" if not len(positions) else "warn" if width > tested_width(printer.line_mm) else "fail"
    message = f"the walls are {width:.2f} mm thick at the rim, {_WALL_LINES} lines of the printer {limit:g} mm"
    return check_result("wall_thickness", status, width, limit, message, positions)


def _check_floor_thickness(mesh: TriangleMesh, printer: PrinterSettings) -> Finding:
    """Check that the solid between horizontal faces is thick enough for a tight floor.

    Thickness is measured vertically, at the middles of faces and near their corners. It is not measured against
    leaning faces, since it vanishes at any sharp edge.
    """
    limit = max(MIN_FLOOR_MM, 2 * printer.layer_mm)
    up, down = mesh.normal_z > _MIN_FLOOR_COSINE, mesh.normal_z < -_MIN_FLOOR_COSINE
    below, above = _measure_thickness(mesh, up, down), _measure_thickness(mesh, down, up)
    thicknesses, points = map(np.concatenate, zip(below, above, strict=True))
    thickness = float(thicknesses.min(initial=mesh.bounds[1, 2] - mesh.bounds[0, 2]))
    positions = _deduplicate(points[thicknesses < tested_width(limit)])
    message = f"the thinnest floor is {thickness:.2f} mm"
    return check_result("floor_thickness", thickness >= tested_width(limit), thickness, limit, message, positions)


def _measure_thickness(mesh: TriangleMesh, start: FaceMask, end: FaceMask) -> tuple[Array, Array]:
    """Measure the solid vertically from triangles `start` (m,) to `end` (m,); return (k,), mm, and positions (k, 2)."""
    corners, middles = mesh.corners[start], mesh.centroids[start][:, None]
    points = np.concatenate([middles, middles + _NEAR_CORNER * (corners - middles)], axis=1).reshape(-1, 3)
    inward = np.repeat(-np.sign(mesh.normal_z[start]), 4)
    targets = mesh.corners[end]
    tree = shapely.STRtree(np.asarray(shapely.polygons(targets[:, :, :2])))
    point, target = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    a, b, c = np.moveaxis(targets[target], 1, 0)
    normals = np.cross(b - a, c - a)
    gaps = ((a - points[point]) * normals).sum(axis=1) / normals[:, 2] * inward[point]
    return gaps[gaps > 0], points[point[gaps > 0], :2]


MAX_OVERHANG_DEG = 45.0  # faces that lean farther from vertical need support
_UPRIGHT_DEG = 0.1  # faces that lean less are vertical within the rounding of their corners
_OFF_FACE_MM = 5e-3  # distance in front of a face at which silicone is detected
_MAX_HEIGHTS = 32  # heights at which silicone is detected, those of the largest faces


def _check_overhang(mesh: TriangleMesh, printer: PrinterSettings) -> Finding:
    """Check that no face above the first layer leans so far that it needs support."""
    high = mesh.corners[:, :, 2].max(axis=1) > mesh.bounds[0, 2] + printer.layer_mm
    leaning = _leaning(mesh, MAX_OVERHANG_DEG + 1.0) & high  # with a tolerance for the rounding of an STL
    lean = _max_lean_deg(mesh, high)
    message = f"overhangs of up to {lean:.0f}°, {MAX_OVERHANG_DEG:g}° print without support"
    positions = _deduplicate(mesh.patch_positions(leaning))
    return check_result("overhang", not leaning.any(), lean, MAX_OVERHANG_DEG, message, positions)


def _check_undercut(mesh: TriangleMesh, lowest: Slab) -> Finding:
    """Check that no face leans over the casting, which would hold it back in demoulding."""
    holding = _faces_at_silicone(mesh, _leaning(mesh, _UPRIGHT_DEG), lowest)
    lean = _max_lean_deg(mesh, holding)
    message = (
        f"faces lean over the casting by up to {lean:.1f}°" if holding.any() else "none, the casting can be demoulded"
    )
    positions = _deduplicate(mesh.patch_positions(holding))
    return check_result("undercut", not holding.any(), lean, 0.0, message, positions)


def _leaning(mesh: TriangleMesh, min_deg: float) -> FaceMask:
    """Return the mask (m,) of faces that overhang by more than an angle from vertical, without specks."""
    leaning = mesh.normal_z < -math.sin(math.radians(min_deg))
    patch = mesh.label_patches(leaning)
    leaning[leaning] = (np.bincount(patch, mesh.areas[leaning]) > SPECK_MM2)[patch]
    return leaning


def _max_lean_deg(mesh: TriangleMesh, mask: FaceMask) -> float:
    """Return the maximum overhang of the faces in `mask` (m,), degrees from vertical; 0 if there is none."""
    return math.degrees(math.asin(np.maximum(-mesh.normal_z[mask], 0.0).max(initial=0.0)))


def _faces_at_silicone(mesh: TriangleMesh, mask: FaceMask, lowest: Slab) -> FaceMask:
    """Return the faces of `mask` (m,) with silicone in front: an area enclosed by the solid, with a floor beneath."""
    faces = np.flatnonzero(mask & (mesh.centroids[:, 2] > lowest.middle_mm + _OFF_FACE_MM))
    x, y, z = (mesh.centroids[faces] + _OFF_FACE_MM * unit_normals(mesh.corners[faces])).T
    height = np.unique(np.round(z / _OFF_FACE_MM), return_inverse=True)[1]
    largest = np.argsort(-np.bincount(height, mesh.areas[faces]), kind="stable")[:_MAX_HEIGHTS]
    result = np.zeros(len(mesh.triangles), dtype=bool)
    has_floor = shapely.contains_xy(lowest.base, x, y)
    for index in largest:
        selected = height == index
        area = surface.cut_solid(mesh.solid, float(z[selected].min()))
        is_enclosed = shapely.contains_xy(surface.fill_outline(area), x[selected], y[selected])
        is_solid = shapely.contains_xy(area, x[selected], y[selected])
        result[faces[selected]] = is_enclosed & ~is_solid & has_floor[selected]
    return result


MAX_LEAK_MM = 10.0  # wider openings in a wall are not leaks, but the shape of a part that is not a tray
_NEAR_MM = 1e-3  # distance up to which areas cut on a grid adjoin
_MIN_BASIN = 0.25  # minimum fraction of a tray's outline that is hollow; funnels and holes have less


def _check_leaks(slabs: Sequence[Slab]) -> Finding:
    """Check that no opening in wall or floor lets silicone out of the tray."""
    leaks = [plug for slab in slabs[1:] for plug in _find_wall_leaks(slab.cross_section)] + _find_floor_leaks(slabs)
    leaks = [leak.representative_point() for leak in leaks if leak.area > SPECK_MM2]
    positions = dict.fromkeys((round(leak.x, 3), round(leak.y, 3)) for leak in leaks)  # one for several slabs
    count = len(positions)
    message = f"silicone leaks at {count} position{'s' * (count > 1)}" if count else "no leaks"
    return check_result("tight", not count, count, 0, message, positions)


def _find_wall_leaks(section: BaseGeometry) -> list[BaseGeometry]:
    """Return the gaps in walls that would enclose an area without them."""
    closed = section.buffer(MAX_LEAK_MM / 2, join_style="mitre").buffer(-MAX_LEAK_MM / 2, join_style="mitre")
    basins = [shapely.Polygon(ring) for polygon in shapely.get_parts(areas(closed)) for ring in polygon.interiors]
    if not basins:
        return []
    frame = shapely.box(*section.bounds).buffer(1.0, join_style="mitre")
    free = shapely.get_parts(without(frame, section))
    outside = shapely.union_all(free[shapely.distance(free, frame.exterior) < _NEAR_MM])
    open_basins = [basin for basin in basins if outside.intersects(basin.representative_point())]
    plugs = shapely.get_parts(overlap(without(closed, section), outside))
    plugs = plugs[shapely.distance(plugs, frame.exterior) < 1 + _NEAR_MM]
    return [plug for basin in open_basins for plug in plugs if plug.distance(basin) < _NEAR_MM]


def _find_floor_leaks(slabs: Sequence[Slab]) -> list[BaseGeometry]:
    """Return the parts of the lowest area enclosed by walls that have no solid beneath them."""
    for index, slab in enumerate(slabs[1:], 1):
        rings = [ring for polygon in shapely.get_parts(slab.cross_section) for ring in polygon.interiors]
        hollow = shapely.union_all([shapely.Polygon(ring) for ring in rings])
        if hollow.area > _MIN_BASIN * slabs[0].cross_section.envelope.area:
            bare = reduce(without, [lower.cross_section for lower in slabs[:index]], hollow)
            if bare.area < 0.5 * hollow.area:  # otherwise it is not a tray
                return list(shapely.get_parts(bare))
    return []
