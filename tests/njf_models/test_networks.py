"""The fields and PointNet against the plain modules or sums that they stand for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import nn
from torch.testing import assert_close

from njf_models import NeuralJacobianField, Shape
from njf_models.field import FieldMLP, PartField
from njf_models.pointnet import PointNet
from njf_models.products import MatrixProducts
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


def in_parts(**options):
    field = PartField(12, 5, 6, parts=8, width=8, **options)
    return randomised(field)


def test_a_part_field_is_a_sum_of_matrices_weighted_by_face_and_source():
    """By hand, for one source and codes of any batch; for several; and for a packed batch."""
    field, features = in_parts(), torch.randn(11, 6, dtype=torch.float64)
    sources, told = torch.randn(2, 5).double(), torch.randn(2, 3, 7).double()
    code = torch.cat([sources[:, None].expand(-1, 3, -1), told], dim=-1)
    expected = torch.zeros(2, 3, 11, 9, dtype=torch.float64)
    for i in range(2):
        w = field.of_face(features, sources[i])
        shares = (3 * w[:, :2]).exp()
        w = torch.cat([shares / shares.sum(1, keepdim=True), w[:, 2:]], dim=1)
        for t in range(3):
            M = field.of_code(code[i, t][None]).view(8, 9)
            for k in range(8):
                expected[i, t] += w[:, k, None] * M[k]
    near = {"rtol": 1e-9, "atol": 1e-9}
    assert_close(field(features, code[0]), expected[0], **near)
    assert_close(field(features, code[1, 2]), expected[1, 2], **near)
    assert_close(field(features, code[1][None]), expected[1][None], **near)
    assert_close(field(features.expand(2, 1, -1, -1), code), expected, **near)
    part = torch.arange(11) % 2
    packed = field(features, code[:, 1], part)
    assert_close(packed, expected[part, 1, torch.arange(11)], **near)
    with pytest.raises(ValueError, match="codes of different sources"):
        field(features, code[:, 0])
    with pytest.raises(ValueError, match="a multiple of 4, got 6"):
        PartField(12, 5, 6, parts=6)


def test_a_part_field_starts_at_the_identity_and_learns():
    mesh = ellipsoid()
    shape = prepared(mesh)
    model = NeuralJacobianField(6, 0, parameters=5, parts=8).double()
    code = torch.randn(3, 5, dtype=torch.float64)
    prediction = model(shape, code)
    assert_close(prediction.jacobians, mesh.frames.expand(3, -1, -1, -1), rtol=0, atol=1e-12)
    prediction.vertices.square().sum().backward()
    assert model.field.of_code[-1].weight.grad.abs().max() > 0
    union = Shape.concatenate([shape, prepared(bumpy_disk())])
    packed = randomised(model)(union, code[:2])
    alone = model(shape, code[0]).vertices
    assert_close(union.mesh.split_vertices(packed.vertices)[0], alone, rtol=1e-9, atol=1e-9)


def test_a_code_has_the_matrices_of_its_rotations_and_its_shapes_scaled():
    model = NeuralJacobianField(6, 6, code_size=8, parameters=6, rotations=True, code_scale=0.1)
    points, vectors = torch.randn(1, 20, 6), torch.randn(4, 2, 3)
    vectors[0] = 0
    code = model.encode(points, None, vectors.flatten(1))
    assert code.shape == (4, 8 + 6 + 18) == (4, model.code_size)
    assert_close(code[:, :8], 0.1 * model.encoder(points).expand(4, -1))
    assert_close(code[:, 8:14], vectors.flatten(1))
    for row, pair in zip(code, vectors, strict=True):
        expected = Rotation.from_rotvec(pair.numpy()).as_matrix() - np.eye(3)
        assert_close(row[14:], torch.from_numpy(expected.reshape(-1)).float(), atol=1e-6, rtol=1e-5)
    assert_close(model.told(None, vectors.flatten(1)), code[:, 8:])
    with pytest.raises(ValueError, match="three parameters each, got 7"):
        NeuralJacobianField(6, 6, parameters=7, rotations=True)
    with pytest.raises(ValueError, match="encodes no shapes"):
        NeuralJacobianField(6, 0, parameters=7).encode_source(points)


def test_products_of_matrices_are_those_of_linear_algebra():
    """Three rotations, of whose product any chain of joints is a special case."""
    products = MatrixProducts(3, n_outputs=2, columns=3).double()
    R = torch.from_numpy(Rotation.random(3, random_state=0).as_matrix())
    first, second, third = products.factors
    for factors in products.factors:
        torch.nn.init.zeros_(factors)
    with torch.no_grad():
        first[0, 0, 0] = first[1, 0, 1] = 1  # X₃ = R₀ R₁
        second[0, 0, 3] = second[1, 0, 2] = 1  # X₃₊₄₈ = X₃ R₂
        third[0, 5, 51] = third[1, 5, 3] = 1  # R₀ R₁ R₂ R₀ R₁
        products.mixed[51, :, 0] = torch.eye(3)
        products.mixed[3 + 2 * 48 + 5, :, 1] = torch.eye(3)
        products.mixed[0, :, 1] = 2 * torch.eye(3)
    identity = torch.eye(3)
    got = products((R - identity)[None])[0]
    assert got.shape == (2, 3, 3)
    assert_close(got[0], R[0] @ R[1] @ R[2] - identity)
    chain = R[0] @ R[1] @ R[2] @ R[0] @ R[1] - identity
    assert_close(got[1], chain + 2 * (R[0] - identity))


def test_a_part_field_sees_waves_and_multiplies_the_matrices_that_end_its_code():
    field = randomised(PartField(4 + 18, 4, 6, 9, parts=8, width=8, octaves=2, rotations=2))
    features, told = torch.randn(5, 6).double(), torch.randn(3, 18).double()
    source = torch.randn(4).double()
    code = torch.cat([source.expand(3, -1), told], dim=1)
    x = features[:, :3] * torch.pi
    seen = torch.cat([features, x.sin(), x.cos(), (2 * x).sin(), (2 * x).cos()], dim=1)
    w = field.of_face(seen, source)
    w = torch.cat([(3 * w[:, :2]).softmax(-1), w[:, 2:]], dim=1)
    M = field.of_code(code).view(3, 8, 3, 3) + field.of_rotations(told.view(3, 2, 3, 3))
    expected = torch.einsum("mk,tkij->tmij", w, M).flatten(-2)
    assert_close(field(features, code), expected, rtol=1e-9, atol=1e-9)
    assert field.of_rotations.mixed.abs().max() > 0
