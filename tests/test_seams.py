"""Whatever the surface, cutting leaves disks, moves nothing, and lowers distortion."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson.seams import CutMesh, _sums_to_the_root, cut_to_disks
from tests import meshes


def assert_cut_to_disks(mesh: dp.Mesh, cut: CutMesh) -> None:
    """The same corners in the same order, and every component a disk; by libigl and by counting."""
    surface, vertex_map = cut
    assert torch.equal(vertex_map[surface.faces], mesh.faces)
    assert torch.equal(surface.vertices, mesh.vertices[vertex_map])
    assert torch.equal(vertex_map[: mesh.n_vertices], torch.arange(mesh.n_vertices))
    faces = surface.faces.numpy()
    assert (np.bincount(faces.ravel(), minlength=len(vertex_map)) > 0).all()
    assert igl.is_edge_manifold(faces)[0]
    assert np.asarray(igl.is_vertex_manifold(faces)).all()
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)  # consistently oriented
    labels = igl.facet_components(faces)[1]
    for label in range(labels.max() + 1):
        part = faces[labels == label]
        edges = np.unique(np.sort(directed[np.tile(labels == label, 3)], axis=1), axis=0)
        assert len(np.unique(part)) - len(edges) + len(part) == 1
    assert len(igl.boundary_loop_all(faces)) == labels.max() + 1


@settings(max_examples=15)
@given(meshes.meshes(meshes.SPATIAL))
def test_every_topology_becomes_disks(arrays):
    mesh = dp.Mesh(*arrays)
    assert_cut_to_disks(mesh, cut_to_disks(mesh))


@settings(max_examples=15)
@given(st.data())
def test_any_heap_of_triangles_becomes_disks(data):
    """Triangles of random vertices, repeated, sharing edges in any number and direction."""
    n = data.draw(st.integers(4, 9))
    corner = st.permutations(range(n)).map(lambda order: order[:3])
    faces = np.array(data.draw(st.lists(corner, min_size=1, max_size=14)))
    faces = np.unique(faces, return_inverse=True)[1].reshape(-1, 3)
    positions = np.random.default_rng(data.draw(meshes.seeds)).standard_normal((faces.max() + 1, 3))
    mesh = dp.Mesh(positions, faces)
    assert_cut_to_disks(mesh, cut_to_disks(mesh))


@pytest.mark.parametrize(
    ("name", "components"),
    [("moebius", 1), ("book", 3), ("bowtie", 2), ("sphere", 1), ("torus", 1), ("annulus", 1)],
)
def test_components(name, components):
    """Pages and wings come apart; a Möbius strip is cut where its faces disagree, and stays one."""
    surface, _ = cut_to_disks(dp.Mesh(*meshes.SPATIAL[name](0)))
    assert surface.n_components == components


def test_smallest_closed_surface():
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    mesh = dp.Mesh(np.r_[np.zeros((1, 3)), np.eye(3)], faces)
    cut = cut_to_disks(mesh)
    assert_cut_to_disks(mesh, cut)
    assert 5 <= cut.mesh.n_vertices <= 6


def test_a_disk_that_flattens_well_stays_as_it_is():
    mesh = dp.Mesh(*meshes.disk(0, 6))
    surface, vertex_map = cut_to_disks(mesh)
    assert surface is mesh
    assert vertex_map.tolist() == list(range(36))


def sock(length: int = 24, around: int = 12) -> dp.Mesh:
    """A closed cylinder without its lower lid: a disk, which nobody would flatten uncut."""
    angle = 2 * np.pi * np.arange(around) / around
    rings = [np.c_[np.cos(angle), np.sin(angle), np.full(around, 0.5 * k)] for k in range(length)]
    grid = np.arange(length * around).reshape(length, around)
    grid = np.c_[grid, grid[:, :1]]
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    tip = length * around
    lid = np.c_[grid[-1, :-1], grid[-1, 1:], np.full(around, tip)]
    vertices = np.r_[np.concatenate(rings), [[0, 0, 0.5 * length]]]
    return dp.Mesh(vertices, np.r_[np.c_[a, b, c], np.c_[a, c, d], lid])


def test_seams_are_extended_while_that_pays():
    """A sock's tip is far from its hem; one cut along it unrolls it."""
    mesh = sock()
    assert mesh.is_disk
    energies = []
    for max_cuts in (0, 1, 30):
        cut = cut_to_disks(mesh, max_cuts=max_cuts)
        assert_cut_to_disks(mesh, cut)
        energies.append(dp.slim(cut.mesh, dp.tutte(cut.mesh)).energies[-1])
    assert energies[0] > 10
    assert energies[1] < 5
    assert energies[2] <= energies[1]
    seam = cut_to_disks(mesh, max_cuts=1).mesh.n_vertices - mesh.n_vertices
    assert 20 <= seam <= 26  # straight up


def test_extended_seams_beat_those_of_topology():
    mesh = dp.Mesh(*meshes.sphere(0, 3))
    bare, extended = (cut_to_disks(mesh, max_cuts=k).mesh for k in (0, 30))
    before, after = (dp.slim(cut, dp.tutte(cut)).energies[-1] for cut in (bare, extended))
    assert after < 4.5 < before
    assert extended.n_vertices < 1.2 * mesh.n_vertices


@given(seed=meshes.seeds, n=st.integers(1, 40))
def test_sums_to_the_root(seed, n):
    rng = np.random.default_rng(seed)
    parent = np.array([rng.integers(0, i + 1) for i in range(n)])  # itself: a root
    order = rng.permutation(n)
    parent = order[parent[np.argsort(order)]]
    values = np.where(parent == np.arange(n), 0, rng.standard_normal(n))
    expected = []
    for node in range(n):
        path = [node]
        while parent[path[-1]] != path[-1]:
            path.append(parent[path[-1]])
        expected.append(values[path].sum())
    np.testing.assert_allclose(_sums_to_the_root(parent, values), expected, atol=1e-12)


def test_dtype_is_kept_and_scale_does_not_matter():
    vertices, faces = meshes.sphere(0, 2)
    mesh = dp.Mesh(vertices.astype(np.float32), faces)
    surface, vertex_map = cut_to_disks(mesh)
    assert surface.dtype == torch.float32
    for scale in (2.0**-20, 2.0**20):
        scaled = cut_to_disks(dp.Mesh(mesh.vertices * scale, faces))
        assert torch.equal(scaled.vertex_map, vertex_map)
