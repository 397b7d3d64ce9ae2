"""Linear maps x ↦ A x and solves b ↦ A⁻¹ b as torch ops that every torch transform understands.

Gradient, divergence and the Poisson solve are linear in the field, so they share one op. Its
derivative is the map itself and its adjoint is the map of Aᵀ, which each `LinearMap` carries along;
since both are again this op, derivatives of any order and in any mode follow:

    y = A x        ẏ = A ẋ (forward mode)        x̄ = Aᵀ ȳ (reverse mode)

A second op is the solve when the matrix moves too. Its derivatives are solves with the same A:

    A x = b        ẋ = A⁻¹ (ḃ - Ȧ x)             b̄ = A⁻ᵀ x̄,  Ā = -b̄ xᵀ

No public torch API gives all of backward of any order, `torch.func` transforms in any nesting,
`vmap` and `torch.compile(fullgraph=True)` at once (torch 2.13), hence this file, and only this
file, uses private ones; docs/linear_map.md says which, why, and what would replace them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch._library.opaque_object import OpaqueBase, get_opaque_type_name, register_opaque_type
from torch.autograd import forward_ad


class Matrix(ABC):
    """What a `LinearMap` needs to know of A: how to multiply dense columns, and its transpose."""

    shape: tuple[int, int]

    @abstractmethod
    def multiply(self, x: Float[Tensor, "cols k"]) -> Float[Tensor, "rows k"]:
        """A x in the dtype of x; never traced, so any library may do the work."""

    @abstractmethod
    def transposed(self) -> Matrix:
        """Aᵀ."""


class BlockDiagonal(Matrix):
    """A block-diagonal matrix, multiplied block by block: a union's, of its parts'.

    Args:
        blocks: the matrices of the parts.
        planes: rows and columns may come in several planes, each of which holds its part of every
            block: (2, 1) for a gradient, whose rows are those of all faces in the first direction,
            then those in the second.
    """

    def __init__(self, blocks: Sequence[Matrix], planes: tuple[int, int] = (1, 1)) -> None:
        self.blocks, self.planes = blocks, planes
        self._columns = [block.shape[1] // planes[1] for block in blocks]
        rows, columns = zip(*(block.shape for block in blocks), strict=True)
        self.shape = (sum(rows), sum(columns))

    def multiply(self, x: Float[Tensor, "cols k"]) -> Float[Tensor, "rows k"]:
        """A x."""
        rows, columns = self.planes
        pieces = x.unflatten(0, (columns, -1)).split(self._columns, dim=1)
        products = [
            A.multiply(piece.flatten(0, 1)).unflatten(0, (rows, -1))
            for A, piece in zip(self.blocks, pieces, strict=True)
        ]
        return torch.cat(products, dim=1).flatten(0, 1)

    def transposed(self) -> BlockDiagonal:
        """Aᵀ."""
        return BlockDiagonal([block.transposed() for block in self.blocks], self.planes[::-1])


class Product(Matrix):
    """A₁ A₂ ⋯, applied from the right and never formed; in float64 inside."""

    def __init__(self, factors: Sequence[Matrix]) -> None:
        self.factors = factors
        self.shape = (factors[0].shape[0], factors[-1].shape[1])

    def multiply(self, x: Float[Tensor, "cols k"]) -> Float[Tensor, "rows k"]:
        """A₁ A₂ ⋯ x."""
        y = x.double()
        for A in reversed(self.factors):
            y = A.multiply(y)
        return y.to(x.dtype)

    def transposed(self) -> Product:
        """⋯ A₂ᵀ A₁ᵀ."""
        return Product([A.transposed() for A in reversed(self.factors)])


class _Handle(OpaqueBase):
    """A matrix, or the transpose of one, as the dispatcher sees it: an opaque constant."""

    def __init__(self, matrix: Matrix, transposed: bool = False) -> None:
        self._matrix, self._transposed = matrix, transposed

    @cached_property
    def matrix(self) -> Matrix:
        """The matrix; a transpose is made at its first use, since some maps need none."""
        return self._matrix.transposed() if self._transposed else self._matrix


class LinearMap:
    """The differentiable map x ↦ A x of a constant matrix A, on (cols, k) dense columns."""

    def __init__(self, matrix: Matrix) -> None:
        self.shape = matrix.shape
        self._handles = (_Handle(matrix), _Handle(matrix, transposed=True))

    def __call__(self, x: Float[Tensor, "cols k"]) -> Float[Tensor, "rows k"]:
        """A x, in the dtype and on the device of x."""
        return _apply(*self._handles, x, *self.shape)

    @property
    def T(self) -> LinearMap:
        """The adjoint map x ↦ Aᵀ x."""
        adjoint = object.__new__(LinearMap)
        adjoint.shape, adjoint._handles = self.shape[::-1], self._handles[::-1]
        return adjoint


class CellwiseInverse:
    """The differentiable solve of A x = b where A moves with its cells: (A, b) ↦ A⁻¹ b.

    A = Σₑ Pₑᵀ Kₑ Pₑ + a constant, symmetric, where Pₑ picks the unknowns of cell e. Only the factor
    of A knows its value; the cell matrices Kₑ are read by no solve, but derivatives by them are
    exact to any order and in any mode.

    Args:
        inverse: A⁻¹ at the values of the cell matrices.
        cells: (m, k) the unknowns of each cell; n, the size of A, stands for none.
    """

    def __init__(self, inverse: Matrix, cells: Int[Tensor, "m k"]) -> None:
        self._handle, self._cells = _Handle(inverse), cells

    def __call__(self, K: Float[Tensor, "m k k"], b: Float[Tensor, "n c"]) -> Float[Tensor, "n c"]:
        """A⁻¹ b.

        Raises:
            ValueError: a batch of matrices under vmap, which one factor cannot solve.
        """
        return _solve(self._handle, self._cells, K, b)


# ------------------------------------------------------- y = A x


def _kernel(A: _Handle, A_transposed: _Handle, x: Tensor, rows: int, cols: int) -> Tensor:
    if x.ndim != 2 or x.shape[0] != cols:
        raise ValueError(
            f"linear map of shape ({rows}, {cols}): expected x of shape ({cols}, k), "
            f"got {tuple(x.shape)}"
        )
    return A.matrix.multiply(x)


def _fake(A: _Handle, A_transposed: _Handle, x: Tensor, rows: int, cols: int) -> Tensor:
    return x.new_empty((rows, x.shape[1]))


def _vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
    """A batch of fields is one field with more columns: still a single multiplication."""
    A, A_transposed, x, rows, cols = args
    x = x.movedim(in_dims[2], 1)
    y = _apply(A, A_transposed, x.flatten(1), rows, cols)
    return y.reshape(rows, *x.shape[1:]), 1


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(A: _Handle, A_transposed: _Handle, x: Tensor, rows: int, cols: int) -> Tensor:
        with _one_level_below():
            return _apply(A, A_transposed, x, rows, cols)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.A, ctx.A_transposed, _, ctx.rows, ctx.cols = inputs

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor, None, None]:
        # ⟨ȳ, A ẋ⟩ = ⟨Aᵀ ȳ, ẋ⟩ for every ẋ, hence x̄ = Aᵀ ȳ.
        return None, None, _apply(ctx.A_transposed, ctx.A, grad, ctx.cols, ctx.rows), None, None

    @staticmethod
    def jvp(ctx: Any, _A: None, _A_transposed: None, tangent: Tensor, *_: None) -> Tensor:
        return _apply(ctx.A, ctx.A_transposed, tangent, ctx.rows, ctx.cols)


# ------------------------------------------------------- A x = b with a moving A


def _solve_kernel(A_inverse: _Handle, cells: Tensor, K: Tensor, b: Tensor) -> Tensor:
    return A_inverse.matrix.multiply(b)


def _solve_fake(A_inverse: _Handle, cells: Tensor, K: Tensor, b: Tensor) -> Tensor:
    return b.new_empty(b.shape)


def _solve_vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[Tensor, int]:
    A_inverse, cells, K, b = args
    if in_dims[2] is not None:
        raise ValueError(
            "a batch of matrices under vmap, but a factor is of one matrix; loop over the meshes, "
            "or concatenate them"
        )
    b = b.movedim(in_dims[3], 1)
    return _solve(A_inverse, cells, K, b.flatten(1)).reshape(b.shape), 1


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(A_inverse: _Handle, cells: Tensor, K: Tensor, b: Tensor) -> Tensor:
        with _one_level_below():
            return _solve(A_inverse, cells, K, b)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.A_inverse, cells, K, _ = inputs
        ctx.save_for_backward(cells, K, output)
        ctx.save_for_forward(cells, K, output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, None, Tensor | None, Tensor]:
        # With λ = A⁻ᵀ x̄: ⟨x̄, A⁻¹ (ḃ - Ȧ x)⟩ = ⟨λ, ḃ⟩ - Σₑ ⟨Pₑλ (Pₑx)ᵀ, K̇ₑ⟩, hence b̄ = λ and
        # K̄ₑ = -Pₑλ (Pₑx)ᵀ. The value of A is symmetric, but for the next derivative its argument
        # counts: Kᵀ.
        cells, K, x = ctx.saved_tensors
        adjoint = _solve(ctx.A_inverse, cells, K.mT, grad)
        K_bar = None
        if ctx.needs_input_grad[2]:
            K_bar = -_picked(adjoint, cells) @ _picked(x, cells).mT
        return None, None, K_bar, adjoint

    @staticmethod
    def jvp(ctx: Any, _A: None, _cells: None, K_dot: Tensor, b_dot: Tensor) -> Tensor:
        cells, K, x = ctx.saved_tensors
        # Function.apply has switched forward mode off, which the operator below undoes for an outer
        # level. What is computed here must do so too; not the solve, or it would push this level's
        # tangent of K once more.
        with forward_ad._set_fwd_grad_enabled(True):
            rhs = b_dot - _summed(K_dot @ _picked(x, cells), cells, len(x))
        return _solve(ctx.A_inverse, cells, K, rhs)


def _picked(x: Float[Tensor, "n c"], cells: Int[Tensor, "m k"]) -> Float[Tensor, "m k c"]:
    """Pₑ x, zero where a corner is no unknown."""
    return torch.cat([x, x.new_zeros(1, x.shape[1])])[cells]


def _summed(
    values: Float[Tensor, "m k c"], cells: Int[Tensor, "m k"], n: int
) -> Float[Tensor, "n c"]:
    """Σₑ Pₑᵀ valuesₑ."""
    total = values.new_zeros(n + 1, values.shape[2])
    return total.index_add(0, cells.flatten(), values.reshape(-1, values.shape[2]))[:n]


# ------------------------------------------------------- registration


@contextmanager
def _one_level_below() -> Iterator[None]:
    """Where an autograd.Function of one level calls its operator again for the levels below.

    Function.apply has switched both modes off; an outer transform still needs them.
    """
    with (
        torch.enable_grad(),
        forward_ad._set_fwd_grad_enabled(True),
        torch._C._AutoDispatchBelowAutograd(),
    ):
        yield


def _register(
    name: str,
    arguments: str,
    function: type[torch.autograd.Function],
    *,
    kernel: Callable[..., Tensor],
    fake: Callable[..., Tensor],
    batched: Callable[..., tuple[Tensor, int]],
) -> Any:
    """A dispatcher operator whose Autograd key runs a Function that calls the operator again."""
    # functorch has already peeled off one level; plain `function.apply` would peel off a second.
    apply = torch._C._FunctionBase.__dict__["apply"].__get__(None, function)

    def autograd(*args: Any) -> Tensor:
        with enable_single_level_autograd_function():
            return apply(*args)

    _library.define(f"{name}({arguments}) -> Tensor", tags=(torch.Tag.pt2_compliant_tag,))
    _library.impl(name, kernel, "CompositeExplicitAutograd")
    _library.impl(name, autograd, "Autograd")
    torch.library.register_fake(f"diffpoisson::{name}", fake, lib=_library)
    torch.library.register_vmap(f"diffpoisson::{name}", batched, lib=_library)
    return getattr(torch.ops.diffpoisson, name).default


register_opaque_type(_Handle, typ="reference")
_library = torch.library.Library("diffpoisson", "DEF")
_handle = get_opaque_type_name(_Handle)
_apply = _register(
    "linear_map",
    f"{_handle} A, {_handle} A_transposed, Tensor x, int rows, int cols",
    _Apply,
    kernel=_kernel,
    fake=_fake,
    batched=_vmap,
)
_solve = _register(
    "solve",
    f"{_handle} A_inverse, Tensor cells, Tensor K, Tensor b",
    _Solve,
    kernel=_solve_kernel,
    fake=_solve_fake,
    batched=_solve_vmap,
)
