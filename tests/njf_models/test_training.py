"""Training learns, stops and resumes; evaluation and pictures say what is there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField, Shape
from njf_models.datasets.uv import UVPatch
from njf_models.evaluation import evaluate_uv, format_table, summarise
from njf_models.losses import paper_loss
from njf_models.report import UVRow, render_checkerboard, save_uv_report
from njf_models.training import (
    Batch,
    NJFTraining,
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
