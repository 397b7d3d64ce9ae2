"""Laplacian eigenpairs and vertex gradients of a shape, for networks that diffuse on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from diffpoisson.gradient import SparseMatrix, gradient_operator
from diffpoisson.linear_map import LinearMap


class Spectrum(NamedTuple):
    """Laplacian eigenpairs and gradients at the vertices of one shape of unit area.

    Attributes:
        values: (k,) λ, of which the first is zero.
        vectors: (n, k) Φ, orthonormal under the masses.
        masses: (n,) share of each vertex in the area.
        gradient: (3n, n) values at the vertices to gradients there, row n·i + j coordinate i at
            vertex j: the mean over the faces around it, weighted by area.
        normals: (n, 3) unit normals of the vertices.
    """

    values: Float[Tensor, "k"]
    vectors: Float[Tensor, "n k"]
    masses: Float[Tensor, "n"]
    gradient: LinearMap
    normals: Float[Tensor, "n 3"]

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
            LinearMap(SparseMatrix(_vertex_gradient(mesh), mesh.device)),
            mesh.vertex_normals.float(),
        )

    def gradients(self, u: Float[Tensor, "n channels"]) -> Float[Tensor, "3 n channels"]:
        """Of each channel, in the pose and orientation of the mesh."""
        return self.gradient(u).unflatten(0, (3, -1))

    def diffused(
        self, u: Float[Tensor, "n channels"], times: Float[Tensor, "channels"]
    ) -> Float[Tensor, "n channels"]:
        """Φ e^(-λ t) Φᵀ M u, each channel for its own time."""
        vectors, values, masses = (x.to(u.dtype) for x in (self.vectors, self.values, self.masses))
        coefficients = vectors.T @ (masses[:, None] * u)
        return vectors @ ((-values[:, None] * times).exp() * coefficients)


def _vertex_gradient(mesh: dp.Mesh) -> sp.csr_matrix:
    """Gradients on faces, in space, averaged to vertices; of the mesh at unit area."""
    m, n = mesh.n_faces, mesh.n_vertices
    areas, frames = mesh.areas.double().numpy(), mesh.frames.double().numpy()
    corner, face = mesh.faces.numpy().ravel(), np.repeat(np.arange(m), 3)
    weights = areas[face] / (3 * mesh.vertex_areas.double().numpy()[corner])
    mean = sp.csr_matrix((weights, (corner, face)), shape=(n, m))
    along = gradient_operator(mesh).matrix  # its rows are those of the first direction, then second
    to_space = sp.bmat(
        [[sp.diags(frames[:, i, d]) for d in range(2)] for i in range(3)], format="csr"
    )
    every = sp.block_diag([mean] * 3, format="csr")
    return (np.sqrt(areas.sum()) * every @ to_space @ along).tocsr()
