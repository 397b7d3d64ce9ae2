"""UV maps of disks: time and distortion together, ours beside other programs'.

Peers that are not installed are left out: `pip install xatlas bpy` (bpy is Blender, of one version
of Python only).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from types import ModuleType

import igl
import numpy as np
import torch
from torch import Tensor

import diffpoisson as dp
import njf_models
from diffpoisson import cells
from diffpoisson.topology import component_labels
from tests.benchmarks.figures import Figure, Spread, Target
from tests.benchmarks.harness import alternate, main
from tests.benchmarks.uv_training import generated_patches

Corners = np.ndarray  # (m, 3, 2) the image of each face's corners
Mapper = Callable[[np.ndarray, np.ndarray], Corners]
OURS = ("ours, from Tutte's map", "ours, from the network's")
SLIM_ITERATIONS = (5, 20, 50)
CONVERGED = 1e-5  # relative energies that differ by less are equal

# ------------------------------------------------------- contestants


def ours(vertices: np.ndarray, faces: np.ndarray) -> Corners:
    return dp.parameterize(dp.Mesh(vertices, faces)).uv.numpy()[faces]


def ours_from_network(vertices: np.ndarray, faces: np.ndarray) -> Corners:
    return njf_models.parameterize(dp.Mesh(vertices, faces)).uv.numpy()[faces]


def libigl_slim(iterations: int) -> Mapper:
    """Harmonic map to a circle, then SLIM, as libigl's tutorial does it."""

    def flatten(vertices: np.ndarray, faces: np.ndarray) -> Corners:
        V, F = np.asfortranarray(vertices), np.asfortranarray(faces, dtype=np.int32)
        V = V / np.sqrt(igl.doublearea(V, F).sum() / 2)
        boundary = igl.boundary_loop(F)
        circle = np.asfortranarray(igl.map_vertices_to_circle(V, boundary) / np.sqrt(np.pi))
        start = np.asfortranarray(igl.harmonic(V, F, boundary, circle, 1))
        energy, none = igl.MappingEnergyType.SYMMETRIC_DIRICHLET, np.zeros(0, dtype=np.int32)
        points = np.zeros((0, 2), order="F")
        data = igl.slim_precompute(V, F, start, energy, none, points, 0.0)
        return igl.slim_solve(data, iterations)[:, :2][faces]

    return flatten


def xatlas_chart(xatlas: ModuleType) -> Mapper:
    """Charts grown without a limit on their cost, so that few seams help the energy."""

    def flatten(vertices: np.ndarray, faces: np.ndarray) -> Corners:
        atlas = xatlas.Atlas()
        atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
        options = xatlas.ChartOptions()
        options.max_cost = 1e9
        atlas.generate(options, xatlas.PackOptions())
        _, indices, uv = atlas[0]
        return (uv * [atlas.width, atlas.height])[indices]

    return flatten


def blender(bpy: ModuleType) -> Mapper:
    """Blender's unwrap with "minimum stretch", which is SLIM in Blender's own code."""

    def flatten(vertices: np.ndarray, faces: np.ndarray) -> Corners:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        data = bpy.data.meshes.new("disk")
        data.from_pydata(vertices.tolist(), [], faces.tolist())
        data.uv_layers.new(name="uv")
        body = bpy.data.objects.new("disk", data)
        bpy.context.collection.objects.link(body)
        bpy.context.view_layer.objects.active = body
        body.select_set(True)
        bpy.ops.object.mode_set(mode="EDIT")
        bpy.ops.mesh.select_all(action="SELECT")
        bpy.ops.uv.unwrap(method="MINIMUM_STRETCH", iterations=20, correct_aspect=False)
        bpy.ops.object.mode_set(mode="OBJECT")
        uv = np.empty(2 * len(data.loops), dtype=np.float32)
        data.uv_layers.active.data.foreach_get("uv", uv)
        return uv.reshape(len(faces), 3, 2)

    return flatten


PEERS = {"xatlas": xatlas_chart, "bpy": blender}
NAMES = {"xatlas": "xatlas", "bpy": "Blender, minimum stretch"}


def contestants() -> tuple[dict[str, Mapper], list[str]]:
    """All mappers that are installed, and the names of those that are not."""
    mappers: dict[str, Mapper] = dict(zip(OURS, (ours, ours_from_network), strict=True))
    for iterations in SLIM_ITERATIONS:
        mappers[f"libigl SLIM, {iterations} iterations"] = libigl_slim(iterations)
    missing = []
    for module, make in PEERS.items():
        try:
            mappers[NAMES[module]] = make(importlib.import_module(module))
        except ImportError:
            missing.append(module)
    return mappers, missing


# ------------------------------------------------------- figures


@dataclass
class Maps:
    """What a contestant made of each mesh: median seconds, energy (None if it flips), charts."""

    seconds: list[float] = field(default_factory=list)
    energy: list[float | None] = field(default_factory=list)
    charts: list[int] = field(default_factory=list)


def front(quick: bool) -> Iterator[Figure]:
    """Time from (V, F), and energy, of patches of generated parts; at two sizes.

    A map is dominated by one that is faster and not more distorted, but for `CONVERGED`, of as few
    charts: seams would lower any energy.
    """
    mappers, missing = contestants()
    sizes = ((100, 200, 1),) if quick else ((800, 1200, 6), (8000, 12000, 2))
    for least, most, count in sizes:
        patches = generated_patches((least, most), count, 1)
        arrays = [(patch.mesh.vertices.numpy(), patch.mesh.faces.numpy()) for patch in patches]
        results = _measured(mappers, arrays, turns=1 if quick else 3)
        faces = float(np.mean([len(F) for _, F in arrays]))
        title = f"UV maps of {len(arrays)} patches of {faces:,.0f} faces"
        points = {name: asdict(maps) for name, maps in results.items()}
        for name in OURS:
            share = _not_dominated(name, results)
            yield Figure(
                f"{title}, {name}: share that no peer dominates",
                "SLIM, xatlas, Blender",
                Spread(share, share, share),
                unit="",
                target=Target("≥", 1.0),
                seconds={other: Spread.of(maps.seconds) for other, maps in results.items()},
                details={"title": title, "points": points, "missing": missing},
            )


def _measured(
    mappers: dict[str, Mapper], arrays: list[tuple[np.ndarray, np.ndarray]], turns: int
) -> dict[str, Maps]:
    results = {name: Maps() for name in mappers}
    for V, F in arrays:
        works = {n: (lambda f=f, V=V, F=F: f(V, F)) for n, f in mappers.items()}
        for name, seconds in alternate(works, turns, at_least=0.0).items():
            corners = mappers[name](V, F)
            results[name].seconds.append(float(np.median(seconds)))
            results[name].energy.append(energy(V, F, corners))
            results[name].charts.append(int(chart_of_face(F, corners).max()) + 1)
    return results


def _not_dominated(name: str, results: dict[str, Maps]) -> float:
    """The share of meshes on which no peer does as well in less time."""
    mine = results[name]
    peers = [maps for other, maps in results.items() if other not in OURS]
    good = [
        ours is not None
        and not any(
            theirs.energy[i] is not None
            and theirs.charts[i] <= mine.charts[i]
            and theirs.seconds[i] < mine.seconds[i]
            and theirs.energy[i] < (1 + CONVERGED) * ours
            for theirs in peers
        )
        for i, ours in enumerate(mine.energy)
    ]
    return float(np.mean(good))


def energy(V: np.ndarray, F: np.ndarray, corners: Corners) -> float | None:
    """Mean symmetric Dirichlet energy at the best scale of the whole; None where a map flips.

    A chart that is mirrored as a whole, as xatlas's are, counts as its mirror image.
    """
    mesh = dp.Mesh(V.astype(np.float64), F)
    hats = cells.hat_gradients(mesh._corners, mesh._double_frames)
    J: Tensor = (hats @ torch.from_numpy(corners.astype(np.float64))).mT
    areas = mesh.areas / mesh.areas.sum()
    charts = torch.from_numpy(chart_of_face(F, corners))
    signed = J.new_zeros(len(F)).index_add(0, charts, areas * dp.determinant(J))
    J = torch.stack([J[:, 0], J[:, 1] * signed.sign()[charts, None]], dim=1)
    if dp.flipped(J).any():
        return None
    stretch = (areas * J.square().sum((-2, -1))).sum()
    shrinkage = (areas * torch.linalg.inv(J).square().sum((-2, -1))).sum()
    return float(2 * (stretch * shrinkage).sqrt())


def chart_of_face(F: np.ndarray, corners: Corners) -> np.ndarray:
    """(m,) the chart of each face: charts share no vertex at the same place."""
    places = np.concatenate([F.reshape(-1, 1), corners.reshape(-1, 2)], axis=1)
    unique, index = np.unique(places, axis=0, return_inverse=True)
    corner_index = index.reshape(-1, 3)
    return component_labels(corner_index, len(unique))[corner_index[:, 0]]


MEASUREMENTS = {"front": front}

if __name__ == "__main__":
    main("maps", MEASUREMENTS)
