"""Whatever the surface, cutting leaves disks, moves nothing, and lowers distortion."""

from __future__ import annotations

import itertools

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson import seams
from diffpoisson.seams import CutMesh, _sums_to_the_root, cut_to_disks
from tests import meshes, references


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


def disk_piece(size: int) -> seams._Piece:
    mesh = dp.Mesh(*meshes.disk(0, size))
    return seams._Piece(mesh, np.arange(mesh.n_vertices))


@pytest.mark.parametrize(
    ("size", "fall", "max_cuts", "cuts"),
    [
        (6, 1.0, 30, 0),  # three cuts in vain are taken back
        (6, 0.95, 5, 5),  # a tenth in three cuts
        (6, 0.5, 2, 2),
        (6, 0.5, 0, 0),
        (3, 0.5, 30, 1),  # no more, since no vertex is inside
        (6, 0.0, 30, 1),  # good enough
    ],
)
def test_cuts_go_on_while_energies_fall(monkeypatch, size, fall, max_cuts, cuts):
    """Energies that are made up: each is that fraction of the one before."""
    energies = (fall**k for k in itertools.count())
    monkeypatch.setattr(seams, "arap", lambda J: torch.full_like(J[:, 0, 0], next(energies)))
    monkeypatch.setattr(seams, "_GOOD_ENOUGH", 0.0)
    piece = disk_piece(size)
    pieces = [piece]
    cut = seams._Piece.cut

    def noted(piece: seams._Piece, edges: np.ndarray) -> tuple[seams._Piece, np.ndarray]:
        result = cut(piece, edges)
        pieces.append(result[0])
        return result

    monkeypatch.setattr(seams._Piece, "cut", noted)
    extended = seams._extended(piece, max_cuts)
    assert extended is pieces[cuts]


def test_local_global_steps_end_at_an_isometry():
    flat, faces = meshes.planar_disk(0, 5)
    mesh = dp.Mesh(np.c_[flat, np.zeros(len(flat))], faces)
    for scale in (0.7, 1.5):
        uv = seams._local_global(mesh, scale * mesh.vertices[:, :2])
        values = dp.singular_values(dp.jacobians(mesh, uv))
        np.testing.assert_allclose(values, np.ones((mesh.n_faces, 2)), atol=1e-9)


def shortest_paths(vertices: np.ndarray, faces: np.ndarray, sources: list[int]) -> dict:
    """Length and vertices of the shortest path of edges from each vertex to a source, relaxed."""
    edges = {(f[i], f[j]) for f in faces.tolist() for i in range(3) for j in range(3) if i != j}
    paths = {source: (0.0, [source]) for source in sources}
    while True:
        longer = {
            b: (d + np.linalg.norm(vertices[a] - vertices[b]), [b, *path])
            for a, b in edges
            if a in paths
            for d, path in [paths[a]]
            if d + np.linalg.norm(vertices[a] - vertices[b]) < paths.get(b, (np.inf,))[0] - 1e-12
        }
        if not longer:
            return paths
        paths |= longer


@pytest.mark.parametrize("seed", range(6))
def test_path_to_the_seam_is_the_most_promising(seed):
    rng = np.random.default_rng(seed)
    vertices, faces, *_ = meshes.renumbered(rng, *meshes.disk(seed, 6))
    vertices = vertices * [3, 1, 1]
    mesh = dp.Mesh(vertices, faces)
    density = rng.uniform(0.1, 10, len(faces))
    areas = references.areas(vertices, faces)
    around = [
        np.average(density[f], weights=areas[f]) for f in ((faces == v).any(1) for v in range(36))
    ]
    promises = {}
    for end, (length, path) in shortest_paths(
        vertices, faces, mesh.boundary_loops[0].tolist()
    ).items():
        steps = [np.linalg.norm(vertices[a] - vertices[b]) for a, b in itertools.pairwise(path)]
        promises[end] = length * np.dot([around[v] for v in path[:-1]], steps), path
    expected = max(promises.values())[1]
    assert seams._path_to_seam(mesh, torch.from_numpy(density)).tolist() == expected


@pytest.mark.parametrize("name", ["sphere", "smallest"])
def test_path_across_is_a_shortest_one_of_two_edges_or_more(name):
    smallest = (
        np.r_[np.zeros((1, 3)), np.eye(3)],
        np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]),
    )
    vertices, faces = smallest if name == "smallest" else meshes.sphere(0, 2)
    path = seams._path_across(dp.Mesh(vertices, faces)).tolist()
    if name == "smallest":
        assert len(set(path)) == len(path) == 3
    else:
        assert path == shortest_paths(vertices, faces, [path[-1]])[path[0]][1]


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
    assert torch.equal(cut_to_disks(mesh.to(torch.float64)).vertex_map, vertex_map)
    for scale in (2.0**-20, 2.0**20):
        scaled = cut_to_disks(dp.Mesh(mesh.vertices * scale, faces))
        assert torch.equal(scaled.vertex_map, vertex_map)
