"""Loading the layout of the authors' checkpoints, against a forward pass written out here."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.nn import functional
from torch.testing import assert_close

from njf_models.pretrained import from_reference_state_dict
from tests import references
from tests.njf_models.shapes import ellipsoid, prepared

FIELD = "per_face_decoder."
ENCODER = "encoder._DeformationEncoder__module_list.{}._PointNetEncoder__pointnet."
POINTNET_WIDTHS, POINTNET_GROUPS = (6, 128, 128, 256, 40), (4, 4, 8, 8)


@pytest.fixture
def state_dict():
    """A checkpoint with the keys and shapes of the authors' code, codes of 40 for speed."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return 0.2 * torch.randn(*shape, generator=generator, dtype=torch.float64)

    state = {}
    sizes = (2 * 40 + 6, 128, 128, 128, 128)
    for i, fan_in in enumerate(sizes[:4]):
        state[f"{FIELD}{3 * i}.weight"] = random(128, fan_in)
        for key in (f"{3 * i}.bias", f"{3 * i + 1}.weight", f"{3 * i + 1}.bias"):
            state[FIELD + key] = random(128)
    state[f"{FIELD}12.weight"], state[f"{FIELD}12.bias"] = random(9, 128), random(9)
    for i, (fan_in, width) in enumerate(pairwise(POINTNET_WIDTHS), start=1):
        layer = {
            f"conv{i}.weight": random(width, fan_in, 1),
            f"conv{i}.bias": random(width),
            f"bn{i}.weight": random(width),
            f"bn{i}.bias": random(width),
        }
        for k in (0, 1):  # the shared encoder is stored twice
            state |= {ENCODER.format(k) + key: value.clone() for key, value in layer.items()}
    return state


def expected_code(state, points):
    x = points.T[None]
    for i, groups in enumerate(POINTNET_GROUPS, start=1):
        layer = {key: state[ENCODER.format(0) + key.format(i)] for key in LAYER_KEYS}
        x = functional.conv1d(x, layer["conv{}.weight"], layer["conv{}.bias"])
        x = functional.group_norm(x, groups, layer["bn{}.weight"], layer["bn{}.bias"])
        x = functional.relu(x) if i < 4 else x
    return x[0].amax(dim=1)


LAYER_KEYS = ("conv{}.weight", "conv{}.bias", "bn{}.weight", "bn{}.bias")


def expected_matrices(state, x):
    for i in range(0, 12, 3):
        x = functional.linear(x, state[f"{FIELD}{i}.weight"], state[f"{FIELD}{i}.bias"])
        x = functional.group_norm(
            x, 4, state[f"{FIELD}{i + 1}.weight"], state[f"{FIELD}{i + 1}.bias"]
        )
        x = functional.relu(x)
    x = functional.linear(x, state[f"{FIELD}12.weight"], state[f"{FIELD}12.bias"])
    return x.reshape(-1, 3, 3) + torch.eye(3, dtype=x.dtype)


def test_forward_pass_is_the_reference_architectures(state_dict):
    mesh = ellipsoid()
    shape = prepared(mesh)
    source, target = torch.randn(2, 1, 50, 6, dtype=torch.float64)
    model = from_reference_state_dict(state_dict)
    prediction = model(shape, model.encode(source, target))

    code = torch.cat([expected_code(state_dict, cloud[0]) for cloud in (source, target)])
    inputs = torch.cat([code.expand(mesh.n_faces, 80), shape.features], dim=1)
    P = expected_matrices(state_dict, inputs)
    phi = references.poisson(mesh.vertices.numpy(), mesh.faces.numpy(), P.numpy())
    assert_close(prediction.matrices[0], P, rtol=1e-10, atol=1e-10)
    vertices = prediction.vertices[0].detach().numpy()
    assert_close(vertices, phi - phi.mean(0), rtol=1e-9, atol=1e-9)
    assert np.abs(vertices.mean(0)).max() < 1e-12


def test_dtype_and_sizes_are_read_off(state_dict):
    model = from_reference_state_dict({key: v.float() for key, v in state_dict.items()})
    assert next(model.parameters()).dtype == torch.float32
    assert model.encode(torch.randn(3, 9, 6), torch.randn(3, 9, 6)).shape == (3, 80)


def test_source_only_and_no_encoder(state_dict):
    def without(*prefixes):
        return {key: v for key, v in state_dict.items() if not key.startswith(prefixes)}

    first = state_dict[f"{FIELD}0.weight"]
    source_only = without(ENCODER.format(1)) | {f"{FIELD}0.weight": first[:, :46]}
    model = from_reference_state_dict(source_only)
    assert model.encode(torch.randn(3, 9, 6).double()).shape == (3, 40)
    pose_only = without("encoder") | {f"{FIELD}0.weight": first[:, :17]}
    model = from_reference_state_dict(pose_only)
    assert model.encode(parameters=torch.randn(3, 11).double()).shape == (3, 11)


def test_wrong_state_dicts_raise(state_dict):
    with pytest.raises(ValueError, match=r"unknown \['stranger'\]"):
        from_reference_state_dict(state_dict | {"stranger": torch.zeros(1)})
    with pytest.raises(ValueError, match="expected keys"):
        from_reference_state_dict({})
    state_dict[ENCODER.format(1) + "conv2.bias"][0] += 1
    with pytest.raises(ValueError, match="source and target encoders differ"):
        from_reference_state_dict(state_dict)
