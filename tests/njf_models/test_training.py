"""Training learns, stops and resumes; evaluation and pictures say what is there."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField, Shape
from njf_models.datasets.uv import UVPatch
from njf_models.evaluation import evaluate_uv, format_table, summarise
from njf_models.features import Motions
from njf_models.losses import paper_loss
from njf_models.report import UVRow, render_checkerboard, save_uv_report
from njf_models.training import (
    Batch,
    NJFTraining,
    Objective,
    UVExamples,
    last_checkpoint,
    load_checkpoint,
    loader,
    make_trainer,
)
from tests import meshes

MODEL = {"face_features": 6, "point_features": 6, "code_size": 16, "output_dim": 2}


def patch(seed: int) -> UVPatch:
    """A bumpy disk with its projection, stretched, as target: easy, but far from the identity."""
    mesh = dp.Mesh(*meshes.disk(seed, 6))
    uv = mesh.vertices[:, :2] @ torch.tensor([[1.5, 0.0], [0.3, 0.7]], dtype=torch.float64)
    wks = dp.wave_kernel_signature(mesh, 4, n_eigenpairs=10).float()
    return UVPatch(mesh.vertices, mesh.faces, uv, wks, f"m{seed}", f"m{seed}", 1.0, 4.5)


@pytest.fixture(scope="module")
def patches():
    return [patch(seed) for seed in range(6)]


def fit(patches, folder, epochs, checkpoint=None):
    trainer = make_trainer(folder)
    trainer.fit_loop.max_epochs = epochs
    module = NJFTraining(MODEL, learning_rate=3e-3)
    examples = UVExamples(patches, n_points=64, resample=True, use_wks=False)
    trainer.fit(
        module, loader(examples, 2, shuffle=True), loader(examples, 6), ckpt_path=checkpoint
    )
    return trainer, module


def test_training_learns_and_resumes_where_it_stopped(patches, tmp_path):
    trainer, module = fit(patches, tmp_path, 15)
    examples = UVExamples(patches, n_points=64, use_wks=False)
    torch.manual_seed(0)
    untrained = summarise(evaluate_uv(NeuralJacobianField(**MODEL), examples)[0])
    trained = summarise(evaluate_uv(module.model, examples)[0])
    assert trained["loss"] < 0.3 * untrained["loss"]

    stopped_at = trainer.global_step
    last = last_checkpoint(tmp_path)
    assert last is not None
    resumed, _ = fit(patches, tmp_path, 17, checkpoint=last)
    assert resumed.global_step == stopped_at + 2 * 3
    model = load_checkpoint(last)
    assert not model.training


def test_training_time_adds_up_over_runs(patches, tmp_path):
    """Each run's within what the call took; unknown after a checkpoint that has none."""
    seconds, calls = [0.0], [0.0]
    for epochs in (2, 4):
        start = time.perf_counter()
        _, module = fit(patches, tmp_path, epochs, checkpoint=last_checkpoint(tmp_path))
        calls.append(time.perf_counter() - start)
        path = last_checkpoint(tmp_path)
        assert path is not None
        saved = torch.load(path, weights_only=False)
        seconds.append(saved["training_seconds"])
        assert seconds[-2] < seconds[-1] <= module.training_seconds
        assert module.training_seconds < sum(calls)
        assert module.training_seconds == module.training_seconds  # the clock has stopped

    del saved["training_seconds"]
    torch.save(saved, path)
    assert not load_checkpoint(path).training
    _, module = fit(patches, tmp_path, 6, checkpoint=path)
    assert module.training_seconds is None
    assert torch.load(path, weights_only=False)["training_seconds"] is None


def test_objectives_without_a_target_or_a_loss(patches):
    batch = Batch.pack([UVExamples(patches, n_points=16, use_wks=False)[0]])
    model = NeuralJacobianField(**MODEL)
    with torch.no_grad():
        prediction = model(batch.shape, model.encode(batch.points))
    J = dp.jacobians(batch.shape.mesh, prediction.vertices[0])
    a, b, c, d = J.double().flatten(1).T
    det = a * d - b * c
    chi = (det + torch.sqrt(0.01 + det**2)) / 2
    energy = (J.double() ** 2).sum((1, 2)) * (1 + 1 / chi**2)
    areas = batch.shape.mesh.areas.double()
    distortion = float((areas * (energy / 4).log()).sum() / areas.sum())
    supervised = float(Objective()(batch, prediction).total)
    alone = Objective(supervised=None, distortion=2.0)(batch, prediction)
    mixed = Objective(distortion=0.5)(batch, prediction)
    assert float(alone.total) == pytest.approx(2 * distortion, rel=1e-4)
    assert float(mixed.total) == pytest.approx(supervised + 0.5 * distortion, rel=1e-4)
    assert float(alone.vertices) == 0
    with pytest.raises(ValueError, match="positive weight"):
        Objective(supervised=None)


def test_a_robust_objective_takes_the_logarithm_of_each_shape(patches):
    batch = Batch.pack(
        [UVExamples(patches, n_points=16, use_wks=False)[i] for i in range(3)]
    ).moved(Motions.random(3))
    model = NeuralJacobianField(**MODEL)
    with torch.no_grad():
        prediction = model(batch.shape, model.encode(batch.points))
    each = paper_loss(batch.shape, prediction, batch.target, "none")
    loss = Objective(robust=True)(batch, prediction)
    assert float(loss.total) == pytest.approx(float((1 + each.total).log().mean()), rel=1e-6)
    assert float(loss.vertices) == pytest.approx(float(each.vertices.mean()), rel=1e-6)
    for supervised in ("official", None):
        with pytest.raises(ValueError, match="robust needs a supervised loss of each shape"):
            Objective(supervised=supervised, distortion=1.0, robust=True)


def test_the_last_step_is_saved_where_none_was_validated_after_it(patches, tmp_path):
    module = NJFTraining(MODEL, steps=5)
    examples = UVExamples(patches, n_points=16, use_wks=False)
    trainer = make_trainer(tmp_path, steps=5, validate_every=2)
    trainer.fit(module, loader(examples, 1), loader(examples, 4))
    record = torch.load(last_checkpoint(tmp_path), weights_only=False)
    assert record["global_step"] == 5
    for name, value in module.state_dict().items():
        assert torch.equal(record["state_dict"][name], value)


def test_unsupervised_training_lowers_distortion(patches, tmp_path):
    trainer = make_trainer(tmp_path, steps=30, validate_every=15)
    objective = {"supervised": None, "distortion": 1.0}
    module = NJFTraining(MODEL, objective, learning_rate=3e-3, steps=30)
    examples = UVExamples(patches, n_points=32, use_wks=False)

    def distortion():
        batch = Batch.pack([examples[i] for i in range(6)])
        with torch.no_grad():
            return float(module.objective(batch, module._iterates(batch)[-1]).total)

    before = distortion()
    trainer.fit(module, loader(examples, 3, shuffle=True), loader(examples, 6))
    assert trainer.global_step == 30
    assert distortion() < 0.8 * before
    assert trainer.optimizers[0].param_groups[0]["lr"] < 1e-6  # the cosine ended


def test_a_moved_batch_is_that_of_moved_meshes(patches):
    """Against meshes that are really moved, built anew; mirrored ones with faces reversed."""
    examples = UVExamples(patches[:3], n_points=16, use_wks=False)
    batch = Batch.pack([examples[i] for i in range(3)])
    motions = Motions.random(3, tilt=0.4, log_scale=0.3, generator=torch.Generator().manual_seed(5))
    moved = batch.moved(motions)
    assert_close(motions.turns @ motions.turns.mT, torch.eye(3).expand(3, 3, 3))
    mirrored = torch.linalg.det(motions.turns) < 0
    assert mirrored.any()
    assert not mirrored.all()
    assert (torch.linalg.det(motions.images) < 0).equal(mirrored)
    features = moved.shape.mesh.split_faces(moved.shape.features)
    frames = moved.shape.mesh.split_faces(moved.shape.frames)
    targets = moved.shape.mesh.split_vertices(moved.target)
    at_vertices = moved.shape.mesh.split_vertices(moved.shape.vertex_features)
    for k, patch in enumerate(patches[:3]):
        turn, scale = motions.turns[k].double(), motions.scales[k].double()
        faces = patch.mesh.faces.flip(1) if mirrored[k] else patch.mesh.faces
        mesh = dp.Mesh(scale * patch.mesh.vertices @ turn.T, faces)
        built = Shape.prepare(mesh)
        expected = built.features
        offset = expected[:, :3] - features[k][:, :3]  # another bounding box, another centre
        assert_close(offset, offset[:1].expand_as(offset), rtol=1e-4, atol=1e-5)
        assert_close(features[k][:, 3:], expected[:, 3:], rtol=1e-4, atol=1e-5)
        shifted = torch.cat([at_vertices[k][:, :3] + offset[:1], at_vertices[k][:, 3:]], dim=1)
        assert_close(shifted, built.vertex_features, rtol=1e-4, atol=1e-5)
        # A matrix for the moved shape acts on its tangents as its counterpart did before.
        P = torch.randn(2, 3)
        before = P @ examples[k].shape.frames
        image = motions.images[k]
        assert_close(
            image @ P @ motions.turns[k].T @ frames[k], image @ before, atol=1e-5, rtol=1e-4
        )
        assert_close(targets[k], patch.uv.float() @ image.T, atol=1e-6, rtol=1e-5)


DDP = """
from __future__ import annotations

import sys
from pathlib import Path

import torch
from njf_models.training import NJFTraining, UVExamples, loader, make_trainer
from tests.njf_models.test_training import MODEL, patch

if __name__ == "__main__":
    processes, folder = int(sys.argv[1]), Path(sys.argv[2])
    torch.manual_seed(0)
    module = NJFTraining(MODEL | {"rounds": 2}, {"distortion": 0.1}, steps=4)
    examples = UVExamples([patch(0), patch(1)], n_points=16, use_wks=False)
    trainer = make_trainer(folder, steps=4, validate_every=1, processes=processes)
    trainer.fit(module, loader(examples, 2 // processes), loader(examples, 2 // processes))
    if trainer.is_global_zero:
        torch.save(module.model.state_dict(), folder / f"{processes}.pt")
"""


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path):
    """Two patches: one step sees both in one process, or one in each of two."""
    script = tmp_path / "ddp.py"
    script.write_text(DDP)
    environment = os.environ | {"PYTHONPATH": str(Path.cwd()), "OMP_NUM_THREADS": "1"}
    for processes in (1, 2):
        command = [sys.executable, str(script), str(processes), str(tmp_path)]
        run = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=False, timeout=300
        )
        assert run.returncode == 0, run.stderr[-3000:]
    one, two = (torch.load(tmp_path / f"{n}.pt") for n in (1, 2))
    untrained = NeuralJacobianField(**MODEL, rounds=2).state_dict()
    assert (one["field.layers.12.weight"] - untrained["field.layers.12.weight"]).abs().max() > 1e-3
    for name, value in one.items():
        assert_close(two[name], value, rtol=1e-4, atol=1e-5)


def test_no_checkpoint_yet(tmp_path):
    assert last_checkpoint(tmp_path) is None


def test_unknown_loss_raises():
    with pytest.raises(ValueError, match="supervised must be None or one of"):
        NJFTraining(MODEL, {"supervised": "best"})


def test_a_packed_step_has_the_gradient_of_the_mean_over_its_shapes(patches):
    examples = UVExamples(patches[:3], n_points=32, use_wks=False)
    model = NeuralJacobianField(**MODEL)
    torch.nn.init.normal_(model.field.layers[-1].weight, std=0.1)

    def gradient(batch):
        prediction = model(batch.shape, model.encode(batch.points))
        total = paper_loss(batch.shape, prediction, batch.target).total
        return torch.cat(
            [g.flatten() for g in torch.autograd.grad(total, list(model.parameters()))]
        )

    packed = gradient(Batch.pack([examples[i] for i in range(3)]))
    alone = torch.stack([gradient(Batch.pack([examples[i]])) for i in range(3)]).mean(0)
    assert_close(packed, alone, rtol=1e-4, atol=1e-5 * float(alone.abs().max()))


def test_evaluation_points_are_fixed_and_training_points_are_not(patches):
    fixed, fresh = UVExamples(patches), UVExamples(patches, resample=True)
    assert_close(fixed[2].points, fixed[2].points)
    assert (fresh[2].points - fresh[2].points).abs().max() > 0
    assert fixed[2].points.shape == (1024, 6 + 4)
    assert fixed[0].shape is fixed[0].shape  # prepared once


def test_records_of_the_exact_and_of_a_flipped_map(patches):
    """A network that outputs a constant matrix: everything about its map is known."""
    examples = UVExamples(patches[:2], n_points=16, use_wks=False)
    model = NeuralJacobianField(**MODEL)
    with torch.no_grad():  # P = diag(2, -1/2) on every face
        model.field.layers[-1].bias.copy_(torch.tensor([1.0, 0, 0, 0, -1.5, 0]))
    records, maps = evaluate_uv(model, examples)
    mesh = patches[0].mesh
    expected = mesh.vertices[:, :2] * torch.tensor([2, -0.5])
    J = dp.jacobians(mesh, expected)
    assert_close(
        maps[0].double() - maps[0][0].double(), expected - expected[0], rtol=1e-4, atol=1e-4
    )
    flips = int((torch.linalg.det(J) <= 0).sum())
    assert flips > mesh.n_faces / 2
    assert (records[0].flips, records[0].flips_raw) == (flips, flips)
    assert records[0].energy == math.inf
    assert records[0].n_faces == mesh.n_faces
    table = summarise(records)
    assert table["patches with a flip, %"] == 100
    assert table["flips per patch"] == np.mean([r.flips for r in records])
    assert "flips per patch" in format_table({"a": table, "b": table})


def test_checkerboard_picture_shows_squares_of_the_map(patches):
    mesh, uv = patches[0].mesh, patches[0].uv
    image = render_checkerboard(mesh, uv, size=80)
    background = (image == 1).all(-1)
    assert 0.2 < background.mean() < 0.9
    blue = (image[..., 2] > 1.3 * image[..., 0]) & ~background
    assert 0.35 < blue.sum() / (~background).sum() < 0.65
    one_square = render_checkerboard(mesh, uv - uv.min(), size=80, square=1e3)
    assert (one_square[..., 2] > 1.3 * one_square[..., 0])[~background].all()


def test_report_is_written(patches, tmp_path):
    log = tmp_path / "metrics.csv"
    log.write_text("step,train/loss,validation/loss\n1,0.5,\n1,,0.7\n2,0.3,\n2,,0.6\n")
    rows = [UVRow("first", patches[0].mesh, {"a": patches[0].uv, "b": -patches[0].uv})]
    save_uv_report(rows, log, tmp_path / "report.png")
    assert (tmp_path / "report.png").stat().st_size > 20_000


def test_shape_weights_are_shares_of_each_part(patches):
    shapes = [Shape.prepare(p.mesh) for p in patches[:2]]
    union = Shape.concatenate(shapes)
    for weights, split in (
        (union.face_weights, union.mesh.split_faces),
        (union.vertex_weights, union.mesh.split_vertices),
    ):
        for part in split(weights):
            assert_close(float(part.sum()), 1.0)
