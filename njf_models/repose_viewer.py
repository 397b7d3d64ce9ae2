"""The window of `njf repose --view`: sliders of the joints, and a character that follows them."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import groupby
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.datasets.poses import JOINTS, Freedom, freedoms, sample_pose
from njf_models.repose_network import ReposeNetwork, Stance
from njf_models.window import Window

_NAMES = {
    "root": "whole body",
    "spine05": "spine, low",
    "spine03": "spine, middle",
    "spine01": "spine, high",
    "neck01": "neck",
    "clavicle": "collarbone",
    "upperarm01": "shoulder",
    "lowerarm01": "elbow",
    "upperleg01": "hip",
    "lowerleg01": "knee",
}
_SIDES = {"L": "left ", "R": "right "}


class ReposeViewer(Window):
    """A page on which one turns the joints of a character.

    Everything that does not depend on the pose is prepared once: features, code and factor. A move
    of a slider costs a pass of the network over the triangles and a solve.

    Args:
        network: that re-poses.
        mesh: a character in the rest pose, in its own coordinates.
        stance: how these are related to the network's.
        title: of the page.
        save: what a button does with the posed vertices, in the character's coordinates.
        host: whose browsers may open it; 127.0.0.1 for this machine's.
        port: of the page; another one where it is taken.

    Attributes:
        sliders: one for each angle of `datasets.poses.freedoms`, in degrees.
        vertices: (n, 3) float64, where the character is now, in the network's coordinates.
    """

    def __init__(
        self,
        network: ReposeNetwork,
        mesh: dp.Mesh,
        stance: Stance | None = None,
        *,
        title: str = "character",
        save: Callable[[Float[Tensor, "n 3"]], None] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
    ) -> None:
        self._stance, self._save = stance or Stance(), save
        standing = dp.Mesh(self._stance.standing(mesh.vertices).double(), mesh.faces)
        self._network, self._body = network, network.prepare(standing)
        self.vertices = standing.vertices
        self._rng = np.random.default_rng()
        super().__init__(
            f"njf repose: {title}",
            standing.vertices,
            mesh.faces,
            host,
            port,
            up="+z",
            camera=(0.36, -0.86, 0.12),  # from the front, a little from its left
        )
        self.sliders: list[tuple[Freedom, Any]] = []
        self._add_controls(title)
        self._changed.set()

    @property
    def pose(self) -> Float[Tensor, "joints=20 3"]:
        """The rotation vectors that the sliders stand for, in radians."""
        vectors = np.zeros((len(JOINTS), 3))
        for freedom, slider in self.sliders:
            vectors[JOINTS.index(freedom.joint)] += np.deg2rad(slider.value) * freedom.axis
        return torch.from_numpy(vectors)

    def show(self, pose: Float[np.ndarray, "joints=20 3"]) -> None:
        """Bring the sliders, and with them the character, to a pose in radians."""
        for freedom, slider in self.sliders:
            angle = np.rad2deg(pose[JOINTS.index(freedom.joint)]) @ freedom.axis
            slider.value = float(np.clip(angle, freedom.low, freedom.high))
        self._changed.set()

    def follow(self) -> None:
        """Map the character to the pose of the sliders."""
        start = time.perf_counter()
        self.vertices = self._network.repose_prepared(self._body, self.pose.reshape(1, -1))[0]
        seconds = time.perf_counter() - start
        self._surface.vertices = self.vertices.numpy().astype(np.float32)
        mesh = self._body.shape.mesh
        self._status.content = f"{mesh.n_faces:,} triangles, {1000 * seconds:.0f} ms a map"

    def _add_controls(self, title: str) -> None:
        gui = self._server.gui
        gui.add_markdown(f"**{title}**\n\nAngles of the joints, in degrees.")
        self._status = gui.add_markdown("")
        reset, random = gui.add_button("Rest pose"), gui.add_button("Random pose")
        reset.on_click(lambda _: self.show(np.zeros((len(JOINTS), 3))))
        random.on_click(lambda _: self.show(sample_pose(self._rng)))
        if (save := self._save) is not None:
            saving = gui.add_button("Save")
            saving.on_click(lambda _: save(self._stance.back(self.vertices)))
        for joint, of_joint in groupby(freedoms(), lambda freedom: freedom.joint):
            with gui.add_folder(_title(joint), expand_by_default=False):
                for freedom in of_joint:
                    slider = gui.add_slider(freedom.name, freedom.low, freedom.high, 1.0, 0.0)
                    slider.on_update(lambda _: self._changed.set())
                    self.sliders.append((freedom, slider))


def _title(joint: str) -> str:
    name, _, side = joint.partition(".")
    return _SIDES.get(side, "") + _NAMES.get(name, name)
