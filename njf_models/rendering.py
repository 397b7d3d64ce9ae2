"""Pictures of surfaces from points on them: no window system, no graphics library."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SAMPLES_PER_PIXEL = 24  # enough that a sample misses a covered pixel once in e²⁴


def splat(
    points: Float[np.ndarray, "s 3"],
    colours: Float[np.ndarray, "s 3"],
    size: int,
    window: tuple[Float[np.ndarray, "2"], float] | None = None,
) -> Float[np.ndarray, "size size 3"]:
    """Colour each pixel by the sample nearest to the camera, on white.

    Args:
        points: right, up, and towards the camera.
        colours: red, green and blue of each, from 0 to 1.
        size: pixels of each side.
        window: centre and side of the square that is seen, which must hold all points; by default
            a little more than the points' own.
    """
    if window is None:
        low, high = points[:, :2].min(0), points[:, :2].max(0)
        window = (low + high) / 2, 1.05 * float((high - low).max())
    centre, side = window
    column, row = (((points[:, :2] - centre) / side + 0.5) * size).astype(int).T
    nearest_last = np.argsort(points[:, 2])
    image = np.ones((size, size, 3))
    image[size - 1 - row[nearest_last], column[nearest_last]] = colours[nearest_last]
    return image
