"""One disk to the plane, whatever map one starts from: repair, untangle, polish."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.certificate import certify, orientations
from diffpoisson.mesh import Mesh
from diffpoisson.parameterization import slim, tutte
from diffpoisson.poisson import PoissonSolver
from diffpoisson.repair import clamp_flips, untangle


class Flattening(NamedTuple):
    """A flip-free map of a disk, and how it came about.

    Attributes:
        uv: (n, 2) the map, in the mesh's units.
        injective: whether the map is one-to-one for certain.
        energy: area-weighted mean symmetric Dirichlet energy.
        method: the stages it came through, such as "init", "init+clamp" or "tutte", before SLIM.
        slim_iterations: iterations of the final polish.
        milliseconds: time of each stage that ran.
    """

    uv: Float[Tensor, "n 2"]
    injective: bool
    energy: float
    method: str
    slim_iterations: int
    milliseconds: dict[str, float]


def flatten_disk(
    mesh: Mesh,
    init: Float[Tensor, "n 2"] | None,
    *,
    solver: PoissonSolver | None,
    tolerance: float,
    max_iterations: int,
) -> Flattening:
    """A flip-free map of a disk with low isometric distortion; arguments as of `parameterize`."""
    polish = {"tolerance": tolerance, "max_iterations": max_iterations}
    if init is not None:
        _check(mesh, init)
        repaired = _repaired(mesh, init, solver)
        if not repaired.flips:
            result = _polished(mesh, repaired, polish)
            if result.injective:
                return result
    stages = _Stages(mesh)
    stages.start("tutte", lambda: tutte(mesh))
    from_tutte = _polished(mesh, stages, polish)
    if init is None or repaired.flips or from_tutte.injective:
        return from_tutte
    return min(result, from_tutte, key=lambda candidate: candidate.energy)  # both overlap


def _repaired(mesh: Mesh, init: Tensor, solver: PoissonSolver | None) -> _Stages:
    stages = _Stages(mesh)
    stages.start("init", lambda: init.detach().to(mesh.vertices))
    if stages.flips:
        stages.run("clamp", lambda uv: clamp_flips(solver or PoissonSolver(mesh), uv)[0])
    if stages.flips:
        stages.run("untangle", lambda uv: untangle(mesh, uv)[0])
    return stages


def _polished(mesh: Mesh, stages: _Stages, options: dict[str, Any]) -> Flattening:
    """A flip-free map after SLIM, checked for overlaps."""
    method = "+".join(stages.passed)
    result = stages.timed("slim", lambda: slim(mesh, stages.uv, **options))
    certificate = stages.timed("certify", lambda: certify(mesh, result.uv))
    return Flattening(
        result.uv,
        certificate.injective,
        certificate.energy,
        method,
        len(result.energies) - 1,
        stages.milliseconds,
    )


class _Stages:
    """The map as it passes through stages, with their names and times."""

    def __init__(self, mesh: Mesh) -> None:
        self._faces = mesh.faces.cpu().numpy()
        self.uv: Tensor = mesh.vertices.new_zeros(0, 2)
        self.passed: list[str] = []
        self.milliseconds: dict[str, float] = {}

    @property
    def flips(self) -> bool:
        """Whether the map has a triangle that is not positively oriented."""
        triangles = self.uv.detach().cpu().double().numpy()[self._faces]
        return bool((orientations(triangles) <= 0).any())

    def start(self, name: str, make: Callable[[], Tensor]) -> None:
        """Begin anew with a map."""
        self.uv, self.passed = self.timed(name, make), [name]

    def run(self, name: str, change: Callable[[Tensor], Tensor]) -> None:
        """Pass the map through one more stage."""
        self.uv = self.timed(name, lambda: change(self.uv))
        self.passed.append(name)

    def timed(self, name: str, work: Callable[[], Any]) -> Any:
        """The result of some work, whose time is kept."""
        start = time.perf_counter()
        result = work()
        self.milliseconds[name] = 1000 * (time.perf_counter() - start)
        return result


def _check(mesh: Mesh, init: Tensor) -> None:
    if init.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"parameterize: expected init of shape (n={mesh.n_vertices}, 2), "
            f"got {tuple(init.shape)}"
        )
    if not torch.isfinite(init).all():
        raise ValueError("parameterize: init has entries that are not finite; leave it out")
