"""A trained network that re-poses bodies, on any triangulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.chain import ChainedNJF, Start
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
        start: of its maps; where a chain of networks has taken it, if the network is one.
        centre: (3,) area-weighted mean of the surface.
    """

    shape: Shape
    start: Start
    centre: Float[Tensor, "3"]


class ReposeNetwork(TrainedNetwork):
    """A network for maps of bodies to poses, with the poses as parameters.

    From the rest pose; or, if it is a chain that takes a body to rest first, from any.
    """

    holds: ClassVar[str] = "repose_network"

    @classmethod
    def chained(cls, checkpoints: Sequence[Path]) -> ReposeNetwork:
        """The networks in several checkpoints of `training.NJFTraining`, one after another.

        Args:
            checkpoints: all but the last of networks that take bodies nearer to rest.

        Raises:
            ValueError: their inputs differ, but for the basis points that they are seen from.
        """
        links = [cls.from_checkpoint(path) for path in checkpoints]
        if len(links) == 1:
            return links[0]
        if len({replace(link.inputs, n_basis=0, basis_at="box") for link in links}) != 1:
            raise ValueError(f"ReposeNetwork.chained: inputs of {checkpoints} differ")
        inputs = links[-1].inputs
        arguments = {"links": [link.arguments for link in links], "n_points": inputs.n_points}
        network = cls(arguments, inputs, "chain")
        chain = ChainedNJF.of([link._last for link in links], inputs.n_points)
        network.model.load_state_dict(chain.state_dict())
        return network

    def repose(self, mesh: dp.Mesh, poses: Float[Tensor, "p k"]) -> Float[Tensor, "p n 3"]:
        """A body in other poses.

        Args:
            mesh: a body in the rest pose of `datasets.poses`, or in any if the network is a chain;
                in metres, x to its left, y to its back, z up. It may have any triangulation, and
                stand anywhere.
            poses: rotation vectors of `datasets.poses.JOINTS`, in radians.

        Returns:
            (p, n, 3) in the dtype of the mesh; its mean over the area stays where it was.
        """
        return self.repose_prepared(self.prepare(mesh), poses).to(mesh.dtype)

    @torch.no_grad()
    def prepare(self, mesh: dp.Mesh) -> PreparedBody:
        """What depends on the body alone: factor, features and code; and the way to rest."""
        mesh = mesh.to(torch.float64)
        shape, points = self.inputs.of(mesh)
        centre = mesh.vertex_areas @ mesh.vertices / mesh.areas.sum()
        if isinstance(self.model, ChainedNJF):
            return PreparedBody(shape, self.model.start(shape), centre)
        start = Start.of(self._last, mesh.vertices, shape.frames, shape.features, points)
        return PreparedBody(shape, start, centre)

    @torch.no_grad()
    def repose_prepared(
        self, body: PreparedBody, poses: Float[Tensor, "p k"]
    ) -> Float[Tensor, "p n 3"]:
        """A body that was prepared before, in other poses; float64."""
        told = self._last.told(None, poses.float())
        return body.start.finish(self._last, body.shape, told).vertices.double() + body.centre

    @property
    def _last(self) -> NeuralJacobianField:
        """The network that is told the pose."""
        model = self.model.last if isinstance(self.model, ChainedNJF) else self.model
        assert isinstance(model, NeuralJacobianField)
        return model
