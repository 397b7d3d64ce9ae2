"""Maps one after another: each network starts from where the one before took the surface.

A character in some pose can be taken to rest first, and from there to any other pose, by a network
that has to know but one start. By the chain rule the Jacobians of the composed map are products, so
that all solves are on the source, with its one factor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.basis_points import basis_features
from njf_models.features import Shape, face_features, point_features
from njf_models.field import PartField
from njf_models.njf import NeuralJacobianField, Prediction
from njf_models.sampled import WholeShapes


class Start(NamedTuple):
    """What of a network's maps of one shape does not depend on the target.

    Attributes:
        vertices: (n, 3) where the maps start: the surface, or where other networks took it.
        jacobians: (m, 3, 2) J of that map; the shape's frames, if it is the surface.
        features: (m, f) features of its faces there.
        code: (z,) what the network's encoder makes of it.
        weights: (m, k) those of its field of parts; None if it has another.
    """

    vertices: Float[Tensor, "n 3"]
    jacobians: Float[Tensor, "m 3 2"]
    features: Float[Tensor, "m f"]
    code: Float[Tensor, "z"]
    weights: Float[Tensor, "m k"] | None

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        network: NeuralJacobianField,
        vertices: Float[Tensor, "n 3"],
        jacobians: Float[Tensor, "m 3 2"],
        features: Float[Tensor, "m f"],
        points: Float[Tensor, "s g"],
    ) -> Start:
        """A network's start, a constant, from the points that its encoder sees there."""
        code = network.encode_source(points[None])[0]
        field = network.field
        weights = field.weights(features, code) if isinstance(field, PartField) else None
        return cls(vertices, jacobians, features, code, weights)

    def finish(
        self, network: NeuralJacobianField, shape: Shape, told: Float[Tensor, "*batch z"]
    ) -> Prediction:
        """The network's maps from here.

        Args:
            network: whose start this is.
            shape: the source.
            told: (…, z) what the code says of the targets, `CodedModel.told`.
        """
        code = torch.cat([self.code.expand(*told.shape[:-1], -1), told], dim=-1)
        if self.weights is None:
            P = network.matrices(self.features, code)
        else:
            assert isinstance(network.field, PartField)
            P = network.from_identity(self.weights @ network.field.parts(code))
        return network.solved(shape, P, self.jacobians)


class ChainedNJF(WholeShapes, nn.Module):
    """Rᵢ = Pᵢ Jᵢ₋₁, Φᵢ = L⁻¹ ∇ᵀ A Rᵢ for one network after another, Jᵢ the Jacobians of Φᵢ.

    Each Pᵢ is predicted from Φᵢ₋₁: of its faces and of points on it. All but the last network are
    told nothing else; what a user says of the target is for the last one. They are trained one by
    one, each on surfaces that those before have carried (`carried.carry`).

    Args:
        links: arguments of each `NeuralJacobianField`, of one round.
        n_points: how many points their encoders see, where they are PointNets.
    """

    output_dim = 3

    def __init__(self, links: Sequence[dict[str, Any]], n_points: int) -> None:
        super().__init__()
        self.links = nn.ModuleList(NeuralJacobianField(**arguments) for arguments in links)
        self.n_points = n_points

    @classmethod
    def of(cls, networks: Sequence[NeuralJacobianField], n_points: int) -> ChainedNJF:
        """A chain of trained networks.

        Raises:
            ValueError: there are none, or one has more than one round.
        """
        if not networks or any(network.rounds > 1 for network in networks):
            raise ValueError("ChainedNJF.of: this needs networks, of one round each")
        chain = cls([], n_points)
        chain.links = nn.ModuleList(networks)
        return chain.eval()

    def encode(
        self,
        source: Float[Tensor, "*#batch s f"] | None = None,
        target: Float[Tensor, "*#batch t f"] | None = None,
        parameters: Float[Tensor, "*#batch p"] | None = None,
    ) -> Float[Tensor, "*batch z"]:
        """What the last network is told of the targets; the sources' codes are made on the way.

        Args:
            source: not used.
            target: (…, t, f) point features of the targets, if it encodes them.
            parameters: (…, p) user parameters, if it has any.
        """
        if target is None and parameters is None:
            assert source is not None
            return source.new_zeros(*source.shape[:-2], 0)
        return self.last.told(target, parameters)

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of one shape for each code of `encode`."""
        return self.start(shape).finish(self.last, shape, code)

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The one map; as of a model with rounds."""
        return [self(shape, code)]

    @torch.no_grad()
    def start(self, shape: Shape) -> Start:
        """Where the last network starts: all the others' work, a constant."""
        vertices, J = shape.mesh.vertices, shape.frames
        samples = dp.sample_surface(
            shape.mesh, self.n_points, generator=torch.Generator().manual_seed(0)
        )
        for link in self.links:
            assert isinstance(link, NeuralJacobianField)
            mesh = shape.mesh.with_vertices(vertices.to(shape.mesh.dtype))
            dtype = shape.features.dtype
            if link.n_basis:
                points = basis_features(mesh, link.n_basis, link.basis_at).to(dtype)
            else:
                points = point_features(mesh, samples).to(dtype)
            start = Start.of(link, vertices, J, face_features(mesh).to(dtype), points)
            if link is not self.last:
                vertices = start.finish(link, shape, start.code.new_zeros(0)).vertices
                J = dp.jacobians(shape.mesh, vertices)
        return start

    @property
    def last(self) -> NeuralJacobianField:
        """The network that is told of the targets."""
        last = self.links[-1]
        assert isinstance(last, NeuralJacobianField)
        return last
