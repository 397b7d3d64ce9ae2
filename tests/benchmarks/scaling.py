"""How time and memory grow with the mesh, up to a million vertices."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import TypeVar
from unittest.mock import patch

import torch

import diffpoisson as dp
from diffpoisson import poisson, testing
from tests.benchmarks import limits
from tests.benchmarks.figures import Figure, Spread, Target, exponent
from tests.benchmarks.harness import main

AT_MOST = {"factor": 1.5, "solve": 1.2, "solve's backward": 1.2}  # exponents; of all else 1.05
T = TypeVar("T")


def sizes(quick: bool) -> Iterator[Figure]:
    """Each stage on jittered tori of 62,500 to a million vertices, R and Φ in float64."""
    sides = (16, 20, 24, 28) if quick else (250, 354, 500, 707, 1000)
    limits.reset_peak()
    before = limits.resident()
    stages: dict[str, list[float]] = {}
    for side in sides:
        for name, seconds in stage_seconds(side).items():
            stages.setdefault(name, []).append(seconds)
    peak = (limits.peak() - before) / 1e9
    vertices = [side**2 for side in sides]
    for name, seconds in stages.items():
        times = {f"{n:,}": Spread(s, s, s) for n, s in zip(vertices, seconds, strict=True)}
        title = f"exponent of the time: {name}"
        yield exponent(title, vertices, seconds, AT_MOST.get(name, 1.05), seconds=times)
    yield Figure(
        f"{vertices[-1]:,} vertices: build, factor, solve, backward: peak memory",
        "memory of the machine",
        Spread(peak, peak, peak),
        unit="GB",
        target=Target("≤", 24.0),
        details={"seconds": sum(values[-1] for values in stages.values())},
    )


def stage_seconds(side: int) -> dict[str, float]:
    """Processor seconds of each stage; of the cheap ones, the best of three."""
    vertices, faces = testing.torus(0, side, side)
    seconds: dict[str, float] = {}

    def best(name: str, work: Callable[[], T], tries: int = 3) -> T:
        seconds[name] = math.inf
        for _ in range(tries):
            start = time.process_time()
            result = work()
            seconds[name] = min(seconds[name], time.process_time() - start)
        return result

    def factorised(*arguments: object) -> object:
        return best("factor", lambda: original(*arguments), tries=1)

    mesh = best("mesh", lambda: dp.Mesh(vertices, faces))
    original = poisson._factorised
    with patch.object(poisson, "_factorised", factorised):
        solver = best("operators", lambda: dp.PoissonSolver(mesh), tries=1)
    seconds["operators"] -= seconds["factor"]
    R = torch.randn(mesh.n_faces, 3, 2, dtype=torch.float64, requires_grad=True)
    phi = best("solve", lambda: solver(R))
    upstream = torch.randn_like(phi)
    best(
        "solve's backward",
        lambda: torch.autograd.grad(phi, R, upstream, retain_graph=True),
    )
    uv = phi[:, :2].detach().requires_grad_()
    J = best("gradient", lambda: dp.jacobians(mesh, uv))
    best("gradient's backward", lambda: torch.autograd.grad(J.sum(), uv, retain_graph=True))
    J = J.detach().requires_grad_()
    best("distortion", lambda: torch.autograd.grad(dp.symmetric_dirichlet(J, 0.1).sum(), J))
    return seconds


MEASUREMENTS = {"sizes": sizes}

if __name__ == "__main__":
    main("scaling", MEASUREMENTS)
