"""The paper's error metrics (its Tables 1 and 2): L2-V, L2-J, L2-N, D > 10 and #I."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp

DISTORTION_LIMIT = 10.0


def l2_vertices(
    predicted: Float[Tensor, "*batch n c"], target: Float[Tensor, "*#batch n c"]
) -> Float[Tensor, "*batch"]:
    """L2-V: mean distance of vertices × 10², each map centred and scaled to largest radius one."""
    return 100 * torch.linalg.vector_norm(_unit(predicted) - _unit(target), dim=-1).mean(-1)


def l2_jacobians(
    predicted: Float[Tensor, "*batch m c d"], target: Float[Tensor, "*#batch m c d"]
) -> Float[Tensor, "*batch"]:
    """L2-J: mean Frobenius distance of restricted Jacobians × 10."""
    return 10 * torch.linalg.matrix_norm(predicted - target).mean(-1)


def l2_normals(
    predicted: Float[Tensor, "*batch n 3"],
    target: Float[Tensor, "*#batch n 3"],
    faces: Int[Tensor, "m 3"],
) -> Float[Tensor, "*batch"]:
    """L2-N: mean angle between the faces' normals, in degrees. A collapsed face counts as 90°."""
    a, b = torch.broadcast_tensors(_area_vectors(predicted, faces), _area_vectors(target, faces))
    sine = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1)
    cosine = (a * b).sum(-1)
    # atan2 keeps its digits where the angle is small, unlike arccos; atan2(0, 0) would be 0°.
    angle = torch.where((sine == 0) & (cosine == 0), torch.pi / 2, torch.atan2(sine, cosine))
    return angle.mean(-1).rad2deg()


def count_distorted(J: Float[Tensor, "*batch m 2 2"]) -> Int[Tensor, "*batch"]:
    """D > 10: number of faces with max(σ₁, 1/σ₂) > 10, flipped ones included."""
    return (dp.isometric_distortion(J) > DISTORTION_LIMIT).sum(-1)


def count_flips(J: Float[Tensor, "*batch m 2 2"]) -> Int[Tensor, "*batch"]:
    """#I: number of faces with det J ≤ 0."""
    return dp.flipped(J).sum(-1)


def _unit(phi: Tensor) -> Tensor:
    centred = phi - phi.mean(dim=-2, keepdim=True)
    return centred / torch.linalg.vector_norm(centred, dim=-1).amax(-1)[..., None, None]


def _area_vectors(phi: Tensor, faces: Tensor) -> Tensor:
    a, b, c = phi[..., faces, :].unbind(-2)
    return torch.linalg.cross(b - a, c - a)
