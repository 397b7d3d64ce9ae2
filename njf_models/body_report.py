"""Pictures of maps of bodies, in the paper's style: source green, target blue, errors coloured."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from jaxtyping import Float, Int
from matplotlib.colors import Normalize
from torch import Tensor

import diffpoisson as dp
from njf_models.rendering import splat

ERROR_LIMIT = 0.1  # metres: where the colours of the error end, unless said otherwise
_GREEN, _BLUE = (0.45, 0.72, 0.45), (0.42, 0.58, 0.85)
_LIGHT = np.array([0.3, 0.4, 0.87])  # right, up, towards the camera
_SAMPLES = 8  # on a pixel's area of the surface, so that one is missed once in e⁸ at most
_AZIMUTH, _ELEVATION = 0.5, 0.1  # of the camera, from the front; radians


class BodyRow(NamedTuple):
    """One map in a report: its name, source, target, and predictions to compare by title.

    Without a target, predictions have its colour, and no error.
    """

    title: str
    faces: Int[Tensor, "m 3"]
    source: Float[Tensor, "n 3"]
    target: Float[Tensor, "n 3"] | None
    predictions: dict[str, Float[Tensor, "n 3"]]


def save_body_report(
    rows: Sequence[BodyRow], path: Path, size: int = 320, limit: float = ERROR_LIMIT
) -> None:
    """A picture with source, target and the predictions of each map.

    Args:
        rows: the maps; all with the same titles of predictions, and all with targets or none.
        path: the PNG to write.
        size: pixels of each body.
        limit: metres where the colours of the error end.
    """
    has_targets = rows[0].target is not None
    titles = ["source", *(["target"] if has_targets else []), *rows[0].predictions]
    figure, axes = plt.subplots(
        len(rows),
        len(titles),
        figsize=(2.2 * len(titles), 2.5 * len(rows)),
        squeeze=False,
        gridspec_kw={"wspace": 0, "hspace": 0.12},
    )
    for row, line in zip(rows, axes, strict=True):
        for ax, title, image in zip(line, titles, _images(row, size, limit), strict=True):
            ax.imshow(image)
            ax.set_axis_off()
            ax.set_title(title if row is rows[0] else "", fontsize=9)
        line[0].text(0.1, 0, row.title, transform=line[0].transAxes, va="top", fontsize=7)
    if has_targets:
        _add_scale(figure, axes, limit)
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)


def _add_scale(figure: Any, axes: Any, limit: float) -> None:
    scale = plt.cm.ScalarMappable(Normalize(0, 100 * limit), "viridis")
    figure.colorbar(scale, ax=axes, shrink=0.5, label="distance from the target, cm")


def render_body(
    vertices: Float[Tensor, "n 3"],
    faces: Int[Tensor, "m 3"],
    colours: Float[np.ndarray, "n 3"],
    size: int = 320,
    side: float = 1.9,
) -> Float[np.ndarray, "size size 3"]:
    """A body seen from the front, a little from its left and from above.

    Args:
        vertices: x to its left, y to its back, z up; in metres.
        faces: its triangles.
        colours: of the vertices.
        size: pixels of each side.
        side: metres that the picture shows; enlarged where the body is larger.
    """
    mesh = dp.Mesh(vertices.double(), faces)
    at = mesh.vertices @ _VIEW.T
    low, high = at[:, :2].amin(0).numpy(), at[:, :2].amax(0).numpy()
    side = max(side, 1.02 * float((high - low).max()))
    fine = 2 * size  # pixels, of which four are averaged
    n_samples = round(_SAMPLES * float(mesh.areas.sum()) / (side / fine) ** 2)
    samples = dp.sample_surface(mesh, n_samples, generator=torch.Generator().manual_seed(0))
    attributes = [at, mesh.vertex_normals @ _VIEW.T, torch.from_numpy(colours)]
    points, normals, colour = samples.interpolate(mesh, torch.cat(attributes, dim=1)).split(3, 1)
    normals = torch.nn.functional.normalize(normals, dim=1).numpy()
    shade = 0.4 + 0.6 * np.clip(normals @ _LIGHT, 0, 1)
    shaded = np.clip(colour.numpy() * shade[:, None], 0, 1)
    image = splat(points.numpy(), shaded, fine, ((low + high) / 2, side))
    return image.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))


def _images(row: BodyRow, size: int, limit: float) -> list[np.ndarray]:
    n = len(row.source)

    def plain(vertices: Tensor, colour: tuple[float, float, float]) -> np.ndarray:
        return render_body(vertices, row.faces, np.tile(colour, (n, 1)), size)

    source = plain(row.source, _GREEN)
    if row.target is None:
        return [source, *(plain(phi, _BLUE) for phi in row.predictions.values())]
    images = [source, plain(row.target, _BLUE)]
    target = row.target - row.target.mean(dim=0)
    for phi in row.predictions.values():
        error = torch.linalg.vector_norm(phi - phi.mean(dim=0) - target, dim=1)
        colours = plt.get_cmap("viridis")(error.numpy() / limit)[:, :3]
        images.append(render_body(phi, row.faces, colours, size))
    return images


def _view() -> Tensor:
    """Rotation to right, up and towards the camera."""
    front = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    c, s = np.cos(_AZIMUTH), np.sin(_AZIMUTH)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(_ELEVATION), np.sin(_ELEVATION)
    return torch.from_numpy(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ front @ turn)


_VIEW = _view()
