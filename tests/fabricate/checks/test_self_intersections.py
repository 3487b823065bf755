import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from padforge.fabricate.checks.surface import find_self_intersections, intersection_points

CUBE = np.asarray(trimesh.creation.box((10, 10, 10)).triangles)


TRIANGLES = st.lists(st.tuples(*[st.integers(-4, 4)] * 3), min_size=6, max_size=6)


def moved(triangles: np.ndarray, *away: float) -> np.ndarray:
    return np.asarray(triangles + np.array(away))


def found(*parts: np.ndarray) -> int:
    return len(find_self_intersections(np.concatenate(parts)))


def interiors_meet(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether some point is a mean of the corners of either triangle with weights that are all positive."""
    weights = np.zeros((5, 7))
    weights[:3, :3], weights[:3, 3:6] = first.T, -second.T
    weights[3, :3] = weights[4, 3:6] = 1
    least = np.hstack([-np.eye(6), np.ones((6, 1))])
    free = [(None, None)] * 6 + [(None, 1)]
    found = linprog([0] * 6 + [-1], least, np.zeros(6), weights, [0, 0, 0, 1, 1], free)
    return bool(found.status == 0 and -found.fun > 1e-9)


@settings(max_examples=70)
@given(TRIANGLES)
def test_two_triangles_against_linear_programming(corners):
    pair = np.array(corners, dtype=float).reshape(2, 3, 3) * 10  # none penetrates by less than the limit then
    areas = np.linalg.norm(np.cross(pair[:, 1] - pair[:, 0], pair[:, 2] - pair[:, 0]), axis=1)
    expected = bool((areas > 0).all()) and interiors_meet(*pair)
    pairs = find_self_intersections(pair)
    assert len(pairs) == expected
    if expected:
        (place,) = intersection_points(pair, pairs)
        low, high = pair.min(axis=1)[:, :2].max(axis=0), pair.max(axis=1)[:, :2].min(axis=0)
        assert (place >= low - 1e-6).all()
        assert (place <= high + 1e-6).all()


@pytest.mark.parametrize(
    ("away", "counts"),
    [
        ((10, 0, 0), True),
        ((10, 4, 3), True),
        ((5, 0, 0), True),
        ((0, 0, 0), True),
        ((10, 10, 0), False),
        ((10, 10, 10), False),
    ],
)
def test_faces_that_lie_on_each_other_count(away, counts):
    assert bool(found(CUBE, moved(CUBE, *away))) == counts


@pytest.mark.parametrize(("depth", "counts"), [(0.0009, False), (0.0011, True), (0.005, True), (3.0, True)])
def test_bodies_that_reach_into_each_other(depth, counts):
    other = moved(CUBE, 10 - depth, 1.0, 2.0)
    assert bool(found(CUBE, other)) == counts
    if depth > 1:
        corners = np.concatenate([CUBE, other])
        middles = intersection_points(corners, find_self_intersections(corners))
        assert (np.abs(middles - [5 - depth / 2, 0.5]) <= [depth / 2 + 1e-9, 4.5 + 1e-9]).all()


def test_one_shell_through_itself():
    torus = trimesh.creation.torus(2, 3)
    pairs = find_self_intersections(np.asarray(torus.triangles))
    assert len(pairs) > 10
    assert np.hypot(*intersection_points(np.asarray(torus.triangles), pairs).T).max() < 1.5
    assert not found(np.asarray(trimesh.creation.torus(3, 2).triangles))


def test_a_fold_in_a_plane():
    sheet = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [1, 2, 0]], dtype=float)
    assert not found(sheet[[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]])
    sheet[4] = (5, 2, 0)
    assert found(sheet[[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]])


@settings(max_examples=8)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-60, 60)] * 3))
def test_the_rounding_of_an_stl_is_no_fault(turn, away):
    solid = trimesh.creation.icosphere(3, 20)
    solid.apply_transform(trimesh.transformations.euler_matrix(*turn))
    assert not found(np.asarray(moved(solid.triangles, *away), dtype=np.float32))
    box = np.asarray(trimesh.creation.box((20, 0.02, 30), trimesh.transformations.euler_matrix(*turn)).triangles)
    assert not found(moved(box, *away).astype(np.float32))


def test_needles_and_nothing():
    assert found(np.empty((0, 3, 3))) == 0
    assert found(np.array([[[0, 0, 0], [1, 1, 1], [2, 2, 2.0]]]), CUBE) == 0
