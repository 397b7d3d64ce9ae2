"""Mean-value coordinates have the properties that define them; cages enclose and carry over."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import Shape
from njf_models.baselines.cages import CageDeformation
from njf_models.baselines.mean_value import build_cage, mean_value_coordinates
from tests import meshes
from tests.njf_models.shapes import bumpy_disk, ellipsoid, prepared, randomised

CUBE = torch.tensor(
    [[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)], dtype=torch.float64
)


def hull(points: torch.Tensor) -> torch.Tensor:
    from scipy.spatial import ConvexHull

    simplices = ConvexHull(points.numpy()).simplices.astype(np.int64)
    faces = torch.from_numpy(simplices)
    a, b, c = points[faces].unbind(1)
    inward = (torch.linalg.cross(b - a, c - a) * (a - points.mean(0))).sum(-1) < 0
    return faces.where(~inward[:, None], faces.flip(1))


@pytest.fixture(scope="module")
def cage():
    """A cage that is not convex, and points on both sides of it."""
    vertices, faces = (torch.from_numpy(x) for x in meshes.sphere(3, subdivisions=1))
    points = 2 * torch.rand(300, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return points - 1, vertices, faces


def test_coordinates_reproduce_points_on_either_side(cage):
    W = mean_value_coordinates(*cage)
    assert_close(W.sum(1), torch.ones(len(W), dtype=torch.float64), rtol=0, atol=1e-12)
    assert_close(W @ cage[1], cage[0], rtol=0, atol=1e-9)


def test_coordinates_are_the_mean_over_all_directions():
    """By the definition: values on a cage, divided by distance, averaged over rays from a point."""
    vertices = CUBE * torch.tensor([1.0, 1.5, 0.7], dtype=torch.float64)
    faces = hull(vertices)
    point = torch.tensor([[0.2, -0.4, 0.1]], dtype=torch.float64)
    rays = np.random.default_rng(0).standard_normal((200_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    expected = np.zeros(8)
    hits = 0
    for face in faces.numpy():
        corners = vertices.numpy()[face] - point.numpy()
        weights = rays @ np.linalg.inv(corners)  # ray = Σ weights · corners
        inside = (weights >= 0).all(1)
        hits += inside.sum()
        np.add.at(expected, face, weights[inside].sum(0))  # barycentric / distance
    assert hits == len(rays)
    W = mean_value_coordinates(point, vertices, faces)[0].numpy()
    assert np.abs(W - expected / expected.sum()).max() < 2e-3


def test_in_a_convex_cage_they_are_positive_and_near_a_corner_its_own():
    faces = hull(CUBE)
    points = 1.9 * torch.rand(200, 3, dtype=torch.float64) - 0.95
    assert mean_value_coordinates(points, CUBE, faces).min() > 0
    near = mean_value_coordinates(CUBE * (1 - 1e-6), CUBE, faces)
    assert_close(near, torch.eye(8, dtype=torch.float64), rtol=0, atol=1e-5)


def test_in_the_plane_of_a_face_they_are_the_limit():
    """Points in the plane of a cube's side, outside of it: that side's faces are seen edge-on."""
    faces = hull(CUBE)
    there = torch.tensor([[1.0, 1.7, 0.3], [1.0, 3.0, 1.0]], dtype=torch.float64)
    beside = [there + torch.tensor([h, 0, 0], dtype=torch.float64) for h in (-1e-5, 1e-5)]
    limit = sum(mean_value_coordinates(points, CUBE, faces) for points in beside) / 2
    assert_close(mean_value_coordinates(there, CUBE, faces), limit, rtol=0, atol=1e-4)


def test_a_cage_is_closed_and_encloses():
    mesh = ellipsoid()
    cage = build_cage(mesh, 120, offset=0.05)
    assert cage.n_faces <= 120
    assert not cage.boundary_loops
    signed = igl.signed_distance(mesh.vertices.numpy(), cage.vertices.numpy(), cage.faces.numpy())
    assert signed[0].max() < 0  # also: its faces are oriented outwards
    longest = float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max())
    away = igl.point_mesh_squared_distance(
        cage.vertices.numpy(), mesh.vertices.numpy(), mesh.faces.numpy()
    )[0]
    assert np.sqrt(away.max()) < 2 * 0.05 * longest
    with pytest.raises(ValueError, match="the mesh has a boundary"):
        build_cage(bumpy_disk())


def test_vertices_follow_the_cage():
    """Moves that are affine on the cage are the same affine map of the shape."""
    mesh = ellipsoid()
    shape = prepared(mesh)
    model = CageDeformation(6, 0, parameters=4, centering="vertex", cage_faces=100).double()
    code = torch.randn(2, 4, dtype=torch.float64)
    rest = mesh.vertices - mesh.vertices.mean(0)
    untrained = model(shape, code)
    assert_close(untrained.vertices, rest.expand(2, -1, -1), rtol=0, atol=1e-12)
    matrix = torch.randn(3, 3, dtype=torch.float64)
    model.field.forward = lambda features, code: (features[:, :3] @ matrix.T + 5).expand(2, -1, -1)
    moved = model(shape, code)
    assert_close(moved.vertices, (rest + rest @ matrix.T).expand(2, -1, -1), rtol=0, atol=1e-9)
    assert_close(moved.jacobians, dp.jacobians(mesh, moved.vertices), rtol=1e-9, atol=1e-9)


def test_a_cage_is_made_once_and_around_one_shape():
    shape = prepared(ellipsoid())
    model = randomised(CageDeformation(6, 0, parameters=4, cage_faces=100, width=32))
    code = torch.randn(3, 4, dtype=torch.float64)
    model.prepare(shape)
    (cage,) = model._cages.values()  # made ahead of the first map
    together = model(shape, code).vertices
    assert model._cage(shape) is cage
    for phi, c in zip(together, code, strict=True):
        assert_close(model(shape, c[None]).vertices[0], phi, rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match="around one shape, got 2 concatenated"):
        model(Shape.concatenate([shape, prepared(ellipsoid(1))]), code[:2])
