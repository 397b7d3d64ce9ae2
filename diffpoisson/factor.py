"""Cached sparse Cholesky factors: the only file that knows cholespy, and closes its traps."""

from __future__ import annotations

import weakref
from typing import Any

import cholespy
import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.linear_map import Matrix

# Of one call: cholespy's limit on CUDA. CHOLMOD solves four columns at a time whatever it is given;
# beyond a few times four, their work space only takes the cache from the factor.
_COLUMNS = {"cuda": 128, "cpu": 8}


class CholeskyFactor(Matrix):
    """A⁻¹ of a symmetric positive definite matrix A, through its sparse factorisation A = L Lᵀ.

    Factorised once, in float64, on the CPU (CHOLMOD, nested dissection); solves run on `device`.
    Pickling and copying carry the matrix and factorise again.

    Args:
        matrix: (n, n) sparse, symmetric positive definite; only real, finite entries.
        device: where right-hand sides will live.

    Raises:
        ValueError: not square, not finite, or not positive definite.
    """

    def __init__(self, matrix: sp.spmatrix, device: torch.device | str = "cpu") -> None:
        rows, cols = matrix.shape
        if rows != cols:
            raise ValueError(f"CholeskyFactor: expected a square matrix, got shape {matrix.shape}")
        # cholespy accepts NaN silently, and with its CSC input it edits the caller's memory: give
        # it COO.
        csr = matrix.tocsr(copy=True)
        csr.sum_duplicates()
        coo = csr.tocoo(copy=False)
        if not np.isfinite(coo.data).all():
            raise ValueError("CholeskyFactor: the matrix has entries that are not finite")
        self.shape = (rows, cols)
        self._recipe = (csr, device)
        self._device = torch.device(device)
        arrays = (coo.row.astype(np.int32), coo.col.astype(np.int32), coo.data.astype(np.float64))
        try:
            solver = cholespy.CholeskySolverD(
                rows, *(torch.from_numpy(a).to(device) for a in arrays), cholespy.MatrixType.COO
            )
        except (ValueError, RuntimeError) as error:
            raise ValueError(
                f"CholeskyFactor: the matrix is not positive definite: {error}"
            ) from error
        self._handle = _Handle(solver, rows, self._device)
        # Also runs at exit, where nanobind would complain of solvers that are still alive.
        weakref.finalize(self, self._handle.close)

    def multiply(self, x: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """A⁻¹ x by forward and back substitution, in float64 inside."""
        # cholespy checks no row count (it would read past the end) and rejects views: both end
        # here.
        if x.ndim != 2 or len(x) != self.shape[0]:
            raise ValueError(
                f"CholeskyFactor: expected x of shape ({self.shape[0]}, k), got {tuple(x.shape)}"
            )
        if x.device != self._device:
            raise ValueError(f"CholeskyFactor: x is on {x.device}, the factor on {self._device}")
        width = _COLUMNS[x.device.type]
        if x.shape[1] <= width:
            return self._solve(x).to(x.dtype)
        return torch.cat([self._solve(chunk) for chunk in x.split(width, dim=1)], dim=1).to(x.dtype)

    def _solve(self, b: Tensor) -> Tensor:
        return self._handle.solve(b.detach().double().contiguous())

    def transposed(self) -> CholeskyFactor:
        """Itself: A is symmetric."""
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return CholeskyFactor, self._recipe


class _Handle:
    """A solver of cholespy, and the clean-up that it needs."""

    def __init__(self, solver: Any, n: int, device: torch.device) -> None:
        self._solver, self._n, self._device = solver, n, device
        self._has_work_space = False

    def solve(self, b: Tensor) -> Tensor:
        """A⁻¹ b of contiguous float64 columns."""
        x = torch.empty_like(b)
        if b.shape[1]:
            self._solver.solve(b, x)
            self._has_work_space = self._device.type == "cpu"
        return x

    def close(self) -> None:
        """Drop the solver, and before that the work space of its last solve, which it would leak.

        cholespy frees it when the next right-hand side has another width; one of width 0 needs none
        itself. (Without a solve before, that call would crash.)
        """
        if self._has_work_space:
            # NumPy's: garbage is collected at any time, also inside a transform that wraps tensors.
            nothing = np.empty((self._n, 0))
            self._solver.solve(nothing, np.empty_like(nothing))
        self._solver = None
