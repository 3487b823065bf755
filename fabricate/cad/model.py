"""CAD models of the printed bodies, by build123d: a named and coloured solid for the tray, every ridge and number.

A ridge is the extrusion of its exact outline. It reaches into the floor and the walls, and ridges overlap where they
cross: every solid can be filleted, shelled or moved on its own, and their union is the mould.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import shapely
from build123d import (
    Color,
    Compound,
    Edge,
    Face,
    GeomType,
    Location,
    Plane,
    Shell,
    Solid,
    Vector,
    Wire,
    export_brep,
    import_brep,
)
from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge
from OCP.BRepGProp import BRepGProp
from OCP.GC import GC_MakeArcOfCircle
from OCP.gp import gp_Pnt
from OCP.GProp import GProp_GProps
from OCP.Standard import Standard_Failure, Standard_NullObject
from shapely import affinity

from padforge.common.plotting import FAMILY_COLOURS
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate import mould
from padforge.fabricate.mesh import build_mesh
from padforge.fabricate.mould import BODY_COLOURS, Body, Prism
from padforge.fabricate.plan import Plan, polygon_rings
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

from .curves import FINE_MM, OutlineCurve, find_joints, fit_arc, insert_joints, ring_curves

FIT_TOLERANCES_MM = (2e-3, 1.5e-3, 5e-4, 1e-4)
"""Tolerances of curves against the finely drawn outlines, tried in order until the kernel finds a solid valid.

Fitted curves may cross where the outlines only come close; closer fits do not.
"""
FUSE_S = 60.0  # time limit for the union of all parts
_FUSE = """\
import sys, build123d
first, *others = map(build123d.import_brep, sys.argv[2:])
build123d.export_brep(first.fuse(*others), sys.argv[1])
"""
"""Program that writes the union of files to its first argument."""
_MIN_CIRCLE_CORNERS = 32  # minimum corners of a polygon that represents a circle
MAX_DEVIATION = 2e-4  # maximum relative deviation of a ridge's volume from that of its mesh
MAX_BODY_DEVIATION = 5e-4  # the same for other parts, such as a lid, whose round holes are polygons in the mesh
KERNEL_ERRORS = Standard_Failure, Standard_NullObject, RuntimeError, ValueError
"""Errors of the CAD kernel and of build123d."""
_DECIMALS = 5  # decimals of points, mm; more would only lengthen a STEP file
_MIN_EDGE_MM = 2e-5  # minimum edge of an outline, so that rounding does not merge two points
_AREA_TOLERANCE = 1e-2  # relative; it selects adaptive integration of areas, whose error is far smaller
_INTO_TERRACE_MM = 0.005  # overlap of a terrace with the one below, so that no two faces coincide


@dataclass(frozen=True)
class CadPart:
    """A part of a printed body."""

    shape: Solid | Compound  # named and coloured; a solid, or an assembly of solids
    deviation: float  # maximum relative deviation of a solid's volume from that of its prisms as a mesh
    fit_mm: float = 0.0  # tolerance of curves against outlines that are drawn within `FINE_MM`; 0 without curves


def build_mould(pad: Morphology, settings: FabricationSettings = DEFAULTS, *, fused: bool = False) -> Compound | Solid:
    """Build the CAD model of a mould: the tray, every ridge, as "horizontal 1", and the numbers, named and coloured.

    Args:
        pad: fibres.
        settings: tray, ridges and fibre.
        fused: return one solid instead, which may take a minute.

    Returns:
        Assembly of closed solids, mm. Ridges reach into the floor and overlap where they cross.

    Raises:
        InputError: settings contradict each other or do not allow this pad, the kernel makes no valid solid, or, if
            `fused`, not within `FUSE_S`.
    """
    plan = Plan(pad, settings)
    plan.require_levels()
    parts = mould_parts(plan.shrinkage_compensated, "mould")
    return fuse(parts, "mould") if fused else assemble({"mould": parts}, plan.shrinkage_compensated)


def mould_parts(plan: Plan, name: str) -> list[CadPart]:
    """Build the parts of a mould from its shrinkage-compensated plan; it has wells if `name` is "conductive"."""
    parts = [_build_part("tray", BODY_COLOURS["mould"], mould.tray_body(plan), name)]
    parts += [_ridge_part(plan, fibre, name) for fibre in range(plan.pad.layout.fibres)]
    numbers = [
        _build_part(f"number {fibre}", "#5D6B7A", Body((prism,)), name)
        for fibre, prism in enumerate(mould.number_prisms(plan), 1)
        if prism
    ]
    if numbers:
        shape = Compound(label="numbers", children=[number.shape for number in numbers])
        parts.append(CadPart(shape, max(number.deviation for number in numbers)))
    return parts


def _build_part(name: str, colour: str, body: Body, printed: str) -> CadPart:
    """Build a part by Boolean operations of its prisms; `printed` is the name of its printed body."""
    solid = body_solid(body)
    if not (isinstance(solid, Solid) and solid.is_valid):
        raise InputError(f"{printed}: the CAD kernel finds its {name} invalid; leave step out of the formats")
    deviation = abs(solid.volume / build_mesh(body).volume() - 1)
    if not deviation <= MAX_BODY_DEVIATION:  # NaN fails as well
        error = f"does not match its mesh (volume {100 * deviation:.3g} % off); nothing was written"
        raise InputError(f"{printed}: the CAD solid of its {name} {error}")
    return CadPart(_label(solid, name, colour), deviation)


def _label(shape: Solid, name: str, colour: str) -> Solid:
    shape.label, shape.color = name, Color(colour)
    return shape


def _ridge_part(plan: Plan, fibre: int, printed: str) -> CadPart:
    """Build the ridge of a fibre at the first tolerance that gives a valid solid with the volume of its mesh.

    That mesh has finely drawn outlines. The outlines of the printed mesh are drawn within the mould's tolerance, which
    would change the volume of a narrow ridge by a thousandth.
    """
    name, colour = plan.pad.layout.fibre_name(fibre), FAMILY_COLOURS[plan.family(fibre)]
    top = plan.outline([fibre], 0.0, FINE_MM)
    top = top | mould.fibre_wells(plan, fibre, sides=512) if printed == "conductive" else top
    prisms = mould.ridge_prisms(plan, [fibre], top, FINE_MM)
    volume_mm3 = build_mesh(Body(tuple(prisms))).volume()
    for fit_mm in FIT_TOLERANCES_MM:
        try:
            solid = _ridge_solid(plan, fibre, prisms, fit_mm)
        except KERNEL_ERRORS:
            continue
        deviation = abs(_upright_volume(solid) / volume_mm3 - 1)
        if isinstance(solid, Solid) and solid.is_valid and deviation <= MAX_DEVIATION:
            has_curves = any(face.geom_type == GeomType.EXTRUSION for face in solid.faces())
            return CadPart(_label(solid, name, colour), deviation, fit_mm if has_curves else 0.0)
    raise InputError(f"{printed}: the CAD kernel finds the ridge of {name} invalid; leave step out of the formats")


def _upright_volume(solid: Solid) -> float:
    """Return the volume, mm³, of a solid whose faces are horizontal or vertical.

    By the divergence theorem it is the integral of z n_z over the surface. The kernel's volume integral has an error of
    up to 3e-3 if outlines have hundreds of edges; its adaptive integral over a face is accurate.
    """
    volume_mm3 = 0.0
    for face in solid.faces().filter_by(Plane.XY):
        BRepGProp.SurfaceProperties_s(face.wrapped, properties := GProp_GProps(), _AREA_TOLERANCE)
        volume_mm3 += face.normal_at().Z * face.center().Z * properties.Mass()
    return volume_mm3


def _ridge_solid(plan: Plan, fibre: int, prisms: Sequence[Prism], fit_mm: float) -> Solid:
    """Build a ridge from its terraces, the upper first, drawn within `FINE_MM`; each stands on the one below."""
    *upper, lowest = prisms
    solid, below = _extrude(plan, fibre, lowest, fit_mm), lowest
    for prism in reversed(upper):
        solid = solid.fuse(_extrude(plan, fibre, replace(prism, bottom_mm=below.top_mm - _INTO_TERRACE_MM), fit_mm))
        below = prism
    return solid


def _extrude(plan: Plan, fibre: int, prism: Prism, fit_mm: float) -> Solid:
    """Extrude the exact outline of a terrace of a fibre's ridge, which is a single polygon."""
    settings = plan.settings
    below_mm = settings.mould.floor_mm + plan.heights_mm[plan.layer_indices[fibre]] - prism.top_mm
    joints = find_joints(plan, fibre, settings.mould.ridge_width_mm / 2 + below_mm * settings.ridge_slope)
    outline = shapely.remove_repeated_points(insert_joints(prism.area, joints), _MIN_EDGE_MM)
    (rings,) = polygon_rings(outline)
    curves = [ring_curves(ring, joints, fit_mm) for ring in rings]
    outer, *holes = [Wire([_edge(curve, prism.bottom_mm) for curve in ring]) for ring in curves]
    face = Face(outer, holes)
    return Solid.extrude(face, Vector(0, 0, prism.top_mm - prism.bottom_mm))


def _edge(curve: OutlineCurve, z: float) -> Edge:
    """Return the edge of an outline's curve at a height; its ends are exactly the outline's vertices."""
    start, end = [(x, y, z) for x, y in np.round(curve.points[[0, -1]], _DECIMALS).tolist()]
    if curve.spline is not None:
        poles = np.round(curve.spline.c, _DECIMALS).tolist()
        return Edge.make_bspline([(x, y, z) for x, y in poles], curve.spline.t.tolist(), 3)
    if curve.arc is not None:
        x, y, radius, angle, sweep = curve.arc
        half = angle + sweep / 2
        middle = np.round([x + radius * np.cos(half), y + radius * np.sin(half)], _DECIMALS + 2)
        first, second, third = gp_Pnt(*start), gp_Pnt(*middle.tolist(), z), gp_Pnt(*end)
        arc = GC_MakeArcOfCircle(first, second, third).Value()
        return Edge(BRepBuilderAPI_MakeEdge(arc, first, third).Edge())  # the arc alone has slightly other ends
    return Edge.make_line(start, end)


def build_parts(plan: Plan, bodies: Mapping[str, Body]) -> dict[str, list[CadPart]]:
    """Build the parts of all printed bodies of a pad from the plan of the finished pad, in their order."""
    built = {}
    for name, body in bodies.items():
        if name == "mould":
            built[name] = mould_parts(plan.shrinkage_compensated, name)
        elif name == "conductive":
            built[name] = mould_parts(mould.conductive_plan(plan).shrinkage_compensated, name)
        else:
            built[name] = [_build_part(name, BODY_COLOURS[name], body, name)]
    return built


def assemble(bodies: Mapping[str, Sequence[CadPart]], plan: Plan) -> Compound:
    """Assemble all bodies: the mould, which is the first, the lid on its rim, the others side by side."""
    shapes = [
        Compound(label=name, children=[part.shape for part in parts]) if len(parts) > 1 else parts[0].shape
        for name, parts in bodies.items()
    ]
    if len(shapes) == 1:
        return shapes[0]
    x_mm = shapes[0].bounding_box().max.X
    for shape in shapes[1:]:
        box = shape.bounding_box()
        if shape.label == "lid":
            shape.locate(Location((0.0, 0.0, plan.settings.mould.floor_mm + plan.silicone_mm)))
        else:
            shape.locate(Location((x_mm + 10.0 - box.min.X, 0.0, 0.0)))
            x_mm = shape.bounding_box().max.X
    return Compound(label="moulds of the pad", children=shapes)


def fuse(parts: Sequence[CadPart], name: str) -> Solid:
    """Unite the parts of a body into one solid, in a process that is killed after `FUSE_S`."""
    with TemporaryDirectory() as folder:
        solids = [solid for part in parts for solid in part.shape.solids()]
        paths = [Path(folder) / f"{k}.brep" for k in range(len(solids))]
        for path, solid in zip(paths, solids, strict=True):
            export_brep(solid, path)
        fused = Path(folder) / "whole.brep"
        with suppress(subprocess.SubprocessError):
            subprocess.run(
                [sys.executable, "-c", _FUSE, fused, *paths], timeout=FUSE_S, check=True, capture_output=True
            )
        shape = import_brep(fused) if fused.exists() else None
    solids = shape.solids() if shape else []
    if len(solids) != 1 or not solids[0].is_valid:
        raise InputError(f"{name}: the CAD kernel makes no single solid of it within {FUSE_S:g} s; use the parts")
    return _label(solids[0], name, BODY_COLOURS[name])


def body_solid(body: Body) -> Solid | Compound:
    """Build a body by Boolean operations of its prisms, mm: a `Solid`, or a `Compound` of several."""

    def solids(prisms: Iterable[Prism]) -> Iterator[Solid]:
        return (solid for prism in prisms for solid in prism_solids(prism))

    solid, *others = solids(body.base)
    if others:
        solid = solid.fuse(*others)
    if body.cuts:
        solid = solid.cut(*solids(body.cuts))
    return solid.fuse(*solids(body.adds)) if body.adds else solid


def prism_solids(prism: Prism) -> list[Solid]:
    """Build one `Solid` for every polygon of a prism; circles become cylinders or cones."""

    def wire(ring: np.ndarray, z: float) -> Wire:
        return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)

    polygons, height = polygon_rings(shapely.simplify(prism.area, _MIN_EDGE_MM)), prism.top_mm - prism.bottom_mm
    arc = None
    if len(polygons) == 1 and len(polygons[0]) == 1 and len(polygons[0][0]) >= _MIN_CIRCLE_CORNERS:
        arc = fit_arc(polygons[0][0])
    if arc:
        x, y, radius = arc[:3]
        base = Plane((x, y, prism.bottom_mm))
        if prism.flare_mm:
            return [Solid.make_cone(radius, radius + prism.flare_mm, height, base)]
        return [Solid.make_cylinder(radius, height, base)]
    if not prism.flare_mm:
        wires = [[wire(ring, prism.bottom_mm) for ring in rings] for rings in polygons]
        return [Solid.extrude(Face(outer, holes), Vector(0, 0, height)) for outer, *holes in wires]
    low, high = np.reshape(prism.area.bounds, (2, 2))
    scale = 1 + 2 * prism.flare_mm / (high - low)
    flared = affinity.scale(prism.area, *scale, origin=tuple((low + high) / 2))
    (((bottom,),), ((top,),)) = polygons, polygon_rings(flared)
    low_points, high_points = (
        [Vector(x, y, z) for x, y in ring.tolist()] for ring, z in ((bottom, prism.bottom_mm), (top, prism.top_mm))
    )
    sides = [[low_points[k - 1], low_points[k], high_points[k], high_points[k - 1]] for k in range(len(bottom))]
    planes = [Face(Wire.make_polygon(points, close=True)) for points in (low_points, high_points, *sides)]
    return [Solid(Shell(planes))]  # a loft would make splines instead of planes
