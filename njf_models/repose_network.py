"""A trained network that re-poses bodies, on any triangulation."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.features import Shape
from njf_models.njf import NeuralJacobianField
from njf_models.trained import TrainedNetwork


class Stance(NamedTuple):
    """How coordinates of a character are related to those that the network knows.

    Attributes:
        y_up: its y is up and its z to its front; else z is up and y to its back, as in the network.
        scale: metres in a unit.
    """

    y_up: bool = False
    scale: float = 1.0

    def standing(self, x: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """The network's coordinates from the character's."""
        x = self.scale * x
        return torch.stack([x[..., 0], -x[..., 2], x[..., 1]], dim=-1) if self.y_up else x

    def back(self, x: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """The character's coordinates from the network's."""
        x = torch.stack([x[..., 0], x[..., 2], -x[..., 1]], dim=-1) if self.y_up else x
        return x / self.scale

    def height(self, x: Float[Tensor, "n 3"]) -> float:
        """Of a character, in its own units."""
        upward = x[:, 1 if self.y_up else 2]
        return float(upward.max() - upward.min())


class PreparedBody(NamedTuple):
    """A body as a `ReposeNetwork` sees it; what depends on the pose is not in it.

    Attributes:
        shape: with its factor and features.
        code: (z,) what the encoder makes of its surface.
        centre: (3,) area-weighted mean of the surface.
    """

    shape: Shape
    code: Float[Tensor, "z"]
    centre: Float[Tensor, "3"]


class ReposeNetwork(TrainedNetwork):
    """A network for the maps of bodies from rest to poses, with the poses as parameters."""

    holds: ClassVar[str] = "repose_network"

    def repose(self, mesh: dp.Mesh, poses: Float[Tensor, "p k"]) -> Float[Tensor, "p n 3"]:
        """A body in other poses.

        Args:
            mesh: a body in the rest pose of `datasets.poses`, in metres: x to its left, y to its
                back, z up. It may have any triangulation, and stand anywhere.
            poses: rotation vectors of `datasets.poses.JOINTS`, in radians.

        Returns:
            (p, n, 3) in the dtype of the mesh; its mean over the area stays where it was.
        """
        return self.repose_prepared(self.prepare(mesh), poses).to(mesh.dtype)

    @torch.no_grad()
    def prepare(self, mesh: dp.Mesh) -> PreparedBody:
        """What depends on the body alone: factor, features and code."""
        mesh = mesh.to(torch.float64)
        shape, points = self.inputs.of(mesh)
        centre = mesh.vertex_areas @ mesh.vertices / mesh.areas.sum()
        assert isinstance(self.model, NeuralJacobianField)
        assert self.model.encoder is not None
        return PreparedBody(shape, self.model.encoder(points[None])[0], centre)

    @torch.no_grad()
    def repose_prepared(
        self, body: PreparedBody, poses: Float[Tensor, "p k"]
    ) -> Float[Tensor, "p n 3"]:
        """A body that was prepared before, in other poses; float64."""
        code = torch.cat([body.code.expand(len(poses), -1), poses.float()], dim=-1)
        return self.model(body.shape, code).vertices.double() + body.centre
