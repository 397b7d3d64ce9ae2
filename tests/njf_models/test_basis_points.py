"""Shapes seen from fixed points: closest points, whatever the triangulation; and their poses."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField
from njf_models.basis_points import BasisEncoder, basis_features, basis_points, reflected_basis
from njf_models.body_maps import BodyMaps, CellSampler, Task
from njf_models.chain import ChainedNJF
from njf_models.datasets.bodies import POSE_SIZE
from njf_models.datasets.poses import JOINTS, reflected, sample_pose
from njf_models.datasets.seen_poses import SeenPoses
from njf_models.features import Shape
from njf_models.pose_estimator import PoseEstimator, angles_between
from njf_models.pose_training import PoseTraining, joint_errors, pose_loader
from njf_models.trained import Inputs
from njf_models.training import NJFTraining, last_checkpoint, make_trainer
from tests.njf_models.shapes import randomised
from tests.njf_models.test_body_maps import twisted

UNSEEN_PIECES = Task(sources=2, told="points", pieces=1, radii=(0.3, 0.4))


def box(subdivisions: int = 0) -> dp.Mesh:
    """A box off the origin, of half sides 0.3, 0.2 and 0.5."""
    solid = trimesh.creation.box(extents=(0.6, 0.4, 1.0))
    for _ in range(subdivisions):
        solid = solid.subdivide()
    return dp.Mesh(
        torch.from_numpy(solid.vertices + np.array([3.0, 2, 1])), torch.from_numpy(solid.faces)
    )


def test_basis_points_are_pairs_in_a_box_and_always_the_same():
    points = basis_points(64)
    assert points.shape == (32, 2, 3)
    assert (points[:, 0] * torch.tensor([-1.0, 1, 1]) == points[:, 1]).all()
    assert (points[:, 0, 0] >= 0).all()
    assert (points.abs() <= torch.tensor([0.9, 0.45, 1.0])).all()
    assert len(points.view(-1, 3).unique(dim=0)) >= 62  # those on the mirror may coincide
    spread = points.view(-1, 3).abs().amax(0) / torch.tensor([0.9, 0.45, 1.0])
    assert spread.min() > 0.9
    assert (basis_points(16) == points[:8]).all()  # the first ones stay
    for n in (0, 3, -2):
        with pytest.raises(ValueError, match=f"pairs, of an even number of points, got {n}"):
            basis_points(n)


def test_basis_points_on_the_average_body_are_pairs_of_a_standing_one():
    points = basis_points(1228, "body")
    assert points.shape == (614, 2, 3)
    assert (points[:, 0] * torch.tensor([-1.0, 1, 1]) == points[:, 1]).all()
    assert (points[:, 0, 0] > 0).all()
    assert_close(points.amax((0, 1)), -points.amin((0, 1)))
    assert 1.6 < 2 * float(points[..., 2].max()) < 2.0
    assert (basis_points(40, "body") == points[:20]).all()
    # More of them where there is more to see: at the hands, a twentieth of the skin.
    assert (points[..., 0].abs() > 0.45).double().mean() > 0.1
    with pytest.raises(ValueError, match="there are 1228 basis points on the body, got n=1230"):
        basis_points(1230, "body")
    reached = points[:7].reshape(-1, 3) + basis_features(box(), 14, "body").view(-1, 4)[:, :3]
    half = torch.tensor([0.3, 0.2, 0.5], dtype=torch.float64)
    assert_close((reached.abs() - half).amax(1), torch.zeros(14).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("place", ["box", "body"])
def test_all_see_the_same(place):
    """Batches, trained networks and chains: a body and its code."""
    body, sizes = twisted(2), MODEL | {"basis_at": place}
    maps = BodyMaps([body], Task(sources=1, told="nothing"), basis_at=place, **SEEN)
    mesh = dp.Mesh(body.posed[0].double(), body.faces)
    expected = basis_features(mesh, 16, place).float()
    assert_close(maps[0].points[0], expected)
    assert_close(Inputs(n_basis=16, basis_at=place).of(mesh)[1], expected)
    network = randomised(NeuralJacobianField(**sizes)).float().eval()
    start = ChainedNJF.of([network], 4).start(Shape.prepare(mesh))
    assert_close(start.code, network.encode(expected[None])[0])


def test_ways_lead_to_the_closest_points_of_a_box():
    """Known in closed form: outside, clamped coordinates; inside, the nearest side."""
    features = basis_features(box(), 256).view(-1, 4)
    points = basis_points(256).view(-1, 3)
    half = torch.tensor([0.3, 0.2, 0.5], dtype=torch.float64)
    outside = (points.abs() - half).clamp(min=0).norm(dim=1)
    inside = (half - points.abs()).amin(1)
    expected = torch.where(outside > 0, outside, inside)
    assert 3 < int((outside == 0).sum()) < 253
    assert_close(features[:, 3], expected, rtol=1e-12, atol=1e-12)
    assert_close(features[:, :3].norm(dim=1), expected, rtol=1e-12, atol=1e-12)
    reached = points + features[:, :3]
    assert_close((reached.abs() - half).amax(1), torch.zeros(256).double(), rtol=0, atol=1e-12)


def test_the_triangulation_does_not_matter():
    some = basis_features(box(), 64)
    finer = basis_features(box(2), 64)
    # At equal distances of two sides, either is closest.
    assert_close(some.view(-1, 4)[:, 3], finer.view(-1, 4)[:, 3], rtol=1e-12, atol=1e-12)
    apart = (some - finer).abs().view(-1, 4).amax(1) > 1e-9
    assert apart.sum() <= 2
    generator = torch.Generator().manual_seed(0)
    mesh = box(1)
    order = torch.randperm(mesh.n_vertices, generator=generator)
    faces = order.argsort()[mesh.faces][torch.randperm(mesh.n_faces, generator=generator)]
    permuted = basis_features(dp.Mesh(mesh.vertices[order], faces), 64)
    assert_close(permuted, basis_features(mesh, 64), rtol=1e-9, atol=1e-9)


def test_a_mirror_image_is_seen_as_said():
    body = twisted(3)
    mesh = dp.Mesh(body.posed[0].double(), body.faces)
    image = dp.Mesh(mesh.vertices * torch.tensor([-1.0, 1, 1]), mesh.faces.flip(1))
    seen, expected = (basis_features(x, 40) for x in (mesh, image))
    assert (seen - expected).abs().max() > 1e-3
    assert_close(reflected_basis(seen), expected, rtol=1e-9, atol=1e-9)
    assert_close(reflected_basis(reflected_basis(seen)), seen)


def test_an_encoder_reads_all_that_is_seen():
    encoder = BasisEncoder(16, 5).double()
    features = torch.randn(2, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    code = encoder(features)
    assert code.shape == (2, 3, 5)
    code.sum().backward()
    assert (features.grad != 0).all()


MODEL = {"face_features": 6, "point_features": 6, "code_size": 8, "basis": 16, "width": 16}
SEEN = {"n_points": 4, "n_energies": 0, "n_basis": 16}


@pytest.mark.parametrize("task", [Task(sources=2), Task(sources=2, told="points", others=True)])
def test_cells_are_seen_from_the_basis_mirrored_with_their_bodies(task):
    bodies = [twisted(number) for number in range(4)]
    maps = BodyMaps(bodies, task, n_targets=3, resample=True, **SEEN)
    mirrored = 0
    for _ in range(6):
        cells = CellSampler(maps, "faces", 3)([0, 3, 5])
        for i, index in enumerate((0, 3, 5)):
            x = bodies[index // 2].posed[index % 2]
            seen = basis_features(dp.Mesh(x, bodies[0].faces), 16)
            same = (cells.points[i] - seen).abs().max() < 1e-5
            other = (cells.points[i] - reflected_basis(seen)).abs().max() < 1e-5
            assert same != other
            mirrored += int(other)
        if task.others:
            every = [basis_features(dp.Mesh(x, b.faces), 16) for b in bodies for x in b.posed]
            either = torch.stack([*every, *(reflected_basis(seen) for seen in every)])
            apart = (cells.target_points[0][:, None] - either).abs().amax((-1, -2))
            assert (apart.amin(1) < 1e-5).all()
    assert 0 < mirrored < 18


def test_batches_see_sources_and_targets_from_the_basis_and_partial_ones_raise():
    bodies = [twisted(number) for number in range(3)]
    task = Task(sources=2, told="points", others=True)
    maps = BodyMaps(bodies, task, n_targets=2, **SEEN)
    batch = maps[3]
    assert_close(batch.points[0], basis_features(dp.Mesh(bodies[1].posed[1], bodies[0].faces), 16))
    for (body, pose), seen in zip(maps.targets(3).tolist(), batch.target_points, strict=True):
        expected = basis_features(dp.Mesh(bodies[body].posed[pose], bodies[0].faces), 16)
        assert_close(seen, expected)
    with pytest.raises(ValueError, match="whole sources only"):
        BodyMaps(bodies, UNSEEN_PIECES, **SEEN)


# -------------------------------------------------------------------- poses


def test_a_code_has_the_estimated_rotations_of_source_or_target():
    seen = torch.randn(2, 8, 8)
    unposing = NeuralJacobianField(**MODEL, joints=3, parts=8)
    assert unposing.code_size == unposing.source_size == 8 + 2 * 27
    torch.nn.init.normal_(unposing.estimator.layers[-1].weight)
    code, offsets = unposing.encode(seen), unposing.estimator(seen)
    assert_close(code[:, 8:35].unflatten(-1, (3, 3, 3)), offsets)
    assert_close(code[:, 35:].unflatten(-1, (3, 3, 3)), offsets.mT)
    assert_close(unposing.encode_source(seen), code)
    morphing = NeuralJacobianField(**MODEL, joints=3, parts=8, encodes_target=True)
    assert (morphing.source_size, morphing.code_size) == (8, 8 + 8 + 27)
    torch.nn.init.normal_(morphing.estimator.layers[-1].weight)
    both = morphing.encode(seen[:1], seen)
    assert_close(both[:, 16:].unflatten(-1, (3, 3, 3)), morphing.estimator(seen))
    assert_close(morphing.told(seen, None), both[:, 8:])
    assert_close(morphing.encode_source(seen), morphing.encode(seen, seen)[:, :8])
    for wrong in ({"basis": 0}, {"parameters": 6}, {"point_features": 0}):
        with pytest.raises(ValueError, match="joints are estimated from basis points"):
            NeuralJacobianField(**{**MODEL, **wrong}, joints=3)


def test_training_leaves_the_estimator_as_it_is():
    module = NJFTraining(MODEL | {"joints": 3, "parts": 8}, inputs=SEEN)
    torch.nn.init.normal_(module.model.estimator.layers[-1].weight)
    before = {name: value.clone() for name, value in module.model.state_dict().items()}
    maps = BodyMaps([twisted(0), twisted(1)], Task(sources=2, told="nothing"), **SEEN)
    optimizer = torch.optim.Adam(module.model.parameters())
    for _ in range(3):  # the gradient comes to the encoder by weights that start at zero
        optimizer.zero_grad()
        module.training_step(CellSampler(maps, "faces", 9)([0, 3]), 0).backward()
        optimizer.step()
    for name, value in module.model.state_dict().items():
        same = torch.equal(before[name], value)
        assert same == name.startswith("estimator."), name


def test_angles_are_those_of_scipy():
    generator = np.random.default_rng(0)
    some, others = (Rotation.random(20, random_state=generator) for _ in range(2))
    expected = torch.from_numpy((some.inv() * others).magnitude())
    matrices = (torch.from_numpy(x.as_matrix()) for x in (some, others))
    a, b = matrices
    stretched = b @ torch.diag(torch.tensor([2.0, 1, 0.5]).double())  # closest rotation: b
    assert_close(angles_between(stretched, a), expected, rtol=1e-6, atol=1e-6)
    assert_close(angles_between(a, a), torch.zeros(20).double(), rtol=0, atol=1e-7)


def pairs(n: int, seed: int) -> SeenPoses:
    """Features that are a linear image of the rotations, as simple as can be."""
    rng = np.random.default_rng(seed)
    poses = torch.from_numpy(np.stack([sample_pose(rng) for _ in range(n)])).float().flatten(1)
    one = torch.zeros(n, 32, 8)
    one.view(n, -1)[:, :60] = poses
    return SeenPoses(one.half(), poses)


def test_an_estimator_learns_resumes_and_is_evaluated(tmp_path, monkeypatch):
    monkeypatch.setattr("njf_models.pose_training.reflected_basis", mirrored_pairs)
    train, validation = pairs(400, 0), pairs(100, 1)
    before = joint_errors(PoseEstimator(64, len(JOINTS), 64), validation)
    assert before.shape == (100, 20)

    def run(steps: int) -> PoseTraining:
        torch.manual_seed(0)
        module = PoseTraining({"basis": 64, "width": 64}, steps=200)
        trainer = make_trainer(tmp_path, steps=steps, validate_every=50)
        trainer.fit(
            module,
            pose_loader(train, 40, shuffle=True),
            pose_loader(validation, 50),
            ckpt_path=last_checkpoint(tmp_path),
        )
        return module

    assert run(50).global_step == 50
    module = run(200)
    assert module.global_step == 200
    assert module.cpu_seconds > 0
    after = joint_errors(module.estimator.eval(), validation)
    assert after.mean() < 0.5 * before.mean()
    loaded = PoseTraining.load_from_checkpoint(tmp_path / "checkpoints" / "last.ckpt")
    assert_close(joint_errors(loaded.estimator, validation), after)


def mirrored_pairs(features: torch.Tensor) -> torch.Tensor:
    """What `pairs` shows of mirrored bodies."""
    mirrored = features.clone()
    flat = mirrored.view(len(features), -1)
    flat[:, :POSE_SIZE] = reflected(flat[:, :POSE_SIZE])
    return mirrored
