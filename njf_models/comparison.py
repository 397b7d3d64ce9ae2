"""UV maps side by side: a map, SLIM from Tutte and LSCM on the same charts, measured alike."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp


@dataclass(frozen=True, eq=False)
class MeasuredMap:
    """A map of a surface that was cut into charts, and its figures; means are weighted by area.

    Attributes:
        title: for people.
        uv: (n', 2) in the surface's units.
        distortion: (m,) max(σ₁, 1/σ₂) of each face, infinite where it is flipped.
        energy: mean symmetric Dirichlet energy, 4 at an isometry, infinite if any face flips.
        mean_distortion: mean of `distortion`.
        max_distortion: largest of them.
        area_distortion: mean of max(det J, 1 / det J).
        angle_distortion: mean of σ₁/σ₂.
        flipped: triangles that are not positively oriented, decided exactly.
        overlapping: charts whose boundary touches or crosses itself.
        certified: whether every chart is one-to-one for certain.
        milliseconds: time of each stage.
    """

    title: str
    uv: Float[Tensor, "n 2"]
    distortion: Float[Tensor, "m"]
    energy: float
    mean_distortion: float
    max_distortion: float
    area_distortion: float
    angle_distortion: float
    flipped: int
    overlapping: int
    certified: bool
    milliseconds: dict[str, float]


def compare(uvmap: dp.UVMap, title: str, *, tolerance: float) -> list[MeasuredMap]:
    """The map, SLIM from Tutte's embedding, and LSCM scaled to the area, on the map's charts.

    Every chart of the others is moved rigidly onto the map's.

    Args:
        uvmap: the map to compare.
        title: its name.
        tolerance: of SLIM, as the map's own.
    """
    charts = [_Disk.of(uvmap, chart.faces) for chart in uvmap.charts]
    maps = [measure(title, uvmap, charts, uvmap.uv, uvmap.milliseconds)]
    for name, flatten in (("SLIM from Tutte", _slim), ("LSCM", _lscm)):
        uv = uvmap.uv.clone()
        milliseconds: dict[str, float] = {}
        for disk in charts:
            flat, times = flatten(disk.mesh, tolerance)
            weights = disk.mesh.vertex_areas
            uv[disk.vertices] = dp.procrustes(flat, uvmap.uv[disk.vertices], weights)
            milliseconds.update({k: milliseconds.get(k, 0.0) + t for k, t in times.items()})
        maps.append(measure(name, uvmap, charts, uv, milliseconds))
    return maps


@dataclass(frozen=True, eq=False)
class _Disk:
    """One chart as a mesh of its own, and its vertices in the whole."""

    mesh: dp.Mesh
    vertices: Int[Tensor, "k"]

    @staticmethod
    def of(uvmap: dp.UVMap, faces: Tensor) -> _Disk:
        vertices, index = uvmap.mesh.faces[faces].unique(return_inverse=True)
        return _Disk(dp.Mesh(uvmap.mesh.vertices[vertices], index), vertices)


def measure(
    title: str,
    uvmap: dp.UVMap,
    charts: list[_Disk],
    uv: Float[Tensor, "n 2"],
    milliseconds: dict[str, float],
) -> MeasuredMap:
    """The figures of one map on the charts of another."""
    mesh = uvmap.mesh
    weights = mesh.areas / mesh.areas.sum()
    J = dp.jacobians(mesh, uv)
    distortion, det = dp.isometric_distortion(J), dp.determinant(J)
    largest, smallest = dp.singular_values(J).unbind(-1)
    upright = det > 0
    infinite = torch.full_like(det, torch.inf)
    certificates = [dp.certify(disk.mesh, uv[disk.vertices]) for disk in charts]
    return MeasuredMap(
        title,
        uv,
        distortion,
        energy=float(weights @ dp.symmetric_dirichlet(J)),
        mean_distortion=float(weights @ distortion),
        max_distortion=float(distortion.max()),
        area_distortion=float(
            weights @ torch.where(upright, torch.maximum(det, 1 / det), infinite)
        ),
        angle_distortion=float(weights @ torch.where(upright, largest / smallest, infinite)),
        flipped=sum(certificate.n_flipped for certificate in certificates),
        overlapping=sum(not certificate.simple_boundary for certificate in certificates),
        certified=all(certificate.injective for certificate in certificates),
        milliseconds=milliseconds,
    )


def _slim(mesh: dp.Mesh, tolerance: float) -> tuple[Tensor, dict[str, float]]:
    start = time.perf_counter()
    init = dp.tutte(mesh)
    middle = time.perf_counter()
    uv = dp.slim(mesh, init, tolerance=tolerance).uv
    end = time.perf_counter()
    return uv, {"tutte": 1000 * (middle - start), "slim": 1000 * (end - middle)}


def _lscm(mesh: dp.Mesh, _: float) -> tuple[Tensor, dict[str, float]]:
    """Least squares conformal map (Lévy et al. 2002), scaled to the surface's area."""
    import igl  # noqa: PLC0415  (a heavy import that only this comparison needs)

    start = time.perf_counter()
    boundary = mesh.boundary_loops[0].numpy()
    pins = boundary[[0, len(boundary) // 2]]
    uv = torch.from_numpy(
        igl.lscm(
            mesh.vertices.numpy(), mesh.faces.numpy(), pins, np.array([[0.0, 0.0], [1.0, 0.0]])
        )[0]
    )
    flat_area = mesh.areas @ dp.determinant(dp.jacobians(mesh, uv))
    uv *= (mesh.areas.sum() / flat_area.abs()).sqrt()
    return uv, {"lscm": 1000 * (time.perf_counter() - start)}
