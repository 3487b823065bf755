"""CAD solids made of meshes, with shapes small enough to count their faces."""

import numpy as np
import pytest
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from manifold3d import Manifold, Mesh64

from fabricate.mould.cad.bodies import body_solid
from fabricate.mould.cad.facets import faceted_solid
from fabricate.mould.mesh import mesh
from fabricate.mould.prisms import Body, Prism


def test_a_box():
    solid = faceted_solid(mesh(Body((Prism(shapely.box(0, 0, 1, 2), 0, 3),))))
    assert solid.is_valid
    assert (len(solid.faces()), len(solid.edges()), len(solid.vertices())) == (6, 12, 8)
    assert solid.volume == pytest.approx(6)


def test_a_hole_through_it():
    ring = shapely.box(0, 0, 3, 3).difference(shapely.box(1, 1, 2, 2))
    solid = faceted_solid(mesh(Body((Prism(ring, 0, 2),))))
    assert solid.is_valid
    assert len(solid.faces()) == 4 + 4 + 2
    assert solid.volume == pytest.approx(16)


def test_edges_too_short_for_the_kernel_are_contracted():
    notched = shapely.Polygon([(0, 0), (1, 0), (1, 1), (0.5, 1), (0.5, 1 - 1e-7), (0, 1 - 1e-7)])
    solid = faceted_solid(mesh(Body((Prism(notched, 0, 1),))))
    assert solid.is_valid
    assert solid.volume == pytest.approx(1, abs=1e-6)


def test_a_vertex_inside_a_face():
    """Meshes of others may have a face divided from within: none of its edges there bounds anything."""
    fine = trimesh.creation.box((2, 2, 2)).subdivide().subdivide()
    solid = faceted_solid(Manifold(Mesh64(fine.vertices, fine.faces.astype(np.uint64))))
    assert solid.is_valid
    assert len(solid.faces()) == 6
    assert solid.volume == pytest.approx(8)


@pytest.mark.parametrize("low", [1.0, 0.5])
def test_parts_that_meet_in_one_upright_line(low):
    """Two blocks on a plate that touch along an edge: the faces around it pass the same places twice."""
    blocks = (Prism(shapely.box(0, 0, 1, 1), 0, 2), Prism(shapely.box(1, 1, 2, 2), 0, 1 + low))
    body = Body((Prism(shapely.box(-1, -1, 3, 3), -1, 0.5), *blocks))
    solid = faceted_solid(mesh(body))
    assert solid.is_valid
    assert solid.volume == pytest.approx(16 * 1.5 + 1.5 + 0.5 + low, rel=1e-9)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_any_union_of_boxes(seed):
    rng = np.random.default_rng(seed)
    low, size = rng.uniform(0, 3, (6, 3)), rng.uniform(0.5, 3, (6, 3))
    boxes = [
        Prism(shapely.box(*a[:2], *(a + d)[:2]), float(a[2]), float((a + d)[2])) for a, d in zip(low, size, strict=True)
    ]
    body = Body(tuple(boxes[:3]), (boxes[3],), tuple(boxes[4:]))
    if len(mesh(body).decompose()) != 1:
        return
    solid = faceted_solid(mesh(body))
    assert solid.is_valid
    assert solid.volume == pytest.approx(body_solid(body).volume, rel=1e-7)
