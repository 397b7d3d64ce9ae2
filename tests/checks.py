"""Properties of a correct gradient and Poisson layer, each a function that asserts.

`test_gradient.py` and `test_poisson.py` run them on the package as it is; `test_faults.py` runs
them on deliberately broken versions of it, to show that they would notice. Each builds its own
meshes and solvers, so that it sees whatever version is in place when it is called.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import igl
import numpy as np
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jvp

import diffpoisson as dp
from tests import meshes, references
from tests.conftest import TOLERANCES

LOCAL = TOLERANCES["local"][torch.float64]
SOLVE = TOLERANCES["solve"][torch.float64]

CHECKS: dict[str, Callable[[], None]] = {}


def check(function: Callable[[], None]) -> Callable[[], None]:
    CHECKS[function.__name__.removeprefix("check_")] = function
    return function


# ------------------------------------------------------- tools


def assert_near(actual: Tensor | np.ndarray, expected: Tensor | np.ndarray, rtol: float) -> None:
    """Largest error at most rtol times the largest expected entry: no cancellation is punished."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    error = np.abs(actual - expected).max(initial=0)
    assert error <= rtol * np.abs(expected).max(initial=0), f"error {error:.2e}"


def field(mesh: dp.Mesh, c: int = 3, k: int = 3, seed: int = 0, batch: tuple = ()) -> Tensor:
    """A random matrix per face: no map has these Jacobians."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.standard_normal((*batch, mesh.n_faces, c, k)))


def constant(mesh: dp.Mesh, M: np.ndarray) -> Tensor:
    return torch.from_numpy(M).expand(mesh.n_faces, *M.shape).clone()


def normal(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape)


ALL = tuple(meshes.TOPOLOGIES.values())
SPATIAL = tuple(meshes.SPATIAL.values())


# ------------------------------------------------------- gradient


@check
def check_gradient_against_edge_basis() -> None:
    for build in ALL:
        vertices, faces = build(0)
        phi = normal((len(vertices), 4))
        J = dp.jacobians(dp.Mesh(vertices, faces), torch.from_numpy(phi), extrinsic=True)
        assert_near(J, references.jacobians(vertices, faces, phi), LOCAL)


@check
def check_laplacian_against_libigl() -> None:
    for build in ALL:
        vertices, faces = build(0)
        expected = -igl.cotmatrix(vertices, faces).toarray()
        assert_near(dp.laplacian(dp.Mesh(vertices, faces)).toarray(), expected, SOLVE)


@check
def check_divergence_is_adjoint() -> None:
    """⟨∇ᵀA R, φ⟩ = Σ |t| ⟨R, ∇φ⟩ with the areas and gradients of the reference."""
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        R, phi = field(mesh, k=mesh.dim).numpy(), normal((len(vertices), 3))
        J = references.jacobians(vertices, faces, phi)
        expected = references.areas(vertices, faces) @ (R * J).sum((1, 2))
        actual = (dp.divergence(mesh, torch.from_numpy(R)).numpy() * phi).sum()
        assert abs(actual - expected) <= LOCAL * (np.abs(R) * np.abs(J)).sum()


# ------------------------------------------------------- what the layer computes


@check
def check_round_trip() -> None:
    """The usual test, weak because a wrong gradient cancels against itself."""
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        phi = normal((len(vertices), 3))
        solved = dp.PoissonSolver(mesh)(dp.jacobians(mesh, torch.from_numpy(phi)))
        assert_near(solved, references.centred(vertices, faces, phi), SOLVE)


@check
def check_reference() -> None:
    """Random, non-integrable fields against libigl's gradient and a dense pseudo-inverse."""
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        R = field(mesh, k=mesh.dim)
        assert_near(
            dp.PoissonSolver(mesh)(R), references.poisson(vertices, faces, R.numpy()), SOLVE
        )


@check
def check_energy_optimality() -> None:
    """The energy, by an independent gradient, is stationary.

    It is quadratic, so central differences of any step are exact.
    """
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        R = field(mesh, k=mesh.dim)
        phi = dp.PoissonSolver(mesh)(R).numpy()
        energy = partial(references.dirichlet_energy, vertices, faces, R.numpy())
        for seed in range(3):
            step = normal(phi.shape, seed)
            slope = (energy(phi + step) - energy(phi - step)) / 2
            assert abs(slope) <= SOLVE * energy(phi + step)


@check
def check_affine() -> None:
    """A linear map with a non-symmetric matrix is reproduced."""
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        M = normal((mesh.dim, mesh.dim))
        solved = dp.PoissonSolver(mesh)(constant(mesh, M))
        assert_near(solved, references.centred(vertices, faces, vertices @ M.T), SOLVE)


@check
def check_manufactured_rate() -> None:
    """R = ∇u + rot ∇ψ, ψ = 0 on the boundary, is solved by u (Helmholtz) at rate h²."""
    pi = np.pi
    errors, sizes = [], (9, 17, 33, 65)
    for size in sizes:
        vertices, faces = meshes.planar_disk(1, size)
        mesh = dp.Mesh(vertices, faces)
        x, y = vertices[faces].mean(1).T
        gradient = [
            -pi * np.sin(pi * x) * np.cos(2 * pi * y),
            -2 * pi * np.cos(pi * x) * np.sin(2 * pi * y),
        ]
        rotated = [
            -pi * np.sin(pi * x) * np.cos(pi * y),
            pi * np.cos(pi * x) * np.sin(pi * y),
        ]
        R = np.stack(gradient, axis=1) + 3 * np.stack(rotated, axis=1)
        u = np.cos(pi * vertices[:, :1]) * np.cos(2 * pi * vertices[:, 1:])
        error = dp.PoissonSolver(mesh)(torch.from_numpy(R)[:, None]).numpy()
        error = error - references.centred(vertices, faces, u)
        errors.append(np.sqrt(references.vertex_areas(vertices, faces) @ error[:, 0] ** 2))
    rate = np.polyfit(-np.log(np.array(sizes) - 1), np.log(errors), 1)[0]
    assert 1.85 < rate < 2.15, rate


@check
def check_zero_and_linearity() -> None:
    mesh = dp.Mesh(*meshes.parts())
    solver = dp.PoissonSolver(mesh)
    a, b = field(mesh, seed=1), field(mesh, seed=2)
    assert_near(solver(2 * a - 3 * b), 2 * solver(a) - 3 * solver(b), SOLVE)
    assert torch.equal(solver(torch.zeros_like(a)), torch.zeros(mesh.n_vertices, 3).double())


# ------------------------------------------------------- gauge and components


@check
def check_mean_gauge() -> None:
    """The area-weighted mean of every component is zero, on meshes of very uneven areas."""
    vertices, faces = meshes.parts()
    vertices = vertices * (1 + 2 * (vertices[:, :1] > vertices[:, :1].mean()))
    mesh = dp.Mesh(vertices, faces)
    phi = dp.PoissonSolver(mesh)(field(mesh)).numpy()
    assert_near(phi, references.centred(vertices, faces, phi), LOCAL)


@check
def check_vertex_gauge() -> None:
    """The vertex of lowest index of every component is at zero; otherwise the same map."""
    mesh = dp.Mesh(*meshes.parts())
    R = field(mesh)
    phi = dp.PoissonSolver(mesh, gauge="vertex")(R)
    labels = references.components(mesh.n_vertices, mesh.faces.numpy())
    anchors = [np.flatnonzero(labels == label)[0] for label in np.unique(labels)]
    assert torch.equal(phi[anchors], torch.zeros(3, 3).double())
    assert_near(dp.jacobians(mesh, phi), dp.jacobians(mesh, dp.PoissonSolver(mesh)(R)), SOLVE)


@check
def check_disconnected_as_each_alone() -> None:
    for gauge in ("mean", "vertex"):
        arrays = [meshes.disk(), meshes.sphere(), meshes.bowtie()]
        alone = [dp.PoissonSolver(dp.Mesh(*a), gauge=gauge) for a in arrays]
        fields = [field(s.mesh, seed=i) for i, s in enumerate(alone)]
        whole = dp.PoissonSolver(dp.Mesh(*meshes.union(*arrays)), gauge=gauge)
        expected = torch.cat([s(R) for s, R in zip(alone, fields, strict=True)])
        assert_near(whole(torch.cat(fields)), expected, LOCAL)


@check
def check_concatenated_as_each_alone() -> None:
    for gauge in ("mean", "vertex"):
        arrays = [meshes.disk(), meshes.parts(), meshes.disk(3)]
        alone = [dp.PoissonSolver(dp.Mesh(*a), gauge=gauge) for a in arrays]
        fields = [field(s.mesh, seed=i, batch=(2,)) for i, s in enumerate(alone)]
        union = dp.PoissonSolver.concatenate(alone)
        expected = torch.cat([s(R) for s, R in zip(alone, fields, strict=True)], dim=1)
        assert_near(union(torch.cat(fields, dim=1)), expected, LOCAL)


@check
def check_cache_is_not_stale() -> None:
    """Another geometry with the same faces, while the first solver is alive."""
    vertices, faces = meshes.disk()
    first = dp.PoissonSolver(dp.Mesh(vertices, faces))
    stretched = vertices * [3.0, 1, 1]
    mesh = dp.Mesh(stretched, faces)
    R = field(mesh)
    assert_near(dp.PoissonSolver(mesh)(R), references.poisson(stretched, faces, R.numpy()), SOLVE)
    assert_near(first(R), references.poisson(vertices, faces, R.numpy()), SOLVE)


# ------------------------------------------------------- equivariance


@check
def check_restricted_or_not() -> None:
    """The part of an ambient matrix along the normal has no effect."""
    for build in SPATIAL:
        mesh = dp.Mesh(*build(0))
        solver, P = dp.PoissonSolver(mesh), field(mesh)
        along_normal = field(mesh, k=1, seed=7) * mesh.normals[:, None, :]
        assert_near(solver(dp.restrict(P, mesh.frames)), solver(P), SOLVE)
        assert_near(solver(P + along_normal), solver(P), SOLVE)


@check
def check_rigid_motion() -> None:
    vertices, faces = meshes.parts()
    mesh = dp.Mesh(vertices, faces)
    Q = meshes.rotation(np.random.default_rng(0), vertices)
    moved = dp.Mesh(vertices @ Q.T + [1, 2, 3], faces)
    R = field(mesh)
    assert_near(
        dp.PoissonSolver(moved)(R @ torch.from_numpy(Q).T), dp.PoissonSolver(mesh)(R), SOLVE
    )


@check
def check_scale() -> None:
    """Twelve decades, with one relative tolerance."""
    vertices, faces = meshes.parts()
    mesh = dp.Mesh(vertices, faces)
    R = field(mesh)
    expected = dp.PoissonSolver(mesh)(R)
    for scale in (1e-6, 1e-3, 1e3, 1e6):
        solved = dp.PoissonSolver(dp.Mesh(scale * vertices, faces))(R)
        assert_near(solved / scale, expected, SOLVE)


@check
def check_renumbering() -> None:
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        new_vertices, new_faces, p, q = meshes.renumbered(np.random.default_rng(4), vertices, faces)
        R = field(mesh, k=mesh.dim)
        renumbered = dp.PoissonSolver(dp.Mesh(new_vertices, new_faces))
        assert_near(renumbered(R[q]), dp.PoissonSolver(mesh)(R)[p], SOLVE)


@check
def check_corner_order() -> None:
    """Cycled and flipped corners turn the frames, not the map."""
    for build in ALL:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        R = field(mesh, k=mesh.dim)
        turned = faces.copy()
        turned[::2] = turned[::2][:, [1, 2, 0]]
        turned[1::3] = turned[1::3][:, [0, 2, 1]]
        assert_near(
            dp.PoissonSolver(dp.Mesh(vertices, turned))(R), dp.PoissonSolver(mesh)(R), SOLVE
        )


@check
def check_frame_choice() -> None:
    """Intrinsic input re-expressed in the frames of cycled corners gives the same map."""
    vertices, faces = meshes.torus()
    mesh, cycled = dp.Mesh(vertices, faces), dp.Mesh(vertices, faces[:, [2, 0, 1]])
    turn = mesh.frames.mT @ cycled.frames  # (m, 2, 2) rotations, different on every face
    assert (turn[:, 0, 0] - 1).abs().min() > 0.1
    R = field(mesh, k=2)
    assert_near(dp.PoissonSolver(cycled)(R @ turn), dp.PoissonSolver(mesh)(R), SOLVE)


# ------------------------------------------------------- as a torch function


def small_layer() -> tuple[dp.PoissonSolver, Tensor]:
    """A layer of two components, on (4, 2, 2) fields."""
    arrays = meshes.union(meshes.book(), meshes.triangle())
    solver = dp.PoissonSolver(dp.Mesh(*arrays))
    return solver, field(solver.mesh, c=2, k=2)


@check
def check_backward() -> None:
    solver, R = small_layer()
    R.requires_grad_()
    assert gradcheck(solver, R, raise_exception=False)
    assert gradcheck(partial(dp.divergence, solver.mesh), R, raise_exception=False)


@check
def check_double_backward() -> None:
    solver, R = small_layer()
    assert gradgradcheck(lambda R: solver(R) ** 2, R.requires_grad_(), raise_exception=False)


@check
def check_adjoint_of_the_solve() -> None:
    """⟨S R, y⟩ = ⟨R, Sᵀ y⟩ to roundings: finer than gradcheck's finite differences."""
    mesh = dp.Mesh(*meshes.parts())
    R = field(mesh).requires_grad_()
    phi = dp.PoissonSolver(mesh)(R)
    y = torch.from_numpy(normal(phi.shape))
    (gradient,) = torch.autograd.grad(phi, R, y)
    difference = (phi.detach() * y).sum() - (R.detach() * gradient).sum()
    assert abs(difference) <= 1e-12 * (phi * y).abs().sum()


@check
def check_forward_mode() -> None:
    """The operators are linear: the tangent is the operator of the tangent."""
    solver, R = small_layer()
    # Also one factor of the composition alone: in it, two wrong signs would cancel.
    for operator in (solver, partial(dp.divergence, solver.mesh)):
        value, tangent = jvp(operator, (R,), (2 * R,))
        assert_near(tangent, 2 * operator(R), LOCAL)
        assert_near(value, operator(R), LOCAL)


@check
def check_forward_over_forward() -> None:
    """∂ᵤ∂ᵥ (S R²)² = 2 S(2Ru) S(2Rv) + 2 S(R²) S(2uv): nonlinear before and after the layer S."""
    S, R = small_layer()
    u, v = field(S.mesh, c=2, k=2, seed=1), field(S.mesh, c=2, k=2, seed=2)

    def along_v(R: Tensor) -> Tensor:
        return jvp(lambda R: S(R**2) ** 2, (R,), (v,))[1]

    expected = 2 * S(2 * R * u) * S(2 * R * v) + 2 * S(R**2) * S(2 * u * v)
    assert_near(jvp(along_v, (R,), (u,))[1], expected, LOCAL)


@check
def check_vmap_against_a_loop() -> None:
    mesh = dp.Mesh(*meshes.parts())
    solver, R = dp.PoissonSolver(mesh), field(mesh, c=2, batch=(3,))
    expected = torch.stack([solver(single) for single in R])
    assert_near(torch.vmap(solver)(R), expected, LOCAL)
    assert_near(torch.vmap(solver, in_dims=2)(R.movedim(0, 2)), expected, LOCAL)
    assert_near(solver(R), expected, LOCAL)


@check
def check_strides() -> None:
    mesh = dp.Mesh(*meshes.disk())
    solver, R = dp.PoissonSolver(mesh), field(mesh)
    expected = solver(R)
    assert_near(solver(R.transpose(0, 2).contiguous().transpose(0, 2)), expected, LOCAL)
    assert_near(solver(R.mT.contiguous().mT), expected, LOCAL)
    assert_near(solver(torch.cat([R, R], dim=2)[:, :, :3]), expected, LOCAL)
    assert_near(solver(R[:, :, :1].expand_as(R)), solver(R[:, :, :1].repeat(1, 1, 3)), LOCAL)


@check
def check_input_is_untouched() -> None:
    mesh = dp.Mesh(*meshes.disk())
    solver = dp.PoissonSolver(mesh)
    for k in (2, 3):
        R = field(mesh, k=k)
        before = R.clone()
        solver(R)
        assert torch.equal(R, before)


@check
def check_precision() -> None:
    """float32 in, float32 out, but solved in float64: an error of single roundings of R."""
    vertices, faces = meshes.planar_disk(size=33)
    mesh = dp.Mesh(vertices, faces)
    solver, R = dp.PoissonSolver(mesh), field(mesh, k=2)
    assert solver(R).dtype == torch.float64
    single = solver(R.float())
    assert single.dtype == torch.float32
    assert_near(single, solver(R.float().double()), 2.0**-23)
