"""The picture of `njf repose --view` in the docs: a body of the body model in a random pose.

`python -m tests.benchmarks.repose_picture` writes `docs/images/repose_view.png`. It needs the
extras bodies, view and browser, and a Chromium on the path.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import diffpoisson as dp
from njf_models.datasets.bodies import BodyModel
from njf_models.datasets.poses import sample_pose
from njf_models.pretrained import load_pretrained
from njf_models.repose_viewer import ReposeViewer
from tests.benchmarks.window_picture import photographed

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "repose_view.png"


def main() -> None:
    reference = BodyModel().reference
    mesh = dp.Mesh(reference.vertices, reference.faces)
    window = ReposeViewer(load_pretrained("repose"), mesh, title="body.obj")
    with photographed(window, PICTURE, height=800) as page:
        window.show(sample_pose(np.random.default_rng(16)))
        for joint in ("left hip", "left knee"):
            page.get_by_text(joint).click()


if __name__ == "__main__":
    main()
