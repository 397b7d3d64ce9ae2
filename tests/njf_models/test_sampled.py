"""Samples say of maps what whole shapes do, and train the same networks."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField
from njf_models.baselines.displacement import DisplacementField
from njf_models.body_maps import (
    BodyCells,
    BodyMaps,
    PosedBodies,
    Task,
    body_loader,
    cell_loader,
    evaluate_maps,
    pair_loader,
    paired_cells,
)
from njf_models.features import face_features
from njf_models.losses import paper_loss, sampled_loss
from njf_models.map_errors import summarise
from njf_models.models import MODELS
from njf_models.sampled import Cells
from njf_models.training import (
    NJFTraining,
    Phase,
    encoded_cells,
    fit_phases,
    last_checkpoint,
    load_checkpoint,
)
from tests.njf_models.shapes import ellipsoid, prepared, randomised
from tests.njf_models.test_body_maps import INPUTS, MODEL, twisted

TOLD_BY_POINTS = {
    "face_features": 6,
    "point_features": 6,
    "code_size": 16,
    "encodes_target": True,
}


def of_faces(mesh, target, chosen):
    """Cells that are given faces, made by hand."""
    corners = mesh.vertices[mesh.faces[chosen]]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = (mesh.vertices.amax(0) + mesh.vertices.amin(0)) / 2
    features = [corners.mean(1) - middle, normal / normal.norm(dim=1, keepdim=True)]
    J = dp.jacobians(mesh, target)[:, chosen]
    return Cells(torch.cat(features, 1), J, torch.zeros(4, 6), frames=mesh.frames[chosen])


def test_jacobians_of_sampled_faces_are_those_of_the_whole_shape():
    """Of two shapes, three maps each, every one with a code of its own."""
    model = randomised(NeuralJacobianField(6, 0, parameters=5, width=32))
    meshes = [ellipsoid(0), ellipsoid(1)]
    code = torch.randn(2, 3, 5, dtype=torch.float64)
    chosen = [torch.randint(mesh.n_faces, (7,)) for mesh in meshes]
    cells = Cells.stack(
        [of_faces(m, m.vertices[None], faces) for m, faces in zip(meshes, chosen, strict=True)]
    )
    R = model.at(cells, code)
    assert R.shape == (2, 3, 7, 3, 2)
    for i, (mesh, faces) in enumerate(zip(meshes, chosen, strict=True)):
        expected = model(prepared(mesh), code[i]).jacobians[:, faces]
        assert_close(R[i], expected, rtol=1e-9, atol=1e-9)


def test_images_of_sampled_vertices_are_those_of_the_whole_shape_but_for_its_place():
    model = randomised(DisplacementField(6, 0, parameters=5, width=32))
    meshes = [ellipsoid(0), ellipsoid(1)]
    code = torch.randn(2, 3, 5, dtype=torch.float64)
    shapes = [prepared(mesh) for mesh in meshes]
    features = torch.stack([shape.vertex_features[:9] for shape in shapes])
    phi = model.at(Cells(features, features, features), code)
    assert phi.shape == (2, 3, 9, 3)
    for i, shape in enumerate(shapes):
        apart = model(shape, code[i]).vertices[:, :9] - phi[i]
        assert_close(apart, apart[:, :1].expand_as(apart), rtol=0, atol=1e-9)


@torch.no_grad()
def test_the_loss_of_samples_has_the_terms_of_the_whole_loss_for_its_expectation():
    """On a mesh whose faces differ in area, so that drawing them alike would show."""
    mesh = dp.Mesh(ellipsoid(0).vertices * torch.tensor([1.0, 1, 6]), ellipsoid(0).faces)
    shape = prepared(mesh)
    torch.manual_seed(0)
    target = mesh.vertices + torch.randn(2, mesh.n_vertices, 3, dtype=torch.float64) ** 2
    n, points = 100_000, torch.zeros(1, 6)
    model = randomised(NeuralJacobianField(6, 0, parameters=5, width=32))
    code = torch.randn(2, 5, dtype=torch.float64)
    cells = Cells.stack([Cells.draw("faces", n, mesh, None, target, points=points)])
    loss = sampled_loss(model.float().at(cells, code[None].float()), cells.target)
    whole = paper_loss(shape, model.double()(shape, code), target)
    assert float(loss) == pytest.approx(float(whole.jacobians), rel=0.02)

    field = randomised(DisplacementField(6, 0, parameters=5, width=32))
    cells = Cells.stack([Cells.draw("vertices", n, mesh, None, target, points=points)])
    place = (
        field(shape, code).vertices[:, 0]
        - field.at(Cells(shape.vertex_features[None, :1], target[None], points[None]), code[None])[
            0, :, 0
        ]
    )
    phi = field.float().at(cells, code[None].float()) + place[None, :, None]
    whole = paper_loss(shape, field.double()(shape, code), target)
    assert float(sampled_loss(phi, cells.target)) == pytest.approx(float(whole.vertices), rel=0.02)


def test_several_sources_serve_their_own_targets():
    model = NeuralJacobianField(6, 6, encodes_target=True, code_size=8, parameters=3)
    sources, targets = torch.randn(2, 1, 10, 6), torch.randn(2, 4, 10, 6)
    parameters = torch.randn(2, 4, 3)
    code = model.encode(sources, targets, parameters)
    assert code.shape == (2, 4, 8 + 8 + 3)
    for i in range(2):
        assert_close(code[i], model.encode(sources[i], targets[i], parameters[i]))


def test_bodies_of_a_step_are_each_others_targets():
    """Every cell is found again, by its features, among the faces of the whole shape."""
    maps = BodyMaps(
        [twisted(number) for number in range(4)],
        Task(sources=3, told="points", others=True),
        resample=True,
        **INPUTS,
    )
    posed = [PosedBodies(maps)[index] for index in (0, 4, 8, 11, 2)]
    cells = paired_cells(posed, "faces", 7, 3)
    assert cells.partners.shape == (5, 3)
    for i, (source, points) in enumerate(posed):
        others = cells.partners[i].tolist()
        assert i not in others
        assert len(set(others)) == 3
        assert torch.equal(cells.points[i], points)
        mesh = source.mesh
        faces = torch.cdist(cells.features[i], face_features(mesh, None).float()).argmin(1)
        for k, j in enumerate(others):
            J = dp.jacobians(mesh, posed[j].source.mesh.vertices)[faces]
            assert_close(cells.target[i, k].double(), J, rtol=1e-4, atol=1e-4)
    assert paired_cells(posed, "faces", 2, 99).partners.shape == (5, 4)  # all others


def test_a_body_encoded_once_has_the_codes_and_the_loss_of_one_encoded_for_each_map():
    module = NJFTraining(TOLD_BY_POINTS)
    randomised(module.model).float()
    maps = BodyMaps(
        [twisted(number) for number in range(4)], Task(sources=2, told="points"), **INPUTS
    )
    (cells,) = list(pair_loader(maps, "faces", 5, 8, 3))
    apart = replace(cells, partners=None, target_points=cells.points[cells.partners])
    loss, expected = module.training_step(cells, 0), module.training_step(apart, 0)
    assert_close(loss, expected)
    losses = (loss, expected)
    for a, b in zip(
        *(torch.autograd.grad(x, list(module.parameters())) for x in losses), strict=True
    ):
        assert_close(a, b, rtol=1e-4, atol=1e-5)


def test_what_has_no_partners_raises():
    pairs = torch.zeros(2, 1, dtype=torch.long)
    with pytest.raises(ValueError, match="a model that encodes source and target"):
        NeuralJacobianField(6, 6, parameters=2).encode_pairs(torch.randn(2, 4, 6), pairs)
    cells = Cells(
        torch.zeros(2, 2, 6), torch.zeros(2, 1, 2, 3), torch.zeros(2, 4, 6), partners=pairs
    )
    with pytest.raises(ValueError, match="DiffusionMap does not learn maps among shapes"):
        encoded_cells(MODELS["diffusion"](6), cells)
    partial = BodyMaps([twisted(0), twisted(1)], Task(sources=2, told="points", pieces=1), **INPUTS)
    with pytest.raises(ValueError, match="no targets of others"):
        PosedBodies(partial)


def test_what_samples_cannot_train_raises():
    vertices = Cells(torch.zeros(1, 2, 6), torch.zeros(1, 1, 2, 3), torch.zeros(1, 4, 6))
    code = torch.zeros(1, 1, 5)
    with pytest.raises(ValueError, match="single prediction, not 2 rounds"):
        NeuralJacobianField(6, 0, parameters=5, rounds=2).at(vertices, code)
    with pytest.raises(ValueError, match="must be faces"):
        NeuralJacobianField(6, 0, parameters=5).at(vertices, code)
    with pytest.raises(ValueError, match="on whole shapes"):
        NJFTraining(MODEL, kind="cages").model.at(vertices, code)
    with pytest.raises(ValueError, match="by the paper's loss alone"):
        NJFTraining(MODEL, {"distortion": 1.0}).training_step(vertices, 0)


@pytest.mark.parametrize("kind", ["njf", "displacement"])
def test_phases_are_one_training_that_resumes_in_either(tmp_path, kind):
    """Interrupted in the first phase and in the second, it ends where one that ran through does."""
    bodies = [twisted(number, 8) for number in range(4)]
    maps = BodyMaps(bodies, n_targets=4, resample=True, **INPUTS)
    examples = BodyMaps(bodies, **INPUTS)

    def fit(sampled, whole):
        torch.manual_seed(0)
        module = NJFTraining(MODEL, learning_rate=3e-3, steps=150, kind=kind)
        cells = cell_loader(BodyCells(maps, MODELS[kind].samples, 60), 3)
        phases = [Phase(cells, sampled), Phase(body_loader(maps, shuffle=True), whole)]
        fit_phases(module, tmp_path, phases, body_loader(examples), validate_every=50)
        saved = torch.load(last_checkpoint(tmp_path), weights_only=False)
        return saved["global_step"], saved["lr_schedulers"][0]["_last_lr"][0]

    assert fit(50, 50)[0] == 50
    step, rate = fit(120, 120)
    assert step == 120
    assert rate == pytest.approx(3e-3 * (1 + math.cos(0.8 * math.pi)) / 2, rel=1e-3)
    step, rate = fit(120, 150)
    assert step == 150
    assert rate == pytest.approx(0, abs=1e-9)
    before = last_checkpoint(tmp_path).stat().st_mtime_ns
    fit(120, 150)
    assert last_checkpoint(tmp_path).stat().st_mtime_ns == before  # nothing was left to do
    untrained = summarise(evaluate_maps(NeuralJacobianField(**MODEL), examples)[0])
    trained = summarise(evaluate_maps(load_checkpoint(last_checkpoint(tmp_path)), examples)[0])
    for error in ("L2-V", "L2-J", "L2-N, degrees"):
        assert trained[error] < 0.7 * untrained[error]
