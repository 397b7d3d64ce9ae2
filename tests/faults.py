"""Named mistakes that a gradient and Poisson layer can have, each put into the real one.

A fault is a context manager that patches the package's internals. `fault_table.py` runs every check
under every fault.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from torch import Tensor

from diffpoisson import cells, constraints, gradient, linear_map, mesh, placement, poisson

Patch = pytest.MonkeyPatch


class Fault(NamedTuple):
    """A mistake, in words; the check that must notice it; how to make it."""

    description: str
    noticed_by: str
    inject: Callable[[Patch], None]

    @contextmanager
    def injected(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            self.inject(patch)
            # The layer's own check refuses many such solvers before any other check could look.
            patch.setattr(poisson.PoissonSolver, "_require_digits", lambda solver: None)
            yield


Inject = Callable[[Patch], None]


def registrar(faults: dict[str, Fault]) -> Callable[[str], Callable[[Inject], Inject]]:
    """A decorator that adds a fault to a table."""

    def fault(noticed_by: str) -> Callable[[Inject], Inject]:
        def register(inject: Inject) -> Inject:
            faults[inject.__name__] = Fault(inspect.getdoc(inject), noticed_by, inject)
            return inject

        return register

    return fault


FAULTS: dict[str, Fault] = {}
fault = registrar(FAULTS)


def wrap(patch: Patch, owner: Any, name: str, wrapper: Callable) -> None:
    """Replace a function by wrapper(original, *arguments)."""
    original = getattr(owner, name)
    patch.setattr(owner, name, lambda *args, **kwargs: wrapper(original, *args, **kwargs))


def wrap_property(patch: Patch, owner: type, name: str, change: Callable[[Any, Any], Any]) -> None:
    """Replace a cached property by change(self, value)."""
    original = owner.__dict__[name].func
    patch.setattr(owner, name, property(lambda self: change(self, original(self))))


def change_system(patch: Patch, change: Callable[..., tuple]) -> None:
    """Change (∇ᵀA, L) when a solver assembles them."""
    wrap(patch, poisson, "_assemble", lambda f, mesh, *rest: change(mesh, *f(mesh, *rest)))


def wrap_method(patch: Patch, owner: type, name: str, wrapper: Callable) -> None:
    original = owner.__dict__[name]

    def method(self, *args, **kwargs):
        return wrapper(original, self, *args, **kwargs)

    patch.setattr(owner, name, method)


# ------------------------------------------------------- discretisation


@fault("gradient_against_edge_basis")
def swapped_hats(patch):
    """The gradients of two corners are exchanged."""
    wrap(patch, cells, "hat_gradients", lambda hats, *cell: hats(*cell)[..., [0, 2, 1]])


@fault("reference")
def negative_gradient(patch):
    """Edges are rotated the wrong way."""
    wrap(patch, cells, "hat_gradients", lambda hats, *cell: -hats(*cell))


@fault("divergence_is_adjoint")
def unweighted_everywhere(patch):
    """Faces of all sizes count alike, in the Laplacian and in the right-hand side."""

    def init(original, self, *args):
        original(self, *args)
        self.weights = torch.ones_like(self.weights)

    wrap_method(patch, gradient.GradientOperator, "__init__", init)


@fault("affine")
def unweighted_right_hand_side(patch):
    """Areas weigh the Laplacian but not the right-hand side."""

    def change(mesh, divergence, L):
        return divergence @ sp.diags(1 / mesh.areas.numpy().repeat(2)), L

    change_system(patch, change)


@fault("affine")
def unweighted_laplacian(patch):
    """Areas weigh the right-hand side but not the Laplacian."""

    def change(mesh, divergence, L):
        G = gradient.gradient_operator(mesh).matrix
        return divergence, (G.T @ G).tocsr()

    change_system(patch, change)


@fault("affine")
def double_areas(patch):
    """The right-hand side is weighed by doubled areas, as `doublearea` functions return them."""
    change_system(patch, lambda mesh, divergence, L: (2 * divergence, L))


@fault("scale")
def area_epsilon(patch):
    """A small number is added to areas, to avoid division by zero."""
    wrap(patch, cells, "measures", lambda f, *cell: f(*cell) + 1e-8)


@fault("gradient_against_edge_basis")
def unsigned_planar_areas(patch):
    """The orientation of clockwise planar faces is lost in the gradient."""

    def hats(original, corners, *rest):
        values = original(corners, *rest)
        if corners.shape[2] == 3:
            return values
        return values * cells.determinants(corners).sign()[:, None, None]

    wrap(patch, cells, "hat_gradients", hats)


@fault("reference")
def diagonal_shift(patch):
    """The identity times 1e-8 is added to the Laplacian, "for stability"."""
    wrap(patch, poisson, "CholeskyFactor", lambda f, L, device: f(L + 1e-8 * _eye(L), device))


@fault("reference")
def relative_diagonal_shift(patch):
    """Every diagonal entry of the Laplacian grows by a millionth."""
    shift = 1e-6
    wrap(
        patch,
        poisson,
        "CholeskyFactor",
        lambda f, L, device: f(L + shift * sp.diags(L.diagonal()), device),
    )


@fault("reference")
def clamped_cotangents(patch):
    """Positive off-diagonal entries of the Laplacian (obtuse angles) are set to zero."""

    def clamp(mesh, divergence, L):
        off = (L - sp.diags(L.diagonal())).minimum(0)
        return divergence, (off - sp.diags(np.asarray(off.sum(1)).ravel())).tocsr()

    change_system(patch, clamp)


# ------------------------------------------------------- conventions


@fault("affine")
def transposed_jacobian(patch):
    """Rows and columns of the input are exchanged where that fits."""

    def transpose(original, operation, mesh, R, frames):
        return original(operation, mesh, R.mT if R.shape[-1] == R.shape[-2] else R, frames)

    wrap(patch, poisson, "as_intrinsic", transpose)


@fault("frame_choice")
def ignored_frames(patch):
    """Intrinsic input is read in the frame of the face's second edge."""

    def turn(original, operation, mesh, R, frames):
        if R.shape[-1] == mesh.dim:
            return original(operation, mesh, R, frames)
        edges = (mesh.vertices[mesh.faces[:, 2]] - mesh.vertices[mesh.faces[:, 1]])[:, None]
        x, y = torch.nn.functional.normalize((edges @ mesh.frames)[:, 0], dim=1).unbind(1)
        return R @ torch.stack([x, y, -y, x], dim=1).view(-1, 2, 2)

    wrap(patch, poisson, "as_intrinsic", turn)


@fault("gradient_against_edge_basis")
def left_handed_frames(patch):
    """The second tangent direction points the wrong way."""
    flip = torch.tensor([1.0, -1.0], dtype=torch.float64)
    wrap_property(patch, mesh.Mesh, "_double_frames", lambda _, frames: frames * flip)


@fault("vmap_against_a_loop")
def mixed_batch(patch):
    """Batch and output coordinates are unflattened in the wrong order."""

    def unflatten(original, columns, shape):
        if len(shape) == 4:
            sizes = (len(columns), shape[-2], shape[0])
            return columns.reshape(sizes).permute(2, 0, 1)
        return original(columns, shape)

    wrap(patch, poisson, "columns_to_vertices", unflatten)


# ------------------------------------------------------- gauge and components


@fault("mean_gauge")
def plain_mean(patch):
    """The mean counts vertices, not areas."""
    wrap_method(
        patch,
        constraints.Constraints,
        "mean_weights",
        lambda f, self, sizes: f(self, torch.ones_like(sizes)),
    )


@fault("mean_gauge")
def global_mean(patch):
    """One mean over all components."""

    def place(_, self, x):
        phi = x.new_zeros(self.shape[0], x.shape[1])
        phi[self.constraints.free] = x
        return phi - (self.means[:, None] * phi).sum(0) / self.means.sum()

    wrap_method(patch, placement.Placement, "multiply", place)


@fault("mean_gauge")
def first_vertex_at_zero(patch):
    """The mean gauge is left out: the first vertex is at zero instead."""
    wrap_method(
        patch, placement.Placement, "multiply", lambda f, self, x: (y := f(self, x)) - y[:1]
    )


@fault("backward")
def detached_gauge(patch):
    """The mean is subtracted as a constant, which the adjoint knows nothing of."""
    wrap_method(
        patch,
        placement.PlacementTransposed,
        "multiply",
        lambda _, self, x: x[self.transposed().constraints.free],
    )


@fault("disconnected_as_each_alone")
def one_anchor_for_all_components(patch):
    """Only the first component is pinned, and a tiny shift lets the factorisation pass."""
    wrap(patch, constraints, "_first_of_each", lambda f, labels, count: f(labels, count)[:1])
    wrap(patch, poisson, "CholeskyFactor", lambda f, L, device: f(L + 1e-10 * _eye(L), device))


@fault("vertex_gauge")
def last_vertex_as_anchor(patch):
    """Another vertex than documented is pinned."""
    wrap(
        patch,
        constraints,
        "_first_of_each",
        lambda f, labels, count: len(labels) - 1 - f(labels.flip(0), count),
    )


# ------------------------------------------------------- caches and memory


@fault("cache_is_not_stale")
def stale_factor(patch):
    """Factors are cached by connectivity only."""
    cache = {}

    def cached(original, L, device):
        return cache.setdefault(L.sorted_indices().indices.tobytes(), original(L, device))

    wrap(patch, poisson, "CholeskyFactor", cached)


@fault("cache_is_not_stale")
def stale_operator(patch):
    """Gradients are cached by faces only."""
    cache = {}

    def cached(original, mesh):
        return cache.setdefault(mesh.faces.numpy().tobytes(), original(mesh))

    for module in (gradient, poisson):
        wrap(patch, module, "gradient_operator", cached)


@fault("concatenated_as_each_alone")
def one_factor_for_all_parts(patch):
    """A batch reuses the first factor where sizes agree."""

    def first(original, blocks, *planes):
        same = {block.shape: block for block in reversed(blocks)}
        return original([same[block.shape] for block in blocks], *planes)

    wrap(patch, poisson, "BlockDiagonal", first)


@fault("concatenated_as_each_alone")
def planes_run_together(patch):
    """A batch reads its field face by face, not direction by direction."""
    wrap(patch, poisson, "BlockDiagonal", lambda f, blocks, *planes: f(blocks))


@fault("input_is_untouched")
def mutated_input(patch):
    """The caller's tensor is scaled in place, by a rounding or so."""

    def mutate(original, operation, mesh, R, frames):
        R.data.mul_(1 + 1e-12)
        return original(operation, mesh, R, frames)

    wrap(patch, poisson, "as_intrinsic", mutate)


@fault("strides")
def ignored_strides(patch):
    """The storage is read as if it were contiguous."""

    def contiguous(original, operation, mesh, R, frames):
        strides = torch.empty(R.shape, device="meta").stride()
        return original(operation, mesh, torch.as_strided(R, R.shape, strides), frames)

    wrap(patch, poisson, "as_intrinsic", contiguous)


@fault("reference")
def single_precision_factor(patch):
    """The Laplacian is rounded to float32 before it is factorised."""
    wrap(
        patch,
        poisson,
        "CholeskyFactor",
        lambda f, L, device: f(L.astype(np.float32).astype(np.float64), device),
    )


@fault("reference")
def single_precision_right_hand_side(patch):
    """The factor's input is rounded to float32."""
    wrap_method(patch, poisson.CholeskyFactor, "_solve", lambda f, self, b: f(self, b.float()))


@fault("precision")
def always_double_output(patch):
    """The output does not have the dtype of the input."""
    wrap_method(
        patch, poisson.PoissonSolver, "__call__", lambda f, solver, R: f(solver, R).double()
    )


# ------------------------------------------------------- derivatives


def change_backward(patch: Patch, change: Callable[[Any, Tensor, Tensor], Tensor]) -> None:
    original = linear_map._Apply.backward

    def backward(ctx, grad):
        result = original(ctx, grad)
        return (*result[:2], change(ctx, grad, result[2]), *result[3:])

    patch.setattr(linear_map._Apply, "backward", staticmethod(backward))


@fault("double_backward")
def no_double_backward(patch):
    """The backward pass is not differentiable."""
    change_backward(patch, lambda ctx, grad, result: result.detach())


@fault("backward")
def backward_not_the_adjoint(patch):
    """A little of the incoming gradient leaks through."""

    def leak(ctx, grad, result):
        return result + 1e-3 * grad if ctx.rows == ctx.cols else result

    change_backward(patch, leak)


@fault("adjoint_of_the_solve")
def single_precision_backward(patch):
    """Gradients are rounded to float32; finite differences can't tell."""
    change_backward(patch, lambda ctx, grad, result: result.float().double())


@fault("backward")
def zero_backward(patch):
    """The solve is cut off the graph."""
    change_backward(patch, lambda ctx, grad, result: torch.zeros_like(result))


@fault("backward")
def negative_backward(patch):
    """The gradient of each operator has the wrong sign; that of two composed ones is right."""
    change_backward(patch, lambda ctx, grad, result: -result)


def scale_tangent(patch: Patch, factor: float) -> None:
    original = linear_map._Apply.jvp
    patch.setattr(linear_map._Apply, "jvp", staticmethod(lambda *args: factor * original(*args)))


@fault("forward_mode")
def zero_tangent(patch):
    """Forward mode returns zeros, as torch does for custom operators."""
    scale_tangent(patch, 0.0)


@fault("forward_mode")
def negative_tangent(patch):
    """The tangent of each operator has the wrong sign; that of two composed ones is right."""
    scale_tangent(patch, -1.0)


@fault("forward_over_forward")
def constant_tangent(patch):
    """Forward mode is right once, but its result is not differentiable again."""
    original, fine = linear_map._Apply.jvp, 2.0**44
    # Rounding has derivative zero, and this one changes no value that matters.
    rounded = staticmethod(lambda *args: torch.round(fine * original(*args)) / fine)
    patch.setattr(linear_map._Apply, "jvp", rounded)


@fault("forward_over_forward")
def modes_left_off(patch):
    """An outer transform does not see the inner one's operator."""

    def forward(A, A_transposed, x, rows, cols):
        with torch._C._AutoDispatchBelowAutograd():
            return linear_map._apply(A, A_transposed, x, rows, cols)

    patch.setattr(linear_map._Apply, "forward", staticmethod(forward))


@fault("vmap_against_a_loop")
def mixed_vmap(patch):
    """The batching rule reads (column, batch) as (batch, column)."""

    def mixed(info, in_dims, *args):
        A, A_transposed, x, rows, cols = args
        x = x.movedim(in_dims[2], 1)
        y = _apply(A, A_transposed, x.flatten(1), rows, cols)  # linear_map's
        return y.reshape(rows, x.shape[2], x.shape[1]).transpose(1, 2), 1

    # torch keeps the registered function itself, so its body is exchanged.
    patch.setattr(inspect.unwrap(linear_map._vmap), "__code__", mixed.__code__)


def _eye(L: sp.spmatrix) -> sp.spmatrix:
    return sp.eye(L.shape[0], format="csr")
