"""Arguments of the wrong kind: messages name the operation, the argument and the remedy."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

import diffpoisson as dp
from diffpoisson import arguments
from tests import meshes

pytestmark = pytest.mark.usefixtures("unchecked")
CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("value", "kind", "message"),
    [
        (np.zeros(3), TypeError, "f: x must be a torch tensor, got ndarray; convert it with torch"),
        (None, TypeError, "f: x must be a torch tensor, got NoneType"),
        (torch.zeros(3, dtype=torch.int64), TypeError, "a real floating dtype, got torch.int64"),
        (torch.zeros(3, dtype=torch.complex64), TypeError, "floating dtype, got torch.complex64"),
        (torch.zeros(3, 3).to_sparse(), TypeError, "f: x must be dense, got torch.sparse_coo"),
        (torch.zeros(3, device="meta"), ValueError, "f: x is on meta, the mesh on cpu"),
    ],
)
def test_tensors(value, kind, message):
    with pytest.raises(kind, match=re.escape(message)):
        arguments.require_tensor("f", "x", value, CPU)
    arguments.require_tensor("f", "x", torch.zeros(3).half(), CPU)
    arguments.require_tensor("f", "x", torch.zeros(3, device="meta"))


def test_single_or_double():
    for dtype in (torch.float32, torch.float64):
        arguments.require_single_or_double("f", "x", torch.zeros(1, dtype=dtype))
    with pytest.raises(TypeError, match=r"f: x must be float32 or float64, got torch\.bfloat16"):
        arguments.require_single_or_double("f", "x", torch.zeros(1).bfloat16())


@pytest.mark.parametrize("value", ["a", object(), 1j, torch.zeros(2, 2).to_sparse(), [[1], [1, 2]]])
def test_not_numeric(value):
    with pytest.raises(TypeError, match="f: x must be "):
        arguments.to_tensor("f", "x", value, CPU)


def test_arrays_that_torch_cannot_share():
    array = np.arange(3)
    array.flags.writeable = False
    assert arguments.to_tensor("f", "x", array, CPU).tolist() == [0, 1, 2]
    assert arguments.to_tensor("f", "x", array[::-1], CPU).tolist() == [2, 1, 0]


def test_integers():
    arguments.require_integer("f", "k", np.int32(2), least=2)
    arguments.require_integer("f", "k", -5)
    for value in (2.0, "2", None, True):
        with pytest.raises(TypeError, match=f"f: k must be an integer, got {type(value).__name__}"):
            arguments.require_integer("f", "k", value)
    with pytest.raises(ValueError, match="f: k must be at least 2, got 1"):
        arguments.require_integer("f", "k", 1, least=2)


def test_numbers():
    for value in (0, 0.0, 1e300, np.float32(2)):
        arguments.require_number("f", "a", value)
    for value in (-1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"finite and not negative, got {value}"):
            arguments.require_number("f", "a", value)
    with pytest.raises(TypeError, match="f: a must be a number, got str"):
        arguments.require_number("f", "a", "1")


def test_instances():
    arguments.require_instances("f", [1, 2], int)
    with pytest.raises(TypeError, match="f: expected a list of int, got int"):
        arguments.require_instances("f", 1, int)
    with pytest.raises(TypeError, match="f: expected a list of int, but entry 1 is of type str"):
        arguments.require_instances("f", [1, "a"], int)


@pytest.mark.parametrize(
    ("name", "others"),
    {
        "jacobians": (torch.zeros(3, 3),),
        "divergence": (torch.zeros(1, 3, 2),),
        "laplacian": (),
        "PoissonSolver": (),
        "laplacian_eigenpairs": (3,),
        "heat_kernel_signature": (torch.ones(1),),
        "lumped_mass": (),
        "sample_surface": (3,),
        "tutte": (),
        "slim": (torch.zeros(3, 2),),
    }.items(),
)
def test_another_library_s_mesh(name, others):
    import trimesh

    with pytest.raises(TypeError, match=f"{name}: expected a diffpoisson.Mesh, got Trimesh"):
        getattr(dp, name)(trimesh.creation.box(), *others)


MESH = dp.Mesh(*meshes.disk())
FIELD = dp.jacobians(MESH, MESH.vertices)
SOLVER = dp.PoissonSolver(MESH)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SOLVER(FIELD.numpy()), "PoissonSolver: R must be a torch tensor"),
        (lambda: SOLVER(FIELD, vertices=[0]), "PoissonSolver: vertices must be a torch tensor"),
        (lambda: SOLVER(FIELD, face_weights=1), "PoissonSolver: face_weights must be a torch"),
        (lambda: SOLVER(FIELD, translations=[0]), "PoissonSolver: translations must be a torch"),
        (lambda: SOLVER(FIELD, refinements=1.5), "PoissonSolver: refinements must be an integer"),
        (lambda: SOLVER.solve_laplacian([0]), "solve_laplacian: b must be a torch tensor"),
        (
            lambda: dp.PoissonSolver.concatenate([MESH]),
            "PoissonSolver.concatenate: expected a list",
        ),
        (lambda: dp.restrict([0], MESH.frames), "restrict: matrices must be a torch tensor"),
        (lambda: dp.restrict(FIELD, [0]), "restrict: frames must be a torch tensor"),
        (
            lambda: dp.restrict(FIELD, MESH.frames[0]),
            "restrict: expected frames of shape (m, D, d)",
        ),
        (lambda: dp.extend([0], MESH.frames), "extend: matrices must be a torch tensor"),
        (lambda: dp.jacobians(MESH, [0]), "jacobians: phi must be a torch tensor"),
        (lambda: dp.divergence(MESH, [0]), "divergence: R must be a torch tensor"),
        (lambda: dp.singular_values([0]), "distortion: J must be a torch tensor"),
        (lambda: dp.sample_surface(MESH, 1.5), "sample_surface: n_samples must be an integer"),
        (lambda: dp.laplacian_eigenpairs(MESH, 1.5), "laplacian_eigenpairs: n_eigenpairs must be"),
        (lambda: MESH.with_vertices([0, 1]), "Mesh"),
    ],
)
def test_operations_name_the_argument(call, message):
    with pytest.raises((TypeError, ValueError), match="^" + re.escape(message)):
        call()


def test_refinements():
    """They change nothing but roundings, under constraints too, and raise with moving geometry."""
    mesh = dp.Mesh(*meshes.parts())
    R = torch.randn(mesh.n_faces, 3, 3, dtype=torch.float64)
    pins, handles = torch.tensor([1, 4]), torch.tensor([2, 30, 33])  # they pull against faces
    solver = dp.PoissonSolver(mesh, pins=pins, handles=handles, handle_weights=3.0)
    images = {"pins": torch.randn(2, 3).double(), "handles": torch.randn(3, 3).double()}
    for given in (R, torch.stack([R, 2 * R])):
        expected = solver(given, **images)
        torch.testing.assert_close(solver(given, **images, refinements=2), expected)
    free = dp.PoissonSolver(mesh)
    torch.testing.assert_close(free(R, refinements=1), free(R))
    with pytest.raises(ValueError, match="refinements know the mesh's own geometry only"):
        solver(R, **images, vertices=mesh.vertices, refinements=1)
    with pytest.raises(ValueError, match="refinements must be at least 0, got -1"):
        solver(R, **images, refinements=-1)


@pytest.mark.parametrize("held", [False, True])
def test_one_refinement_mends_any_error(held):
    """Newton's method for a linear system: also of a map that is nowhere near."""
    mesh = dp.Mesh(*meshes.disk())
    kinds = {"pins": torch.tensor([0]), "handles": torch.tensor([3, 9])} if held else {}
    solver = dp.PoissonSolver(mesh, **kinds)
    images = {name: torch.randn(len(at), 3).double() for name, at in kinds.items()}
    R = torch.randn(mesh.n_faces, 3, 2, dtype=torch.float64)
    expected = solver(R, **images)
    noise = torch.randn_like(expected)
    noise = noise - (noise[0] if held else mesh.vertex_areas @ noise / mesh.vertex_areas.sum())
    pull = solver.constraints.handle_weights[:, None] * images["handles"] if held else None
    torch.testing.assert_close(solver._refined(expected + noise, R, pull), expected)


@pytest.mark.parametrize("name", ["needles", "caps", "one_sliver"])
def test_refinements_restore_digits(name):
    """On faces of aspect ratio 10,000, against sixty-digit arithmetic."""
    from tests.benchmarks import conditioning

    record = conditioning.measure(*conditioning.SHAPES[name](1e4))
    plain, refined = record["random"]["map"], record["random, refined"]["map"]
    assert plain < 1e-5
    assert refined < min(1e-10, plain / 100)
