"""Laplacian eigenpairs of a shape, for networks that let functions on it diffuse."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp


class Spectrum(NamedTuple):
    """Laplacian eigenpairs of one connected shape of unit area.

    Attributes:
        values: (k,) λ, of which the first is zero.
        vectors: (n, k) Φ, orthonormal under the masses.
        masses: (n,) share of each vertex in the area.
    """

    values: Float[Tensor, "k"]
    vectors: Float[Tensor, "n k"]
    masses: Float[Tensor, "n"]

    @classmethod
    def of(
        cls, mesh: dp.Mesh, n_eigenpairs: int, solver: dp.PoissonSolver | None = None
    ) -> Spectrum:
        """The smallest eigenpairs of a mesh, in float32; its unit of length drops out.

        Args:
            mesh: the surface.
            n_eigenpairs: how many, no more than it has vertices.
            solver: its Poisson solver, made if omitted.
        """
        values, vectors = dp.laplacian_eigenpairs(mesh, n_eigenpairs, solver=solver)
        area = mesh.areas.double().sum()
        return cls(
            (values.double() * area).float(),
            (vectors.double() * area.sqrt()).float(),
            (mesh.vertex_areas.double() / area).float(),
        )

    def diffused(
        self, u: Float[Tensor, "n channels"], times: Float[Tensor, "channels"]
    ) -> Float[Tensor, "n channels"]:
        """Φ e^(-λ t) Φᵀ M u, each channel for its own time."""
        vectors, values, masses = (x.to(u.dtype) for x in (self.vectors, self.values, self.masses))
        coefficients = vectors.T @ (masses[:, None] * u)
        return vectors @ ((-values[:, None] * times).exp() * coefficients)
