"""Drawings of shapes whose cells can be counted."""

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from fabricate.mould.cad.outlines.drawing import GRID_MM, Drawing, edges
from fabricate.mould.cad.outlines.pieces import straight_pieces
from tests.helpers.effort import few


def drawn(*areas: shapely.Polygon) -> Drawing:
    lines = [area.boundary for area in areas]
    return Drawing(lines, [piece for line in lines for piece in straight_pieces(line)])


def test_two_squares_that_overlap_make_three_cells():
    drawing = drawn(shapely.box(0, 0, 2, 2), shapely.box(1, 1, 3, 3))
    assert sorted(shapely.area(drawing.cells)) == pytest.approx([1, 3, 3])
    assert shapely.contains_xy(drawing.cells, *drawing.middles.T).all()


def test_what_lies_within_makes_a_hole():
    drawing = drawn(shapely.box(0, 0, 9, 9), shapely.box(3, 3, 6, 6))
    assert sorted(shapely.area(drawing.cells)) == pytest.approx([9, 72])
    assert not drawing.thin()


@st.composite
def triangles(draw: st.DrawFn) -> list[shapely.Polygon]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count = draw(st.integers(1, 6))
    return [shapely.Polygon(corners) for corners in rng.uniform(0, 9, (count, 3, 2))]


@given(triangles())
@few(20)
def test_every_edge_is_there_once_with_what_lies_beside_it(areas):
    drawing = drawn(*areas)
    known = set(drawing.edges)
    assert len(known) == len(drawing.edges)
    assert not known & {(b, a) for a, b in known}
    for (a, b), (left, right), piece in zip(drawing.edges, drawing.sides, drawing.pieces_of, strict=True):
        start, end = GRID_MM * np.array(a), GRID_MM * np.array(b)
        middle, along = (start + end) / 2, (end - start) / np.linalg.norm(end - start)
        assert shapely.LineString(drawing.pieces[piece].points).distance(shapely.Point(middle)) < 2 * GRID_MM
        if np.linalg.norm(end - start) < 1e-3:
            continue
        for side, way in ((left, 1), (right, -1)):
            beside = shapely.Point(middle + way * 1e-5 * np.array([-along[1], along[0]]))
            inside = [k for k, cell in enumerate(drawing.cells) if cell.contains(beside)]
            assert inside in ([side], []) if side >= 0 else inside == []
    around = sum(
        math.dist(a, b) * GRID_MM for (a, b), (_, right) in zip(drawing.edges, drawing.sides, strict=True) if right < 0
    )
    assert around == pytest.approx(shapely.union_all(drawing.cells).length, rel=1e-6)


@given(triangles())
@few(20)
def test_cells_cover_what_was_drawn(areas):
    """And what they enclose between them."""
    drawing = drawn(*areas)
    covered = shapely.union_all(drawing.cells)
    assert shapely.area(drawing.cells).sum() == pytest.approx(covered.area, rel=1e-6)
    outer = [shapely.Polygon(part.exterior) for part in shapely.get_parts(shapely.union_all(areas))]
    assert covered.area == pytest.approx(shapely.union_all(outer).area, rel=1e-6)


def test_slivers_belong_to_what_they_lie_along():
    """Two squares that should share a side, drawn 3 nanometres apart."""
    sliver = 3e-6
    drawing = drawn(shapely.box(0, 0, 1, 1), shapely.box(1 + sliver, 0, 3, 1), shapely.box(-1, -1, 4, 2))
    assert drawn(shapely.box(0, 0, 1, 1), shapely.box(1 + 1e-8, 0, 3, 1)).thin() == {}  # one line, on the grid
    overlap = drawn(shapely.box(0, 0, 1, 1), shapely.box(1 - sliver, 0, 3, 1), shapely.box(-1, -1, 4, 2))
    ((thin, beside),) = overlap.thin().items()
    assert overlap.cells[thin].area == pytest.approx(sliver)
    assert overlap.cells[beside].area == pytest.approx((1, 2)[overlap.cells[beside].area > 1.5], abs=1e-4)
    assert drawing.thin() == {}  # what is open between them is part of what lies around


def test_edges_of_a_ring_close():
    ring = np.array([[0, 0], [1, 0], [1, 1]])
    assert list(edges(ring)) == [
        ((0, 0), (10**6, 0)),
        ((10**6, 0), (10**6, 10**6)),
        ((10**6, 10**6), (0, 0)),
    ]
