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
    BodyMaps,
    CellSampler,
    MixedSampler,
    Task,
    body_loader,
    cell_loader,
    evaluate_maps,
)
from njf_models.datasets.partial import cut_pieces
from njf_models.datasets.poses import reflected
from njf_models.features import face_features, vertex_features
from njf_models.losses import paper_loss, sampled_loss
from njf_models.map_errors import summarise
from njf_models.models import MODELS
from njf_models.sampled import Cells, Surfaces
from njf_models.training import (
    NJFTraining,
    Phase,
    fit_phases,
    last_checkpoint,
    load_checkpoint,
)
from tests.njf_models.shapes import ellipsoid, prepared, randomised
from tests.njf_models.test_body_maps import INPUTS, MODEL, distances, twisted

TOLD_BY_POINTS = {
    "face_features": 6,
    "point_features": 6,
    "code_size": 16,
    "encodes_target": True,
}


def of_faces(meshes, chosen):
    """Cells that are given faces of several meshes, made by hand; their targets say nothing."""
    features, frames = [], []
    for mesh, faces in zip(meshes, chosen, strict=True):
        corners = mesh.vertices[mesh.faces[faces]]
        normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle = (mesh.vertices.amax(0) + mesh.vertices.amin(0)) / 2
        normal = normal / normal.norm(dim=1, keepdim=True)
        features.append(torch.cat([corners.mean(1) - middle, normal], 1))
        frames.append(mesh.frames[faces])
    n = len(meshes)
    target, points = torch.zeros(n, 1, len(chosen[0]), 3, 2), torch.zeros(n, 4, 6)
    return Cells(torch.stack(features), target, points, frames=torch.stack(frames))


def surfaces_of(*meshes, **options):
    return Surfaces(torch.stack([m.vertices.float() for m in meshes]), meshes[0].faces, **options)


def test_jacobians_of_sampled_faces_are_those_of_the_whole_shape():
    """Of two shapes, three maps each, every one with a code of its own."""
    model = randomised(NeuralJacobianField(6, 0, parameters=5, width=32))
    meshes = [ellipsoid(0), ellipsoid(1)]
    code = torch.randn(2, 3, 5, dtype=torch.float64)
    chosen = [torch.randint(mesh.n_faces, (7,)) for mesh in meshes]
    R = model.at(of_faces(meshes, chosen), code)
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
    phi = model.at(Cells(features, features[:, None], features), code)
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
    n, points = 100_000, torch.zeros(1, 1, 6)
    model = randomised(NeuralJacobianField(6, 0, parameters=5, width=32))
    code = torch.randn(2, 5, dtype=torch.float64)
    source, images = surfaces_of(mesh), target.float()[None]
    cells = Cells.draw("faces", n, source, images, points=points)
    loss = sampled_loss(model.float().at(cells, code[None].float()), cells.target)
    whole = paper_loss(shape, model.double()(shape, code), target)
    assert float(loss) == pytest.approx(float(whole.jacobians), rel=0.02)

    field = randomised(DisplacementField(6, 0, parameters=5, width=32))
    cells = Cells.draw("vertices", n, source, images, points=points)
    place = (
        field(shape, code).vertices[:, 0]
        - field.at(Cells(shape.vertex_features[None, :1], target[None, :, :1], points), code[None])[
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


def found(cells, mesh, i):
    """The faces of a mesh that the cells of shape i are, by their places and normals."""
    distance = (cells.features[i][:, None, :6] - face_features(mesh).float()).norm(dim=-1)
    assert distance.amin(1).max() < 1e-5
    return distance.argmin(1)


def ambient(J, frames):
    return (J @ frames.mT).float()


@pytest.mark.parametrize("task", [Task(sources=3), Task(sources=3, told="nothing")])
def test_cells_are_faces_of_their_sources_and_have_the_jacobians_of_the_whole_maps(task):
    maps = BodyMaps([twisted(number) for number in range(4)], task, resample=True, **INPUTS)
    indices = [0, 4, 8, 11, 2]
    cells = CellSampler(maps, "faces", 7)(indices)
    assert cells.target.shape[1] == (4 if task.told == "pose" else 1)
    turned = 0
    for i, index in enumerate(indices):
        body, mesh = maps.bodies[index // 3], maps.source(index).mesh
        mirror = dp.Mesh(mesh.vertices * torch.tensor([-1.0, 1, 1]), mesh.faces.flip(1))
        distance = (cells.features[i][:, None] - face_features(mirror).float()).norm(dim=-1)
        reflect = distance.amin(1).max() < 1e-5
        turned += bool(reflect)
        S = torch.diag(torch.tensor([-1.0 if reflect else 1.0, 1, 1]))
        chosen = found(cells, mirror if reflect else mesh, i)
        for t in range(cells.target.shape[1]):
            target = body.rest
            if task.told == "pose":
                pose = cells.parameters[i, t]
                pose = reflected(pose) if reflect else pose
                target = body.posed[int((body.poses - pose).abs().sum(1).argmin())]
            J = ambient(dp.jacobians(mesh, target.double()), mesh.frames)[chosen]
            got = ambient(cells.target[i, t], cells.frames[i])
            assert_close(S @ got @ S, J, rtol=1e-4, atol=1e-4)
    assert 0 < turned < 5  # of the seed that conftest sets


def test_cells_are_vertices_and_have_the_images_of_the_whole_maps_but_for_their_place():
    maps = BodyMaps([twisted(number) for number in range(3)], resample=True, **INPUTS)
    cells = CellSampler(maps, "vertices", 40)([2, 0])
    for i, body in enumerate((maps.bodies[2], maps.bodies[0])):
        mesh = dp.Mesh(body.rest, body.faces)
        weights = mesh.vertex_areas / mesh.areas.sum()
        features, matched = vertex_features(mesh), 0
        for sign in (-1.0, 1.0):
            S = torch.tensor([sign, 1, 1, sign, 1, 1])
            distance = (cells.features[i][:, None] - S * features).norm(dim=-1)
            if distance.amin(1).max() > 1e-4:
                continue
            matched, chosen = matched + 1, distance.argmin(1)
            for target, told in zip(cells.target[i], cells.parameters[i], strict=True):
                pose = reflected(told) if sign < 0 else told
                phi = body.posed[int((body.poses - pose).abs().sum(1).argmin())]
                phi = S[:3] * (phi - weights @ phi)[chosen]
                assert_close(target, phi, rtol=1e-4, atol=1e-5)
        assert matched == 1


def test_sources_of_maps_to_others_share_their_targets():
    """Encoded once, they have the codes and losses of targets encoded for every source."""
    module = NJFTraining(TOLD_BY_POINTS)
    randomised(module.model).float()
    task = Task(sources=2, told="points", others=True)
    maps = BodyMaps([twisted(number) for number in range(4)], task, n_targets=3, **INPUTS)
    (cells,) = list(cell_loader(CellSampler(maps, "faces", 5), 8))
    assert cells.target_points.shape[:2] == (1, 3)
    assert cells.target.shape[:2] == (8, 3)
    apart = replace(cells, target_points=cells.target_points.expand(8, -1, -1, -1))
    assert_close(module.training_step(cells, 0), module.training_step(apart, 0))


def test_points_of_targets_lie_on_them():
    task = Task(sources=2, told="points", pieces=1, radii=(0.3, 0.4))
    maps = BodyMaps([twisted(0), twisted(1)], task, n_targets=2, **INPUTS)
    cells = CellSampler(maps, "faces", 50)([0, 3])
    assert cells.target_points.shape == (2, 2, 32, 6)
    for i, index in enumerate((0, 3)):
        body = maps.bodies[index // 2]
        own = [x for pose, x in enumerate(body.posed) if pose != index % 2]
        for points in cells.target_points[i]:
            near = [
                min(
                    distances(points * torch.tensor([s, 1, 1, s, 1, 1]), x, body.faces).max()
                    for s in (1.0, -1.0)
                )
                for x in own
            ]
            assert min(near) < 1e-10


def test_surfaces_have_the_features_of_their_meshes():
    """Whole and in part, where vertices without faces count for nothing; with a signature too."""
    mesh = dp.Mesh(ellipsoid(0).vertices.float(), ellipsoid(0).faces)
    wks = torch.rand(mesh.n_vertices, 3)
    whole = surfaces_of(mesh, wks=wks[None])
    assert_close(whole.vertex_features[0], vertex_features(mesh, wks), rtol=1e-4, atol=1e-5)
    assert_close(whole.areas[0], mesh.areas, rtol=1e-4, atol=1e-6)
    assert_close(whole.vertex_shares[0], mesh.vertex_areas / mesh.areas.sum(), rtol=1e-4, atol=1e-6)
    left = cut_pieces(mesh, 1, (0.6, 0.7), torch.Generator().manual_seed(0))
    assert 10 < left.mesh.n_vertices < mesh.n_vertices
    present = torch.zeros(1, mesh.n_faces)
    present[0, left.faces] = 1
    part = surfaces_of(mesh, present=present)
    assert_close(
        part.vertex_features[0, left.kept], vertex_features(left.mesh), rtol=1e-4, atol=1e-5
    )
    assert set(part.draw(2000)[0].tolist()) == set(left.faces.tolist())
    cells = Cells.draw("faces", 300, part, mesh.vertices[None, None], points=part.points(2))
    found(cells, left.mesh, 0)
    signed = Cells.draw("faces", 9, whole, mesh.vertices[None, None], points=whole.points(5))
    assert signed.features.shape == (1, 9, 9)
    assert signed.points.shape == (1, 5, 9)
    chosen = found(signed, mesh, 0)
    assert_close(signed.features[0, :, 6:], wks[mesh.faces[chosen]].mean(1))
    other = signed.reflected(torch.tensor([-1.0]))
    assert_close(other.points * torch.tensor([-1.0, 1, 1, -1, 1, 1, 1, 1, 1]), signed.points)


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
        cells = cell_loader(CellSampler(maps, MODELS[kind].samples, 60), 3)
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


def test_a_step_sees_one_of_several_triangulations():
    """Of either, as drawn; and samplers are of the same maps only."""
    coarse = [twisted(number) for number in range(3)]
    other = [replace(body, faces=body.faces.flip(0)) for body in coarse]
    maps = [BodyMaps(of, n_targets=2, resample=True, **INPUTS) for of in (coarse, other)]
    samplers = [CellSampler(one, "faces", 4) for one in maps]
    mixed = MixedSampler(samplers)
    assert mixed.maps is maps[0]
    generator = torch.random.get_rng_state()
    drawn = [int(torch.randint(2, ())) for _ in range(20)]
    assert set(drawn) == {0, 1}
    torch.random.set_rng_state(generator)
    first = mixed([0, 2])
    torch.random.set_rng_state(generator)
    torch.randint(2, ())
    assert torch.equal(first.features, samplers[drawn[0]]([0, 2]).features)
    assert next(iter(cell_loader(mixed, 3))).features.shape == (3, 4, 6)
    with pytest.raises(ValueError, match=r"same maps are mixed, got \[3, 2\]"):
        MixedSampler([samplers[0], CellSampler(BodyMaps(other[:2], **INPUTS), "faces", 4)])
