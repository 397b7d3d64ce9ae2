"""A Neural Jacobian Field that learns of the whole shape by diffusion instead of a code."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from njf_models.diffusion_net import DiffusionNet
from njf_models.features import Shape
from njf_models.njf import NeuralJacobianField, Prediction
from njf_models.sampled import WholeShapes


class UncodedModel(WholeShapes, nn.Module):
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


class DiffusionEncodedNJF(UncodedModel):
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
