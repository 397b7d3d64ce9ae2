"""DiffusionNet against its published formulas, typed in with dense algebra and complex numbers."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import scipy.linalg
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import Shape
from njf_models.baselines.diffusion import DiffusionMap
from njf_models.diffusion_net import DiffusionBlock, DiffusionNet
from njf_models.diffusion_njf import DiffusionEncodedNJF
from njf_models.models import MODELS
from njf_models.spectrum import Spectrum
from njf_models.training import NJFTraining
from tests import references
from tests.njf_models.shapes import bumpy_disk, ellipsoid, randomised, with_frames_rotated

K = 12


def prepared(mesh: dp.Mesh, dtype: torch.dtype = torch.float64) -> Shape:
    return Shape.prepare(mesh, dtype=dtype, n_eigenpairs=K)


def lively_block() -> DiffusionBlock:
    """Random, but for its times, in which not all of the gradients may die out."""
    block = randomised(DiffusionBlock(5))
    with torch.no_grad():
        block.log_times -= 6
    return block


def unit(mesh: dp.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices at unit area, and faces."""
    faces = mesh.faces.numpy()
    vertices = mesh.vertices.numpy()
    return vertices / np.sqrt(references.areas(vertices, faces).sum()), faces


def test_heat_spreads_as_the_matrix_exponential_of_all_eigenpairs_says():
    """exp(-t M⁻¹L) u, by SciPy, where the spectrum has all eigenpairs."""
    mesh = bumpy_disk()
    vertices, faces = unit(mesh)
    spectrum = Spectrum.of(mesh, mesh.n_vertices)
    M = references.vertex_areas(vertices, faces)
    L = -igl.cotmatrix(vertices, faces).toarray()
    u = torch.randn(mesh.n_vertices, 2, dtype=torch.float64)
    times = torch.tensor([1e-3, 0.05], dtype=torch.float64)
    diffused = spectrum.diffused(u, times)
    for channel, t in enumerate(times.tolist()):
        expected = scipy.linalg.expm(-t * L / M[:, None]) @ u[:, channel].numpy()
        assert_close(diffused[:, channel].numpy(), expected, rtol=1e-4, atol=1e-5)


def test_the_unit_of_length_drops_out():
    mesh = bumpy_disk()
    large = dp.Mesh(1000 * mesh.vertices, mesh.faces)
    a, b = (Spectrum.of(m, K) for m in (mesh, large))
    assert_close(a.values, b.values, rtol=1e-5, atol=1e-4)
    u = torch.randn(mesh.n_vertices, 1)
    assert_close(a.diffused(u, torch.tensor([0.1])), b.diffused(u, torch.tensor([0.1])))
    assert_close(a.gradients(u), b.gradients(u), rtol=1e-4, atol=1e-4)


def test_gradients_of_linear_functions_are_their_tangent_parts():
    """On a flat piece exactly; the mean over faces of the projected constant elsewhere."""
    mesh = bumpy_disk()
    vertices, faces = unit(mesh)
    g = np.array([0.3, -1.0, 2.0])
    u = torch.from_numpy(vertices @ g)[:, None]
    normals = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    areas = np.linalg.norm(normals, axis=1)
    normals /= areas[:, None]
    projected = g - (normals @ g)[:, None] * normals
    expected = np.zeros_like(vertices)
    total = np.zeros(len(vertices))
    for k in range(3):
        np.add.at(expected, faces[:, k], areas[:, None] * projected)
        np.add.at(total, faces[:, k], areas)
    actual = Spectrum.of(mesh, K).gradients(u)[..., 0].numpy().T
    assert_close(actual, expected / total[:, None], rtol=1e-9, atol=1e-9)


def test_block_is_the_published_formula():
    """With tangents as complex numbers, in any basis of the planes across the vertex normals."""
    mesh = ellipsoid()
    shape = prepared(mesh)
    block = lively_block()
    u = torch.randn(mesh.n_vertices, 5, dtype=torch.float64)
    spectrum = shape.spectra[0]
    spread = spectrum.diffused(u, block.log_times.exp())
    gradients = spectrum.gradients(spread).detach().numpy().swapaxes(0, 1)  # (n, 3, w)
    normals = spectrum.normals.double().numpy()
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    x = np.cross(normals, np.random.default_rng(0).normal(size=3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(normals, x)
    # What is left along the normal, where the faces around a vertex are not in one plane.
    along = np.einsum("nd,ndw->nw", normals, gradients)
    z = np.einsum("nd,ndw->nw", x, gradients) + 1j * np.einsum("nd,ndw->nw", y, gradients)
    A = block.real.weight.detach().numpy() + 1j * block.imaginary.weight.detach().numpy()
    products = (z.conj() * (z @ A.T)).real + along * (along @ A.real.T)
    assert np.abs(products).max() > 0.1
    features = torch.cat([u, spread, torch.from_numpy(np.tanh(products))], dim=1)
    assert_close(block(shape, u), u + block.mlp(features), rtol=1e-9, atol=1e-9)


def test_frames_of_the_faces_do_not_matter():
    mesh = bumpy_disk()
    net = randomised(DiffusionNet(6, 3, width=8, n_blocks=2))
    a, b = (net(prepared(m)) for m in (mesh, with_frames_rotated(mesh)))
    assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_a_block_knows_no_pose_but_orientation():
    """The imaginary part of A turns with the faces' orientation; a mirror keeps their order."""
    mesh, block = bumpy_disk(), lively_block()
    u = torch.randn(mesh.n_vertices, 5, dtype=torch.float64)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    turn *= torch.linalg.det(turn)
    expected = block(prepared(mesh), u)
    for matrix in (turn, -turn):
        moved = dp.Mesh(mesh.vertices @ matrix.T, mesh.faces)
        assert_close(block(prepared(moved), u), expected, rtol=1e-4, atol=1e-4)
    inverted = dp.Mesh(mesh.vertices, mesh.faces.flip(1))
    assert not torch.allclose(block(prepared(inverted), u), expected, atol=1e-2)


@pytest.mark.parametrize("kind", [DiffusionMap, DiffusionEncodedNJF])
def test_packed_shapes_are_each_alone(kind):
    shapes = [prepared(mesh) for mesh in (bumpy_disk(0), bumpy_disk(1, 4), bumpy_disk(2, 7))]
    model = randomised(kind(6, output_dim=2))
    union = Shape.concatenate(shapes)
    code = model.encode(torch.zeros(3, 4, 6, dtype=torch.float64))
    packed = union.mesh.split_vertices(model(union, code).vertices)
    for shape, phi in zip(shapes, packed, strict=True):
        assert_close(model(shape, code[:1]).vertices[0], phi, rtol=1e-8, atol=1e-8)


def test_the_map_is_centred_and_untrained_nearly_the_projection():
    shape = prepared(bumpy_disk())
    model = DiffusionMap(6).double()
    with torch.no_grad():
        model.net.last.weight.zero_()
        model.net.last.bias.zero_()
    prediction = model(shape, model.encode(torch.zeros(1, 4, 6, dtype=torch.float64)))
    flat = shape.mesh.vertices[:, :2]
    weights = shape.mesh.vertex_areas / shape.mesh.areas.sum()
    assert_close(prediction.vertices[0], flat - weights @ flat, rtol=1e-9, atol=1e-9)
    assert prediction.jacobians.shape == (1, shape.mesh.n_faces, 2, 2)


def test_every_parameter_learns():
    shape = prepared(bumpy_disk(), torch.float32)
    for kind in ("diffusion", "diffusion+njf"):
        model = MODELS[kind](6, output_dim=2)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        model(shape, model.encode(torch.zeros(1, 4, 6))).vertices.square().sum().backward()
        for name, parameter in model.named_parameters():
            assert parameter.grad is not None, name
            assert float(parameter.grad.abs().max()) > 0, name


def test_what_it_refuses():
    shape = Shape.prepare(bumpy_disk())
    model = DiffusionMap(6)
    with pytest.raises(ValueError, match="1 parts has 0 spectra; prepare it with n_eigenpairs"):
        model(shape, torch.zeros(1, 0))
    with pytest.raises(ValueError, match="maps of the source alone"):
        model.encode(torch.zeros(1, 4, 6), parameters=torch.zeros(1, 3))
    with pytest.raises(NotImplementedError):
        DiffusionMap.__mro__[1]().iterates(shape, torch.zeros(1, 0))
    assert NJFTraining({"features": 6}, kind="diffusion").model.output_dim == 2
