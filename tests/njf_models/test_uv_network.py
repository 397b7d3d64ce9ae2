"""A UV network maps disks in any pose and unit, survives saving, and starts `parameterize`."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from safetensors.torch import save_file
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import parameterize
from njf_models.pretrained import load_pretrained
from njf_models.trained import Inputs
from njf_models.uv_network import UVNetwork
from tests import meshes
from tests.njf_models.shapes import bumpy_disk

ARGUMENTS = {
    "face_features": 6,
    "point_features": 6,
    "code_size": 16,
    "output_dim": 2,
    "rounds": 2,
    "width": 16,
}
DIFFUSING = {
    "features": 6, "encoded": 4, "net_width": 8, "n_blocks": 1,
    "output_dim": 2, "rounds": 2, "width": 16,
}  # fmt: skip


NETWORKS = {
    "njf": lambda: UVNetwork(ARGUMENTS, Inputs(n_points=64)),
    "diffusion+njf": lambda: UVNetwork(
        DIFFUSING, Inputs(n_points=1, n_eigenpairs=10), "diffusion+njf"
    ),
}


@pytest.fixture(scope="module", params=NETWORKS)
def network(request) -> UVNetwork:
    """Random weights, small enough that the map is not all flips."""
    network = NETWORKS[request.param]()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in network.model.parameters():
            parameter.normal_(std=0.1, generator=generator)
    return network


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_pose_and_unit_do_not_count(network, scale):
    mesh = bumpy_disk(1)
    turn = meshes.rotation(np.random.default_rng(3), mesh.vertices.numpy())
    moved = dp.Mesh(scale * (mesh.vertices.numpy() @ turn.T + [3.0, -2.0, 1.0]), mesh.faces)
    expected = network.predict(mesh)
    assert expected.shape == (mesh.n_vertices, 2)
    # The network works in float32; the pose is determined to some digits fewer than float64's.
    assert_close(network.predict(moved), scale * expected, rtol=1e-3, atol=1e-4 * scale)


def test_a_batch_is_each_alone(network):
    disks = [bumpy_disk(seed, size) for seed, size in ((0, 5), (1, 7), (2, 6))]
    for mesh, uv in zip(disks, network.predict_all(disks), strict=True):
        assert_close(uv, network.predict(mesh), rtol=1e-4, atol=1e-5)


def test_dtype_is_that_of_the_mesh(network):
    assert network.predict(bumpy_disk(0).to(torch.float32)).dtype == torch.float32
    assert network.predict(bumpy_disk(0)).dtype == torch.float64


def test_wave_kernel_signature_is_made_on_demand():
    arguments = ARGUMENTS | {"face_features": 6 + 8, "point_features": 6 + 8}
    network = UVNetwork(arguments, Inputs(n_points=32, n_energies=8))
    disk = network.prepare(bumpy_disk(0, 9))
    assert disk.shape.features.shape[1] == disk.points.shape[1] == 14
    assert disk.shape.features.dtype == torch.float32
    assert network.predict(disk.mesh).isfinite().all()


def test_a_mesh_of_fewer_vertices_than_eigenpairs_has_all_of_its_own():
    network = UVNetwork(DIFFUSING, Inputs(n_points=1, n_eigenpairs=10), "diffusion+njf")
    triangle = dp.Mesh(torch.eye(3, dtype=torch.float64), torch.tensor([[0, 1, 2]]))
    (spectrum,) = network.prepare(triangle).shape.spectra
    assert len(spectrum.values) == 3
    # One triangle is mapped without error: its Jacobian is the prediction's.
    assert network.predict(triangle).isfinite().all()


@pytest.mark.parametrize("make", [meshes.sphere, meshes.annulus, meshes.parts])
def test_other_surfaces_raise_and_name_the_remedy(network, make):
    with pytest.raises(dp.MeshError, match=r"topological disk.*cut=True"):
        network.predict(dp.Mesh(*make(0)))


def test_planar_meshes_and_tetrahedra_raise(network):
    for make in (meshes.planar_disk, meshes.box):
        with pytest.raises(dp.MeshError, match="UVNetwork: flattens surfaces"):
            network.predict(dp.Mesh(*make(0)))


def test_stopped_after_fewer_rounds(network):
    """The map of the first round, and the whole network where nothing is left out."""
    mesh = bumpy_disk(2)
    disk = network.prepare(mesh)
    code = network.model.encode(disk.points[None])
    first, last = network.model.iterates(disk.shape, code)
    for rounds, iterate in ((1, first), (2, last)):
        uv = network.with_rounds(rounds).predict(mesh)
        assert_close(uv, disk.scale * iterate.vertices[0].detach().double())
    assert not torch.allclose(first.vertices, last.vertices, rtol=1e-2)
    for rounds in (0, 3):
        with pytest.raises(ValueError, match=f"1 to 2 rounds of separate weights, got {rounds}"):
            network.with_rounds(rounds)


def test_saved_and_loaded(network, tmp_path):
    network.save(tmp_path / "uv.safetensors")
    loaded = UVNetwork.load(tmp_path / "uv.safetensors")
    mesh = bumpy_disk(0)
    assert torch.equal(loaded.predict(mesh), network.predict(mesh))
    for name in ("arguments", "inputs", "kind"):
        assert getattr(loaded, name) == getattr(network, name)
    assert not loaded.model.training


def test_files_of_other_things_raise(tmp_path):
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="holds no UVNetwork"):
        UVNetwork.load(tmp_path / "other.safetensors")


def test_unknown_weights_raise():
    with pytest.raises(ValueError, match="no weights 'u'"):
        load_pretrained("u")


@pytest.mark.parametrize("make", [meshes.disk, meshes.sphere, meshes.torus])
def test_parameterize_from_a_network_certifies(network, make):
    mesh = dp.Mesh(*make(0))
    uvmap = parameterize(mesh, model=network, cut=True, tolerance=1e-3)
    assert uvmap.certified
    assert uvmap.flipped == 0
    triangles = uvmap.uv[uvmap.mesh.faces]
    assert (torch.linalg.det(triangles[:, 1:] - triangles[:, :1]) > 0).all()


def cube() -> dp.Mesh:
    """Closed, and so symmetric that its area vectors cancel exactly."""
    box = trimesh.creation.box().subdivide().subdivide()
    return dp.Mesh.cleaned(np.array(box.vertices), np.array(box.faces)).mesh


@pytest.mark.parametrize("closed", [cube(), dp.Mesh(*meshes.sphere(0)), dp.Mesh(*meshes.torus(0))])
@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_closed_surfaces_cut_open_start_from_tutte(network, closed, scale):
    """They have no pose; where rounding leaves something of a mean normal, that is none either."""
    mesh = dp.Mesh(scale * (closed.vertices + 0.1), closed.faces)
    uvmap = parameterize(mesh, model=network, cut=True, tolerance=1e-3)
    assert uvmap.certified
    assert uvmap.method.startswith("tutte")
    with pytest.raises(dp.MeshError, match="no pose"):
        network.predict(uvmap.mesh)
    assert network.start(bumpy_disk(0)) is not None
