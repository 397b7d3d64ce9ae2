"""Every layer under every torch transform, against dense linear algebra.

The grid is layer × transform × dtype × device. A layer comes as a pair of nonlinear functions of
one tensor, the package's and a dense one made of `references.py`; a transform is applied to both.
Where nothing right can be returned, something must be raised: the second half lists those cases.
`linear_map.py`'s two operators alone, on small matrices, are in `test_linear_map.py`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, hessian, jacfwd, jacrev, jvp, vjp, vmap
from torch.utils.checkpoint import checkpoint

import diffpoisson as dp
from diffpoisson.factor import CholeskyFactor
from tests import meshes, references
from tests.checks import assert_near, field, normal

Function = Callable[[Tensor], Tensor]
DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()
DTYPES = {"float64": torch.float64, "float32": torch.float32}
# Of quantities that went through up to three derivatives and a cube.
RTOL = {torch.float64: 1e-9, torch.float32: 2e-3}


# ------------------------------------------------------- layers


class Layer(NamedTuple):
    """The same function by the package and by dense algebra, and where to take it."""

    function: Function
    reference: Function
    x: Tensor


Builder = Callable[[torch.dtype, str], Layer]
LAYERS: dict[str, Builder] = {}
GEOMETRY = ("jacobians of vertices", "geometry", "geometry of tetrahedra", "face weights")


def layer(name: str) -> Callable[[Builder], Builder]:
    def register(build: Builder) -> Builder:
        LAYERS[name] = functools.cache(build)
        return build

    return register


def mesh_of(arrays: meshes.Arrays, dtype: torch.dtype, device: str) -> dp.Mesh:
    vertices, faces = (torch.from_numpy(a).to(device) for a in arrays)
    return dp.Mesh(vertices.to(dtype), faces)


def surface(dtype: torch.dtype, device: str) -> dp.Mesh:
    """Two components, one with three faces at an edge."""
    return mesh_of(meshes.union(meshes.book(), meshes.triangle()), dtype, device)


def bent(x: Tensor) -> Tensor:
    """A nonlinearity before a linear layer, so that its second derivatives count."""
    return x + x**2 / 2


def linear(mesh: dp.Mesh, function: Function, reference: Function, x: Tensor) -> Layer:
    """A layer that is affine in the field: the reference is evaluated once, as a dense matrix."""
    zero = torch.zeros(x.shape, dtype=torch.float64)
    M, constant = jacrev(reference)(zero).to(mesh.device), reference(zero).to(mesh.device)

    def dense(x: Tensor) -> Tensor:
        return torch.tensordot(M, bent(x), x.ndim) + constant

    x = x.to(mesh.dtype).to(mesh.device)
    return Layer(lambda x: function(bent(x)), dense, x)


def geometry(mesh: dp.Mesh) -> tuple[Tensor, np.ndarray]:
    return mesh.vertices.double().cpu(), mesh.faces.cpu().numpy()


def values(*shape: int, seed: int = 0) -> Tensor:
    return torch.from_numpy(normal(shape, seed))


@layer("solve")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    vertices, faces = geometry(mesh)
    G = references.hat_gradient_matrix(vertices, faces)
    L = G.T @ (references.measures(vertices, faces).repeat_interleave(3)[:, None] * G)
    free = [1, 2, 3, 4, 6, 7]  # all but the first vertex of each component
    inverse = torch.zeros(8, 8, dtype=torch.float64)
    inverse[torch.tensor(free)[:, None], free] = torch.linalg.inv(L[free][:, free])
    solver = dp.PoissonSolver(mesh)
    return linear(mesh, solver.solve_laplacian, lambda b: inverse @ b, values(8, 2))


@layer("jacobians")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    G = references.hat_gradient_matrix(*geometry(mesh)).view(mesh.n_faces, 3, -1)
    function = functools.partial(dp.jacobians, mesh, extrinsic=True)
    return linear(mesh, function, lambda phi: (G @ phi).mT, values(8, 2))


@layer("divergence")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    vertices, faces = geometry(mesh)
    A = references.measures(vertices, faces).repeat_interleave(3)
    GA = (A[:, None] * references.hat_gradient_matrix(vertices, faces)).T
    function = functools.partial(dp.divergence, mesh)
    R = field(mesh, c=2)
    return linear(mesh, function, lambda R: GA @ R.mT.reshape(-1, 2), R)


def poisson(mesh: dp.Mesh, solver: Callable[..., Tensor], **options) -> Layer:
    vertices, faces = geometry(mesh)

    def reference(R: Tensor) -> Tensor:
        return references.constrained_poisson(vertices, faces, R, **options)

    return linear(mesh, solver, reference, field(mesh, c=2, k=mesh.dim))


@layer("Poisson, surface")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    return poisson(mesh, dp.PoissonSolver(mesh))


@layer("Poisson, planar")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = mesh_of(meshes.planar_disk(size=3), dtype, device)
    return poisson(mesh, dp.PoissonSolver(mesh))


@layer("Poisson, tetrahedra")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = mesh_of(meshes.box(0, 2), dtype, device)
    return poisson(mesh, dp.PoissonSolver(mesh, gauge="vertex"), gauge="vertex")


PINS, HANDLES = [3, 0], [4, 2]


def constrained(mesh: dp.Mesh, **options) -> tuple[Callable, dict]:
    """A solver with pins and handles on one component, and what the reference needs to know."""
    index = torch.tensor
    solver = dp.PoissonSolver(
        mesh, pins=index(PINS), handles=index(HANDLES), handle_weights=0.7, **options
    )
    q, p = values(2, 2, seed=1), values(2, 2, seed=2)
    images = {"pins": q.to(mesh.device), "handles": p.to(mesh.device)}
    return (
        functools.partial(solver, **images),
        {"pins": (PINS, q), "handles": (HANDLES, p), "handle_weights": 0.7},
    )


@layer("pins and handles")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    solver, options = constrained(mesh)
    return poisson(mesh, solver, **options)


@layer("images of pins")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    solver, options = constrained(mesh)
    vertices, faces = geometry(mesh)
    R = field(mesh, c=2).to(dtype)

    def reference(q: Tensor) -> Tensor:
        pinned = options | {"pins": (PINS, q)}
        return references.constrained_poisson(vertices, faces, R.double(), **pinned)

    def function(q: Tensor) -> Tensor:
        return solver(R.to(device), pins=q)

    return linear(mesh, function, reference, values(2, 2))


@layer("concatenation")
def _(dtype: torch.dtype, device: str) -> Layer:
    arrays = meshes.book(), meshes.triangle(), meshes.triangle(1)
    solvers = [dp.PoissonSolver(mesh_of(a, dtype, device)) for a in arrays]
    union = dp.PoissonSolver.concatenate(solvers)
    return poisson(union.mesh, union)


def moving(mesh: dp.Mesh) -> Layer:
    """A function of the vertices, with every constraint on."""
    _, faces = geometry(mesh)
    solver, options = constrained(mesh)
    R = field(mesh, c=2, k=mesh.dim).to(mesh.dtype)

    def reference(v: Tensor) -> Tensor:
        on_cpu = references.constrained_poisson(v.cpu(), faces, R.double(), **options)
        return on_cpu.to(v.device)

    return Layer(lambda v: solver(R.to(v.device), vertices=v), reference, mesh.vertices)


@layer("geometry")
def _(dtype: torch.dtype, device: str) -> Layer:
    return moving(surface(dtype, device))


@layer("geometry of tetrahedra")
def _(dtype: torch.dtype, device: str) -> Layer:
    return moving(mesh_of(meshes.box(0, 2), dtype, device))


@layer("face weights")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    weights = (1 + values(mesh.n_faces).abs()).to(dtype).to(device)
    solver, options = constrained(mesh, face_weights=weights)
    vertices, faces = geometry(mesh)
    R = field(mesh, c=2).to(dtype)

    def reference(w: Tensor) -> Tensor:
        on_cpu = references.constrained_poisson(
            vertices, faces, R.double(), face_weights=w.cpu(), **options
        )
        return on_cpu.to(device)

    return Layer(lambda w: solver(R.to(device), face_weights=w), reference, weights)


@layer("jacobians of vertices")
def _(dtype: torch.dtype, device: str) -> Layer:
    mesh = surface(dtype, device)
    phi = values(8, 2).to(dtype).to(device)
    _, faces = geometry(mesh)

    def reference(v: Tensor) -> Tensor:
        G = references.hat_gradient_matrix(v.cpu(), faces).view(len(faces), 3, -1)
        return (G @ phi.cpu().double()).mT.to(v.device)

    return Layer(
        lambda v: dp.jacobians(mesh, phi, extrinsic=True, vertices=v), reference, mesh.vertices
    )


# ------------------------------------------------------- transforms


TRANSFORMS: dict[str, Callable[[Function, Tensor], Tensor]] = {}
FIELD_TRANSFORMS: dict[str, Callable[[Function, Tensor], Tensor]] = {}  # of a batch of arguments


def transform(function: Callable[[Function, Tensor], Tensor]) -> Callable:
    TRANSFORMS[function.__name__.removeprefix("by_").replace("_", " ")] = function
    return function


def field_transform(function: Callable[[Function, Tensor], Tensor]) -> Callable:
    FIELD_TRANSFORMS[function.__name__.removeprefix("by_").replace("_", " ")] = function
    return function


def loss(f: Function) -> Function:
    """A scalar whose derivatives of any order involve those of f."""

    def of_x(x: Tensor) -> Tensor:
        y = f(x)
        return (y**3).sum() / 3 + y.sin().sum()

    return of_x


def direction(x: Tensor, seed: int = 3) -> Tensor:
    return values(*x.shape, seed=seed).to(x)


def along(f: Function, seed: int) -> Function:
    """The derivative of f along a fixed direction, in forward mode."""
    return lambda x: jvp(f, (x,), (direction(x, seed),))[1]


@transform
def by_value(f, x):
    return f(x)


@transform
def by_backward(f, x):
    x = x.clone().requires_grad_()
    loss(f)(x).backward()
    return x.grad


@transform
def by_double_backward(f, x):
    return repeated_backward(f, x, 2)


@transform
def by_third_backward(f, x):
    return repeated_backward(f, x, 3)


def repeated_backward(f, x, order):
    x = x.clone().requires_grad_()
    y = loss(f)(x)
    for seed in range(order):
        (g,) = torch.autograd.grad(y, x, create_graph=True)
        y = (g * direction(x, seed)).sum()
    return g.detach()


@transform
def by_batched_grads(f, x):
    x = x.clone().requires_grad_()
    y = f(x)
    seeds = torch.eye(y.numel(), dtype=y.dtype, device=y.device).view(-1, *y.shape)
    return torch.autograd.grad(y, x, seeds, is_grads_batched=True)[0]


@transform
def by_checkpoint(f, x):
    """The layer is run again in the backward pass."""
    x = x.clone().requires_grad_()
    loss(lambda x: checkpoint(f, x, use_reentrant=False))(x).backward()
    return x.grad


@transform
def by_dual_numbers(f, x):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(f(forward_ad.make_dual(x, direction(x)))).tangent


@transform
def by_backward_of_dual_numbers(f, x):
    x = x.clone().requires_grad_()
    with forward_ad.dual_level():
        y = loss(f)(forward_ad.make_dual(x, direction(x)))
        return torch.autograd.grad(forward_ad.unpack_dual(y).tangent, x)[0]


@transform
def by_grad(f, x):
    return grad(loss(f))(x)


@transform
def by_vjp(f, x):
    y, pull_back = vjp(f, x)
    return pull_back(direction(y))[0]


@transform
def by_jvp(f, x):
    return along(f, 3)(x)


@transform
def by_jacrev(f, x):
    return jacrev(f)(x)


@transform
def by_jacfwd(f, x):
    return jacfwd(f)(x)


@transform
def by_hessian(f, x):
    return hessian(loss(f))(x)


@transform
def by_jacfwd_jacfwd(f, x):
    return jacfwd(jacfwd(loss(f)))(x)


@transform
def by_jacrev_jacfwd(f, x):
    return jacrev(jacfwd(loss(f)))(x)


@transform
def by_jacrev_jacrev(f, x):
    return jacrev(jacrev(loss(f)))(x)


@transform
def by_jvp_grad(f, x):
    return along(grad(loss(f)), 3)(x)


@transform
def by_grad_jvp(f, x):
    return grad(along(loss(f), 3))(x)


@transform
def by_jvp_jvp_jvp(f, x):
    return along(along(along(f, 3), 4), 5)(x)


@transform
def by_jvp_jvp_grad(f, x):
    return along(along(grad(loss(f)), 3), 4)(x)


@transform
def by_grad_jvp_jvp(f, x):
    return grad(along(along(loss(f), 3), 4))(x)


@transform
def by_jvp_grad_jvp(f, x):
    return along(grad(along(loss(f), 3)), 4)(x)


@transform
def by_grad_of_squared_grad(f, x):
    inner = grad(lambda x: (grad(loss(f))(x) ** 2).sum())
    return grad(lambda x: (inner(x) * direction(x)).sum())(x)


@transform
def by_backward_through_grad(f, x):
    """The outer level is the ordinary tape."""
    x = x.clone().requires_grad_()
    (grad(loss(f))(x) * direction(x)).sum().backward()
    return x.grad


@transform
def by_vmap_of_directions(f, x):
    """A batch of tangents at one point, folded into columns."""
    batch = torch.stack([direction(x, seed) for seed in range(3)])
    return vmap(lambda v: jvp(grad(loss(f)), (x,), (v,))[1])(batch)


def batch_of(x: Tensor, dim: int) -> Tensor:
    return torch.stack([x, 2 * x, x.cos()], dim=dim)


@field_transform
def by_vmap_first(f, x):
    return vmap(f)(batch_of(x, 0))


@field_transform
def by_vmap_second(f, x):
    return vmap(f, in_dims=1, out_dims=1)(batch_of(x, 1))


@field_transform
def by_vmap_last(f, x):
    return vmap(f, in_dims=-1, out_dims=-1)(batch_of(x, -1))


@field_transform
def by_vmap_in_chunks(f, x):
    return vmap(f, chunk_size=2)(batch_of(x, 0))


@field_transform
def by_vmap_vmap(f, x):
    batch = batch_of(x, 0)
    return vmap(vmap(f), in_dims=1)(torch.stack([batch, batch.sin()], dim=1))


@field_transform
def by_vmap_grad(f, x):
    return vmap(grad(loss(f)))(batch_of(x, 0))


@field_transform
def by_grad_vmap(f, x):
    return grad(lambda batch: vmap(loss(f))(batch).sum())(batch_of(x, 0))


@field_transform
def by_vmap_hessian(f, x):
    return vmap(hessian(loss(f)))(batch_of(x, 0))


@field_transform
def by_vmap_jvp(f, x):
    return vmap(along(f, 3), in_dims=-1)(batch_of(x, -1))


@field_transform
def by_backward_of_vmap(f, x):
    batch = batch_of(x, 0).requires_grad_()
    vmap(loss(f))(batch).sum().backward()
    return batch.grad


def agree(build: Builder, apply: Callable, dtype: torch.dtype, device: str) -> None:
    function, reference, x = build(dtype, device)
    actual, expected = apply(function, x), apply(reference, x.double())
    assert actual.dtype == dtype
    assert actual.device.type == device
    assert_near(actual.detach().cpu(), expected.detach().cpu(), RTOL[dtype])


layers = pytest.mark.parametrize("build", LAYERS.values(), ids=LAYERS)
dtypes = pytest.mark.parametrize("dtype", DTYPES.values(), ids=DTYPES)
devices = pytest.mark.parametrize("device", DEVICES)


@pytest.mark.parametrize("apply", TRANSFORMS.values(), ids=TRANSFORMS)
@layers
@dtypes
@devices
def test_grid(apply, build, dtype, device):
    agree(build, apply, dtype, device)


@pytest.mark.parametrize("apply", FIELD_TRANSFORMS.values(), ids=FIELD_TRANSFORMS)
@pytest.mark.parametrize("name", [name for name in LAYERS if name not in GEOMETRY])
@dtypes
@devices
def test_grid_of_batches(apply, name, dtype, device):
    agree(LAYERS[name], apply, dtype, device)
