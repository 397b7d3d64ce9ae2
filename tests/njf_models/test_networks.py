"""The fields and PointNet against the plain modules or sums that they stand for."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from njf_models import NeuralJacobianField, Shape
from njf_models.field import BilinearField, FieldMLP
from njf_models.pointnet import PointNet
from tests.njf_models.shapes import bumpy_disk, ellipsoid, prepared, randomised


def plain_field(model: FieldMLP) -> nn.Sequential:
    """The same network as one `nn.Sequential` with `nn.GroupNorm`, on (code | features)."""
    first = model.layers[0]
    layers: list[nn.Module] = []
    sizes = (first.in_features, 128, 128, 128, 128)
    for fan_in in sizes[:-1]:
        layers += [nn.Linear(fan_in, 128), nn.GroupNorm(4, 128), nn.ReLU()]
    plain = nn.Sequential(*layers, nn.Linear(128, model.layers[-1].out_features)).double()
    plain.load_state_dict(model.layers.state_dict())  # strict: same names and shapes
    return plain


def test_field_has_the_gradients_of_the_plain_network():
    model = randomised(FieldMLP(20, 6))
    plain = plain_field(model)
    x = torch.randn(50, 26, dtype=torch.float64, requires_grad=True)
    y = torch.cat([model(f, c) for f, c in zip(x[:, None, 20:], x[:, :20], strict=True)])
    expected = plain(x)
    w = torch.randn_like(expected)
    for ours, theirs in zip(
        torch.autograd.grad((y * w).sum(), [x, *model.parameters()]),
        torch.autograd.grad((expected * w).sum(), [x, *plain.parameters()]),
        strict=True,
    ):
        assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def test_field_in_float32_is_as_exact_as_the_plain_network():
    """Also where the weights of a group share a large offset, which its norm takes out again."""
    model = randomised(FieldMLP(20, 6, width=64))
    with torch.no_grad():
        model.layers[3].weight[:16] += 100.0
        model.layers[6].bias[16:32] -= 100.0
    features, code = torch.randn(200, 6), torch.randn(1, 20)
    rows = torch.cat([code.expand(200, 20), features], dim=1)
    exact = model.layers(rows.double())
    model.float()
    error = (model(features, code)[0] - exact).abs().max()
    assert error < 2 * (model.layers(rows) - exact).abs().max() < 1e-2


def test_split_first_layer_is_the_plain_network_on_code_and_features():
    model = randomised(FieldMLP(20, 6))
    features = torch.randn(40, 6, dtype=torch.float64)
    codes = torch.randn(3, 20, dtype=torch.float64)
    expected = torch.stack(
        [plain_field(model)(torch.cat([c.expand(40, 20), features], dim=1)) for c in codes]
    )
    assert_close(model(features, codes), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("m", [30, 700, 3000])
@pytest.mark.parametrize("batch", [(), (0,), (7,), (2, 3)])
@pytest.mark.parametrize("own_features", [False, True])
def test_codes_of_one_shape_are_applied_one_by_one(m, batch, own_features):
    """As many as fit at a time; on the shape's features, or on each its own."""
    model = randomised(FieldMLP(20, 6, width=32))
    codes = torch.randn(*batch, 20, dtype=torch.float64)
    features = torch.randn(*(batch if own_features else ()), m, 6, dtype=torch.float64)
    out = model(features, codes)
    assert out.shape == (*batch, m, 9)
    each = features.expand(*batch, m, 6).reshape(-1, m, 6)
    for got, code, seen in zip(out.reshape(-1, m, 9), codes.reshape(-1, 20), each, strict=True):
        expected = model.layers(torch.cat([code.expand(m, 20), seen], dim=1))
        assert_close(got, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("m", [30, 2048, 5000])
def test_packed_faces_get_the_code_of_their_part(m):
    model = randomised(FieldMLP(20, 6))
    features = torch.randn(m, 6, dtype=torch.float64)
    codes = torch.randn(3, 20, dtype=torch.float64)
    part = torch.randint(3, (m,))
    expected = plain_field(model)(torch.cat([codes[part], features], dim=1))
    assert_close(model(features, codes, part), expected, rtol=1e-11, atol=1e-11)


def test_last_layer_starts_at_zero():
    model = FieldMLP(4, 6)
    assert model(torch.randn(9, 6), torch.randn(2, 4)).abs().max() == 0


def test_pointnet_is_blind_to_the_order_of_points_but_not_to_their_places():
    net = randomised(PointNet(6, code_size=16))
    points = torch.randn(2, 100, 6, dtype=torch.float64)
    code = net(points)
    assert code.shape == (2, 16)
    assert_close(net(points[:, torch.randperm(100)]), code, rtol=1e-11, atol=1e-11)
    assert (net(points + 0.1) - code).abs().max() > 1e-3


def test_pointnet_norms_act_over_the_channels_of_a_group_and_all_points():
    """The network written out, mean and variance over (channels of the group) × (points)."""
    net = randomised(PointNet(6, code_size=16))
    points = torch.randn(1, 30, 6, dtype=torch.float64)
    x = points[0].T
    for i, groups in enumerate((4, 4, 8, 8), start=1):
        conv, norm = (getattr(net.layers, f"{kind}{i}") for kind in ("conv", "norm"))
        x = conv.weight[..., 0] @ x + conv.bias[:, None]
        blocks = x.reshape(groups, -1)
        mean, variance = blocks.mean(1, keepdim=True), blocks.var(1, keepdim=True, correction=0)
        x = ((blocks - mean) / (variance + 1e-5).sqrt()).reshape(x.shape)
        x = norm.weight[:, None] * x + norm.bias[:, None]
        x = x.relu() if i < 4 else x
    assert_close(net(points)[0], x.max(dim=1).values, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("code_size", [8, 1000])
def test_pointnet_code_size(code_size):
    assert PointNet(6, code_size)(torch.randn(1, 10, 6)).shape == (1, code_size)


def bilinear(**options):
    return randomised(BilinearField(5, 6, width=8, rank=7, **options))


def test_a_bilinear_field_is_a_sum_of_products():
    """By hand, for codes of any batch; and for the parts of a packed batch."""
    field, features = bilinear(), torch.randn(11, 6, dtype=torch.float64)
    code = torch.randn(2, 3, 5, dtype=torch.float64)
    functions = field.of_face(features).view(11, 7, 9)
    expected = torch.zeros(2, 3, 11, 9, dtype=torch.float64)
    for k in range(7):
        h = field.of_code(code.view(6, 5))[:, k].view(2, 3, 1, 1)
        expected = expected + h * functions[:, k]
    assert_close(field(features, code), expected, rtol=1e-9, atol=1e-9)
    assert_close(field(features, code[0, 0]), expected[0, 0], rtol=1e-9, atol=1e-9)
    part = torch.arange(11) % 3
    packed = field(features, code[0], part)
    assert_close(packed, expected[0, part, torch.arange(11)], rtol=1e-9, atol=1e-9)


def test_a_bilinear_field_starts_at_the_identity_and_learns():
    mesh = ellipsoid()
    shape = prepared(mesh)
    model = NeuralJacobianField(6, 0, parameters=5, rank=7).double()
    code = torch.randn(3, 5, dtype=torch.float64)
    prediction = model(shape, code)
    assert_close(prediction.jacobians, mesh.frames.expand(3, -1, -1, -1), rtol=0, atol=1e-12)
    prediction.vertices.square().sum().backward()
    assert model.field.of_face[-1].weight.grad.abs().max() > 0
    union = Shape.concatenate([shape, prepared(bumpy_disk())])
    packed = randomised(model)(union, code[:2])
    alone = model(shape, code[0]).vertices
    assert_close(union.mesh.split_vertices(packed.vertices)[0], alone, rtol=1e-9, atol=1e-9)


def test_a_network_on_one_shape():
    """The same maps; the network itself stays what it is, and other shapes are refused."""
    shape, other = prepared(ellipsoid()), prepared(ellipsoid(1))
    model = randomised(NeuralJacobianField(6, 0, parameters=5, rank=7))
    fixed, code = model.on(shape), torch.randn(2, 5, dtype=torch.float64)
    assert_close(fixed(shape, code).vertices, model(shape, code).vertices, rtol=1e-12, atol=1e-12)
    assert isinstance(model.field, BilinearField)
    model(other, code)
    with pytest.raises(ValueError, match="the faces of another shape"):
        fixed(other, code)
    with pytest.raises(ValueError, match="rank > 0"):
        NeuralJacobianField(6, 0, parameters=5).on(shape)
