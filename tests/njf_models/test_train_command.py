"""`njf data`, then `njf train`, then a network that maps: the whole path by its commands."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
import trimesh

from njf_models.cli import main
from njf_models.datasets.store import UVStore
from njf_models.training import last_checkpoint
from njf_models.uv_network import UVNetwork
from tests import meshes
from tests.njf_models.shapes import bumpy_disk


def moves(network: UVNetwork) -> bool:
    """Whether it maps otherwise than before its training, and finitely."""
    mesh = bumpy_disk(0)
    untrained = UVNetwork(network.arguments, network.inputs, network.kind).predict(mesh)
    return bool(0 < float((network.predict(mesh) - untrained).abs().max()) < np.inf)


def test_data_and_training_by_their_commands(tmp_path, capsys):
    store, out = tmp_path / "store", tmp_path / "run"
    data = [
        "data",
        str(store),
        "--csg",
        "12",
        "--bent",
        "1",
        "--patches",
        "1",
        "--faces",
        "150",
        "300",
    ]
    assert main([*data, "--energies", "0", "--jobs", "1", "--backend", "sequential"]) == 0
    said = capsys.readouterr().out
    patches = UVStore(store)
    assert any("~" in name for name in patches.mesh_name)
    assert f"{len(patches)} patches of {len(patches.sources)} meshes" in said
    assert f"{patches.counts['kept']} kept" in said

    train = ["train", str(store), str(out), "--batch-size", "2", "--points", "32", "--width", "16"]
    assert main([*train, "--code-size", "16", "--rounds", "2", "--steps", "4"]) == 0
    split = json.loads((out / "split.json").read_text())
    families = [set(split[name]) for name in ("train", "validation", "test")]
    assert set.union(*families) == set(patches.family)
    assert sum(map(len, families)) == len(set(patches.family))

    checkpoint = last_checkpoint(out)
    assert checkpoint is not None
    assert torch.load(checkpoint, weights_only=False)["global_step"] == 4  # its very end
    network = UVNetwork.from_checkpoint(checkpoint)
    assert (network.model.rounds, network.inputs.n_points, network.inputs.n_energies) == (2, 32, 0)
    assert moves(network)

    train[2] = str(tmp_path / "diffusing")
    net = ["--encoder", "diffusion", "--eigenpairs", "12", "--net-width", "8", "--net-blocks", "1"]
    assert main([*train, *net, "--rounds", "2", "--steps", "3"]) == 0
    network = UVNetwork.from_checkpoint(last_checkpoint(tmp_path / "diffusing"))
    assert (network.kind, network.inputs.n_eigenpairs) == ("diffusion+njf", 12)
    assert moves(network)

    # Begun with these weights, one step goes hardly anywhere; other networks are refused.
    train[2], begun = str(tmp_path / "begun"), last_checkpoint(tmp_path / "diffusing")
    small = [*train, *net, "--rounds", "2", "--steps", "1", "--rate", "1e-9"]
    network.save(tmp_path / "begun.safetensors")
    for weights in (begun, tmp_path / "begun.safetensors"):
        assert main([*small, "--init", str(weights)]) == 0
        after = UVNetwork.from_checkpoint(last_checkpoint(tmp_path / "begun"))
        for name, value in network.model.state_dict().items():
            torch.testing.assert_close(after.model.state_dict()[name], value, atol=1e-7, rtol=0)
        train[2] = small[2] = str(tmp_path / "again")
    capsys.readouterr()
    small[small.index("--eigenpairs") + 1] = "13"
    small[2] = str(tmp_path / "refused")
    for weights, difference in ((str(begun), "eigenpairs 12, not 13"), ("uv", "net_width 32, not")):
        assert main([*small, "--init", weights]) == 2
        assert f"--init {weights} is of a network with" in (said := capsys.readouterr().err)
        assert difference in said

    # It maps files at once, from either kind of file.
    disk = tmp_path / "disk.ply"
    trimesh.Trimesh(*meshes.disk(0, 12), process=False).export(disk)
    for weights in (begun, tmp_path / "begun.safetensors"):
        written = tmp_path / f"by{weights.suffix}.obj"
        assert main(["uv", str(disk), str(written), "--model", str(weights)]) == 0
        assert "certified" in capsys.readouterr().out
    by = [(tmp_path / f"by{suffix}.obj").read_text() for suffix in (".ckpt", ".safetensors")]
    assert by[0].split("\nv ", 1)[1] == by[1].split("\nv ", 1)[1]


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ("nothing", "there are no weights 'nothing', but repose, repose-any, uv"),
        ("repose", "the weights 'repose' are not for UV maps; use 'uv'"),
        ("none.ckpt", "there is no file none.ckpt"),
    ],
)
def test_other_weights_are_refused_by_name(weights, message, tmp_path, capsys):
    disk = tmp_path / "disk.ply"
    trimesh.Trimesh(*meshes.disk(0, 5), process=False).export(disk)
    assert main(["uv", str(disk), "--model", weights]) == 1
    assert message in capsys.readouterr().err


def test_data_from_a_cluster_by_its_address(tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    small = ["--csg", "2", "--patches", "1", "--faces", "100", "250", "--energies", "0"]
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(processes=False, **options) as cluster:
        where = ["--backend", "dask", "--scheduler", cluster.scheduler_address]
        assert main(["data", str(tmp_path / "there"), *small, *where]) == 0
    assert main(["data", str(tmp_path / "here"), *small, "--backend", "sequential"]) == 0
    there, here = (sorted((tmp_path / n / "shards").iterdir()) for n in ("there", "here"))
    assert [path.read_bytes() for path in there] == [path.read_bytes() for path in here]


def test_unreadable_files_are_listed(tmp_path, capsys):
    trimesh.Trimesh(*meshes.disk(0, 12), process=False).export(tmp_path / "good.ply")
    (tmp_path / "bad.obj").write_text("f 1 2 3")
    options = ["--patches", "1", "--faces", "50", "100", "--backend", "sequential"]
    assert main(["data", str(tmp_path / "out"), "--meshes", str(tmp_path), *options]) == 0
    said = capsys.readouterr()
    assert "1 patches of 1 meshes" in said.out
    (line,) = [line for line in said.err.split("\n") if line.startswith("njf data: ")]
    assert line.startswith(f"njf data: skipped {tmp_path / 'bad.obj'}: MeshFileError: a face uses")


def test_data_without_sources_is_wrong_usage(tmp_path, capsys):
    assert main(["data", str(tmp_path / "store")]) == 2
    assert "pass --meshes FOLDER or --csg N" in capsys.readouterr().err


def test_training_without_a_store_says_so(tmp_path, capsys):
    assert main(["train", str(tmp_path / "none"), str(tmp_path / "run"), "--steps", "1"]) == 1
    assert "no shard in" in capsys.readouterr().err
