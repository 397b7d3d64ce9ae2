"""From the unknowns of a Poisson problem to a map: x at the free vertices, placed by the gauge.

    Φ = C E x

E puts x at the free vertices and zero elsewhere, C subtracts from each floating component its mean.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.constraints import Constraints
from diffpoisson.linear_map import Matrix


class Placement(Matrix):
    """C E as a matrix, (n, f).

    Args:
        constraints: which vertices are free, and which component floats.
        means: (n,) the weights of each vertex in the mean of its component, None for no mean; see
            `Constraints.mean_weights`.
    """

    def __init__(self, constraints: Constraints, means: Float[Tensor, "n"] | None) -> None:
        self.constraints, self.means = constraints, means
        self.shape = (len(constraints.floating), len(constraints.free))
        self._free = _rows(constraints.free)
        # One component needs no sums by index, which cost four times as much.
        self._one_floats = constraints.n_floating == 1 and bool((constraints.floating == 0).all())

    def multiply(self, x: Float[Tensor, "f k"]) -> Float[Tensor, "n k"]:
        """C E x."""
        phi = x.new_zeros(self.shape[0], x.shape[1])
        phi[self._free] = x
        if self.means is None:
            return phi
        weights = self.means.to(x.dtype)
        if self._one_floats:
            return phi.sub_(weights @ phi)
        return phi.sub_(self._sums(weights[:, None] * phi)[self.constraints.floating])

    def transposed(self) -> PlacementTransposed:
        """Eᵀ Cᵀ."""
        return PlacementTransposed(self)

    def _sums(self, values: Float[Tensor, "n k"]) -> Float[Tensor, "q k"]:
        """Over each floating component, and zero for what is held, which catches no NaN there."""
        sums = values.new_zeros(self.constraints.n_floating + 1, values.shape[1])
        sums.index_add_(0, self.constraints.floating, values)
        sums[-1] = 0
        return sums


class PlacementTransposed(Matrix):
    """Eᵀ Cᵀ, (f, n): the values at free vertices, less the share of each in its component's sum."""

    def __init__(self, placement: Placement) -> None:
        self._placement = placement
        self.shape = placement.shape[::-1]

    def multiply(self, x: Float[Tensor, "n k"]) -> Float[Tensor, "f k"]:
        """Eᵀ Cᵀ x."""
        place = self._placement
        if place.means is not None:
            weights = place.means.to(x.dtype)
            if place._one_floats:
                x = torch.addmm(x, weights[:, None], x.sum(0, keepdim=True), alpha=-1)
            else:
                x = x - weights[:, None] * place._sums(x)[place.constraints.floating]
        return x[place._free]

    def transposed(self) -> Placement:
        """C E."""
        return self._placement


def _rows(indices: Tensor) -> Tensor | slice:
    """Indices as a slice, where they are consecutive: copied at once instead of row by row."""
    if len(indices) and bool((indices.diff() == 1).all()):
        return slice(int(indices[0]), int(indices[-1]) + 1)
    return indices
