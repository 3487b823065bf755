"""What is known of a mesh from its triangles alone, on boxes whose numbers are known."""

import numpy as np
import pytest

from fabricate.checks.findings import graded
from fabricate.checks.surface import Surface, spread
from tests.fabricate.checks.trays import block


def surface(*meshes) -> Surface:
    corners = np.concatenate([mesh.triangles for mesh in meshes]).reshape(-1, 3)
    return Surface.joined(corners, np.arange(len(corners)).reshape(-1, 3))


def test_equal_corners_are_one_and_triangles_without_three_are_none():
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.0, -0.0, 0], [1, 0, 0], [5, 5, 5]]
    found = Surface.joined(vertices, [[0, 1, 2], [3, 4, 2], [0, 3, 2], [1, 4, 2]])
    assert found.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]]
    assert len(found.triangles) == 2
    assert (found.triangles[0] == found.triangles[1]).all()
    assert found.bottom_top.tolist() == [[0, 0, 0], [1, 1, 0]]


def test_a_box_has_its_measures():
    box = surface(block(2, 3, 4, at=(10, -5, 2)))
    assert len(box.vertices) == 8
    assert box.areas.sum() == pytest.approx(2 * (6 + 8 + 12))
    assert box.volumes.sum() == pytest.approx(24)
    assert sorted(box.rise) == pytest.approx([-1] * 2 + [0] * 8 + [1] * 2)
    assert box.areas[box.rise == 1].sum() == pytest.approx(6)
    np.testing.assert_allclose(box.bottom_top, [[9, -6.5, 0], [11, -3.5, 4]])
    assert len(box.edges[0]) == 18
    assert np.bincount(box.edges[1]).tolist() == [2] * 18
    np.testing.assert_allclose(box.middles, box.corners.mean(axis=1))


@pytest.mark.parametrize(("height", "rise"), [(1.9e-3, 1.0), (0.9e-3, 0.0)])
def test_needles_have_no_slope(height, rise):
    found = Surface.joined([[0, 0, 0], [2, 0, 0], [1, height, 0]], [[0, 1, 2]])
    assert found.rise.tolist() == [rise]
    slanted = Surface.joined([[0, 0, 0], [2, 0, 0], [0, 3, 4]], [[0, 1, 2]])
    assert slanted.rise == pytest.approx([0.6])
    assert slanted.areas == pytest.approx([5])


def test_shells_and_patches_are_told_apart_at_edges():
    both = surface(block(2, 2, 2), block(2, 2, 2, at=(9, 0, 0)))
    count, label = both.shells
    assert count == 2
    assert len(set(label[:12])) == len(set(label[12:])) == 1
    upright = np.abs(both.rise) > 0.5
    assert both.patches(upright)[0] == 4
    places = both.patch_places(both.rise > 0.5)
    assert sorted(x > 5 for x, _ in places) == [False, True]


def test_places_are_spread_by_a_millimetre():
    assert spread([(0.1, 0.2), (0.3, -0.4), (1.2, 0.0), (0.2, 0.9)]) == ((0.1, 0.2), (1.2, 0.0), (0.2, 0.9))
    assert spread([]) == ()


@pytest.mark.parametrize(
    ("measured", "status"),
    [(0.4, "pass"), (0.4 - 1e-10, "pass"), (0.399, "warn"), (1e-6, "warn"), (0, "fail"), (-1, "fail")],
)
def test_what_is_less_than_the_limit_is_a_warning_and_nothing_a_failure(measured, status):
    assert graded(measured, 0.4) == status
