"""A disk to the plane, whatever map one starts from: repair, untangle, polish."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from diffpoisson.certificate import count_flips, is_simple
from diffpoisson.mesh import Mesh
from diffpoisson.parameterization import SlimResult, slim, tutte
from diffpoisson.poisson import PoissonSolver
from diffpoisson.repair import clamp_flips, untangle


class Flattening(NamedTuple):
    """A flip-free map of a disk, and how it came about.

    Attributes:
        uv: (n, 2) the map, in the mesh's units.
        energy: its area-weighted mean symmetric Dirichlet energy.
        simple: whether its boundary does not meet itself.
        method: the stages it came through, such as "init", "init+clamp" or "tutte", before SLIM.
        slim_iterations: iterations of the final polish.
        milliseconds: time of each stage that ran.
    """

    uv: Float[Tensor, "n 2"]
    energy: float
    simple: bool
    method: str
    slim_iterations: int
    milliseconds: dict[str, float]


def flatten_disk(
    mesh: Mesh,
    init: Float[Tensor, "n 2"] | None,
    *,
    solver: PoissonSolver | None,
    injective: bool,
    **polish: Any,
) -> Flattening:
    """A flip-free map of a disk with low isometric distortion.

    Args:
        mesh: a disk in space.
        init: (n, 2) finite map to start from.
        solver: of the mesh, made if it is needed.
        injective: where both the initial and Tutte's map end up overlapping themselves, stop SLIM
            before that.
        polish: options of `slim`.
    """
    candidates = []
    if init is not None:
        stages = _Stages(mesh)
        _repair(stages, init, solver)
        if not count_flips(mesh, stages.uv):
            candidates.append(_polished(stages, **polish))
    if not any(candidate.simple for candidate in candidates):
        stages = _Stages(mesh)
        stages.start("tutte", lambda: tutte(mesh))
        candidates.append(_polished(stages, **polish))
    if injective and not any(candidate.simple for candidate in candidates):
        candidates = [_polished(stages, injective=True, **polish)]
    return min(candidates, key=lambda candidate: (not candidate.simple, candidate.energy))


def _repair(stages: _Stages, init: Tensor, solver: PoissonSolver | None) -> None:
    mesh = stages.mesh
    stages.start("init", lambda: init)
    if count_flips(mesh, stages.uv):
        stages.run("clamp", lambda uv: clamp_flips(solver or PoissonSolver(mesh), uv)[0])
    if count_flips(mesh, stages.uv):
        stages.run("untangle", lambda uv: untangle(mesh, uv)[0])


def _polished(stages: _Stages, **options: Any) -> Flattening:
    """The map after SLIM."""
    result: SlimResult = stages.timed("slim", lambda: slim(stages.mesh, stages.uv, **options))
    boundary = result.uv[stages.mesh.boundary_loops[0]]
    return Flattening(
        uv=result.uv,
        energy=result.energies[-1],
        simple=is_simple(boundary.cpu().double().numpy()),
        method="+".join(stages.passed),
        slim_iterations=len(result.energies) - 1,
        milliseconds=stages.milliseconds,
    )


class _Stages:
    """The map as it passes through stages, with their names and times."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.uv: Tensor = mesh.vertices.new_zeros(0, 2)
        self.passed: list[str] = []
        self.milliseconds: dict[str, float] = {}

    def start(self, name: str, make: Callable[[], Tensor]) -> None:
        """Begin with a map."""
        self.uv, self.passed = self.timed(name, make), [name]

    def run(self, name: str, change: Callable[[Tensor], Tensor]) -> None:
        """Pass the map through one more stage."""
        self.uv = self.timed(name, lambda: change(self.uv))
        self.passed.append(name)

    def timed(self, name: str, work: Callable[[], Any]) -> Any:
        """The result of some work, whose time is kept."""
        start = time.perf_counter()
        result = work()
        spent = 1000 * (time.perf_counter() - start)
        self.milliseconds[name] = self.milliseconds.get(name, 0.0) + spent
        return result
