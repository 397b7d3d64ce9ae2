"""The gradient ∇ of piecewise-linear maps, its adjoint ∇ᵀA, and the cotangent Laplacian L = ∇ᵀA∇.

∇ maps vertex values to one tangent vector per face (paper, eq. 2: Jᵢ = Φ∇ᵢᵀ). Its entries are the
gradients of the cells' hat functions. For a mesh as it is, ∇ is a constant sparse matrix; for
positions given as an argument it is applied cell by cell, differentiably in the positions too.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson import cells
from diffpoisson.arguments import require_single_or_double, require_tensor
from diffpoisson.intrinsic import intrinsic_delaunay_laplacian
from diffpoisson.linear_map import BlockDiagonal, LinearMap, Matrix
from diffpoisson.mesh import Mesh, require_cells, require_mesh
from diffpoisson.restriction import extend, restrict
from diffpoisson.transforms import concrete, constant_property, outside_transforms


class SparseMatrix(Matrix):
    """A constant CSR matrix, multiplied in the dtype of the operand."""

    def __init__(self, matrix: sp.csr_matrix, device: torch.device) -> None:
        self.shape = matrix.shape
        self.scipy = matrix
        self._device = device
        self._by_dtype: dict[torch.dtype, Tensor] = {}

    def multiply(self, x: Float[Tensor, "cols k"]) -> Float[Tensor, "rows k"]:
        """A x."""
        # Into given memory: A @ x would clear that first and copy it once more, and autocast would
        # round geometry to half precision behind the caller's back.
        y = x.new_empty(self.shape[0], x.shape[1])
        return torch.addmm(y, self._in(x.dtype), x, beta=0, out=y)

    def transposed(self) -> SparseMatrix:
        """Aᵀ, stored as CSR too: multiplying by a transposed view is 50 times slower."""
        return self._transposed

    @cached_property
    def _transposed(self) -> SparseMatrix:
        return SparseMatrix(self.scipy.T.tocsr(), self._device)

    def __reduce__(self) -> tuple[Any, ...]:
        return SparseMatrix, (self.scipy, self._device)

    def _in(self, dtype: torch.dtype) -> Tensor:
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(
                f"mesh operators work in float32 and float64, got {dtype}; convert first"
            )
        if dtype not in self._by_dtype:
            self._by_dtype[dtype] = _to_torch(self.scipy, dtype, self._device)
        return self._by_dtype[dtype]


def _to_torch(matrix: sp.csr_matrix, dtype: torch.dtype, device: torch.device) -> Tensor:
    arrays = (matrix.indptr, matrix.indices, matrix.data)
    crow, col, values = (torch.from_numpy(np.ascontiguousarray(a)) for a in arrays)
    with warnings.catch_warnings():
        # torch says once per process that its CSR layout is in beta; users of a mesh can't act on
        # it.
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta")
        return torch.sparse_csr_tensor(
            crow.int(),  # MKL's kernels take 32-bit indices as they are
            col.int(),
            values.to(dtype),
            matrix.shape,
            device=device,
            check_invariants=False,  # SciPy built it
        )


def _to_scipy(gradient: Matrix) -> sp.csr_matrix:
    if isinstance(gradient, BlockDiagonal):
        d = gradient.planes[0]
        planes = zip(*(_planes(_to_scipy(block), d) for block in gradient.blocks), strict=True)
        return sp.vstack([sp.block_diag(plane) for plane in planes], format="csr")
    assert isinstance(gradient, SparseMatrix)
    return gradient.scipy


def _planes(matrix: sp.csr_matrix, d: int) -> list[sp.csr_matrix]:
    """The rows of each direction."""
    m = matrix.shape[0] // d
    return [matrix[i * m : (i + 1) * m] for i in range(d)]


class GradientOperator:
    """∇ of one mesh and what is made of it, assembled once; see `gradient_operator`.

    Attributes:
        gradient: ∇ as a differentiable map, (n, ·) to (d·m, ·).
        adjoint: ∇ᵀ as a differentiable map, (d·m, ·) to (n, ·).
        weights: (d·m, 1) float64 measure of the cell of each row: the diagonal of A.
    """

    def __init__(self, mesh: Mesh, gradient: SparseMatrix | BlockDiagonal) -> None:
        self._gradient = gradient
        self.gradient = LinearMap(gradient)
        self.adjoint = self.gradient.T
        self.weights = mesh._double_measures.repeat(mesh.cell_dim)[:, None]

    @constant_property
    def matrix(self) -> sp.csr_matrix:
        """∇ as a SciPy matrix (d·m, n), float64; row m·i + j is direction i on face j."""
        return _to_scipy(self._gradient)

    @constant_property
    def divergence_matrix(self) -> sp.csr_matrix:
        """∇ᵀA as a SciPy matrix (n, d·m)."""
        weighted = self.matrix.copy()
        weighted.data *= np.repeat(self.weights[:, 0].cpu().numpy(), np.diff(weighted.indptr))
        return weighted.T.tocsr()

    @constant_property
    def laplacian(self) -> sp.csr_matrix:
        """L = ∇ᵀA∇ as a SciPy matrix (n, n)."""
        return (self.divergence_matrix @ self.matrix).tocsr()


_operators: WeakKeyDictionary[Mesh, GradientOperator] = WeakKeyDictionary()


def gradient_operator(mesh: Mesh) -> GradientOperator:
    """The mesh's operators, assembled at the first call and kept as long as the mesh lives."""
    if mesh not in _operators:
        if torch.compiler.is_compiling():
            raise RuntimeError(
                "the operators of this mesh are not assembled yet, and torch.compile cannot trace "
                "that; make a PoissonSolver of the mesh, or call the function once, before "
                "compiled code runs"
            )
        with outside_transforms():
            gradient = SparseMatrix(_gradient_matrix(mesh), mesh.device)
            _operators[mesh] = GradientOperator(mesh, gradient)
    return _operators[mesh]


def concatenate_operators(union: Mesh, parts: Sequence[Mesh]) -> None:
    """Keep for the disjoint union of meshes what was assembled for them."""
    blocks = [gradient_operator(part)._gradient for part in parts]
    with outside_transforms():
        _operators[union] = GradientOperator(union, BlockDiagonal(blocks, (union.cell_dim, 1)))


def jacobians(
    mesh: Mesh,
    phi: Float[Tensor, "*batch n c"],
    *,
    extrinsic: bool = False,
    vertices: Float[Tensor, "n D"] | None = None,
) -> Float[Tensor, "*batch m c d"]:
    """Jacobian of a piecewise-linear map on each face (paper, eq. 2).

    Args:
        mesh: the domain.
        phi: (…, n, c) float32 or float64 image of each vertex, c output coordinates.
        extrinsic: return J Bᵀ, acting on ambient vectors (zero along the normal), instead of J.
        vertices: (n, D) positions to use instead of the mesh's, to differentiate by. (Under vmap
            and torch.compile they are not checked, and flat cells give infinities or NaN.)

    Returns:
        (…, m, c, d) in the coordinates of the faces' frames, d = 2 for triangles and 3 for
        tetrahedra, or (…, m, c, D) if extrinsic; row = output coordinate, column = tangent
        direction. Dimensionless if the image has the mesh's units. In the dtype of phi.

    Raises:
        ValueError: phi does not have one row per vertex, or is on another device.
        TypeError: phi is not a float32 or float64 tensor.
        MeshError: a cell is flat at the given positions.
    """
    _require("jacobians", mesh, "phi", phi, vertices)
    if phi.ndim < 2 or phi.shape[-2] != mesh.n_vertices:
        raise ValueError(
            f"jacobians: expected phi of shape (…, n={mesh.n_vertices}, c), got {tuple(phi.shape)}"
        )
    if vertices is not None:
        geometry = CellGeometry.at(mesh, vertices)
        J = geometry.gradient(phi.double())
        return (extend(J, geometry.frames) if extrinsic else J).to(phi.dtype)
    columns = gradient_operator(mesh).gradient(vertices_to_columns(phi))
    J = columns_to_matrices(columns, phi.shape, mesh.cell_dim)
    return extend(J, mesh._double_frames) if extrinsic else J


def divergence(
    mesh: Mesh,
    R: Float[Tensor, "*batch m c k"],
    *,
    vertices: Float[Tensor, "n D"] | None = None,
) -> Float[Tensor, "*batch n c"]:
    """∇ᵀA R, the adjoint of the gradient in the area-weighted inner product.

    This is the integrated divergence with the sign of an adjoint: ⟨∇ᵀA R, Φ⟩ = Σ |tⱼ| ⟨Rⱼ, (∇Φ)ⱼ⟩.

    Args:
        mesh: the domain.
        R: (…, m, c, d) in the coordinates of the faces' frames, or (…, m, c, D) on ambient vectors.
        vertices: (n, D) positions to use instead of the mesh's, to differentiate by; intrinsic R
            stays what it is in the coordinates of the moving frames.

    Raises:
        ValueError: R does not have one such matrix per face, or is on another device.
        TypeError: R is not a float32 or float64 tensor.
        MeshError: a cell is flat at the given positions.
    """
    _require("divergence", mesh, "R", R, vertices)
    if vertices is not None:
        geometry = CellGeometry.at(mesh, vertices)
        intrinsic = as_intrinsic("divergence", mesh, R.double(), geometry.frames)
        return geometry.divergence(intrinsic).to(R.dtype)
    R = as_intrinsic("divergence", mesh, R, mesh._double_frames)
    operator, columns = gradient_operator(mesh), matrices_to_columns(R)
    return columns_to_vertices(operator.adjoint(operator.weights.to(R.dtype) * columns), R.shape)


def laplacian(mesh: Mesh, *, intrinsic_delaunay: bool = False) -> sp.csr_matrix:
    """The cotangent Laplacian L = ∇ᵀA∇, (n, n), symmetric positive semi-definite, float64.

    Args:
        mesh: the domain.
        intrinsic_delaunay: that of the surface's intrinsic Delaunay triangulation instead, see
            `intrinsic.py`: better on thin, obtuse faces. Not for fitting Jacobians, which belong to
            the original faces: only L itself reproduces the map that they came from.

    Raises:
        MeshError: tetrahedra, or very thin faces, with intrinsic_delaunay.
    """
    require_mesh("laplacian", mesh)
    if intrinsic_delaunay:
        return intrinsic_delaunay_laplacian(mesh)
    return gradient_operator(mesh).laplacian.copy()


def _require(operation: str, mesh: Mesh, name: str, field: Tensor, vertices: Tensor | None) -> None:
    require_mesh(operation, mesh)
    require_tensor(operation, name, field, mesh.device)
    require_single_or_double(operation, name, field)
    if vertices is not None:
        require_tensor(operation, "vertices", vertices, mesh.device)
        require_single_or_double(operation, "vertices", vertices)
        if vertices.shape != mesh.vertices.shape:
            raise ValueError(
                f"{operation}: expected vertices of shape {tuple(mesh.vertices.shape)}, "
                f"got {tuple(vertices.shape)}"
            )
        require_cells(operation, concrete(vertices), mesh.faces)


def as_intrinsic(
    operation: str, mesh: Mesh, R: Float[Tensor, "*batch m c k"], frames: Float[Tensor, "m D d"]
) -> Float[Tensor, "*batch m c d"]:
    """R in frame coordinates, restricted if it acts on ambient vectors; any other shape raises."""
    D, d = mesh.dim, mesh.cell_dim
    if R.ndim < 3 or R.shape[-3] != mesh.n_faces or R.shape[-1] not in (d, D):
        sizes = " or ".join(str(size) for size in sorted({d, D}))
        raise ValueError(
            f"{operation}: expected one matrix per face, (…, m={mesh.n_faces}, c, {sizes}), "
            f"got {tuple(R.shape)}"
        )
    return R if R.shape[-1] == d else restrict(R, frames)


class CellGeometry(NamedTuple):
    """The gradient at given positions, cell by cell: differentiable in field and positions.

    Attributes:
        mesh: the cells, at whatever positions.
        hats: (m, d, k) hat gradients, in frame coordinates.
        frames: (m, D, d) tangent bases.
        measures: (m,) areas or volumes.
    """

    mesh: Mesh
    hats: Float[Tensor, "m d k"]
    frames: Float[Tensor, "m D d"]
    measures: Float[Tensor, "m"]

    @classmethod
    def at(cls, mesh: Mesh, vertices: Float[Tensor, "n D"]) -> CellGeometry:
        """The geometry of a mesh's cells at other positions, in float64."""
        corners = vertices.double()[mesh.faces]
        determinant = cells.determinants(corners)
        frames = cells.frames(corners, determinant)
        hats = cells.hat_gradients(corners, frames, determinant)
        return cls(mesh, hats, frames, cells.measures(corners, determinant))

    def gradient(self, phi: Float[Tensor, "*batch n c"]) -> Float[Tensor, "*batch m c d"]:
        """∇Φ on each cell."""
        return (self.hats @ phi[..., self.mesh.faces, :]).mT

    def divergence(
        self, R: Float[Tensor, "*batch m c d"], weights: Float[Tensor, "m"] | None = None
    ) -> Float[Tensor, "*batch n c"]:
        """∇ᵀA R at each vertex, with the weights, if any, in A."""
        A = self.measures if weights is None else self.measures * weights
        at_corners = A[:, None, None] * (R @ self.hats).mT  # (…, m, k, c)
        zeros = at_corners.new_zeros(*R.shape[:-3], self.mesh.n_vertices, R.shape[-2])
        return zeros.index_add(-2, self.mesh.faces.flatten(), at_corners.flatten(-3, -2))

    def stiffness(self, weights: Float[Tensor, "m"]) -> Float[Tensor, "m k k"]:
        """The matrix of each cell in L = ∇ᵀA∇, with the weights in A."""
        return (self.measures * weights)[:, None, None] * (self.hats.mT @ self.hats)

    def vertex_measures(self) -> Float[Tensor, "n"]:
        """An equal share of the measure of each cell around a vertex."""
        shares = self.measures[:, None] / self.mesh.faces.shape[1]
        return self.mesh.sum_at_vertices(shares)[:, 0]


# ------------------------------------------------------- fields as columns, for sparse products


def vertices_to_columns(phi: Float[Tensor, "*batch n c"]) -> Float[Tensor, "n k"]:
    """Batch and output coordinates side by side: (…, n, c) to (n, …·c)."""
    return phi.movedim(-2, 0).flatten(1)


def columns_to_vertices(
    columns: Float[Tensor, "n k"], shape: torch.Size
) -> Float[Tensor, "*batch n c"]:
    """Back to (…, n, c), given the shape (…, m, c, d) of the matrices the columns came from."""
    return columns.unflatten(1, (*shape[:-3], shape[-2])).movedim(0, -2)


def matrices_to_columns(R: Float[Tensor, "*batch m c d"]) -> Float[Tensor, "rows k"]:
    """(…, m, c, d) to (d·m, …·c), row m·i + j is direction i on face j."""
    m, d = R.shape[-3], R.shape[-1]
    return R.movedim((-1, -3), (0, 1)).reshape(d * m, math.prod(R.shape[:-3]) * R.shape[-2])


def columns_to_matrices(
    columns: Float[Tensor, "rows k"], shape: torch.Size, d: int
) -> Float[Tensor, "*batch m c d"]:
    """(d·m, …·c) back to (…, m, c, d), given the shape (…, n, c) of the map it came from."""
    return (
        columns.unflatten(1, (*shape[:-2], shape[-1]))
        .unflatten(0, (d, -1))
        .movedim((0, 1), (-1, -3))
    )


# ------------------------------------------------------- assembly


def _gradient_matrix(mesh: Mesh) -> sp.csr_matrix:
    """∇ as (d·m, n): row m·i + j holds component i of the hat gradients of face j."""
    d, k = mesh.cell_dim, mesh.cell_dim + 1
    hats = cells.hat_gradients(mesh._corners, mesh._double_frames, mesh._determinants)  # (m, d, k)
    values = hats.movedim(1, 0).cpu().numpy()
    columns = np.tile(mesh.faces.cpu().numpy(), (d, 1))
    rows = np.arange(0, values.size + 1, k)
    shape = (d * mesh.n_faces, mesh.n_vertices)
    matrix = sp.csr_matrix((values.ravel(), columns.ravel(), rows), shape=shape)
    matrix.sort_indices()
    return matrix
