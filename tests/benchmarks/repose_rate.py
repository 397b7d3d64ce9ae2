"""How many maps of a character the shipped network makes in a second, as `njf repose --view` does.

`python -m tests.benchmarks.repose_rate` writes `docs/results/repose_rate.json`: for a body on two
triangulations, the seconds of the preparation and the median of those of a map, of one pose each.
It needs the extra bodies. Seconds are of one processor; drawing in the browser is not in them.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import torch

import diffpoisson as dp
from njf_models.datasets.bodies import BodyModel, BodySettings, draw_body
from njf_models.datasets.poses import sample_pose
from njf_models.datasets.triangulation import Triangulation
from njf_models.pretrained import load_pretrained
from njf_models.repose_network import ReposeNetwork

RESULT = Path(__file__).parents[2] / "docs" / "results" / "repose_rate.json"
MAPS = 100


def measure(network: ReposeNetwork, mesh: dp.Mesh) -> dict[str, float]:
    """Seconds on one mesh."""
    start = time.process_time()
    body = network.prepare(mesh)
    prepared = time.process_time() - start
    seconds = []
    for seed in range(MAPS):
        vectors = sample_pose(np.random.default_rng(seed))
        start = time.process_time()
        network.repose_prepared(body, torch.from_numpy(vectors).reshape(1, -1))
        seconds.append(time.process_time() - start)
    median = float(np.median(seconds))
    return {
        "faces": mesh.n_faces,
        "preparation, s": prepared,
        "a map, ms": 1000 * median,
        "maps per second": 1 / median,
    }


def main() -> None:
    torch.set_num_threads(1)
    model, network = BodyModel(), load_pretrained("repose")
    original = Triangulation.original(model.reference)
    triangulations = [Triangulation.decimated(model.reference, 2500), original]
    rows = []
    for triangulation in triangulations:
        body = draw_body(model, triangulation, BodySettings(seed=5, n_poses=1), 0)
        mesh = dp.Mesh(body.rest.double(), body.faces)
        measure(network, mesh)  # once for nothing
        rows.append(measure(network, mesh))
        print(rows[-1])
    RESULT.write_text(json.dumps({"torch": torch.__version__, "meshes": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
