"""Tetrahedral meshes beyond the Poisson layer: geometry, spectra, and what needs triangles."""

from __future__ import annotations

import re

import igl
import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given

import diffpoisson as dp
from diffpoisson import testing
from tests import meshes
from tests.checks import LOCAL, SOLVE, assert_near

names = pytest.mark.parametrize("name", meshes.TETRAHEDRAL)


@names
def test_laplacian_against_libigl(name):
    vertices, cells = meshes.TETRAHEDRAL[name](0)
    # libigl wants positively oriented tetrahedra.
    volumes = np.linalg.det(vertices[cells[:, 1:]] - vertices[cells[:, :1]])
    turned = np.where(volumes[:, None] > 0, cells, cells[:, [0, 2, 1, 3]])
    expected = -igl.cotmatrix(vertices, turned).toarray()
    assert_near(dp.laplacian(dp.Mesh(vertices, cells)).toarray(), expected, SOLVE)
    assert_near(dp.Mesh(vertices, cells).volumes, igl.volume(vertices, turned), LOCAL)


CONNECTED = {name: testing.TETRAHEDRAL[name] for name in ("tetrahedron", "box", "inverted_box")}


@given(testing.meshes(CONNECTED))
def test_affine_maps_of_random_meshes(mesh):
    M = torch.from_numpy(np.random.default_rng(0).standard_normal((3, 3)))
    J = dp.jacobians(mesh, mesh.vertices @ M.T)
    assert_near(J, M.expand(mesh.n_faces, 3, 3), 1e-10)
    solved = dp.solve_poisson(mesh, M.expand(mesh.n_faces, 3, 3))
    assert_near(solved - solved[:1], (mesh.vertices - mesh.vertices[:1]) @ M.T, 10 * SOLVE)


@given(testing.meshes(testing.TETRAHEDRAL, max_log_scale=2))
def test_geometry_follows(mesh):
    testing.assert_equivariant(lambda mesh: mesh.volumes, mesh, per="face", degree=3)
    testing.assert_equivariant(lambda mesh: mesh.vertex_measures, mesh, per="vertex", degree=3)
    testing.assert_equivariant(
        lambda mesh: mesh.centroids, mesh, per="face", degree=1, rotates=True, under=["rotation"]
    )


def test_vertex_measures_share_the_volume():
    mesh = dp.Mesh(*meshes.box())
    expected = np.bincount(mesh.faces.numpy().ravel(), np.repeat(mesh.volumes.numpy() / 4, 4))
    assert_near(mesh.vertex_measures, expected, LOCAL)
    assert mesh.vertex_measures.sum().item() == pytest.approx(1)
    assert torch.equal(dp.lumped_mass(mesh), mesh.vertex_measures)


# ------------------------------------------------------- spectra


def test_spectrum_of_the_box():
    """π²(i² + j² + k²), natural boundary conditions, at rate h²."""
    errors = []
    for size in (6, 11):
        values, vectors = dp.laplacian_eigenpairs(dp.Mesh(*meshes.box(0, size)), 8)
        expected = np.array([0, 1, 1, 1, 2, 2, 2, 3])
        errors.append(np.abs(values.numpy() / np.pi**2 - expected).max())
        assert vectors.isfinite().all()
    assert errors[1] < 0.1
    assert 2.5 < errors[0] / errors[1] < 6


@pytest.mark.parametrize("name", ["box", "delaunay", "tetrahedral_parts"])
def test_eigenvalues_against_lapack(name):
    mesh = dp.Mesh(*meshes.TETRAHEDRAL[name](0))
    for k in (5, mesh.n_vertices):
        values, vectors = dp.laplacian_eigenpairs(mesh, k)
        M = mesh.vertex_measures.numpy()
        expected = scipy.linalg.eigh(dp.laplacian(mesh).toarray(), np.diag(M))[0][:k]
        assert_near(values, np.where(np.abs(expected) < 1e-9, 0, expected), SOLVE)
        assert_near(vectors.mT @ (torch.from_numpy(M)[:, None] * vectors), np.eye(k), SOLVE)


def test_signatures():
    """Invariant to motions and scale; scaled by the volume, of average one."""
    mesh = dp.Mesh(*meshes.box())
    testing.assert_equivariant(
        lambda mesh: dp.wave_kernel_signature(mesh, 10, n_eigenpairs=12),
        mesh,
        per="vertex",
        rtol=1e-7,
    )
    mean = mesh.vertex_measures @ dp.wave_kernel_signature(mesh, 10, n_eigenpairs=12)
    assert_near(mean, torch.ones(10).double(), SOLVE)
    heat = dp.heat_kernel_signature(mesh, torch.tensor([0.1, 1e3]), n_eigenpairs=12)
    assert_near(heat[:, 1], torch.ones(27).double(), SOLVE)  # one over the volume


def test_constrained_solver_has_no_spectrum():
    mesh = dp.Mesh(*meshes.disk())
    weights = torch.full((32,), 2.0, dtype=torch.float64)
    for options in (
        {"pins": torch.tensor([1])},
        {"handles": torch.tensor([1])},
        {"face_weights": weights},
    ):
        with pytest.raises(ValueError, match="has pins, handles or face weights"):
            dp.laplacian_eigenpairs(mesh, 4, solver=dp.PoissonSolver(mesh, **options))


# ------------------------------------------------------- what needs triangles

TRIANGLES_ONLY = {
    "areas": lambda mesh: mesh.areas,
    "normals": lambda mesh: mesh.normals,
    "vertex_areas": lambda mesh: mesh.vertex_areas,
    "vertex_normals": lambda mesh: mesh.vertex_normals,
    "euler_characteristic": lambda mesh: mesh.euler_characteristic,
    "is_manifold": lambda mesh: mesh.is_manifold,
    "boundary_loops": lambda mesh: mesh.boundary_loops,
    "is_disk": lambda mesh: mesh.is_disk,
    "sample_surface": lambda mesh: dp.sample_surface(mesh, 5),
    "tutte": dp.tutte,
    "slim": lambda mesh: dp.slim(mesh, mesh.vertices[:, :2]),
    "voronoi": lambda mesh: dp.lumped_mass(mesh, "voronoi"),
}


@pytest.mark.parametrize("name", TRIANGLES_ONLY)
def test_needs_triangles(name, unchecked):
    with pytest.raises(
        dp.MeshError, match=r"need triangles: .* tetrahedra|flattens surfaces, got tet"
    ):
        TRIANGLES_ONLY[name](dp.Mesh(*meshes.box()))


def test_needs_tetrahedra():
    with pytest.raises(dp.MeshError, match=re.escape("volumes need tetrahedra: faces are (m, 3)")):
        _ = dp.Mesh(*meshes.disk()).volumes


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (np.zeros((4, 2)), [[0, 1, 2, 3]], "faces of four vertices are tetrahedra, which need"),
        (np.eye(4, 3), [[0, 1, 2, 2]], "1 face [0] with a repeated vertex index"),
        (
            np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
            [[0, 1, 2, 3]],
            "1 face [0] of zero volume (faces of four vertices are tetrahedra; triangulate quads)",
        ),
    ],
    ids=["planar", "repeated", "quad"],
)
def test_rejected(vertices, faces, message):
    with pytest.raises(dp.MeshError, match=re.escape(message)):
        dp.Mesh(vertices, np.array(faces))


def test_cleaned():
    vertices, cells = meshes.box()
    flat = np.array([[0, 1, 2, 2], [0, 1, 2, 99], [0, 1, 2, 4]])  # 0, 1, 2 on an edge of the cube
    cleaned = dp.Mesh.cleaned(np.r_[vertices, [[np.nan] * 3]], np.r_[flat, cells])
    assert torch.equal(cleaned.mesh.faces, torch.from_numpy(cells))
    assert cleaned.face_map.tolist() == [-1, -1, -1, *range(len(cells))]
    assert cleaned.vertex_map.tolist() == [*range(27), -1]


# ------------------------------------------------------- other positions


@pytest.mark.parametrize("name", meshes.TOPOLOGIES | meshes.TETRAHEDRAL)
def test_with_vertices_is_a_new_mesh(name):
    vertices, faces = (meshes.TOPOLOGIES | meshes.TETRAHEDRAL)[name](0)
    mesh = dp.Mesh(vertices, faces)
    kept = mesh.components
    _ = mesh.measures, mesh.frames  # which must not be kept
    moved = mesh.with_vertices(mesh.vertices * 1.5 + 1)
    fresh = dp.Mesh(vertices * 1.5 + 1, faces)
    assert moved.components is kept
    for attribute in ("measures", "frames", "centroids", "vertex_measures", "components"):
        assert torch.equal(getattr(moved, attribute), getattr(fresh, attribute))
    assert (dp.laplacian(moved) != dp.laplacian(fresh)).nnz == 0


def test_with_vertices_keeps_topology_and_parts():
    union = dp.Mesh.concatenate([dp.Mesh(*meshes.disk()), dp.Mesh(*meshes.sphere())])
    known = (union.is_manifold, union.euler_characteristic, union.boundary_loops)
    moved = union.with_vertices(union.vertices + 1)
    assert moved.n_parts == 2
    assert [len(part) for part in moved.split_faces(moved.areas)] == [32, 80]
    assert (moved.is_manifold, moved.euler_characteristic) == known[:2]
    assert moved.boundary_loops is known[2]


def test_with_vertices_copies():
    mesh = dp.Mesh(*meshes.disk())
    vertices = mesh.vertices * 2
    moved = mesh.with_vertices(vertices)
    vertices += 1
    assert torch.equal(moved.vertices, mesh.vertices * 2)


def test_with_vertices_validates(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    for vertices in (mesh.vertices[:24], mesh.vertices.float(), mesh.vertices[:, :2]):
        with pytest.raises(dp.MeshError, match=re.escape("expected (25, 3) torch.float64 on cpu")):
            mesh.with_vertices(vertices)
    with pytest.raises(dp.MeshError, match="of zero area"):
        mesh.with_vertices(torch.zeros_like(mesh.vertices))
    with pytest.raises(dp.MeshError, match="not finite"):
        mesh.with_vertices(mesh.vertices * torch.nan)
    with pytest.raises(dp.MeshError, match="require grad"):
        mesh.with_vertices(mesh.vertices.clone().requires_grad_())
