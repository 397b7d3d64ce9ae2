"""PointNet with group norms: a global code of a shape from points on its surface."""

from __future__ import annotations

from collections import OrderedDict

from jaxtyping import Float
from torch import Tensor, nn


class PointNet(nn.Module):
    """Pointwise linear layers with group norms, then the maximum over the points.

    Args:
        in_features: number of features of each point.
        code_size: size z of the code.
    """

    def __init__(self, in_features: int, code_size: int = 1000) -> None:
        super().__init__()
        widths = (in_features, 128, 128, 256, code_size)
        groups = (4, 4, 8, 8)
        layers: OrderedDict[str, nn.Module] = OrderedDict()
        for i in range(4):
            layers[f"conv{i + 1}"] = nn.Conv1d(widths[i], widths[i + 1], 1)
            layers[f"norm{i + 1}"] = nn.GroupNorm(groups[i], widths[i + 1])
            if i < 3:
                layers[f"relu{i + 1}"] = nn.ReLU()
        self.layers = nn.Sequential(layers)

    def forward(self, points: Float[Tensor, "*batch s f"]) -> Float[Tensor, "*batch z"]:
        """Code of each point cloud; independent of the order of its points."""
        clouds = points.reshape(-1, *points.shape[-2:])
        return self.layers(clouds.mT).max(dim=-1).values.unflatten(0, points.shape[:-2])
