from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csgraph

from njf_models.datasets.patches import (
    Patch,
    PatchOptions,
    PatchRejectedError,
    PatchSampler,
    align,
    clean_boundary,
    defect,
    dual_graph,
)
from njf_models.datasets.sources import CSGParts
from tests import meshes, references


def stretched_disk(seed: int) -> meshes.Arrays:
    """A disk with distinct principal axes."""
    vertices, faces = meshes.disk(seed)
    return vertices * [1, 1.6, 1], faces


def draw(arrays: meshes.Arrays, options: PatchOptions, seed: int = 0) -> Patch:
    return PatchSampler(*arrays, options).sample(np.random.default_rng(seed))


# ------------------------------------------------------- patches


@pytest.fixture(scope="module")
def patches() -> list[Patch]:
    """Whatever 40 draws on a part with sharp edges and on a ball give."""
    part = next(iter(CSGParts(1, n_faces=3000)))
    options = PatchOptions(min_faces=150, max_faces=400)
    kept = []
    for arrays in ((part.vertices, part.faces), meshes.sphere(0, 4)):
        sampler, rng = PatchSampler(*arrays, options), np.random.default_rng(0)
        for _ in range(20):
            try:
                kept.append(sampler.sample(rng))
            except PatchRejectedError:
                continue
    assert len(kept) >= 30
    return kept


def test_patches_are_disks_of_the_size_asked_for(patches: list[Patch]) -> None:
    for patch in patches:
        faces = patch.mesh.faces.numpy()
        assert 150 <= len(faces) <= 400
        assert igl.euler_characteristic(faces) == 1
        assert len(igl.boundary_loop_all(faces)) == 1
        assert igl.is_edge_manifold(faces)[0]
        assert igl.is_vertex_manifold(faces).all()
        neighbours = igl.triangle_triangle_adjacency(faces)[0] >= 0
        assert (neighbours.sum(axis=1) >= 2).all()  # no ears
    assert len({patch.mesh.n_faces for patch in patches}) > 10  # sizes vary


def test_patches_are_in_the_aligned_pose(patches: list[Patch]) -> None:
    for patch in patches:
        vertices, faces = patch.mesh.vertices.numpy(), patch.mesh.faces.numpy()
        areas = references.areas(vertices, faces)
        assert areas.sum() == pytest.approx(1)
        centroids = igl.barycenter(vertices, faces)
        np.testing.assert_allclose(areas @ centroids, 0, atol=1e-6)  # vertices are float32
        normal = areas @ igl.per_face_normals(vertices, faces, np.zeros(3))
        np.testing.assert_allclose(normal, [0, 0, patch.flatness], atol=1e-6)
        moments = (areas[:, None] * centroids).T @ centroids
        assert moments[0, 0] >= moments[1, 1]
        assert moments[0, 1] == pytest.approx(0, abs=1e-6)


def test_a_patch_is_a_geodesic_ball() -> None:
    size = 41
    flat, faces = meshes.planar_disk(0, size)
    sampler = PatchSampler(np.c_[flat, 0 * flat[:, 0]], faces, PatchOptions(300, 600))
    graph, rng = sampler.graph, np.random.default_rng(1)
    patch = sampler.sample(rng)
    seed_face = np.random.default_rng(1).integers(len(faces))
    distance = csgraph.dijkstra(graph, directed=False, indices=seed_face)
    centroids = igl.barycenter(np.c_[flat, 0 * flat[:, 0]], faces)
    straight = np.linalg.norm(centroids - centroids[seed_face], axis=1)
    # A path is no shorter than the straight line, and on an even grid not much longer.
    assert (distance >= straight - 1e-12).all()
    assert (distance <= 1.6 * straight + 0.05).all()
    assert patch.flatness == pytest.approx(1)


def test_a_patch_swallows_the_spike_it_has_grown_around() -> None:
    """Its tip is far away; without it the patch had a hole, which is left where room is short."""
    flat, faces = meshes.planar_disk(0, 30)
    away = np.linalg.norm(flat - flat.mean(0), axis=1)
    spike = away < 0.2 * away.max()
    vertices = np.c_[flat, np.where(spike, 30 * (0.2 * away.max() - away), 0)]
    seed_face = int(np.abs(away[faces].mean(axis=1) - 0.35 * away.max()).argmin())
    is_spike = spike[faces].any(axis=1)
    wanted = len(faces) - int(is_spike.sum()) - 150  # all around, and nothing of the tip

    sampler = PatchSampler(vertices, faces, PatchOptions(100, len(faces)))
    chosen = sampler.nearest(seed_face, wanted)
    assert defect(faces[chosen]) == "has holes"
    patch = sampler._cut(chosen)
    assert patch.mesh.is_disk
    kept = patch.mesh.n_faces
    with_spike = np.union1d(chosen, np.flatnonzero(is_spike))
    assert kept >= len(clean_boundary(faces[with_spike])) > wanted

    sampler = PatchSampler(vertices, faces, PatchOptions(100, wanted))
    with pytest.raises(PatchRejectedError, match="has holes"):
        sampler._cut(chosen)


def test_distance_goes_through_the_midpoints_of_shared_edges() -> None:
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [1, 3, 0], [1, -3, 3]])
    graph = dual_graph(vertices, np.array([[0, 1, 2], [1, 0, 3]]))
    # The centroids (1, 1, 0) and (1, -1, 1) meet at the midpoint (1, 0, 0).
    length = 1 + np.sqrt(2)
    np.testing.assert_allclose(graph.toarray(), [[0, length], [length, 0]])


def test_there_is_no_way_across_an_edge_of_three_faces() -> None:
    assert dual_graph(*meshes.book()).nnz == 0


def test_the_same_stream_draws_the_same_patch() -> None:
    options = PatchOptions(50, 100)
    arrays = meshes.sphere(0, 3)
    a, b, c = (draw(arrays, options, seed) for seed in (1, 1, 2))
    assert torch.equal(a.mesh.vertices, b.mesh.vertices)
    assert torch.equal(a.mesh.faces, b.mesh.faces)
    assert a.mesh.vertices.shape != c.mesh.vertices.shape


# ------------------------------------------------------- rejections


@pytest.mark.parametrize(
    ("arrays", "options", "reason"),
    [
        (meshes.sphere(), PatchOptions(80, 80), "closed"),
        (meshes.torus(), PatchOptions(70, 70), "closed"),
        (meshes.annulus(), PatchOptions(28, 28), "has holes"),
        (meshes.sphere(), PatchOptions(81, 200), "component too small"),
        (meshes.parts(), PatchOptions(81, 200), "component too small"),
        (meshes.moebius(), PatchOptions(36, 36), "not manifold"),
        (meshes.disk(), PatchOptions(16, 32, min_flatness=0.999), "not flat enough"),
    ],
)
def test_rejections_say_why(arrays: meshes.Arrays, options: PatchOptions, reason: str) -> None:
    with pytest.raises(PatchRejectedError, match=reason):
        draw(arrays, options)


def test_a_torus_with_a_hole_has_a_handle() -> None:
    vertices, faces = meshes.torus()
    with pytest.raises(PatchRejectedError, match="has a handle"):
        draw((vertices, faces[1:]), PatchOptions(69, 69))


def test_ears_can_leave_too_few_faces() -> None:
    with pytest.raises(PatchRejectedError, match="too few faces after cleaning"):
        draw(meshes.triangle(), PatchOptions(1, 1))


# ------------------------------------------------------- cleaning


def as_sets(faces: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(face) for face in faces.tolist()}


def test_ears_are_removed_one_after_the_other() -> None:
    _, faces = meshes.planar_disk(0, 4)
    strip = np.array([[1, 2, 16], [2, 17, 16], [16, 17, 18]])  # hangs on at the edge (1, 2)
    faces_and_strip = np.concatenate([faces, strip])
    cleaned = faces_and_strip[clean_boundary(faces_and_strip)]
    corners = {frozenset({2, 3, 7}), frozenset({8, 12, 13})}  # the grid's own ears
    assert as_sets(cleaned) == as_sets(faces) - corners


def test_a_pinched_vertex_is_opened() -> None:
    _, faces = meshes.planar_disk(0, 6)
    grid = np.arange(36).reshape(6, 6)
    # Without two diagonally opposite cells, the boundary passes the vertex between them twice.
    cells = {(1, 2), (2, 1)}
    removed = [
        {int(grid[i, j]), int(grid[i + 1, j]), int(grid[i + 1, j + 1]), int(grid[i, j + 1])}
        for i, j in cells
    ]
    kept = faces[[not any(set(face) <= cell for cell in removed) for face in faces.tolist()]]
    boundary = igl.boundary_facets(kept)[0]
    assert (np.bincount(boundary.ravel()) == 4).sum() == 1
    cleaned = kept[clean_boundary(kept)]
    boundary = igl.boundary_facets(cleaned)[0]
    assert np.bincount(boundary.ravel()).max() == 2
    assert as_sets(cleaned) < as_sets(kept)


def test_only_the_largest_part_is_kept() -> None:
    _, faces = meshes.union(meshes.disk(0, 4), meshes.disk(0, 6))
    assert as_sets(faces[clean_boundary(faces)]) <= as_sets(faces[18:])


def test_a_clean_patch_stays_as_it_is() -> None:
    _, faces = meshes.planar_disk(0, 5)
    once = faces[clean_boundary(faces)]
    assert len(once) >= len(faces) - 2
    np.testing.assert_array_equal(clean_boundary(once), np.arange(len(once)))


# ------------------------------------------------------- alignment


@given(seed=meshes.seeds, log_scale=st.floats(-4, 4))
def test_alignment_undoes_any_similarity_and_numbering(seed: int, log_scale: float) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = stretched_disk(seed)
    expected, flatness = align(vertices, faces)
    moved, renumbered, p, _ = meshes.renumbered(rng, vertices, faces)
    moved = 10.0**log_scale * (moved + rng.standard_normal(3)) @ meshes.rotation(rng, moved).T
    actual, same_flatness = align(moved, renumbered)
    np.testing.assert_allclose(actual, expected[p], atol=1e-9)
    assert same_flatness == pytest.approx(flatness)


@given(seed=meshes.seeds)
def test_alignment_is_a_similarity_without_reflection(seed: int) -> None:
    vertices, faces = stretched_disk(seed)
    aligned, _ = align(vertices, faces)
    centred = [x - x.mean(axis=0) for x in (vertices, aligned)]
    A = np.linalg.lstsq(*centred, rcond=None)[0]
    scale = references.areas(vertices, faces).sum() ** -0.5
    np.testing.assert_allclose(A @ A.T, scale**2 * np.eye(3), atol=1e-9)
    assert np.linalg.det(A) > 0


def test_flatness_is_one_in_the_plane_and_half_on_a_hemisphere() -> None:
    flat, faces = meshes.planar_disk()
    assert align(np.c_[flat, 0 * flat[:, 0]], faces)[1] == pytest.approx(1)
    vertices, faces = igl.icosahedron()
    vertices, faces = igl.upsample(vertices, faces, 4)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    upper = faces[(vertices[faces, 2] > -1e-9).all(axis=1)]
    assert align(vertices, upper)[1] == pytest.approx(0.5, abs=0.02)


def test_a_closed_surface_has_no_canonical_direction() -> None:
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array(
        [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    )
    with pytest.raises(PatchRejectedError, match="no mean normal"):
        align(octahedron, faces)
