"""The trained field against the ARAP solver, on the lizard and on refinements of it.

`python -m tests.benchmarks.arap_speed RUN --levels 0 1`, RUN a folder of `examples/arap.py`, writes
`docs/results/arap_speed.json`. Each level cuts every tetrahedron of the one before into eight, and
so each face of the surface into four; the network, trained on the first, maps the others as it is;
what of it depends on the mesh alone is prepared, as the factor is.
Its functions are prepared by as many Poisson solves; a map is then a sum of them.
Times are of one processor. The solver ends where a step moves no vertex by more than a millionth of
the size. "As it comes" it is libigl's; accelerated it is what made the data.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffpoisson as dp
from njf_models.datasets.arap import ArapSettings, ArapSolver, draw_offsets, load_solid
from njf_models.datasets.solids import Solid
from njf_models.elastic_maps import solid_handles
from njf_models.features import Shape
from njf_models.metrics import l2_normals, l2_vertices
from njf_models.modal_njf import ModalNJF
from njf_models.modal_training import load_modal

RESULT = Path(__file__).parents[2] / "docs" / "results" / "arap_speed.json"
TEST = ArapSettings(seed=2)  # as in the example


def measure(solid: Solid, model: ModalNJF, n_maps: int) -> dict[str, Any]:
    """Seconds and errors on one mesh: median over some test maps."""
    start = time.process_time()
    shape = Shape.prepare(dp.Mesh(solid.vertices[solid.surface], solid.faces))
    shape = shape.with_handles(solid_handles(solid, shape.mesh, TEST.reach))
    model = model.on(shape)  # what depends on the mesh alone
    prepared = time.process_time() - start
    rows = [_measure_map(solid, shape, model, number) for number in range(n_maps)]
    median = {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
    return {
        "tetrahedra": len(solid.tetrahedra),
        "faces": len(solid.faces),
        "maps": n_maps,
        "preparation, s": prepared,
        "speed-up": median["solver, s"] / median["network, s"],
        "speed-up over the accelerated": median["accelerated, s"] / median["network, s"],
        **median,
    }


@torch.no_grad()
def _measure_map(solid: Solid, shape: Shape, model: ModalNJF, number: int) -> dict[str, float]:
    offsets = draw_offsets(TEST, number, solid.n_handles)
    row: dict[str, float] = {}
    for name, memory in (("solver", 0), ("accelerated", 6)):
        solver = ArapSolver(solid, memory=memory, tolerance=TEST.tolerance, max_iterations=100_000)
        start = time.process_time()
        found = solver(offsets)
        row[f"{name}, s"] = time.process_time() - start
        row[f"{name}, iterations"] = found.iterations
        if name == "solver":
            target = torch.from_numpy(found.positions[solid.surface])
            row["flipped tetrahedra"] = found.flips
    code = torch.from_numpy(offsets).float().flatten()[None] / TEST.reach
    seconds = []
    for _ in range(5):
        start = time.process_time()
        phi = model(shape, model.encode(parameters=code)).vertices[0].double()
        seconds.append(time.process_time() - start)
    row["network, s"] = float(np.median(seconds))
    row["L2-V"] = float(l2_vertices(phi, target))
    row["L2-N, degrees"] = float(l2_normals(phi, target, shape.mesh.faces))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, help="folder with the solid (RUN/data)")
    parser.add_argument("--levels", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--maps", type=int, default=5, help="on the coarsest; then fewer")
    parser.add_argument("--rounds", type=int, default=5, help="predictions of our field (5)")
    parser.add_argument("--out", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    model = load_modal(options.run / "modal-0" / "model.pt")[0].with_rounds(options.rounds)
    solid = load_solid((options.data or options.run / "data") / "solid.safetensors")
    results = {}
    for level in range(max(options.levels) + 1):
        if level in options.levels:
            results[str(level)] = measure(solid, model, max(1, options.maps - 2 * level))
            print(level, results[str(level)], flush=True)
            options.out.write_text(json.dumps(results, indent=1) + "\n")
        solid = solid.refined()


if __name__ == "__main__":
    main()
