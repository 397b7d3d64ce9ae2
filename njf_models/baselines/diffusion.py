"""DiffusionNet as the map itself, the paper's baseline."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.diffusion_net import DiffusionNet
from njf_models.diffusion_njf import UncodedModel
from njf_models.features import Shape
from njf_models.njf import Prediction, centre_areas


class DiffusionMap(UncodedModel):
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
