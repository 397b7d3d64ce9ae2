"""Shapes seen from fixed points in space: what a code is made of, without drawing samples.

Prokudin, Lassner, Romero: *Efficient Learning on Point Clouds with Basis Point Sets*, ICCV 2019.
Closest points are taken on the surface itself, so that how it is cut into triangles hardly matters,
and no network runs over points.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Literal

import igl
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.features import bounding_box_centre
from njf_models.layers import smooth_layers

BasisPlace = Literal["box", "body"]
"""Where basis points are: all over a box that bodies reach little beyond in most poses; or on the
average body at rest, for bodies that are near it, of which they see all details."""

_PAIR = 4  # numbers that a point of a pair sees
_BOX = (0.9, 0.45, 1.0)  # half its sides, in metres
_BODY = Path(__file__).with_name("rest_points.npy")  # of tests/benchmarks/rest_points.py


@cache
def basis_points(n: int, place: BasisPlace = "box") -> Float[Tensor, "pairs 2 3"]:
    """Fixed points in space, in pairs that are mirror images in x = 0; the first ones stay.

    In the box, they and their images are the first points of Sobol's sequence.

    Args:
        n: how many, an even number.
        place: where.

    Raises:
        ValueError: n is odd or not positive, or there are not so many on the body.
    """
    if n < 2 or n % 2:
        raise ValueError(f"basis points are pairs, of an even number of points, got {n}")
    if place == "body":
        left = torch.from_numpy(np.load(_BODY)).double()
        if n > 2 * len(left):
            raise ValueError(f"there are {2 * len(left)} basis points on the body, got n={n}")
        left = left[: n // 2]
    else:
        unit = torch.quasirandom.SobolEngine(3).draw(n // 2).double()
        x, y, z = (unit * torch.tensor([1.0, 2, 2]) - torch.tensor([0.0, 1, 1])).unbind(-1)
        left = torch.stack([x, y, z], dim=-1) * torch.tensor(_BOX)
    return torch.stack([left, left * torch.tensor([-1.0, 1, 1])], dim=1)


def basis_features(mesh: dp.Mesh, n: int, place: BasisPlace = "box") -> Float[Tensor, "pairs 8"]:
    """The way from each basis point to the closest point of a surface, and its length.

    Args:
        mesh: a surface in metres; its bounding box's centre is the origin.
        n: how many basis points.
        place: where they are.

    Returns:
        (n / 2, 8) [way, length, way, length] of each pair, in the mesh's dtype.
    """
    points = basis_points(n, place).view(-1, 3)
    vertices = (mesh.vertices - bounding_box_centre(mesh)).double()
    closest = igl.point_mesh_squared_distance(
        points.numpy(), vertices.detach().cpu().numpy(), mesh.faces.cpu().numpy()
    )[2]
    ways = torch.as_tensor(closest) - points
    lengths = torch.linalg.vector_norm(ways, dim=-1, keepdim=True)
    return torch.cat([ways, lengths], dim=-1).view(-1, 8).to(mesh.vertices)


def reflected_basis(features: Float[Tensor, "*b pairs 8"]) -> Float[Tensor, "*b pairs 8"]:
    """What the basis points see of the mirror image in x = 0: each what its own image saw."""
    swapped = features.roll(_PAIR, dims=-1)
    return swapped * features.new_tensor([-1, 1, 1, 1]).repeat(2)


class BasisEncoder(nn.Module):
    """A code of a shape, from `basis_features`, by three hidden layers.

    They are as wide as there are points, but not wider than 512.

    Args:
        n: how many basis points.
        code_size: size z of the code.
    """

    def __init__(self, n: int, code_size: int) -> None:
        super().__init__()
        width = min(n, 512)
        self.layers = smooth_layers((4 * n, width, width, width, code_size))

    def forward(self, features: Float[Tensor, "*batch pairs 8"]) -> Float[Tensor, "*batch z"]:
        """Code of each shape."""
        return self.layers(features.flatten(-2))
