"""Bodies are anny's, posed as asked, screened, reproducible; and kept in files."""

from __future__ import annotations

import dataclasses
import importlib.util
import os

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import NeuralJacobianField
from njf_models.agnosticism import compare_triangulations
from njf_models.basis_points import basis_features
from njf_models.datasets import bodies, seen_poses
from njf_models.datasets.bodies import (
    PHENOTYPES,
    POSE_SIZE,
    BodyModel,
    BodySettings,
    BodyStore,
    build_bodies,
    build_retriangulated,
    draw_body,
    retriangulated,
)
from njf_models.datasets.poses import JOINTS, sample_pose
from njf_models.datasets.seen_poses import build_seen_poses
from njf_models.datasets.store import StoreError
from njf_models.datasets.triangulation import Triangulation
from njf_models.metrics import l2_vertices
from njf_models.pretrained import load_pretrained
from njf_models.trained import Inputs

pytestmark = pytest.mark.slow  # the body model takes a minute or more to build, the first time

MIDDLE = torch.tensor([sum(limits) / 2 for limits in PHENOTYPES.values()])
SETTINGS = BodySettings(n_poses=3)


@pytest.fixture(scope="module")
def model():
    return BodyModel()


@pytest.fixture(scope="module")
def coarse(model):
    return Triangulation.decimated(model.reference, 400)


def pose(**degrees: list[float]) -> torch.Tensor:
    vectors = torch.zeros(len(JOINTS), 3)
    for name, vector in degrees.items():
        vectors[JOINTS.index(name.replace("_", "."))] = torch.tensor(vector).deg2rad()
    return vectors.reshape(1, POSE_SIZE)


def moved(model: BodyModel, **degrees: list[float]) -> torch.Tensor:
    """How far each vertex moves from the rest pose."""
    rest, posed = (model.vertices(MIDDLE, p)[0] for p in (pose(), pose(**degrees)))
    return torch.linalg.vector_norm(posed - rest, dim=1)


def test_the_reference_is_one_closed_surface_as_tall_as_a_person(model):
    mesh = model.reference
    assert (mesh.n_vertices, mesh.n_faces) == (13348, 26692)
    assert mesh.n_vertices - mesh.n_faces / 2 == 2  # Euler: genus 0
    assert mesh.n_components == 1
    height = float(mesh.vertices[:, 2].max() - mesh.vertices[:, 2].min())
    assert 1.5 < height < 2
    assert model.intersecting(mesh.vertices.float()) == 0


def test_turning_the_root_turns_the_whole_body_rigidly(model):
    rest, turned = (model.vertices(MIDDLE, p)[0].double() for p in (pose(), pose(root=[0, 0, 90])))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    expected = (rest - rest.mean(0)) @ quarter.T
    assert_close(turned - turned.mean(0), expected, rtol=0, atol=1e-5)


def test_a_joint_moves_what_hangs_on_it(model):
    rest = model.reference.vertices
    x, y, z = rest.T
    arm = moved(model, lowerarm01_L=[-40.0, 0.0, -40.0])
    assert arm[x == x.max()] > 0.1  # the left hand
    assert arm[x < 0.1].max() == 0
    knee = moved(model, lowerleg01_R=[60.0, 0.0, 0.0])
    assert knee[z == z.min()].max() > 0.1 or knee[x < 0].max() > 0.1
    assert knee[x > 0].max() == 0
    posed = model.vertices(MIDDLE, pose(lowerleg01_R=[60.0, 0.0, 0.0]))[0]
    assert (posed[:, 1] - y)[knee > 0.2].min() > 0  # knees bend to the back, which is +y


def test_poses_of_a_batch_are_posed_alone(model):
    poses = torch.cat([pose(head=[10.0, 0, 0]), pose(foot_L=[0, 0, 5.0])])
    both = model.vertices(MIDDLE, poses)
    for i in range(2):
        assert_close(both[i], model.vertices(MIDDLE, poses[i : i + 1])[0], rtol=0, atol=1e-6)


def test_an_arm_through_the_body_is_seen(model):
    through = pose(upperarm01_L=[0, 90.0, 0])
    assert model.intersecting(model.vertices(MIDDLE, through)[0]) > SETTINGS.max_intersecting


def test_bodies_differ_by_number_and_seed_and_by_nothing_else(model, coarse):
    body = draw_body(model, coarse, SETTINGS, 5)
    again = draw_body(model, Triangulation.original(model.reference), SETTINGS, 5)
    assert (body.poses == again.poses).all()
    assert (body.phenotype == again.phenotype).all()
    assert_close(coarse.deformed(again.posed.double()).float(), body.posed, rtol=0, atol=1e-6)
    for other in (
        draw_body(model, coarse, SETTINGS, 6),
        draw_body(model, coarse, dataclasses.replace(SETTINGS, seed=1), 5),
    ):
        assert (other.phenotype != body.phenotype).all()
        assert (other.poses - body.poses).abs().amax(1).min() > 0.05
    low, high = torch.tensor(list(PHENOTYPES.values())).T
    assert ((low <= body.phenotype) & (body.phenotype <= high)).all()


def test_a_body_on_another_triangulation_is_the_one_drawn_on_it(model, coarse):
    other = Triangulation.decimated(model.reference, 700, grading=1.0)
    body = retriangulated(model, other, draw_body(model, coarse, SETTINGS, 4))
    drawn = draw_body(model, other, SETTINGS, 4)
    assert body.number == 4
    assert (body.faces == other.faces).all()
    assert_close(body.rest, drawn.rest, rtol=0, atol=1e-6)
    assert_close(body.posed, drawn.posed, rtol=0, atol=1e-6)


def test_a_body_is_what_its_parameters_say(model, coarse):
    body = draw_body(model, coarse, SETTINGS, 2)
    for vertices, poses in ((body.posed, body.poses), (body.rest[None], pose())):
        expected = coarse.deformed(model.vertices(body.phenotype, poses))
        assert_close(vertices, expected, rtol=0, atol=1e-5)


def test_rest_and_poses_are_screened(model, coarse, monkeypatch):
    """Every other one counts as bad: twice as many are drawn, and the good ones are kept."""
    seen = []

    def alternately(vertices):
        seen.append(vertices)
        return 0.0 if len(seen) % 2 == 0 else 0.001

    monkeypatch.setattr(model, "intersecting", alternately)
    body = draw_body(model, coarse, SETTINGS, 0)
    assert len(seen) == 8
    rest, *posed = coarse.deformed(torch.stack(seen[1::2]).double()).float()
    assert_close(body.rest, rest, rtol=0, atol=1e-6)
    assert_close(body.posed, torch.stack(posed), rtol=0, atol=1e-6)
    assert (seen[0] - seen[1]).abs().max() > 0.01  # another identity


def test_maps_on_other_triangulations_are_compared_at_the_same_points(model, coarse):
    """A network of constant matrices, whose map is the same linear one on every triangulation."""
    body = draw_body(model, coarse, SETTINGS, 1)
    network = NeuralJacobianField(6, 6, code_size=8, parameters=POSE_SIZE)
    matrix = torch.eye(3) + 0.3 * torch.randn(3, 3)
    with torch.no_grad():
        network.field.layers[-1].bias.copy_((matrix - torch.eye(3)).flatten())
    finer = Triangulation.decimated(model.reference, 3000)
    found = compare_triangulations(
        network,
        Inputs(n_points=8, n_energies=0),
        body_model=model,
        trained_on=coarse,
        others={"itself": coarse, "original": Triangulation.original(model.reference), "n": finer},
        bodies=[body],
    )
    assert found["itself"].deviation < 1e-6
    assert found["original"].deviation < 1e-4  # the points are vertices' convex combinations
    apart = body.rest @ matrix.T - body.posed
    apart -= apart.mean(1, keepdim=True)
    error = float(apart.norm(dim=-1).mean())
    for deviation in found.values():
        assert deviation.error == pytest.approx(error, rel=0.02)
        assert deviation.share == pytest.approx(deviation.deviation / error, rel=1e-3)
    # Points between the chords of the finer mesh miss the surface a little.
    assert 1e-5 < found["n"].deviation < 5e-3
    assert found["n"].n_faces == 3000
    # An affine map is as exact as a map can be; those of poses miss the surface about as much.
    assert found["itself"].exact < 1e-6
    assert found["original"].exact < 1e-4
    assert 1e-5 < found["n"].exact < 5e-3


def test_the_shipped_weights_re_pose_bodies_of_any_triangulation(model, coarse):
    """New ones, which neither training nor its test split has; the identity map errs by 18."""
    finer = Triangulation.decimated(model.reference, 5000, grading=1.0)
    body = draw_body(model, coarse, BodySettings(seed=1000, n_poses=4), 0)
    for triangulation in (coarse, finer):
        on = retriangulated(model, triangulation, body)
        mesh = dp.Mesh(on.rest.double(), on.faces)
        phi = load_pretrained("repose").repose(mesh, on.poses)
        assert l2_vertices(phi, on.posed.double()).max() < 1.5
        # From one of the poses to the others.
        mesh = dp.Mesh(on.posed[0].double(), on.faces)
        phi = load_pretrained("repose-any").repose(mesh, on.poses[1:])
        assert l2_vertices(phi, on.posed[1:].double()).max() < 4


# -------------------------------------------------------------------- files


def test_a_store_grows_and_keeps_what_it_has(tmp_path, monkeypatch):
    first = build_bodies(tmp_path, 2, 400, SETTINGS, progress=False)
    times = [path.stat().st_mtime_ns for path in first.paths]
    more = build_bodies(tmp_path, 3, 400, SETTINGS, progress=False)
    assert [path.stat().st_mtime_ns for path in more.paths[:2]] == times
    assert len(more) == len(BodyStore(tmp_path)) == 3
    assert len(build_bodies(tmp_path, 2, 400, SETTINGS, progress=False)) == 2
    assert more[2].number == 2
    body = more[1]
    assert body.faces.shape == (400, 3)
    assert body.faces.dtype == torch.int64
    assert body.posed.shape == (3, len(body.rest), 3)
    with pytest.raises(StoreError, match="other settings; use another folder"):
        build_bodies(tmp_path, 3, 300, SETTINGS, progress=False)

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert len(build_bodies(tmp_path, 3, 400, SETTINGS, progress=False)) == 3  # nothing to make
    with pytest.raises(ModuleNotFoundError, match=r'pip install "diffpoisson\[bodies\]"'):
        build_bodies(tmp_path, 4, 400, SETTINGS, progress=False)

    os.truncate(more.paths[0], 1000)
    with pytest.raises(StoreError, match="delete it and build the bodies again"):
        BodyStore(tmp_path)[0]


def test_a_store_gives_back_what_was_drawn(tmp_path, model, coarse):
    stored = build_bodies(tmp_path, 1, 400, SETTINGS, progress=False)[0]
    drawn = draw_body(model, coarse, SETTINGS, 0)
    for name in ("phenotype", "faces", "rest", "poses", "posed"):
        assert np.array_equal(getattr(stored, name), getattr(drawn, name))


def test_an_empty_folder_raises(tmp_path):
    with pytest.raises(StoreError, match="holds no bodies"):
        BodyStore(tmp_path)
    assert bodies.POSE_SIZE == 60


def test_seen_poses_are_those_of_their_bodies_and_kept(model, tmp_path, monkeypatch):
    monkeypatch.setattr(seen_poses, "PER_FILE", 16)
    arguments = {"n_basis": 8, "n_faces": 400, "seed": 5, "progress": False}
    seen = build_seen_poses(tmp_path, 2, **arguments)
    assert seen.features.shape == (32, 4, 8)
    rng = np.random.default_rng([5, 1])  # of the second file
    phenotype = torch.tensor([rng.uniform(*limits) for limits in PHENOTYPES.values()])
    poses = [torch.from_numpy(sample_pose(rng)).float().flatten() for _ in range(8)]
    assert_close(seen.poses[16:24], torch.stack(poses))
    triangulation = Triangulation.decimated(model.reference, 400)
    vertices = triangulation.deformed(model.vertices(phenotype, poses[3][None]).double())[0]
    expected = basis_features(dp.Mesh(vertices, triangulation.faces), 8)
    assert_close(seen.features[19].double(), expected, rtol=1e-3, atol=1e-3)
    assert len(seen.poses.unique(dim=0)) == 32
    # What is there is kept, and more can be added.
    monkeypatch.setattr(seen_poses, "BodyModel", None)
    again = build_seen_poses(tmp_path, 2, **arguments)
    assert torch.equal(again.features, seen.features)
    assert torch.equal(build_seen_poses(tmp_path, 1, **arguments).poses, seen.poses[:16])
    with pytest.raises(TypeError, match="not callable"):
        build_seen_poses(tmp_path, 3, **arguments)
    with pytest.raises(StoreError, match="pairs of other settings"):
        build_seen_poses(tmp_path, 2, **(arguments | {"n_basis": 10}))


def test_a_data_set_on_another_triangulation_has_the_same_bodies(model, tmp_path, monkeypatch):
    some = build_bodies(tmp_path / "some", 2, 400, SETTINGS, progress=False)
    other = build_retriangulated(tmp_path / "other", some, 600, grading=-1.0, progress=False)
    triangulation = Triangulation.decimated(model.reference, 600, -1.0)
    for body, elsewhere in zip(some, other, strict=True):
        assert torch.equal(elsewhere.faces, triangulation.faces)
        expected = triangulation.deformed(model.vertices(body.phenotype, body.poses).double())
        assert_close(elsewhere.posed.double(), expected, rtol=1e-6, atol=1e-6)
        assert torch.equal(body.poses, elsewhere.poses)
        assert body.number == elsewhere.number
    monkeypatch.setattr(bodies, "BodyModel", None)  # all there
    again = build_retriangulated(tmp_path / "other", some, 600, grading=-1.0, progress=False)
    assert torch.equal(again[1].posed, other[1].posed)
    with pytest.raises(StoreError, match="bodies of other settings"):
        build_retriangulated(tmp_path / "other", some, 600, grading=0.0, progress=False)
