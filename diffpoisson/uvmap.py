"""A valid UV map of any surface: cut it into disks, flatten each, pack and certify them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffpoisson.certificate import Certificate, certify
from diffpoisson.chart import flatten_disk
from diffpoisson.mesh import Mesh
from diffpoisson.poisson import PoissonSolver

Init = Float[Tensor, "n 2"] | Callable[[Mesh], Tensor]


@dataclass(frozen=True)
class Chart:
    """One disk of a UV map.

    Attributes:
        faces: (k,) int64 indices of its faces, ascending.
        certificate: exact facts and distortion.
        method: the stages it came through, such as "init", "init+clamp" or "tutte", before SLIM.
        slim_iterations: iterations of the final polish.
        milliseconds: time of each stage that ran.
    """

    faces: Int[Tensor, "k"]
    certificate: Certificate
    method: str
    slim_iterations: int
    milliseconds: dict[str, float]


@dataclass(frozen=True)
class UVMap:
    """A map of a surface to the plane, in one or more charts, and what is known of it.

    Attributes:
        mesh: the surface cut open: the input's faces in their order, seam vertices repeated; the
            input itself where nothing was cut.
        uv: (n', 2) image of each vertex of `mesh`, in the input's units.
        vertex_map: (n',) int64 the input's vertex that each vertex of `mesh` is a copy of.
        charts: the disks, whose faces are all of the mesh's.
    """

    mesh: Mesh
    uv: Float[Tensor, "n 2"]
    vertex_map: Int[Tensor, "n"]
    charts: tuple[Chart, ...]

    @cached_property
    def chart_of_face(self) -> Int[Tensor, "m"]:
        """(m,) int64 index of each face's chart."""
        index = self.mesh.faces.new_empty(self.mesh.n_faces)
        for i, chart in enumerate(self.charts):
            index[chart.faces] = i
        return index

    @property
    def flipped(self) -> int:
        """Number of triangles that are not positively oriented: zero."""
        return sum(chart.certificate.n_flipped for chart in self.charts)

    @property
    def energy(self) -> float:
        """Area-weighted mean symmetric Dirichlet energy, 4 at an isometry."""
        return self._mean([chart.certificate.energy for chart in self.charts])

    @property
    def mean_distortion(self) -> float:
        """Area-weighted mean of max(σ₁, 1/σ₂), 1 at an isometry."""
        return self._mean([chart.certificate.mean_distortion for chart in self.charts])

    @property
    def max_distortion(self) -> float:
        """Largest max(σ₁, 1/σ₂)."""
        return max(chart.certificate.max_distortion for chart in self.charts)

    @property
    def min_determinant(self) -> float:
        """Smallest det J."""
        return min(chart.certificate.min_determinant for chart in self.charts)

    @cached_property
    def certified(self) -> bool:
        """Whether the map is one-to-one for certain: every chart is, and their boxes are apart."""
        return all(chart.certificate.injective for chart in self.charts) and self._boxes_apart()

    @property
    def method(self) -> str:
        """The stages that its charts came through, each way once, the most frequent first."""
        return ", ".join(way for way, _ in Counter(c.method for c in self.charts).most_common())

    @property
    def slim_iterations(self) -> int:
        """Iterations of SLIM, of all charts."""
        return sum(chart.slim_iterations for chart in self.charts)

    @property
    def milliseconds(self) -> dict[str, float]:
        """Time of each stage that ran, summed over the charts."""
        total: dict[str, float] = {}
        for chart in self.charts:
            for stage, time in chart.milliseconds.items():
                total[stage] = total.get(stage, 0.0) + time
        return total

    def _mean(self, values: list[float]) -> float:
        """Mean over the charts, by their areas."""
        areas = [float(self.mesh._double_measures[chart.faces].sum()) for chart in self.charts]
        return float(np.average(values, weights=areas))

    def _boxes_apart(self) -> bool:
        """Whether the charts' bounding boxes are disjoint."""
        corners = [self.uv[self.mesh.faces[chart.faces]].flatten(0, 1) for chart in self.charts]
        low = torch.stack([points.amin(0) for points in corners])
        high = torch.stack([points.amax(0) for points in corners])
        meet = ((low[:, None] <= high) & (low <= high[:, None])).all(-1)
        return int(meet.sum()) == len(self.charts)


def parameterize(
    mesh: Mesh,
    init: Init | None = None,
    *,
    cut: bool = False,
    solver: PoissonSolver | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
) -> UVMap:
    """A flip-free map of a surface to the plane with low isometric distortion.

    An initial map with flips is repaired by clamping its singular values, and if that is not enough
    by untangling. SLIM then descends to a local minimum of the symmetric Dirichlet energy without
    ever flipping a triangle. Where no map is given, nothing mends it, or it ends up overlapping
    itself, Tutte's embedding takes its place.

    Args:
        mesh: a surface in space; a topological disk unless `cut`.
        init: a map to start from, in the mesh's units, such as a network's: (n, 2) if the mesh is
            one disk, or a function that is called with the mesh of each chart.
        cut: cut what is not a disk.
        solver: a `PoissonSolver` of this mesh whose factor to use; made if it is needed.
        tolerance: of SLIM, see `slim`.
        max_iterations: of SLIM.

    Raises:
        MeshError: not a disk in space, or too distorted even for Tutte's embedding.
        ValueError: `init` is not (n, 2) and finite.
    """
    if cut:
        raise NotImplementedError("parameterize: cut=True is under way")
    start = init(mesh) if callable(init) else init
    flat = flatten_disk(
        mesh, start, solver=solver, tolerance=tolerance, max_iterations=max_iterations
    )
    chart = Chart(
        torch.arange(mesh.n_faces, device=mesh.device),
        certify(mesh, flat.uv),
        flat.method,
        flat.slim_iterations,
        flat.milliseconds,
    )
    vertex_map = torch.arange(mesh.n_vertices, device=mesh.device)
    return UVMap(mesh, flat.uv, vertex_map, (chart,))
