"""Pictures on a surface, carried over from one UV map to another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

Picture = UInt8[np.ndarray, "_ _ 4"]

_SMALLEST, _LARGEST = 256, 2048  # sides of a baked picture, in pixels


@dataclass(frozen=True, eq=False)
class Paint:
    """Pictures on the triangles of a surface.

    Attributes:
        uv: (m, 3, 2) where each corner lies in its picture, (0, 0) at the bottom left; pictures
            repeat outside of the unit square.
        image_of_face: (m,) int64 index into `images`.
        images: RGBA pictures, one pixel for a plain colour.
    """

    uv: Float[np.ndarray, "m 3 2"]
    image_of_face: Int[np.ndarray, "m"]
    images: tuple[Picture, ...]


def bake(paint: Paint, uv: Float[np.ndarray, "t 2"], corners: Int[np.ndarray, "m 3"]) -> Picture:
    """One picture that shows the same on the surface under other UVs.

    Each pixel takes the colour of the nearest point of the layout, so that it goes on beyond the
    seams, where filtering needs it. As large as the largest of the old pictures, within 256 and
    2048 pixels a side.

    Args:
        paint: the old pictures and UVs.
        uv: (t, 2) new UVs in the unit square.
        corners: (m, 3) indices into `uv` of each triangle's corners.
    """
    import igl  # noqa: PLC0415  (a heavy import that only textures need)

    largest = max(max(image.shape[:2]) for image in paint.images)
    side = int(np.clip(largest, _SMALLEST, _LARGEST))
    centres = (np.arange(side) + 0.5) / side
    u, v = np.meshgrid(centres, centres[::-1])
    pixels = np.stack([u.ravel(), v.ravel(), np.zeros(side**2)], axis=1)
    flat = np.pad(uv, ((0, 0), (0, 1)))
    face, point = igl.point_mesh_squared_distance(pixels, flat, corners)[1:]
    weights = _barycentric(point[:, :2], uv[corners[face]])
    old = (weights[:, :, None] * paint.uv[face]).sum(axis=1)
    baked = np.empty((side**2, 4), dtype=np.uint8)
    for i, image in enumerate(paint.images):
        here = paint.image_of_face[face] == i
        baked[here] = _sampled(image, old[here])
    return baked.reshape(side, side, 4)


def _barycentric(
    points: Float[np.ndarray, "p 2"], triangles: Float[np.ndarray, "p 3 2"]
) -> Float[np.ndarray, "p 3"]:
    """Barycentric coordinates; of a triangle without area, its first corner."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    area = _cross(b - a, c - a)
    flat = area == 0
    area = np.where(flat, 1, area)
    second, third = _cross(points - a, c - a) / area, _cross(b - a, points - a) / area
    second, third = np.where(flat, 0, second), np.where(flat, 0, third)
    return np.stack([1 - second - third, second, third], axis=1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _sampled(image: Picture, uv: Float[np.ndarray, "p 2"]) -> UInt8[np.ndarray, "p 4"]:
    """Bilinear samples of a picture that repeats."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = (x - column)[:, None], (y - row)[:, None]

    def pixel(down: int, right: int) -> np.ndarray:
        return image[(row + down) % height, (column + right) % width].astype(np.float64)

    top = (1 - s) * pixel(0, 0) + s * pixel(0, 1)
    bottom = (1 - s) * pixel(1, 0) + s * pixel(1, 1)
    return np.rint((1 - t) * top + t * bottom).astype(np.uint8)
