"""Small shapes and reference networks for the tests of njf_models."""

from __future__ import annotations

import numpy as np
import torch

import diffpoisson as dp
from njf_models import Shape
from tests import meshes


def bumpy_disk(seed: int = 0, size: int = 6) -> dp.Mesh:
    return dp.Mesh(*meshes.disk(seed, size))


def ellipsoid(seed: int = 0) -> dp.Mesh:
    return dp.Mesh(*meshes.sphere(seed, subdivisions=2))


def with_frames_rotated(mesh: dp.Mesh, seed: int = 0) -> dp.Mesh:
    """The same mesh whose tangent bases are turned by a random angle on each face."""
    angle = torch.from_numpy(np.random.default_rng(seed).uniform(0, 2 * np.pi, mesh.n_faces))
    cos, sin = angle.cos(), angle.sin()
    turn = torch.stack([torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)], -2)
    turned = dp.Mesh(mesh.vertices, mesh.faces)
    turned.__dict__["_double_frames"] = mesh._double_frames @ turn
    assert not torch.allclose(turned.frames, mesh.frames, atol=0.1)
    return turned


def randomised(model: torch.nn.Module, seed: int = 0) -> torch.nn.Module:
    """The model in float64 with all parameters random: the last layer starts at zero otherwise."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(std=0.2, generator=generator)
    return model.double()


def prepared(mesh: dp.Mesh) -> Shape:
    return Shape.prepare(mesh, dtype=torch.float64)
