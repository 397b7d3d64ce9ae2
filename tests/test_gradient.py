"""Jacobians, divergence and Laplacian against libigl and an edge-basis solve."""

from __future__ import annotations

import gc
import re
import warnings

import igl
import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hypothesis import given

import diffpoisson as dp
from diffpoisson.gradient import CellGeometry, SparseMatrix, _operators, gradient_operator
from tests import checks, meshes, references
from tests.checks import LOCAL, SOLVE, assert_near, field
from tests.meshes import SPATIAL, TOPOLOGIES

shapes = pytest.mark.parametrize("name", TOPOLOGIES)


# ------------------------------------------------------- against libigl


@shapes
def test_gradient_against_libigl(name):
    vertices, faces = TOPOLOGIES[name](1)
    phi = checks.normal((len(vertices), 2))
    # libigl stacks directions: row d·m + j is direction d on face j.
    stacked = (igl.grad(vertices, faces) @ phi).reshape(vertices.shape[1], len(faces), 2)
    J = dp.jacobians(dp.Mesh(vertices, faces), torch.from_numpy(phi), extrinsic=True)
    assert_near(J, stacked.transpose(1, 2, 0), LOCAL)


@given(meshes.meshes(max_log_aspect=3))
def test_laplacian_against_libigl(mesh):
    """The cotangent Laplacian, at any scale (it has none) and on slivers."""
    expected = -igl.cotmatrix(*mesh).toarray()
    assert_near(dp.laplacian(dp.Mesh(*mesh)).toarray(), expected, SOLVE)


@shapes
def test_laplacian_is_a_laplacian(name):
    """Symmetric, positive semi-definite, with one zero eigenvalue per component."""
    mesh = dp.Mesh(*TOPOLOGIES[name](0))
    L = dp.laplacian(mesh).toarray()
    assert_near(L, L.T, 1e-15)
    values = np.linalg.eigvalsh((L + L.T) / 2)
    zeros = np.abs(values) < 1e-12 * values[-1]
    assert zeros.sum() == mesh.n_components
    assert (values[~zeros] > 0).all()


def test_callers_cannot_edit_the_laplacian():
    mesh = dp.Mesh(*meshes.disk())
    L = dp.laplacian(mesh)
    expected = L.toarray()
    L.data[:] = 0
    assert (dp.laplacian(mesh).toarray() == expected).all()


# ------------------------------------------------------- against the edge basis


@given(meshes.meshes(max_log_aspect=3))
def test_jacobians_against_edge_basis(mesh):
    """The error is a few roundings of the positions, relative to the height of the triangles."""
    vertices, faces = mesh
    phi = checks.normal((len(vertices), 3))
    J = dp.jacobians(dp.Mesh(vertices, faces), torch.from_numpy(phi), extrinsic=True)
    expected = references.jacobians(vertices, faces, phi)
    error = np.abs(J.numpy() - expected).max((1, 2)) / np.abs(expected).max((1, 2))
    assert error.max() <= 1e-15 * 1e4 * 1e3


@given(meshes.meshes())
def test_affine_maps(mesh):
    """The Jacobian of x ↦ M x + t is M, restricted to the tangent plane; M is not symmetric."""
    vertices, faces = mesh
    built = dp.Mesh(vertices, faces)
    D = built.dim
    M, t = checks.normal((4, D)), np.abs(vertices).max() * checks.normal((4,), 1)
    phi = torch.from_numpy(vertices @ M.T + t)
    intrinsic = dp.jacobians(built, phi)
    assert_near(intrinsic, M @ built.frames.numpy(), SOLVE)
    extrinsic = dp.jacobians(built, phi, extrinsic=True)
    projector = (built.frames @ built.frames.mT).numpy()
    assert_near(extrinsic, M @ projector, SOLVE)


@shapes
def test_identity_map(name):
    """The Jacobian of the embedding is the frame itself, an isometry."""
    mesh = dp.Mesh(*TOPOLOGIES[name](0))
    assert_near(dp.jacobians(mesh, mesh.vertices), mesh.frames, LOCAL)


@pytest.mark.parametrize("name", SPATIAL)
def test_extrinsic_and_intrinsic_agree(name):
    mesh = dp.Mesh(*SPATIAL[name](0))
    phi = torch.from_numpy(checks.normal((mesh.n_vertices, 3)))
    J, extrinsic = dp.jacobians(mesh, phi), dp.jacobians(mesh, phi, extrinsic=True)
    assert_near(extrinsic @ mesh.frames, J, LOCAL)
    along_normal = extrinsic @ mesh.normals[:, :, None]
    assert along_normal.abs().max() <= LOCAL * extrinsic.abs().max()


def test_planar_jacobians_are_in_world_coordinates():
    """Clockwise faces too: their Jacobians are not mirrored."""
    mesh = dp.Mesh(*meshes.clockwise_disk())
    M = torch.tensor([[2.0, 1.0], [0.5, 3.0]], dtype=torch.float64)
    J = dp.jacobians(mesh, mesh.vertices @ M.T)
    assert_near(J, M.expand(mesh.n_faces, 2, 2), LOCAL)
    assert torch.equal(dp.jacobians(mesh, mesh.vertices @ M.T, extrinsic=True), J)
    assert (dp.determinant(J) > 0).all()


# ------------------------------------------------------- adjoint


@given(meshes.meshes())
def test_adjoint_dot_product(mesh):
    vertices, faces = mesh
    built = dp.Mesh(vertices, faces)
    phi = torch.from_numpy(checks.normal((built.n_vertices, 2)))
    for k in {2, built.dim}:
        R = field(built, c=2, k=k)
        J = dp.jacobians(built, phi, extrinsic=k > 2)
        left = dp.divergence(built, R) * phi
        right = built.areas[:, None, None] * R * J
        assert abs(left.sum() - right.sum()) <= LOCAL * right.abs().sum()


# ------------------------------------------------------- precision and shapes


@shapes
def test_single_precision(name):
    """float32 values on either mesh, to roundings of the values and of the entries of ∇."""
    vertices, faces = TOPOLOGIES[name](0)
    vertices = vertices.astype(np.float32).astype(np.float64)
    mesh = dp.Mesh(vertices, faces)
    phi = torch.from_numpy(checks.normal((mesh.n_vertices, 3))).float()
    expected = dp.jacobians(mesh, phi.double())
    for either in (mesh, mesh.to(torch.float32)):
        J = dp.jacobians(either, phi)
        assert J.dtype == torch.float32
        assert_near(J, expected, 1e-6)
        R = field(mesh).float() if mesh.dim == 3 else field(mesh, k=2).float()
        assert dp.divergence(either, R).dtype == torch.float32
        assert_near(dp.divergence(either, R), dp.divergence(mesh, R.double()), 1e-6)


def test_double_precision_values_on_a_single_precision_mesh():
    vertices, faces = meshes.sphere()
    single = dp.Mesh(vertices.astype(np.float32), faces)
    double = dp.Mesh(single.vertices.double(), faces)
    phi = torch.from_numpy(checks.normal((single.n_vertices, 3)))
    for extrinsic in (False, True):
        expected = dp.jacobians(double, phi, extrinsic=extrinsic)
        assert_near(dp.jacobians(single, phi, extrinsic=extrinsic), expected, LOCAL)


def test_half_precision_raises(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    for dtype in (torch.float16, torch.bfloat16):
        with pytest.raises(TypeError, match="phi must be float32 or float64, got torch"):
            dp.jacobians(mesh, torch.zeros(25, 3, dtype=dtype))


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,), (1, 0, 2)])
@pytest.mark.parametrize("c", [0, 1, 4])
def test_batch_dimensions(batch, c):
    mesh = dp.Mesh(*meshes.parts())
    phi = torch.from_numpy(checks.normal((*batch, mesh.n_vertices, c)))
    for extrinsic, d in ((False, 2), (True, 3)):
        J = dp.jacobians(mesh, phi, extrinsic=extrinsic)
        R = field(mesh, c=c, k=d, batch=batch)
        b = dp.divergence(mesh, R)
        assert J.shape == (*batch, mesh.n_faces, c, d)
        assert b.shape == (*batch, mesh.n_vertices, c)
        for index in np.ndindex(*batch):
            assert_near(J[index], dp.jacobians(mesh, phi[index], extrinsic=extrinsic), LOCAL)
            assert_near(b[index], dp.divergence(mesh, R[index]), LOCAL)


@pytest.mark.parametrize("shape", [(25,), (24, 3), (2, 3, 25)])
def test_wrong_shape_of_a_map_raises(shape, unchecked):
    message = f"jacobians: expected phi of shape (…, n=25, c), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        dp.jacobians(dp.Mesh(*meshes.disk()), torch.zeros(shape, dtype=torch.float64))


@pytest.mark.parametrize("shape", [(32, 3), (25, 3, 3), (32, 3, 4)])
def test_wrong_shape_of_a_field_raises(shape, unchecked):
    message = f"divergence: expected one matrix per face, (…, m=32, c, 2 or 3), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        dp.divergence(dp.Mesh(*meshes.disk()), torch.zeros(shape, dtype=torch.float64))


# ------------------------------------------------------- the cache


def test_operators_live_as_long_as_their_mesh():
    mesh = dp.Mesh(*meshes.disk())
    assert gradient_operator(mesh) is gradient_operator(mesh)
    before = len(_operators)
    del mesh
    gc.collect()
    assert len(_operators) == before - 1


@pytest.mark.parametrize("make", [meshes.disk, meshes.torus, meshes.parts])
def test_a_union_of_solvers_has_the_operators_of_the_same_mesh_assembled_alone(make):
    parts = [dp.PoissonSolver(dp.Mesh(*make(seed))) for seed in (0, 1)]
    inner = dp.PoissonSolver.concatenate(parts)
    union = dp.PoissonSolver.concatenate([parts[1], inner]).mesh
    ours, alone = (gradient_operator(m) for m in (union, dp.Mesh(union.vertices, union.faces)))
    for name in ("matrix", "divergence_matrix", "laplacian"):
        assert abs(getattr(ours, name) - getattr(alone, name)).max() == 0
    x = torch.randn(union.n_vertices, 2, dtype=torch.float64)
    y = torch.randn(2 * union.n_faces, 2, dtype=torch.float64)
    torch.testing.assert_close(ours.gradient(x), alone.gradient(x), rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(ours.adjoint(y), alone.adjoint(y), rtol=1e-13, atol=1e-13)


def test_torch_does_not_announce_its_csr_layout_to_users():
    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)  # instead of once per process
    try:
        with warnings.catch_warnings(action="error"):
            SparseMatrix(sp.eye(2, format="csr"), torch.device("cpu")).multiply(torch.ones(2, 1))
    finally:
        torch.set_warn_always(before)


def test_matrices_have_no_half_precision():
    matrix = SparseMatrix(sp.eye(2, format="csr"), torch.device("cpu"))
    with pytest.raises(TypeError, match=r"work in float32 and float64, got torch\.float16"):
        matrix.multiply(torch.ones(2, 1).half())


@shapes
def test_operations_at_given_positions_are_those_of_a_mesh_there(name):
    vertices, faces = TOPOLOGIES[name](1)
    mesh, moved = dp.Mesh(vertices, faces), dp.Mesh(1.5 * vertices + np.sin(vertices), faces)
    v, there = moved.vertices, CellGeometry.at(mesh, moved.vertices)
    assert_near(there.vertex_measures(), moved._double_vertex_measures, LOCAL)
    phi = torch.from_numpy(checks.normal((2, 3, len(vertices), 2)))
    assert_near(dp.jacobians(mesh, phi, vertices=v), dp.jacobians(moved, phi), LOCAL)
    R = field(mesh, c=2, k=mesh.cell_dim, batch=(2, 3))
    assert_near(dp.divergence(mesh, R, vertices=v), dp.divergence(moved, R), LOCAL)
    single = dp.divergence(mesh, R.float(), vertices=v)
    assert torch.equal(single, dp.divergence(mesh, R.float().double(), vertices=v).float())


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("positions", "error", "message"),
    [
        (lambda v: v.numpy(), TypeError, "jacobians: vertices must be a torch tensor, got ndarray"),
        (lambda v: v.half(), TypeError, "jacobians: vertices must be float32 or float64, got"),
        (lambda v: 0 * v, dp.MeshError, "jacobians: at the given vertices, "),
    ],
)
def test_positions_that_are_none_are_refused(positions, error, message):
    mesh = dp.Mesh(*meshes.disk())
    with pytest.raises(error, match="^" + re.escape(message)):
        dp.jacobians(mesh, mesh.vertices, vertices=positions(mesh.vertices))
