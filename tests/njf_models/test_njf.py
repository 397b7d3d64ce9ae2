"""The assembled network: identity at the start, the paper's invariances, batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField, Shape
from njf_models.features import face_features, point_features
from njf_models.losses import LOSSES
from tests import references
from tests.njf_models.shapes import bumpy_disk, ellipsoid, prepared, randomised, with_frames_rotated


def model_and_code(output_dim=3, centering="area", **options):
    model = NeuralJacobianField(
        6,
        6,
        code_size=16,
        output_dim=output_dim,
        centering=centering,
        encodes_target=True,
        **options,
    )
    randomised(model)
    clouds = torch.randn(2, 50, 6, dtype=torch.float64)
    return model, model.encode(clouds, clouds + 1)


def test_untrained_network_is_the_identity_and_its_projection():
    mesh = ellipsoid()
    shape = prepared(mesh)
    centred = mesh.vertices - (mesh.vertex_areas[:, None] * mesh.vertices).sum(0) / mesh.areas.sum()
    for output_dim in (3, 2):
        for rounds in (1, 3):
            model = NeuralJacobianField(
                6, 6, code_size=16, output_dim=output_dim, rounds=rounds
            ).double()
            code = model.encode(torch.randn(1, 50, 6, dtype=torch.float64))
            emitted = model(shape, code).vertices[0]
            assert_close(emitted, centred[:, :output_dim], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("loss", "output_dim", "rounds", "local_step"),
    [
        ("paper", 2, 1, False),
        ("paper", 3, 1, False),
        ("paper", 2, 3, False),
        ("official", 2, 1, False),
        ("official", 3, 1, False),
        ("turned", 2, 3, True),
    ],
)
@given(seed=st.integers(0, 10**6))
def test_nothing_depends_on_the_frames(loss, output_dim, rounds, local_step, seed):
    """The paper's appendix: predictions, loss and gradients are invariant to the tangent bases."""
    mesh = bumpy_disk(seed)
    model, code = model_and_code(output_dim, rounds=rounds, local_step=local_step)
    code = code.detach()
    target = torch.from_numpy(
        np.random.default_rng(seed).standard_normal((mesh.n_vertices, output_dim))
    )
    results = []
    for framed in (mesh, with_frames_rotated(mesh, seed)):
        shape = prepared(framed)
        prediction = model(shape, code)
        total = LOSSES[loss](shape, prediction, target).total
        parameters = [*model.field.parameters(), *model.corrections.parameters()]
        gradients = torch.autograd.grad(total, parameters)
        results.append((prediction, total, gradients))
    (plain, loss_plain, grad_plain), (turned, loss_turned, grad_turned) = results
    assert (plain.jacobians - turned.jacobians).abs().max() > 1e-3  # frames do differ
    assert_close(turned.matrices, plain.matrices, rtol=1e-10, atol=1e-10)
    assert_close(turned.vertices, plain.vertices, rtol=1e-9, atol=1e-9)
    assert_close(loss_turned, loss_plain, rtol=1e-9, atol=1e-9)
    for a, b in zip(grad_turned, grad_plain, strict=True):
        assert_close(a, b, rtol=1e-8, atol=1e-9 * max(1, float(b.abs().max())))


def test_emitted_map_is_the_best_fit_to_the_predicted_matrices():
    """Against dense least squares on the unrestricted matrices, gradients made independently."""
    mesh = ellipsoid()
    model, code = model_and_code()
    prediction = model(prepared(mesh), code)
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    for P, phi in zip(prediction.matrices, prediction.vertices, strict=True):
        expected = references.poisson(V, F, P.detach().numpy())
        assert_close(phi.detach().numpy(), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("local_step", [False, True])
def test_rounds_read_the_map_back_and_correct_it(shared, local_step):
    """Written out on world coordinates, with dense algebra and one concatenated input per face."""
    mesh = bumpy_disk(2)
    model, code = model_and_code(2, rounds=3, shared_rounds=shared, local_step=local_step)
    assert len(model.corrections) == (1 if shared else 2)
    shape = prepared(mesh)
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    projection = torch.eye(3) - mesh.normals[:, :, None] * mesh.normals[:, None, :]
    nets = [model.field, model.corrections[0], model.corrections[-1]]
    features = shape.features
    P = torch.eye(2, 3)
    iterates = model.iterates(shape, code[0])
    assert len(iterates) == 3
    for net, iterate in zip(nets, iterates, strict=True):
        rows = torch.cat([code[0].expand(mesh.n_faces, -1), features], dim=1)
        P = P + net.layers(rows).unflatten(1, (2, 3))
        assert_close(iterate.matrices, P.double(), rtol=1e-8, atol=1e-8)
        phi = references.poisson(V, F, P.detach().numpy())
        assert_close(iterate.vertices.detach().numpy(), phi, rtol=1e-8, atol=1e-8)
        J = torch.from_numpy(references.jacobians(V, F, phi))  # on ambient vectors
        missed = P @ projection - J
        features = torch.cat([shape.features, J.flatten(1), missed.flatten(1)], dim=1)
        P = J
        if local_step:
            # The closest 2×3 matrix with orthonormal rows that keeps the face's orientation.
            U, _, Vt = torch.linalg.svd(J, full_matrices=False)
            Q = U @ Vt
            turns_over = (torch.linalg.cross(Q[:, 0], Q[:, 1]) * mesh.normals).sum(-1) < 0
            U[turns_over, :, 1] *= -1
            P = U @ Vt
            features = torch.cat([features, P.flatten(1)], dim=1)


@pytest.mark.parametrize("rounds", [1, 3])
def test_under_autocast_only_the_networks_are_rounded(rounds):
    torch.manual_seed(0)
    shape = Shape.prepare(bumpy_disk(0))
    model = NeuralJacobianField(6, 6, code_size=16, output_dim=2, rounds=rounds)
    randomised(model)
    model.float()
    code = model.encode(torch.randn(1, 50, 6))
    exact = model(shape, code)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        prediction = model(shape, code)
    assert all(field.dtype == torch.float32 for field in prediction)
    assert torch.equal(prediction.vertices, shape.solver(prediction.jacobians))
    error = (prediction.vertices - exact.vertices).abs().max() / exact.vertices.abs().max()
    assert 0 < error < 0.1


def test_the_local_step_is_for_maps_to_the_plane():
    with pytest.raises(ValueError, match="maps to the plane, got output_dim=3"):
        NeuralJacobianField(6, 6, rounds=2, local_step=True)


def test_no_rounds_raise():
    with pytest.raises(ValueError, match="rounds must be at least 1"):
        NeuralJacobianField(6, 6, rounds=0)


@pytest.mark.parametrize(("centering", "rounds"), [("area", 1), ("vertex", 1), ("area", 2)])
def test_packed_shapes_are_each_alone(centering, rounds):
    shapes = [prepared(mesh) for mesh in (bumpy_disk(0), ellipsoid(), bumpy_disk(1, 4))]
    union = Shape.concatenate(shapes)
    model, code = model_and_code(2, centering, rounds=rounds)
    codes = torch.randn(3, code.shape[1], dtype=torch.float64)
    packed = model(union, codes)
    for i, shape in enumerate(shapes):
        alone = model(shape, codes[i])
        assert_close(union.mesh.split_faces(packed.jacobians)[i], alone.jacobians)
        assert_close(
            union.mesh.split_vertices(packed.vertices)[i], alone.vertices, rtol=1e-10, atol=1e-10
        )


@pytest.mark.parametrize("rounds", [1, 2])
def test_codes_of_one_shape_are_a_batch(rounds):
    shape = prepared(ellipsoid())
    model, code = model_and_code(rounds=rounds)
    batch = model(shape, code)
    assert batch.vertices.shape == (2, shape.mesh.n_vertices, 3)
    for i in range(2):
        assert_close(batch.vertices[i], model(shape, code[i]).vertices, rtol=1e-10, atol=1e-10)


def test_vertex_centering_and_area_centering():
    shape = prepared(ellipsoid())
    for centering, weights in (
        ("vertex", torch.full((shape.mesh.n_vertices,), 1 / shape.mesh.n_vertices)),
        ("area", shape.mesh.vertex_areas / shape.mesh.areas.sum()),
    ):
        model, code = model_and_code(3, centering)
        mean = (weights[:, None] * model(shape, code).vertices).sum(-2)
        assert mean.abs().max() < 1e-12


def test_triangulation_does_not_enter_the_prediction_of_a_face():
    """The matrix of a face depends on its own features and the code alone."""
    mesh = bumpy_disk()
    keep = torch.arange(0, mesh.n_faces, 2)
    sub = dp.Mesh.cleaned(mesh.vertices, mesh.faces[keep]).mesh
    model, code = model_and_code()
    shape = prepared(mesh)
    part = prepared(sub).with_features(shape.features[keep])
    assert_close(model(part, code).matrices, model(shape, code).matrices[:, keep])


def test_face_features_against_their_definition():
    mesh = ellipsoid()
    wks = torch.randn(mesh.n_vertices, 5)
    features = face_features(mesh, wks).numpy()
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    corners = V[F]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    expected = np.concatenate(
        [
            corners.mean(1) - (V.min(0) + V.max(0)) / 2,
            normal / np.linalg.norm(normal, axis=1, keepdims=True),
            wks.double().numpy()[F].mean(1),
        ],
        axis=1,
    )
    assert_close(features, expected, rtol=1e-6, atol=1e-6)  # wks was float32


def test_point_features_interpolate_positions_normals_and_signature():
    mesh = ellipsoid()
    wks = torch.randn(mesh.n_vertices, 5)
    samples = dp.sample_surface(mesh, 20, generator=torch.Generator().manual_seed(1))
    features = point_features(mesh, samples, wks)
    for face, weights, row in zip(*samples, features, strict=True):
        corner = mesh.faces[face]
        values = torch.cat([mesh.vertices, mesh.vertex_normals, wks.double()], dim=1)[corner]
        expected = weights @ values
        centre = (mesh.vertices.min(0).values + mesh.vertices.max(0).values) / 2
        expected[:3] -= centre
        assert_close(row, expected, rtol=1e-10, atol=1e-10)


def test_wrong_codes_raise(unchecked):
    shape = Shape.concatenate([prepared(bumpy_disk()), prepared(ellipsoid())])
    model, code = model_and_code()
    with pytest.raises(ValueError, match=r"2 concatenated shapes need codes of shape \(2, z\)"):
        model(shape, torch.cat([code, code]))
    with pytest.raises(ValueError, match="encodes 2 point cloud"):
        model.encode(torch.randn(1, 5, 6))
    cloud = torch.randn(1, 5, 6, dtype=torch.float64)
    with pytest.raises(ValueError, match="expects a code of size 32, got 35"):
        model.encode(cloud, cloud, torch.randn(1, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="centering"):
        NeuralJacobianField(6, 6, centering="middle")


def test_parameters_replace_or_extend_the_encoder():
    shape = prepared(ellipsoid())
    pose = torch.randn(4, 7, dtype=torch.float64)
    for point_size, clouds in ((0, ()), (6, (torch.randn(4, 9, 6, dtype=torch.float64),))):
        model = NeuralJacobianField(6, point_size, code_size=16, parameters=7)
        randomised(model)
        out = model(shape, model.encode(*clouds, parameters=pose)).vertices
        assert out.shape == (4, shape.mesh.n_vertices, 3)
        assert (out[0] - out[1]).abs().max() > 1e-3
