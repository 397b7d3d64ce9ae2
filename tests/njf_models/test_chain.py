"""Networks one after another: the map is the composition, on one factor, however it is made."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from diffpoisson.gradient import gradient_operator
from njf_models import NeuralJacobianField
from njf_models.body_maps import BodyMaps, Task, evaluate_maps
from njf_models.carried import carry
from njf_models.chain import ChainedNJF
from njf_models.datasets.bodies import POSE_SIZE
from njf_models.features import Shape, face_features, point_features
from njf_models.sampled import Cells
from njf_models.trained import Inputs, TrainedNetwork
from tests.njf_models.shapes import ellipsoid, randomised
from tests.njf_models.test_body_maps import twisted

FIRST = {"face_features": 6, "point_features": 6, "code_size": 8, "width": 16}
LAST = {**FIRST, "parameters": POSE_SIZE, "rotations": True, "parts": 8, "code_scale": 0.1}


def networks():
    """Far from the identity, each another."""
    links = [NeuralJacobianField(**FIRST), NeuralJacobianField(**FIRST)]
    links.append(NeuralJacobianField(**LAST))
    return [randomised(link, seed).float().eval() for seed, link in enumerate(links)]


@pytest.fixture(name="bodies")
def a_few():
    return [twisted(number) for number in range(3)]


@torch.no_grad()
def test_a_map_is_of_products_of_matrices_each_read_off_the_map_before():
    """Written out, with a dense solve for every step."""
    links, mesh = networks(), ellipsoid()
    poses = torch.randn(4, POSE_SIZE)
    chain = ChainedNJF.of(links, 40)
    prediction = chain(Shape.prepare(mesh), chain.encode(torch.zeros(1, 40, 6), None, poses))
    samples = dp.sample_surface(mesh, 40, generator=torch.Generator().manual_seed(0))
    gradient = torch.from_numpy(gradient_operator(mesh).matrix.toarray())
    A = mesh.areas.repeat(2)[:, None]
    x, J = mesh.vertices, mesh.frames
    for link in links:
        at = mesh.with_vertices(x)
        told = poses if link is links[-1] else None
        code = link.encode(point_features(at, samples).float()[None], None, told)
        P = link.matrices(face_features(at).float(), code).double()
        R = P @ J  # (maps, faces, 3, 2)
        columns = R.permute(3, 1, 0, 2).flatten(0, 1).flatten(1)
        phi = torch.linalg.lstsq(A.sqrt() * gradient, A.sqrt() * columns, driver="gelsd").solution
        phi = phi.unflatten(-1, (-1, 3)).transpose(0, 1)
        weights = mesh.vertex_areas / mesh.areas.sum()
        phi = phi - (weights @ phi)[:, None]
        x, J = phi[0], dp.jacobians(mesh, phi[0])
    assert (phi[0] - phi[1]).abs().max() > 0.01
    assert_close(prediction.vertices.double(), phi, rtol=1e-3, atol=1e-4)
    assert_close(prediction.jacobians.double(), R, rtol=1e-3, atol=1e-4)


def test_networks_that_do_nothing_leave_the_last_ones_map():
    links, mesh = [NeuralJacobianField(**FIRST).eval(), networks()[-1]], ellipsoid()
    chain, shape, poses = ChainedNJF.of(links, 30), Shape.prepare(mesh), torch.randn(2, POSE_SIZE)
    samples = dp.sample_surface(mesh, 30, generator=torch.Generator().manual_seed(0))
    points = point_features(mesh, samples).float()
    alone = links[-1](shape, links[-1].encode(points[None], None, poses))
    both = chain(shape, chain.encode(None, None, poses))
    assert_close(both.vertices, alone.vertices, rtol=1e-4, atol=1e-4)


def test_carried_bodies_start_where_the_chain_is(tmp_path, bodies):
    """The last network on a carried body has the features and points of the chain's last one."""
    links = networks()
    arguments = {"n_sources": 2, "n_points": 30, "progress": False}
    carried = carry(bodies, links[:2], tmp_path, **arguments)
    assert [len(body.carried) for body in carried] == [2] * 3
    chain = ChainedNJF.of(links, 30)
    for body, before in zip(carried, bodies, strict=True):
        assert body.posed is before.posed
        for pose in range(2):
            start = chain.start(Shape.prepare(dp.Mesh(before.posed[pose].double(), before.faces)))
            assert_close(body.carried[pose], start.vertices.float())
    maps = BodyMaps(carried, Task(sources=2), n_points=30, n_energies=0)
    assert_close(maps.source(3).mesh.vertices.float(), carried[1].carried[1])
    assert_close(maps.surfaces([3]).vertices[0], carried[1].carried[1])
    times = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert len(times) == 3
    carry(bodies, links[:2], tmp_path, **arguments)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times
    other = carry(bodies, links[:1], tmp_path, **arguments)  # other networks: other files
    assert (other[0].carried - carried[0].carried).abs().max() > 1e-3


def test_chains_are_evaluated_and_kept_as_other_models_are(tmp_path, bodies):
    links = networks()
    chain = ChainedNJF.of(links, 30)
    maps = BodyMaps(bodies, Task(sources=1), n_points=30, n_energies=0)
    records, emitted = evaluate_maps(chain, maps)
    assert len(records) == 3 * 4
    network = TrainedNetwork({"links": [FIRST, FIRST, LAST], "n_points": 30}, Inputs(30), "chain")
    network.holds = TrainedNetwork.holds = "test"
    network.model.load_state_dict(chain.state_dict())
    network.save(tmp_path / "chain.safetensors")
    again = TrainedNetwork.load(tmp_path / "chain.safetensors").model
    assert_close(evaluate_maps(again, maps)[1], emitted)
    unposing = ChainedNJF.of(links[:2], 30)
    rest = BodyMaps(bodies, Task(sources=2, told="nothing"), n_points=30, n_energies=0)
    records, _ = evaluate_maps(unposing, rest)
    assert [(record.source, record.pose) for record in records] == [(0, None), (1, None)] * 3


def test_what_is_no_chain_raises():
    with pytest.raises(ValueError, match="of one round each"):
        ChainedNJF.of([], 10)
    with pytest.raises(ValueError, match="of one round each"):
        ChainedNJF.of([NeuralJacobianField(**FIRST, rounds=2)], 10)
    chain = ChainedNJF.of(networks(), 10)
    cells = Cells(torch.zeros(1, 1, 6), torch.zeros(1, 1, 1, 3, 2), torch.zeros(1, 1, 6))
    with pytest.raises(ValueError, match="on whole shapes"):
        chain.at(cells, torch.zeros(1, 1, POSE_SIZE))
