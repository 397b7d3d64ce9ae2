"""Properties of maps found step by step: closest rotations, ARAP, embeddings, flattening.

Like `checks.py`: each a function that asserts, run on the package as it is by `test_maps.py`, and
on broken versions of it by `test_faults.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import igl
import numpy as np
import pytest
import scipy.linalg
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp

import diffpoisson as dp
from diffpoisson import flattening
from diffpoisson.parameterization import _embeddings
from tests import meshes
from tests.checks import assert_near

CHECKS: dict[str, Callable[[], None]] = {}


def check(function: Callable[[], None]) -> Callable[[], None]:
    CHECKS[function.__name__.removeprefix("check_")] = function
    return function


# ------------------------------------------------------- tools


def matrices(d: int = 3, n: int = 40, seed: int = 0) -> Tensor:
    """Generic 3 × d ones; square, half of them flipped."""
    return torch.from_numpy(np.random.default_rng(seed).standard_normal((n, 3, d)))


def of_signed_values(values: Tensor, seed: int = 0) -> Tensor:
    """Matrices of these signed singular values, (n, 3), between random rotations."""
    left, right = (
        torch.from_numpy(Rotation.random(len(values), random_state=s).as_matrix())
        for s in (seed, seed + 1)
    )
    return (left * values[:, None]) @ right


def aligned(J: Tensor) -> np.ndarray:
    """The rotation that takes the axes closest to the columns of J, which SciPy aligns."""
    flat = J.detach().double().reshape(-1, 3, J.shape[-1]).mT.numpy()
    axes = np.eye(3)[: J.shape[-1]]
    Q = [Rotation.align_vectors(columns, axes)[0].as_matrix() for columns in flat]
    return np.reshape(Q, (*J.shape[:-2], 3, 3))[..., : J.shape[-1]]


def turning(J: Tensor, direction: Tensor) -> np.ndarray:
    """The derivative for one J = Q P: Q Ω, where Ω is antisymmetric and PΩ + ΩP = QᵀJ' - J'ᵀQ."""
    Q = aligned(J)
    P, turned = Q.T @ J.numpy(), Q.T @ direction.numpy()
    return Q @ scipy.linalg.solve_sylvester(P, P, turned - turned.T)


class Bar:
    """A solid away from the origin, whose ends are handles of uneven strength; uneven weights."""

    def __init__(self) -> None:
        vertices, cells = meshes.box(0, 3)
        self.mesh = dp.Mesh(vertices + 3, cells)
        x = self.mesh.vertices[:, 0]
        self.handles = torch.nonzero((x == x.min()) | (x == x.max()))[:, 0]
        rng = np.random.default_rng(0)
        self.strengths = torch.from_numpy(rng.uniform(0.1, 0.3, len(self.handles)))
        self.weights = torch.from_numpy(rng.uniform(0.5, 1.5, self.mesh.n_faces))
        self.solver = dp.PoissonSolver(
            self.mesh,
            handles=self.handles,
            handle_weights=self.strengths,
            face_weights=self.weights,
        )
        self.images = self.mesh.vertices[self.handles].clone()
        self.images[x[self.handles] == x.max(), 1] += 0.4

    def map(self, steps: int | None = None, **options: float) -> dp.RigidMap:
        if steps is not None:
            options |= {"tolerance": None, "max_steps": steps}
        return dp.as_rigid_as_possible(self.solver, handles=self.images, **options)

    def energy(self, phi: Tensor) -> float:
        """By SciPy's rotations."""
        J = dp.jacobians(self.mesh, phi).numpy()
        strain = ((J - aligned(torch.from_numpy(J))) ** 2).sum((-2, -1))
        missed = ((phi[self.handles] - self.images) ** 2).sum(-1)
        weights = self.weights * self.mesh.measures
        return float(weights.numpy() @ strain + (self.strengths * missed).sum().numpy())


# ------------------------------------------------------- closest rotations


@check
def check_rotations_against_scipy() -> None:
    for d in (2, 3):
        J = matrices(d)
        assert_near(dp.closest_rotation(J), aligned(J), 1e-13)


@check
def check_rotations_almost_not_unique() -> None:
    """Corrections are no longer small there, and only as Cayley has them do they keep lengths."""
    n, eps = 2000, torch.finfo(torch.float64).eps
    gap = torch.logspace(0, 4, n, dtype=torch.float64) * eps
    middle = torch.linspace(0, 0.9, n, dtype=torch.float64)
    J = of_signed_values(torch.stack([torch.ones_like(gap), middle, gap - middle], dim=1))
    Q = dp.closest_rotation(J)
    assert_near(Q.mT @ Q, torch.eye(3, dtype=torch.float64).expand(n, 3, 3), 20 * eps)
    assert_near(((J - Q) ** 2).sum((-2, -1)), dp.arap(J), 40 * eps)


@check
def check_turning_by_sylvester() -> None:
    J, v = matrices(n=12), matrices(n=12, seed=1)
    _, found = jvp(dp.closest_rotation, (J,), (v,))
    expected = np.stack([turning(*pair) for pair in zip(J, v, strict=True)])
    assert_near(found, expected, 1e-11)


@check
def check_turning_at_a_rotation() -> None:
    """By hand, half the antisymmetric part: all singular values are one."""
    X = matrices(n=1)[0]
    _, found = jvp(dp.closest_rotation, (torch.eye(3, dtype=torch.float64),), (X,))
    assert_near(found, (X - X.mT) / 2, 1e-14)


@check
def check_third_derivatives_of_rotations() -> None:
    """Against differences of second ones."""
    v, h = matrices(n=1, seed=1)[0], 1e-4

    def sum_of_cubes(J: Tensor) -> Tensor:
        return (dp.closest_rotation(J) ** 3).sum()

    for x in matrices(n=2):
        for one, two in ((jacfwd, jacrev), (jacfwd, jacfwd)):
            second = one(two(sum_of_cubes))
            _, along = jvp(second, (x,), (v,))
            assert_near(along, (second(x + h * v) - second(x - h * v)) / (2 * h), 1e-5)


@check
def check_no_turning_where_several_are_closest() -> None:
    """σ₂ + σ₃ = 0 but for rounding: rank one, and reflections."""
    n = 2000
    for ratio in (0, 1e-8, 0.3, 1):
        values = torch.tensor([[1, ratio, -ratio]], dtype=torch.float64).expand(n, 3)
        J = of_signed_values(values).requires_grad_()
        (derivative,) = torch.autograd.grad((dp.closest_rotation(J) ** 3).sum(), J)
        assert not derivative.any()


# ------------------------------------------------------- as rigid as possible


@check
def check_energies_of_rigid_maps() -> None:
    bar = Bar()
    energies = bar.map(8).energies
    assert (energies.diff() < 0).all()
    for steps in (1, 3, 8):
        assert abs(bar.energy(bar.map(steps).vertices) / float(energies[steps - 1]) - 1) < 1e-10


@check
def check_rigid_maps_are_minima() -> None:
    """By differences of the energy along random directions."""
    bar = Bar()
    phi = bar.map(tolerance=1e-9, max_steps=5000).vertices
    for seed in range(4):
        v = torch.from_numpy(np.random.default_rng(seed).standard_normal(phi.shape))
        below, at, above = (bar.energy(phi + h * v) for h in (-1e-3, 0, 1e-3))
        assert min(below, above) > at
        assert abs(above - below) < 1e-2 * (above + below - 2 * at)


@check
def check_moves_of_rigid_maps() -> None:
    """In shares of the diagonal of a box far from the origin; the first not above ends it."""
    bar = Bar()
    vertices = bar.mesh.vertices.numpy()
    size = np.linalg.norm(np.ptp(vertices, axis=0))
    maps = [bar.map(steps).vertices.numpy() for steps in range(1, 7)]
    expected = [np.linalg.norm(b - a, axis=1).max() / size for a, b in pairwise(maps)]
    moves = bar.map(6).moves
    assert_near(moves, expected, 1e-12)
    stopped = bar.map(tolerance=float(moves[2]))
    assert torch.equal(stopped.moves, moves[:3])
    assert_near(stopped.vertices, maps[3], 1e-14)


@check
def check_gradient_of_a_rigid_map() -> None:
    """Of an iterate, by the handles, against a difference."""
    bar, h = Bar(), 1e-5
    q = bar.images
    v = torch.from_numpy(np.random.default_rng(1).standard_normal(q.shape))

    def iterate(q: Tensor) -> Tensor:
        return dp.as_rigid_as_possible(bar.solver, handles=q, tolerance=None, max_steps=4).vertices

    _, along = jvp(iterate, (q,), (v,))
    assert_near(along, (iterate(q + h * v) - iterate(q - h * v)) / (2 * h), 1e-7)
    y = torch.from_numpy(np.random.default_rng(2).standard_normal(along.shape))
    q.requires_grad_()
    (gradient,) = torch.autograd.grad(iterate(q), q, y)
    assert abs(float((gradient * v).sum() - (along * y).sum())) < 1e-10


# ------------------------------------------------------- embeddings and flattening


@check
def check_embeddings_are_weighted_means() -> None:
    """By the definition, one vertex at a time, for pulls of one, two, four …"""
    vertices, faces = meshes.disk(3, 7)
    neighbours = {v: np.setdiff1d(faces[(faces == v).any(1)], v) for v in range(len(vertices))}
    loop = np.asarray(igl.boundary_loop(faces))
    depth = np.where(np.isin(np.arange(len(vertices)), loop), 0, len(vertices))
    for _ in depth:
        depth = np.array([min(depth[v], 1 + depth[neighbours[v]].min()) for v in neighbours])
    for k, uv in enumerate(_embeddings(dp.Mesh(vertices, faces))):
        for v in np.flatnonzero(depth):
            weights = 2.0 ** (-k * depth[neighbours[v]])
            assert_near(uv[v], np.average(uv[neighbours[v]], axis=0, weights=weights), 1e-11)
    assert k == 4


def winding_strip(turns: float, size: int = 24) -> dp.Mesh:
    """A ring's strip that climbs as it winds: flat, it would cover itself."""
    angle, radius = np.meshgrid(
        np.linspace(0, 2 * np.pi * turns, size), [0.3, 0.65, 1.0], indexing="ij"
    )
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * angle], axis=-1)
    grid = np.arange(3 * size).reshape(size, 3)
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    return dp.Mesh(vertices.reshape(-1, 3), np.r_[np.c_[a, b, c], np.c_[a, c, d]])


def collapsed_up_to_rounding() -> tuple[dp.Mesh, list[Tensor]]:
    """A disk and maps of it, each with one corner on the opposite edge but for rounding.

    Computed in floating point, the Jacobian of that triangle is flipped where the triangle is not,
    or the other way round.
    """
    mesh = dp.Mesh(*meshes.disk(0, 4))
    (around,) = mesh.faces[(mesh.faces == 3).any(1)].tolist()
    a, b = (v for v in around if v != 3)
    rng = np.random.default_rng(0)
    found: dict[bool, Tensor] = {}
    while len(found) < 2:
        uv = mesh.vertices[:, :2] + torch.from_numpy(10 * rng.normal(size=2))
        uv[3] = torch.lerp(uv[a], uv[b], rng.random())
        exactly = dp.certify(mesh, uv).n_flipped
        if exactly != int(dp.flipped(dp.jacobians(mesh, uv)).sum()):
            found[bool(exactly)] = uv
    return mesh, list(found.values())


def flattened(mesh: dp.Mesh, init: Tensor | None) -> flattening.Flattening:
    """SLIM's refusal of a start is a failed assertion: it should not have been asked."""
    try:
        return flattening.flatten_disk(mesh, init, solver=None, injective=True, tolerance=1e-2)
    except dp.MeshError as error:
        raise AssertionError(str(error)) from error


@check
def check_starts_that_round_to_a_flip() -> None:
    """Flipped exactly or as computed, a start is not what SLIM begins with."""
    mesh, starts = collapsed_up_to_rounding()
    for uv in starts:
        found = flattened(mesh, uv)
        assert dp.certify(mesh, found.uv).injective
        assert found.method != "init"


@check
def check_what_is_not_untangled_is_not_polished() -> None:
    """Where untangling leaves a flip, or an overlap, the flattening starts anew from Tutte's."""
    disk, strip = dp.Mesh(*meshes.disk(0, 4)), winding_strip(1.2)
    flat, wound = disk.vertices[:, :2], strip.vertices[:, :2]
    flipped = flat.clone()
    flipped[5] = flat[10]  # an interior vertex, past another, within the boundary
    for mesh, left, method in (
        (disk, flat, "tutte+untangle"),
        (disk, flipped, "tutte"),
        (strip, wound, "tutte"),
    ):
        assert dp.certify(mesh, left).simple_boundary is (left is not wound)
        assert (dp.certify(mesh, left).n_flipped > 0) is (left is flipped)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(flattening, "harmonic_disk", lambda mesh: -mesh.vertices[:, [1, 0]])
            patch.setattr(flattening, "untangle", lambda mesh, uv, left=left, **_: (left, 0))
            found = flattened(mesh, None)
        assert dp.certify(mesh, found.uv).injective
        assert found.method == method
