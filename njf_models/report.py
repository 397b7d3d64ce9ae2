"""Pictures of UV maps: checkerboards on the surface, layouts, loss curves."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from torch import Tensor

import diffpoisson as dp
from njf_models.rendering import SAMPLES_PER_PIXEL, splat

SQUARE = 0.06  # side of a checkerboard's square, for patches of unit area
_LIGHT = np.array([0.35, 0.45, 0.82])


class UVRow(NamedTuple):
    """One patch in a report: its name, its mesh, and maps to compare by title."""

    title: str
    mesh: dp.Mesh
    maps: dict[str, Float[Tensor, "n 2"]]


def save_uv_report(rows: Sequence[UVRow], log: Path | None, path: Path) -> None:
    """A picture with, for each patch and map, the textured surface and the UV layout.

    Args:
        rows: the patches; all with the same titles of maps.
        log: a `metrics.csv` of the training run to draw as a curve, or None.
        path: the PNG to write.
    """
    titles = list(rows[0].maps)
    figure = plt.figure(figsize=(3.1 * 2 * len(titles), 3.2 * (len(rows) + (log is not None))))
    grid = figure.add_gridspec(len(rows) + (log is not None), 2 * len(titles))
    for i, row in enumerate(rows):
        for j, (title, uv) in enumerate(row.maps.items()):
            surface, layout = (figure.add_subplot(grid[i, 2 * j + k]) for k in (0, 1))
            draw_checkerboard(surface, row.mesh, uv)
            draw_layout(layout, row.mesh, uv)
            if i == 0:
                surface.set_title(title, loc="left", fontweight="bold")
            if j == 0:
                surface.text(0, -0.02, row.title, transform=surface.transAxes, va="top", fontsize=8)
    if log is not None:
        draw_curve(figure.add_subplot(grid[-1, :]), log)
    _colour_bar(figure)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)


def draw_checkerboard(ax: Axes, mesh: dp.Mesh, uv: Float[Tensor, "n 2"]) -> None:
    """The surface seen obliquely from above, textured by a checkerboard through its map."""
    ax.imshow(render_checkerboard(mesh, uv))
    ax.set_axis_off()


def draw_layout(ax: Axes, mesh: dp.Mesh, uv: Float[Tensor, "n 2"]) -> None:
    """The map in the plane, faces coloured by max(σ₁, 1/σ₂); flipped ones in red."""
    J = dp.jacobians(mesh, uv.double())
    distortion = dp.isometric_distortion(J).log2().clamp(max=_COLOUR_LIMIT).numpy()
    polygons = PolyCollection(
        list(uv[mesh.faces].double().numpy()), linewidths=0.1, edgecolors="#0003"
    )
    colours = plt.get_cmap("viridis")(distortion / _COLOUR_LIMIT)
    colours[dp.flipped(J).numpy()] = (0.9, 0.1, 0.1, 1.0)
    polygons.set_facecolor(list(colours))
    ax.add_collection(polygons)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()


_COLOUR_LIMIT = 2.0  # log₂: faces stretched or shrunk four times or more look alike


def _colour_bar(figure: Figure) -> None:
    scale = plt.cm.ScalarMappable(Normalize(0, _COLOUR_LIMIT), "viridis")
    bar = figure.colorbar(scale, ax=figure.axes, shrink=0.25, pad=0.01, anchor=(0, 1))
    bar.set_ticks([0, 1, 2], labels=["1 (isometric)", "2", "≥ 4"])
    bar.set_label("max(σ₁, 1/σ₂); flipped: red")


def draw_curve(ax: Axes, log: Path) -> None:
    """Training and validation loss over the steps of a Lightning CSV log."""
    with log.open() as file:
        lines = list(csv.DictReader(file))
    for name in ("train/loss", "validation/loss"):
        points = [(int(line["step"]), float(line[name])) for line in lines if line.get(name)]
        ax.plot(*zip(*points, strict=True), label=name)
    ax.set(xlabel="step", ylabel="loss", yscale="log")
    ax.legend()


def render_checkerboard(
    mesh: dp.Mesh,
    uv: Float[Tensor, "n 2"],
    size: int = 320,
    square: float = SQUARE,
    seen: Float[Tensor, "k 3"] | None = None,
) -> Float[np.ndarray, "size size 3"]:
    """An orthographic picture of a mesh in space, by splatting random surface samples.

    Args:
        mesh: the surface, seen from above (+z) and the side.
        uv: (n, 2) texture coordinates, in the mesh's units.
        size: pixels of each side.
        square: side of the checkerboard's squares, in the units of uv.
        seen: points that the picture has room for; by default those of the surface.
    """
    view, window = _view(), None
    if seen is not None:
        at = (seen.double() @ view.T)[:, :2]
        low, high = at.amin(0), at.amax(0)
        window = ((low + high) / 2).numpy(), 1.05 * float((high - low).max())
    samples = dp.sample_surface(
        mesh, SAMPLES_PER_PIXEL * size**2, generator=torch.Generator().manual_seed(0)
    )
    points = samples.interpolate(mesh, mesh.vertices @ view.T)
    texture = samples.interpolate(mesh, uv.double())
    normals = (mesh.normals @ view.T)[samples.faces].numpy()
    checker = (texture / square).floor().sum(dim=1).remainder(2).numpy()
    colour = np.where(checker[:, None] > 0, (0.98, 0.97, 0.94), (0.16, 0.42, 0.67))
    colour = np.where(normals[:, 2:] < 0, 0.5 * colour + (0.45, 0.2, 0.1), colour)  # back side
    shade = 0.45 + 0.55 * np.abs(normals @ _LIGHT)
    return splat(points.numpy(), np.clip(colour * shade[:, None], 0, 1), size, window)


def _view(elevation: float = 0.9, azimuth: float = -0.5) -> Tensor:
    """Rotation to a camera that looks down on the patch; angles in radians."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    around_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    tilt = np.pi / 2 - elevation
    c, s = np.cos(-tilt), np.sin(-tilt)
    return torch.from_numpy(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ around_z)
