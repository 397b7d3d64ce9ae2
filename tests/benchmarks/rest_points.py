"""The basis points that see bodies near rest: vertices of the average body's left half.

`python -m tests.benchmarks.rest_points` writes `njf_models/rest_points.npy`. The body is anny's
(CC0). It is decimated first, which leaves more vertices where there is more to see: at head, hands
and feet. They are in random order, so that the first ones are everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from njf_models.datasets.bodies import BodyModel
from njf_models.datasets.triangulation import Triangulation

PATH = Path(__file__).parents[2] / "njf_models" / "rest_points.npy"
N_FACES = 2500
MARGIN = 1e-3  # metres from the mirror, where a point and its image would be one


def main() -> None:
    reference = BodyModel().reference
    x = Triangulation.decimated(reference, N_FACES).deformed(reference.vertices).numpy()
    x = x - (x.max(0) + x.min(0)) / 2
    left = x[x[:, 0] > MARGIN]
    order = np.random.default_rng(0).permutation(len(left))
    np.save(PATH, left[order].astype(np.float32))
    print(f"{PATH}: {len(left)} points")


if __name__ == "__main__":
    main()
