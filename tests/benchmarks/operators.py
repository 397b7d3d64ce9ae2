"""The layers that every training step goes through: Poisson solve, gradient and its adjoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cholespy
import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

import diffpoisson as dp
from diffpoisson import cells, testing
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import gradient_operator, matrices_to_columns
from tests.benchmarks import limits
from tests.benchmarks.figures import Figure, Limit, cost, speed_up
from tests.benchmarks.harness import alternate, main


class BareLayer(NamedTuple):
    """The Poisson layer of a connected mesh as cholespy and CSR products alone, layouts as they
    come: what no implementation on them can do without.
    """

    solver: cholespy.CholeskySolverD
    divergence: Tensor
    adjoint: Tensor

    @classmethod
    def of(cls, mesh: dp.Mesh) -> BareLayer:
        divergence = gradient_operator(mesh).divergence_matrix[1:]
        solver = bare_solver(dp.laplacian(mesh)[1:, 1:])
        return cls(solver, csr(divergence), csr(divergence.T))

    def solve(self, b: Tensor) -> Tensor:
        x = torch.empty_like(b)
        self.solver.solve(b, x)
        return x

    def forward(self, columns: Tensor) -> Tensor:
        """(d·m, k) columns of R to (n - 1, k) columns of Φ."""
        return self.solve(self.divergence @ columns)

    def backward(self, grad: Tensor) -> Tensor:
        """(n - 1, k) to (d·m, k)."""
        return self.adjoint @ self.solve(grad)


def bare_solver(L: sp.spmatrix) -> cholespy.CholeskySolverD:
    """cholespy's solver of a matrix, nothing else."""
    coo = L.tocoo()
    arrays = coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data
    tensors = (torch.from_numpy(array) for array in arrays)
    return cholespy.CholeskySolverD(L.shape[0], *tensors, cholespy.MatrixType.COO)


def csr(matrix: sp.spmatrix, dtype: torch.dtype = torch.float64) -> Tensor:
    """A SciPy matrix in torch's CSR, with 32-bit indices."""
    matrix = matrix.tocsr()
    crow, col = (torch.from_numpy(a.astype(np.int32)) for a in (matrix.indptr, matrix.indices))
    values = torch.from_numpy(matrix.data).to(dtype)
    return torch.sparse_csr_tensor(crow, col, values, matrix.shape, check_invariants=False)


def csr_bytes(matrix: Tensor) -> int:
    """Bytes of a CSR matrix."""
    parts = matrix.crow_indices(), matrix.col_indices(), matrix.values()
    return sum(part.nbytes for part in parts)


def factor_bytes(mesh: dp.Mesh) -> int:
    """Bytes of the factor of a mesh's pinned Laplacian, by the heap that it takes."""
    L = dp.laplacian(mesh)[1:, 1:]
    kept, grown = limits.growth_of_heap(lambda: CholeskyFactor(L))
    del kept
    return grown - 12 * L.nnz - 4 * len(L.indptr)  # the copy of the matrix that pickling needs


# ------------------------------------------------------- Poisson layer


def poisson(quick: bool) -> Iterator[Figure]:
    """One map with three coordinates, forward and backward, in float64."""
    mesh = dp.Mesh(*testing.sphere(0, 2 if quick else 5))
    seconds, limit = _poisson(mesh, batch=(), turns=2 if quick else 15)
    yield cost(
        f"Poisson layer, forward + backward, {mesh.n_vertices:,} vertices, 3 columns",
        seconds,
        "two cholespy solves and their CSR products",
        1.15,
        limit=limit,
    )


def poisson_wide(quick: bool) -> Iterator[Figure]:
    """128 maps at once, against the bare wide solve, and one by one."""
    mesh = dp.Mesh(*testing.sphere(0, 2 if quick else 5))
    batch = 4 if quick else 128
    seconds, limit = _poisson(mesh, batch=(batch,), turns=2 if quick else 7)
    what = f"Poisson layer, {mesh.n_vertices:,} vertices, {batch} maps at once"
    wide = "two cholespy solves and their CSR products"
    yield speed_up(what, seconds, wide, 0.9, limit=limit)
    yield speed_up(what, seconds, "a loop of single solves")


def _poisson(
    mesh: dp.Mesh, batch: tuple[int, ...], turns: int
) -> tuple[dict[str, np.ndarray], Limit]:
    layer, bare = dp.PoissonSolver(mesh), BareLayer.of(mesh)
    R = torch.randn(*batch, mesh.n_faces, 3, 2, dtype=torch.float64, requires_grad=True)
    upstream = torch.randn(*batch, mesh.n_vertices, 3, dtype=torch.float64)
    columns = matrices_to_columns(R.detach())
    bare_upstream = upstream.movedim(-2, 0).reshape(mesh.n_vertices, -1)[1:].contiguous()
    _require_equal(layer(R), bare.forward(columns))

    def step(R: Tensor, upstream: Tensor) -> None:
        torch.autograd.grad(layer(R), R, upstream)

    def loop() -> None:
        for field, grad in zip(R.detach(), upstream, strict=True):
            step(field.requires_grad_(), grad)

    contestants: dict[str, Callable[[], object]] = {
        "ours": lambda: step(R, upstream),
        "two cholespy solves and their CSR products": lambda: (
            bare.forward(columns),
            bare.backward(bare_upstream),
        ),
    }
    if batch:
        contestants["a loop of single solves"] = loop
    seconds = dict(alternate(contestants, turns))
    return seconds, _solve_limit(mesh, bare, columns)


def _require_equal(phi: Tensor, bare: Tensor) -> None:
    """What is compared must be the same map, up to a translation."""
    ours = phi.detach().movedim(-2, 0).flatten(1)
    torch.testing.assert_close(ours[1:] - ours[:1], bare, rtol=1e-8, atol=1e-8)


def _solve_limit(mesh: dp.Mesh, bare: BareLayer, columns: Tensor) -> Limit:
    """What two solves read and write, or compute, whichever takes longer."""
    size = factor_bytes(mesh)
    field, phi = columns.nbytes, columns.nbytes * mesh.n_vertices // len(columns)
    moved = csr_bytes(bare.divergence) + csr_bytes(bare.adjoint) + 2 * field + 2 * phi
    traffic = 4 * size / limits.read_bandwidth(size) + moved / limits.bandwidth(moved)
    entries = size / 12  # a float64 and a 32-bit row index each
    operations = 4 * 2 * entries * columns.shape[1] / limits.peak_flops(torch.float64)
    read = f"factor of {size / 1e6:.1f} MB read four times, {moved / 1e6:.0f} MB moved"
    bounds = Limit(read, traffic), Limit("operations of the solves", operations)
    return max(bounds, key=lambda limit: limit.seconds)


# ------------------------------------------------------- gradient


def gradient(quick: bool) -> Iterator[Figure]:
    """∇ and its adjoint on 3 columns in float32: a mesh that fits the cache and one that does not.

    Peers: torch's sparse COO product, and gather with small matrices, scattered back by index_add.
    """
    for subdivisions in (2,) if quick else (5, 8):
        mesh = dp.Mesh(*testing.sphere(0, subdivisions))
        yield from _gradient(mesh, turns=2 if quick else 11)


def _gradient(mesh: dp.Mesh, turns: int) -> Iterator[Figure]:
    matrix = gradient_operator(mesh).matrix
    phi = torch.randn(mesh.n_vertices, 3)
    R = torch.randn(mesh.n_faces, 3, 2)
    columns = matrices_to_columns(R)
    coo, coo_T = (csr(A, torch.float32).to_sparse_coo().coalesce() for A in (matrix, matrix.T))
    hats = cells.hat_gradients(mesh._corners, mesh._double_frames).float()
    operator = gradient_operator(mesh)

    def scatter() -> Tensor:
        at_corners = (R @ hats).mT.reshape(-1, 3)
        return phi.new_zeros(mesh.n_vertices, 3).index_add(0, mesh.faces.flatten(), at_corners)

    torch.testing.assert_close(scatter(), coo_T @ columns, rtol=1e-3, atol=1e-3)
    works: dict[str, dict[str, Callable[[], object]]] = {
        "gradient": {
            "ours": lambda: dp.jacobians(mesh, phi),
            "torch sparse COO": lambda: coo @ phi,
            "gather": lambda: (hats @ phi[mesh.faces]).mT,
        },
        "adjoint": {
            "ours": lambda: operator.adjoint(columns),
            "torch sparse COO": lambda: coo_T @ columns,
            "index_add": scatter,
        },
    }
    for name, contestants in works.items():
        seconds = alternate(contestants, turns)
        what = f"{name}, {mesh.n_faces:,} faces, 3 columns, float32"
        stored = csr(matrix if name == "gradient" else matrix.T, torch.float32)
        traffic = csr_bytes(stored) + phi.nbytes + columns.nbytes
        limit = Limit(f"{traffic / 1e6:.1f} MB moved", traffic / limits.bandwidth(traffic))
        yield speed_up(what, seconds, "torch sparse COO", 5.0, limit=limit)
        yield speed_up(what, seconds, list(contestants)[-1], 2.0, limit=limit)
        bound = {"ours": seconds["ours"], "bandwidth": np.full(turns, limit.seconds)}
        yield speed_up(what, bound, "bandwidth", 0.4)


MEASUREMENTS = {"poisson": poisson, "poisson_wide": poisson_wide, "gradient": gradient}

if __name__ == "__main__":
    main("operators", MEASUREMENTS)
