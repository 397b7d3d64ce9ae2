"""Handles whose positions a code tells: the pins of a Poisson solve, and what follows from them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import diffpoisson as dp

Moves = Callable[[Tensor], Tensor]


def _themselves(code: Tensor) -> Tensor:
    return code


@dataclass(frozen=True, eq=False)
class Handles:
    """Vertices that are held where a code says: at q = origin + Σⱼ aⱼ movesⱼ, a = `amounts(code)`.

    Attributes:
        mesh: whose vertices.
        held: (n,) which.
        origin: (p, c) float64 where they are if all amounts are nought, ascending.
        moves: (k, p, c) float64 by how much each amount moves them.
        amounts: (…, z) codes ↦ (…, k); the codes themselves if omitted.
    """

    mesh: dp.Mesh
    held: Bool[Tensor, "n"]
    origin: Float[Tensor, "p c"]
    moves: Float[Tensor, "k p c"]
    amounts: Moves = field(default=_themselves)

    @cached_property
    def solver(self) -> dp.PoissonSolver:
        """With these vertices as pins."""
        return dp.PoissonSolver(self.mesh, pins=self.held)

    def positions(self, code: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch p c"]:
        """Where the vertices are held, in float64."""
        amounts = self.amounts(code).double()
        return self.origin + torch.einsum("...k,kpc->...pc", amounts, self.moves)

    def solved(
        self, R: Float[Tensor, "*batch m c d"], code: Float[Tensor, "*batch z"]
    ) -> Float[Tensor, "*batch n c"]:
        """The map closest to given Jacobians among those that meet the handles."""
        return self.solver(R, pins=self.positions(code))

    @cached_property
    def rest(self) -> Float[Tensor, "n c"]:
        """The map closest to the identity if all amounts are nought, float64."""
        c = self.origin.shape[-1]
        return self.solver(self.mesh.frames.double()[:, :c], pins=self.origin)

    @cached_property
    def harmonic(self) -> Float[Tensor, "k n c"]:
        """What each amount adds to a map that keeps to given Jacobians: harmonic, float64."""
        k, _, c = self.moves.shape
        nought = self.moves.new_zeros(k, self.mesh.n_faces, c, self.mesh.cell_dim)
        return self.solver(nought, pins=self.moves)
