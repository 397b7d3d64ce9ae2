"""The pose of a body, from what basis points see of it."""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.layers import smooth_layers


class PoseEstimator(nn.Module):
    """Rotations of joints from `basis_points.basis_features`.

    That the network of a map infers the source's pose by itself takes it long: each of its steps
    sees a few dozen bodies. A network that does nothing else sees as many in the same time
    as there are, and what it says can be told as if a user had.

    Args:
        basis: how many basis points.
        joints: how many rotations.
        width: of three hidden layers.
    """

    def __init__(self, basis: int, joints: int, width: int = 512) -> None:
        super().__init__()
        self.layers = smooth_layers((4 * basis, width, width, width, 9 * joints))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, features: Float[Tensor, "*b pairs 8"]) -> Float[Tensor, "*b joints 3 3"]:
        """Least-squares estimates of the matrices, less the identity.

        They are means over what could be seen so, not rotations where that is uncertain.
        """
        return self.layers(features.flatten(-2)).unflatten(-1, (-1, 3, 3))


def angles_between(
    matrices: Float[Tensor, "*b 3 3"], rotations: Float[Tensor, "*b 3 3"]
) -> Float[Tensor, "*b"]:
    """Angles in radians between rotations and those closest to some matrices."""
    cosines = ((dp.closest_rotation(matrices) * rotations).sum((-1, -2)) - 1) / 2
    return cosines.clamp(-1, 1).acos()  # rounding may leave the interval
