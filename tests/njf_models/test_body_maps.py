"""One source and many poses in a batch; what training and evaluation make of them."""

from __future__ import annotations

import igl
import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField
from njf_models.body_maps import BodyMaps, Task, body_loader, evaluate_maps
from njf_models.body_report import BodyRow, render_body, save_body_report
from njf_models.datasets.bodies import POSE_SIZE, Body
from njf_models.losses import paper_loss
from njf_models.map_errors import summarise
from njf_models.training import NJFTraining, last_checkpoint, load_checkpoint, make_trainer
from tests import meshes

MODEL = {"face_features": 6, "point_features": 6, "code_size": 16, "parameters": POSE_SIZE}
INPUTS = {"n_points": 32, "n_energies": 0}


def twisted(number: int, n_poses: int = 5) -> Body:
    """An ellipsoid of random axes, twisted about z by a turn of its root about it."""
    rng = np.random.default_rng(number)
    vertices, faces = meshes.sphere(0, subdivisions=2)
    rest = torch.from_numpy(vertices * rng.uniform(0.6, 1.4, 3)).float()
    poses = torch.zeros(n_poses, POSE_SIZE)
    poses[:, 2] = torch.from_numpy(rng.uniform(-1, 1, n_poses))
    angle = poses[:, 2:3] * rest[:, 2]
    x, y, z = rest.T
    posed = [angle.cos() * x - angle.sin() * y, angle.sin() * x + angle.cos() * y]
    posed = torch.stack([*posed, z.expand_as(angle)], dim=-1)
    return Body(number, torch.zeros(6), torch.from_numpy(faces), rest, poses, posed)


@pytest.fixture(scope="module")
def bodies():
    return [twisted(number) for number in range(4)]


def test_a_batch_is_one_shape_and_targets_with_their_parameters(bodies):
    batch = BodyMaps(bodies, n_targets=3, n_energies=8, n_points=20)[1]
    assert batch.n_maps == 3
    assert batch.shape.mesh.n_parts == 1
    assert batch.points.shape == (1, 20, 6 + 8)
    assert (batch.target == bodies[1].posed[:3]).all()
    assert (batch.parameters == bodies[1].poses[:3]).all()
    assert_close(batch.shape.mesh.vertices.float(), bodies[1].rest)


def test_training_sees_all_poses_in_turn_and_evaluation_always_the_same(bodies):
    fixed, fresh = (
        BodyMaps(bodies, **INPUTS),
        BodyMaps(bodies, n_targets=2, resample=True, **INPUTS),
    )
    assert_close(fixed[0].points, fixed[0].points)
    assert (fresh[0].points - fresh[0].points).abs().max() > 0
    seen = set()
    for _ in range(30):
        batch = fresh[0]
        for target, pose in zip(batch.target, batch.parameters, strict=True):
            index = int((bodies[0].poses == pose).all(1).nonzero())
            assert (target == bodies[0].posed[index]).all()
            seen.add(index)
    assert seen == set(range(5))
    assert fresh[0].shape is fresh[0].shape  # factorised once


def test_any_pose_can_be_the_source_of_the_others(bodies):
    examples = BodyMaps(bodies, Task(sources=2), **INPUTS)
    assert len(examples) == 2 * len(bodies)
    for index in range(len(examples)):
        body, source = bodies[index // 2], index % 2
        batch = examples[index]
        assert_close(batch.shape.mesh.vertices.float(), body.posed[source])
        others = [pose for pose in range(5) if pose != source]
        assert (batch.target == body.posed[others]).all()
        assert (batch.parameters == body.poses[others]).all()
    records, maps = evaluate_maps(NeuralJacobianField(**MODEL), examples)
    assert [(r.source, r.pose) for r in records[:5]] == [(0, 1), (0, 2), (0, 3), (0, 4), (1, 0)]
    assert [len(of_source) for of_source in maps] == [4] * 8


def distances(points, vertices, faces):
    """Squared distance of point features' positions to a surface, both as features have it."""
    x = vertices.double()
    x = x - (x.amax(0) + x.amin(0)) / 2
    return igl.point_mesh_squared_distance(
        points[:, :3].double().numpy(), x.numpy(), faces.numpy()
    )[0]


def test_registration_maps_what_is_left_of_a_body_onto_points_of_all_of_another_pose(bodies):
    task = Task(sources=2, told="points", pieces=2, radii=(0.4, 0.5))
    maps = BodyMaps(bodies, task, **INPUTS)
    for index in (0, 3):
        source, batch = maps.source(index), maps[index]
        body = bodies[index // 2]
        kept, mesh = source.kept, batch.shape.mesh
        assert 10 < mesh.n_vertices < len(body.rest)
        assert_close(mesh.vertices.float(), body.posed[index % 2][kept])
        assert batch.parameters is None
        targets = maps.targets(index).tolist()
        assert [b for b, _ in targets] == [index // 2] * 4
        for (_, pose), target, points in zip(
            targets, batch.target, batch.target_points, strict=True
        ):
            assert pose != index % 2
            assert (target == body.posed[pose][kept]).all()
            assert distances(points, body.posed[pose], body.faces).max() < 1e-10
        assert distances(batch.points[0], mesh.vertices, mesh.faces).max() < 1e-10
        again = maps[index]
        assert (again.target_points == batch.target_points).all()
        assert (again.points == batch.points).all()
    fresh = BodyMaps(bodies, task, resample=True, **INPUTS)
    assert len({len(fresh.source(0).kept) for _ in range(20)}) > 1  # cut anew each time


def test_morphing_maps_to_other_bodies_in_any_pose(bodies):
    maps = BodyMaps(bodies, Task(sources=3, told="points", others=True), n_targets=3, **INPUTS)
    seen = set()
    for index in range(len(maps)):
        batch, targets = maps[index], maps.targets(index)
        assert torch.equal(targets, maps.targets(index))
        for (body, pose), target in zip(targets.tolist(), batch.target, strict=True):
            assert body != index // 3
            assert (target == bodies[body].posed[pose]).all()
            seen.add((body, pose))
    assert len(seen) > 10
    model = NeuralJacobianField(6, 6, encodes_target=True, code_size=16)
    records, _ = evaluate_maps(model, maps)
    assert [(r.target, r.pose) for r in records[:3]] == [tuple(t) for t in maps.targets(0).tolist()]
    with pytest.raises(ValueError, match="two of them at least"):
        BodyMaps(bodies[:1], Task(others=True))


@pytest.mark.parametrize("kind", ["njf", "displacement", "cages"])
def test_a_batch_has_the_loss_and_gradient_of_the_mean_over_its_targets(bodies, kind):
    batch = BodyMaps(bodies, **INPUTS)[0]
    model = NJFTraining(MODEL, kind=kind).model
    torch.nn.init.normal_(model.field.layers[-1].weight, std=0.1)

    def gradient(chosen):
        code = model.encode(batch.points, parameters=batch.parameters[chosen])
        loss = paper_loss(batch.shape, model(batch.shape, code), batch.target[chosen]).total
        grads = torch.autograd.grad(loss, list(model.parameters()))
        return torch.cat([loss.detach()[None], *(g.flatten() for g in grads)])

    together = gradient(torch.arange(5))
    alone = torch.stack([gradient(torch.tensor([i])) for i in range(5)]).mean(0)
    assert_close(together, alone, rtol=1e-4, atol=1e-5 * float(alone.abs().max()))


def test_one_source_is_encoded_once_for_all_targets():
    model = NeuralJacobianField(6, 6, code_size=8, parameters=3)
    cloud, parameters = torch.randn(1, 10, 6), torch.randn(4, 3)
    code = model.encode(cloud, parameters=parameters)
    again = model.encode(cloud.expand(4, -1, -1), parameters=parameters)
    assert_close(code, again)
    assert code.shape == (4, 11)


@pytest.mark.parametrize("kind", ["njf", "displacement", "cages"])
def test_training_learns_the_twist_and_resumes(bodies, tmp_path, kind):
    train, validation = bodies[:3], bodies[3:]

    def fit(steps):
        torch.manual_seed(0)
        module = NJFTraining(MODEL, learning_rate=3e-3, steps=90, kind=kind)
        trainer = make_trainer(tmp_path, steps=steps, validate_every=30)
        trainer.fit(
            module,
            body_loader(BodyMaps(train, resample=True, **INPUTS), shuffle=True),
            body_loader(BodyMaps(validation, **INPUTS)),
            ckpt_path=last_checkpoint(tmp_path),
        )
        return trainer

    fit(45)
    assert fit(90).global_step == 90
    path = last_checkpoint(tmp_path)
    model = load_checkpoint(path)
    assert type(model) is type(NJFTraining(MODEL, kind=kind).model)
    saved = torch.load(path, weights_only=False)
    assert saved["cpu_seconds"] > 0
    examples = BodyMaps(train, **INPUTS)
    untrained = summarise(evaluate_maps(NeuralJacobianField(**MODEL), examples)[0])
    trained = summarise(evaluate_maps(model, examples)[0])
    for error in ("L2-V", "L2-J", "L2-N, degrees"):
        assert trained[error] < 0.9 * untrained[error]


def test_records_of_a_known_map(bodies):
    """A network that outputs twice a quarter turn: every error can be computed by hand."""
    examples = BodyMaps(bodies[:2], **INPUTS)
    model = NeuralJacobianField(**MODEL)
    turn = 2 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    with torch.no_grad():
        model.field.layers[-1].bias.copy_((turn - torch.eye(3)).flatten())
    records, maps = evaluate_maps(model, examples)
    assert [(r.body, r.pose) for r in records] == [(b, p) for b in (0, 1) for p in range(5)]
    assert {record.source for record in records} == {None}
    record, body = records[7], bodies[1]
    phi, target = (x.double().numpy() for x in (body.rest @ turn.T, body.posed[2]))
    unit = [x - x.mean(0) for x in (phi, target)]
    unit = [x / np.linalg.norm(x, axis=1).max() for x in unit]
    assert record.l2_v == pytest.approx(
        100 * np.linalg.norm(unit[0] - unit[1], axis=1).mean(), 1e-4
    )
    normals = [dp.Mesh(torch.from_numpy(x), body.faces).normals.numpy() for x in (phi, target)]
    angles = np.rad2deg(np.arccos(np.clip((normals[0] * normals[1]).sum(1), -1, 1)))
    assert record.l2_n == pytest.approx(angles.mean(), rel=1e-4)
    mesh = dp.Mesh(body.rest.double(), body.faces)
    difference = dp.jacobians(mesh, torch.from_numpy(phi - target), extrinsic=True)
    error = 10 * float(difference.square().sum((1, 2)).sqrt().mean())
    assert record.l2_j == pytest.approx(error, rel=1e-4)
    assert record.l2_j_emitted == pytest.approx(error, rel=1e-4)  # the field is integrable
    emitted = maps[1][2] - maps[1][2].mean(0)
    assert_close(emitted, body.rest @ turn.T - (body.rest @ turn.T).mean(0), rtol=0, atol=1e-5)
    assert summarise(records)["L2-V"] == pytest.approx(np.mean([r.l2_v for r in records]))


def test_a_baseline_that_does_not_exist_and_turns_in_space_raise():
    with pytest.raises(ValueError, match="kind must be one of"):
        NJFTraining(MODEL, kind="best")
    with pytest.raises(ValueError, match="augment turns planar maps"):
        NJFTraining(MODEL, {"augment": True})


def test_a_body_is_drawn_in_its_colours_seen_from_the_front():
    """A ball, red to the back and green to the front; then red to its left, green to its right."""
    vertices, faces = (torch.from_numpy(x) for x in meshes.sphere(0, subdivisions=2))
    vertices = vertices / torch.linalg.vector_norm(vertices, dim=1, keepdim=True)
    behind = vertices[:, 1].numpy() > 0.7
    colours = np.where(behind[:, None], (1.0, 0, 0), (0, 1.0, 0))
    image = render_body(vertices, faces, colours, size=60, side=4.0)
    seen = (image < 1).any(-1)
    assert 0.15 < seen.mean() < 0.22  # π / 16
    assert (image[..., 1] >= image[..., 0])[seen].all()
    left = vertices[:, :1].numpy() > 0
    image = render_body(vertices, faces, np.where(left, (1.0, 0, 0), (0, 1.0, 0)), 60, side=4.0)
    red, green = ((image[..., k] < 0.5 * image[..., 1 - k]).nonzero()[1] for k in (1, 0))
    assert red.mean() > green.mean() + 5  # the body's left is on our right


def test_report_is_written(bodies, tmp_path):
    body = bodies[0]
    predictions = {"a": body.posed[0], "b": body.rest}
    rows = [BodyRow("first", body.faces, body.rest, body.posed[0], predictions)]
    save_body_report(rows, tmp_path / "report.png", size=80)
    assert (tmp_path / "report.png").stat().st_size > 10_000


def test_without_targets_maps_are_drawn_plain(bodies, tmp_path):
    """Source and map, two panels, and no scale of errors."""
    body, sizes = bodies[0], []
    for target in (None, body.posed[0]):
        rows = [BodyRow("first", body.faces, body.rest, target, {"ours": body.posed[0]})]
        save_body_report(rows, tmp_path / "report.png", size=80)
        sizes.append(plt.imread(tmp_path / "report.png").shape[1])
    assert 1.4 * sizes[0] < sizes[1]
