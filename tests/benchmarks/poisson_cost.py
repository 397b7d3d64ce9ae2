"""What the Poisson layer costs: assembly and factor, a solve, and its backward, over mesh sizes.

`python -m tests.benchmarks.poisson_cost` writes `docs/results/poisson_cost.json`: medians, on one
thread.
"""

from __future__ import annotations

import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import diffpoisson as dp
from diffpoisson import testing

RESULT = Path(__file__).parents[2] / "docs" / "results" / "poisson_cost.json"


def median_seconds(work: Callable[[], object], repeats: int) -> float:
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def cost(subdivisions: int, repeats: int = 7) -> dict[str, float]:
    vertices, faces = testing.sphere(0, subdivisions)
    mesh = dp.Mesh(vertices, faces)
    solver = dp.PoissonSolver(mesh)
    R = torch.randn(mesh.n_faces, 3, 2, dtype=torch.float64, requires_grad=True)
    phi = solver(R)
    upstream = torch.randn_like(phi)
    return {
        "vertices": mesh.n_vertices,
        "mesh_and_factor": median_seconds(
            lambda: dp.PoissonSolver(dp.Mesh(vertices, faces)), min(repeats, 3)
        ),
        "solve": median_seconds(lambda: solver(R.detach()), repeats),
        "solve_and_backward": median_seconds(lambda: solver(R).backward(upstream), repeats),
    }


def main() -> None:
    torch.set_num_threads(1)
    rows = [cost(subdivisions) for subdivisions in (5, 6, 7)]
    result = {"torch": torch.__version__, "machine": platform.machine(), "rows": rows}
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
