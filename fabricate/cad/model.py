"""The CAD model of what is printed: named and coloured parts in one assembly, of true curves.

Importing this module loads the CAD kernel, which takes seconds: import it where it is used.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from build123d import Color, Compound, Face, Location, Plane, Solid, Vector, Wire
from OCP.BRepGProp import BRepGProp
from OCP.GProp import GProp_GProps
from OCP.Standard import Standard_Failure
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from padforge.design.common.plotting import HORIZONTAL, VERTICAL
from padforge.design.common.validation import InputError
from padforge.design.morphology import Morphology
from padforge.fabricate.cad.curves import arc_through
from padforge.fabricate.cad.planar_map import HORIZONTAL_TRACKS as HORIZONTAL_TRACKS
from padforge.fabricate.cad.planar_map import TRAY
from padforge.fabricate.cad.planar_map import VERTICAL_TRACKS as VERTICAL_TRACKS
from padforge.fabricate.cad.planar_map import contact_mm2 as contact_area_mm2
from padforge.fabricate.cad.planar_map import fill_cells as fill_cells
from padforge.fabricate.cad.solids import solids
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

if TYPE_CHECKING:
    from manifold3d import Manifold

_MIN_CIRCLE_CORNERS = 32
"""A polygon of fewer corners is meant as one."""


def body_solid(body: Body) -> Any:
    """A body as a build123d `Solid`, or a `Compound` of several; lengths in mm."""
    solid: Any
    solid, *more = prism_solids(body.base)
    if more:
        solid = solid.fuse(*more)
    if body.cuts:
        solid = solid.cut(*prism_solids(body.cuts))
    return solid.fuse(*prism_solids(body.adds)) if body.adds else solid


def prism_solids(prisms: Iterable[Prism]) -> list[Solid]:
    """One solid for every polygon of every prism."""
    return [solid for prism in prisms for solid in _solids(prism)]


def _solids(prism: Prism) -> list[Solid]:
    polygons = polygon_rings(prism.area)
    if len(polygons) == 1 and len(polygons[0]) == 1 and (circle := _circle(polygons[0][0])):
        return [_round(prism, *circle)]
    if not prism.flare_mm:
        up = Vector(0, 0, prism.top_mm - prism.bottom_mm)
        wires = [[_wire(ring, prism.bottom_mm) for ring in rings] for rings in polygons]
        return [Solid.extrude(Face(outer, holes), up) for outer, *holes in wires]
    low, high = np.reshape(prism.area.bounds, (2, 2))
    x, y = 1 + 2 * prism.flare_mm / (high - low)
    grown = affinity.scale(prism.area, x, y, origin=tuple((low + high) / 2))
    (((bottom,),), ((top,),)) = polygons, polygon_rings(grown)
    return [Solid.make_loft([_wire(bottom, prism.bottom_mm), _wire(top, prism.top_mm)], ruled=True)]


def _circle(ring: np.ndarray) -> tuple[float, float, float] | None:
    """Middle and radius of the circle that a ring of many corners is drawn for."""
    arc = arc_through(ring) if len(ring) >= _MIN_CIRCLE_CORNERS else None
    return arc[:3] if arc else None


def _round(prism: Prism, x: float, y: float, radius: float) -> Solid:
    height, foot = prism.top_mm - prism.bottom_mm, Plane((x, y, prism.bottom_mm))
    if prism.flare_mm:
        return Solid.make_cone(radius, radius + prism.flare_mm, height, foot)
    return Solid.make_cylinder(radius, height, foot)


def _wire(ring: np.ndarray, z: float) -> Wire:
    return Wire.make_polygon([Vector(x, y, z) for x, y in ring.tolist()], close=True)


# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.


FITS_MM = (2e-3, 5e-4, 1e-4)
"""How near curves are to the exact outlines; where the kernel finds a solid invalid, it is tried with the next.

Curves that hardly cross may do so in another order than what they stand for, which finer ones do not.
"""
_TRACKS = {HORIZONTAL_TRACKS: HORIZONTAL, VERTICAL_TRACKS: VERTICAL}
_GREY = "#5D6B7A"
_ROUND = 512
"""Sides of the polygons that stand for circles until they become arcs: cut anywhere, also on a chord, they do."""
_APART_MM = 10.0
"""Between bodies that stand side by side."""
_EXACT = 1e-2
"""Error asked for of volumes and surfaces, as a share: what comes is a million times better, unlike without asking."""


@dataclass(frozen=True)
class Model:
    """A body in CAD.

    Attributes:
        shape: its named parts, which touch and do not overlap. contact_mm2: the area where they touch.
        fit_mm: how near its curves are to the exact outlines; 0 where it has none.
    """

    shape: Compound
    contact_mm2: float = 0.0
    fit_mm: float = 0.0

    def apart(self, mesh: "Manifold") -> tuple[float, float]:
        """How far volume and surface lie from those of a mesh of the same body, as shares of them."""
        volumes, surfaces = GProp_GProps(), GProp_GProps()
        BRepGProp.VolumeProperties_s(self.shape.wrapped, volumes, _EXACT)
        BRepGProp.SurfaceProperties_s(self.shape.wrapped, surfaces, _EXACT)
        surface_mm2 = surfaces.Mass() - 2 * self.contact_mm2
        return abs(volumes.Mass() / mesh.volume() - 1), abs(surface_mm2 / mesh.surface_area() - 1)


def build_mould(pad: Morphology, settings: FabricationSettings = DEFAULTS) -> Compound:
    """The mould in CAD: tray, horizontal tracks, vertical tracks, numbers and pins, each named and coloured.

    Args:
        pad: the fibres.
        settings: tray, ridges and fibre.

    Returns:
        An assembly of closed solids, mm, which touch and do not overlap.

    Raises:
        InputError: settings that contradict each other or refuse this pad, or no valid solid comes out.
    """
    plan = Plan(pad, settings)
    plan.require_levels()
    return mould_model(plan.shrinkage_compensated, "mould").shape


def mould_model(plan: Plan, name: str, wells: Sequence[BaseGeometry] = ()) -> Model:
    """The mould of a plan.

    Args:
        wells: outlines that belong to the ridges of each level; none for a pad whose fibres are laid.

    Raises:
        InputError: the CAD kernel finds a solid invalid, however fine its curves.
    """
    for fit_mm in FITS_MM:
        drawing, parts = fill_cells(plan, fit_mm, wells)
        together = _valid({part.name: partial(solids, drawing, part.spans) for part in parts})
        if together:
            break
    else:
        raise InputError(f"{name}: the CAD kernel finds a solid invalid; leave step out of the formats")
    colours = {TRAY: BODY_COLOURS["mould"], **_TRACKS}
    children = [_part(part, own, colours.get(part, _GREY)) for part, own in together.items()]
    contact = contact_area_mm2(drawing, parts)
    if plan.settings.mould.pins:
        standing = [replace(pin, bottom_mm=pin.bottom_mm + INTO_FLOOR_MM) for pin in registration_pins(plan)]
        children.append(_part("pins", prism_solids(standing), _GREY))
        contact += sum(pin.area.area for pin in standing)
    return Model(Compound(label=name, children=children), contact, fit_mm)


def body_model(body: Body, name: str) -> Model:
    """A body of few prisms: a lid, a holder.

    Raises:
        InputError: the CAD kernel finds the solid invalid.
    """
    own = _valid({name: lambda: body_solid(body).solids()})
    if not own:
        raise InputError(f"{name}: the CAD kernel finds the solid invalid; leave step out of the formats")
    return Model(_part(name, own[name], BODY_COLOURS[name]))


def _valid(makes: Mapping[str, Callable[[], Iterable[Solid]]]) -> dict[str, list[Solid]] | None:
    """The solids of every part, or None if the kernel finds one invalid or cannot make it."""
    try:
        together = {part: list(make()) for part, make in makes.items()}
        return together if all(solid.is_valid for own in together.values() for solid in own) else None
    except (Standard_Failure, RuntimeError, ValueError):  # the kernel's own, and build123d's of what it was given
        return None


def models(plan: Plan, bodies: Mapping[str, Body]) -> list[Model]:
    """All bodies of a pad in CAD, in their order: the moulds from their plans, the others from what they are made of.

    Args:
        plan: of the pad as used.

    Raises:
        InputError: the CAD kernel finds a solid invalid.
    """
    made = []
    for name, body in bodies.items():
        if name == "mould":
            made.append(mould_model(plan.shrinkage_compensated, name))
        elif name == "conductive":
            second = conductive_plan(plan).shrinkage_compensated
            made.append(mould_model(second, name, well_outlines(second, sides=_ROUND)))
        else:
            made.append(body_model(body, name))
    return made


def assembly(models: Sequence[Model], plan: Plan) -> Compound:
    """All that is printed for a pad: the lid on the rim of the mould, which is of a plan, and the others beside it."""
    if len(models) == 1:
        return models[0].shape
    beside, children = 0.0, []
    for model in models:
        box = model.shape.bounding_box()
        if model.shape.label == "lid":
            place = (0.0, 0.0, plan.settings.mould.floor_mm + plan.silicone_mm)
        else:
            place = (beside - box.min.X if children else 0.0, 0.0, 0.0)
            beside = place[0] + box.max.X + _APART_MM
        children.append(model.shape.locate(Location(place)))
    return Compound(label="moulds of the pad", children=children)


def _part(name: str, own: Iterable[Solid], colour: str) -> Any:
    part = Compound(list(own), label=name)
    part.color = Color(colour)
    return part
