"""Properties of constraints, of derivatives by the geometry, and of other cells than triangles.

Like `checks.py`: each a function that asserts, run on the package as it is by
`test_constraints.py`, and on broken versions of it by `test_faults.py`. The oracle is one dense
saddle-point system with everything in it (`references.constrained_poisson`), which torch can
differentiate too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch
from torch import Tensor
from torch.func import jvp

import diffpoisson as dp
from tests import meshes, references
from tests.checks import LOCAL, SOLVE, assert_near, field, normal

CHECKS: dict[str, Callable[[], None]] = {}


def check(function: Callable[[], None]) -> Callable[[], None]:
    CHECKS[function.__name__.removeprefix("check_")] = function
    return function


# ------------------------------------------------------- tools


EVERY = tuple((meshes.TOPOLOGIES | meshes.TETRAHEDRAL).values())
MIXED = (meshes.parts, meshes.tetrahedral_parts)  # of several components
SOLIDS = tuple(meshes.TETRAHEDRAL.values())


def images(count: int, c: int = 3, seed: int = 1) -> Tensor:
    return torch.from_numpy(normal((count, c), seed))


def some(mesh: dp.Mesh, count: int, seed: int = 0) -> np.ndarray:
    """Distinct vertices of one component, in no order."""
    component = np.flatnonzero(mesh.components.numpy() == mesh.n_components - 1)
    return np.random.default_rng(seed).permutation(component)[:count]


def solved(mesh: dp.Mesh, R: Tensor, call: dict[str, Any] | None = None, **options: Any) -> Tensor:
    """`dp.solve_poisson` with pins and handles as (indices, images), and what else a call takes."""
    given = {}
    for name in ("pins", "handles"):
        if name in options:
            indices, given[name] = options[name]
            options[name] = torch.from_numpy(indices)
    return dp.PoissonSolver(mesh, **options)(R, **given, **(call or {}))


def assert_as_reference(mesh: dp.Mesh, R: Tensor, *, rtol: float = SOLVE, **options: Any) -> None:
    weights = options.get("face_weights")
    ignored = None if weights is None else (weights == 0).numpy()
    expected = references.constrained_poisson(
        mesh.vertices, mesh.faces.numpy(), R, ignored=ignored, **options
    )
    call = {name: options.pop(name) for name in ("translations",) if name in options}
    assert_near(solved(mesh, R, call, **options), expected, rtol)


def anchored(c: int = 3) -> tuple[dp.Mesh, Tensor, dict[str, Any]]:
    """A mesh of four components with every constraint: pinned, pinned and pulled, pulled, free."""
    arrays = (meshes.disk(0, 3), meshes.book(), meshes.disk(1, 3), meshes.bowtie())
    mesh = dp.Mesh(*meshes.union(*arrays))
    mask = torch.zeros(mesh.n_vertices, dtype=torch.bool)
    mask[[1, 2, 24, 26]] = True
    options = {
        "pins": (np.array([7, 3, 11]), images(3, c)),
        "handles": (np.array([20, 9, 13]), images(3, c, seed=2)),
        "handle_weights": torch.tensor([0.5, 2.0, 1.0], dtype=torch.float64),
        "face_weights": torch.from_numpy(np.random.default_rng(3).uniform(0.5, 2, mesh.n_faces)),
        "gauge": mask,
    }
    return mesh, field(mesh, c=c), options


# ------------------------------------------------------- constraints against the saddle point


@check
def check_pins() -> None:
    """One or several, in any order; the components without one float."""
    for build in EVERY:
        mesh = dp.Mesh(*build(0))
        R = field(mesh, k=mesh.dim)
        for count in (1, 2):
            assert_as_reference(mesh, R, pins=(some(mesh, count), images(count)))
    pins = (some(mesh, 2), images(2))
    assert torch.equal(solved(mesh, R, pins=pins)[pins[0]], pins[1])


@check
def check_handles() -> None:
    """Of different strengths, on some of the components."""
    strengths = torch.tensor([0.3, 5.0], dtype=torch.float64)
    for build in EVERY:
        mesh = dp.Mesh(*build(0))
        handles = (some(mesh, 2), images(2))
        R = field(mesh, k=mesh.dim)
        assert_as_reference(mesh, R, handles=handles, handle_weights=strengths)
        assert_as_reference(mesh, R, handles=handles, handle_weights=2.0)


@check
def check_handles_tend_to_pins() -> None:
    """The stronger, the closer: the distance falls like the inverse of the weight."""
    mesh = dp.Mesh(*meshes.parts())
    R, held = field(mesh), (some(mesh, 2), images(2))
    pinned = solved(mesh, R, pins=held)
    for weight in (1e4, 1e6, 1e8):
        error = (solved(mesh, R, handles=held, handle_weights=weight) - pinned).abs().max()
        assert error < 20 / weight


@check
def check_weak_handles_only_translate() -> None:
    """The weaker, the closer to the free map, put where the handles' mean wants it."""
    mesh = dp.Mesh(*meshes.disk())
    R, (handles, q) = field(mesh), (some(mesh, 3), images(3))
    free = solved(mesh, R)
    expected = free + (q - free[handles]).mean(0)
    for weight in (1e-3, 1e-5):
        phi = solved(mesh, R, handles=(handles, q), handle_weights=weight)
        assert (phi - expected).abs().max() < 20 * weight


@check
def check_face_weights() -> None:
    """Positive factors on the measures, which change the fit but not the gauge."""
    for build in EVERY:
        mesh = dp.Mesh(*build(0))
        weights = torch.from_numpy(np.random.default_rng(0).uniform(0.1, 3, mesh.n_faces))
        assert_as_reference(mesh, field(mesh, k=mesh.dim), face_weights=weights)


@check
def check_ignored_faces() -> None:
    """Weight zero leaves a face out, which can split a component in two that both float."""
    vertices, faces = meshes.planar_disk(size=6)
    centre = vertices[faces].mean(1)[:, 0]
    weights = torch.from_numpy(np.where((centre > 0.4) & (centre < 0.6), 0.0, 1.0))
    mesh = dp.Mesh(vertices, faces)
    R = field(mesh, k=2)
    assert dp.PoissonSolver(mesh, face_weights=weights).n_floating == 2
    assert_as_reference(mesh, R, face_weights=weights)
    R[weights == 0] += 1e6
    assert_as_reference(mesh, R, face_weights=weights)
    assert_as_reference(mesh, R, face_weights=weights, pins=(np.array([35]), images(1)))


@check
def check_masked_gauge() -> None:
    for build in MIXED:
        mesh = dp.Mesh(*build(0))
        mask = torch.zeros(mesh.n_vertices, dtype=torch.bool)
        for label in range(mesh.n_components):
            mask[(mesh.components == label).nonzero()[1:3, 0]] = True
        assert_as_reference(mesh, field(mesh), gauge=mask)


@check
def check_translations() -> None:
    """Where each floating component goes, under every gauge, the held ones untouched."""
    for build in MIXED:
        mesh = dp.Mesh(*build(0))
        R, q = field(mesh), images(mesh.n_components)
        for gauge in ("mean", "vertex"):
            assert_as_reference(mesh, R, gauge=gauge, translations=q)
            held = {"pins": (np.array([0]), images(1, seed=5))}
            assert_as_reference(mesh, R, gauge=gauge, translations=q[1:], **held)


@check
def check_every_constraint_at_once() -> None:
    """On surfaces and volumes, including a component that holds both pins and handles."""
    mesh, R, options = anchored()
    translations = images(1, seed=4)
    assert_as_reference(mesh, R, translations=translations, **options)
    solid = dp.Mesh(*meshes.tetrahedral_parts())
    strengths = torch.tensor([0.2, 3.0], dtype=torch.float64)
    assert_as_reference(
        solid,
        field(solid),
        pins=(np.array([2]), images(1)),
        handles=(np.array([12, 0]), images(2)),
        handle_weights=strengths,
        translations=translations,
        gauge="vertex",
    )


@check
def check_transforms() -> None:
    """Matrices that multiply those of the field from the left, one per face."""
    mesh, R, options = anchored()
    T = torch.from_numpy(normal((mesh.n_faces, 3, 3), 8))
    expected = solved(mesh, torch.einsum("fij,fjk->fik", T, R), **options)
    assert_near(solved(mesh, R, {"transforms": T}, **options), expected, LOCAL)


@check
def check_batches_of_images() -> None:
    """Leading dimensions of images, translations and transforms broadcast to those of R."""
    mesh, _, options = anchored()
    pins, handles = options.pop("pins"), options.pop("handles")
    R = field(mesh, batch=(2, 4))
    solver = dp.PoissonSolver(
        mesh, pins=torch.from_numpy(pins[0]), handles=torch.from_numpy(handles[0]), **options
    )
    given = {
        "pins": torch.from_numpy(normal((4, 3, 3), 1)),
        "handles": torch.from_numpy(normal((2, 1, 3, 3), 2)),
        "translations": torch.from_numpy(normal((2, 4, 1, 3), 3)),
        "transforms": torch.from_numpy(normal((1, 4, mesh.n_faces, 3, 3), 4)),
    }
    whole = solver(R, **given)
    full = {
        k: v.expand(2, 4, *v.shape[-3 if k == "transforms" else -2 :]) for k, v in given.items()
    }
    for i, j in np.ndindex(2, 4):
        single = solver(R[i, j], **{name: value[i, j] for name, value in full.items()})
        assert_near(whole[i, j], single, LOCAL)


# ------------------------------------------------------- unions, updates, wide batches


@check
def check_constrained_union() -> None:
    """A batch of solvers with different constraints gives what each gives alone."""
    mesh, R, options = anchored()
    images_of = {name: options.pop(name) for name in ("pins", "handles")}
    constrained = dp.PoissonSolver(
        mesh, **{name: torch.from_numpy(value[0]) for name, value in images_of.items()}, **options
    )
    given = {name: value[1] for name, value in images_of.items()}
    pinned = dp.PoissonSolver(dp.Mesh(*meshes.torus()), pins=torch.tensor([30, 4]))
    pulled = dp.PoissonSolver(
        dp.Mesh(*meshes.parts()), handles=torch.tensor([50]), handle_weights=3.0
    )
    free = dp.PoissonSolver(dp.Mesh(*meshes.sphere()))
    solvers = [free, constrained, pulled, pinned]
    fields = [field(free.mesh), R, field(pulled.mesh), field(pinned.mesh)]
    counts = [solver.n_floating for solver in solvers]
    assert counts == [1, 1, 2, 0]
    q = images(sum(counts), seed=6).split(counts)
    alone = [
        free(fields[0], translations=q[0]),
        constrained(R, translations=q[1], **given),
        pulled(fields[2], handles=images(1), translations=q[2]),
        pinned(fields[3], pins=images(2)),
    ]
    together = dp.PoissonSolver.concatenate(solvers)(
        torch.cat(fields),
        pins=torch.cat([given["pins"], images(2)]),
        handles=torch.cat([given["handles"], images(1)]),
        translations=torch.cat(q),
    )
    assert_near(together, torch.cat(alone), LOCAL)


@check
def check_update() -> None:
    """A new solver of the moved mesh with the same constraints, also of a union."""
    mesh, R, options = anchored()
    given = {name: options[name][1] for name in ("pins", "handles")}
    named = {name: torch.from_numpy(options[name][0]) for name in ("pins", "handles")}
    solver = dp.PoissonSolver(mesh, **(options | named))
    other = dp.PoissonSolver(dp.Mesh(*meshes.disk()), handles=torch.tensor([3]))
    vertices = mesh.vertices * 1.5 + 0.02 * images(mesh.n_vertices)
    expected = references.constrained_poisson(vertices, mesh.faces.numpy(), R, **options)
    assert_near(solver.update(vertices)(R, **given), expected, SOLVE)

    union = dp.PoissonSolver.concatenate([solver, other])
    moved = union.update(torch.cat([vertices, other.mesh.vertices]))
    S, pull = field(other.mesh), images(1)
    handles = torch.cat([given["handles"], pull])
    expected = torch.cat([expected, other(S, handles=pull)])
    assert_near(moved(torch.cat([R, S]), pins=given["pins"], handles=handles), expected, SOLVE)


@check
def check_chunks() -> None:
    """More columns than a factor takes at once are solved a chunk at a time."""
    mesh = dp.Mesh(*meshes.disk())
    solver, R = dp.PoissonSolver(mesh), field(mesh, batch=(100,))
    expected = torch.stack([solver(single) for single in R])
    assert_near(solver(R), expected, LOCAL)


@check
def check_callers_tensors_are_copied() -> None:
    """Edits after the factorisation must not reach half of the system."""
    mesh, R, options = anchored()
    given = {name: options[name][1] for name in ("pins", "handles")}
    named = {name: torch.from_numpy(options[name][0].copy()) for name in ("pins", "handles")}
    mine = {name: value.clone() for name, value in (options | named).items()}
    solver = dp.PoissonSolver(mesh, **mine)
    for name in ("pins", "handles"):
        mine[name].copy_(mine[name].flip(0))
    mine["handle_weights"] *= 2
    mine["face_weights"] *= 3
    mine["gauge"].logical_not_()
    assert_near(solver(R, **given), solved(mesh, R, **options), LOCAL)


# ------------------------------------------------------- derivatives by the images


@check
def check_gradients_of_images() -> None:
    """By pins, handles, translations and transforms: the layer is affine in all of them."""
    mesh, R, options = anchored(c=2)
    (pins, q), (handles, p) = options.pop("pins"), options.pop("handles")
    solver = dp.PoissonSolver(
        mesh, pins=torch.from_numpy(pins), handles=torch.from_numpy(handles), **options
    )
    T = torch.from_numpy(normal((mesh.n_faces, 2, 2), 8))
    inputs = [x.clone().requires_grad_() for x in (q, p, images(1, 2), T)]
    steps = [torch.from_numpy(normal(tuple(x.shape), 9)) for x in inputs]

    def layer(q: Tensor, p: Tensor, t: Tensor, T: Tensor) -> Tensor:
        return solver(R, pins=q, handles=p, translations=t, transforms=T)

    phi = layer(*inputs)
    y = images(*phi.shape, seed=3)
    gradients = torch.autograd.grad((phi * y).sum(), inputs, materialize_grads=True)
    for i, (gradient, step) in enumerate(zip(gradients, steps, strict=True)):
        moved = [x + step if i == j else x for j, x in enumerate(inputs)]
        change = ((layer(*moved) - phi) * y).sum().detach()
        assert abs((gradient * step).sum() - change) <= SOLVE * abs(change)
        assert abs(change) > 1e-3
    tangent = jvp(layer, tuple(x.detach() for x in inputs), tuple(steps))[1]
    assert_near(tangent, (layer(*map(torch.add, inputs, steps)) - phi).detach(), SOLVE)


# ------------------------------------------------------- derivatives by the geometry


def geometry_case(intrinsic: bool = False) -> tuple[Callable, Callable, dp.Mesh, Tensor]:
    """The layer and its reference as functions of (vertices, face weights), all constraints on."""
    mesh, R, options = anchored(c=2)
    (pins, q), (handles, p) = options["pins"], options["handles"]
    built = options | {"pins": torch.from_numpy(pins), "handles": torch.from_numpy(handles)}
    solver = dp.PoissonSolver(mesh, **built)
    faces, weights = mesh.faces.numpy(), options["face_weights"]
    if intrinsic:
        R = R @ references.gram_schmidt_frames(mesh.vertices, faces)
    fixed = {name: value for name, value in options.items() if name != "face_weights"}

    def layer(v: Tensor, w: Tensor) -> Tensor:
        return solver(R, pins=q, handles=p, vertices=v, face_weights=w)

    def reference(v: Tensor, w: Tensor) -> Tensor:
        ambient = R @ references.gram_schmidt_frames(v, faces).mT if intrinsic else R
        return references.constrained_poisson(v, faces, ambient, face_weights=w, **fixed)

    return layer, reference, mesh, weights


@check
def check_geometry_changes_no_value() -> None:
    for intrinsic in (False, True):
        layer, reference, mesh, weights = geometry_case(intrinsic)
        actual = layer(mesh.vertices, weights)
        assert_near(actual, reference(mesh.vertices, weights), SOLVE)


@check
def check_geometry_gradient() -> None:
    """Of first order, in both modes, with moving frames and with fixed ambient matrices."""
    for intrinsic in (False, True):
        layer, reference, mesh, weights = geometry_case(intrinsic)
        v, w = mesh.vertices.clone().requires_grad_(), weights.clone().requires_grad_()
        y = torch.from_numpy(normal((mesh.n_vertices, 2), 7))
        actual = torch.autograd.grad((layer(v, w) * y).sum(), (v, w), materialize_grads=True)
        expected = torch.autograd.grad((reference(v, w) * y).sum(), (v, w))
        for a, e in zip(actual, expected, strict=True):
            assert_near(a, e, SOLVE)
        directions = (images(mesh.n_vertices), images(mesh.n_faces, 1)[:, 0])
        primals = (mesh.vertices, weights)
        tangent = jvp(layer, primals, directions)[1]
        assert_near(tangent, jvp(reference, primals, directions)[1], SOLVE)


@check
def check_geometry_gradient_by_refactorising() -> None:
    """Central differences of solvers made anew, whatever the references say."""
    for build, intrinsic in ((meshes.parts, True), (meshes.box, False), (meshes.planar_disk, True)):
        mesh = dp.Mesh(*build(0))
        R = field(mesh, k=mesh.cell_dim if intrinsic else mesh.dim)
        direction = images(mesh.n_vertices, mesh.dim)
        layer = partial(dp.PoissonSolver(mesh), R)
        tangent = jvp(lambda v, layer=layer: layer(vertices=v), (mesh.vertices,), (direction,))[1]
        step = 1e-5 * mesh.measures.min().item() ** (1 / mesh.cell_dim)
        ahead, behind = (
            dp.PoissonSolver(mesh).update(mesh.vertices + h * direction)(R) for h in (step, -step)
        )
        assert_near(tangent, (ahead - behind) / (2 * step), 1e-6)


@check
def check_geometry_derivatives_of_higher_order() -> None:
    """First, second and third derivatives along a direction, in nested forward mode."""
    for intrinsic in (False, True):
        layer, reference, mesh, weights = geometry_case(intrinsic)
        direction = 0.1 * images(mesh.n_vertices)
        bend = 0.1 * weights.flip(0)

        def along(function: Callable, order: int) -> Tensor:
            def curve(t: Tensor) -> Tensor:
                return function(mesh.vertices + t * direction, weights + t * bend)  # noqa: B023

            for _ in range(order):
                curve = partial(_derivative, curve)
            return curve(torch.zeros((), dtype=torch.float64))

        for order in (1, 2, 3):
            assert_near(along(layer, order), along(reference, order), SOLVE)


def _derivative(curve: Callable, t: Tensor) -> Tensor:
    return jvp(curve, (t,), (torch.ones_like(t),))[1]


@check
def check_geometry_double_backward() -> None:
    """Second derivatives by reverse mode twice, by positions, weights, and both."""
    for intrinsic in (False, True):
        layer, reference, mesh, weights = geometry_case(intrinsic)
        y = images(mesh.n_vertices, 2, seed=7)
        steps = images(mesh.n_vertices), images(mesh.n_faces, 1)[:, 0]

        def curvature(function: Callable) -> tuple[Tensor, ...]:
            inputs = mesh.vertices.clone().requires_grad_(), weights.clone().requires_grad_()  # noqa: B023
            loss = (function(*inputs) * y).sum()  # noqa: B023
            slopes = torch.autograd.grad(loss, inputs, create_graph=True)
            along = sum((g * u).sum() for g, u in zip(slopes, steps, strict=True))  # noqa: B023
            return torch.autograd.grad(along, inputs)

        for actual, expected in zip(curvature(layer), curvature(reference), strict=True):
            assert_near(actual, expected, SOLVE)


@check
def check_geometry_of_the_operators() -> None:
    """Jacobians and divergence as functions of the positions: values and gradients."""
    for build in EVERY:
        vertices, faces = build(0)
        mesh = dp.Mesh(vertices, faces)
        phi, R = images(mesh.n_vertices, 2), field(mesh, c=2, k=mesh.dim)

        def gradients(
            J: Callable, div: Callable, mesh: dp.Mesh = mesh, R: Tensor = R
        ) -> list[Tensor]:
            v = mesh.vertices.clone().requires_grad_()
            loss = (J(v) * R).square().sum() + div(v).square().sum()
            return [J(v).detach(), div(v).detach(), *torch.autograd.grad(loss, v)]

        def reference_jacobians(v: Tensor, faces: np.ndarray = faces, phi: Tensor = phi) -> Tensor:
            return phi[faces].mT @ references.barycentric_gradients(v, faces)

        def reference_divergence(v: Tensor, faces: np.ndarray = faces, R: Tensor = R) -> Tensor:
            G = references.hat_gradient_matrix(v, faces)
            A = references.measures(v, faces).repeat_interleave(v.shape[1])
            return G.T @ (A[:, None] * R.mT.reshape(-1, 2))

        actual = gradients(
            lambda v, mesh=mesh, phi=phi: dp.jacobians(mesh, phi, extrinsic=True, vertices=v),
            lambda v, mesh=mesh, R=R: dp.divergence(mesh, R, vertices=v),
        )
        for a, e in zip(actual, gradients(reference_jacobians, reference_divergence), strict=True):
            assert_near(a, e, SOLVE)


@check
def check_moving_frames() -> None:
    """Intrinsic fields keep their coordinates while the frames turn with the faces."""
    mesh = dp.Mesh(*meshes.sphere())
    solver, R = dp.PoissonSolver(mesh), field(mesh, k=2)
    phi = images(mesh.n_vertices)
    spin = torch.tensor([[0.0, -3, 2], [3, 0, -1], [-2, 1, 0]], dtype=torch.float64)
    turning = (mesh.vertices,), (mesh.vertices @ spin.T,)
    # An isometry changes nothing that is measured within the surface, ...
    for intrinsic in (
        lambda v: solver(R, vertices=v),
        lambda v: dp.jacobians(mesh, phi, vertices=v),
        lambda v: dp.divergence(mesh, R, vertices=v),
    ):
        value, tangent = jvp(intrinsic, *turning)
        assert tangent.abs().max() < SOLVE * value.abs().max()
    # ... and turns the ambient Jacobian, J Qᵀ.
    J, tangent = jvp(lambda v: dp.jacobians(mesh, phi, extrinsic=True, vertices=v), *turning)
    assert_near(tangent, J @ spin.T, SOLVE)


# ------------------------------------------------------- tetrahedra


@check
def check_tetrahedra_against_barycentric_inverse() -> None:
    """Rows of the inverse of [1 x]: λ = [1 x]⁻¹ at once, whatever the orientation."""
    for build in SOLIDS:
        vertices, cells = build(0)
        mesh = dp.Mesh(vertices, cells)
        ones = np.ones((*cells.shape, 1))
        inverse = np.linalg.inv(np.concatenate([ones, vertices[cells]], axis=2))  # (m, 4, 4)
        phi = normal((len(vertices), 2))
        expected = np.einsum("mkc,mdk->mcd", phi[cells], inverse[:, 1:])
        assert_near(dp.jacobians(mesh, torch.from_numpy(phi)), expected, LOCAL * 10)
        volumes = np.abs(np.linalg.det(vertices[cells[:, 1:]] - vertices[cells[:, :1]])) / 6
        assert_near(mesh.volumes, volumes, LOCAL)


@check
def check_tetrahedra_against_sparse_lu() -> None:
    """SciPy's SuperLU on textbook stiffness matrices, one vertex pinned."""
    for build in (meshes.box, meshes.delaunay, meshes.inverted_box):
        vertices, cells = build(1)
        mesh = dp.Mesh(vertices, cells)
        R = field(mesh)
        ones = np.ones((*cells.shape, 1))
        g = np.linalg.inv(np.concatenate([ones, vertices[cells]], axis=2))[:, 1:]  # (m, 3, 4)
        volumes = np.abs(np.linalg.det(vertices[cells[:, 1:]] - vertices[cells[:, :1]])) / 6
        local = volumes[:, None, None] * (g.transpose(0, 2, 1) @ g)
        where = cells.repeat(4, axis=1).ravel(), np.tile(cells, 4).ravel()
        L = sp.csc_matrix((local.ravel(), where))
        b = np.zeros((len(vertices), 3))
        np.add.at(b, cells, volumes[:, None, None] * (R.numpy() @ g).transpose(0, 2, 1))
        phi = np.zeros_like(b)
        phi[1:] = scipy.sparse.linalg.spsolve(L[1:, 1:], b[1:])
        assert_near(solved(mesh, R, gauge="vertex"), phi, SOLVE)


@check
def check_inverted_tetrahedra() -> None:
    """The orientation of a cell does not matter."""
    vertices, cells = meshes.box(2)
    mesh, inverted = dp.Mesh(vertices, cells), dp.Mesh(vertices, cells[:, [1, 0, 2, 3]])
    R = field(mesh)
    assert_near(solved(inverted, R), solved(mesh, R), SOLVE)
    assert_near(inverted.volumes, mesh.volumes, LOCAL)


@check
def check_tetrahedral_rate() -> None:
    """R = ∇u + curl ψ, ψ × n = 0 on the boundary, is solved by u (Helmholtz) at rate h²."""
    pi, errors, sizes = np.pi, [], (5, 9, 17)
    for size in sizes:
        vertices, cells = meshes.box(0, size)
        mesh = dp.Mesh(vertices, cells)
        x, y, z = vertices[cells].mean(1).T
        sx, sy, sz = (np.sin(pi * s) for s in (x, y, z))
        cx, cy, cz = (np.cos(pi * s) for s in (x, y, z))
        gradient = np.stack([-sx * cy * cz, -cx * sy * cz, -cx * cy * sz], axis=1)
        # ψ = (sin πy sin πz, 0, 0), whose normal component alone is free at the boundary
        curl = np.stack([np.zeros_like(x), sy * cz, -cy * sz], axis=1)
        R = torch.from_numpy(pi * (gradient + curl))[:, None]
        u = np.prod(np.cos(pi * vertices), axis=1)
        weights = references.vertex_measures(mesh.vertices, cells).numpy()
        error = solved(mesh, R).numpy()[:, 0] - (u - weights @ u / weights.sum())
        errors.append(np.sqrt(weights @ error**2))
    rate = np.polyfit(-np.log(np.array(sizes) - 1), np.log(errors), 1)[0]
    assert 1.8 < rate < 2.3, rate


@check
def check_distortion_of_volumes() -> None:
    """Energies by the singular values of LAPACK, at flipped and unflipped Jacobians."""
    J = torch.from_numpy(normal((200, 3, 3)))
    det = torch.linalg.det(J)
    s = torch.linalg.svdvals(J) * torch.stack([torch.ones_like(det)] * 2 + [det.sign()], dim=1)
    assert_near(dp.singular_values(J), s, LOCAL)
    assert_near(dp.determinant(J), s.prod(1), LOCAL)
    assert torch.equal(dp.flipped(J), s[:, 2] < 0)
    assert_near(dp.arap(J), (s - 1).square().sum(1), LOCAL)
    keep = s[:, 2] > 0.1
    s, J = s[keep], J[keep]
    squares, inverses = s.square().sum(1), s.pow(-2).sum(1)
    assert_near(dp.symmetric_dirichlet(J), squares + inverses, LOCAL * 10)
    assert_near(dp.mips(J), (squares * inverses - 1) / 4, LOCAL * 10)
    assert_near(dp.area_distortion(J), s.prod(1) + 1 / s.prod(1), LOCAL * 10)
    assert_near(dp.isometric_distortion(J), torch.maximum(s[:, 0], 1 / s[:, 2]), LOCAL * 10)
