"""Cells of drawn shapes and the chains of curves between them, against places where circles and lines meet."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry.base import BaseGeometry

from fabricate.mould.cad.outlines.arrangement import Arrangement, Loop
from fabricate.mould.cad.outlines.drawing import Drawing
from fabricate.mould.cad.outlines.pieces import ring_pieces, straight_pieces
from fabricate.mould.plan import polygon_rings


def disc(x: float, y: float, radius: float) -> shapely.Polygon:
    """A circle that is drawn within 0.3 µm per mm of its radius."""
    return shapely.Point(x, y).buffer(radius, quad_segs=512)


def drawn(*areas: BaseGeometry) -> Drawing:
    pieces = []
    for area in areas:
        for ring in polygon_rings(area)[0]:
            pieces += ring_pieces(ring, {}, 2e-3) if len(ring) > 100 else straight_pieces(shapely.LinearRing(ring))
    return Drawing([area.boundary for area in areas], pieces)


def arranged(*areas: BaseGeometry, alike: bool = False) -> tuple[Arrangement, Drawing]:
    """The arrangement of all cells, which are of a kind each, or all of one."""
    drawing = drawn(*areas)
    return Arrangement(drawing, [0 if alike else k for k in range(len(drawing.cells))]), drawing


def used(arrangement: Arrangement) -> np.ndarray:
    """The places where chains begin and end."""
    return arrangement.nodes[sorted({node for chain in arrangement.chains for node in chain.nodes})]


def area_within(arrangement: Arrangement, loops: Sequence[Loop]) -> float:
    """Green's theorem along the curves of loops, each of which is seen to close."""
    area = 0.0
    for loop in loops:
        chains = [(arrangement.chains[k], forward) for k, forward in loop]
        for (chain, forward), (after, ahead) in zip(chains, [*chains[1:], chains[0]], strict=True):
            assert chain.nodes[1 if forward else 0] == after.nodes[0 if ahead else 1]
        for chain, forward in chains:
            piece = arrangement.pieces[chain.piece]
            for node, s in zip(chain.nodes, (chain.start, chain.end), strict=True):
                off = np.linalg.norm(piece.at(s) - arrangement.nodes[node])
                assert off <= arrangement.slack_mm[node] + 1e-12
            nodes, weights = np.polynomial.legendre.leggauss(40)
            s = (chain.start + chain.end) / 2 + (chain.end - chain.start) / 2 * nodes
            (x, y), (dx, dy) = piece.at(s).T, piece.tangent(s).T
            area += (1 if forward else -1) * (chain.end - chain.start) / 4 * weights @ (x * dy - y * dx)
    return float(area)


@given(st.floats(0.5, 3), st.floats(0.5, 3), st.floats(0.05, 0.95), st.floats(0, 6.3))
@settings(max_examples=5)
def test_circles_meet_where_circles_meet(r, other, share, angle):
    apart = abs(r - other) + share * (r + other - abs(r - other))
    arrangement, drawing = arranged(disc(0, 0, r), disc(apart * math.cos(angle), apart * math.sin(angle), other))
    assert len(drawing.cells) == 3
    along = (apart**2 + r**2 - other**2) / (2 * apart)
    aside = math.sqrt(r**2 - along**2)
    turned = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    meets = np.array([[along, aside], [along, -aside]]) @ turned
    for place in meets:
        assert np.linalg.norm(used(arrangement) - place, axis=1).min() < 1e-8
    assert arrangement.slack_mm.max() < 1e-8
    lens = [k for k, cell in enumerate(drawing.cells) if cell.contains(shapely.Point(meets.mean(axis=0)))]
    (loops,) = arrangement.faces(lens)
    one, two = (math.acos(a / b) for a, b in ((along, r), (apart - along, other)))
    expected = r**2 * (one - math.sin(2 * one) / 2) + other**2 * (two - math.sin(2 * two) / 2)
    assert area_within(arrangement, loops) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_there_is_no_border_between_cells_of_one_kind():
    arrangement, drawing = arranged(shapely.box(0, 0, 2, 2), shapely.box(1, 1, 3, 3), alike=True)
    assert sum(chain.end - chain.start for chain in arrangement.chains) == pytest.approx(12)
    assert all(min(chain.left, chain.right) == -1 for chain in arrangement.chains)
    assert len(arrangement.chains) == 8
    assert area_within(arrangement, next(arrangement.faces(range(len(drawing.cells))))) == pytest.approx(7)


def test_cells_that_hang_together_are_one_face_and_others_are_not():
    arrangement, drawing = arranged(shapely.box(0, 0, 2, 2), shapely.box(1, 1, 3, 3), shapely.box(7, 7, 8, 8))
    faces = list(arrangement.faces(range(len(drawing.cells))))
    assert sorted(area_within(arrangement, loops) for loops in faces) == pytest.approx([1, 7])


@given(st.integers(0, 2**32 - 1), st.integers(2, 5))
@settings(max_examples=5)
def test_any_discs(seed, count):
    rng = np.random.default_rng(seed)
    circles = rng.uniform([0, 0, 0.3], [5, 5, 2], (count, 3)).tolist()
    arrangement, drawing = arranged(*(disc(x, y, radius) for x, y, radius in circles))
    for number, cell in enumerate(drawing.cells):
        for loops in arrangement.faces([number]):
            assert area_within(arrangement, loops) == pytest.approx(cell.area, abs=1e-3)
    for chain in arrangement.chains:
        assert chain.start < chain.end
        assert chain.left != chain.right
    whole = [area_within(arrangement, loops) for loops in arrangement.faces(range(len(drawing.cells)))]
    assert sum(whole) == pytest.approx(shapely.area(drawing.cells).sum(), abs=1e-3)


@pytest.mark.parametrize("apart", [0.0, 1e-7, -1e-7, 1e-5, -1e-5, -1e-3])
@pytest.mark.parametrize("other", [shapely.box(-5, -5, 5, 0), disc(0, -1.5, 1.5)], ids=["a line", "a circle"])
def test_a_circle_that_touches(other, apart):
    """They come no nearer than a grid's step, or overlap in next to nothing: loops close whatever is made of it."""
    arrangement, drawing = arranged(other, disc(0, 1 + apart, 1.0))
    for number, cell in enumerate(drawing.cells):
        for loops in arrangement.faces([number]):
            assert area_within(arrangement, loops) == pytest.approx(cell.area, abs=2e-3)
    assert arrangement.slack_mm.max() < 1e-3
    if apart == -1e-3 and other.area == 50:
        aside = math.sqrt(1 - (1 + apart) ** 2)
        for x in (-aside, aside):
            assert np.linalg.norm(used(arrangement) - (x, 0), axis=1).min() < 1e-8
