"""Every layer under every torch transform, against dense linear algebra.

The grid is layer × transform × dtype × device. A layer comes as a pair of nonlinear functions of
one tensor, the package's and a dense one made of `references.py`; a transform is applied to both.
Where nothing right can be returned, something must be raised: the second half lists those cases.
`linear_map.py`'s two operators alone, on small matrices, are in `test_linear_map.py`.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.func import grad, hessian, jacfwd, jacrev, jvp, linearize, vjp, vmap
from torch.utils.checkpoint import checkpoint

import diffpoisson as dp
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import CellGeometry
from tests import meshes, references
from tests.checks import assert_near, field, normal

Function = Callable[[Tensor], Tensor]
DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()
DTYPES = {"float64": torch.float64, "float32": torch.float32}
# Of quantities that went through up to three derivatives and a cube.
RTOL = {torch.float64: 1e-11, torch.float32: 2e-5}


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


def polar(J: Tensor) -> Tensor:
    """The rotation closest to matrices of positive determinant, by Newton's iteration."""
    for _ in range(12):
        J = (J + torch.linalg.inv(J).mT) / 2
    return J


@layer("closest rotation")
def _(dtype: torch.dtype, device: str) -> Layer:

    def near(x: Tensor) -> Tensor:  # the identity, whatever x is, so that nothing is flipped
        return torch.eye(3).to(x) + x.sin() / 5

    x = values(3, 3, 3).to(dtype).to(device)
    return Layer(lambda x: dp.closest_rotation(near(x)), lambda x: polar(near(x)), x)


@layer("as rigid as possible")
def _(dtype: torch.dtype, device: str) -> Layer:
    """Two steps from a start, by the start."""
    mesh = mesh_of(meshes.box(0, 2), dtype, device)
    pins, q = [0, 3, 5, 6], values(4, 3) / 5
    solver = dp.PoissonSolver(mesh, pins=torch.tensor(pins, device=device))
    vertices, faces = geometry(mesh)
    G = references.hat_gradient_matrix(vertices, faces).view(mesh.n_faces, 3, -1)
    q = q + vertices[pins]

    def function(x: Tensor) -> Tensor:
        options = {"pins": q.to(x), "tolerance": None, "max_steps": 2}
        start = vertices.to(x) + x.sin() / 10
        return dp.as_rigid_as_possible(solver, start=start, **options).vertices

    def reference(x: Tensor) -> Tensor:
        phi = vertices + x.sin() / 10
        for _ in range(2):
            R = polar((G @ phi).mT)
            phi = references.constrained_poisson(vertices, faces, R, pins=(pins, q))
        return phi

    return Layer(function, reference, values(8, 3, seed=1).to(dtype).to(device))


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
def by_functional_jacobian(f, x):
    """Forward mode under torch's older vmap."""
    options = {"vectorize": True, "strategy": "forward-mode"}
    return torch.autograd.functional.jacobian(f, x, **options)


@transform
def by_linearize(f, x):
    return linearize(f, x)[1](direction(x))


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
@pytest.mark.filterwarnings("ignore:Attempted to insert a get_attr Node:UserWarning")
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


# ------------------------------------------------------- cost: one factor call per pass


FACTOR_CALLS = {  # two losses have two solves of each order, all directions of one fold
    "value": 1,
    "vmap first": 1,
    "vmap last": 1,
    "vmap vmap": 1,
    "vmap jvp": 2,
    "vmap grad": 2,
    "grad vmap": 2,
    "backward": 2,
    "checkpoint": 2,  # recomputing stops before a linear solve, whose backward needs no value of it
    "vjp": 2,
    "jvp": 2,
    "jacrev": 2,
    "jacfwd": 2,
}


@pytest.mark.parametrize("name", FACTOR_CALLS)
@pytest.mark.parametrize("layer", ["Poisson, surface", "geometry"])
def test_factor_calls(name, layer, monkeypatch):
    """All rows of a Jacobian, all elements of a batch: columns of one triangular solve."""
    apply = (TRANSFORMS | FIELD_TRANSFORMS)[name]
    if layer in GEOMETRY and name in FIELD_TRANSFORMS:
        pytest.skip("no batch of vertices")
    function, _, x = LAYERS[layer](torch.float64, "cpu")
    calls = []
    multiply = CholeskyFactor.multiply
    monkeypatch.setattr(
        CholeskyFactor, "multiply", lambda self, x: calls.append(x.shape) or multiply(self, x)
    )
    apply(function, x)
    assert len(calls) == FACTOR_CALLS[name] + (layer in GEOMETRY and name == "checkpoint")


# ------------------------------------------------------- autocast


@pytest.mark.parametrize("name", LAYERS)
def test_autocast_does_not_round_geometry(name):
    """Under bfloat16 autocast: the same numbers to float32, forward and backward."""
    function, _, x = LAYERS[name](torch.float32, "cpu")
    leaf = x.clone().requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        value = function(leaf)
        result = loss(lambda x: value)(leaf)
    result.backward()
    assert value.dtype == torch.float32
    assert_near(value.detach(), function(x), 1e-6)
    assert_near(leaf.grad, grad(loss(function))(x), 1e-5)


# ------------------------------------------------------- torch.compile


COMPILED: dict[str, Callable[[Callable, Function, Tensor], Tensor]] = {}


def compiled(function: Callable) -> Callable:
    COMPILED[function.__name__.removeprefix("compiled_").replace("_", " ")] = function
    return function


@compiled
def compiled_forward(compile_, f, x):
    return compile_(f)(x)


@compiled
def compiled_backward(compile_, f, x):
    x = x.clone().requires_grad_()
    compile_(loss(f))(x).backward()
    return x.grad


@compiled
def compiled_grad(compile_, f, x):
    return compile_(grad(loss(f)))(x)


@compiled
def compiled_jvp(compile_, f, x):
    return compile_(lambda x, v: jvp(f, (x,), (v,))[1])(x, direction(x))


@compiled
def compiled_hessian_vector_product(compile_, f, x):
    return compile_(lambda x, v: jvp(grad(loss(f)), (x,), (v,))[1])(x, direction(x))


@pytest.fixture
def compile_(unchecked, monkeypatch):
    # Dynamo stumbles over shape checks, even disabled ones, on methods of objects made in a graph.
    for name in ("gradient", "divergence", "stiffness", "vertex_measures"):
        monkeypatch.setattr(CellGeometry, name, inspect.unwrap(getattr(CellGeometry, name)))
    torch.compiler.reset()
    yield lambda f, backend="aot_eager": torch.compile(f, fullgraph=True, backend=backend)
    torch.compiler.reset()


def as_it_is(f: Callable, backend: str = "") -> Callable:
    return f


COMPILED_LAYERS = ["jacobians", "divergence", "pins and handles", "concatenation", "geometry"]


@pytest.mark.parametrize("apply", COMPILED.values(), ids=COMPILED)
@pytest.mark.parametrize("name", COMPILED_LAYERS)
@devices
def test_compiled(apply, name, device, compile_):
    function, reference, x = LAYERS[name](torch.float64, device)
    function(x)  # assembles the mesh's operators
    actual, expected = apply(compile_, function, x), apply(as_it_is, reference, x)
    assert_near(actual.detach().cpu(), expected.detach().cpu(), RTOL[torch.float64])


def test_compiled_vmap(compile_):
    function, reference, x = LAYERS["pins and handles"](torch.float64, "cpu")
    batch = batch_of(x, 0)
    actual = compile_(vmap(grad(loss(function))))(batch)
    assert_near(actual, vmap(grad(loss(reference)))(batch), RTOL[torch.float64])


@pytest.mark.slow
def test_compiled_by_inductor(compile_):
    for name in ("pins and handles", "geometry"):
        function, reference, x = LAYERS[name](torch.float64, "cpu")
        actual = compiled_backward(functools.partial(compile_, backend="inductor"), function, x)
        assert_near(actual, grad(loss(reference))(x), RTOL[torch.float64])


def test_compiled_at_the_first_use_of_a_mesh(compile_):
    """Tracing cannot assemble operators: it says so, and what to do, and after that it works."""
    mesh = surface(torch.float64, "cpu")
    function, phi = compile_(lambda phi: dp.jacobians(mesh, phi)), values(8, 2)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="operators of this mesh are not assem"):
        function(phi)
    dp.PoissonSolver(mesh)
    torch.compiler.reset()
    assert_near(function(phi), dp.jacobians(mesh, phi), 1e-12)


# ------------------------------------------------------- what cannot be right raises


def moving_solver() -> tuple[dp.PoissonSolver, Tensor, Tensor]:
    mesh = surface(torch.float64, "cpu")
    return dp.PoissonSolver(mesh), field(mesh, c=2), mesh.vertices


def test_double_backward_through_compiled_code_raises(compile_):
    """AOTAutograd does not support it: torch raises, and nothing here turns that into zeros."""
    function, _, x = LAYERS["pins and handles"](torch.float64, "cpu")
    x = x.clone().requires_grad_()
    (g,) = torch.autograd.grad(compile_(loss(function))(x), x, create_graph=True)
    with pytest.raises(RuntimeError, match="double backward"):
        g.square().sum().backward()


@pytest.mark.parametrize("batched", ["vertices", "face_weights"])
def test_vmap_over_geometry_raises(batched):
    """A factor is of one geometry."""
    solver, R, v = moving_solver()
    given = {"vertices": v, "face_weights": torch.ones(len(R)).double()}[batched]
    with pytest.raises(ValueError, match="vmap gives one for each element of the batch"):
        vmap(lambda x: solver(R, **{batched: x}))(given.expand(2, *given.shape))
    with pytest.raises(ValueError, match="vmap gives one for each element of the batch"):
        vmap(grad(lambda x: solver(R, **{batched: x}).sum()))(given.expand(2, *given.shape))


def test_vmap_over_fields_with_moving_geometry():
    """That batch is fine: one geometry, several fields."""
    solver, R, v = moving_solver()
    batch = torch.stack([R, R.cos()])
    summed = lambda v, R: (solver(R, vertices=v) ** 3).sum()  # noqa: E731
    expected = torch.stack([grad(summed)(v, R) for R in batch])
    assert_near(vmap(grad(summed), (None, 0))(v, batch), expected, 1e-12)


OTHER_VERTICES = {
    "plain": lambda f, v: f(v),
    "grad": lambda f, v: grad(lambda v: f(v).sum())(v),
    "jvp": lambda f, v: jvp(f, (v,), (v,)),
    "hessian": lambda f, v: hessian(lambda v: f(v).sum())(v),
    "vmap over fields": lambda f, v: vmap(lambda s: f(v) * s)(torch.ones(2)),
}


@pytest.mark.parametrize("apply", OTHER_VERTICES.values(), ids=OTHER_VERTICES)
def test_other_vertices_raise(apply):
    solver, R, v = moving_solver()
    with pytest.raises(ValueError, match="vertices differ from those that were factorised"):
        apply(lambda v: solver(R, vertices=v), v + 1e-12)


def test_other_vertices_raise_in_compiled_code(compile_):
    """The code compiled for the solver's own positions checks them each time it runs."""
    solver, R, v = moving_solver()
    compiled = compile_(lambda v: solver(R, vertices=v))
    assert_near(compiled(v), solver(R), 1e-12)
    with pytest.raises(RuntimeError, match="vertices differ from those that were factorised"):
        compiled(v + 1e-12)


def test_vertices_edited_in_place_raise():
    """A mesh is immutable; who edits its tensors all the same gets no mixture of two geometries."""
    solver, R, v = moving_solver()
    expected = solver(R)
    v.mul_(2)
    assert torch.equal(solver(R), expected)
    with pytest.raises(ValueError, match="vertices differ from those that were factorised"):
        solver(R, vertices=v)


MESH_OF_MOVING_VERTICES = {
    "requires grad": lambda f, v: f(v.clone().requires_grad_()),
    "grad": lambda f, v: grad(f)(v),
    "jvp": lambda f, v: jvp(f, (v,), (v,)),
    "jacfwd": lambda f, v: jacfwd(f)(v),
    "vmap": lambda f, v: vmap(f)(v[None]),
}


@pytest.mark.parametrize("apply", MESH_OF_MOVING_VERTICES.values(), ids=MESH_OF_MOVING_VERTICES)
def test_a_mesh_of_moving_vertices_raises(apply):
    """It would be a constant, and every derivative by its vertices silently zero."""
    _, R, v = moving_solver()
    faces = surface(torch.float64, "cpu").faces
    with pytest.raises(dp.MeshError, match="vertices"):
        apply(lambda v: dp.PoissonSolver(dp.Mesh(v, faces))(R).sum(), v)
    solver = moving_solver()[0]
    with pytest.raises(dp.MeshError, match="vertices"):
        apply(lambda v: solver.update(v)(R).sum(), v)


def test_properties_are_documented_on_the_class():
    assert inspect.getdoc(dp.Mesh.measures) == inspect.getdoc(dp.Mesh.__dict__["measures"])
    assert dp.Mesh.measures.__doc__


def test_a_mesh_of_dual_vertices_raises():
    _, _, v = moving_solver()
    faces = surface(torch.float64, "cpu").faces
    with forward_ad.dual_level(), pytest.raises(dp.MeshError, match="vertices"):
        dp.Mesh(forward_ad.make_dual(v, v), faces)


def test_slim_of_a_moving_start_raises(unchecked):
    """Its result would be a constant."""
    mesh = mesh_of(meshes.disk(), torch.float64, "cpu")
    init = dp.tutte(mesh)
    for apply in (lambda f, x: f(x.clone().requires_grad_()), lambda f, x: jvp(f, (x,), (x,))):
        with pytest.raises(ValueError, match="init"):
            apply(lambda uv: dp.slim(mesh, uv).uv, init)


def test_moving_constants_of_a_solver_raise():
    """Handle and face weights given to the constructor are constants of the factor."""
    mesh = surface(torch.float64, "cpu")
    for name, count in (("face_weights", mesh.n_faces), ("handle_weights", 1)):
        options = {"handles": torch.tensor([0])}

        def build(w, name=name, options=options):
            solver = dp.PoissonSolver(mesh, **options, **{name: w})
            return solver(field(mesh, c=2), handles=values(1, 2)).sum()

        w = torch.ones(count, dtype=torch.float64)
        for apply in (
            lambda f, w: f(w.clone().requires_grad_()),
            lambda f, w: grad(f)(w),
            lambda f, w: jvp(f, (w,), (w,)),
        ):
            with pytest.raises(ValueError, match=name):
                apply(build, w)
