"""As-rigid-as-possible maps: against libigl step by step, closed forms, and finite differences."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from torch.func import vmap

import diffpoisson as dp
from tests import meshes
from tests.checks import assert_near

KINDS = {
    "plane": lambda: dp.Mesh(*meshes.planar_disk(0, 5)),
    "surface": lambda: dp.Mesh(*meshes.sphere(0, subdivisions=1)),
    "tetrahedra": lambda: dp.Mesh(*meshes.box(0, 4)),
    "inverted tetrahedra": lambda: dp.Mesh(*meshes.inverted_box(0)),
}
kinds = pytest.mark.parametrize("kind", KINDS)


def held(mesh, share=0.25):
    """Both ends along x."""
    x = mesh.vertices[:, 0]
    margin = share * (x.max() - x.min())
    return torch.nonzero((x < x.min() + margin) | (x > x.max() - margin))[:, 0]


def pulled(mesh, pins, by=0.4):
    """One end moved sideways."""
    q = mesh.vertices[pins].clone()
    q[q[:, 0] > mesh.vertices[:, 0].mean(), 1] += by
    return q


def started(mesh, pins, q):
    return mesh.vertices.index_copy(0, pins, q)


def rotation(mesh, angle=1.0):
    if mesh.dim == 2:
        c, s = np.cos(angle), np.sin(angle)
        return torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    axis = torch.tensor([[0, -0.6, 0.8], [0.6, 0, 0], [-0.8, 0, 0]], dtype=torch.float64)
    return torch.linalg.matrix_exp(angle * axis)


def libigl(mesh, pins, q, steps):
    """libigl's iterate after so many steps from the rest position with its pins moved."""
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    if F.shape[1] == 4:  # it wants them positively oriented
        volumes = np.linalg.det(V[F[:, 1:]] - V[F[:, :1]])
        F = np.where(volumes[:, None] > 0, F, F[:, [0, 2, 1, 3]])
    data = igl.ARAPData()
    data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_ELEMENTS
    data.max_iter = steps
    igl.arap_precomputation(V, F, mesh.dim, pins.numpy().astype(np.int32), data)
    return torch.from_numpy(igl.arap_solve(q.numpy(), data, np.asfortranarray(V.copy())))


def energy(mesh, phi):
    """By numpy's singular values."""
    J = dp.jacobians(mesh, phi).numpy()
    U, s, Vt = np.linalg.svd(J)
    if J.shape[-1] == J.shape[-2]:
        s[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    return float((mesh.measures.numpy() * ((s - 1) ** 2).sum(-1)).sum())


@kinds
def test_step_by_step_as_libigl(kind):
    mesh = KINDS[kind]()
    pins = held(mesh)
    q = pulled(mesh, pins)
    solver = dp.PoissonSolver(mesh, pins=pins)
    start = started(mesh, pins, q)
    for steps in (1, 2, 7):
        found = dp.as_rigid_as_possible(
            solver, pins=q, start=start, tolerance=None, max_steps=steps
        )
        # libigl fits rotations in single precision, which each step of a membrane amplifies.
        assert_near(
            found.vertices, libigl(mesh, pins, q, steps), 1e-3 if kind == "surface" else 2e-5
        )
        assert found.energies.shape == (steps,)
        assert found.moves.shape == (steps - 1,)


@pytest.mark.parametrize("kind", ["plane", "tetrahedra", "inverted tetrahedra"])
def test_minimum_not_above_libigls(kind):
    mesh = KINDS[kind]()
    pins = held(mesh)
    q = pulled(mesh, pins)
    found = dp.as_rigid_as_possible(dp.PoissonSolver(mesh, pins=pins), pins=q, tolerance=1e-8)
    theirs = libigl(mesh, pins, q, 500)
    assert energy(mesh, found.vertices) <= energy(mesh, theirs) * (1 + 1e-9)
    assert_near(found.vertices, theirs, 1e-4)
    assert torch.equal(found.vertices[pins], q)
    assert found.moves[-1] <= 1e-8 < found.moves[-2]


@kinds
def test_energies_are_those_of_the_maps_and_never_grow(kind):
    mesh = KINDS[kind]()
    pins = held(mesh)
    solver = dp.PoissonSolver(mesh, pins=pins)
    q = pulled(mesh, pins)
    energies = dp.as_rigid_as_possible(solver, pins=q, tolerance=None, max_steps=12).energies
    for steps in (1, 2, 12):
        found = dp.as_rigid_as_possible(solver, pins=q, tolerance=None, max_steps=steps)
        assert float(found.energies[-1]) == pytest.approx(energy(mesh, found.vertices), rel=1e-10)
        assert_near(found.energies, energies[:steps], 1e-12)
    assert (energies.diff() < 0).all()


@kinds
def test_handles_that_move_rigidly_take_all_along(kind):
    """Energy zero, from rest, at a large turn: the global minimum is found."""
    mesh = KINDS[kind]()
    pins = held(mesh)
    turned = mesh.vertices @ rotation(mesh).T + 3
    solver = dp.PoissonSolver(mesh, pins=pins)
    found = dp.as_rigid_as_possible(solver, pins=turned[pins], tolerance=1e-8, max_steps=5000)
    assert_near(found.vertices, turned, 1e-5)
    assert float(found.energies[-1]) < 1e-10
    assert float(found.energies[0]) > 1e-3


def test_soft_handles_and_face_weights_are_in_the_energy():
    """A stationary point of the sum that is written down here, so that nothing is left out."""
    mesh = KINDS["tetrahedra"]()
    handles = held(mesh)
    strengths = 0.1 + torch.rand(len(handles), dtype=torch.float64)
    weights = 0.5 + torch.rand(mesh.n_faces, dtype=torch.float64)
    solver = dp.PoissonSolver(mesh, handles=handles, handle_weights=strengths, face_weights=weights)
    q = pulled(mesh, handles)
    found = dp.as_rigid_as_possible(solver, handles=q, tolerance=1e-10, max_steps=5000)
    assert (found.energies.diff() <= 1e-15).all()

    def objective(phi):
        density = dp.arap(dp.jacobians(mesh, phi))
        missed = (phi[handles] - q).square().sum(-1)
        return (weights * mesh.measures * density).sum() + (strengths * missed).sum()

    phi = found.vertices.requires_grad_()
    value = objective(phi)
    assert value.item() == pytest.approx(found.energies[-1].item(), rel=1e-10)
    (gradient,) = torch.autograd.grad(value, phi)
    assert gradient.abs().max() < 1e-8 * weights.max()


def test_a_start_gives_other_rotations_and_the_plane_for_surfaces():
    """ARAP parameterisation: from a start in the plane, of lower energy than it."""
    mesh = dp.Mesh(*meshes.disk(0, 5))
    solver = dp.PoissonSolver(mesh)
    uv = dp.tutte(mesh)
    found = dp.as_rigid_as_possible(solver, start=uv, tolerance=1e-6)
    assert found.vertices.shape == uv.shape
    assert float(found.energies[-1]) < 0.9 * energy(mesh, uv)
    turned = dp.as_rigid_as_possible(solver, start=-uv, tolerance=1e-6).vertices
    assert_near(turned, -found.vertices, 1e-9)


# ------------------------------------------------------- derivatives


@kinds
def test_gradient_of_an_iterate(kind):
    mesh = KINDS[kind]()
    pins = held(mesh)
    solver = dp.PoissonSolver(mesh, pins=pins)
    q = pulled(mesh, pins)

    def iterate(q, start):
        found = dp.as_rigid_as_possible(solver, pins=q, start=start, tolerance=None, max_steps=3)
        return found.vertices[::5], found.energies

    inputs = (q.requires_grad_(), started(mesh, pins, q.detach()).requires_grad_())
    assert torch.autograd.gradcheck(iterate, inputs, fast_mode=True, check_forward_ad=True)


def test_gradient_of_the_minimiser():
    """Against differences of minimisers; more steps from the converged map bring it closer."""
    mesh = KINDS["tetrahedra"]()
    pins = held(mesh)
    solver = dp.PoissonSolver(mesh, pins=pins)
    q, v, h = pulled(mesh, pins), torch.randn(len(pins), 3, dtype=torch.float64), 1e-5
    converged, plus, minus = (
        dp.as_rigid_as_possible(solver, pins=p, tolerance=1e-11).vertices
        for p in (q, q + h * v, q - h * v)
    )
    expected = (plus - minus) / (2 * h)
    errors = []
    for steps in (1, 6, 40):

        def more(q, steps=steps):
            return dp.as_rigid_as_possible(
                solver, pins=q, start=converged, tolerance=None, max_steps=steps
            ).vertices

        _, along = torch.func.jvp(more, (q,), (v,))
        errors.append(float((along - expected).abs().max() / expected.abs().max()))
    assert errors[0] > 2e-2 > errors[1] > 1e-4
    assert errors[2] < 1e-6


def test_energy_of_the_minimiser_has_the_gradient_of_the_envelope():
    """By handles: 2 a (q - Φ), as if Φ did not depend on them."""
    mesh = KINDS["tetrahedra"]()
    handles = held(mesh)
    solver = dp.PoissonSolver(mesh, handles=handles, handle_weights=0.3)
    q = pulled(mesh, handles)
    phi = dp.as_rigid_as_possible(solver, handles=q, tolerance=1e-9, max_steps=5000).vertices
    q.requires_grad_()
    found = dp.as_rigid_as_possible(solver, handles=q, start=phi, tolerance=None, max_steps=2)
    (gradient,) = torch.autograd.grad(found.energies[-1], q)
    assert_near(gradient, 2 * 0.3 * (q.detach() - phi[handles]), 1e-5)


# ------------------------------------------------------- batches, dtypes, mistakes


@kinds
def test_a_batch_is_each_alone(kind):
    mesh = KINDS[kind]()
    pins = held(mesh)
    solver = dp.PoissonSolver(mesh, pins=pins)
    q = torch.stack([pulled(mesh, pins, by) for by in (0.1, 0.3, 0.5)])
    options = {"tolerance": None, "max_steps": 4}
    batch = dp.as_rigid_as_possible(solver, pins=q, **options)
    mapped = vmap(lambda q: dp.as_rigid_as_possible(solver, pins=q, **options))(q)
    for i in range(3):
        alone = dp.as_rigid_as_possible(solver, pins=q[i], **options)
        for many in (batch, mapped):
            assert_near(many.vertices[i], alone.vertices, 1e-12)
            assert_near(many.energies[i], alone.energies, 1e-12)
    assert_near(batch.moves, mapped.moves.amax(0), 1e-12)


def test_single_precision_is_the_callers_alone():
    mesh = KINDS["tetrahedra"]()
    pins = held(mesh)
    single = dp.Mesh(mesh.vertices.float(), mesh.faces)
    q = pulled(mesh, pins)
    found = dp.as_rigid_as_possible(dp.PoissonSolver(single, pins=pins), pins=q.float())
    assert found.vertices.dtype == found.energies.dtype == found.moves.dtype == torch.float32
    double = dp.as_rigid_as_possible(dp.PoissonSolver(mesh, pins=pins), pins=q)
    assert_near(found.vertices, double.vertices, 1e-6)


@pytest.mark.parametrize("kind", ["pins", "handles"])
def test_mixed_precision_loses_nothing_in_between(kind):
    """The dtype of the first given decides what comes out; in between, all is double."""
    mesh = KINDS["tetrahedra"]()
    chosen = held(mesh)
    single = dp.Mesh(mesh.vertices.float(), mesh.faces)
    rest = dp.Mesh(single.vertices.double(), mesh.faces)
    q = pulled(mesh, chosen)
    start = started(mesh, chosen, q).float()
    options = {"tolerance": None, "max_steps": 4}

    def solved(on, images, start=None):
        solver = dp.PoissonSolver(on, **{kind: chosen})
        return dp.as_rigid_as_possible(solver, **{kind: images}, start=start, **options)

    expected = solved(rest, q)
    found = solved(single, q)
    for name in ("vertices", "energies"):
        assert getattr(found, name).dtype == torch.float64
        assert_near(getattr(found, name), getattr(expected, name), 1e-12)
    assert_near(found.moves, expected.moves, 1e-6)  # the diagonal is rounded
    found, expected = solved(mesh, q, start), solved(mesh, q, start.double())
    assert torch.equal(found.vertices, expected.vertices)
    rounded = solved(mesh, q.float())
    expected = solved(mesh, q.float().double())
    assert torch.equal(rounded.vertices, expected.vertices.float())
    assert torch.equal(rounded.energies, expected.energies.float())


def test_a_start_alone_gives_the_dtype():
    mesh = dp.Mesh(*meshes.disk(0, 4))
    solver = dp.PoissonSolver(mesh)
    start = dp.tutte(mesh)
    options = {"tolerance": None, "max_steps": 2}
    assert dp.as_rigid_as_possible(solver, start=start.float(), **options)[0].dtype == torch.float32
    assert dp.as_rigid_as_possible(solver, **options)[0].dtype == torch.float64


def test_batches_of_starts_meet_batches_of_pins():
    mesh = KINDS["plane"]()
    pins = held(mesh)
    solver = dp.PoissonSolver(mesh, pins=pins)
    q = torch.stack([pulled(mesh, pins, by) for by in (0.1, 0.3, 0.5)])
    starts = torch.stack([mesh.vertices, -mesh.vertices])[:, None]
    options = {"tolerance": None, "max_steps": 3}
    found = dp.as_rigid_as_possible(solver, pins=q, start=starts, **options)
    assert found.vertices.shape == (2, 3, mesh.n_vertices, 2)
    for i, j in np.ndindex(2, 3):
        alone = dp.as_rigid_as_possible(solver, pins=q[j], start=starts[i, 0], **options)
        assert_near(found.vertices[i, j], alone.vertices, 1e-12)
        assert_near(found.energies[i, j], alone.energies, 1e-12)


def test_of_no_maps_there_are_none():
    mesh = KINDS["tetrahedra"]()
    pins = held(mesh)
    q = pulled(mesh, pins).expand(0, -1, -1)
    found = dp.as_rigid_as_possible(dp.PoissonSolver(mesh, pins=pins), pins=q)
    assert found.vertices.shape == (0, mesh.n_vertices, 3)
    assert found.energies.shape == (0, 2)
    assert found.moves.tolist() == [0]


def test_moves_have_no_gradient():
    mesh = KINDS["plane"]()
    pins = held(mesh)
    q = pulled(mesh, pins).requires_grad_()
    found = dp.as_rigid_as_possible(dp.PoissonSolver(mesh, pins=pins), pins=q)
    assert found.vertices.requires_grad
    assert not found.moves.requires_grad


def test_what_floats_stays_at_rest():
    """Of two parts only one is held; the other keeps its shape, where the gauge puts it."""
    mesh = dp.Mesh(*meshes.tetrahedral_parts(0))
    pins = torch.nonzero(mesh.components == 0)[:6, 0]
    found = dp.as_rigid_as_possible(dp.PoissonSolver(mesh, pins=pins), pins=mesh.vertices[pins] + 1)
    assert float(found.energies[-1]) < 1e-20
    assert_near(dp.jacobians(mesh, found.vertices), dp.jacobians(mesh, mesh.vertices), 1e-9)


def test_mistakes(unchecked):
    solid, plane = KINDS["tetrahedra"](), KINDS["plane"]()
    pins = held(solid)
    solver, q = dp.PoissonSolver(solid, pins=pins), pulled(solid, pins)
    call = dp.as_rigid_as_possible
    with pytest.raises(RuntimeError, match=r"to 1.0e-04 after 3 steps: .*tolerance=None"):
        call(solver, pins=q, max_steps=3)
    with pytest.raises(RuntimeError, match="after 1 steps; allow"):
        call(solver, pins=q, max_steps=1)
    with pytest.raises(ValueError, match="images missing for"):
        call(solver)
    with pytest.raises(ValueError, match="no rotations lead from 3-dimensional cells to 2"):
        call(solver, pins=q[:, :2])
    with pytest.raises(ValueError, match="in 2 dimensions and its map in 3"):
        call(dp.PoissonSolver(plane, pins=held(plane)), pins=torch.zeros(len(held(plane)), 3))
    with pytest.raises(ValueError, match="expected start of shape"):
        call(solver, pins=q, start=q)
    with pytest.raises(ValueError, match="max_steps"):
        call(solver, pins=q, max_steps=0)
    with pytest.raises(ValueError, match="tolerance"):
        call(solver, pins=q, tolerance=-1.0)
    with pytest.raises(TypeError, match="pins, handles and start"):
        call(solver, pins=q.numpy())
    with pytest.raises(TypeError, match="as_rigid_as_possible"):
        call(solid, pins=q)
    for given in ({"pins": q.half()}, {"pins": q, "start": solid.vertices.half()}):
        with pytest.raises(TypeError, match="start must be float32 or float64"):
            call(solver, **given)
    with pytest.raises(ValueError, match="handles and start is on meta, the mesh on cpu"):
        call(solver, pins=q, start=solid.vertices.to("meta"))


@pytest.mark.parametrize("shape", [(), (3,)])
def test_images_of_too_few_axes_are_named(shape, unchecked):
    solver = dp.PoissonSolver(dp.Mesh(*meshes.disk()), pins=torch.tensor([0]))
    with pytest.raises(ValueError, match=r"as_rigid_as_possible: expected pins, handles and start"):
        dp.as_rigid_as_possible(solver, pins=torch.zeros(shape, dtype=torch.float64))
