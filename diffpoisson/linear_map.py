"""A constant linear map x ↦ A x as a torch op that every torch transform understands.

Gradient, divergence and the Poisson solve are linear in the field, so they share one op. Its
derivative is the map itself and its adjoint is the map of Aᵀ, which each `LinearMap` carries along;
since both are again this op, derivatives of any order and in any mode follow:

    y = A x        ẏ = A ẋ (forward mode)        x̄ = Aᵀ ȳ (reverse mode)

No public torch API gives all of backward of any order, `torch.func` transforms in any nesting,
`vmap` and `torch.compile(fullgraph=True)` at once (torch 2.13): a `custom_op` with
`register_autograd` returns zero tangents under `func.jvp`, and an `autograd.Function` cannot be
compiled around an opaque kernel. Hence this file, and only this file, uses private APIs: an
operator whose Autograd key runs an `autograd.Function` that calls the operator again, one dispatch
level below. Once `register_autograd` supports forward mode, `_Apply`, `_autograd` and the
registration below shrink to two decorators.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Float
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


register_opaque_type(_Handle, typ="reference")
_library = torch.library.Library("diffpoisson", "DEF")
_handle = get_opaque_type_name(_Handle)
_library.define(
    f"linear_map({_handle} A, {_handle} A_transposed, Tensor x, int rows, int cols) -> Tensor",
    tags=(torch.Tag.pt2_compliant_tag,),
)
_apply = torch.ops.diffpoisson.linear_map.default


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
        # Function.apply has switched both modes off; an outer transform still needs them.
        with (
            torch.enable_grad(),
            forward_ad._set_fwd_grad_enabled(True),
            torch._C._AutoDispatchBelowAutograd(),
        ):
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


def _autograd(*args: Any) -> Tensor:
    # functorch has already peeled off one level; plain `_Apply.apply` would peel off a second one.
    with enable_single_level_autograd_function():
        return torch._C._FunctionBase.__dict__["apply"].__get__(None, _Apply)(*args)


_library.impl("linear_map", _kernel, "CompositeExplicitAutograd")
_library.impl("linear_map", _autograd, "Autograd")
torch.library.register_fake("diffpoisson::linear_map", _fake, lib=_library)
torch.library.register_vmap("diffpoisson::linear_map", _vmap, lib=_library)
