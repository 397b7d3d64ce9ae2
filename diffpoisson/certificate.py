"""What is certain of a planar map: the signs of its triangles and the simplicity of its boundary.

Signs are decided in exact arithmetic on the floating-point coordinates as they stand. A map of a
disk whose triangles are all positively oriented and whose boundary is a simple polygon is
one-to-one: a point has as many preimages as the boundary winds around it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import require_single_or_double, require_tensor
from diffpoisson.distortion import determinant, isometric_distortion, symmetric_dirichlet
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh, require_mesh

# A computed orientation (a - c) × (b - c) has the right sign if it exceeds 3u + 16u² times the sum
# of the magnitudes of its two products, u the unit roundoff (Shewchuk 1997).
_U = 2.0**-53
_ORIENTATION_BOUND = (3 + 16 * _U) * _U


@dataclass(frozen=True)
class Certificate:
    """Facts about a map of a triangle mesh to the plane.

    Attributes:
        n_flipped: triangles that are not positively oriented, decided exactly.
        simple_boundary: whether the boundary is one polygon that does not touch itself, decided
            exactly.
        min_determinant: smallest det J.
        mean_distortion: area-weighted mean of max(σ₁, 1/σ₂), infinite at a flip.
        max_distortion: largest max(σ₁, 1/σ₂), infinite at a flip.
        energy: area-weighted mean symmetric Dirichlet energy, 4 at an isometry, infinite at a flip.
    """

    n_flipped: int
    simple_boundary: bool
    min_determinant: float
    mean_distortion: float
    max_distortion: float
    energy: float

    @property
    def injective(self) -> bool:
        """Whether the map of a disk is one-to-one."""
        return self.n_flipped == 0 and self.simple_boundary


def certify(mesh: Mesh, uv: Float[Tensor, "n 2"]) -> Certificate:
    """Check a map of a disk; a surface in space or a planar mesh.

    Args:
        mesh: a topological disk.
        uv: (n, 2) the map.

    Raises:
        TypeError: not a mesh, or uv no tensor of floating-point numbers.
        ValueError: uv is not (n, 2) and finite, or on another device.
    """
    require_mesh("certify", mesh)
    require_tensor("certify", "uv", uv, mesh.device)
    require_single_or_double("certify", "uv", uv)
    if uv.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"certify: expected uv of shape (n={mesh.n_vertices}, 2), got {tuple(uv.shape)}"
        )
    if not uv.isfinite().all():
        raise ValueError("certify: uv has entries that are not finite")
    J = jacobians(mesh, uv.detach().double())
    distortion = isometric_distortion(J)
    density = symmetric_dirichlet(J)
    areas = mesh._double_measures / mesh._double_measures.sum()
    points = uv.detach().cpu().double().numpy()
    loops = [loop.cpu().numpy() for loop in mesh.boundary_loops]
    return Certificate(
        n_flipped=count_flips(mesh, uv),
        simple_boundary=len(loops) == 1 and is_simple(points[loops[0]]),
        min_determinant=float(determinant(J).min()),
        mean_distortion=float((areas * distortion).sum()),
        max_distortion=float(distortion.max()),
        energy=float((areas * density).sum()),
    )


def count_flips(mesh: Mesh, uv: Float[Tensor, "n 2"]) -> int:
    """Number of faces that a map does not orient positively, decided exactly."""
    points = uv.detach().cpu().double().numpy()
    return int((orientations(points[mesh.faces.cpu().numpy()]) <= 0).sum())


def orientations(triangles: Float[np.ndarray, "m 3 2"]) -> np.ndarray:
    """Exact sign of each triangle's area, (m,): 1 counter-clockwise, -1 clockwise, else 0.

    A triangle that is not finite has sign 0, as a flat one.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    with np.errstate(over="ignore", invalid="ignore"):  # beyond the range of floats: unsure
        left = (a[:, 0] - c[:, 0]) * (b[:, 1] - c[:, 1])
        right = (a[:, 1] - c[:, 1]) * (b[:, 0] - c[:, 0])
        difference, magnitude = left - right, np.abs(left) + np.abs(right)
    unsure = ~(np.abs(difference) > _ORIENTATION_BOUND * magnitude)
    signs = np.sign(np.where(unsure, 0, difference)).astype(int)
    finite = np.isfinite(triangles).all((1, 2))
    for i in np.flatnonzero(unsure & finite):  # few: nearly collinear corners
        signs[i] = _exact_orientation(triangles[i])
    return signs


def _exact_orientation(triangle: np.ndarray) -> int:
    (ax, ay), (bx, by), (cx, cy) = [[Fraction(float(x)) for x in corner] for corner in triangle]
    area = (ax - cx) * (by - cy) - (ay - cy) * (bx - cx)
    return (area > 0) - (area < 0)


def is_simple(polygon: Float[np.ndarray, "b 2"], at_once: int = 2**20) -> bool:
    """Whether a closed polygon's edges meet only at shared corners, decided exactly.

    Looks at the pairs of edges whose bounding boxes meet, so many candidates at once.
    """
    ends = np.roll(polygon, -1, axis=0)
    pairs = _meeting_boxes(np.minimum(polygon, ends), np.maximum(polygon, ends), at_once)
    return not any(_any_improper_contact(polygon, i, j) for i, j in pairs)


def boxes_apart(low: Float[np.ndarray, "k 2"], high: Float[np.ndarray, "k 2"]) -> bool:
    """Whether no two of the boxes with these lower and upper corners have a common point."""
    return all(len(i) == 0 for i, _ in _meeting_boxes(low, high))


def _meeting_boxes(
    low: np.ndarray, high: np.ndarray, at_once: int = 2**20
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs i < j of boxes that have a common point, some at a time.

    In the order of their left sides, those that begin before box p ends follow p without a gap.
    """
    order = np.argsort(low[:, 0], kind="stable")
    position = np.arange(len(low))
    followers = np.searchsorted(low[order, 0], high[order, 0], side="right") - position - 1
    total = np.cumsum(followers)
    for start in range(0, int(total[-1]), at_once):
        k = np.arange(start, min(start + at_once, total[-1]))  # of all pairs
        p = np.searchsorted(total, k, side="right")
        i, j = order[p], order[p + 1 + k - (total[p] - followers[p])]
        meet = (low[i, 1] <= high[j, 1]) & (low[j, 1] <= high[i, 1])
        yield np.minimum(i, j)[meet], np.maximum(i, j)[meet]


def _any_improper_contact(polygon: np.ndarray, i: np.ndarray, j: np.ndarray) -> bool:
    """Whether any edge i meets its edge j > i other than at the corner that neighbours share."""
    n = len(polygon)
    a, b, c, d = (polygon[k % n] for k in (i, i + 1, j, j + 1))
    adjacent = (j == i + 1) | ((i == 0) & (j == n - 1))
    apart = ~adjacent
    if _segments_meet(a[apart], b[apart], c[apart], d[apart]).any():
        return True
    # Neighbours share a corner; they overlap if collinear and folded back.
    shared = np.where((j == i + 1)[:, None], b, a)[adjacent]
    first = np.where((j == i + 1)[:, None], a, b)[adjacent]
    other = np.where((j == i + 1)[:, None], d, c)[adjacent]
    collinear = orientations(np.stack([first, shared, other], axis=1)) == 0
    # The signs of the products, which at extreme scales leave the range of floats.
    folded = (np.sign(first - shared) * np.sign(other - shared)).sum(-1) >= 0
    return bool((collinear & folded).any())


def _segments_meet(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Whether closed segments ab and cd, whose bounding boxes meet, have a common point.

    They do unless one lies strictly on one side of the other's line.
    """
    abc, abd, cda, cdb = (
        orientations(np.stack(corners, axis=1))
        for corners in ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    )
    return (abc * abd <= 0) & (cda * cdb <= 0)
