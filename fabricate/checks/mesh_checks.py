"""Whether a mesh is a solid that prints and lets go of its casting: what can be told from its triangles alone.

Each check is one finding with its places. Nothing here changes a mesh.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from padforge.design.common.validation import check_float, check_int, check_type
from padforge.fabricate.mesh_files import read_mesh
from padforge.fabricate.settings import DEFAULTS, PrinterSettings

from . import self_intersections
from .findings import Finding, verdict
from .leaks import tight
from .overhangs import overhang, undercut
from .slices import slabs
from .surface import Numbers, Surface, spread
from .thickness import floor_thickness, ridge_width, silicone_wall, wall_thickness

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
        findings += [ridge_width(slices, printer), silicone_wall(slices, min_silicone_mm, size), tight(slices)]
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
        verdict("manifold", status == "NoError", int(status == "NoError"), 1, f"manifold3d says {status}"),
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
    return verdict("watertight", not len(wrong), len(wrong), 0, message, middles)


def _self_intersection(surface: Surface) -> Finding:
    pairs = self_intersections.penetrating(surface.corners, _MOST_PAIRS)
    places, count = spread(self_intersections.places(surface.corners, pairs)), len(pairs)
    many = f"{count} pairs of triangles" if count < _MOST_PAIRS else f"{count} pairs of triangles and more"
    message = f"{many} cut through each other" if count else "no triangles cut through each other"
    return verdict("self_intersection", count == 0, count, 0, message, places)


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
    return verdict("volume", volume > 0, volume, 0, f"the solid holds {volume:.1f} mm³")


def _genus(surface: Surface, expected: int) -> Finding:
    """The holes that lead through, by Euler's formula; it holds for closed surfaces."""
    corners, edges, faces = len(np.unique(surface.triangles)), len(surface.edges[0]), len(surface.triangles)
    genus = surface.shells[0] - (corners - edges + faces) / 2
    message = f"{genus:g} holes lead through the solid, expected are {expected}"
    return verdict("genus", genus == expected, genus, expected, message)


def _bed(surface: Surface, printer: PrinterSettings) -> Finding:
    """Whether it fits the printer, turned by 90 degrees if need be."""
    size, bed = np.ptp(surface.bottom_top, axis=0).tolist(), printer.bed_mm
    turned = zip([*sorted(size[:2]), size[2]], [*sorted(bed[:2]), bed[2]], strict=True)
    fits = all(extent <= room for extent, room in turned)
    return verdict("bed", fits, size, bed, f"{_by(size)} mm to print on a bed of {_by(bed)} mm")


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{math.ceil(size * 100 - 1e-3) / 100:g}" for size in sizes)
