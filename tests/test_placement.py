"""From unknowns to a placed map, against the dense matrix C E written out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffpoisson as dp
from diffpoisson.constraints import Constraints
from diffpoisson.placement import Placement
from tests import meshes

ONE = meshes.disk()
TWO = meshes.union(meshes.disk(), meshes.sphere())


def mask_of_every_third(vertices: np.ndarray) -> torch.Tensor:
    return torch.arange(len(vertices)) % 3 == 0


CASES = {
    "one floats": (ONE, {}),
    "two float": (TWO, {}),
    "one of two floats": (TWO, {"pins": torch.tensor([3])}),
    "all held": (ONE, {"pins": torch.tensor([3, 0])}),
    "a mask": (ONE, {"gauge": mask_of_every_third(ONE[0])}),
    "a vertex": (TWO, {"gauge": "vertex"}),
}


def constraints_of(mesh: dp.Mesh, options: dict) -> Constraints:
    names = ("pins", "handles", "face_weights")
    given = {"gauge": "mean", "handle_weights": 1.0} | dict.fromkeys(names) | options
    return Constraints.build(mesh, **given)


def dense(constraints: Constraints, sizes: np.ndarray) -> np.ndarray:
    """C E, by the sentence that defines it."""
    n = len(sizes)
    E = np.eye(n)[:, constraints.free.numpy()]
    C = np.eye(n)
    if constraints.gauge_mask is None:
        return C @ E
    for q in range(constraints.n_floating):
        own = constraints.floating.numpy() == q
        weights = sizes * own * constraints.gauge_mask.numpy()
        C -= np.outer(own, weights / weights.sum())
    return C @ E


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("case", CASES)
def test_placement_is_the_dense_matrix(case: str, dtype: torch.dtype) -> None:
    (vertices, faces), options = CASES[case]
    mesh = dp.Mesh(vertices, faces)
    constraints = constraints_of(mesh, options)
    place = Placement(constraints, constraints.mean_weights(mesh.vertex_measures))
    expected = torch.from_numpy(dense(constraints, mesh.vertex_measures.numpy())).to(dtype)
    n, f = expected.shape
    tolerance = {"rtol": 0, "atol": 10 * torch.finfo(dtype).eps}
    assert place.shape == (n, f)
    torch.testing.assert_close(place.multiply(torch.eye(f, dtype=dtype)), expected, **tolerance)
    adjoint = place.transposed()
    assert adjoint.shape == (f, n)
    torch.testing.assert_close(adjoint.multiply(torch.eye(n, dtype=dtype)), expected.T, **tolerance)
    assert adjoint.transposed() is place


def test_the_argument_stays_as_it_is() -> None:
    mesh = dp.Mesh(*ONE)
    constraints = constraints_of(mesh, {})
    place = Placement(constraints, constraints.mean_weights(mesh.vertex_measures))
    for matrix in (place, place.transposed()):
        x = torch.randn(matrix.shape[1], 2, dtype=torch.float64)
        before = x.clone()
        matrix.multiply(x)
        assert torch.equal(x, before)


def test_nan_stays_in_its_component() -> None:
    mesh = dp.Mesh(*meshes.union(meshes.disk(), meshes.sphere(), meshes.disk()))
    parts = mesh.components
    held = torch.tensor([int((parts == q).nonzero()[0]) for q in (0, 2)])
    constraints = constraints_of(mesh, {"pins": held})
    place = Placement(constraints, constraints.mean_weights(mesh.vertex_measures))
    x = torch.ones(len(constraints.free), 1, dtype=torch.float64)
    x[0] = torch.nan  # of the first part, which is held
    assert torch.equal(place.multiply(x).isnan()[:, 0].nonzero()[:, 0], constraints.free[:1])
    y = torch.ones(mesh.n_vertices, 1, dtype=torch.float64)
    y[constraints.free[0]] = torch.nan
    assert place.transposed().multiply(y).isnan()[:, 0].tolist() == [True] + [False] * (len(x) - 1)
