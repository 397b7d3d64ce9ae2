"""DiffusionNet in two places: as the map itself, the paper's baseline, and as NJF's encoder."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.diffusion_net import DiffusionNet
from njf_models.features import Shape
from njf_models.njf import NeuralJacobianField, Prediction, centre_areas
from njf_models.sampled import WholeShapes


class _Uncoded(WholeShapes, nn.Module):
    """A model that learns of the whole shape by diffusion, and needs no code."""

    output_dim: int

    def encode(
        self,
        source: Float[Tensor, "batch s f"] | None = None,
        target: Float[Tensor, "batch t f"] | None = None,
        parameters: Float[Tensor, "batch p"] | None = None,
    ) -> Float[Tensor, "batch 0"]:
        """Nothing, for each source; for one if there are none.

        Raises:
            ValueError: targets or parameters, which the model would not see.
        """
        if target is not None or parameters is not None:
            raise ValueError(f"{type(self).__name__}: maps of the source alone, without parameters")
        return torch.zeros(1, 0) if source is None else source.new_zeros(len(source), 0)

    def forward(self, shape: Shape, code: Float[Tensor, "*batch 0"]) -> Prediction:
        """The map of a shape."""
        return self.iterates(shape, code)[-1]

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch 0"]) -> list[Prediction]:
        """The map after each round."""
        raise NotImplementedError


class DiffusionMap(_Uncoded):
    """Φ(v) = v + DiffusionNet(features), on the shape as the network sees it.

    Args:
        features: number of features of a vertex (6, or 6 + k with a wave-kernel signature).
        output_dim: c, 3 for maps to space, 2 for maps to the plane.
        width: channels of DiffusionNet.
        n_blocks: its blocks.
    """

    def __init__(
        self, features: int, *, output_dim: int = 2, width: int = 64, n_blocks: int = 4
    ) -> None:
        super().__init__()
        self.output_dim = output_dim
        self.net = DiffusionNet(features, output_dim, width, n_blocks)

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch 0"]) -> list[Prediction]:
        """The one map. Its Jacobians are those of the map, nought along the normals."""
        phi = shape.vertex_features[:, : self.output_dim] + self.net(shape)
        phi = centre_areas(shape, phi)
        if shape.mesh.n_parts == 1:
            phi = phi.expand(*code.shape[:-1], -1, -1)
        J = dp.jacobians(shape.mesh, phi)
        return [Prediction(dp.extend(J, shape.frames), J, phi)]


class DiffusionEncodedNJF(_Uncoded):
    """A Neural Jacobian Field whose faces see DiffusionNet's outputs at their corners.

    In place of PointNet's code and the wave-kernel signature.

    Args:
        features: number of features of a vertex and of a face.
        encoded: number of DiffusionNet's outputs.
        net_width: its channels.
        n_blocks: its blocks.
        field: further arguments of `NeuralJacobianField`.
    """

    def __init__(
        self,
        features: int,
        *,
        encoded: int = 32,
        net_width: int = 64,
        n_blocks: int = 2,
        **field: object,
    ) -> None:
        super().__init__()
        self.net = DiffusionNet(features, encoded, net_width, n_blocks)
        self.njf = NeuralJacobianField(features + encoded, 0, **field)  # type: ignore[arg-type]
        self.output_dim = self.njf.output_dim

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch 0"]) -> list[Prediction]:
        """The maps after each round."""
        encoded = self.net(shape)[shape.mesh.faces].mean(dim=1)
        seen = torch.cat([shape.features, encoded], dim=1)
        return self.njf.iterates(shape.with_features(seen), code)
