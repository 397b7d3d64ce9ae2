"""A valid UV map of any surface: cut it into disks, flatten each, pack and certify them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffpoisson import topology
from diffpoisson.arguments import require_tensor
from diffpoisson.certificate import Certificate, boxes_apart, certify
from diffpoisson.flattening import Flattening, flatten_disk
from diffpoisson.mesh import Mesh, MeshError, require_mesh
from diffpoisson.packing import pack
from diffpoisson.parameterization import describe_topology
from diffpoisson.poisson import PoissonSolver
from diffpoisson.seams import cut_to_disks

T = TypeVar("T")
Init = Float[Tensor, "n 2"] | Callable[[Mesh], Tensor | None]


@dataclass(frozen=True)
class Chart:
    """One disk of a UV map.

    Attributes:
        faces: (k,) int64 indices of its faces, ascending.
        certificate: exact facts and distortion.
        method: the stages it came through, such as "init+clamp" or "tutte", before SLIM; ending in
            "scaffold" where that kept it from overlapping itself.
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
        mesh: the surface cut open: the input's faces in their order, seam vertices repeated after
            all others; the input itself where nothing was cut.
        uv: (n', 2) image of each vertex of `mesh`, in the input's units.
        vertex_map: (n',) int64 the input's vertex that each vertex of `mesh` is a copy of.
        charts: the disks, whose faces are all of the mesh's.
        overhead: milliseconds of what was not done chart by chart: cutting, packing.
    """

    mesh: Mesh
    uv: Float[Tensor, "n 2"]
    vertex_map: Int[Tensor, "n"]
    charts: tuple[Chart, ...]
    overhead: dict[str, float] = field(default_factory=dict)

    @cached_property
    def chart_of_face(self) -> Int[Tensor, "m"]:
        """(m,) int64 index of each face's chart."""
        sizes = torch.tensor([len(chart.faces) for chart in self.charts])
        index = torch.arange(len(sizes)).repeat_interleave(sizes).to(self.mesh.device)
        faces = torch.cat([chart.faces for chart in self.charts])
        return torch.empty_like(faces).scatter_(0, faces, index)

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
        triangles = self.uv[self.mesh.faces].cpu().numpy()
        charts = [triangles[chart.faces.cpu().numpy()] for chart in self.charts]
        low = np.stack([corners.min(axis=(0, 1)) for corners in charts])
        high = np.stack([corners.max(axis=(0, 1)) for corners in charts])
        return all(chart.certificate.injective for chart in self.charts) and boxes_apart(low, high)

    @property
    def method(self) -> str:
        """The stages that its charts came through, the most frequent first."""
        return ", ".join(way for way, _ in Counter(c.method for c in self.charts).most_common())

    @property
    def slim_iterations(self) -> int:
        """Iterations of SLIM, of all charts."""
        return sum(chart.slim_iterations for chart in self.charts)

    @property
    def milliseconds(self) -> dict[str, float]:
        """Time of each stage that ran, summed over the charts."""
        total: Counter[str] = Counter()
        for stages in (self.overhead, *(chart.milliseconds for chart in self.charts)):
            total.update(stages)
        return dict(total)

    def _mean(self, values: list[float]) -> float:
        """Mean over the charts, by their areas."""
        areas = self.mesh._double_measures
        return float(np.average(values, weights=[float(areas[c.faces].sum()) for c in self.charts]))


def parameterize(
    mesh: Mesh,
    init: Init | None = None,
    *,
    cut: bool = False,
    injective: bool = True,
    solver: PoissonSolver | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
) -> UVMap:
    """A flip-free map of a surface to the plane with low isometric distortion.

    Each connected component, cut open if need be, becomes a chart; several charts are packed side
    by side. An initial map with flips is repaired by clamping its singular values, and if that is
    not enough by untangling. SLIM then descends to a local minimum of the symmetric Dirichlet
    energy without ever flipping a triangle. Where no map is given, nothing mends it, or it ends up
    overlapping itself, Tutte's embedding takes its place.

    Args:
        mesh: a surface in space, whose components are topological disks unless `cut`.
        init: a map to start from, in the mesh's units, such as a network's: (n, 2) if the mesh is
            one disk, or a function that is called with the mesh of each chart and returns its map,
            or None to start that one from Tutte's embedding.
        cut: cut the surface where topology or low distortion ask for it, see `cut_to_disks`.
        injective: keep charts from overlapping themselves, see `slim`. If false, SLIM's minimum is
            returned, whose distortion is a little lower and which may not be certified.
        solver: a `PoissonSolver` of this mesh whose factor to use, where the mesh is the one chart.
        tolerance: of SLIM, see `slim`.
        max_iterations: of SLIM.

    Raises:
        MeshError: not a surface in space; components that are not disks, unless `cut`; a component
            too distorted for Tutte's embedding; or rounding to the mesh's dtype flips triangles.
        ValueError: an initial map is not (n, 2) and finite, or is given for more than one disk.
    """
    _require_surface(mesh)
    overhead: dict[str, float] = {}
    surface, vertex_map = mesh, torch.arange(mesh.n_vertices, device=mesh.device)
    if cut:
        surface, vertex_map = _timed(overhead, "cut", lambda: cut_to_disks(mesh))
    parts = _parts(surface)
    _require_disks(parts)
    starts = _starts(mesh, vertex_map, parts, init)
    flats = [
        flatten_disk(
            part.mesh if mesh.dtype == torch.float64 else part.mesh.to(torch.float64),
            start,
            solver=solver if part.mesh is mesh else None,
            injective=injective,
            tolerance=tolerance,
            max_iterations=max_iterations,
        )
        for part, start in zip(parts, starts, strict=True)
    ]
    uv = _timed(overhead, "pack", lambda: _packed(surface, parts, flats))
    charts = [_chart(part, flat, uv) for part, flat in zip(parts, flats, strict=True)]
    uvmap = UVMap(surface, uv, vertex_map, tuple(charts), overhead)
    _require_flip_free(uvmap)
    return uvmap


class _Part(NamedTuple):
    """A connected component: its mesh, and its faces and vertices on the surface."""

    mesh: Mesh
    faces: Int[Tensor, "k"]
    vertices: Int[Tensor, "n"]


def _parts(surface: Mesh) -> list[_Part]:
    """The components, in the order of their first vertices; the surface itself if it is one."""
    device = surface.device
    if surface.n_components == 1:
        counts = surface.n_faces, surface.n_vertices
        return [_Part(surface, *(torch.arange(count, device=device) for count in counts))]
    parts = []
    for part in topology.connected_parts(surface.faces.cpu().numpy(), surface.n_vertices):
        cells, vertices, faces = (torch.from_numpy(a).to(device) for a in part)
        parts.append(_Part(Mesh(surface.vertices[vertices], faces), cells, vertices))
    return parts


def _starts(
    mesh: Mesh, vertex_map: Tensor, parts: list[_Part], init: Init | None
) -> list[Tensor | None]:
    """The initial map of each part in float64, or None."""
    if init is None:
        return [None] * len(parts)
    if callable(init):
        made = [init(part.mesh) for part in parts]
        return [
            None if uv is None else _checked(part.mesh, uv)
            for part, uv in zip(parts, made, strict=True)
        ]
    if not mesh.is_disk:
        raise ValueError(
            "parameterize: init belongs to a mesh that is one disk; for other meshes pass a "
            "function that maps a chart's mesh"
        )
    return [_checked(mesh, init)[vertex_map]]


def _checked(mesh: Mesh, init: Tensor) -> Tensor:
    require_tensor("parameterize", "init", init, mesh.device)
    if init.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"parameterize: expected init of shape (n={mesh.n_vertices}, 2), "
            f"got {tuple(init.shape)}"
        )
    if not torch.isfinite(init).all():
        raise ValueError("parameterize: init has entries that are not finite; leave it out")
    return init.detach().double()


def _packed(surface: Mesh, parts: list[_Part], flats: list[Flattening]) -> Float[Tensor, "n 2"]:
    """The maps of the parts, side by side if there are several, in the surface's dtype."""
    maps = [flat.uv for flat in flats]
    if len(maps) > 1:
        maps = [
            torch.from_numpy(uv).to(flats[0].uv) for uv in pack([m.cpu().numpy() for m in maps])
        ]
    uv = surface.vertices.new_empty(surface.n_vertices, 2)
    uv[torch.cat([part.vertices for part in parts])] = torch.cat(maps).to(uv)
    return uv


def _chart(part: _Part, flat: Flattening, uv: Float[Tensor, "n 2"]) -> Chart:
    milliseconds = dict(flat.milliseconds)
    certificate = _timed(milliseconds, "certify", lambda: certify(part.mesh, uv[part.vertices]))
    return Chart(part.faces, certificate, flat.method, flat.slim_iterations, milliseconds)


# -------------------------------------------------------------------- what is refused


def _require_surface(mesh: Mesh) -> None:
    require_mesh("parameterize", mesh)
    if (mesh.cell_dim, mesh.dim) != (2, 3):
        kind = "tetrahedra" if mesh.cell_dim == 3 else f"vertices with D = {mesh.dim}"
        raise MeshError(f"parameterize: maps surfaces in space to the plane, got {kind}")


def _require_disks(parts: list[_Part]) -> None:
    others = [(i, part.mesh) for i, part in enumerate(parts) if not part.mesh.is_disk]
    if not others:
        return
    named = [f"component {i} of {len(parts)} has {describe_topology(m)}" for i, m in others[:3]]
    more = f", and {len(others) - 3} more components" if len(others) > 3 else ""
    raise MeshError(
        f"parameterize: needs topological disks, but {'; '.join(named)}{more}; "
        "parameterize(mesh, cut=True) cuts them open"
    )


def _require_flip_free(uvmap: UVMap) -> None:
    """Charts are flip-free in float64; moving or rounding them can collapse small triangles."""
    if uvmap.flipped:
        raise MeshError(
            f"parameterize: rounding the map to {uvmap.mesh.dtype} flips {uvmap.flipped} of "
            f"{uvmap.mesh.n_faces} faces; use mesh.to(torch.float64), or map the components alone"
        )


def _timed(milliseconds: dict[str, float], stage: str, work: Callable[[], T]) -> T:
    """The result of some work, whose time is kept."""
    start = time.perf_counter()
    result = work()
    milliseconds[stage] = 1000 * (time.perf_counter() - start)
    return result
