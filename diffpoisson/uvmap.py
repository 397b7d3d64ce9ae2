"""A valid UV map of a disk, whatever map one starts from: repair, untangle, polish, certify."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import require_tensor
from diffpoisson.certificate import Certificate, certify, orientations
from diffpoisson.mesh import Mesh, require_mesh
from diffpoisson.parameterization import slim, tutte
from diffpoisson.poisson import PoissonSolver
from diffpoisson.repair import clamp_flips, untangle


@dataclass(frozen=True)
class UVMap:
    """A map of a disk to the plane, and what is known of it.

    Attributes:
        uv: (n, 2) the map, in the mesh's units.
        certificate: exact facts and distortion.
        method: the stages it came through, such as "init", "init+clamp" or "tutte", before SLIM.
        slim_iterations: iterations of the final polish.
        milliseconds: time of each stage that ran.
    """

    uv: Float[Tensor, "n 2"]
    certificate: Certificate
    method: str
    slim_iterations: int
    milliseconds: dict[str, float]

    @property
    def flipped(self) -> int:
        """Number of triangles that are not positively oriented: zero."""
        return self.certificate.n_flipped

    @property
    def energy(self) -> float:
        """Area-weighted mean symmetric Dirichlet energy, 4 at an isometry."""
        return self.certificate.energy

    @property
    def certified(self) -> bool:
        """Whether the map is one-to-one for certain."""
        return self.certificate.injective


def parameterize(
    mesh: Mesh,
    init: Float[Tensor, "n 2"] | None = None,
    *,
    solver: PoissonSolver | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
) -> UVMap:
    """A flip-free map of a disk with low isometric distortion.

    An initial map with flips is repaired by clamping its singular values, and if that is not enough
    by untangling. SLIM then descends to a local minimum of the symmetric Dirichlet energy without
    ever flipping a triangle. Where no map is given, nothing mends it, or it ends up overlapping
    itself, Tutte's embedding takes its place.

    Args:
        mesh: a topological disk in space.
        init: (n, 2) a map to start from, in the mesh's units, such as a network's.
        solver: a `PoissonSolver` of this mesh whose factor to use; made if it is needed.
        tolerance: of SLIM, see `slim`.
        max_iterations: of SLIM.

    Raises:
        MeshError: not a disk in space, or too distorted even for Tutte's embedding.
        ValueError: `init` is not (n, 2) and finite.
    """
    require_mesh("parameterize", mesh)
    polish = {"tolerance": tolerance, "max_iterations": max_iterations}
    if init is not None:
        _check(mesh, init)
        repaired = _repaired(mesh, init, solver)
        if not repaired.flips:
            uvmap = _polished(mesh, repaired, polish)
            if uvmap.certified:
                return uvmap
    stages = _Stages(mesh)
    stages.start("tutte", lambda: tutte(mesh))
    from_tutte = _polished(mesh, stages, polish)
    if init is None or repaired.flips or from_tutte.certified:
        return from_tutte
    return min(uvmap, from_tutte, key=lambda candidate: candidate.energy)  # both overlap


def _repaired(mesh: Mesh, init: Tensor, solver: PoissonSolver | None) -> _Stages:
    stages = _Stages(mesh)
    stages.start("init", lambda: init.detach().to(mesh.vertices))
    if stages.flips:
        stages.run("clamp", lambda uv: clamp_flips(solver or PoissonSolver(mesh), uv)[0])
    if stages.flips:
        stages.run("untangle", lambda uv: untangle(mesh, uv)[0])
    return stages


def _polished(mesh: Mesh, stages: _Stages, options: dict[str, Any]) -> UVMap:
    """A flip-free map after SLIM, certified."""
    method = "+".join(stages.passed)
    result = stages.timed("slim", lambda: slim(mesh, stages.uv, **options))
    certificate = stages.timed("certify", lambda: certify(mesh, result.uv))
    iterations = len(result.energies) - 1
    return UVMap(result.uv, certificate, method, iterations, stages.milliseconds)


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
    require_tensor("parameterize", "init", init, mesh.device)
    if init.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"parameterize: expected init of shape (n={mesh.n_vertices}, 2), "
            f"got {tuple(init.shape)}"
        )
    if not torch.isfinite(init).all():
        raise ValueError("parameterize: init has entries that are not finite; leave it out")
