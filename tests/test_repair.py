"""Clamping against the SVD, repair and untangling on maps that are known to be mendable."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson.repair import _energy, _epsilon, clamp_flips, clamp_singular_values, untangle
from tests import meshes, references
from tests.checks import assert_near


def clamped_by_svd(J: np.ndarray, smallest: float, largest: float) -> np.ndarray:
    """U diag(clamped signed σ) Vᵀ with rotations U and V."""
    U, sigma, Vt = np.linalg.svd(J)
    for Q, axis in ((U, (..., slice(None), 1)), (Vt, (..., 1, slice(None)))):
        sign = np.sign(np.linalg.det(Q))
        Q[axis] *= sign[..., None]
        sigma[..., 1] *= sign
    return (U * np.clip(sigma, smallest, largest)[..., None, :]) @ Vt


@given(seed=st.integers(0, 10**6))
def test_clamping_is_that_of_the_signed_svd(seed):
    J = np.random.default_rng(seed).standard_normal((50, 2, 2)) * 3
    clamped = clamp_singular_values(torch.from_numpy(J), 0.25, 4.0)
    assert_near(clamped, clamped_by_svd(J, 0.25, 4.0), 1e-12)
    values = dp.singular_values(clamped)
    assert values.min() >= 0.25 - 1e-12
    assert values.max() <= 4 + 1e-12


def test_clamping_keeps_what_is_allowed_and_is_the_closest():
    rng = np.random.default_rng(0)
    J = torch.from_numpy(rng.standard_normal((300, 2, 2)))
    clamped = clamp_singular_values(J, 0.5, 2.0)
    sigma = dp.singular_values(J)
    allowed = ((sigma >= 0.5) & (sigma <= 2)).all(-1)
    assert 10 < allowed.sum() < 290
    assert_near(clamped[allowed], J[allowed], 1e-13)
    distance = torch.linalg.matrix_norm(clamped - J)
    for _ in range(20):
        other = clamp_singular_values(clamped + 0.1 * torch.randn_like(J), 0.5, 2.0)
        assert (torch.linalg.matrix_norm(other - J) >= distance - 1e-12).all()


@pytest.mark.parametrize(
    "J",
    [np.zeros((2, 2)), np.eye(2), 9 * np.eye(2), np.diag([1.0, -1.0]), np.diag([5.0, -5.0])],
    ids=["zero", "identity", "large", "reflection", "large reflection"],
)
def test_clamping_where_a_part_vanishes(J):
    clamped = clamp_singular_values(torch.from_numpy(J), 0.25, 4.0)
    assert clamped.isfinite().all()
    sigma = dp.singular_values(clamped)
    assert (sigma >= 0.25 - 1e-14).all()
    assert (sigma <= 4 + 1e-14).all()


def test_clamping_needs_a_positive_interval():
    for limits in ((0.0, 1.0), (2.0, 1.0), (-1.0, 1.0)):
        with pytest.raises(ValueError, match="0 < smallest <= largest"):
            clamp_singular_values(torch.eye(2), *limits)


def spoiled(seed: int, strength: float) -> tuple[dp.Mesh, dp.PoissonSolver, torch.Tensor]:
    """A bumpy disk and its projection, integrated from Jacobians with noise: some faces flip."""
    mesh = dp.Mesh(*meshes.disk(seed, 9))
    solver = dp.PoissonSolver(mesh)
    generator = torch.Generator().manual_seed(seed)
    R = dp.jacobians(mesh, mesh.vertices[:, :2])
    noise = torch.randn(R.shape, dtype=R.dtype, generator=generator)
    return mesh, solver, solver(R + strength * noise)


@pytest.mark.parametrize("seed", range(5))
def test_both_repairs_mend_spoiled_maps(seed):
    mesh, solver, uv = spoiled(seed, 1.2)
    assert dp.flipped(dp.jacobians(mesh, uv)).any()
    for repaired, rounds in (clamp_flips(solver, uv), untangle(mesh, uv)):
        assert not dp.flipped(dp.jacobians(mesh, repaired)).any()
        assert rounds > 0


def test_valid_maps_come_back_as_they_are():
    mesh, solver, uv = spoiled(0, 0.0)
    for repaired, rounds in (clamp_flips(solver, uv), untangle(mesh, uv)):
        assert torch.equal(repaired, uv)
        assert rounds == 0


def test_repairs_give_up_after_their_rounds():
    mesh, solver, uv = spoiled(0, 8.0)
    once = solver(clamp_singular_values(dp.jacobians(mesh, uv), 0.5, 2.0))
    assert dp.flipped(dp.jacobians(mesh, once)).any()
    for count, expected in ((0, uv), (1, once)):
        clamped, rounds = clamp_flips(solver, uv, limits=(0.5, 2.0), max_rounds=count)
        assert_near(clamped, expected, 1e-12)
        assert rounds == count
        untangled, rounds = untangle(mesh, uv, max_rounds=count, iterations=1)
        assert torch.equal(untangled, uv) == (count == 0)
        assert rounds == count


def test_untangling_turns_a_mirrored_map_over():
    mesh, _, uv = spoiled(0, 0.0)
    untangled, rounds = untangle(mesh, uv * torch.tensor([1, -1]), max_rounds=200)
    assert rounds > 0
    assert not dp.flipped(dp.jacobians(mesh, untangled)).any()


def test_dtype_is_kept():
    mesh, solver, uv = spoiled(1, 1.2)
    assert clamp_flips(solver, uv.float())[0].dtype == torch.float32
    assert untangle(mesh, uv.float())[0].dtype == torch.float32


def test_strides_do_not_count():
    """Coordinates one after the other in memory, as a fuzzed call had them."""
    mesh, solver, uv = spoiled(1, 1.2)
    strided = uv.mT.contiguous().mT
    assert not strided.is_contiguous()
    assert torch.equal(untangle(mesh, strided)[0], untangle(mesh, uv)[0])
    assert torch.equal(clamp_flips(solver, strided)[0], clamp_flips(solver, uv)[0])


# ------------------------------------------------------- untangling


def test_depth_of_flips_decides_epsilon():
    """Small against the deepest flip, and falling with it to a floor near zero."""
    depths = [0.0, 1e-4, 1e-2, 1.0, 100.0]
    epsilons = [_epsilon(-depth) for depth in depths]
    assert epsilons == sorted(set(epsilons))
    assert 0 < epsilons[0] <= 1e-5
    assert all(e < depth / 5 for e, depth in zip(epsilons[1:], depths[1:], strict=True))


def test_energy_weighs_faces_by_area():
    """Without regularisation the mean of ‖J‖² / det J + det J + 1 / det J."""
    vertices, faces = meshes.disk(0)
    J = references.jacobians(vertices, faces, vertices[:, :2])
    u, v = np.linalg.svd(J, compute_uv=False).T
    density = u / v + v / u + u * v + 1 / (u * v)
    expected = np.average(density, weights=references.areas(vertices, faces))
    mesh = dp.Mesh(vertices, faces)
    assert float(_energy(mesh, mesh.vertices[:, :2], 0.0)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_untangling_does_not_depend_on_the_unit(scale):
    mesh, _, uv = spoiled(2, 1.2)
    expected, rounds = untangle(mesh, uv)
    scaled = untangle(dp.Mesh(scale * mesh.vertices, mesh.faces), scale * uv)
    assert torch.equal(scaled[0], scale * expected)
    assert scaled[1] == rounds


def test_untangling_needs_neither_double_precision_nor_a_constant():
    """Single precision is rounded at the end alone; the result has no graph."""
    mesh, _, uv = spoiled(2, 1.2)
    expected, rounds = untangle(mesh, uv.float().double())
    for single in (uv.float(), uv.float().requires_grad_()):
        actual = untangle(mesh, single)
        assert torch.equal(actual[0], expected.float())
        assert actual[1] == rounds
        assert not actual[0].requires_grad


def test_descent_stops_where_nothing_flips():
    mesh, _, uv = spoiled(2, 1.2)
    short, long = (untangle(mesh, uv, iterations=count) for count in (60, 200))
    assert short[1] == 1
    assert torch.equal(short[0], long[0])


def test_a_face_that_is_flat_is_a_flip():
    vertices = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    mesh = dp.Mesh(vertices, faces)
    uv = mesh.vertices[:, :2].clone()
    uv[4, 1] = 0  # on the edge from 0 to 1
    for repaired, rounds in (clamp_flips(dp.PoissonSolver(mesh), uv), untangle(mesh, uv)):
        assert rounds == 1
        assert not dp.flipped(dp.jacobians(mesh, repaired)).any()


# ------------------------------------------------------- arguments


def test_repair_names_what_it_refuses(unchecked):
    mesh = dp.Mesh(*meshes.planar_disk(0, 4))
    solver, uv = dp.PoissonSolver(mesh), mesh.vertices
    for operation, first in ((clamp_flips, solver), (untangle, mesh)):
        name = f"^{operation.__name__}: "
        with pytest.raises(TypeError, match=name):
            operation("mesh", uv)
        with pytest.raises(TypeError, match=name + "uv must be a torch tensor"):
            operation(first, uv.numpy())
        with pytest.raises(TypeError, match=name + "uv must be float32 or float64"):
            operation(first, uv.half())
        with pytest.raises(ValueError, match=name + "expected uv of shape"):
            operation(first, uv[1:])
        with pytest.raises(ValueError, match=name + "max_rounds must be at least 0"):
            operation(first, uv, max_rounds=-1)
    with pytest.raises(ValueError, match=r"^untangle: iterations must be at least 1"):
        untangle(mesh, uv, iterations=0)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ((np.eye(2), 1, 2), TypeError, "J must be a torch tensor"),
        ((torch.eye(2).half(), 1, 2), TypeError, "J must be float32 or float64"),
        ((torch.eye(3), 1, 2), ValueError, "expected J of shape"),
        ((torch.eye(2), None, 2), TypeError, "smallest must be a number"),
    ],
)
def test_clamping_names_what_it_refuses(arguments, kind, message, unchecked):
    with pytest.raises(kind, match="^clamp_singular_values: " + message):
        clamp_singular_values(*arguments)
