"""The Poisson layer: the map whose Jacobians are closest to given ones, Φ = L⁻¹ ∇ᵀA R.

    Φ = argmin Σⱼ |tⱼ| ‖(∇Φ)ⱼ - Rⱼ‖²   ⟺   L Φ = ∇ᵀA R,  L = ∇ᵀA∇        (paper, Poisson system)

The minimiser is unique up to one translation per connected component. Eliminating one vertex of
each component leaves a positive definite matrix, factorised once; the gauge then fixes the
translations.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffpoisson.factor import BlockDiagonal, CholeskyFactor
from diffpoisson.gradient import (
    SparseMatrix,
    as_intrinsic,
    columns_to_vertices,
    gradient_operator,
    matrices_to_columns,
)
from diffpoisson.linear_map import LinearMap, Matrix
from diffpoisson.mesh import Mesh

Gauge = Literal["mean", "vertex"]


class PoissonSolver:
    """A mesh's Laplacian, factorised once, to turn Jacobian fields into maps differentiably.

    Args:
        mesh: the domain; any number of components.
        gauge: what fixes the translation of each connected component: `"mean"`, its area-weighted
            mean is zero, or `"vertex"`, its vertex of lowest index (its anchor) maps to zero.

    Attributes:
        mesh: the domain.
        gauge: as given.
    """

    def __init__(self, mesh: Mesh, *, gauge: Gauge = "mean") -> None:
        anchors = _first_of_each(mesh.components.cpu().numpy())
        free = np.setdiff1d(np.arange(mesh.n_vertices), anchors)
        operator = gradient_operator(mesh)
        factor = CholeskyFactor(operator.laplacian[free][:, free], mesh.device)
        self._assign(mesh, gauge, factor, free, operator.divergence_matrix[free])

    def _assign(
        self, mesh: Mesh, gauge: Gauge, factor: Matrix, free: np.ndarray, divergence: sp.csr_matrix
    ) -> None:
        if gauge not in ("mean", "vertex"):
            raise ValueError(f"PoissonSolver: gauge must be 'mean' or 'vertex', got {gauge!r}")
        self.mesh, self.gauge = mesh, gauge
        self._factor, self._free, self._divergence_matrix = factor, free, divergence
        self._free_index = torch.from_numpy(free).to(mesh.device)
        self._divergence = LinearMap(SparseMatrix(divergence, mesh.device))
        self._inverse = LinearMap(factor)
        # Computed here, not at first use: torch.compile cannot trace what fills a cache.
        self._labels, _ = mesh.components, mesh._double_frames
        self._mean_weights = _shares(mesh._double_vertex_areas, self._labels)

    @classmethod
    def concatenate(cls, solvers: Sequence[PoissonSolver]) -> PoissonSolver:
        """The solver of the disjoint union of the meshes, reusing their factors.

        Raises:
            ValueError: the solvers have different gauges.
            MeshError: the meshes differ in dimension, dtype or device.
        """
        gauges = {solver.gauge for solver in solvers}
        if len(gauges) != 1:
            raise ValueError(
                f"PoissonSolver.concatenate: expected one common gauge, got {sorted(gauges)}"
            )
        mesh = Mesh.concatenate([solver.mesh for solver in solvers])
        starts = np.cumsum([0] + [solver.mesh.n_vertices for solver in solvers])
        union = object.__new__(cls)
        union._assign(
            mesh,
            gauges.pop(),
            BlockDiagonal([solver._factor for solver in solvers]),
            np.concatenate([s._free + start for s, start in zip(solvers, starts, strict=False)]),
            sp.block_diag([solver._divergence_matrix for solver in solvers], format="csr"),
        )
        return union

    def __call__(self, R: Float[Tensor, "*batch m c k"]) -> Float[Tensor, "*batch n c"]:
        """The map whose Jacobians are closest to R in the area-weighted least-squares sense.

        Args:
            R: (…, m, c, 2) in the coordinates of `mesh.frames`, or (…, m, c, D) on ambient vectors;
                only their restriction to the tangent planes matters. float32 or float64; solved in
                float64.

        Returns:
            (…, n, c) images of the vertices, in the dtype of R.

        Raises:
            ValueError: R does not have one such matrix per face.
        """
        R = as_intrinsic("PoissonSolver", self.mesh, R)
        b = self._divergence(matrices_to_columns(R.double()))
        phi = self._fix_gauge(self._anchored(self._inverse(b)))
        return columns_to_vertices(phi, R.shape).to(R.dtype)

    def solve_laplacian(self, b: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """The solution of L x = b that is zero at the vertex of lowest index of each component.

        Args:
            b: (n, k) right-hand sides that sum to zero over each component, or no solution exists;
                the rows of the anchors are not read.
        """
        if b.ndim != 2 or len(b) != self.mesh.n_vertices:
            raise ValueError(
                f"solve_laplacian: expected b of shape (n={self.mesh.n_vertices}, k), "
                f"got {tuple(b.shape)}"
            )
        return self._anchored(self._inverse(b[self._free_index].double())).to(b.dtype)

    def _anchored(self, x: Float[Tensor, "free k"]) -> Float[Tensor, "n k"]:
        """Values at the free vertices, zero at the anchors."""
        zeros = x.new_zeros(self.mesh.n_vertices, x.shape[1])
        return zeros.index_copy(0, self._free_index, x)

    def _fix_gauge(self, phi: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        if self.gauge == "vertex":
            return phi  # the anchors are at zero already
        means = phi.new_zeros(self.mesh.n_components, phi.shape[1])
        means = means.index_add(0, self._labels, self._mean_weights[:, None] * phi)
        return phi - means.index_select(0, self._labels)

    def __repr__(self) -> str:
        return f"PoissonSolver({self.mesh}, gauge={self.gauge!r})"


def solve_poisson(
    mesh: Mesh, R: Float[Tensor, "*batch m c k"], *, gauge: Gauge = "mean"
) -> Float[Tensor, "*batch n c"]:
    """One-shot `PoissonSolver(mesh, gauge=gauge)(R)`; keep the solver to solve more than once."""
    return PoissonSolver(mesh, gauge=gauge)(R)


def _shares(sizes: Float[Tensor, "n"], labels: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Each size as a share of the total of its label."""
    totals = sizes.new_zeros(int(labels.max()) + 1).index_add(0, labels, sizes)
    return sizes / totals[labels]


def _first_of_each(labels: np.ndarray) -> np.ndarray:
    """Lowest index that carries each label."""
    return np.unique(labels, return_index=True)[1]
