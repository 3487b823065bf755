"""CAD models of what is printed: named and coloured parts with exact curves, in one assembly.

A mould is built face by face from its plan, without Boolean operations. A lid or holder, which has few faces, is built
by build123d. Importing this module loads the CAD kernel (OCP), which takes half a second: import it where it is used.
"""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from OCP.BRepAdaptor import BRepAdaptor_Surface
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.BRepGProp import BRepGProp
from OCP.GeomAbs import GeomAbs_Cylinder, GeomAbs_Plane, GeomAbs_SurfaceOfExtrusion
from OCP.GProp import GProp_GProps
from OCP.Standard import Standard_Failure
from OCP.TopAbs import TopAbs_FACE, TopAbs_REVERSED
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from padforge.common.plotting import HORIZONTAL, VERTICAL
from padforge.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate.mould import (
    BODY_COLOURS,
    INTO_FLOOR_MM,
    Body,
    Prism,
    conductive_plan,
    registration_pins,
    well_outlines,
)
from padforge.fabricate.plan import Plan, polygon_rings
from padforge.fabricate.settings import DEFAULTS, FabricationSettings

from .curves import fit_arc
from .planar_map import HORIZONTAL_TRACKS, TRAY, VERTICAL_TRACKS, compute_contact_area, fill_cells
from .solids import build_solids
from .step_file import CadPart

if TYPE_CHECKING:
    from build123d import Compound, Solid
    from manifold3d import Manifold

FIT_TOLERANCES_MM = (2e-3, 5e-4, 1e-4)
"""Tolerances of curves against the finely drawn outlines; the next is tried where the kernel finds a solid invalid.

Curves that hardly cross may meet in another order than the outlines they replace; finer ones do not.
"""
_PART_COLOURS = {TRAY: BODY_COLOURS["mould"], HORIZONTAL_TRACKS: HORIZONTAL, VERTICAL_TRACKS: VERTICAL}
_GREY = "#5D6B7A"
_WELL_SIDES = 512
"""Sides of the polygons that stand for the round wells until these become arcs."""
_MIN_CIRCLE_CORNERS = 32
"""Polygons of fewer corners are no circles."""
_SPACING_MM = 10.0
"""Distance between bodies that stand side by side."""
_AREA_TOLERANCE = 1e-2
"""Relative error asked for of areas; it selects an adaptive integration that is faster and far more accurate."""


@dataclass(frozen=True)
class CadModel:
    """CAD model of a printed body.

    Attributes:
        part: body, or assembly of its parts, which touch and do not overlap.
        contact_mm2: area where parts touch.
        fit_mm: tolerance of curves against outlines that are drawn within `FINE_MM`; 0 without curves.
    """

    part: CadPart
    contact_mm2: float = 0.0
    fit_mm: float = 0.0

    @property
    def shape(self) -> "Compound":
        """The model as a build123d `Compound` with labels and colours."""
        return _to_build123d(self.part)

    def compare(self, mesh: "Manifold") -> tuple[float, float]:
        """Return the relative deviations of volume and surface area from those of a mesh of the same body."""
        volume_mm3, area_mm2 = _measure(self.part.compound)
        area_mm2 -= 2 * self.contact_mm2
        return abs(volume_mm3 / mesh.volume() - 1), abs(area_mm2 / mesh.surface_area() - 1)


def _measure(shape: Any) -> tuple[float, float]:
    """Return volume and surface area of a shape of the kernel, mm³ and mm².

    By the divergence theorem the volume is the integral of z n_z over the surface. Upright walls have n_z = 0, so that
    a mould's volume follows from its planes; only shapes with cones need the kernel's slower integral.
    """
    volume_mm3, area_mm2, explorer = 0.0, 0.0, TopExp_Explorer(shape, TopAbs_FACE)
    while explorer.More():
        face, properties = TopoDS.Face(explorer.Current()), GProp_GProps()
        BRepGProp.SurfaceProperties_s(face, properties, _AREA_TOLERANCE)
        area_mm2 += properties.Mass()
        surface = BRepAdaptor_Surface(face, False)
        if surface.GetType() == GeomAbs_Plane:
            up = surface.Plane().Axis().Direction().Z() * (-1 if face.Orientation() == TopAbs_REVERSED else 1)
            volume_mm3 += up * properties.Mass() * properties.CentreOfMass().Z()
        elif surface.GetType() not in (GeomAbs_Cylinder, GeomAbs_SurfaceOfExtrusion):
            volume_mm3 = math.nan
        explorer.Next()
    if math.isnan(volume_mm3):
        BRepGProp.VolumeProperties_s(shape, properties := GProp_GProps())
        volume_mm3 = properties.Mass()
    return volume_mm3, area_mm2


def build_mould(pad: Morphology, settings: FabricationSettings = DEFAULTS) -> "Compound":
    """Build the CAD model of a mould: tray, horizontal tracks, vertical tracks, numbers and pins, named and coloured.

    Args:
        pad: fibres.
        settings: tray, ridges and fibre.

    Returns:
        Assembly of closed solids, mm, which touch and do not overlap.

    Raises:
        InputError: settings that contradict each other or refuse this pad, or no valid solid comes out.
    """
    plan = Plan(pad, settings)
    plan.require_levels()
    return build_mould_model(plan.shrinkage_compensated, "mould").shape


def build_mould_model(plan: Plan, name: str, wells: Sequence[BaseGeometry] = ()) -> CadModel:
    """Build the CAD model of the mould of a plan of what is printed, with wells that belong to its ridges, if any.

    Raises:
        InputError: the CAD kernel finds a solid invalid at every tolerance.
    """
    for fit_mm in FIT_TOLERANCES_MM:
        cells, fills = fill_cells(plan, fit_mm, wells)
        solids = _build_valid({part: partial(build_solids, cells, z_ranges) for part, z_ranges in fills.items()})
        if solids:
            break
    else:
        raise InputError(f"{name}: the CAD kernel finds a solid invalid; leave step out of the formats")
    parts = [CadPart(part, _PART_COLOURS.get(part, _GREY), shapes) for part, shapes in solids.items()]
    contact = compute_contact_area(cells, fills)
    if plan.settings.mould.pins:
        pins = [replace(pin, bottom_mm=pin.bottom_mm + INTO_FLOOR_MM) for pin in registration_pins(plan)]
        parts.append(CadPart("pins", _GREY, tuple(solid.wrapped for solid in prism_solids(pins))))
        contact += sum(pin.area.area for pin in pins)
    return CadModel(CadPart(name, children=tuple(parts)), contact, fit_mm)


def build_body_model(body: Body, name: str) -> CadModel:
    """Build the CAD model of a body of few prisms: a lid or a holder.

    Raises:
        InputError: the CAD kernel finds the solid invalid.
    """
    solids = _build_valid({name: lambda: [solid.wrapped for solid in body_solid(body).solids()]})
    if not solids:
        raise InputError(f"{name}: the CAD kernel finds the solid invalid; leave step out of the formats")
    return CadModel(CadPart(name, BODY_COLOURS[name], solids[name]))


def build_models(plan: Plan, bodies: Mapping[str, Body]) -> list[CadModel]:
    """Build the CAD models of all bodies of a pad, in their order; moulds are built from the plan of the pad as used.

    Raises:
        InputError: the CAD kernel finds a solid invalid.
    """
    models = []
    for name, body in bodies.items():
        if name == "mould":
            models.append(build_mould_model(plan.shrinkage_compensated, name))
        elif name == "conductive":
            second = conductive_plan(plan).shrinkage_compensated
            models.append(build_mould_model(second, name, well_outlines(second, sides=_WELL_SIDES)))
        else:
            models.append(build_body_model(body, name))
    return models


def assemble(models: Sequence[CadModel], plan: Plan) -> CadPart:
    """Return the assembly of all bodies, the mould first: the lid on the rim of the mould, the others side by side."""
    if len(models) == 1:
        return models[0].part
    x_mm, parts = 0.0, []
    for part in (model.part for model in models):
        x_min, x_max = _x_range(part)
        if part.name == "lid":
            position = (0.0, 0.0, plan.settings.mould.floor_mm + plan.silicone_mm)
        else:
            position = (x_mm - x_min if parts else 0.0, 0.0, 0.0)
            x_mm = position[0] + x_max + _SPACING_MM
        parts.append(replace(part, position_mm=position))
    return CadPart("moulds of the pad", children=tuple(parts))


def _build_valid(builders: Mapping[str, Callable[[], Iterable[Any]]]) -> dict[str, tuple[Any, ...]] | None:
    """Return the solids of every part, or None if the kernel finds one invalid or cannot build it."""
    try:
        solids = {part: tuple(build()) for part, build in builders.items()}
    except (Standard_Failure, RuntimeError, ValueError):  # the kernel's, and build123d's about what it was given
        return None
    return solids if all(is_valid(solid) for part in solids.values() for solid in part) else None


def is_valid(solid: Any) -> bool:
    """Tell whether the CAD kernel finds a solid valid: closed, with faces within their tolerances."""
    return BRepCheck_Analyzer(solid, True, True).IsValid()


def _x_range(part: CadPart) -> tuple[float, float]:
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    box = Bnd_Box()
    BRepBndLib.AddOptimal_s(part.compound, box)
    return box.CornerMin().X(), box.CornerMax().X()


def _to_build123d(part: CadPart) -> "Compound":
    from build123d import Color, Compound, Location, Solid

    shape = Compound([Solid(solid) for solid in part.solids]) if part.solids else Compound()
    shape.label = part.name
    shape.children = [_to_build123d(child) for child in part.children]
    if part.colour:
        shape.color = Color(part.colour)
    return shape.locate(Location(part.position_mm))


def body_solid(body: Body) -> Any:
    """Build the `Solid` of a body by Boolean operations of its prisms, or the `Compound` of several; mm."""
    solid: Any
    solid, *others = prism_solids(body.base)
    if others:
        solid = solid.fuse(*others)
    if body.cuts:
        solid = solid.cut(*prism_solids(body.cuts))
    return solid.fuse(*prism_solids(body.adds)) if body.adds else solid


def prism_solids(prisms: Iterable[Prism]) -> list["Solid"]:
    """Build one `Solid` for every polygon of every prism; circles become cylinders and cones."""
    return [solid for prism in prisms for solid in _prism_solids(prism)]


def _prism_solids(prism: Prism) -> list["Solid"]:
    from build123d import Face, Plane, Solid, Vector, Wire

    def wire(ring: np.ndarray, z: float) -> Wire:
        return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)

    polygons, height = polygon_rings(prism.area), prism.top_mm - prism.bottom_mm
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
    return [Solid.make_loft([wire(bottom, prism.bottom_mm), wire(top, prism.top_mm)], ruled=True)]
