"""Samples are uniform by area, reproducible, and interpolate linear functions exactly."""

from __future__ import annotations

import re

import numpy as np
import pytest
import scipy.stats
import torch

import diffpoisson as dp
from tests import checks, meshes, references
from tests.checks import LOCAL, assert_near

COUNT = 100_000


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def stretched() -> tuple[np.ndarray, np.ndarray]:
    """Areas over three decades."""
    vertices, faces = meshes.disk(size=7)
    return vertices * [1, 1, 1] * np.exp(2 * vertices[:, :1]), faces


@pytest.fixture(scope="module")
def samples() -> dp.SurfaceSamples:
    return dp.sample_surface(dp.Mesh(*stretched()), COUNT, generator=generator())


def test_faces_are_drawn_by_area(samples):
    areas = references.areas(*stretched())
    assert areas.max() > 20 * areas.min()
    observed = np.bincount(samples.faces, minlength=len(areas))
    assert scipy.stats.chisquare(observed, COUNT * areas / areas.sum()).pvalue > 0.01


def test_points_are_uniform_on_each_face(samples):
    """Cut each triangle into 16 congruent ones: all are hit alike."""
    a, b, _ = (samples.barycentric.numpy().T * 4).clip(0, 4 - 1e-9)
    i, j = a.astype(int), b.astype(int)
    upside_down = (a % 1) + (b % 1) > 1
    _, observed = np.unique(np.stack([i, j, upside_down]), axis=1, return_counts=True)
    assert len(observed) == 16
    assert scipy.stats.chisquare(observed).pvalue > 0.01


def test_barycentric_moments(samples):
    """Uniform on a simplex (Dirichlet): mean 1/3, E bᵢ² = 1/6, E bᵢbⱼ = 1/12."""
    b = samples.barycentric.numpy()
    expected = (np.ones((3, 3)) + np.eye(3)) / 12
    assert np.abs(b.mean(0) - 1 / 3).max() < 4 * np.sqrt(1 / 18 / COUNT)
    assert np.abs(b.T @ b / COUNT - expected).max() < 4 / np.sqrt(15 * COUNT)


def test_barycentric_coordinates_are_convex(samples):
    assert (samples.barycentric >= 0).all()
    assert_near(samples.barycentric.sum(1), np.ones(COUNT), LOCAL)


def test_successive_samples_are_independent(samples):
    """The face says nothing about the place in it, nor about the next face."""
    b, f = samples.barycentric.numpy(), samples.faces.numpy()
    correlations = np.corrcoef(np.stack([f[:-1], f[1:], b[:-1, 0], b[:-1, 1]]).astype(float))
    independent = correlations[[0, 0, 0], [1, 2, 3]]
    assert np.abs(independent).max() < 4 / np.sqrt(COUNT)


def test_linear_functions_are_interpolated_exactly(samples):
    mesh = dp.Mesh(*stretched())
    points = samples.interpolate(mesh, mesh.vertices)
    M = torch.from_numpy(checks.normal((3, 4)))
    assert_near(samples.interpolate(mesh, mesh.vertices @ M + 2), points @ M + 2, LOCAL)
    corners = stretched()[0][stretched()[1]][samples.faces]
    normals = mesh.normals[samples.faces].numpy()
    offsets = np.einsum("sd,sd->s", points.numpy() - corners[:, 0], normals)
    assert np.abs(offsets).max() < 1e-13 * np.abs(corners).max()


def test_interpolation_keeps_batches_and_dtypes_and_is_differentiable():
    mesh = dp.Mesh(*meshes.disk())
    samples = dp.sample_surface(mesh, 5, generator=generator())
    values = torch.from_numpy(checks.normal((2, 3, 25, 4)))
    expected = torch.stack([torch.stack([samples.interpolate(mesh, v) for v in w]) for w in values])
    assert_near(samples.interpolate(mesh, values), expected, LOCAL)
    assert samples.interpolate(mesh, values.float()).dtype == torch.float32
    flat = values[0, 0].requires_grad_()
    samples.interpolate(mesh, flat).sum().backward()
    weights = np.zeros(25)
    np.add.at(weights, mesh.faces[samples.faces].numpy(), samples.barycentric.numpy())
    assert_near(flat.grad, np.repeat(weights[:, None], 4, axis=1), LOCAL)


def test_reproducible():
    mesh = dp.Mesh(*meshes.torus())
    first, again, other = (dp.sample_surface(mesh, 9, generator=generator(s)) for s in (1, 1, 2))
    assert torch.equal(first.faces, again.faces)
    assert torch.equal(first.barycentric, again.barycentric)
    assert not torch.equal(first.barycentric, other.barycentric)
    torch.manual_seed(1)
    assert torch.equal(dp.sample_surface(mesh, 9).barycentric, first.barycentric)


def test_single_precision_mesh():
    samples = dp.sample_surface(dp.Mesh(*meshes.torus()).to(torch.float32), 1000)
    assert samples.barycentric.dtype == torch.float32
    assert samples.faces.dtype == torch.int64
    assert_near(samples.barycentric.sum(1), np.ones(1000, np.float32), 1e-6)


def test_the_largest_random_number_is_on_the_last_face(monkeypatch):
    monkeypatch.setattr(torch.Tensor, "uniform_", lambda x, **_: x.fill_(1 - 2.0**-53))
    vertices, faces = meshes.disk()
    for scale in np.geomspace(1e-3, 1e3, 50):
        mesh = dp.Mesh(scale * vertices, faces)
        assert dp.sample_surface(mesh, 1).faces.item() == mesh.n_faces - 1


def test_no_samples_and_wrong_input(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    none = dp.sample_surface(mesh, 0)
    assert none.faces.shape == (0,)
    assert none.barycentric.shape == (0, 3)
    with pytest.raises(ValueError, match="n_samples must be at least 0, got -1"):
        dp.sample_surface(mesh, -1)
    message = "interpolate: expected values of shape (…, n=25, c), got (24, 3)"
    with pytest.raises(ValueError, match=re.escape(message)):
        none.interpolate(mesh, torch.zeros(24, 3, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"^interpolate: expected a diffpoisson\.Mesh"):
        none.interpolate(None, mesh.vertices)
    with pytest.raises(TypeError, match=r"^interpolate: values must be a torch tensor"):
        none.interpolate(mesh, mesh.vertices.numpy())
