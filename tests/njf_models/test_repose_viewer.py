"""The window of `njf repose --view`: its sliders, the character, and what Chromium shows of it."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models import pretrained
from njf_models.cli import main
from njf_models.datasets.poses import JOINTS, freedoms, sample_pose
from njf_models.meshfiles import read_mesh_file
from njf_models.repose_network import Stance
from tests.njf_models.test_body_maps import twisted
from tests.njf_models.test_repose_command import write
from tests.njf_models.test_repose_network import network_of

repose_viewer = pytest.importorskip(
    "njf_models.repose_viewer", reason="pip install diffpoisson[view]"
)
from tests.njf_models.test_viewer import page, picture, share, soon  # noqa: E402, F401

BODY, NETWORK = twisted(0), network_of()


@pytest.fixture
def window():
    """A character of centimetres, whose y is up."""
    x, y, z = 100 * BODY.rest.double().T
    mesh = dp.Mesh(torch.stack([x, z, -y], dim=1), BODY.faces)
    with repose_viewer.ReposeViewer(
        NETWORK, mesh, Stance(y_up=True, scale=0.01), port=8230
    ) as window:
        yield window


def expected(pose: Any) -> torch.Tensor:
    mesh = dp.Mesh(BODY.rest.double(), BODY.faces)
    return NETWORK.repose(mesh, torch.as_tensor(pose).reshape(1, -1))[0]


def slider(window, joint, name):
    (found,) = (s for f, s in window.sliders if (f.joint, f.name) == (joint, name))
    return found


def test_angles_of_the_joints_span_all_poses_that_are_drawn():
    angles = freedoms()
    for seed in range(200):
        pose, again = np.rad2deg(sample_pose(np.random.default_rng(seed))), np.zeros((20, 3))
        for freedom in angles:
            vector = pose[JOINTS.index(freedom.joint)]
            angle = vector @ freedom.axis
            assert freedom.low - 1e-9 <= angle <= freedom.high + 1e-9
            again[JOINTS.index(freedom.joint)] += angle * freedom.axis
        np.testing.assert_allclose(again, pose, atol=1e-9)
    assert [f.joint for f in angles] == sorted((f.joint for f in angles), key=JOINTS.index)


def test_the_character_follows_the_sliders(window):
    window.follow()
    assert_close(window.vertices, expected(np.zeros((20, 3))), rtol=0, atol=1e-5)
    slider(window, "head", "z").value = 25.0
    slider(window, "lowerarm01.R", "bend").value = 80.0
    pose = np.zeros((20, 3))
    pose[JOINTS.index("head"), 2] = np.deg2rad(25)
    pose[JOINTS.index("lowerarm01.R")] = np.deg2rad(80) * np.array([-1, 0, 1]) / np.sqrt(2)
    assert_close(window.pose, torch.from_numpy(pose))
    window.follow()
    assert_close(window.vertices, expected(pose), rtol=0, atol=1e-5)
    np.testing.assert_allclose(window._surface.vertices, window.vertices, atol=1e-6)
    assert "320 triangles" in window._status.content


def test_a_pose_is_shown_and_the_rest_pose_again(window):
    pose = sample_pose(np.random.default_rng(5))
    window.show(pose)
    assert_close(window.pose, torch.from_numpy(pose), rtol=0, atol=1e-6)
    window.show(np.zeros((20, 3)))
    assert not window.pose.any()


def test_serving_follows_until_it_is_closed(window, capsys):
    thread = threading.Thread(target=window.serve)
    thread.start()
    before = window.vertices
    slider(window, "root", "x").value = 8.0
    assert soon(lambda: float((window.vertices - before).abs().max()) > 1e-3)
    window.close()
    thread.join(timeout=10)
    assert not thread.is_alive()
    assert capsys.readouterr().out == ""


def test_command_serves_until_interrupted_and_its_button_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pretrained, "load_pretrained", {"repose": NETWORK}.__getitem__)
    path, out = write(tmp_path / "body.obj", BODY.rest.double()), tmp_path / "posed.obj"

    def interrupted(self: Any) -> None:
        slider(self, "head", "x").value = -15.0
        self.follow()
        self._save(self._stance.back(self.vertices))
        raise KeyboardInterrupt

    monkeypatch.setattr(repose_viewer.ReposeViewer, "serve", interrupted)
    assert main(["repose", str(path), str(out), "--view", "--port", "8240"]) == 130
    printed = capsys.readouterr()
    assert "body.obj at http://127.0.0.1:" in printed.out
    assert printed.err == "njf repose: interrupted\n"
    pose = np.zeros((20, 3))
    pose[JOINTS.index("head"), 0] = np.deg2rad(-15)
    got = read_mesh_file(out).cleaned().mesh.vertices
    assert torch.cdist(got, expected(pose)).amin(1).max() < 1e-4

    assert main(["repose", str(path), "--random", "1"]) == 2
    assert "OUTPUT is missing" in capsys.readouterr().err


def test_in_chromium(window, page):  # noqa: F811  (a fixture)
    """The character shows, and moves with a slider."""
    thread = threading.Thread(target=window.serve)
    thread.start()
    assert soon(lambda: share(picture(page), "surface") > 0.02)
    assert page.get_by_text("left knee").count() == 1
    before = picture(page)
    page.get_by_role("button", name="Random pose").click()
    assert soon(lambda: bool(window.pose.any()))
    assert soon(lambda: float((np.abs(picture(page) - before).max(-1) > 30).mean()) > 0.01)
    assert page.errors == []
    window.close()
    thread.join(timeout=10)
