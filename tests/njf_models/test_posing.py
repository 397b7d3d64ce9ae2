"""A surface that follows its handles, against closed forms, dense algebra and trimesh's rays."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from scipy.spatial.transform import Rotation

import diffpoisson as dp
from njf_models.posing import PosedMesh, hit_vertex, rigid_motion
from tests import meshes
from tests.checks import assert_near

KINDS = ("as rigid as possible", "Poisson")


def posed(kind: str = KINDS[0], arrays: meshes.Arrays | None = None) -> PosedMesh:
    pose = PosedMesh(dp.Mesh(*(arrays or meshes.sphere(subdivisions=2))), radius=0.1)
    pose.kind = kind
    return pose


def turn(seed: int, angle: float = 0.8) -> torch.Tensor:
    """A rotation about a random axis."""
    axis = np.random.default_rng(seed).normal(size=3)
    vector = angle * axis / np.linalg.norm(axis)
    return torch.from_numpy(Rotation.from_rotvec(vector).as_matrix())


def test_nothing_follows_without_handles():
    pose = posed()
    assert pose.follow() == 0
    assert torch.equal(pose.vertices, pose.mesh.vertices)


@pytest.mark.parametrize("kind", KINDS)
def test_handles_at_rest_leave_it_at_rest(kind):
    pose = posed(kind)
    assert [pose.add(0), pose.add(5)] == ["handle 0", "handle 1"]
    assert pose.follow() < 1e-12
    assert_near(pose.vertices, pose.mesh.vertices, 1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_handles_that_are_shifted_alike_carry_all_of_it(kind):
    pose, shift = posed(kind), torch.tensor([1.0, -2, 3]).double()
    for name in [pose.add(vertex) for vertex in (0, 1, 5)]:
        pose.move(name, pose.handles[name].centre + shift, torch.eye(3).double())
    pose.follow()
    assert_near(pose.vertices, pose.mesh.vertices + shift, 1e-12)


def test_handles_that_turn_alike_turn_all_of_it():
    """Up to creases, which cost a surface nothing; a Poisson solve would shrink it."""
    pose, Q = posed(), turn(0, 0.5)
    for name in [pose.add(vertex) for vertex in (0, 1, 5)]:
        pose.move(name, Q @ pose.handles[name].centre, Q)
    pose.follow(steps=200)
    turned = pose.mesh.vertices @ Q.T
    assert float((pose.vertices - turned).norm(dim=1).mean()) < 0.01
    pose.kind = "Poisson"
    pose.follow()
    assert float((pose.vertices - turned).norm(dim=1).mean()) > 0.05


def test_poisson_is_the_constrained_fit_to_the_undeformed_jacobians():
    """Against a dense solve of the harmonic displacement."""
    pose = posed("Poisson")
    names = [pose.add(0), pose.add(7)]
    pose.move(names[0], pose.handles[names[0]].centre + torch.tensor([0.3, 0, 0.1]), turn(1))
    pose.follow()
    vertices, faces = pose.mesh.vertices.numpy(), pose.mesh.faces.numpy()
    pins = torch.cat([handle.vertices for handle in pose.handles.values()]).numpy()
    held = torch.cat([h.placed(pose.mesh.vertices) for h in pose.handles.values()]).numpy()
    free = np.setdiff1d(np.arange(len(vertices)), pins)
    L = -igl.cotmatrix(vertices, faces).toarray()
    expected = vertices.copy()
    expected[pins] = held
    right = -L[np.ix_(free, pins)] @ (held - vertices[pins])
    expected[free] += np.linalg.solve(L[np.ix_(free, free)], right)
    assert_near(pose.vertices, expected, 1e-10)


@pytest.mark.parametrize("kind", KINDS)
def test_spots_are_met_exactly_and_moves_end(kind):
    pose = posed(kind)
    first, second = pose.add(0), pose.add(9)
    Q = turn(2)
    pose.move(second, pose.handles[second].centre + 0.5, Q)
    moves = [pose.follow() for _ in range(400)]
    handle, rest = pose.handles[second], pose.mesh.vertices
    spot = rest[handle.vertices]
    assert len(spot) > 1
    assert_near(pose.vertices[handle.vertices], (spot - rest[9]) @ Q.T + rest[9] + 0.5, 1e-12)
    fixed = pose.handles[first].vertices
    assert_near(pose.vertices[fixed], rest[fixed], 1e-12)
    assert moves[0] > 0.1
    assert moves[-1] < 0.02 * moves[0]


def test_components_without_a_handle_stay():
    pose = posed(arrays=meshes.union(meshes.sphere(), meshes.torus()))
    name = pose.add(0)
    pose.move(name, pose.handles[name].centre + torch.tensor([2.0, 0, 0]), torch.eye(3).double())
    for _ in range(50):
        pose.follow()
    assert_near(pose.vertices, pose.mesh.vertices + _shifted(pose.mesh, 2.0), 1e-9)


def _shifted(mesh: dp.Mesh, by: float) -> torch.Tensor:
    shift = torch.zeros_like(mesh.vertices)
    shift[mesh.components == mesh.components[0], 0] = by
    return shift


def test_a_handle_takes_free_vertices_only():
    pose = posed()
    name = pose.add(0)
    spot = pose.handles[name].vertices
    assert pose.add(int(spot[-1])) is None
    neighbour = int(np.setdiff1d(pose.mesh.faces[(pose.mesh.faces == spot[-1]).any(1)], spot)[0])
    other = pose.add(neighbour)
    assert not set(pose.handles[other].vertices.tolist()) & set(spot.tolist())
    pose.remove(name)
    assert list(pose.handles) == [other]
    assert pose.add(0) == "handle 2"


def test_the_last_vertices_are_not_taken():
    """All of a surface held by one handle would leave nothing to solve for."""
    pose = PosedMesh(dp.Mesh(*meshes.disk()), radius=10.0)
    assert pose.add(0) is None
    assert pose.handles == {}


def test_a_handle_on_a_moved_surface_does_not_pull_it_back():
    pose = posed()
    pose.add(0)
    second = pose.add(9)
    pose.move(second, pose.handles[second].centre + 0.5, turn(3))
    for _ in range(300):
        pose.follow()
    before = pose.vertices
    pose.add(20)
    pose.follow()
    assert float((pose.vertices - before).norm(dim=1).max()) < 0.02 * pose.diagonal
    pose.reset()
    assert torch.equal(pose.vertices, pose.mesh.vertices)
    assert pose.handles == {}


@pytest.mark.parametrize("n", [1, 2, 3, 10])
def test_rigid_motion_is_found(n):
    points = torch.randn(n, 3, dtype=torch.float64)
    Q, t, centre = turn(4), torch.randn(3).double(), points[0]
    moved = (points - centre) @ Q.T + centre + t
    rotation, translation = rigid_motion(points, moved, centre)
    assert_near(torch.linalg.det(rotation), 1, 1e-12)
    if n > 2:
        assert_near(rotation, Q, 1e-7)
        assert_near((points - centre) @ rotation.T + centre + translation, moved, 1e-7)
    else:
        assert torch.equal(rotation, torch.eye(3).double())


@given(seed=meshes.seeds)
def test_rays_meet_the_first_triangle_that_linear_algebra_finds(seed):
    """origin + t direction = a + u (b - a) + v (c - a), three equations for each triangle."""
    vertices, faces = meshes.torus()
    rng = np.random.default_rng(seed)
    origin, target = rng.normal(size=3) * 3, rng.normal(size=3) * 0.5
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    matrices = np.stack([b - a, c - a, np.tile(origin - target, (len(faces), 1))], axis=-1)
    u, v, t = np.linalg.solve(matrices, (origin - a)[..., None])[..., 0].T
    hits = np.flatnonzero((np.minimum(u, v) >= 0) & (u + v <= 1) & (t > 0))
    vertex = hit_vertex(vertices, faces, origin, target - origin)
    if not len(hits):
        assert vertex is None
        return
    first = hits[t[hits].argmin()]
    assert vertex == faces[first, np.argmax([1 - u[first] - v[first], u[first], v[first]])]


def test_what_it_refuses():
    with pytest.raises(dp.MeshError, match="expected triangles in space"):
        PosedMesh(dp.Mesh(*meshes.planar_disk()))
    pose = posed()
    with pytest.raises(IndexError, match=f"vertex {pose.mesh.n_vertices} of"):
        pose.add(pose.mesh.n_vertices)
    pose.kind = "magic"
    with pytest.raises(ValueError, match="unknown kind 'magic'"):
        pose.follow()
