"""Polygons to triangles, by fans."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def triangulated(
    positions: Float[np.ndarray, "c 3"], sizes: Int[np.ndarray, "p"]
) -> tuple[Int[np.ndarray, "m 3"], Int[np.ndarray, "m"]]:
    """A fan of triangles for each polygon, around the corner whose smallest triangle is largest.

    So a concave quad gets the diagonal inside it, and a vertex in the middle of a polygon's side
    does not make a triangle without area where another fan avoids it.

    Args:
        positions: of the corners of all polygons, one polygon after the other.
        sizes: corners of each polygon; those of fewer than three give no triangle.

    Returns:
        (m, 3) indices into the corners, and (m,) the polygon of each triangle, ascending.
    """
    start = np.cumsum(sizes) - sizes
    triangles, owners = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for size in np.unique(sizes[sizes >= 3]).tolist():
        polygons = np.flatnonzero(sizes == size)
        corners = start[polygons][:, None] + np.arange(size)
        fans = _fans(size)
        apex = 0 if size == 3 else _best_apex(positions[corners], fans)
        triangles.append(
            corners[np.arange(len(polygons))[:, None, None], fans[apex]].reshape(-1, 3)
        )
        owners.append(np.repeat(polygons, size - 2))
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


_MOST_APEXES = 64  # tried per polygon, evenly spaced: a fan of each corner takes size² memory


def _fans(size: int) -> Int[np.ndarray, "a k 3"]:
    """The triangles of the fans around (some of) the corners of a polygon."""
    apexes = np.unique(np.linspace(0, size - 1, min(size, _MOST_APEXES)).astype(int))
    apex, k = apexes[:, None], np.arange(1, size - 1)
    return np.stack([apex + 0 * k, apex + k, apex + k + 1], axis=-1) % size


def _best_apex(corners: Float[np.ndarray, "q s 3"], fans: np.ndarray) -> Int[np.ndarray, "q"]:
    """For each polygon, the fan whose smallest triangle, seen along the normal, is largest."""
    a, b, c = np.moveaxis(corners[:, fans], -2, 0)  # (q, apex, k, 3) each
    doubled = np.cross(b - a, c - a)
    normal = doubled[:, 0].sum(axis=1)  # twice the area vector, the same for every fan
    return np.einsum("qakd,qd->qak", doubled, normal).min(axis=-1).argmax(axis=-1)
