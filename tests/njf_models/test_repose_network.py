"""A network that re-poses bodies: the same maps as in evaluation, wherever the body stands."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
import njf_models
from njf_models.body_maps import BodyMaps, Task, evaluate_maps
from njf_models.pretrained import card
from njf_models.repose_network import ReposeNetwork
from njf_models.trained import Inputs
from njf_models.training import NJFTraining, make_trainer
from njf_models.uv_network import UVNetwork
from tests.njf_models.shapes import bumpy_disk, randomised
from tests.njf_models.test_body_maps import MODEL, twisted


def network_of(n_energies=0):
    size = {"face_features": 6 + n_energies, "point_features": 6 + n_energies}
    network = ReposeNetwork(MODEL | size, Inputs(32, n_energies))
    randomised(network.model).float()
    return network


@pytest.mark.parametrize("n_energies", [0, 8])
def test_poses_are_the_maps_of_evaluation_around_the_bodys_centre(n_energies):
    body, network = twisted(0), network_of(n_energies)
    mesh = dp.Mesh(body.rest.double(), body.faces)
    _, [expected] = evaluate_maps(
        network.model, BodyMaps([body], n_points=32, n_energies=n_energies)
    )
    posed = network.repose(mesh, body.poses)
    assert posed.dtype == torch.float64
    areas = mesh.vertex_areas / mesh.vertex_areas.sum()
    centre = areas @ mesh.vertices
    assert_close(posed - centre, expected.double(), rtol=1e-5, atol=1e-5)
    assert_close(areas @ posed, centre.expand(5, 3), rtol=0, atol=1e-6)


def checkpoint(path, model, seed, n_points=32):
    module = NJFTraining(model, steps=1, inputs={"n_points": n_points, "n_energies": 0})
    randomised(module.model, seed).float()
    trainer = make_trainer(path.parent, steps=1)
    trainer.strategy.connect(module)
    trainer.save_checkpoint(path)
    return path


def test_a_chain_re_poses_from_any_pose_and_is_prepared_once(tmp_path):
    """The maps are those of evaluation; files keep them; the way to rest is not gone twice."""
    unposing = {name: MODEL[name] for name in ("face_features", "point_features", "code_size")}
    links = [unposing, unposing, MODEL | {"parts": 8, "rotations": True}]
    paths = [checkpoint(tmp_path / f"{i}.ckpt", model, i) for i, model in enumerate(links)]
    network = ReposeNetwork.chained(paths)
    body = twisted(0)
    mesh = dp.Mesh(body.posed[1].double(), body.faces)
    posed = network.repose(mesh, body.poses)
    _, [_, expected] = evaluate_maps(network.model, BodyMaps([body], Task(sources=2), n_points=32))
    centre = mesh.vertex_areas @ mesh.vertices / mesh.areas.sum()
    others = [0, 2, 3, 4]
    assert_close(posed[others] - centre, expected.double(), rtol=1e-5, atol=1e-5)
    network.save(tmp_path / "chain.safetensors")
    loaded = ReposeNetwork.load(tmp_path / "chain.safetensors")
    assert torch.equal(loaded.repose(mesh, body.poses), posed)
    prepared = network.prepare(mesh)
    for link in network.model.links[:-1]:
        link.register_forward_pre_hook(lambda *_: pytest.fail("went to rest again"))
        link.field.register_forward_pre_hook(lambda *_: pytest.fail("went to rest again"))
    assert_close(network.repose_prepared(prepared, body.poses), posed)
    odd = checkpoint(tmp_path / "odd.ckpt", MODEL, 0, n_points=16)
    with pytest.raises(ValueError, match="differ"):
        ReposeNetwork.chained([paths[0], odd])


def test_where_a_body_stands_does_not_matter():
    body, network = twisted(1), network_of()
    shift = torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64)
    here = network.repose(dp.Mesh(body.rest.double(), body.faces), body.poses)
    there = network.repose(dp.Mesh(body.rest.double() + shift, body.faces), body.poses)
    assert_close(there - shift, here, rtol=0, atol=1e-5)


def test_files_keep_all_that_the_maps_depend_on(tmp_path):
    body, network = twisted(2), network_of(8)
    mesh = dp.Mesh(body.rest, body.faces)
    network.save(tmp_path / "repose.safetensors")
    loaded = ReposeNetwork.load(tmp_path / "repose.safetensors")
    assert loaded.inputs == network.inputs
    posed = loaded.repose(mesh, body.poses)
    assert posed.dtype == torch.float32
    assert torch.equal(posed, network.repose(mesh, body.poses))

    uv = UVNetwork({"face_features": 6, "point_features": 6, "output_dim": 2}, Inputs())
    uv.save(tmp_path / "uv.safetensors")
    with pytest.raises(ValueError, match="holds no ReposeNetwork"):
        ReposeNetwork.load(tmp_path / "uv.safetensors")
    with pytest.raises(ValueError, match="holds no UVNetwork"):
        UVNetwork.load(tmp_path / "repose.safetensors")


def test_the_network_of_a_checkpoint(tmp_path):
    path = checkpoint(tmp_path / "a.ckpt", MODEL, 0)
    network = ReposeNetwork.from_checkpoint(path)
    assert network.inputs == Inputs(n_points=32, n_energies=0)
    saved = torch.load(path, weights_only=False)["state_dict"]
    for name, value in network.model.state_dict().items():
        assert torch.equal(value, saved[f"model.{name}"])


@pytest.mark.parametrize(("name", "megabytes"), [("repose", 3), ("repose-any", 18)])
def test_the_shipped_weights_are_those_of_their_card(name, megabytes):
    network, about = njf_models.load_pretrained(name), card(name)
    assert isinstance(network, ReposeNetwork)
    assert about["parameters"] == sum(p.numel() for p in network.model.parameters())
    assert about["bytes"] < 1e6 * megabytes
    with pytest.raises(ValueError, match="not for UV maps"):
        njf_models.parameterize(bumpy_disk(), model="repose")
