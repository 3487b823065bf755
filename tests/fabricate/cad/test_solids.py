"""Solids put together face by face or by the kernel, against volumes and surfaces that arithmetic gives."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ellipe
from shapely.geometry.base import BaseGeometry

from padforge.design.morphology import Morphology
from padforge.fabricate.cad.curves import edge_curves, ring_curves
from padforge.fabricate.cad.model import body_solid, prism_solids
from padforge.fabricate.cad.planar_map import FLOOR, RIM, Subdivision, Surface, TrayWalls, ZRange
from padforge.fabricate.cad.solids import build_solids
from padforge.fabricate.mesh import build_mesh as body_mesh
from padforge.fabricate.mould import Prism, cylinder, lid_body, sizes
from padforge.fabricate.plan import Plan, polygon_rings
from tests.fabricate.planted import with_settings

if TYPE_CHECKING:
    from build123d import Solid


def disc(x: float, y: float, radius: float) -> BaseGeometry:
    return shapely.Point(x, y).buffer(radius, quad_segs=512)


def drawn(*areas: BaseGeometry) -> Subdivision:
    pieces = []
    for area in areas:
        for ring in polygon_rings(area)[0]:
            pieces += ring_curves(ring, {}, 2e-3) if len(ring) > 100 else edge_curves(shapely.LinearRing(ring))
    return Subdivision([area.boundary for area in areas], pieces)


def built(areas: Sequence[BaseGeometry], top: Callable[[set[int]], float | None]) -> "list[Solid]":
    """The solids over z = 0 up to a height that is given for the set of areas which cover a cell."""
    drawing = drawn(*areas)
    spans: list[ZRange | None] = []
    for place in drawing.interior_points:
        height = top({k for k, area in enumerate(areas) if area.contains(shapely.Point(place))})
        spans.append(None if height is None else ZRange(0.0, height))
    return wrapped(drawing, spans)


def wrapped(drawing: Subdivision, spans: Sequence[ZRange | None]) -> "list[Solid]":
    from build123d import Solid  # takes seconds, also in workers that run other tests

    return [Solid(solid) for solid in build_solids(drawing, spans)]


def kinds(solid: "Solid") -> dict[str, int]:
    names = [face.geom_type.name for face in solid.faces()]
    return {name: names.count(name) for name in sorted(set(names))}


def test_build_solids_of_an_ellipse_has_spline_walls():
    """Over half of its outline the walls of a block that it overlaps rise higher."""
    t = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    ellipse = shapely.Polygon(np.stack([8 * np.cos(t), 3 * np.sin(t)], axis=1))
    heights = {(): None, (0,): 1.0}
    (solid,) = built([ellipse, shapely.box(0, -5, 20, 5)], lambda within: heights.get(tuple(within), 2.0))
    assert solid.is_valid
    half, length = 24 * math.pi / 2, 32 * float(ellipe(1 - 9 / 64))
    assert solid.volume == pytest.approx(half + 200 * 2, rel=1e-3)
    assert solid.area == pytest.approx(2 * (half + 200) + length / 2 + 2 * 60 - 6, rel=1e-3)
    assert kinds(solid)["EXTRUSION"] >= 2


def test_build_solids_of_steps_share_edges():
    """A tower on a plate: no face where they meet, one ring of walls from either height to the next."""
    (solid,) = built([shapely.box(0, 0, 4, 4), disc(2, 2, 1)], lambda within: {0: None, 1: 1.0, 2: 3.0}[len(within)])
    assert solid.is_valid
    assert solid.volume == pytest.approx(16 + 2 * math.pi, rel=1e-9)
    assert kinds(solid) == {"CYLINDER": 2, "PLANE": 4 + 3}
    assert solid.area == pytest.approx(2 * 16 + 16 + 2 * 2 * math.pi, rel=1e-9)


@pytest.mark.parametrize("apart", [0.0, -1e-3])
@pytest.mark.parametrize("other", [shapely.box(-5, -5, 5, 0), disc(0, -1.5, 1.5)], ids=["a line", "a circle"])
def test_build_solids_of_touching_circles(other, apart):
    """It comes no nearer than a grid's step, or overlaps in next to nothing."""
    found = built([other, disc(0, 1 + apart, 1.0)], lambda within: sum(1.0 + 2 * k for k in within) or None)
    assert all(solid.is_valid for solid in found)
    assert sum(solid.volume for solid in found) == pytest.approx(other.area + 3 * math.pi, rel=1e-4)
    if apart == -1e-3 and other.area == 50:
        aside = math.sqrt(1 - (1 + apart) ** 2)
        corners = [abs(vertex.X) for solid in found for vertex in solid.vertices() if abs(vertex.Y) < 1e-7]
        assert min(abs(x - aside) for x in corners) < 1e-7


BOWL = TrayWalls(np.array([[-3.0, -2.0, 3.0, 2.0]]), floor_mm=1.0, depth_mm=4.0, flare_mm=0.8)


def surfaces(drawing: Subdivision) -> list[Surface]:
    rim = BOWL.floor_mm + BOWL.depth_mm
    sheets = BOWL.planes(drawing.interior_points).tolist()
    return [BOWL.floor_mm if k == FLOOR else rim if k == RIM else (BOWL, k) for k in sheets]


def bowl_drawn(*areas: BaseGeometry) -> Subdivision:
    lines = [shapely.box(-5, -4, 5, 4).exterior, *BOWL.creases(), BOWL.outline(5.0).exterior]
    lines += [BOWL.outline(3.0).exterior] if areas else []
    within = drawn(*areas).curves if areas else []
    pieces = [*(piece for line in lines for piece in edge_curves(line)), *within]
    return Subdivision([*lines, *(area.boundary for area in areas)], pieces)


@pytest.mark.parametrize(("x", "y"), [(3.0, 0.0), (2.9, 1.9)])
def test_build_solids_on_flared_walls(x, y):
    """It ends where the wall comes out of its top; wherever it stands, its volume is that above what is below."""
    round_ = disc(x, y, 0.5)
    drawing = bowl_drawn(round_)
    heights = BOWL.heights(drawing.interior_points)
    spans = [
        ZRange(under, 3.0) if round_.contains(shapely.Point(place)) and height < 3.0 else None
        for under, place, height in zip(surfaces(drawing), drawing.interior_points, heights, strict=True)
    ]
    (solid,) = wrapped(drawing, spans)
    assert solid.is_valid
    grid = (np.arange(1000) + 0.5) / 1000 - 0.5
    places = np.stack(np.meshgrid(x + grid, y + grid), axis=-1).reshape(-1, 2)
    places = places[np.hypot(*(places - (x, y)).T) < 0.5]
    assert solid.volume == pytest.approx(np.maximum(3.0 - BOWL.heights(places), 0).sum() * 1e-6, rel=1e-3)


def test_build_solids_end_curves_at_their_top():
    """Drawn, the drum stays below its top where two walls meet; its own curve crosses their crease a little above."""
    walls = replace(BOWL, hollows=np.array([[-3.0, -2.0, 3.0, 2.0], [-1.0, -2.0, 1.0, 4.0]]))
    short, astray = 1e-4, 3e-4
    away = (0.5 + short) / math.sqrt(2)
    round_ = disc(1.4 - away, 2.4 - away, 0.5)
    lines = [*walls.creases(), walls.outline(3.0).exterior]
    pieces = [*(piece for line in lines for piece in edge_curves(line)), *drawn(round_).curves]
    drawing = Subdivision([*lines, round_.boundary], pieces)
    for number, piece in enumerate(pieces):
        if piece.arc is not None:
            x, y, radius, *angles = piece.arc
            pieces[number] = replace(piece, arc=(x, y, radius + astray, *angles))
    sheets = walls.planes(drawing.interior_points).tolist()
    spans = [
        ZRange(walls.floor_mm if k == FLOOR else (walls, k), 3.0) if round_.contains(shapely.Point(place)) else None
        for k, place in zip(sheets, drawing.interior_points, strict=True)
    ]
    (solid,) = wrapped(drawing, spans)
    assert solid.is_valid
    assert max(vertex.Z for vertex in solid.vertices()) == pytest.approx(3.0, abs=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
@settings(max_examples=2)
def test_build_solids_of_random_areas_match_cell_volumes(seed, count):
    rng = np.random.default_rng(seed)
    areas = [disc(*row) for row in rng.uniform([0, 0, 0.3], [4, 4, 1.5], (count, 3))]
    areas += [shapely.box(*low, *(low + size)) for low, size in rng.uniform(0.2, 3, (2, 2, 2))]
    tops = rng.uniform(0.5, 3, len(areas))
    found = built(areas, lambda within: max((tops[k] for k in within), default=None))
    assert all(solid.is_valid for solid in found)
    drawing = drawn(*areas)
    volume = 0.0
    for cell, place in zip(drawing.cells, drawing.interior_points, strict=True):
        within = [top for area, top in zip(areas, tops, strict=True) if area.contains(shapely.Point(place))]
        volume += cell.area * max(within, default=0.0)
    assert sum(solid.volume for solid in found) == pytest.approx(volume, rel=1e-5)


@pytest.mark.parametrize(
    ("prism", "volume", "faces"),
    [
        (Prism(shapely.box(0, 0, 1, 2), 1, 4), 6, {"PLANE": 6}),
        (Prism(cylinder(3, 4, 2.0), 0, 5), 5 * math.pi, {"CYLINDER": 1, "PLANE": 2}),
        (Prism(cylinder(0, 0, 2.0), 0, 3, flare_mm=1.0), math.pi * (1 + 2 + 4), {"CONE": 1, "PLANE": 2}),
        (Prism(cylinder(0, 0, 2.0, sides=8), 0, 1), 4 * math.sin(math.pi / 4), {"PLANE": 10}),
        (Prism(shapely.box(0, 0, 4, 2), 0, 3, flare_mm=0.5), 3 * (8 + 4.5 * 2.5 * 4 + 15) / 6, None),
        (Prism(shapely.box(0, 0, 3, 3) - shapely.box(1, 1, 2, 2), 0, 2), 16, {"PLANE": 10}),
    ],
)
def test_prism_solids_have_true_faces(prism, volume, faces):
    (solid,) = prism_solids([prism])
    assert solid.is_valid
    assert solid.volume == pytest.approx(volume, rel=1e-9)
    assert faces in (None, kinds(solid))
    box = solid.bounding_box()
    assert pytest.approx((prism.bottom_mm, prism.top_mm), abs=1e-6) == (box.min.Z, box.max.Z)


def test_body_solid_of_a_lid_has_closed_form_volume():
    everything = {"pins": True, "lid": True, "spout": True, "border_mm": 1.0}
    plan = Plan(Morphology.straight(1), with_settings(everything))
    flare = 6 * math.tan(math.radians(30))

    def cone(low, high, height):
        return math.pi * height * (low**2 + low * high + high**2) / 3

    holes = math.pi * (4 * 0.75**2 + 3 * ((sizes(plan)["pin_mm"] + 0.3) / 2) ** 2 + 3.0**2)
    plate = 3 * (sizes(plan)["tray_mm"] ** 2 - holes)
    cup = cone(5 + flare * 0.2 / 6.2, 5 + flare, 6.0)
    solid = body_solid(lid_body(plan))
    assert solid.is_valid
    assert solid.volume == pytest.approx(plate + cup - cone(3.0, 3 + flare, 6.0), rel=1e-7)
    assert solid.volume == pytest.approx(body_mesh(lid_body(plan)).volume(), rel=3e-4)
    assert kinds(solid) == {"CONE": 2, "CYLINDER": 8, "PLANE": 7}
