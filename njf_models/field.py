"""The neural field: one small MLP that turns a triangle's features and a code into a 3×3 matrix."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional


class RowGroupNorm(nn.Module):
    """`nn.GroupNorm` of (rows, channels), with its parameters, at a third of its time on a CPU.

    Each group of channels of one row is normalised on its own, which is what layer norm does to the
    row cut into groups.
    """

    def __init__(self, num_groups: int, num_channels: int, eps: float = 1e-5) -> None:
        super().__init__()
        self.num_groups, self.eps = num_groups, eps
        self.weight = nn.Parameter(torch.ones(num_channels))
        self.bias = nn.Parameter(torch.zeros(num_channels))

    def forward(self, x: Float[Tensor, "*rows channels"]) -> Float[Tensor, "*rows channels"]:
        """Normalise each group of channels of each row, then scale and shift each channel."""
        groups = x.unflatten(-1, (self.num_groups, -1))
        normalised = functional.layer_norm(groups, groups.shape[-1:], eps=self.eps)
        return normalised.flatten(-2) * self.weight + self.bias


class FieldMLP(nn.Module):
    """Five linear layers, 128 wide, group norms between; the last starts at zero: the identity map.

    The first layer acts on [code | features]. Its two halves are applied apart, W [c | f] = W₁c +
    W₂f, so that the code is multiplied once per shape and no (faces × code) array exists.

    Args:
        code_size: size of the global code; 0 for none.
        in_features: number of features of each face.
        out_features: number of outputs per face, the entries of its matrix.
        width: size of the hidden layers.
    """

    def __init__(
        self, code_size: int, in_features: int, out_features: int = 9, width: int = 128
    ) -> None:
        super().__init__()
        self.code_size = code_size
        sizes = (code_size + in_features, width, width, width, width)
        layers: list[nn.Module] = []
        for fan_in in sizes[:-1]:
            layers += [nn.Linear(fan_in, width), RowGroupNorm(4, width), nn.ReLU()]
        last = nn.Linear(width, out_features)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    def forward(
        self,
        features: Float[Tensor, "*#batch m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face.

        Args:
            features: (m, f) features of the faces, or (…, m, f) with a code for each.
            code: (…, z), every code with every face, if `part_of_face` is None; else (parts, z),
                one code for the faces of each part of a packed batch.
            part_of_face: (m,) the code that belongs to each face.

        Returns:
            (…, m, out), or (m, out) if packed.
        """
        first = cast("nn.Linear", self.layers[0])
        of_code, of_features = first.weight.split((self.code_size, features.shape[-1]), dim=1)
        per_code = functional.linear(code, of_code, first.bias)
        per_code = per_code[..., None, :] if part_of_face is None else per_code[part_of_face]
        return self.layers[1:](per_code + functional.linear(features, of_features))
