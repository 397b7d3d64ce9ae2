"""The op x ↦ A x under every torch transform, against the dense matrix."""

from __future__ import annotations

import copy
import gc
import itertools
import pickle
import re
import weakref

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from torch.autograd import forward_ad, gradcheck, gradgradcheck
from torch.func import grad, hessian, jacfwd, jacrev, jvp, linearize, vjp, vmap

from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import SparseMatrix
from diffpoisson.linear_map import CellwiseInverse, LinearMap, _apply, _solve
from tests.checks import assert_near

RTOL = 1e-13


def rectangular() -> tuple[LinearMap, torch.Tensor]:
    A = sp.random(5, 4, density=0.6, format="csr", rng=np.random.default_rng(0))
    return LinearMap(SparseMatrix(A, torch.device("cpu"))), torch.from_numpy(A.toarray())


def inverse() -> tuple[LinearMap, torch.Tensor]:
    B = np.random.default_rng(0).standard_normal((4, 4))
    A = B @ B.T + 4 * np.eye(4)
    return LinearMap(CholeskyFactor(sp.csr_matrix(A))), torch.from_numpy(np.linalg.inv(A))


def adjoint() -> tuple[LinearMap, torch.Tensor]:
    map_, dense = rectangular()
    return map_.T, dense.T


CASES = [rectangular, adjoint, inverse]
both = pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)


def columns(dense: torch.Tensor, k: int = 2, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(dense.shape[1], k, generator=generator, dtype=torch.float64)


def losses(case):
    """The same nonlinear scalar function through the op and through the dense matrix."""
    map_, dense = case()

    def of(A):
        return lambda x: (A(x**2) ** 3).sum() + A(x).sin().sum()

    return of(map_), of(lambda x: dense @ x), columns(dense)


# ------------------------------------------------------- values


@both
def test_value(case):
    map_, dense = case()
    x = columns(dense)
    assert map_.shape == tuple(dense.shape)
    assert_near(map_(x), dense @ x, RTOL)
    assert_near(map_.T(dense @ x), dense.T @ dense @ x, RTOL)
    assert_near(map_.T.T(x), dense @ x, RTOL)


@both
def test_dtype_and_columns(case):
    map_, dense = case()
    single = map_(columns(dense).float())
    assert single.dtype == torch.float32
    assert_near(single, dense @ columns(dense).float().double(), 1e-6)
    assert map_(columns(dense, k=0)).shape == (len(dense), 0)
    strided = columns(dense, k=6)[:, ::2]
    assert_near(map_(strided), dense @ strided, RTOL)


@both
def test_autocast_does_not_round(case):
    map_, dense = case()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_near(map_(columns(dense)), dense @ columns(dense), RTOL)


@both
def test_copies(case):
    map_, dense = case()
    for twin in (copy.deepcopy(map_), pickle.loads(pickle.dumps(map_)), copy.deepcopy(map_.T).T):
        assert_near(twin(columns(dense)), dense @ columns(dense), RTOL)
        assert_near(twin.T(dense), dense.T @ dense, RTOL)


@both
@pytest.mark.parametrize("shape", [(6, 2), (4,), (4, 2, 2)])
def test_wrong_shape_raises(case, shape, unchecked):
    map_, (rows, cols) = case()[0], case()[1].shape
    shape = (cols, *shape[1:]) if len(shape) != 2 else shape
    message = f"linear map of shape ({rows}, {cols}): expected x of shape ({cols}, k), got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        map_(torch.zeros(shape, dtype=torch.float64))


# ------------------------------------------------------- reverse mode


@both
def test_backward_of_order_three(case):
    loss, reference, x = losses(case)
    actual, expected = x.clone().requires_grad_(), x.clone().requires_grad_()
    a, e = loss(actual), reference(expected)
    for order in range(3):
        (a,) = torch.autograd.grad(a, actual, create_graph=True)
        (e,) = torch.autograd.grad(e, expected, create_graph=True)
        assert_near(a.detach(), e.detach(), RTOL * 10**order)
        a, e = (a**2).sum(), (e**2).sum()


@both
def test_gradcheck(case):
    """Both modes, batched too, against finite differences."""
    map_, dense = case()
    x = columns(dense).requires_grad_()
    modes = {"check_forward_ad": True, "check_batched_grad": True}
    assert gradcheck(map_, x, check_batched_forward_grad=True, **modes)
    assert gradgradcheck(
        lambda x: map_(x) ** 2, x, check_fwd_over_rev=True, check_rev_over_rev=True
    )


@both
def test_requires_grad_is_propagated_only_when_asked(case):
    map_, dense = case()
    x = columns(dense).requires_grad_()
    assert map_(x).requires_grad
    with torch.no_grad():
        assert not map_(x).requires_grad
    with torch.inference_mode():
        assert_near(map_(x), dense @ x, RTOL)
    assert not map_(x.detach()).requires_grad


# ------------------------------------------------------- forward mode and nestings


@both
def test_forward_mode(case):
    map_, dense = case()
    x, tangent = columns(dense), columns(dense, seed=1)
    value, derivative = jvp(map_, (x,), (tangent,))
    assert_near(value, dense @ x, RTOL)
    assert_near(derivative, dense @ tangent, RTOL)
    with forward_ad.dual_level():
        dual = map_(forward_ad.make_dual(x, tangent))
        assert_near(forward_ad.unpack_dual(dual).tangent, dense @ tangent, RTOL)


@both
@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node:UserWarning")
def test_linearize(case):
    """torch's tracer warns about constants that are not tensors, and is right all the same."""
    map_, dense = case()
    value, derivative = linearize(map_, columns(dense))
    assert_near(value, dense @ columns(dense), RTOL)
    assert_near(derivative(columns(dense, seed=1)), dense @ columns(dense, seed=1), RTOL)


@both
def test_vjp(case):
    map_, dense = case()
    cotangent = torch.ones(len(dense), 2, dtype=torch.float64)
    value, pull_back = vjp(map_, columns(dense))
    assert_near(value, dense @ columns(dense), RTOL)
    assert_near(pull_back(cotangent)[0], dense.T @ cotangent, RTOL)


TRANSFORMS = {"jacfwd": jacfwd, "jacrev": jacrev}


@both
@pytest.mark.parametrize("nesting", list(itertools.product(TRANSFORMS, repeat=3)), ids="-".join)
def test_nested_jacobians(case, nesting):
    """First, second and third derivatives in all fourteen orders of nesting."""
    loss, reference, x = losses(case)
    for name in nesting:
        loss, reference = TRANSFORMS[name](loss), jacrev(reference)
        assert_near(loss(x), reference(x), 1e-11)


@both
def test_hessian_vector_products(case):
    """The three usual compositions of jvp and grad."""
    loss, reference, x = losses(case)
    v = torch.cos(x)
    expected = torch.tensordot(hessian(reference)(x), v, 2)
    assert_near(hessian(loss)(x), hessian(reference)(x), 1e-11)
    assert_near(jvp(grad(loss), (x,), (v,))[1], expected, 1e-11)
    assert_near(grad(lambda x: jvp(loss, (x,), (v,))[1])(x), expected, 1e-11)
    assert_near(grad(lambda x: (grad(loss)(x) * v).sum())(x), expected, 1e-11)


# ------------------------------------------------------- vmap


@both
@pytest.mark.parametrize("in_dim", [0, 1, 2, -1])
@pytest.mark.parametrize("out_dim", [0, 1, 2])
def test_vmap_against_a_loop(case, in_dim, out_dim):
    map_, dense = case()
    batch = torch.stack([columns(dense, seed=seed) for seed in range(3)], dim=in_dim)
    expected = torch.stack([dense @ x for x in batch.unbind(in_dim)], dim=out_dim)
    assert_near(vmap(map_, in_dims=in_dim, out_dims=out_dim)(batch), expected, RTOL)


@both
def test_nested_and_differentiated_vmap(case):
    loss, reference, x = losses(case)
    batch = torch.stack([x, 2 * x, x.cos()])
    grid = torch.stack([batch, batch.sin()])
    assert_near(vmap(vmap(loss))(grid), vmap(vmap(reference))(grid), RTOL)
    assert_near(vmap(grad(loss))(batch), vmap(grad(reference))(batch), RTOL)
    summed, expected = (lambda b, f=f: vmap(f)(b).sum() for f in (loss, reference))
    assert_near(grad(summed)(batch), grad(expected)(batch), RTOL)
    tangents = vmap(lambda v: jvp(loss, (x,), (v,))[1])(batch)
    assert_near(tangents, vmap(lambda v: jvp(reference, (x,), (v,))[1])(batch), RTOL)


# ------------------------------------------------------- dispatcher and compiler


@both
def test_opcheck(case, unchecked):
    """torch's own test of a custom operator: schema, fake kernel, autograd registration, AOT."""
    map_, dense = case()
    x = columns(dense).requires_grad_()
    torch.library.opcheck(_apply, (*map_._handles, x, *map_.shape))


@pytest.fixture
def compile_(unchecked):
    torch.compiler.reset()
    yield lambda f, backend="aot_eager": torch.compile(f, fullgraph=True, backend=backend)
    torch.compiler.reset()


@both
def test_compiled_value_and_backward(case, compile_):
    loss, reference, x = losses(case)
    actual, expected = x.clone().requires_grad_(), x.clone().requires_grad_()
    value = compile_(loss)(actual)
    value.backward()
    reference(expected).backward()
    assert_near(value.detach(), reference(x), RTOL)
    assert_near(actual.grad, expected.grad, RTOL)


@both
def test_compiled_transforms(case, compile_):
    loss, reference, x = losses(case)
    v = torch.cos(x)
    assert_near(compile_(grad(loss))(x), grad(reference)(x), RTOL)
    forward = compile_(lambda x, v: jvp(loss, (x,), (v,))[1])
    assert_near(forward(x, v), jvp(reference, (x,), (v,))[1], RTOL)
    batch = torch.stack([x, v])
    assert_near(compile_(vmap(grad(loss)))(batch), vmap(grad(reference))(batch), RTOL)
    assert_near(compile_(hessian(loss))(x), hessian(reference)(x), 1e-11)


def test_compiled_code_serves_other_maps(compile_):
    """The matrix is an input of the compiled code, not a constant baked into it."""
    first, A = rectangular()
    second, B = LinearMap(SparseMatrix(sp.csr_matrix(2 * A.numpy()), torch.device("cpu"))), 2 * A
    apply = compile_(lambda map_, x: map_(x))
    x = columns(A)
    assert_near(apply(first, x), A @ x, RTOL)
    assert_near(apply(second, x), B @ x, RTOL)


@pytest.mark.slow
def test_compiled_by_inductor(compile_):
    loss, reference, x = losses(inverse)
    actual = x.clone().requires_grad_()
    compile_(loss, "inductor")(actual).backward()
    assert_near(actual.grad, grad(reference)(x), RTOL)


# ------------------------------------------------------- a solve whose matrix moves

CELLS = torch.tensor([[0, 1], [1, 2], [2, 3]])  # 3 is no unknown


def assembled(K: torch.Tensor) -> torch.Tensor:
    """Σₑ Pₑᵀ Kₑ Pₑ with dense Pₑ, plus a constant."""
    P = torch.nn.functional.one_hot(CELLS, 4)[..., :3].double()
    return torch.einsum("eki,ekl,elj->ij", P, K, P) + torch.eye(3).double()


def moving():
    """The solve; the same by `inv`, as `linalg.solve` errs at second order; K and b."""
    generator = torch.Generator().manual_seed(0)
    K = torch.randn(3, 2, 2, generator=generator, dtype=torch.float64)
    K = K @ K.mT
    b = torch.randn(3, 2, generator=generator, dtype=torch.float64)
    solve = CellwiseInverse(CholeskyFactor(sp.csr_matrix(assembled(K).numpy())), CELLS)
    return solve, lambda K, b: torch.linalg.inv(assembled(K)) @ b, K, b


def moving_losses():
    *solves, K, b = moving()

    def of(solve):
        return lambda K, b: (solve(K, b**2) ** 3).sum() + solve(K, b).sin().sum()

    return *map(of, solves), K, b


def test_moving_value():
    solve, reference, K, b = moving()
    assert_near(solve(K, b), reference(K, b), RTOL)


@pytest.mark.parametrize("argnums", [0, 1, (0, 1)])
@pytest.mark.parametrize("nesting", list(itertools.product(TRANSFORMS, repeat=3)), ids="-".join)
def test_nested_jacobians_of_a_moving_solve(nesting, argnums):
    """First, second and mixed derivatives by matrix and right-hand side; third by the matrix."""
    loss, reference, K, b = moving_losses()
    for order, name in enumerate(nesting):
        if order == 2:
            argnums = 0
        loss, reference = TRANSFORMS[name](loss, argnums), jacrev(reference, argnums)
        actual, expected = (torch.utils._pytree.tree_leaves(f(K, b)) for f in (loss, reference))
        for a, e in zip(actual, expected, strict=True):
            assert_near(a, e, 1e-11)


def test_backward_of_order_four_of_a_moving_solve():
    loss, reference, K, b = moving_losses()
    actual, expected = K.clone().requires_grad_(), K.clone().requires_grad_()
    a, e = loss(actual, b), reference(expected, b)
    for order in range(4):
        (a,) = torch.autograd.grad(a, actual, create_graph=True)
        (e,) = torch.autograd.grad(e, expected, create_graph=True)
        assert_near(a.detach(), e.detach(), RTOL * 10**order)
        a, e = (a**2).sum(), (e**2).sum()


def test_forward_mode_of_a_moving_solve():
    solve, reference, K, b = moving()
    tangents = (K.sin(), b.cos())
    expected = jvp(reference, (K, b), tangents)[1]
    with forward_ad.dual_level():
        duals = map(forward_ad.make_dual, (K.requires_grad_(), b), tangents)
        tangent = forward_ad.unpack_dual(solve(*duals)).tangent
    assert_near(tangent.detach(), expected.detach(), RTOL)
    actual, expected = (
        torch.autograd.grad(jvp(f, (K, b), tangents)[1].square().sum(), K)[0]
        for f in (solve, reference)
    )
    assert_near(actual, expected, 1e-12)


def test_vmap_of_a_moving_solve():
    loss, reference, K, b = moving_losses()
    batch = torch.stack([b, 2 * b, b.cos()], dim=1)
    for argnums in (0, 1):
        actual, expected = (vmap(grad(f, argnums), (None, 1))(K, batch) for f in (loss, reference))
        assert_near(actual, expected, 1e-12)
    with pytest.raises(ValueError, match="a batch of matrices under vmap"):
        vmap(loss, (0, None))(torch.stack([K, K]), b)


def test_opcheck_of_a_moving_solve(unchecked):
    solve, _, K, b = moving()
    torch.library.opcheck(_solve, (solve._handle, CELLS, K.requires_grad_(), b.requires_grad_()))


def test_compiled_moving_solve(compile_):
    loss, reference, K, b = moving_losses()
    actual = K.clone().requires_grad_()
    compile_(loss)(actual, b).backward()
    assert_near(actual.grad, grad(reference)(K, b), 1e-12)
    assert_near(compile_(grad(loss))(K, b), grad(reference)(K, b), 1e-12)
    assert_near(compile_(hessian(loss))(K, b), hessian(reference)(K, b), 1e-11)


# ------------------------------------------------------- life time


def test_maps_are_collected():
    """Neither the graph nor the dispatcher keeps a matrix alive."""
    A = SparseMatrix(sp.eye(4, format="csr"), torch.device("cpu"))
    alive = weakref.ref(A)
    x = torch.ones(4, 2, dtype=torch.float64, requires_grad=True)
    LinearMap(A)(x).sum().backward()
    del A
    gc.collect()
    assert alive() is None
