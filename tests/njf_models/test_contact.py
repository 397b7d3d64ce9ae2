"""The block and the star: equilibria without intersections, and maps that are freed of theirs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField
from njf_models.contact_maps import (
    Contact,
    _inside,
    _nearest,
    block_shape,
    evaluate_contact,
    summarise,
)
from njf_models.datasets.contact import (
    ContactSettings,
    ContactSolver,
    build_contact,
    draw_trajectory,
    make_scene,
)
from njf_models.datasets.store import StoreError
from tests.njf_models.shapes import randomised

SETTINGS = ContactSettings(seed=5, columns=12)
STILL, CLEAR = np.zeros((2, 3)), np.array([0.0, 2.0, 0.0])


@pytest.fixture(scope="module")
def solver():
    return ContactSolver(make_scene(12))


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    return build_contact(tmp_path_factory.mktemp("states"), 2, SETTINGS, progress=False)


def rings(scene, positions, star):
    """Both boundaries as segments (e, 2, 2)."""
    around = np.stack([star, np.roll(star, -1, axis=0)], axis=1)
    return np.concatenate([positions[scene.boundary], around])


def crossings(segments):
    """Pairs of segments that cross properly, by the signs of the four areas."""

    def side(a, b, c):
        return np.sign((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    return sum(
        side(*p, q[0]) * side(*p, q[1]) < 0 and side(*q, p[0]) * side(*q, p[1]) < 0
        for p, q in itertools.combinations(segments, 2)
    )


def squeezed(solver):
    """A state with the star in the block's top."""
    handles = np.array([[-0.1, 0.1, 0.3], [0.1, 0, -0.2]])
    state = solver.rest(np.array([0.2, 1.5, 0.3]))
    for share, y in ((0.5, 1.0), (1.0, 0.7), (1.0, 0.5)):
        state, _ = solver(state, share * handles, np.array([0.2, y, 0.3]))
    return state, handles, np.array([0.2, 0.5, 0.3])


# ------------------------------------------------------- scene


def test_the_scene():
    scene = make_scene(12)
    mesh = dp.Mesh(scene.vertices, scene.faces)
    assert float(mesh.areas.sum()) == pytest.approx(3)
    assert mesh.areas.std() < 1e-12
    loops = mesh.boundary_loops
    assert len(loops) == 1
    assert set(loops[0].tolist()) == set(scene.boundary.ravel().tolist())
    length = np.linalg.norm(np.diff(scene.vertices[scene.boundary], axis=1), axis=-1).sum()
    assert length == pytest.approx(8)
    # A turn of the star by a fifth is none, for the outline as for what networks are told.
    turned = scene.placed_obstacle(np.array([0, 0, 2 * np.pi / 5]))
    assert_close(turned, np.roll(scene.outline, -4, axis=0))


def test_what_a_network_is_told(maps):
    assert maps.parameters.shape == (8, 10)
    turned = maps.obstacles + torch.tensor([0, 0, 2 * torch.pi / 5])
    again = type(maps)(
        maps.scene, maps.settings, maps.handles, turned, maps.positions, maps.iterations
    )
    assert_close(again.parameters, maps.parameters, atol=1e-5, rtol=0)
    assert_close(maps.parameters[:, :6].view(-1, 2, 3) * 0.3, maps.handles)


# ------------------------------------------------------- equilibria


def test_derivatives_of_the_elastic_energy(solver):
    rng = np.random.default_rng(0)
    scene = solver.scene
    rest = np.concatenate([scene.vertices, scene.outline]).ravel()
    x, v, h = rest + 0.05 * rng.normal(size=rest.shape), rng.normal(size=rest.shape), 1e-6
    here = solver._elastic(x, derivatives=True)
    plus, minus = (solver._elastic(x + t * v, derivatives=True) for t in (h, -h))
    along = (plus.energy - minus.energy) / (2 * h)
    assert along == pytest.approx(here.gradient @ v, rel=1e-7)
    eigenvalues = np.linalg.eigvalsh(here.hessian.toarray())
    assert eigenvalues.min() > -1e-10 * eigenvalues.max()
    # At rest no curvature is negative, so that nothing is clamped.
    hessian = solver._elastic(rest, derivatives=True).hessian
    plus, minus = (solver._elastic(rest + t * v, derivatives=True) for t in (h, -h))
    assert_close(hessian @ v, (plus.gradient - minus.gradient) / (2 * h), rtol=1e-4, atol=1e-4)


def test_at_rest_nothing_pulls(solver):
    state = solver.rest(CLEAR)
    assert np.abs(solver._elastic(state.ravel(), derivatives=True).gradient).max() < 1e-14
    again, _ = solver(state, STILL, CLEAR)
    assert_close(again, state, rtol=0, atol=1e-10)


def test_ends_that_move_as_one_take_the_block_along(solver):
    """A rigid motion, in two steps, since the ends go straight."""
    state = solver.rest(np.array([0.0, 3.0, 0.0]))
    x = solver.scene.vertices
    for angle in (0.3, 0.6):
        c, s = np.cos(angle), np.sin(angle)
        turned = x @ np.array([[c, s], [-s, c]])
        motions = []
        for k in range(2):
            end = solver.scene.handle_of == k
            motions.append([*(turned[end].mean(0) - x[end].mean(0)), angle])
        state, _ = solver(state, np.array(motions), np.array([0.0, 3.0, 0.0]))
    assert_close(state[: len(x)], turned, rtol=0, atol=1e-5)


def test_an_equilibrium(solver):
    """Ends and star are where they should be, nothing meets, and all forces are in balance."""
    state, handles, obstacle = squeezed(solver)
    scene, n = solver.scene, len(solver.scene.vertices)
    held = scene.handle_of >= 0
    assert np.array_equal(state[:n][held], scene.placed_handles(handles)[held])
    assert np.array_equal(state[n:], scene.placed_obstacle(obstacle))
    assert not crossings(rings(scene, state[:n], state[n:]))
    x, free = state.ravel(), ~solver._fixed
    goal = x.copy()
    rng, h = np.random.default_rng(0), 1e-6
    force = solver._elastic(x, derivatives=True).gradient[free]
    pushed = np.abs(force).max()
    assert pushed > 1e-2  # the star pushes: elastic forces alone are not in balance
    for _ in range(5):
        v = rng.normal(size=x.shape) * free
        energies = [solver._energy(x + t * v, goal, True) for t in (h, -h)]
        assert abs(energies[0] - energies[1]) / (2 * h) < 0.02 * pushed


def test_what_has_no_equilibrium_raises(solver):
    state = solver.rest(CLEAR)
    hasty = ContactSolver(solver.scene, max_iterations=2)
    with pytest.raises(RuntimeError, match="no equilibrium after 2 Newton steps"):
        hasty(state, np.array([[0, 0.3, 0.5], [0, -0.3, 0.5]]), CLEAR)
    with pytest.raises(ValueError, match="the obstacle intersects the free block"):
        solver.rest(np.array([0, 0.5, 0]))


def test_no_state_of_a_set_intersects(maps):
    scene = maps.scene
    assert len(maps) == 8
    for i in range(len(maps)):
        star = scene.placed_obstacle(maps.obstacles[i].double().numpy())
        assert not crossings(rings(scene, maps.positions[i].double().numpy(), star))
    assert (maps.positions[3] - maps.positions[0]).abs().max() > 0.05  # the star went on


def test_a_store_goes_on(tmp_path, maps, solver):
    build_contact(tmp_path, 1, SETTINGS, progress=False)
    grown = build_contact(tmp_path, 2, SETTINGS, progress=False)
    assert torch.equal(grown.positions, maps.positions)
    states = draw_trajectory(solver, SETTINGS, 1)
    assert_close(maps.positions[7], torch.from_numpy(states[-1].positions).float())
    with pytest.raises(StoreError, match="states of other settings"):
        build_contact(tmp_path, 1, ContactSettings(seed=6, columns=12), progress=False)


# ------------------------------------------------------- maps


def test_inside_and_nearest_of_polygons():
    scene, rng = make_scene(12), np.random.default_rng(0)
    star = np.stack([scene.outline, np.roll(scene.outline, -1, axis=0)], axis=1)
    points = rng.uniform(-0.5, 0.5, (500, 2))
    inside = _inside(points, star)
    assert np.array_equal(inside, Outline(scene.outline).contains_points(points))
    assert 0 < inside.sum() < 500
    feet, which = _nearest(points, star)
    t = np.linspace(0, 1, 401)[:, None, None]
    dense = star[:, 0] * (1 - t) + star[:, 1] * t
    distance = np.linalg.norm(points[:, None, None] - dense, axis=-1).min(axis=1)
    assert_close(np.linalg.norm(points - feet, axis=1), distance.min(axis=1), rtol=0, atol=1e-4)
    assert_close(distance[np.arange(500), which], distance.min(axis=1), rtol=0, atol=1e-4)


def test_steps_free_a_map_of_its_intersections(solver):
    """Of the harmonic map, which knows nothing of the star; an equilibrium needs none."""
    state, handles, obstacle = squeezed(solver)
    scene, n = solver.scene, len(solver.scene.vertices)
    mesh = block_shape(scene).mesh
    contact = Contact(solver, mesh, handles, obstacle)
    R = dp.jacobians(mesh, torch.from_numpy(scene.vertices))
    steps, phi = contact.corrected(R, max_steps=1)
    assert steps is None
    assert crossings(rings(scene, phi.numpy(), contact.star)) > 0
    steps, phi = contact.corrected(R)
    assert 1 < steps <= 20
    assert not crossings(rings(scene, phi.numpy(), contact.star))
    assert_close(phi[contact.held], contact.ends)
    truth = torch.from_numpy(state[:n])
    steps, phi = contact.corrected(dp.jacobians(mesh, truth))
    assert steps == 1
    assert_close(phi, truth, rtol=0, atol=1e-8)
    assert_close(contact.placed(truth + 5), truth, rtol=0, atol=1e-12)


def test_records_of_maps(maps):
    shape = block_shape(maps.scene)
    model = randomised(NeuralJacobianField(6, 0, parameters=10, output_dim=2, width=16)).float()
    records, images, corrected = evaluate_contact(model, maps, shape)
    assert images.shape == corrected.shape == maps.positions.shape
    assert any(record.intersects for record in records)
    for record, before, after in zip(records, images, corrected, strict=True):
        assert (record.steps == 0) == (not record.intersects)
        if not record.intersects:
            assert torch.equal(before, after)
    summary = summarise(records)
    assert summary["maps"] == 8
    share = np.mean([record.intersects for record in records])
    assert summary["maps that intersect, %"] == pytest.approx(100 * share)
