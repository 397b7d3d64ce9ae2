"""The displacement field: one vertex at a time, trained and emitted as a Jacobian field is."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField, Shape
from njf_models.baselines.displacement import DisplacementField
from njf_models.features import vertex_features
from njf_models.losses import paper_loss
from tests.njf_models.shapes import bumpy_disk, ellipsoid, prepared, randomised


def model_of(output_dim=3, **options):
    return randomised(
        DisplacementField(6, 0, parameters=5, output_dim=output_dim, width=32, **options)
    )


def test_untrained_it_is_the_identity_as_the_jacobian_field_is():
    shape = prepared(ellipsoid())
    code = torch.randn(2, 5, dtype=torch.float64)
    maps = [
        kind(6, 0, parameters=5).double()(shape, code)
        for kind in (DisplacementField, NeuralJacobianField)
    ]
    for name in ("vertices", "jacobians"):
        assert_close(*(getattr(phi, name) for phi in maps), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("output_dim", [2, 3])
def test_a_vertex_moves_by_the_plain_network_of_its_features(output_dim):
    mesh = ellipsoid()
    shape = prepared(mesh)
    model = model_of(output_dim, centering="vertex")
    code = torch.randn(3, 5, dtype=torch.float64)
    prediction = model(shape, code)
    features = vertex_features(mesh)
    for phi, J, c in zip(prediction.vertices, prediction.jacobians, code, strict=True):
        rows = torch.cat([c.expand(mesh.n_vertices, 5), features], dim=1)
        expected = mesh.vertices[:, :output_dim] + model.field.layers(rows)
        assert_close(phi, expected - expected.mean(0), rtol=1e-9, atol=1e-9)
        assert_close(J, dp.jacobians(mesh, expected), rtol=1e-9, atol=1e-9)
    extended = dp.extend(prediction.jacobians, mesh.frames)
    assert_close(prediction.matrices, extended, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("centering", ["area", "vertex"])
def test_packed_shapes_are_each_alone(centering):
    shapes = [prepared(mesh) for mesh in (bumpy_disk(0), ellipsoid(), bumpy_disk(1, 4))]
    union = Shape.concatenate(shapes)
    model = model_of(centering=centering)
    codes = torch.randn(3, 5, dtype=torch.float64)
    packed = model(union, codes)
    for i, shape in enumerate(shapes):
        alone = model(shape, codes[i]).vertices
        assert_close(union.mesh.split_vertices(packed.vertices)[i], alone, rtol=1e-9, atol=1e-9)


def test_the_position_of_the_target_does_not_matter_to_the_loss():
    """For which the map is centred as targets are."""
    shape = prepared(ellipsoid())
    with torch.no_grad():
        prediction = model_of()(shape, torch.randn(2, 5, dtype=torch.float64))
    target = torch.randn(2, shape.mesh.n_vertices, 3, dtype=torch.float64)
    there, here = (paper_loss(shape, prediction, target + shift).total for shift in (7.0, 0.0))
    assert_close(there, here, rtol=1e-9, atol=1e-9)
    exact = paper_loss(shape, prediction, prediction.vertices + 3)
    assert float(exact.total) < 1e-15
