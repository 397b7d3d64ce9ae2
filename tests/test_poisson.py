"""The Poisson layer: every property of `checks.py`, then random meshes, precision and errors."""

from __future__ import annotations

import copy
import pickle
import re

import numpy as np
import pytest
import torch
from hypothesis import given
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vmap

import diffpoisson as dp
from diffpoisson import poisson
from tests import checks, meshes, references
from tests.checks import LOCAL, SOLVE, assert_near, field, small_layer


@pytest.mark.parametrize("check", checks.CHECKS.values(), ids=checks.CHECKS)
def test_property(check):
    check()


# ------------------------------------------------------- random meshes


@given(meshes.meshes())
def test_reference_on_random_meshes(mesh):
    """Any topology, position, orientation, numbering and scale."""
    vertices, faces = mesh
    mesh = dp.Mesh(vertices, faces)
    R = field(mesh, k=mesh.dim)
    size = np.ptp(vertices, axis=0).max()
    expected = references.poisson(vertices / size, faces, R.numpy())
    assert_near(dp.PoissonSolver(mesh)(R) / size, expected, SOLVE)


@pytest.mark.parametrize("log_aspect", [0, 2, 4, 6])
@pytest.mark.parametrize("name", meshes.TOPOLOGIES)
def test_slivers(name, log_aspect):
    """Meshes squeezed up to a million times: the error is roundings times the condition number.

    Squeezing multiplies the ratio of the Laplacian's extreme eigenvalues by the aspect squared.
    """
    vertices, faces = meshes.TOPOLOGIES[name](0)
    vertices[:, 0] *= 10.0**-log_aspect
    mesh = dp.Mesh(vertices @ meshes.rotation(np.random.default_rng(0), vertices).T, faces)
    M = checks.normal((mesh.dim, mesh.dim))
    solved = dp.PoissonSolver(mesh)(checks.constant(mesh, M))
    expected = references.centred(vertices, faces, mesh.vertices.numpy() @ M.T)
    assert_near(solved, expected, 1e-13 + 1e-14 * 10.0 ** (2 * log_aspect))


# ------------------------------------------------------- precision


def test_single_precision_mesh():
    """Built from the same rounded positions, a float32 mesh solves like a float64 one."""
    vertices, faces = meshes.parts()
    rounded = vertices.astype(np.float32)
    single, double = dp.Mesh(rounded, faces), dp.Mesh(rounded.astype(np.float64), faces)
    R = field(single).float()
    phi = dp.PoissonSolver(single)(R)
    assert phi.dtype == torch.float32
    # Frames and R are rounded to float32: a few roundings, whatever the mesh.
    assert_near(phi, dp.PoissonSolver(double)(R.double()), 1e-6)


def test_single_precision_mesh_in_double():
    """A float64 field on a float32 mesh is solved to float64 accuracy: geometry is kept in it."""
    vertices, faces = meshes.parts()
    rounded = vertices.astype(np.float32)
    single, double = dp.Mesh(rounded, faces), dp.Mesh(rounded.astype(np.float64), faces)
    R = field(single)
    assert_near(dp.PoissonSolver(single)(R), dp.PoissonSolver(double)(R), SOLVE)


def test_mean_gauge_in_double_on_a_single_precision_mesh():
    vertices, faces = meshes.parts()
    rounded = vertices.astype(np.float32)
    phi = dp.PoissonSolver(dp.Mesh(rounded, faces))(field(dp.Mesh(rounded, faces), k=2)).numpy()
    assert_near(phi, references.centred(rounded.astype(np.float64), faces, phi), LOCAL)


# ------------------------------------------------------- torch transforms


def test_nested_transforms_of_a_nonlinear_loss():
    """Hessian of ½‖S R‖² is SᵀS, by every order of nesting."""
    solver, R = small_layer()

    def loss(R):
        return solver(R).square().sum() / 2

    S = torch.stack([solver(e.view_as(R)).flatten() for e in torch.eye(R.numel()).double()], dim=1)
    shape = (*R.shape, *R.shape)
    expected = (S.T @ S).reshape(shape)
    assert_near(hessian(loss)(R), expected, SOLVE)
    for outer in (jacfwd, jacrev):
        for inner in (jacfwd, jacrev):
            assert_near(outer(inner(loss))(R), expected, SOLVE)
    assert_near(vmap(grad(loss))(R[None])[0], (S.T @ S @ R.flatten()).view_as(R), SOLVE)


def test_batched_backward():
    """`is_grads_batched` vmaps the backward."""
    solver, R = small_layer()
    phi = solver(R.requires_grad_())
    seeds = torch.eye(phi.numel()).double().view(-1, *phi.shape)
    (rows,) = torch.autograd.grad(phi, R, seeds, is_grads_batched=True, retain_graph=True)
    expected = torch.stack([torch.autograd.grad(phi, R, e, retain_graph=True)[0] for e in seeds])
    assert_near(rows, expected, LOCAL)


def test_compiled(unchecked):
    """One graph, no break, for value and gradient."""
    solver, R = small_layer()

    def loss(R):
        return solver(R).square().sum()

    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    expected = R.clone().requires_grad_()
    loss(expected).backward()
    actual = R.clone().requires_grad_()
    value = compiled(actual)
    value.backward()
    assert_near(value.detach(), loss(R), LOCAL)
    assert_near(actual.grad, expected.grad, LOCAL)


# ------------------------------------------------------- shapes


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
@pytest.mark.parametrize("c", [0, 1, 4])
@pytest.mark.parametrize("k", [2, 3])
def test_batch_and_output_dimensions(batch, c, k):
    mesh = dp.Mesh(*meshes.parts())
    solver = dp.PoissonSolver(mesh)
    R = field(mesh, c=c, k=k, batch=batch)
    phi = solver(R)
    assert phi.shape == (*batch, mesh.n_vertices, c)
    for index in np.ndindex(*batch):
        assert_near(phi[index], solver(R[index]), LOCAL)


@pytest.mark.parametrize("shape", [(32, 3), (31, 3, 2), (32, 3, 1), (32, 3, 4), (32, 3, 2, 1)])
def test_wrong_shapes_raise(shape, unchecked):
    mesh = dp.Mesh(*meshes.disk())
    message = f"PoissonSolver: expected one matrix per face, (…, m=32, c, 2 or 3), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        dp.PoissonSolver(mesh)(torch.zeros(shape, dtype=torch.float64))


def test_planar_mesh_takes_planar_matrices_only(unchecked):
    mesh = dp.Mesh(*meshes.planar_disk())
    with pytest.raises(ValueError, match=re.escape("(…, m=32, c, 2), got (32, 3, 3)")):
        dp.PoissonSolver(mesh)(torch.zeros(32, 3, 3, dtype=torch.float64))


def test_unknown_gauge_raises(unchecked):
    with pytest.raises(ValueError, match=r"gauge must be .mean., .vertex. or a mask"):
        dp.PoissonSolver(dp.Mesh(*meshes.disk()), gauge="first")


def test_solvers_of_different_gauge_do_not_concatenate():
    mesh = dp.Mesh(*meshes.disk())
    solvers = [dp.PoissonSolver(mesh), dp.PoissonSolver(mesh, gauge="vertex")]
    with pytest.raises(ValueError, match=r"all solvers have the gauge .vertex. or none"):
        dp.PoissonSolver.concatenate(solvers)


# ------------------------------------------------------- the rest of the interface


def test_one_shot():
    mesh = dp.Mesh(*meshes.parts())
    R = field(mesh)
    for gauge in ("mean", "vertex"):
        expected = dp.PoissonSolver(mesh, gauge=gauge)(R)
        assert torch.equal(dp.solve_poisson(mesh, R, gauge=gauge), expected)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])
@pytest.mark.parametrize("concatenated", [False, True])
def test_copies(clone, concatenated):
    """What DataLoader workers and checkpoints do."""
    solver = dp.PoissonSolver(dp.Mesh(*meshes.parts()))
    if concatenated:
        solver = dp.PoissonSolver.concatenate([solver, solver])
    R = field(solver.mesh)
    assert_near(clone(solver)(R), solver(R), LOCAL)


def test_solve_laplacian():
    """Zero at each anchor, and L x = b wherever b can be met."""
    mesh = dp.Mesh(*meshes.parts())
    L = dp.laplacian(mesh).toarray()
    b = L @ checks.normal((mesh.n_vertices, 2))
    x = dp.PoissonSolver(mesh).solve_laplacian(torch.from_numpy(b)).numpy()
    labels = references.components(mesh.n_vertices, mesh.faces.numpy())
    anchors = [np.flatnonzero(labels == label)[0] for label in np.unique(labels)]
    assert (x[anchors] == 0).all()
    assert_near(L @ x, b, SOLVE)


def test_solve_laplacian_rejects_other_row_counts(unchecked):
    solver = dp.PoissonSolver(dp.Mesh(*meshes.disk()))
    with pytest.raises(ValueError, match=re.escape("shape (n=25, k), got (24, 1)")):
        solver.solve_laplacian(torch.zeros(24, 1, dtype=torch.float64))


def test_repr():
    solver = dp.PoissonSolver(dp.Mesh(*meshes.triangle()), gauge="vertex")
    assert repr(solver).startswith("PoissonSolver(Mesh(n_vertices=3")
    assert repr(solver).endswith("0 pins, 0 handles, 1 floating components)")


def test_updating_a_union_keeps_its_constraints():
    """The union of a pinned and a free solver, moved, is the union of both moved."""
    pinned = dp.PoissonSolver(dp.Mesh(*meshes.disk()), pins=torch.tensor([3, 0]))
    free = dp.PoissonSolver(dp.Mesh(*meshes.sphere()))
    moved = [2 * solver.mesh.vertices.sin() + solver.mesh.vertices for solver in (pinned, free)]
    union = dp.PoissonSolver.concatenate([pinned, free]).update(torch.cat(moved))
    R, images = field(union.mesh), torch.from_numpy(np.random.default_rng(1).random((2, 3)))
    expected = [
        pinned.update(moved[0])(R[: pinned.mesh.n_faces], pins=images),
        free.update(moved[1])(R[pinned.mesh.n_faces :]),
    ]
    assert_near(union(R, pins=images), torch.cat(expected), SOLVE)


@pytest.mark.parametrize("transform", ["grad", "jvp", "hessian", "vmap", "inference"])
def test_first_use_inside_a_transform_leaves_no_trace(transform):
    """Mesh, operators and factor made inside: the same numbers, and usable afterwards."""
    vertices, faces = meshes.disk()
    expected = dp.PoissonSolver(dp.Mesh(vertices, faces))
    R = field(expected.mesh, c=2)
    kept = []

    def energy(R):
        mesh = dp.Mesh(vertices, faces)
        solver = dp.PoissonSolver(mesh)
        kept.append((mesh, solver))
        return dp.jacobians(mesh, solver(R), extrinsic=True).sin().sum() + mesh.normals.sum()

    def known(R):
        J = dp.jacobians(expected.mesh, expected(R), extrinsic=True)
        return J.sin().sum() + expected.mesh.normals.sum()

    def apply(function):
        if transform == "grad":
            return grad(function)(R)
        if transform == "jvp":
            return jvp(function, (R,), (R.cos(),))[1]
        if transform == "hessian":
            return hessian(lambda t: function(t * R))(torch.ones(2, 1, dtype=R.dtype))
        if transform == "vmap":
            return vmap(function)(torch.stack([R, 2 * R]))
        with torch.inference_mode():
            return function(R)

    assert_near(apply(energy), apply(known), SOLVE)
    mesh, solver = kept[0]
    R = R.clone().requires_grad_()
    (dp.jacobians(mesh, solver(R)) * mesh.frames[:, :2]).sum().backward()
    assert R.grad.isfinite().all()


def test_a_mesh_of_differentiated_vertices_raises():
    vertices, faces = meshes.disk()
    R = field(dp.Mesh(vertices, faces), c=2)
    with pytest.raises(dp.MeshError, match="vertices require grad"):
        grad(lambda v: dp.solve_poisson(dp.Mesh(v, faces), R).sum())(torch.from_numpy(vertices))


def test_an_update_keeps_the_gauge_that_fixes_a_vertex():
    mesh = dp.Mesh(*meshes.parts())
    R, moved = checks.field(mesh), mesh.vertices * 1.5
    phi = dp.PoissonSolver(mesh, gauge="vertex").update(moved)(R)
    expected = dp.PoissonSolver(mesh.with_vertices(moved), gauge="vertex")(R)
    assert torch.equal(phi, expected)
    assert (phi[0] == 0).all()


def test_a_factor_without_digits_raises(monkeypatch):
    """The check alone, on a factor of another matrix: half of the size is the bound of errors."""
    mesh = dp.Mesh(*meshes.disk(0))
    factorised = poisson.CholeskyFactor

    def solver(factor: float, **options) -> dp.PoissonSolver:
        monkeypatch.setattr(poisson, "CholeskyFactor", lambda L, device: factorised(factor * L))
        return dp.PoissonSolver(mesh, **options)

    for factor, options in (
        (2.01, {}),
        (2.5, {"pins": torch.tensor([0, 5])}),
        (2.5, {"handles": torch.tensor([3])}),
    ):
        with pytest.raises(dp.MeshError, match="leaves no digit"):
            solver(factor, **options)
    solver(1.99)


def test_digits_are_required_of_each_held_component(monkeypatch):
    """A large component in place does not make up for a small one that is lost."""
    large = dp.Mesh(10 * meshes.disk()[0], meshes.disk()[1])
    mesh = dp.Mesh.concatenate([large, dp.Mesh(*meshes.disk())])
    pins = torch.tensor([0, large.n_vertices])
    exact = poisson.PoissonSolver._fitted

    def lost(self, *arguments):
        return exact(self, *arguments).index_fill(0, torch.arange(40, mesh.n_vertices), 0)

    dp.PoissonSolver(mesh, pins=pins)
    monkeypatch.setattr(poisson.PoissonSolver, "_fitted", lost)
    with pytest.raises(dp.MeshError, match="leaves no digit"):
        dp.PoissonSolver(mesh, pins=pins)
