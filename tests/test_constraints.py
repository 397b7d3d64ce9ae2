"""Constraints and derivatives by the geometry: `constraint_checks.py`, random meshes, errors."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson import testing
from tests import constraint_checks, meshes, references
from tests.checks import LOCAL, SOLVE, assert_near, field
from tests.constraint_checks import anchored, assert_as_reference, images, solved


@pytest.mark.parametrize("check", constraint_checks.CHECKS.values(), ids=constraint_checks.CHECKS)
def test_property(check):
    check()


# ------------------------------------------------------- random meshes and constraints


@st.composite
def constrained(draw) -> tuple[dp.Mesh, dict]:
    """A mesh of any kind with a random part of its vertices pinned and pulled."""
    mesh = draw(testing.meshes(testing.TOPOLOGIES, max_log_scale=2))
    rng = np.random.default_rng(draw(testing.seeds))
    order = rng.permutation(mesh.n_vertices)
    n_pins = draw(st.integers(0, min(4, mesh.n_vertices - 1)))
    n_handles = draw(st.integers(0, min(4, mesh.n_vertices - n_pins)))
    options = {"gauge": draw(st.sampled_from(["mean", "vertex"]))}
    if n_pins:
        options["pins"] = (order[:n_pins], torch.from_numpy(rng.standard_normal((n_pins, 3))))
    if n_handles:
        handles = order[n_pins : n_pins + n_handles]
        options["handles"] = (handles, torch.from_numpy(rng.standard_normal((n_handles, 3))))
        # Handles compete with measures: weights in their unit keep both of them of order one.
        size = mesh.measures.mean()
        size = size ** (1 - 2 / mesh.cell_dim)  # the Laplacian's unit
        options["handle_weights"] = size * torch.from_numpy(rng.uniform(0.1, 3, n_handles))
    if draw(st.booleans()):
        options["face_weights"] = torch.from_numpy(rng.uniform(0.3, 3, mesh.n_faces))
    return mesh, options


@given(constrained())
def test_random_constraints_on_random_meshes(drawn):
    mesh, options = drawn
    assert_as_reference(mesh, field(mesh, k=mesh.dim), **options)


@given(constrained())
def test_geometry_gradient_on_random_meshes(drawn):
    mesh, options = drawn
    R = field(mesh, k=mesh.dim)
    y = images(mesh.n_vertices)
    v = mesh.vertices.clone().requires_grad_()
    expected = references.constrained_poisson(v, mesh.faces.numpy(), R, **options)
    (expected,) = torch.autograd.grad((expected * y).sum(), v)
    (actual,) = torch.autograd.grad((solved(mesh, R, {"vertices": v}, **options) * y).sum(), v)
    assert_near(actual, expected, 10 * SOLVE)


CONNECTED = {k: v for k, v in testing.TOPOLOGIES.items() if "parts" not in k}


@settings(max_examples=10)
@given(testing.meshes(CONNECTED, max_log_scale=2))
def test_equivariance(mesh):
    """A pinned map turns, moves and grows with the mesh, if the field turns with it."""

    def deform(mesh: dp.Mesh) -> torch.Tensor:
        """Stretches each face along its own centroid."""
        x = mesh.centroids - mesh.centroids[:1]
        R = x[:, :, None] * x[:, None, :] / mesh.measures.sum() ** (2 / mesh.cell_dim)
        return dp.solve_poisson(mesh, R, pins=(torch.tensor([1]), mesh.vertices[1:2]))

    testing.assert_equivariant(
        deform,
        mesh,
        per="vertex",
        rotates=True,
        translates=True,
        degree=1,
        under=("rotation", "scale"),
        rtol=1e-8,
    )


@settings(max_examples=10)
@given(testing.meshes(testing.TOPOLOGIES, max_log_scale=2))
def test_invariance(mesh):
    """Of a map of any mesh with a constant field, to what does not turn the mesh."""
    M = torch.from_numpy(np.random.default_rng(0).standard_normal((mesh.dim, mesh.dim)))
    testing.assert_equivariant(
        lambda mesh: dp.solve_poisson(mesh, M.expand(mesh.n_faces, -1, -1)),
        mesh,
        per="vertex",
        degree=1,
        under=("translation", "scale", "permutation"),
        rtol=1e-8,
    )


@pytest.mark.parametrize("name", meshes.SPATIAL)
def test_frames_do_not_matter(name):
    mesh = dp.Mesh(*meshes.SPATIAL[name](0))
    R = field(mesh, k=2)
    pins = torch.tensor([1])
    testing.assert_frame_invariant(
        lambda mesh, R: dp.PoissonSolver(mesh, pins=pins)(R, pins=images(1)), mesh, R
    )
    testing.assert_frame_invariant(
        lambda mesh, R: dp.divergence(mesh, R, vertices=mesh.vertices), mesh, R
    )
    phi = images(mesh.n_vertices)
    testing.assert_frame_invariant(
        lambda mesh: dp.jacobians(mesh, phi), mesh, intrinsic_output=True
    )


# ------------------------------------------------------- the rest of the interface


def test_masks_are_indices_in_ascending_order():
    mesh = dp.Mesh(*meshes.disk())
    pins, handles = torch.tensor([3, 8, 20]), torch.tensor([1, 9])
    R, q, p = field(mesh), images(3), images(2)
    expected = dp.PoissonSolver(mesh, pins=pins, handles=handles)(R, pins=q, handles=p)
    as_mask = torch.zeros(2, 25, dtype=torch.bool)
    as_mask[0, pins] = True
    as_mask[1, handles] = True
    masked = dp.PoissonSolver(mesh, pins=as_mask[0], handles=as_mask[1])
    assert torch.equal(masked(R, pins=q, handles=p), expected)


def test_frozen_region():
    """A mask of pins with their positions keeps a region exactly where it is."""
    mesh = dp.Mesh(*meshes.disk(size=7))
    frozen = mesh.vertices[:, 0] < 0.5
    phi = dp.solve_poisson(mesh, field(mesh), pins=(frozen, mesh.vertices[frozen]))
    assert torch.equal(phi[frozen], mesh.vertices[frozen])
    assert (phi[~frozen] - mesh.vertices[~frozen]).abs().max() > 0.01


def test_one_shot_with_constraints():
    mesh, R, options = anchored()
    (pins, q), (handles, p) = options.pop("pins"), options.pop("handles")
    pins, handles = torch.from_numpy(pins), torch.from_numpy(handles)
    expected = dp.PoissonSolver(mesh, pins=pins, handles=handles, **options)(R, pins=q, handles=p)
    actual = dp.solve_poisson(mesh, R, pins=(pins, q), handles=(handles, p), **options)
    assert torch.equal(actual, expected)


def test_all_but_one_vertex_pinned():
    mesh = dp.Mesh(*meshes.disk())
    pins = np.setdiff1d(np.arange(25), 12)
    assert_as_reference(mesh, field(mesh), pins=(pins, images(24)))


def test_everything_held_leaves_nothing_to_the_gauge():
    mesh = dp.Mesh(*meshes.disk())
    R, options = field(mesh), {"pins": (np.array([4]), images(1))}
    expected = solved(mesh, R, **options)
    mask = torch.zeros(25, dtype=torch.bool)
    for gauge in ("vertex", mask):
        assert torch.equal(solved(mesh, R, gauge=gauge, **options), expected)
    assert torch.equal(solved(mesh, R, {"translations": images(0)}, **options), expected)


def test_single_precision():
    """float32 in and out, solved in float64, by images and by geometry."""
    mesh, R, options = anchored()
    single = dp.Mesh(mesh.vertices.float(), mesh.faces)
    rounded = dp.Mesh(single.vertices.double(), mesh.faces)
    halved = options | {
        name: (options[name][0], options[name][1].float()) for name in ("pins", "handles")
    }
    v = single.vertices.clone().requires_grad_()
    phi = solved(single, R.float(), {"vertices": v}, **halved)
    phi.square().sum().backward()
    w = rounded.vertices.clone().requires_grad_()
    doubled = options | {
        name: (halved[name][0], halved[name][1].double()) for name in ("pins", "handles")
    }
    expected = solved(rounded, R.float().double(), {"vertices": w}, **doubled)
    expected.square().sum().backward()
    assert phi.dtype == v.grad.dtype == torch.float32
    assert_near(phi.detach(), expected.detach(), 1e-6)
    assert_near(v.grad, w.grad, 1e-5)
    turns = field(mesh, seed=1).float()
    phi = solved(single, R.float(), {"transforms": turns}, **halved)
    expected = solved(rounded, turns.double() @ R.float().double(), **doubled)
    assert torch.equal(phi, expected.float())


def test_update_keeps_what_depends_on_the_faces():
    mesh = dp.Mesh(*meshes.parts())
    solver = dp.PoissonSolver(mesh)
    moved = solver.update(mesh.vertices * 2).mesh
    assert moved.faces is mesh.faces
    assert moved.components is mesh.components
    assert torch.equal(moved.vertices, mesh.vertices * 2)
    assert_near(moved.measures, 4 * mesh.measures, LOCAL)
    assert torch.equal(mesh.vertices, solver.mesh.vertices)


def test_descent_on_the_geometry():
    """Updates along the gradient lead back to the mesh whose map was given."""
    vertices, faces = meshes.planar_disk(size=5)
    target, boundary = dp.Mesh(vertices, faces), torch.zeros(25, dtype=torch.bool)
    grid = torch.arange(25).view(5, 5)
    for side in (grid[0], grid[-1], grid[:, 0], grid[:, -1]):
        boundary[side] = True
    inner = (~boundary)[:, None]
    R = field(target, c=2, k=2) + torch.eye(2).double() * 3
    wanted = dp.solve_poisson(target, R)
    v = target.vertices + 0.02 * inner * images(25, 2)
    solver, losses = dp.PoissonSolver(target), []
    for _ in range(25):
        solver, v = solver.update(v), v.detach().requires_grad_()
        loss = (solver(R, vertices=v) - wanted).square().sum()
        losses.append(loss.item())
        (slope,) = torch.autograd.grad(loss, v)
        v = (v - 0.02 * inner * slope).detach()
    assert losses[-1] < 1e-4 * losses[0]


# ------------------------------------------------------- errors


def options_table() -> dict[str, tuple[dict, str]]:
    """Options of a solver on the 25 vertices and 32 faces of a disk, and what is wrong."""
    i, f = torch.tensor, torch.float64
    few = torch.zeros(32, dtype=f)
    few[:2] = 1
    return {
        "pins twice": ({"pins": i([3, 3, 5, 5, 1])}, "pins name 2 vertices [3, 5] twice"),
        "handles twice": ({"handles": i([7, 7])}, "handles name 1 vertex [7] twice"),
        "pins too large": (
            {"pins": i([0, 25, 30])},
            "pins 2 entries [1, 2] outside 0 … 24",
        ),
        "pins negative": ({"pins": i([-1])}, "pins 1 entry [0] outside 0 … 24"),
        "handles too large": ({"handles": i([99])}, "handles 1 entry [0] outside 0 … 24"),
        "both": (
            {"pins": i([1, 2, 3]), "handles": i([9, 3, 1])},
            "2 vertices [3, 1] both pinned and handles",
        ),
        "all pinned": ({"pins": torch.arange(25)}, "every vertex is pinned"),
        "all pinned by mask": (
            {"pins": torch.ones(25, dtype=torch.bool)},
            "every vertex is pinned",
        ),
        "float pins": (
            {"pins": i([1.0])},
            "pins must be (k,) int64 vertex indices or a (n=25,) mask, got (1,) torch.float32",
        ),
        "two-dimensional pins": ({"pins": i([[1], [2]])}, "got (2, 1) torch.int64"),
        "short mask": ({"handles": torch.ones(24, dtype=torch.bool)}, "got (24,) torch.bool"),
        "weights of another number": (
            {"handles": i([1, 2]), "handle_weights": torch.ones(3, dtype=f)},
            "handle_weights must be a number or of shape (2,), got (3,)",
        ),
        "zero weight": (
            {"handles": i([1, 2]), "handle_weights": i([1.0, 0.0], dtype=f)},
            "handle_weights must be positive and finite; leave out handles without weight",
        ),
        "negative weight": ({"handles": i([1]), "handle_weights": -1.0}, "must be positive"),
        "infinite weight": (
            {"handles": i([1]), "handle_weights": float("inf")},
            "must be positive and finite",
        ),
        "nan weight": (
            {"handles": i([1]), "handle_weights": float("nan")},
            "must be positive and finite",
        ),
        "handle weights with gradient": (
            {"handles": i([1]), "handle_weights": torch.ones(1, dtype=f, requires_grad=True)},
            "handle_weights require grad, but a factor is constant",
        ),
        "face weights with gradient": (
            {"face_weights": torch.ones(32, dtype=f, requires_grad=True)},
            "pass face_weights.detach() here, and face_weights=... to the solver's call",
        ),
        "face weights of another number": (
            {"face_weights": torch.ones(31, dtype=f)},
            "face_weights must be of shape (m=32,), got (31,)",
        ),
        "negative face weights": (
            {"face_weights": torch.arange(32, dtype=f) - 2},
            "face_weights of 2 faces [0, 1] negative or not finite",
        ),
        "infinite face weights": (
            {"face_weights": torch.full((32,), torch.inf, dtype=f)},
            "32 faces [0, 1, 2, 3, 4, …] negative or not finite",
        ),
        "uncovered vertices": (
            {"face_weights": few},
            "20 vertices [2, 3, 4, 8, 9, …] only in faces of weight zero, so undetermined",
        ),
        "unknown gauge": ({"gauge": "first"}, "gauge must be 'mean', 'vertex' or a mask"),
        "short gauge mask": (
            {"gauge": torch.ones(24, dtype=torch.bool)},
            "a gauge mask must be (n=25,) bool, got (24,) torch.bool",
        ),
        "float gauge mask": (
            {"gauge": torch.ones(25)},
            "a gauge mask must be (n=25,) bool, got (25,) torch.float32",
        ),
        "empty gauge mask": (
            {"gauge": torch.zeros(25, dtype=torch.bool)},
            "the gauge mask has no vertex in floating 1 component [0]; add one, or pin it",
        ),
    }


@pytest.mark.parametrize("name", options_table())
def test_wrong_options_raise(name, unchecked):
    options, message = options_table()[name]
    with pytest.raises(ValueError, match="^PoissonSolver: .*" + re.escape(message)):
        dp.PoissonSolver(dp.Mesh(*meshes.disk()), **options)


def test_mask_must_reach_every_floating_component(unchecked):
    mesh = dp.Mesh(*meshes.parts())
    mask = mesh.components == 1
    message = re.escape("no vertex in floating 2 components [0, 2]")
    with pytest.raises(ValueError, match=message):
        dp.PoissonSolver(mesh, gauge=mask)
    held = dp.PoissonSolver(mesh, gauge=mask, pins=torch.tensor([0, mesh.n_vertices - 1]))
    assert held.n_floating == 1


def calls_table() -> dict[str, tuple[dict, str]]:
    """Arguments of a call for two pins, one handle and a batch of 4, and what is wrong."""
    one, two = torch.zeros(1, 3).double(), torch.zeros(2, 3).double()
    good = {"pins": two, "handles": one}
    batch = "with … broadcasting to the batch (4,) of R, got"
    moved = dp.Mesh(*meshes.disk()).vertices + 1e-9
    weights = torch.full((32,), 1 + 1e-9, dtype=torch.float64)
    return {
        "no pins": ({"handles": one}, "images missing for 2 pins"),
        "no handles": ({"pins": two}, "images missing for 1 handles"),
        "fewer pins": (
            {"pins": one, "handles": one},
            f"expected pins of shape (…, 2, 3), {batch} (1, 3)",
        ),
        "other coordinates": (
            good | {"handles": torch.zeros(1, 2).double()},
            f"expected handles of shape (…, 1, 3), {batch} (1, 2)",
        ),
        "other batch": (good | {"pins": two.expand(3, 2, 3)}, f"{batch} (3, 2, 3)"),
        "more batch": (good | {"pins": two.expand(2, 4, 2, 3)}, f"{batch} (2, 4, 2, 3)"),
        "vector": (good | {"handles": torch.zeros(3).double()}, f"{batch} (3,)"),
        "translations of what is held": (
            good | {"translations": one},
            f"expected translations of shape (…, 0, 3), {batch} (1, 3)",
        ),
        "transforms of another shape": (
            good | {"transforms": torch.zeros(32, 2, 3).double()},
            f"expected transforms of shape (…, 32, 3, 3), {batch} (32, 2, 3)",
        ),
        "transforms of other faces": (
            good | {"transforms": torch.zeros(1, 3, 3).double()},
            f"expected transforms of shape (…, 32, 3, 3), {batch} (1, 3, 3)",
        ),
        "other vertices": (
            good | {"vertices": moved},
            "vertices differ from those that were factorised; solve with solver.update(vertices)",
        ),
        "other face weights": (good | {"face_weights": weights}, "face_weights differ from those"),
    }


@pytest.mark.parametrize("name", calls_table())
def test_wrong_calls_raise(name, unchecked):
    given, message = calls_table()[name]
    mesh = dp.Mesh(*meshes.disk())
    solver = dp.PoissonSolver(mesh, pins=torch.tensor([1, 2]), handles=torch.tensor([5]))
    with pytest.raises(ValueError, match="^PoissonSolver: .*" + re.escape(message)):
        solver(field(mesh, batch=(4,)), **given)


def test_images_for_nothing_raise(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    for name in ("pins", "handles"):
        with pytest.raises(ValueError, match=f"images given for 0 {name}"):
            dp.PoissonSolver(mesh)(field(mesh), **{name: images(1)})


def test_positions_of_another_shape_raise(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    for function in (
        lambda v: dp.jacobians(mesh, mesh.vertices, vertices=v),
        lambda v: dp.divergence(mesh, field(mesh), vertices=v),
        lambda v: dp.PoissonSolver(mesh)(field(mesh), vertices=v),
    ):
        with pytest.raises(ValueError, match=r"vertices"):
            function(mesh.vertices[:24])
        with pytest.raises(ValueError, match=r"vertices"):
            function(mesh.vertices[:, :2])


def test_a_number_is_not_rounded(unchecked):
    """A weight given as a Python number is that number, not its float32 rounding."""
    mesh = dp.Mesh(*meshes.disk())
    R, handles, q = field(mesh), torch.tensor([3, 7]), torch.ones(2, 3, dtype=torch.float64)
    for weights in (0.7, [0.7, 0.7]):
        given = dp.PoissonSolver(mesh, handles=handles, handle_weights=weights)
        exact = torch.full((2,), 0.7, dtype=torch.float64)
        expected = dp.PoissonSolver(mesh, handles=handles, handle_weights=exact)
        assert torch.equal(given(R, handles=q), expected(R, handles=q))


def test_numbers_of_any_width():
    """Indices of 32 bits and weights of single precision are converted, exactly."""
    mesh = dp.Mesh(*meshes.disk())
    R = field(mesh)
    pins, handles = torch.tensor([5, 1]), torch.tensor([3, 7])
    q = torch.eye(3, dtype=torch.float64)[:2]
    strengths = torch.tensor([0.3, 2])
    weights = torch.arange(mesh.n_faces, dtype=torch.float32) / 7 + 1

    def solution(indices, reals):
        options = {"handle_weights": strengths.to(reals), "face_weights": weights.to(reals)}
        solver = dp.PoissonSolver(
            mesh, pins=pins.to(indices), handles=handles.to(indices), **options
        )
        given = {"pins": q, "handles": 2 * q}
        assert solver.constraints.face_weights.dtype == torch.float64
        union = dp.PoissonSolver.concatenate([solver])
        return union(R, **given), solver(R, **given, face_weights=weights.to(reals))

    expected = solution(torch.int64, torch.float64)
    for actual, exact in zip(solution(torch.int32, torch.float32), expected, strict=True):
        assert torch.equal(actual, exact)


def test_handles_are_of_strength_one_by_default():
    mesh, handles = dp.Mesh(*meshes.disk()), torch.tensor([3, 7])
    R, q = field(mesh), torch.ones(2, 3, dtype=torch.float64)
    default = dp.PoissonSolver(mesh, handles=handles)
    one = dp.PoissonSolver(mesh, handles=handles, handle_weights=1.0)
    assert torch.equal(default(R, handles=q), one(R, handles=q))


@pytest.mark.parametrize("weight", [2.0, 0.5])
def test_uniform_face_weights_count_against_handles(weight):
    """Face weights w and handles of strength w a are faces without weights and handles a."""
    mesh = dp.Mesh(*meshes.disk())
    R, targets = field(mesh), torch.eye(3, dtype=torch.float64)[:2]
    handles = torch.tensor([3, 7])
    plain = dp.PoissonSolver(mesh, handles=handles, handle_weights=0.3)
    weights = torch.full((mesh.n_faces,), weight, dtype=torch.float64)
    scaled = dp.PoissonSolver(
        mesh, handles=handles, handle_weights=0.3 * weight, face_weights=weights
    )
    assert_near(scaled(R, handles=targets), plain(R, handles=targets), SOLVE)


def test_editing_a_gauge_mask_afterwards_changes_nothing():
    mesh = dp.Mesh(*meshes.disk())
    mask = torch.arange(mesh.n_vertices) < 4
    solver, R = dp.PoissonSolver(mesh, gauge=mask), field(mesh)
    expected = solver(R)
    mask[:] = True
    assert torch.equal(solver(R), expected)
    assert_near(solver.update(mesh.vertices)(R), expected, SOLVE)
    assert_near(dp.PoissonSolver.concatenate([solver])(R), expected, SOLVE)
