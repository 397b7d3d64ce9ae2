"""Deform a mesh under any loss: optimise a Jacobian per face, through the Poisson layer.

A loss on the map's vertices, here the distance to a point cloud, pulls at each vertex by itself,
and crumples the surface if vertices are what is optimised. Optimise matrices instead, one per face,
and let the layer find the map whose Jacobians are closest to them: each matrix then moves the whole
surface, and the same loss gives smooth deformations. This is how text-driven deformation works; put
another loss in place of `chamfer`. Pins hold one end of the bar; handles attract the other.

Takes less than a minute. Writes to the folder `--out`: deform.png, results.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from torch import Tensor

import diffpoisson as dp


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    mesh = make_bar(options.edge)
    truth = bent(mesh.vertices)
    cloud = dp.sample_surface(mesh, options.points).interpolate(
        mesh, truth
    )  # all that is known ...
    low, high = mesh.vertices[:, 2] < -1.8, mesh.vertices[:, 2] > 1.8
    pins, handles = truth[low], truth[high]  # ... and where both ends go

    solver = dp.PoissonSolver(mesh, pins=low, handles=high, handle_weights=1.0)
    samples = dp.sample_surface(mesh, options.points)

    def loss(phi: Tensor) -> Tensor:
        rigid = (mesh.areas * dp.arap(dp.jacobians(mesh, phi))).sum() / mesh.areas.sum()
        return chamfer(samples.interpolate(mesh, phi), cloud) + 1e-2 * rigid

    def by_layer(R: Tensor) -> Tensor:
        return solver(R, pins=pins, handles=handles)

    def held(v: Tensor) -> Tensor:
        return torch.where(low[:, None], truth, v)

    R = torch.eye(3, dtype=mesh.dtype).repeat(mesh.n_faces, 1, 1)
    start = by_layer(R)
    maps = {
        "start": start,
        "by Jacobians": by_layer(minimise(R, lambda R: loss(by_layer(R)), options.steps, 0.02)),
        "by vertices": held(minimise(start, lambda v: loss(held(v)), options.steps, 0.02)),
    }
    results = {name: errors(mesh, phi, truth, cloud) for name, phi in maps.items()}
    for name, row in results.items():
        print(f"{name:14}" + ", ".join(f"{what} {value:.3g}" for what, value in row.items()))
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    draw(options.out / "deform.png", mesh, cloud, maps, results)
    return results


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/deform"), help="folder for results (runs/deform)")
    add("--edge", type=float, default=0.2, help="longest edge of the mesh (0.2)")
    add("--points", type=int, default=1000, help="of the cloud, and of the surface (1000)")
    add("--steps", type=int, default=200, help="of Adam (200)")
    return parser.parse_args(argv)


def minimise(x: Tensor, loss: Callable[[Tensor], Tensor], steps: int, rate: float) -> Tensor:
    """Adam from x, its rate falling along a cosine."""
    x = x.clone().requires_grad_()
    optimiser = torch.optim.Adam([x], lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad()
        loss(x).backward()
        optimiser.step()
        schedule.step()
    return x.detach()


def chamfer(a: Tensor, b: Tensor) -> Tensor:
    """Mean squared distance to the nearest point, both ways."""
    squared = torch.cdist(a, b).square()
    return squared.amin(0).mean() + squared.amin(1).mean()


def make_bar(edge: float) -> dp.Mesh:
    """The source: a bar of length 4 along z."""
    bar = trimesh.creation.box((0.8, 0.8, 4)).subdivide_to_size(edge)
    bar.merge_vertices()
    return dp.Mesh(np.array(bar.vertices), np.array(bar.faces))


def bent(x: Tensor) -> Tensor:
    """The target: the bar twisted, thinned in its middle and bent, its lower end in place."""
    z = x[:, 2:] + 2
    twist, bend = 0.15 * z, 0.4 * z
    thin = 1 - 0.3 * torch.exp(-2 * (z - 2) ** 2)
    u = thin * (twist.cos() * x[:, :1] - twist.sin() * x[:, 1:2])
    v = thin * (twist.sin() * x[:, :1] + twist.cos() * x[:, 1:2])
    along = torch.cat([(1 - bend.cos()) / 0.4, 0 * z, bend.sin() / 0.4 - 2], dim=1)
    return along + torch.cat([u * bend.cos(), v, -u * bend.sin()], dim=1)


def errors(mesh: dp.Mesh, phi: Tensor, truth: Tensor, cloud: Tensor) -> dict[str, float]:
    """How near the cloud is, and how near the map that made it, which no loss has seen."""
    found, wanted = (mesh.with_vertices(x).normals for x in (phi, truth))
    angle = (found * wanted).sum(1).clamp(-1, 1).acos().rad2deg()
    surface = dp.sample_surface(mesh, 4 * len(cloud)).interpolate(mesh, phi)
    return {
        "distance of the cloud": float(torch.cdist(cloud, surface).amin(1).mean()),
        "error of vertices": float((phi - truth).norm(dim=1).mean()),
        "angle of normals": float(angle.mean()),
    }


def draw(
    path: Path,
    mesh: dp.Mesh,
    cloud: Tensor,
    maps: dict[str, Tensor],
    results: dict[str, dict[str, float]],
) -> None:
    """The source, the cloud, and the maps."""
    shapes = {"source": mesh.vertices, "target, a point cloud": None, **maps}
    figure = Figure(figsize=(2.6 * len(shapes), 4))
    for i, (title, x) in enumerate(shapes.items(), 1):
        ax = figure.add_subplot(1, len(shapes), i, projection="3d", computed_zorder=False)
        assert isinstance(ax, Axes3D)
        if x is None:
            ax.scatter(*cloud.T.numpy(), s=1)
        else:
            ax.plot_trisurf(
                *x.T.numpy(), triangles=mesh.faces.numpy(), color="#8fb98f", edgecolor="k", lw=0.1
            )
        below = [f"{what} {value:.2g}" for what, value in results.get(title, {}).items()]
        ax.set_title("\n".join([title, *below]), fontsize=8, va="top", y=1.2)
        ax.set(xlim=(-1, 3), ylim=(-2, 2), zlim=(-2, 2))
        ax.set_box_aspect((1, 1, 1), zoom=1.5)
        ax.view_init(12, -70)
        ax.set_axis_off()
    figure.savefig(path, dpi=110, bbox_inches="tight")


if __name__ == "__main__":
    main()
