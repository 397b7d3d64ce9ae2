"""A valid map comes out whatever goes in."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffpoisson as dp
from tests import meshes, references
from tests.checks import assert_near
from tests.test_repair import spoiled


def independent_flips(mesh: dp.Mesh, uv: torch.Tensor) -> int:
    corners = uv.double().numpy()[mesh.faces.numpy()]
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return int((e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0] <= 0).sum())


@pytest.mark.parametrize("kind", ["none", "valid", "some flips", "noise", "mirrored", "collapsed"])
def test_every_start_ends_valid_and_as_good_as_slim(kind):
    mesh, solver, noisy = spoiled(3, 1.2)
    starts = {
        "none": None,
        "valid": mesh.vertices[:, :2].clone(),
        "some flips": noisy,
        "noise": torch.randn(mesh.n_vertices, 2, dtype=torch.float64),
        "mirrored": mesh.vertices[:, :2] * torch.tensor([1, -1]),
        "collapsed": torch.zeros(mesh.n_vertices, 2, dtype=torch.float64),
    }
    result = dp.parameterize(mesh, starts[kind], solver=solver)
    assert result.flipped == independent_flips(mesh, result.uv) == 0
    assert result.certified
    best = dp.slim(mesh, dp.tutte(mesh)).energies[-1]
    assert result.energy <= 1.001 * best
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    assert_near(result.energy, references.symmetric_dirichlet(V, F, result.uv.numpy()), 1e-9)
    expected = {"none": "tutte", "valid": "init", "some flips": "init+clamp"}
    assert result.method.startswith(expected.get(kind, ""))
    assert set(result.milliseconds) >= {"slim", "certify"}


def test_result_does_not_depend_on_unit():
    mesh, _, uv = spoiled(1, 1.2)
    large = dp.Mesh(1e5 * mesh.vertices, mesh.faces)
    a, b = dp.parameterize(mesh, uv), dp.parameterize(large, 1e5 * uv)
    assert b.energy == pytest.approx(a.energy, rel=1e-6)
    assert_near(b.uv / 1e5, a.uv, 1e-3)


def test_what_cannot_be_mapped_raises():
    sphere = dp.Mesh(*meshes.sphere())
    with pytest.raises(dp.MeshError, match="topological disk"):
        dp.parameterize(sphere)
    mesh = dp.Mesh(*meshes.disk())
    with pytest.raises(ValueError, match=r"expected init of shape \(n=25, 2\), got \(4, 2\)"):
        dp.parameterize(mesh, torch.zeros(4, 2))
    with pytest.raises(ValueError, match="not finite"):
        dp.parameterize(mesh, torch.full((25, 2), np.nan))
