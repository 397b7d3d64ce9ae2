"""`njf repose` hands a mesh file and a pose to the network, and its map back."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import pretrained
from njf_models.cli import main
from njf_models.datasets.poses import JOINTS, sample_pose
from njf_models.meshfiles import read_mesh_file
from tests.njf_models.test_body_maps import twisted
from tests.njf_models.test_repose_network import network_of

BODY = twisted(0)


@pytest.fixture(autouse=True)
def network(monkeypatch):
    """A random one: what it was trained on does not matter here."""
    random, other = network_of(), network_of(8)
    networks = {"repose": random, "repose-any": other}
    monkeypatch.setattr(pretrained, "load_pretrained", networks.__getitem__)
    return random


@pytest.fixture
def character(tmp_path):
    return write(tmp_path / "body.obj", BODY.rest.double())


def write(path, vertices):
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (BODY.faces + 1).tolist()]
    path.write_text("\n".join(lines))
    return path


def posed(network, pose):
    mesh = dp.Mesh(BODY.rest.double(), BODY.faces)
    return network.repose(mesh, torch.as_tensor(pose).reshape(1, -1))[0]


def same_surface(path, expected):
    """Vertices may be listed in another order."""
    got = read_mesh_file(path).cleaned().mesh
    triangles = got.vertices[got.faces].sum(1)
    wanted = expected[BODY.faces].sum(1)
    distance = torch.cdist(triangles, wanted)
    assert_close(distance.amin(1), torch.zeros(len(triangles)).double(), rtol=0, atol=1e-5)
    assert (distance.argmin(1).sort().values == torch.arange(len(wanted))).all()


def test_characters_in_any_pose_have_the_network_for_that(character, tmp_path):
    out, other = tmp_path / "posed.obj", network_of(8)
    assert main(["repose", str(character), str(out), "--random", "3", "--any-pose"]) == 0
    pose = sample_pose(np.random.default_rng(3))
    same_surface(out, posed(other, pose))


def test_joints_in_degrees(network, character, tmp_path, capsys):
    out = tmp_path / "out" / "posed.obj"
    turns = ["--joint", "head", "20", "0", "-5", "--joint", "foot.L", "0", "90", "0"]
    assert main(["repose", str(character), str(out), *turns]) == 0
    pose = np.zeros((len(JOINTS), 3))
    pose[JOINTS.index("head")] = np.deg2rad([20, 0, -5])
    pose[JOINTS.index("foot.L")] = np.deg2rad([0, 90, 0])
    same_surface(out, posed(network, pose))
    assert f"{len(BODY.faces)} triangles" in capsys.readouterr().out

    (tmp_path / "pose.json").write_text(json.dumps({"head": [20, 0, -5], "foot.L": [0, 90, 0]}))
    again = tmp_path / "again.obj"
    assert main(["repose", str(character), str(again), "--pose", str(tmp_path / "pose.json")]) == 0
    assert again.read_text() == out.read_text()


def test_a_character_in_other_units_whose_y_is_up(network, tmp_path):
    x, y, z = 100 * BODY.rest.double().T
    path = write(tmp_path / "body.obj", torch.stack([x, z, -y], dim=1))
    height, out = float(z.max() - z.min()) / 100, tmp_path / "posed.obj"
    options = ["--random", "3", "--y-up", "--height", str(height)]
    assert main(["repose", str(path), str(out), *options]) == 0
    expected = posed(network, sample_pose(np.random.default_rng(3)))
    x, y, z = 100 * expected.T
    same_surface_scaled = torch.stack([x, z, -y], dim=1)
    got = read_mesh_file(out).cleaned().mesh.vertices
    assert torch.cdist(got, same_surface_scaled).amin(1).max() < 1e-2


@pytest.mark.parametrize(
    "case",
    [
        (["out.ply", "--random", "1"], 2, "poses are written as .obj"),
        (["out.obj", "--joint", "hat", "1", "2", "3"], 2, "no joint 'hat'; there are root, "),
        (["out.obj", "--joint", "head", "1", "2", "x"], 2, "three numbers, in degrees"),
        (["out.obj", "--random", "1", "--height", "0"], 2, "--height must be positive"),
        (["out.obj", "--pose", "missing.json"], 1, "missing.json: No such file"),
        (["out.obj"], 2, "one of the arguments --pose --joint --random --view is required"),
    ],
)
def test_what_cannot_be_done_is_one_line(case, character, capsys, monkeypatch):
    options, code, message = case
    monkeypatch.chdir(character.parent)
    try:
        got = main(["repose", "body.obj", *options])
    except SystemExit as exit_:  # argparse's own
        got = exit_.code
    assert got == code
    assert message in capsys.readouterr().err.strip().split("\n")[-1]
    assert not (character.parent / "out.obj").exists()


@pytest.mark.parametrize("text", ["{", "[1]", '{"head": [1, 2]}', '{"head": "abc"}'])
def test_a_pose_file_that_is_none(text, character, capsys):
    pose = character.with_name("pose.json")
    pose.write_text(text)
    assert main(["repose", str(character), str(character.with_name("o.obj")), "--pose", str(pose)])
    assert "pose.json: a joint needs three numbers" in capsys.readouterr().err


def test_a_bad_file_is_one_line(tmp_path, capsys):
    assert main(["repose", str(tmp_path / "no.obj"), str(tmp_path / "o.obj"), "--random", "1"]) == 1
    assert "no such file" in capsys.readouterr().err
