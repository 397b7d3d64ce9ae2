"""What to make, so that it is right after it has warped? Optimise a mesh through the Poisson layer.

A part deforms in a way that is known for each of its faces: here, a bar shrinks, bends and twists,
as printed parts do when they cool. The warped shape of a mesh is the map whose Jacobians are
closest to that fixed field, which depends on the mesh: through its gradient operator, its areas,
and the matrix that is factorised. The derivative of all of it by the vertices is exact
(`PoissonSolver(...)(R, vertices=...)`), so that the mesh can be found whose warped shape is the
wanted part.

Takes about a minute on two cores. Writes to the folder `--out`: source.png, results.json,
source.obj (what to make).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from torch import Tensor
from torch.func import jvp, vjp

import diffpoisson as dp


def main(argv: list[str] | None = None) -> dict[str, Any]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    part = make_part(options.edge)
    R = warp(part)
    as_is = dp.solve_poisson(part, R)
    print(f"{part}\nmade as it is, it misses the wanted shape by {distance(part, as_is):.2%}")

    start = time.perf_counter()
    source, distances = fit(part, R, options.steps)
    seconds = time.perf_counter() - start
    image = dp.solve_poisson(source, R)
    results = {
        "vertices": part.n_vertices,
        "distance_before": distance(part, as_is),
        "distance_after": distance(part, image),
        "distances": distances,
        "seconds": seconds,
    }
    print(f"fitted in {seconds:.0f} s, it misses by {results['distance_after']:.0e}")
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    trimesh.Trimesh(source.vertices, source.faces, process=False).export(options.out / "source.obj")
    shapes = {
        "the wanted part, made as it is ...": part.vertices,
        f"... warps, and misses by {results['distance_before']:.1%}": as_is,
        "the fitted source ...": source.vertices,
        f"... warps into it, up to {results['distance_after']:.0e}": image,
    }
    draw(options.out / "source.png", part, shapes, distances)
    print(options.out / "source.png")
    return results


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/fit_source"), help="folder for results")
    add("--edge", type=float, default=0.25, help="longest edge of the mesh (0.25)")
    add("--steps", type=int, default=5, help="Gauss-Newton steps (5)")
    return parser.parse_args(argv)


def make_part(edge: float) -> dp.Mesh:
    """The wanted shape: a bar along x, of length 4."""
    bar = trimesh.creation.box((4, 1, 0.4)).subdivide_to_size(edge)
    bar.merge_vertices()
    return dp.Mesh(np.array(bar.vertices), np.array(bar.faces))


def warp(part: dp.Mesh) -> Tensor:
    """(m, 3, 3) what happens to each face: it shrinks, twists about the bar, and bends with it."""
    x = part.centroids[:, 0] / 4
    twist, bend = torch.pi * x, 0.75 * torch.pi * x
    shrink = torch.diag(torch.tensor([0.9, 0.95, 0.95], dtype=torch.float64))
    return rotations(bend, axis=1) @ rotations(twist, axis=0) @ shrink


def rotations(angles: Tensor, axis: int) -> Tensor:
    """(m, 3, 3) rotations about a coordinate axis."""
    generator = torch.zeros(3, 3, dtype=torch.float64)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    generator[j, i], generator[i, j] = 1, -1
    return torch.linalg.matrix_exp(angles[:, None, None] * generator)


def misfit(part: dp.Mesh, image: Tensor) -> Tensor:
    """(n, 3) by how much each vertex misses, both shapes centred; its norm is the rms distance."""
    weights = (part.vertex_areas / part.areas.sum())[:, None]
    missed = image - part.vertices
    return weights.sqrt() * (missed - (weights * missed).sum(0))


def distance(part: dp.Mesh, image: Tensor) -> float:
    """Root mean square distance of corresponding points, relative to the length of the part."""
    return float(misfit(part, image).norm() / np.ptp(part.vertices[:, 0].numpy()))


def fit(part: dp.Mesh, R: Tensor, steps: int) -> tuple[dp.Mesh, list[float]]:
    """The mesh whose warped shape is the wanted part, by Gauss-Newton, and the distance by step.

    A step factorises once. Its conjugate gradients apply the derivative of the warped shape by the
    vertices forwards and backwards, which only takes solves with that factor.
    """
    solver = dp.PoissonSolver(part)
    distances = [distance(part, solver(R))]
    for _ in range(steps):
        vertices = solver.mesh.vertices

        def residual(vertices: Tensor, solver: dp.PoissonSolver = solver) -> Tensor:
            return misfit(part, solver(R, vertices=vertices))

        value, pull_back = vjp(residual, vertices)

        def normal_matrix(u: Tensor, residual=residual, v=vertices, back=pull_back) -> Tensor:
            return back(jvp(residual, (v,), (u,))[1])[0]

        step = conjugate_gradients(normal_matrix, -pull_back(value)[0])
        solver = solver.update(vertices + step)
        distances.append(distance(part, solver(R)))
    return solver.mesh, distances


def conjugate_gradients(A: Callable[[Tensor], Tensor], b: Tensor, iterations: int = 40) -> Tensor:
    """A few iterations on A x = b; stopping early keeps the step moderate where A is singular."""
    x, r = torch.zeros_like(b), b
    p, square = r, r.square().sum()
    for _ in range(iterations):
        Ap = A(p)
        alpha = square / (p * Ap).sum()
        x, r = x + alpha * p, r - alpha * Ap
        square, before = r.square().sum(), square
        p = r + square / before * p
        if square < 1e-6 * b.square().sum():
            break
    return x


# ------------------------------------------------------- the picture


def draw(
    path: Path,
    part: dp.Mesh,
    shapes: dict[str, Tensor],
    distances: list[float],
) -> None:
    """Two shapes above two, and the curve beside them."""
    figure = Figure(figsize=(12, 5.5), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1, 1, 0.7))
    for i, (title, vertices) in enumerate(shapes.items()):
        axes = figure.add_subplot(grid[i // 2, i % 2], projection="3d", title=title)
        draw_surface(axes, part, vertices)
    axes = figure.add_subplot(
        grid[:, 2],
        xlabel="Gauss-Newton step (one factorisation each)",
        title="rms distance / length",
        yscale="log",
    )
    axes.plot(distances, "o-")
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def draw_surface(axes: Axes3D, part: dp.Mesh, vertices: Tensor) -> None:
    """Shaded, with stripes that show where each face was on the part."""
    centred = (vertices - (vertices.amax(0) + vertices.amin(0)) / 2).numpy()
    stripes = torch.floor(part.centroids[:, 0] * 2.5).long() % 2
    colours = np.array([[0.25, 0.47, 0.70], [0.93, 0.89, 0.80]])[stripes]
    normals = part.with_vertices(vertices).normals.numpy()
    shade = LightSource(azdeg=300, altdeg=55).shade_normals(normals, fraction=0.8)
    colours = np.clip(colours * (0.45 + 0.55 * shade[:, None]), 0, 1)
    surface = Poly3DCollection(
        centred[part.faces], facecolors=colours, edgecolors=colours, linewidths=0.3, clip_on=False
    )
    axes.add_collection3d(surface)
    axes.set(xlim=(-2, 2), ylim=(-1, 1), zlim=(-1, 1))
    axes.set_box_aspect((2, 1, 1), zoom=1.6)
    axes.view_init(elev=20, azim=-70)
    axes.set_axis_off()


if __name__ == "__main__":
    main()
