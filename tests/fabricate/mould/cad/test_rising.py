"""Curves and surfaces over stretches of pieces: the CAD kernel's own values against those of the pieces."""

# pyright: reportAttributeAccessIssue=false
# The CAD kernel's modules come without types.

import math

import numpy as np
import pytest
import shapely
from OCP.gp import gp_Pnt, gp_Vec

from fabricate.mould.cad.outlines.arrangement import Chain
from fabricate.mould.cad.outlines.pieces import Piece, ring_pieces, straight_pieces
from fabricate.mould.cad.rising import Rising, rising, upright_line
from fabricate.mould.plan import polygon_rings

Array = np.ndarray


def round_pieces(clockwise: bool) -> list[Piece]:
    disc = shapely.Point(3, 4).buffer(2.0, quad_segs=64)
    return list(ring_pieces(polygon_rings(disc)[0][0][:: -1 if clockwise else 1], {}, 2e-3))


def waves() -> list[Piece]:
    t = np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    return list(ring_pieces(np.stack([8 * np.cos(t), 3 * np.sin(t) + np.cos(2 * t)], axis=1), {}, 2e-3))


PIECES = {
    "line": straight_pieces(shapely.LineString([(1, 2), (4, -2)]))[0],
    "arc": round_pieces(clockwise=False)[1],
    "arc clockwise": round_pieces(clockwise=True)[0],
    "spline": waves()[0],
    "last spline": waves()[-1],
}
STRETCHES = [(0.0, 1.0), (0.2, 0.9), (0.4, 0.5), (0.0, 0.1)]


def tilted(places: Array) -> Array:
    return 5 + 0.3 * places[:, 0] - 0.2 * places[:, 1]


def over(piece: Piece, start: float, end: float) -> tuple[Rising, Array]:
    """What rises over a stretch, and 50 places along it."""
    chain = Chain(0, start * piece.length, end * piece.length, (0, 1), -1, -1)
    places = piece.at(np.linspace(chain.start, chain.end, 50))
    return rising(piece, chain, places[[0, -1]]), places


def on_curve(curve, first: float, last: float) -> Array:
    points = [curve.Value(u) for u in np.linspace(first, last, 50).tolist()]
    return np.array([[point.X(), point.Y(), point.Z()] for point in points])


def beside(piece: Piece, start: float, end: float, points: Array) -> float:
    """How far points (n, 3) lie from a stretch of a piece seen from above."""
    line = shapely.LineString(piece.at(np.linspace(start, end, 5000) * piece.length))
    return max(line.distance(shapely.Point(x, y)) for x, y, _ in points)


@pytest.mark.parametrize("name", PIECES)
@pytest.mark.parametrize(("start", "end"), STRETCHES)
def test_level_curves_run_along_their_stretch(name, start, end):
    wall, places = over(PIECES[name], start, end)
    points = on_curve(*wall.curve(2.5))
    assert points[[0, -1]] == pytest.approx(np.column_stack([places[[0, -1]], [2.5, 2.5]]), abs=1e-9)
    assert points[:, 2] == pytest.approx(np.full(50, 2.5))
    assert points[:, :2] == pytest.approx(places, abs=1e-9)


@pytest.mark.parametrize("name", PIECES)
@pytest.mark.parametrize(("start", "end"), STRETCHES)
def test_curves_on_a_plane_that_leans(name, start, end):
    wall, places = over(PIECES[name], start, end)
    points = on_curve(*wall.curve(tilted))
    assert points[:, 2] == pytest.approx(tilted(points), abs=1e-9)
    assert points[:, :2] == pytest.approx(places, abs=1e-9)  # at the same shares of an arc, too


@pytest.mark.parametrize("name", PIECES)
@pytest.mark.parametrize(("start", "end"), STRETCHES)
@pytest.mark.parametrize("low", [2.0, tilted])
def test_edges_lie_on_the_surface_where_they_say(name, start, end, low):
    wall, _ = over(PIECES[name], start, end)
    surface = wall.surface(low, 30.0)
    for height in (low, 30.0):
        curve, first, last = wall.curve(height)
        across = wall.across(height)
        if across is None:
            assert name == "line"
            for point in on_curve(curve, first, last).tolist():
                away = gp_Vec(surface.Location(), gp_Pnt(*point))
                assert away.Dot(gp_Vec(surface.Axis().Direction())) == pytest.approx(0, abs=1e-9)
            continue
        for u in np.linspace(first, last, 20).tolist():
            at = across.Value(u)
            assert surface.Value(at.X(), at.Y()).Distance(curve.Value(u)) < 2e-7
    for which in (0, 1):
        upright = wall.upright(which, 4.0)
        if upright is not None:
            at, foot = upright.Value(1.5), wall.curve(7.0)
            assert surface.Value(at.X(), at.Y()).Distance(foot[0].Value(foot[1 + which])) < 1.5 + 1e-9
            assert surface.Value(at.X(), at.Y()).Z() == pytest.approx(5.5)


@pytest.mark.parametrize("name", PIECES)
def test_a_surface_says_which_way_it_looks(name):
    piece = PIECES[name]
    wall, _ = over(piece, 0.0, 1.0)
    surface = wall.surface(2.0, 4.0)
    across, first = wall.across(3.0), wall.curve(3.0)[1]
    point, along_u, along_v = gp_Pnt(), gp_Vec(), gp_Vec()
    at = across.Value(first) if across is not None else None
    surface.D1(at.X() if at else 0.0, at.Y() if at else 0.0, point, along_u, along_v)
    normal = along_u.Crossed(along_v)
    dx, dy = piece.tangent(0.0)
    assert (normal.X() * dy - normal.Y() * dx > 0) == wall.rightward
    assert normal.Z() == pytest.approx(0, abs=1e-9)


def test_kinds_of_surfaces():
    kinds = {name: type(over(piece, 0.0, 1.0)[0].surface(2.0, 3.0)).__name__ for name, piece in PIECES.items()}
    assert kinds == {
        "line": "Geom_Plane",
        "arc": "Geom_CylindricalSurface",
        "arc clockwise": "Geom_CylindricalSurface",
        "spline": "Geom_BSplineSurface",
        "last spline": "Geom_BSplineSurface",
    }


def test_an_arc_over_the_seam_goes_on():
    """Its angles are those of one round, so that no edge jumps over the seam of its cylinder."""
    for piece in (*round_pieces(clockwise=False), *round_pieces(clockwise=True)):
        wall, _ = over(piece, 0.1, 0.9)
        _, first, last = wall.curve(0.0)
        assert 0 <= first < 2 * math.pi
        assert last - first == pytest.approx(0.8 * math.pi)


def test_upright_lines():
    line = upright_line(1, 2, 3)
    assert line.Value(0).Distance(gp_Pnt(1, 2, 3)) == 0
    assert line.Value(2.5).Distance(gp_Pnt(1, 2, 5.5)) < 1e-12
