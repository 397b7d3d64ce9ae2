"""Clamping against the SVD, repair and untangling on maps that are known to be mendable."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson.repair import clamp_flips, clamp_singular_values, untangle
from tests import meshes
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
    mesh, solver, uv = spoiled(0, 1.2)
    mirrored = uv * torch.tensor([1, -1])
    assert clamp_flips(solver, mirrored, max_rounds=0) == (pytest.approx(mirrored), 0)
    assert untangle(mesh, mirrored, max_rounds=1, iterations=1)[1] == 1


def test_untangling_turns_a_mirrored_map_over():
    mesh, _, uv = spoiled(0, 0.0)
    untangled, rounds = untangle(mesh, uv * torch.tensor([1, -1]), max_rounds=200)
    assert rounds > 0
    assert not dp.flipped(dp.jacobians(mesh, untangled)).any()


def test_dtype_is_kept():
    mesh, solver, uv = spoiled(1, 1.2)
    assert clamp_flips(solver, uv.float())[0].dtype == torch.float32
    assert untangle(mesh, uv.float())[0].dtype == torch.float32
