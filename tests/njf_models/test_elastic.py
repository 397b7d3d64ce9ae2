"""Deformed solids: the lizard, converged ARAP maps of it in a store, batches, the global MLP."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField, Shape
from njf_models.baselines.global_mlp import GlobalMLP
from njf_models.budget import planned_steps
from njf_models.datasets.arap import (
    ArapSettings,
    ArapSolver,
    build_arap,
    draw_offsets,
    load_solid,
    save_solid,
)
from njf_models.datasets.solids import LIZARD_HANDLES, Solid, lizard, lizard_surface
from njf_models.datasets.store import StoreError
from njf_models.elastic_maps import ElasticBatches, elastic_loader, evaluate_elastic, summarise
from njf_models.losses import paper_loss
from njf_models.njf import Prediction
from njf_models.training import NJFTraining
from tests import meshes
from tests.njf_models.shapes import prepared, randomised


def block(size: int = 4) -> Solid:
    """A box held at both ends along x."""
    vertices, tetrahedra = meshes.box(0, size)
    volumes = np.linalg.det(vertices[tetrahedra[:, 1:]] - vertices[tetrahedra[:, :1]])
    tetrahedra = np.where(volumes[:, None] > 0, tetrahedra, tetrahedra[:, [0, 2, 1, 3]])
    x = vertices[:, 0]
    handle_of = np.where(x < 0.1, 0, np.where(x > 0.9, 1, -1))
    return Solid(vertices, tetrahedra, handle_of)


SETTINGS = ArapSettings(seed=3, reach=0.3)


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    return build_arap(tmp_path_factory.mktemp("maps"), 6, block(), SETTINGS, progress=False)


@pytest.fixture(scope="module")
def shape(maps):
    solid = maps.solid
    return prepared(dp.Mesh(solid.vertices[solid.surface], solid.faces))


# ------------------------------------------------------- solids


def enclosed(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.einsum("ij,ij->", np.cross(a, b), c) / 6


@pytest.mark.slow
def test_the_lizard(tmp_path, monkeypatch):
    """A closed surface of genus 0, symmetric; tetrahedra fill it, and each end has its handle."""
    monkeypatch.chdir(tmp_path)
    vertices, faces = lizard_surface()
    mirrored = vertices * [1, -1, 1]
    distance = np.linalg.norm(vertices[:, None] - mirrored, axis=-1).min(axis=0)
    assert distance.max() < 1e-6
    solid = lizard(0.2)
    for V, F in ((vertices, faces), (solid.vertices[solid.surface], solid.faces)):
        mesh = dp.Mesh(V, F)
        assert not len(mesh.boundary_loops)
        assert mesh.n_components == 1
        n_edges = 3 * len(F) // 2
        assert len(V) - n_edges + len(F) == 2
    volume = solid.volumes(solid.vertices).sum()
    assert enclosed(vertices, faces) == pytest.approx(volume, rel=0.03)
    assert enclosed(solid.vertices[solid.surface], solid.faces) == pytest.approx(volume, rel=1e-12)
    assert solid.n_handles == 6
    for k, place in enumerate(LIZARD_HANDLES):
        held = solid.vertices[solid.handle_of == k]
        assert np.linalg.norm(held.mean(axis=0) - place) < 0.06
    assert not list(tmp_path.iterdir())  # fTetWild would leave a file


def test_refinement_keeps_the_solid():
    solid = block()
    fine = solid.refined()
    assert len(fine.tetrahedra) == 8 * len(solid.tetrahedra)
    assert len(fine.faces) == 4 * len(solid.faces)
    volumes = fine.volumes(fine.vertices).reshape(-1, 8)
    assert_close(volumes.sum(1), solid.volumes(solid.vertices), rtol=1e-12, atol=0)
    for k, x in enumerate((0, 1)):
        assert (fine.vertices[fine.handle_of == k, 0] == x).all()
    assert (fine.handle_of >= 0).sum() == 2 * 7**2


def test_what_is_no_solid_is_refused(unchecked):
    solid = block()
    cells = solid.tetrahedra.copy()
    cells[0] = cells[0][[1, 0, 2, 3]]
    with pytest.raises(ValueError, match="1 tetrahedra are flat or inside out"):
        Solid(solid.vertices, cells, solid.handle_of)
    few = np.where(solid.handle_of == 0, -1, solid.handle_of)
    few[0] = 0
    with pytest.raises(ValueError, match=r"three vertices at least, these hold \[1, 16\]"):
        Solid(solid.vertices, solid.tetrahedra, few)


# ------------------------------------------------------- maps


def test_libigls_minimiser_is_ours(maps):
    """The core's local and global steps, from the same start, end at the same map."""
    solid = maps.solid
    mesh = dp.Mesh(solid.vertices, solid.tetrahedra)
    solver = dp.PoissonSolver(mesh, pins=torch.from_numpy(solid.held))
    for number in range(2):
        offsets = draw_offsets(SETTINGS, number, 2)
        assert_close(maps.offsets[number], torch.from_numpy(offsets).float())
        q = torch.from_numpy(solid.moved_handles(offsets))
        ours = dp.as_rigid_as_possible(solver, pins=q, tolerance=1e-8).vertices
        assert_close(maps.positions[number], ours[solid.surface].float(), rtol=0, atol=1e-4)


def test_acceleration_changes_the_way_not_the_end():
    solid, offsets = block(5), np.array([[0.0, 0, 0], [0.2, 0.5, -0.4]])
    found = [ArapSolver(solid, memory=memory, tolerance=1e-7)(offsets) for memory in (0, 6)]
    assert found[1].iterations < 0.6 * found[0].iterations
    for deformation in found:
        assert deformation.residual <= 1e-7
        assert_close(deformation.positions[solid.held], solid.moved_handles(offsets))
        step = ArapSolver(solid).step(deformation.positions, solid.moved_handles(offsets))
        assert np.abs(step - deformation.positions).max() < 3e-7 * solid.size
    assert_close(found[0].positions, found[1].positions, rtol=0, atol=2e-5)
    given_up = ArapSolver(solid, accelerated=0, tolerance=1e-7)(offsets)
    assert given_up.iterations == found[0].iterations


def test_flips_are_counted():
    solid = block()
    offsets = np.array([[0.0, 0, 0], [-1.8, 0, 0]])  # one end pushed through the other
    found = ArapSolver(solid, tolerance=1e-4)(offsets)
    a, b, c, d = (found.positions[solid.tetrahedra[:, k]] for k in range(4))
    determinants = np.linalg.det(np.stack([b - a, c - a, d - a], axis=1))
    assert found.flips == (determinants <= 0).sum() > 0


def test_what_does_not_converge_raises():
    with pytest.raises(RuntimeError, match="after 2 iterations a step still moves a vertex"):
        ArapSolver(block(), max_iterations=2)(np.array([[0.0, 0, 0], [0.1, 0.5, 0]]))


def test_a_store_goes_on_and_grows(tmp_path, maps):
    solid = block()
    first = build_arap(tmp_path, 2, solid, SETTINGS, progress=False)
    grown = build_arap(tmp_path, 6, solid, SETTINGS, progress=False)
    less = build_arap(tmp_path, 3, solid, SETTINGS, progress=False)
    for name in ("offsets", "positions", "iterations", "residuals", "flips"):
        assert torch.equal(getattr(grown, name), getattr(maps, name))
        assert torch.equal(getattr(grown, name)[:2], getattr(first, name))
        assert torch.equal(getattr(grown, name)[:3], getattr(less, name))
    assert (maps.residuals <= SETTINGS.tolerance).all()
    assert maps.parameters.abs().max() <= 1
    assert_close(maps.parameters.view(6, 2, 3) * 0.3, maps.offsets)
    with pytest.raises(StoreError, match="maps of another solid or of other settings"):
        build_arap(tmp_path, 2, solid, ArapSettings(seed=4, reach=0.3), progress=False)
    with pytest.raises(StoreError, match="maps of another solid"):
        build_arap(tmp_path, 2, block(5), SETTINGS, progress=False)
    (tmp_path / "maps-000000.safetensors").write_bytes(b"broken")
    with pytest.raises(StoreError, match="cannot be read"):
        build_arap(tmp_path, 2, solid, SETTINGS, progress=False)


def test_sets_of_other_seeds_have_no_map_in_common():
    drawn = {
        tuple(draw_offsets(ArapSettings(seed=seed), number, 6).flatten())
        for seed in range(3)
        for number in range(50)
    }
    assert len(drawn) == 150


def test_a_solid_is_kept(tmp_path):
    solid = block()
    save_solid(tmp_path / "solid.safetensors", solid)
    again = load_solid(tmp_path / "solid.safetensors")
    for name in ("vertices", "tetrahedra", "handle_of"):
        assert np.array_equal(getattr(solid, name), getattr(again, name))


# ------------------------------------------------------- batches


def test_some_faces_have_the_loss_of_these_faces(maps, shape):
    """Of a network on them alone, against the same on the whole surface."""
    batches = ElasticBatches(
        maps, shape, sampled=3, n_faces=11, n_sampled_targets=4, n_targets=2, shuffle=True
    )
    batch, sample = batches[1], None
    for kept in batches._samples:
        if kept.shape is batch.shape:
            sample = kept
    model = randomised(NeuralJacobianField(6, 0, parameters=6, width=16))
    code = model.encode(parameters=batch.parameters.double())
    prediction = model(batch.shape, code)
    assert prediction.jacobians.shape == (4, 11, 3, 2)
    corners = [tuple(row) for row in shape.mesh.faces.tolist()]
    faces = torch.tensor([corners.index(tuple(row)) for row in sample.corners.tolist()])
    whole = model(shape, code).jacobians[:, faces]
    assert_close(prediction.jacobians, whole, rtol=1e-9, atol=1e-9)
    numbers = [int((maps.parameters == row).all(1).nonzero()[0, 0]) for row in batch.parameters]
    J = dp.jacobians(shape.mesh, maps.positions[numbers].double())[:, faces]
    weights = shape.mesh.areas[faces] / shape.mesh.areas[faces].sum()
    expected = (weights * (whole - J).square().sum((-2, -1))).sum(-1).mean()
    loss = paper_loss(batch.shape, prediction, batch.target.double())
    assert loss.jacobians.item() == pytest.approx(expected.item(), rel=1e-6)
    exact = Prediction(prediction.matrices, J, batch.shape.solver(J))
    assert float(paper_loss(batch.shape, exact, batch.target.double()).total) < 1e-12


def test_every_map_once_in_order_and_whole_by_turns(maps, shape):
    ordered = list(elastic_loader(ElasticBatches(maps, shape, n_targets=4)))
    assert [batch.n_maps for batch in ordered] == [4, 2]
    assert torch.equal(torch.cat([batch.target for batch in ordered]), maps.positions)
    assert torch.equal(torch.cat([batch.parameters for batch in ordered]), maps.parameters)
    mixed = ElasticBatches(
        maps, shape, n_targets=1, sampled=2, n_faces=5, n_sampled_targets=3, period=3, shuffle=True
    )
    whole = [batch.shape is shape for batch in (mixed[i] for i in range(len(mixed)))]
    assert whole == [True, False, False] * 2


# ------------------------------------------------------- the global network


def test_the_global_mlp(shape, unchecked):
    model = GlobalMLP(shape.mesh.n_faces, 6, width=16)
    code = torch.randn(3, 6)
    untrained = model(shape, code)
    assert_close(untrained.jacobians, shape.mesh.frames.expand_as(untrained.jacobians))
    rest = shape.solver(shape.mesh.frames)
    assert_close(untrained.vertices, rest.expand_as(untrained.vertices))
    model = randomised(model)
    prediction = model(shape, model.encode(parameters=code.double()))
    rows = model.layers(code.double()).view(3, -1, 3, 2)
    assert_close(prediction.jacobians, shape.mesh.frames + rows)
    assert_close(prediction.vertices, shape.solver(prediction.jacobians))
    assert_close(dp.restrict(prediction.matrices, shape.mesh.frames), prediction.jacobians)
    alone = model(shape, code[1].double())
    assert_close(alone.vertices, prediction.vertices[1])
    with pytest.raises(ValueError, match="of one mesh with 10 faces"):
        GlobalMLP(10, 6)(shape, code)


@pytest.mark.parametrize("kind", ["njf", "global"])
def test_both_learn_in_the_same_module(maps, shape, kind):
    shape = Shape.prepare(shape.mesh)
    options = (
        {"face_features": 6, "point_features": 0, "parameters": 6, "width": 32}
        if kind == "njf"
        else {"n_faces": shape.mesh.n_faces, "parameters": 6, "width": 32}
    )
    module = NJFTraining(options, kind=kind)
    module.log = lambda *_, **__: None
    batches = ElasticBatches(maps, shape, n_targets=6)
    optimizer = torch.optim.Adam(module.parameters(), lr=1e-2)
    before, _ = evaluate_elastic(module.model, maps, shape)
    for _ in range(60):
        optimizer.zero_grad()
        module.training_step(batches[0], 0).backward()
        optimizer.step()
    after, images = evaluate_elastic(module.model, maps, shape)
    assert images.shape == maps.positions.shape
    old, new = summarise(before), summarise(after)
    assert new["maps"] == 6
    for name in ("L2-V", "L2-J", "L2-N, degrees"):
        assert new[name] < 0.7 * old[name]


def test_pinned_maps_meet_the_handles(maps, shape):
    """And are those of the same Jacobians: of the true ones, the targets themselves."""
    model = randomised(NeuralJacobianField(6, 0, parameters=6, width=16))
    double = type(maps)(**{**vars(maps), "offsets": maps.offsets.double()})
    free, _ = evaluate_elastic(model, double, shape)
    pinned, images = evaluate_elastic(model, double, shape, pinned=True)
    solver = dp.PoissonSolver(shape.mesh, pins=maps.held)
    for i in range(len(maps)):
        q = maps.held_positions(i)
        assert_close(images[i][maps.held], q)
        assert_close(q.float(), maps.positions[i][maps.held])
        assert pinned[i].l2_j == pytest.approx(free[i].l2_j)
        target = maps.positions[i].double()
        again = solver(dp.jacobians(shape.mesh, target), pins=q)
        assert_close(again, target, rtol=0, atol=1e-6)


def test_steps_for_a_time(tmp_path, maps, shape):
    """Twice the time, twice the steps; once decided, they stay."""
    module = NJFTraining({"n_faces": shape.mesh.n_faces, "parameters": 6}, kind="global")
    batches = [ElasticBatches(maps, Shape.prepare(shape.mesh), n_targets=2)[i] for i in range(2)]
    short, long = (
        planned_steps(tmp_path / f"{minutes}.json", module, batches, minutes, 5)
        for minutes in (0.5, 4.0)
    )
    assert short % 5 == long % 5 == 0
    assert 2 < long / short < 32  # eight, if the machine were quiet
    assert planned_steps(tmp_path / "4.0.json", module, batches, 100.0, 5) == long
    assert planned_steps(tmp_path / "least.json", module, batches, 1e-9, 7) == 7
