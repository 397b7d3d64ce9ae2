"""Constraints, derivatives by the geometry, and tetrahedra: `constraint_checks.py`, and errors."""

from __future__ import annotations

import pytest
import torch

import diffpoisson as dp
from tests import constraint_checks, meshes
from tests.checks import field


@pytest.mark.parametrize("check", constraint_checks.CHECKS.values(), ids=constraint_checks.CHECKS)
def test_property(check):
    check()


def test_a_number_is_not_rounded(unchecked):
    """A weight given as a Python number is that number, not its float32 rounding."""
    mesh = dp.Mesh(*meshes.disk())
    R, handles, q = field(mesh), torch.tensor([3, 7]), torch.ones(2, 3, dtype=torch.float64)
    for weights in (0.7, [0.7, 0.7]):
        given = dp.PoissonSolver(mesh, handles=handles, handle_weights=weights)
        exact = torch.full((2,), 0.7, dtype=torch.float64)
        expected = dp.PoissonSolver(mesh, handles=handles, handle_weights=exact)
        assert torch.equal(given(R, handles=q), expected(R, handles=q))
