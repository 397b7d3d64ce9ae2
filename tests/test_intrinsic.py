"""The intrinsic Delaunay Laplacian: equal where nothing is to flip, better where it is."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.spatial
import torch

import diffpoisson as dp
from tests import meshes
from tests.checks import assert_near


def delaunay_disk(seed: int = 0) -> meshes.Arrays:
    """Random points in the plane with SciPy's Delaunay triangulation (Qhull)."""
    vertices = np.random.default_rng(seed).uniform(0, 1, (40, 2))
    return vertices, scipy.spatial.Delaunay(vertices).simplices.astype(np.int64)


def flipped_edges(vertices: np.ndarray, faces: np.ndarray, count: int = 12) -> np.ndarray:
    """Other triangulations of the same points: edges of convex pairs of faces, exchanged."""
    faces = [tuple(face) for face in faces.tolist()]

    def area(a: int, b: int, c: int) -> float:
        (x, y), (u, v) = vertices[b] - vertices[a], vertices[c] - vertices[a]
        return x * v - y * u

    faces = [f if area(*f) > 0 else (f[0], f[2], f[1]) for f in faces]
    rng, done = np.random.default_rng(0), 0
    while done < count:
        a, b, c = faces[i := int(rng.integers(len(faces)))]
        for j, other in enumerate(faces):
            if a in other and b in other and c not in other:
                (d,) = set(other) - {a, b}
                if min(area(a, d, c), area(d, b, c)) > 1e-4:
                    faces[i], faces[j] = (a, d, c), (d, b, c)
                    done += 1
                break
    return np.array(faces)


def test_nothing_to_flip():
    """On a Delaunay mesh, moved into space, it is the cotangent Laplacian."""
    vertices, faces = delaunay_disk()
    for points in (
        vertices,
        np.c_[vertices, np.zeros(40)]
        @ meshes.rotation(np.random.default_rng(0), np.zeros((1, 3))).T,
    ):
        mesh = dp.Mesh(points, faces)
        L = dp.laplacian(mesh, intrinsic_delaunay=True)
        assert_near(L.toarray(), dp.laplacian(mesh).toarray(), 1e-10)


def test_every_triangulation_of_points_in_the_plane_has_one():
    """Whatever the faces, flips lead to Qhull's Delaunay triangulation, with its spectrum."""
    vertices, faces = delaunay_disk()
    other = flipped_edges(vertices, faces)
    expected = dp.laplacian(dp.Mesh(vertices, faces)).toarray()
    mesh = dp.Mesh(vertices, other)
    assert np.abs(dp.laplacian(mesh).toarray() - expected).max() > 0.1
    actual = dp.laplacian(mesh, intrinsic_delaunay=True).toarray()
    assert_near(actual, expected, 1e-9)
    assert_near(np.linalg.eigvalsh(actual), np.linalg.eigvalsh(expected), 1e-9)


@pytest.mark.parametrize("scale", [1e-70, 1, 1e70])
def test_maximum_principle_on_closed_surfaces(scale):
    """All weights are non-negative, though the cotangents of the faces are not."""
    vertices, faces = meshes.sphere(0, 2)
    vertices = vertices * [1, 1, 0.1]
    mesh = dp.Mesh(scale * vertices, faces)

    def largest(L: sp.csr_matrix) -> float:
        return (L - sp.diags(L.diagonal())).max()

    L = dp.laplacian(mesh, intrinsic_delaunay=True)
    assert largest(dp.laplacian(mesh)) > 0.1
    assert largest(L) < 1e-10
    assert_near(L.toarray(), L.T.toarray(), 1e-12)
    assert np.abs(L.sum(1)).max() < 1e-10 * L.max()


@pytest.mark.parametrize("build", meshes.SPATIAL.values(), ids=meshes.SPATIAL)
def test_any_topology(build):
    mesh = dp.Mesh(*build(0))
    values, vectors = dp.laplacian_eigenpairs(mesh, mesh.n_vertices, intrinsic_delaunay=True)
    L = dp.laplacian(mesh, intrinsic_delaunay=True)
    M = mesh.vertex_measures.numpy()
    residual = L @ vectors.numpy() - M[:, None] * vectors.numpy() * values.numpy()
    assert np.abs(residual).max() < 1e-9 * L.max()
    assert (values[mesh.n_components :] > 0).all()


def test_lanczos_and_dense_agree():
    """The same spectrum by the factor as by LAPACK; signatures take the option too."""
    vertices, faces = meshes.sphere(0, 2)
    mesh = dp.Mesh(vertices * [1, 1, 0.1], faces)
    few = dp.laplacian_eigenpairs(mesh, 8, intrinsic_delaunay=True)[0]
    every = dp.laplacian_eigenpairs(mesh, mesh.n_vertices, intrinsic_delaunay=True)[0]
    assert_near(few, every[:8], 1e-9)
    assert (few[1:] - dp.laplacian_eigenpairs(mesh, 8)[0][1:]).abs().min() > 1e-6
    times = torch.tensor([0.5], dtype=torch.float64)
    for signature in (
        lambda **o: dp.wave_kernel_signature(mesh, n_eigenpairs=9, **o),
        lambda **o: dp.heat_kernel_signature(mesh, times, n_eigenpairs=9, **o),
    ):
        assert (signature() - signature(intrinsic_delaunay=True)).abs().max() > 1e-4


def test_faces_too_thin_for_lengths_are_refused():
    """Where rounded lengths break the triangle inequality, no Laplacian of NaN comes back."""
    refused = 0
    for x in np.linspace(0.1, 0.9, 30):
        turned = np.array([[0, 0], [1, 0], [x, 1e-9]]) @ [[0.6, -0.8], [0.8, 0.6]]
        mesh = dp.Mesh(turned, np.array([[0, 1, 2]]))
        try:
            L = dp.laplacian(mesh, intrinsic_delaunay=True)
        except dp.MeshError:
            refused += 1
        else:
            assert np.isfinite(L.toarray()).all()
    assert refused


def test_refused():
    mesh = dp.Mesh(*meshes.disk())
    with pytest.raises(ValueError, match="its intrinsic Delaunay triangulation"):
        dp.laplacian_eigenpairs(mesh, 3, solver=dp.PoissonSolver(mesh), intrinsic_delaunay=True)
    tetrahedron = dp.Mesh(np.r_[np.zeros((1, 3)), np.eye(3)], np.array([[0, 1, 2, 3]]))
    with pytest.raises(dp.MeshError, match="intrinsic Delaunay triangulations need triangles"):
        dp.laplacian(tetrahedron, intrinsic_delaunay=True)
