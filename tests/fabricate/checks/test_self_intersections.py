import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from padforge.fabricate.checks.mesh_checks import check_solid
from padforge.fabricate.checks.surface import TriangleMesh

CUBE = np.asarray(trimesh.creation.box((10, 10, 10)).triangles)


TRIANGLES = st.lists(st.tuples(*[st.integers(-4, 4)] * 3), min_size=6, max_size=6)


def moved(triangles: np.ndarray, *away: float) -> np.ndarray:
    return np.asarray(triangles + np.array(away))


def mesh_of(*parts: np.ndarray) -> TriangleMesh:
    corners = np.concatenate(parts).astype(np.float64).reshape(-1, 3)
    return TriangleMesh(corners, np.arange(len(corners)).reshape(-1, 3))


def count_intersections(*parts: np.ndarray) -> int:
    return len(mesh_of(*parts).find_self_intersections(1000))


def positions(*parts: np.ndarray) -> np.ndarray:
    (finding,) = (finding for finding in check_solid(mesh_of(*parts)) if finding.name == "self_intersection")
    assert finding.message.endswith("pairs of triangles intersect each other")
    return np.array(finding.positions_mm)


def interiors_meet(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether some point is a mean of the corners of either triangle with weights that are all positive."""
    weights = np.zeros((5, 7))
    weights[:3, :3], weights[:3, 3:6] = first.T, -second.T
    weights[3, :3] = weights[4, 3:6] = 1
    least = np.hstack([-np.eye(6), np.ones((6, 1))])
    free = [(None, None)] * 6 + [(None, 1)]
    optimum = linprog([0] * 6 + [-1], least, np.zeros(6), weights, [0, 0, 0, 1, 1], free)
    return bool(optimum.status == 0 and -optimum.fun > 1e-9)


@settings(max_examples=70)
@given(TRIANGLES)
def test_find_self_intersections_agrees_with_linear_programming(corners):
    pair = np.array(corners, dtype=float).reshape(2, 3, 3) * 10  # none penetrates by less than the limit then
    areas = np.linalg.norm(np.cross(pair[:, 1] - pair[:, 0], pair[:, 2] - pair[:, 0]), axis=1)
    expected = bool((areas > 0).all()) and interiors_meet(*pair)
    assert count_intersections(pair) == expected
    if expected:
        (position,) = positions(pair)
        low, high = pair.min(axis=1)[:, :2].max(axis=0), pair.max(axis=1)[:, :2].min(axis=0)
        assert (position >= low - 1e-6).all()
        assert (position <= high + 1e-6).all()


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
def test_find_self_intersections_counts_coincident_faces(away, counts):
    assert bool(count_intersections(CUBE, moved(CUBE, *away))) == counts


@pytest.mark.parametrize(("depth", "counts"), [(0.0009, False), (0.0011, True), (0.005, True), (3.0, True)])
def test_find_self_intersections_counts_penetrating_bodies(depth, counts):
    other = moved(CUBE, 10 - depth, 1.0, 2.0)
    assert bool(count_intersections(CUBE, other)) == counts
    if depth > 1:
        assert (np.abs(positions(CUBE, other) - [5 - depth / 2, 0.5]) <= [depth / 2 + 1e-9, 4.5 + 1e-9]).all()


def test_find_self_intersections_of_one_shell():
    torus = np.asarray(trimesh.creation.torus(2, 3).triangles)
    assert count_intersections(torus) > 10
    assert np.hypot(*positions(torus).T).max() < 1.5
    assert not count_intersections(np.asarray(trimesh.creation.torus(3, 2).triangles))


def test_find_self_intersections_counts_folds_in_a_plane():
    sheet = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [1, 2, 0]], dtype=float)
    assert not count_intersections(sheet[[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]])
    sheet[4] = (5, 2, 0)
    assert count_intersections(sheet[[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]])


@settings(max_examples=8)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-60, 60)] * 3))
def test_find_self_intersections_ignores_the_rounding_of_an_stl(turn, away):
    solid = trimesh.creation.icosphere(3, 20)
    solid.apply_transform(trimesh.transformations.euler_matrix(*turn))
    assert not count_intersections(np.asarray(moved(solid.triangles, *away), dtype=np.float32))
    box = np.asarray(trimesh.creation.box((20, 0.02, 30), trimesh.transformations.euler_matrix(*turn)).triangles)
    assert not count_intersections(moved(box, *away).astype(np.float32))


def test_find_self_intersections_ignores_needles_and_empty_meshes():
    assert count_intersections(np.empty((0, 3, 3))) == 0
    assert count_intersections(np.array([[[0, 0, 0], [1, 1, 1], [2, 2, 2.0]]]), CUBE) == 0
