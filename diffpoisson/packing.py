"""Charts side by side in the plane: each turned to fit its box, the boxes on shelves."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

# Between charts, as a fraction of the side of a square of all boxes' area: 10 pixels in 1024.
_MARGIN = 0.01


def pack(charts: list[Float[np.ndarray, "_ 2"]]) -> list[Float[np.ndarray, "_ 2"]]:
    """Move charts, given by their points, so that their bounding boxes do not meet.

    Charts are rotated, each to its bounding box of least area, and translated, never mirrored. The
    whole is nearly square, with its lowest corner at the origin.
    """
    lying = [_lying(points) for points in charts]
    sizes = np.stack([np.ptp(points, axis=0) for points in lying])
    margin = _MARGIN * math.sqrt(sizes.prod(axis=1).sum())
    corners = _on_shelves(sizes + margin)
    return [p - p.min(axis=0) + corner for p, corner in zip(lying, corners, strict=True)]


def _lying(points: np.ndarray) -> np.ndarray:
    """The points turned so that their bounding box is least in area, and not higher than wide.

    One side of such a box lies on an edge of the convex hull (Freeman and Shapira 1975).
    """
    from scipy.spatial import ConvexHull  # noqa: PLC0415  (quick to use, slow to import)

    # Joggled, since slivers are flat to Qhull: the hull only supplies directions.
    hull = points[ConvexHull(points, qhull_options="QJ").vertices]
    x, y = (np.roll(hull, -1, axis=0) - hull).T
    length = np.hypot(x, y)
    turns = np.array([[x, y], [-y, x]]) / length  # (2, 2, edges): each edge to the x-axis
    extents = np.ptp(np.einsum("ije,pj->pie", turns, hull), axis=0)
    best = extents.prod(axis=0).argmin()
    turned = points @ turns[..., best].T
    upright = extents[0, best] < extents[1, best]
    return turned @ np.array([[0, 1], [-1, 0]]) if upright else turned


def _on_shelves(sizes: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "k 2"]:
    """Lower left corners of boxes, by first fit in the order of falling heights.

    Coffman, Garey, Johnson and Tarjan, "Performance bounds for level-oriented two-dimensional
    packing algorithms", 1980.
    """
    least = max(sizes[:, 0].max(), math.sqrt(sizes.prod(axis=1).sum()))
    layouts = [_first_fit(sizes, stretch * least) for stretch in np.linspace(1, 1.5, 11)]
    return min(layouts, key=lambda corners: (corners + sizes).max())


def _first_fit(sizes: np.ndarray, width: float) -> np.ndarray:
    corners = np.empty_like(sizes)
    ends, floors, ceiling = np.zeros(0), np.zeros(0), 0.0  # of each shelf; of the last one
    for i in np.argsort(-sizes[:, 1], kind="stable"):
        shelf = int(np.argmax(np.r_[ends + sizes[i, 0] <= width, True]))
        if shelf == len(ends):
            ends, floors = np.r_[ends, 0], np.r_[floors, ceiling]
            ceiling += sizes[i, 1]
        corners[i] = ends[shelf], floors[shelf]
        ends[shelf] += sizes[i, 0]
    return corners
