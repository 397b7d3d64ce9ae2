"""Products of matrices, for chains of joints."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

_LEVELS = 3  # products of up to eight matrices: as many joints as lie between pelvis and hand
_PER_LEVEL = 48


class MatrixProducts(nn.Module):
    """Σⱼ Xⱼ Gₖⱼ, where Xⱼ are some given matrices and learned products of them.

    A bone is turned by the product of the rotations of all joints between the root and it, which
    layers of a network can but approximate. Here each level multiplies pairs of linear combinations
    of all matrices before it, so that three levels reach products of eight. Matrices stand
    for what they differ by from the identity: (I + A)(I + B) = I + A + B + AB.

    Args:
        n_matrices: how many are given.
        n_outputs: how many combinations of the products are made.
        columns: of each.
    """

    def __init__(self, n_matrices: int, n_outputs: int, columns: int) -> None:
        super().__init__()
        n = n_matrices
        self.factors = nn.ParameterList()
        for _ in range(_LEVELS):
            self.factors.append(nn.Parameter(torch.randn(2, _PER_LEVEL, n) * n**-0.5))
            n += _PER_LEVEL
        self.mixed = nn.Parameter(torch.zeros(n, 3, n_outputs, columns))

    def forward(self, matrices: Float[Tensor, "b n 3 3"]) -> Float[Tensor, "b k 3 c"]:
        """The combinations, of matrices less the identity."""
        X = matrices
        for factors in self.factors:
            A, B = torch.einsum("sjn,bnxy->sbjxy", factors, X)
            X = torch.cat([X, _product(A, B)], dim=1)
        rows = X.transpose(1, 2).flatten(2)  # (b, 3, n 3), for one product of matrices
        mixed = rows @ self.mixed.flatten(2).flatten(0, 1)
        return mixed.unflatten(-1, self.mixed.shape[2:]).transpose(1, 2)


def _product(A: Float[Tensor, "*b 3 3"], B: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """(I + A)(I + B) - I."""
    return A + B + A @ B
