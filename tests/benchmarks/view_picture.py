"""The picture of `njf view` in the docs: a bone from `dm_control` bent by three handles.

`python -m tests.benchmarks.view_picture` writes `docs/images/view.png`. It needs the extras
examples, view and browser, and a Chromium on the path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import diffpoisson as dp
from njf_models.datasets.sources import DogBones
from njf_models.viewer import Viewer
from tests.benchmarks.page_picture import BONE
from tests.benchmarks.window_picture import photographed

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "view.png"


def ends(vertices: torch.Tensor) -> list[int]:
    """A vertex at the lower end along the longest axis, in the middle, and at the upper end."""
    centred = vertices - vertices.mean(0)
    along = centred @ torch.linalg.svd(centred, full_matrices=False)[2][0]
    return [int(along.argmin()), int(along.abs().argmin()), int(along.argmax())]


def main() -> None:
    bone = next(bone for bone in DogBones(n_faces=1) if bone.name == BONE)
    mesh = dp.Mesh.cleaned(bone.vertices, bone.faces, merge_duplicates=True).mesh
    window = Viewer(mesh, "pelvis.ply")
    with photographed(window, PICTURE, height=700):
        names = [window.add_handle(vertex) for vertex in ends(mesh.vertices)]
        size = window.pose.diagonal
        for name, up, angle in zip(names, (0.25, 0.0, 0.25), (-0.6, 0.0, 0.6), strict=True):
            x, y, z, w = Rotation.from_rotvec([0, 0, angle]).as_quat()
            place = window.pose.handles[name].centre.numpy() + np.array([0, up * size, 0])
            window.move_handle(name, place, np.array([w, x, y, z]))


if __name__ == "__main__":
    main()
