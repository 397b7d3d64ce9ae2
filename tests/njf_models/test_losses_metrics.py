"""Losses and metrics against their definitions written out with numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import Prediction, Shape
from njf_models.losses import official_loss, paper_loss, turned_loss
from njf_models.metrics import (
    count_distorted,
    count_flips,
    l2_jacobians,
    l2_normals,
    l2_vertices,
)
from tests import references
from tests.njf_models.shapes import bumpy_disk, ellipsoid, prepared


def made_up(shape: Shape, c: int, seed: int):
    generator = torch.Generator().manual_seed(seed)
    options = {"dtype": torch.float64, "generator": generator}
    n, m = shape.mesh.n_vertices, shape.mesh.n_faces
    R = torch.randn(m, c, 2, **options)
    return Prediction(torch.randn(m, c, 3, **options), R, shape.solver(R)), torch.randn(
        n, c, **options
    )


def test_paper_loss_is_the_weighted_sum_of_its_equation():
    shape = prepared(ellipsoid())
    prediction, target = made_up(shape, 3, 0)
    V, F = shape.mesh.vertices.numpy(), shape.mesh.faces.numpy()
    A, M = references.areas(V, F), references.vertex_areas(V, F)
    M = M / A.sum()
    A = A / A.sum()
    phi = prediction.vertices.numpy()
    psi = target.numpy() - (M[:, None] * target.numpy()).sum(0)
    J = references.jacobians(V, F, target.numpy())  # extrinsic
    R = prediction.jacobians.numpy() @ shape.mesh.frames.numpy().transpose(0, 2, 1)
    vertices = (M * ((phi - psi) ** 2).sum(1)).sum()
    jacobians = (A * ((R - J) ** 2).sum((1, 2))).sum()
    loss = paper_loss(shape, prediction, target)
    assert_close(float(loss.vertices), vertices, rtol=1e-9, atol=0)
    assert_close(float(loss.jacobians), jacobians, rtol=1e-9, atol=0)
    assert_close(float(loss.total), 10 * vertices + jacobians, rtol=1e-9, atol=0)


@pytest.mark.parametrize("loss", [paper_loss, official_loss])
def test_zero_at_the_target_and_blind_to_translation(loss):
    shape = prepared(bumpy_disk())
    target = torch.randn(shape.mesh.n_vertices, 2, dtype=torch.float64)
    weights = {
        paper_loss: shape.vertex_weights,
        official_loss: torch.full_like(shape.vertex_weights, 1 / shape.mesh.n_vertices),
    }[loss]
    exact = Prediction(
        torch.zeros(shape.mesh.n_faces, 2, 3, dtype=torch.float64),
        dp.jacobians(shape.mesh, target),
        target - (weights[:, None] * target).sum(0),
    )
    assert loss(shape, exact, target + 7).total < 1e-20


def test_official_loss_is_the_mean_over_entries():
    shape = prepared(ellipsoid())
    prediction, target = made_up(shape, 3, 1)
    psi = target - target.mean(0)
    J = dp.jacobians(shape.mesh, target)
    vertices = np.mean((prediction.vertices.numpy() - psi.numpy()) ** 2)
    jacobians = np.mean((prediction.jacobians.numpy() - J.numpy()) ** 2)
    loss = official_loss(shape, prediction, target)
    assert_close(float(loss.total), 10 * vertices + jacobians, rtol=1e-12, atol=0)


def test_paper_loss_of_a_batch_is_the_mean_of_its_shapes():
    shapes = [prepared(bumpy_disk(0)), prepared(ellipsoid()), prepared(bumpy_disk(2, 4))]
    single = [made_up(shape, 2, i) for i, shape in enumerate(shapes)]
    union = Prediction(*(torch.cat(fields) for fields in zip(*(p for p, _ in single), strict=True)))
    target = torch.cat([t for _, t in single])
    each = [float(paper_loss(s, p, t).total) for s, (p, t) in zip(shapes, single, strict=True)]
    total = paper_loss(Shape.concatenate(shapes), union, target).total
    assert_close(float(total), np.mean(each), rtol=1e-10, atol=0)
    totals = paper_loss(Shape.concatenate(shapes), union, target, "none").total
    assert_close(totals, torch.tensor(each, dtype=totals.dtype), rtol=1e-10, atol=0)


def test_turned_loss_of_a_batch_turns_each_target_as_the_svd_does():
    shapes = [prepared(bumpy_disk(0)), prepared(ellipsoid()), prepared(bumpy_disk(2, 4))]
    single = [made_up(shape, 2, i) for i, shape in enumerate(shapes)]
    expected = []
    for shape, (prediction, target) in zip(shapes, single, strict=True):
        weights = shape.vertex_weights.numpy()[:, None]
        phi, psi = prediction.vertices.numpy(), target.numpy()
        U, _, Vt = np.linalg.svd((weights * phi).T @ (psi - (weights * psi).sum(0)))
        U[:, 1] *= np.sign(np.linalg.det(U @ Vt))  # a rotation, no reflection
        turned = torch.from_numpy(psi @ (U @ Vt).T)
        expected.append(float(paper_loss(shape, prediction, turned).total))
        assert expected[-1] < float(paper_loss(shape, prediction, target).total)
    union = Prediction(*(torch.cat(fields) for fields in zip(*(p for p, _ in single), strict=True)))
    target = torch.cat([t for _, t in single])
    total = turned_loss(Shape.concatenate(shapes), union, target).total
    assert_close(float(total), np.mean(expected), rtol=1e-10, atol=0)


@pytest.mark.parametrize("angle", [0.3, 3.0])
def test_turned_loss_is_blind_to_rotations_but_not_to_reflections(angle):
    shape = prepared(bumpy_disk())
    mesh = shape.mesh
    target = mesh.vertices[:, :2]
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, -s], [s, c]])
    mirror = torch.diag(torch.tensor([1.0, -1.0], dtype=torch.float64))
    for image, blind in ((turn, True), (turn @ mirror, False)):
        moved = target @ image.T + 5
        J = dp.jacobians(mesh, moved)
        phi = moved - (shape.vertex_weights[:, None] * moved).sum(0)
        loss = float(turned_loss(shape, Prediction(dp.extend(J, shape.frames), J, phi), target)[0])
        assert loss < 1e-20 if blind else loss > 1e-2


def test_the_gradient_of_turned_loss_in_vertices_is_that_of_the_minimum_over_turns():
    """By the envelope theorem, although the turn itself is held constant."""
    shape = prepared(bumpy_disk())
    prediction, target = made_up(shape, 2, 3)

    def minimum(phi):
        angles = torch.linspace(0, 2 * np.pi, 100_001, dtype=torch.float64)
        psi = target - (shape.vertex_weights[:, None] * target).sum(0)
        a = (shape.vertex_weights[:, None] * phi).T @ psi
        gain = (a[0, 0] + a[1, 1]) * angles.cos() + (a[1, 0] - a[0, 1]) * angles.sin()
        size = (shape.vertex_weights[:, None] * (phi.square() + psi.square())).sum()
        return size - 2 * gain.max()

    phi = prediction.vertices.clone().requires_grad_()
    loss = turned_loss(shape, prediction._replace(vertices=phi), target).vertices
    (ours,) = torch.autograd.grad(loss, phi)
    (theirs,) = torch.autograd.grad(minimum(phi), phi)
    assert_close(loss, minimum(phi), rtol=1e-8, atol=0)
    assert_close(ours, theirs, rtol=1e-3, atol=1e-6)


def test_paper_loss_does_not_depend_on_unit_or_refinement():
    """A constant error in Jacobians costs its squared norm, whatever the mesh's size or scale."""
    for mesh in (bumpy_disk(0, 4), dp.Mesh(1e3 * bumpy_disk().vertices, bumpy_disk().faces)):
        shape = prepared(mesh)
        target = mesh.vertices[:, :2]
        J = dp.jacobians(mesh, target)
        error = torch.tensor([[0.1, 0.2], [0.0, -0.1]], dtype=torch.float64)
        loss = paper_loss(
            shape, Prediction(torch.zeros(mesh.n_faces, 2, 3).double(), J + error, target), target
        )
        assert_close(float(loss.jacobians), 0.06, rtol=1e-9, atol=0)


def test_l2_vertices_written_out():
    a, b = np.random.default_rng(0).standard_normal((2, 30, 3))
    centred = (a - a.mean(0), b - b.mean(0))
    unit = [x / np.linalg.norm(x, axis=1).max() for x in centred]
    expected = 100 * np.linalg.norm(unit[0] - unit[1], axis=1).mean()
    a, b = torch.from_numpy(a), torch.from_numpy(b)
    assert_close(float(l2_vertices(a, b)), expected, rtol=1e-12, atol=0)
    assert l2_vertices(3 * a + 5, a) < 1e-12
    assert_close(
        l2_vertices(torch.stack([a, b]), b), torch.stack([l2_vertices(a, b), l2_vertices(b, b)])
    )


def test_l2_jacobians_written_out():
    a, b = np.random.default_rng(0).standard_normal((2, 30, 3, 2))
    expected = 10 * np.mean([np.linalg.norm(x - y) for x, y in zip(a, b, strict=True)])
    assert_close(float(l2_jacobians(torch.from_numpy(a), torch.from_numpy(b))), expected)


def test_l2_normals_measures_the_angle_of_a_rotation():
    mesh = ellipsoid()
    V, F = mesh.vertices, mesh.faces
    triangle, faces = V[F[:1]][0], torch.tensor([[0, 1, 2]])
    normal, tangent = mesh.normals[0], mesh.frames[0, :, 0]
    for degrees in (1e-6, 30.0, 179.0):
        angle = torch.tensor(degrees, dtype=torch.float64).deg2rad()
        K = torch.linalg.cross(tangent[None].expand(3, 3), torch.eye(3, dtype=torch.float64)).T
        rotation = torch.eye(3).double() + angle.sin() * K + (1 - angle.cos()) * K @ K
        assert abs(normal @ tangent) < 1e-12
        measured = l2_normals(triangle @ rotation.T, triangle, faces)
        assert_close(float(measured), degrees, rtol=1e-6, atol=0)
    assert l2_normals(V, V, F) < 1e-12
    assert_close(float(l2_normals(torch.zeros_like(V), V, F)), 90.0)


def test_counts():
    J = torch.diag_embed(
        torch.tensor(
            [[1.0, 1.0], [11.0, 1.0], [1.0, 0.09], [10.0, 0.1], [1.0, -1.0], [1.0, 0.0]]
        ).double()
    )
    assert int(count_flips(J)) == 2
    assert int(count_distorted(J[[0, 1, 2, 4, 5]])) == 4
    batch = torch.stack([J, J[:1].expand_as(J)])
    assert count_flips(batch).tolist() == [2, 0]
