"""Disk patches of a mesh: grown to a random geodesic radius, cleaned, kept if a disk, aligned.

Geodesic distance is the shortest path through faces, from centroid to centroid by way of the
midpoint of the shared edge. Alignment follows NJF: unit area, centred, mean normal along +z, then
turned in the plane to the principal axes. The identity Jacobian then is the projection to the
plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from diffpoisson.mesh import Mesh


class PatchRejectedError(Exception):
    """A patch that must not enter the data set; the message is the reason, to count it by."""


@dataclass(frozen=True)
class PatchOptions:
    """Which patches are grown and kept.

    Attributes:
        min_faces: smallest patch, after cleaning.
        max_faces: largest patch, before cleaning.
        min_flatness: reject patches with |Σ nA| / ΣA below this (1 is flat); 0 keeps all.
        attempts: draws for one patch before giving up.
    """

    min_faces: int = 500
    max_faces: int = 2000
    min_flatness: float = 0.0
    attempts: int = 10


@dataclass(frozen=True, eq=False)
class Patch:
    """A disk of unit area in the aligned pose.

    Attributes:
        vertices: (n, 3) float64.
        faces: (m, 3) int64.
        flatness: |Σ nA| / ΣA, 1 where the patch is flat.
        radius: geodesic radius it was grown to, in units of the patch.
    """

    vertices: np.ndarray
    faces: np.ndarray
    flatness: float
    radius: float


class PatchSampler:
    """Grows random patches on one mesh.

    Args:
        vertices: (n, 3) float64 positions.
        faces: (m, 3) int64, as `Mesh` accepts them.
        options: allowed sizes and filters.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, options: PatchOptions) -> None:
        self.vertices, self.faces, self.options = vertices, faces, options
        self.graph = dual_graph(vertices, faces)

    def sample(self, rng: np.random.Generator) -> Patch:
        """One patch: uniform seed face, uniform radius among those that give an allowed size.

        Raises:
            PatchRejectedError: this patch is not wanted; draw again.
        """
        seed_face = rng.integers(len(self.faces))
        distance = csgraph.dijkstra(self.graph, directed=False, indices=seed_face)
        reachable = np.sort(distance[np.isfinite(distance)])
        smallest, largest = self.options.min_faces, min(self.options.max_faces, len(reachable))
        if largest < smallest:
            raise PatchRejectedError("component too small")
        radius = rng.uniform(reachable[smallest - 1], reachable[largest - 1])
        return self._cut(distance <= radius, float(radius))

    def _cut(self, inside: np.ndarray, radius: float) -> Patch:
        """Clean, check and align the patch of the faces inside."""
        kept = clean_boundary(self.faces[inside])
        if len(kept) < self.options.min_faces:
            raise PatchRejectedError("too few faces after cleaning")
        mesh = Mesh.cleaned(self.vertices, kept).mesh
        _require_disk(mesh)
        vertices, flatness = align(mesh.vertices.numpy(), mesh.faces.numpy())
        if flatness < self.options.min_flatness:
            raise PatchRejectedError("not flat enough")
        scale = math.sqrt(mesh.areas.sum())
        return Patch(vertices, mesh.faces.numpy(), flatness, radius / scale)


def dual_graph(vertices: np.ndarray, faces: np.ndarray) -> sp.csr_matrix:
    """(m, m) graph of the faces that share an edge with no third face, weighted by distance."""
    f, g, i, j = _inner_edges(faces)
    midpoints = (vertices[i] + vertices[j]) / 2
    centroids = vertices[faces].mean(axis=1)
    lengths = np.linalg.norm(centroids[f] - midpoints, axis=1)
    lengths += np.linalg.norm(centroids[g] - midpoints, axis=1)
    return sp.csr_matrix((lengths, (f, g)), shape=(len(faces), len(faces)))


def clean_boundary(faces: np.ndarray) -> np.ndarray:
    """The largest edge-connected part left after removing ears and faces at pinched vertices.

    An ear hangs on by one edge; a pinched vertex is one the boundary passes twice. Removing either
    can expose new ones, so this repeats until there are none.
    """
    while len(faces):
        kept = _largest_part(faces)
        kept = kept[~_is_ear(kept)]
        kept = kept[~np.isin(kept, _pinched_vertices(kept)).any(axis=1)]
        if len(kept) == len(faces):
            break
        faces = kept
    return faces


def align(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, float]:
    """Vertices in the canonical pose, which no rotation, translation or scaling of them changes.

    Area one, area-weighted mean of the face centroids at the origin, area-weighted mean normal
    along +z, x the direction of largest second moment in the plane. A half turn remains free: it
    is chosen so that the larger of the third moments in x and y is positive.

    Returns:
        (n, 3) aligned vertices, and the flatness |Σ nA| / ΣA.

    Raises:
        PatchRejectedError: the mean normal vanishes, so there is no canonical direction.
    """
    corners = vertices[faces]
    area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas = np.linalg.norm(area_vectors, axis=1)
    mean_normal = area_vectors.sum(axis=0)
    flatness = np.linalg.norm(mean_normal) / areas.sum()
    if flatness == 0:
        raise PatchRejectedError("no mean normal")
    weights = areas / areas.sum()
    centroids = corners.mean(axis=1)
    centre = weights @ centroids
    centroids = (centroids - centre) / np.sqrt(areas.sum())

    z = mean_normal / np.linalg.norm(mean_normal)
    in_plane = centroids - np.outer(centroids @ z, z)
    # Ascending eigenvalues: z itself (zero), then the minor axis, then the major axis.
    x = np.linalg.eigh((weights[:, None] * in_plane).T @ in_plane)[1][:, 2]
    pose = np.stack([x, np.cross(z, x), z], axis=1)
    third_moments = weights @ (centroids @ pose[:, :2]) ** 3
    if third_moments[np.abs(third_moments).argmax()] < 0:
        pose[:, :2] *= -1
    return (vertices - centre) / np.sqrt(areas.sum()) @ pose, float(flatness)


def _require_disk(mesh: Mesh) -> None:
    """Say what the patch is instead of a disk."""
    if mesh.is_disk:
        return
    if not mesh.is_manifold or mesh.n_components > 1:
        raise PatchRejectedError("not manifold")
    holes = len(mesh.boundary_loops)
    if holes == 0:
        raise PatchRejectedError("closed")
    raise PatchRejectedError("has holes" if holes > 1 else "has a handle")


# -------------------------------------------------------------------- topology


def _half_edges(faces: np.ndarray) -> np.ndarray:
    """(3m, 2) sorted vertex pairs; rows 3f … 3f + 2 belong to face f."""
    return np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)


def _inner_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Edges shared by exactly two faces, as (first face, second face, one vertex, other vertex)."""
    edges = _half_edges(faces)
    order = np.lexsort(edges.T)
    edges, owner = edges[order], order // 3
    same = (edges[1:] == edges[:-1]).all(axis=1)
    starts = np.flatnonzero(np.r_[True, ~same])
    pair = starts[np.diff(np.r_[starts, len(edges)]) == 2]
    return owner[pair], owner[pair + 1], edges[pair, 0], edges[pair, 1]


def _largest_part(faces: np.ndarray) -> np.ndarray:
    f, g, *_ = _inner_edges(faces)
    graph = sp.coo_matrix((np.ones(len(f)), (f, g)), shape=(len(faces), len(faces)))
    label = csgraph.connected_components(graph, directed=False)[1]
    return faces[label == np.bincount(label).argmax()]


def _is_ear(faces: np.ndarray) -> np.ndarray:
    f, g, *_ = _inner_edges(faces)
    return np.bincount(np.r_[f, g], minlength=len(faces)) < 2


def _pinched_vertices(faces: np.ndarray) -> np.ndarray:
    """Vertices at more than two boundary edges."""
    edges, counts = np.unique(_half_edges(faces), axis=0, return_counts=True)
    return np.flatnonzero(np.bincount(edges[counts == 1].ravel()) > 2)
