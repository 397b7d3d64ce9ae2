"""A disk to the plane, whatever map one starts from: repair, untangle, polish."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Float
from torch import Tensor

from diffpoisson.certificate import count_flips, is_simple
from diffpoisson.distortion import flipped
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh
from diffpoisson.parameterization import SlimResult, harmonic_disk, slim, tutte
from diffpoisson.poisson import PoissonSolver
from diffpoisson.repair import clamp_flips, untangle


class Flattening(NamedTuple):
    """A flip-free map of a disk, and how it came about.

    Attributes:
        uv: (n, 2) the map, in the mesh's units.
        simple: whether its boundary does not meet itself.
        method: the stages it came through, such as "init+clamp" or "tutte", before SLIM; ending in
            "scaffold" where that kept it from overlapping itself.
        slim_iterations: iterations of the final polish.
        milliseconds: time of each stage that ran.
    """

    uv: Float[Tensor, "n 2"]
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
        mesh: a disk in space, in float64.
        init: (n, 2) finite map to start from; Tutte's takes its place if nothing mends it.
        solver: of the mesh, made if it is needed.
        injective: keep the map from overlapping itself.
        polish: options of `slim`.
    """
    stages = _Stages(mesh)
    if init is not None:
        stages.start("init", lambda: init)
        if stages.flips:
            stages.run("clamp", lambda uv: clamp_flips(solver or PoissonSolver(mesh), uv)[0])
        if stages.flips:
            stages.run("untangle", lambda uv: untangle(mesh, uv)[0])
        if not stages.flips:
            # Where it starts with an overlap, SLIM may still undo that.
            flattening = stages.polished(injective=injective and stages.simple, **polish)
            if flattening.simple or not injective:
                return flattening
    stages.start("tutte", lambda: harmonic_disk(mesh))
    if stages.flips:
        # Deep surfaces shrink exponentially in an embedding, which SLIM may not undo; the harmonic
        # map, with the flips out of it, is closer to an isometry, and worth some patience.
        stages.run("untangle", lambda uv: untangle(mesh, uv, max_rounds=100)[0])
        if stages.flips or not stages.simple:
            stages.start("tutte", lambda: tutte(mesh))
    return stages.polished(injective=injective, **polish)


class _Stages:
    """The map as it passes through stages, with their names and times."""

    uv: Tensor

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.passed: list[str] = []
        self.milliseconds: dict[str, float] = {}

    @property
    def flips(self) -> bool:
        """Whether a triangle is not positively oriented, exactly or as SLIM will round it."""
        exactly = count_flips(self.mesh, self.uv) > 0
        return exactly or bool(flipped(jacobians(self.mesh, self.uv)).any())

    @property
    def simple(self) -> bool:
        """Whether the map's boundary does not meet itself."""
        return is_simple(self.uv[self.mesh.boundary_loops[0]].cpu().numpy())

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

    def polished(self, **options: Any) -> Flattening:
        """The map after SLIM."""
        result: SlimResult = self.timed("slim", lambda: slim(self.mesh, self.uv, **options))
        self.uv = result.uv
        if result.scaffolded:
            self.passed.append("scaffold")
        return Flattening(
            uv=self.uv,
            simple=self.simple,
            method="+".join(self.passed),
            slim_iterations=len(result.energies) - 1,
            milliseconds=self.milliseconds,
        )
