"""Whether a mould prints, demoulds and lets the fibres be laid: each check one finding with its places.

Nothing here changes a mould or stops its making: a pass, warn or fail with what was measured is all there is.
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely import ops
from shapely.geometry.base import BaseGeometry

from design.errors import InputError
from design.morphology import Morphology

from .findings import Finding, Status, as_places, graded, verdict
from .mould import plan_mesh
from .outlines import INTO_WALL_MM, Plan, areas, overlap, without
from .settings import DEFAULTS, Printer, Settings

SOUND = ("manifold", "watertight", "bodies", "volume", "genus")
"""The checks a mesh must pass to be a solid at all."""

_LARGEST_MM = 1e6

_SPECK_MM2 = 0.01
"""Silicone too thin over less than this area is a corner, not a wall."""


def check(pad: Morphology, settings: Settings = DEFAULTS) -> list[Finding]:
    """Every check on the mould of a pad.

    Raises:
        InputError: settings that contradict each other.
    """
    return planned(pad, settings)[-1]


def planned(pad: Morphology, settings: Settings) -> tuple[Plan, np.ndarray, np.ndarray, list[Finding]]:
    """The plan of a mould, its mesh as vertices (n, 3) mm and triangles (m, 3), and every check on them.

    The first plan whose mesh is sound, or the last one tried.
    """
    plans = Plan.tries(pad, settings)
    plan = next(plans)
    vertices, triangles, solid = _meshed(plan)
    for finer in plans:
        if not unsound(solid):
            break
        plan, (vertices, triangles, solid) = finer, _meshed(finer)
    return plan, vertices, triangles, [*solid, *inspect(plan, vertices, triangles)]


def _meshed(plan: Plan) -> tuple[np.ndarray, np.ndarray, list[Finding]]:
    mesh = plan_mesh(plan).to_mesh()
    vertices, triangles = np.asarray(mesh.vert_properties), np.asarray(mesh.tri_verts)
    return vertices, triangles, inspect_mesh(vertices, triangles, plan.settings.printer)


def unsound(findings: Iterable[Finding]) -> list[Finding]:
    """Those of the findings by which a mesh is no solid at all."""
    return [finding for finding in findings if finding.name in SOUND and finding.status == "fail"]


def check_mesh(path: Path, printer: Printer = DEFAULTS.printer) -> list[Finding]:
    """The checks that need no plan, on a mesh file (.stl, .3mf) of any origin.

    Raises:
        InputError: the file is missing or holds no triangles.
    """
    import trimesh

    if not path.is_file():
        raise InputError(f"{path}: {'a folder, expected a mesh file' if path.is_dir() else 'no such file'}")
    try:
        with np.errstate(all="ignore"):
            mesh = trimesh.load_mesh(path)
    except Exception as error:  # readers of broken files raise whatever comes
        raise InputError(f"{path}: not a mesh that can be read ({error or type(error).__name__})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise InputError(f"{path}: holds no triangles that can be read, or is torn")
    if not np.isfinite(mesh.vertices).all() or np.abs(mesh.vertices).max() > _LARGEST_MM:
        raise InputError(f"{path}: vertices hold NaN, infinity or more than {_LARGEST_MM:g}")
    if mesh.units:  # a 3MF says its unit; an STL has none and counts as mm
        mesh.convert_units("millimeters")
    return inspect_mesh(mesh.vertices, mesh.faces, printer)


def inspect(plan: Plan, vertices: np.ndarray, triangles: np.ndarray) -> list[Finding]:
    """The checks that need the plan beside its mesh: vertices (n, 3) mm, triangles (m, 3) vertex numbers."""
    settings = plan.settings
    return [
        _genus(vertices, triangles),
        _ridge_width(settings),
        _track_size(settings),
        _layers(settings),
        _crossing_gap(settings),
        _same_family_crossings(plan),
        *_silicone_walls(plan),
        _tray_wall(plan),
    ]


def inspect_mesh(vertices: np.ndarray, triangles: np.ndarray, printer: Printer) -> list[Finding]:
    """Whether a mesh is one closed body that fits the printer: vertices (n, 3) mm, triangles (m, 3)."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, triangles)  # joins equal vertices, as whoever reads the file will
    status = _manifold(vertices, triangles).status().name
    loose = mesh.edges_unique[np.bincount(mesh.edges_unique_inverse) != 2]
    middles = mesh.vertices[loose].mean(axis=1)[:, :2]
    closed = bool(mesh.is_watertight and mesh.is_winding_consistent)
    edges = f"{len(loose)} edges without exactly two faces" if len(loose) or closed else "faces turn both ways"
    bodies, volume = int(mesh.body_count), float(mesh.volume)
    size, bed = np.ptp(mesh.vertices, axis=0).tolist(), printer.bed_mm
    turned = zip([*sorted(size[:2]), size[2]], [*sorted(bed[:2]), bed[2]], strict=True)
    fits = all(extent <= room for extent, room in turned)
    return [
        verdict("manifold", status == "NoError", int(status == "NoError"), 1, f"manifold3d says {status}"),
        verdict("watertight", closed, len(loose), 0, edges, middles),
        verdict("bodies", bodies == 1, bodies, 1, "one body" if bodies == 1 else f"the mesh has {bodies} bodies"),
        verdict("volume", volume > 0, volume, 0, f"the solid holds {volume:.1f} mm³"),
        verdict("bed", fits, size, bed, f"{_by(size)} mm to print on a bed of {_by(bed)} mm"),
    ]


def _manifold(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    from manifold3d import Manifold, Mesh64

    return Manifold(Mesh64(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(triangles, np.uint64)))


def _genus(vertices: np.ndarray, triangles: np.ndarray) -> Finding:
    genus = _manifold(vertices, triangles).genus()
    return verdict(
        "genus", genus == 0, genus, 0, "no hole through it" if genus == 0 else f"{genus} holes lead through the solid"
    )


def _ridge_width(settings: Settings) -> Finding:
    """A printer draws nothing narrower than its nozzle, or than two pixels of its screen."""
    width, printer = settings.mould.ridge_width_mm, settings.printer
    least = printer.nozzle_mm * (2 if printer.resin else 1)
    reason = "two pixels" if printer.resin else "the nozzle"
    message = f"ridges are {width:g} mm wide, {reason} {least:g} mm"
    return verdict("ridge_width", width >= least - 1e-9, width, least, message)


def _track_size(settings: Settings) -> Finding:
    """A fibre must lie within its track, neither pinched nor standing out."""
    room = min(settings.mould.ridge_width_mm, settings.mould.shallow_ridge_height_mm)
    fibre = settings.pad.fibre_diameter_mm
    message = f"the tightest track is {room:g} mm, the fibre {fibre:g} mm"
    return verdict("track_size", room >= fibre, room, fibre, message)


def _layers(settings: Settings) -> Finding:
    """Ridges of less than two layers do not print; heights between layers come out rounded."""
    layer, mould = settings.printer.layer_mm, settings.mould
    heights = {
        "floor_mm": mould.floor_mm,
        "shallow_ridge_height_mm": mould.shallow_ridge_height_mm,
        "deep_ridge_height_mm": mould.deep_ridge_height_mm,
    }
    uneven = [key for key, height in heights.items() if abs(height / layer - round(height / layer)) > 1e-6]
    least = min(heights.values()) / layer
    if least < 2 - 1e-6:
        return Finding("layers", "fail", least, 2.0, f"the lowest step has {least:.2f} layers of {layer:g} mm")
    if uneven:
        return Finding("layers", "warn", least, 2.0, f"{', '.join(uneven)}: not a whole number of {layer:g} mm layers")
    return Finding("layers", "pass", least, 2.0, f"every step is a whole number of {layer:g} mm layers")


def _crossing_gap(settings: Settings) -> Finding:
    """Where families cross, silicone or adhesive between the fibres keeps them from shorting."""
    mould = settings.mould
    gap = mould.deep_ridge_height_mm - settings.pad.fibre_diameter_mm - mould.shallow_ridge_height_mm
    message = f"{gap:.3f} mm lie between fibres of different families where they cross"
    return Finding("crossing_gap", graded(gap, mould.min_silicone_mm), gap, mould.min_silicone_mm, message)


def _same_family_crossings(plan: Plan) -> Finding:
    """Tracks of one depth that cross become one: the fibres in them touch."""
    places = plan.pad.to_mm([c.place for c in plan.crossings if plan.same_family(c)]).reshape(-1, 2)
    allowed = plan.settings.rules.same_family_crossings
    status: Status = "fail" if len(places) > allowed else "warn" if len(places) else "pass"
    message = f"{len(places)} crossings of fibres of one family, whose tracks merge; allowed are {allowed}"
    return Finding("same_family_crossings", status, len(places), allowed, message, as_places(places))


def _silicone_walls(plan: Plan) -> list[Finding]:
    """The thinnest silicone between tracks of equal depth, of two fibres or of one that turns back.

    Silicone beside the tray's walls is left to the check of those. Found by bisection to 2 % or 10 µm.
    """
    limit, pitch = plan.settings.mould.min_silicone_mm, plan.pad.pitch_mm
    around = plan.cavity.buffer(2 * pitch, join_style="mitre")
    findings = []
    for name, ridge in zip(("horizontal", "vertical"), plan.ridges, strict=True):
        silicone = without(around, ridge)
        patches = _thinner(silicone, limit, plan.cavity)
        within, low, high = plan.cavity, limit, pitch
        if patches:  # the thinnest place lies in one of them: look no further than their surroundings
            within, low, high = shapely.union_all(patches), 0.0, limit
            silicone = overlap(silicone, within.buffer(2 * limit))
        while high - low > max(0.01, 0.02 * low):
            middle = (low + high) / 2
            low, high = (low, middle) if _thinner(silicone, middle, within) else (middle, high)
        message = f"the thinnest silicone between {name} tracks is {high:.2f} mm"
        places = [patch.representative_point().coords[0] for patch in patches]
        status = graded(low, limit) if patches else "pass"
        findings.append(Finding(f"silicone_wall_{name}", status, high, limit, message, as_places(places)))
    return findings


def _thinner(area: BaseGeometry, width: float, within: BaseGeometry) -> list[BaseGeometry]:
    """Patches of `area` that vanish when it shrinks and grows again by half of `width`, corners kept sharp."""
    opened = area.buffer(-width / 2, join_style="mitre").buffer(width / 2, join_style="mitre")
    if not opened.is_valid:  # sharp corners that grow past each other
        opened = areas(shapely.make_valid(opened))
    lost = overlap(without(area, opened), within)
    return [patch for patch in shapely.get_parts(lost) if patch.area > _SPECK_MM2]


def _tray_wall(plan: Plan) -> Finding:
    """Between its ends a fibre must keep off the tray's wall, or its track opens to the pad's side.

    The first stretch at each end is left out: long enough for fibres that leave the wall at 30 degrees or more.
    """
    half, limit = plan.settings.mould.ridge_width_mm / 2, plan.settings.mould.min_silicone_mm
    reach, wall = half + limit, plan.cavity.boundary
    beside = plan.cavity.difference(plan.cavity.buffer(-reach, join_style="mitre"))
    end = INTO_WALL_MM + 2 * reach
    middles = [ops.substring(line, end, line.length - end) for line in plan.lines]
    near = [part for middle in middles for part in shapely.get_parts(middle.intersection(beside)) if part.length]
    gaps = [part.distance(wall) - half for part in near]
    least = min(gaps, default=min(middle.distance(wall) - half for middle in middles))
    places = [ops.nearest_points(part, wall)[0].coords[0] for part in near]
    message = f"ridges between their ends come within {least:.2f} mm of the tray's wall"
    return Finding("tray_wall", graded(least, limit), least, limit, message, as_places(places))


def _by(sizes: list[float]) -> str:
    return " x ".join(f"{math.ceil(size * 100 - 1e-3) / 100:g}" for size in sizes)
