"""Disk patches of a mesh: the faces nearest to a random one, cleaned, kept if a disk, aligned.

Nearest is meant along the surface: the shortest path through faces, from centroid to centroid by
way of the midpoint of the shared edge. Islands that a patch encloses belong to it. Alignment
follows NJF: unit area, centred, mean normal along +z, then turned in the plane to the principal
axes. The identity Jacobian then is the projection to the plane.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph

from diffpoisson.mesh import Mesh, MeshError


class PatchRejectedError(Exception):
    """A patch that must not enter the data set; the message is the reason, to count it by."""


@dataclass(frozen=True)
class PatchOptions:
    """Which patches are grown and kept.

    Attributes:
        min_faces: smallest patch, after cleaning.
        max_faces: largest patch.
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
        mesh: the disk, its float64 vertices rounded to float32, as they are stored.
        flatness: |Σ nA| / ΣA, 1 where the patch is flat.
    """

    mesh: Mesh
    flatness: float


class PatchSampler:
    """Grows random patches on one mesh; the graph of its faces is made once.

    Args:
        vertices: (n, 3) float64 positions.
        faces: (m, 3) int64, as `Mesh` accepts them.
        options: allowed sizes and filters.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, options: PatchOptions) -> None:
        self.vertices, self.faces, self.options = vertices, faces, options
        self.graph = dual_graph(vertices, faces)
        self.component = csgraph.connected_components(self.graph)[1]
        self.component_sizes = np.bincount(self.component)
        self.spacing = self.graph.data.mean() if self.graph.nnz else 0.0

    def sample(self, rng: np.random.Generator) -> Patch:
        """One patch: uniform seed face, uniform size among those allowed.

        Raises:
            PatchRejectedError: this patch is not wanted; draw again.
        """
        seed_face = int(rng.integers(len(self.faces)))
        smallest, largest = self.options.min_faces, self.options.max_faces
        largest = min(largest, int(self.component_sizes[self.component[seed_face]]))
        if largest < smallest:
            raise PatchRejectedError("component too small")
        return self._cut(self.nearest(seed_face, int(rng.integers(smallest, largest + 1))))

    def nearest(self, seed_face: int, size: int) -> np.ndarray:
        """(size,) the faces nearest to one, itself first; its component must have as many."""
        # A disk of k even faces, two per cell of this spacing, is about √k spacings wide. Only
        # the time depends on the guess.
        limit = self.spacing * np.sqrt(size) + np.finfo(np.float64).tiny
        while True:
            distance = csgraph.dijkstra(self.graph, indices=seed_face, limit=limit)
            reached = np.flatnonzero(np.isfinite(distance))
            if len(reached) >= size:
                return reached[np.argsort(distance[reached], kind="stable")[:size]]
            limit *= 2

    def _cut(self, chosen: np.ndarray) -> Patch:
        """Clean, fill, check and align the patch of the faces chosen."""
        kept = chosen[clean_boundary(self.faces[chosen])]
        if len(kept) and defect(self.faces[kept]) == "has holes":
            kept = np.concatenate([kept, self._enclosed(kept)])
            kept = kept[clean_boundary(self.faces[kept])]
        if len(kept) < self.options.min_faces:
            raise PatchRejectedError("too few faces after cleaning")
        if (reason := defect(self.faces[kept])) is not None:
            raise PatchRejectedError(reason)
        used, faces = np.unique(self.faces[np.sort(kept)], return_inverse=True)
        vertices, flatness = align(self.vertices[used], faces.reshape(-1, 3))
        if flatness < self.options.min_flatness:
            raise PatchRejectedError("not flat enough")
        mesh = rounded_mesh(vertices, faces.reshape(-1, 3))
        if not mesh.is_disk:
            raise PatchRejectedError("not manifold")
        return Patch(mesh, flatness)

    def _enclosed(self, kept: np.ndarray) -> np.ndarray:
        """Faces of the islands around which a patch has grown, if there is room for all of them.

        All parts of the component's rest are islands except the largest.
        """
        outside = self.component == self.component[kept[0]]
        outside[kept] = False
        rest = np.flatnonzero(outside)
        if not len(rest):
            return rest
        part = csgraph.connected_components(self.graph[rest][:, rest])[1]
        islands = rest[part != np.bincount(part).argmax()]
        return islands if len(kept) + len(islands) <= self.options.max_faces else islands[:0]


def dual_graph(vertices: np.ndarray, faces: np.ndarray) -> sp.csr_matrix:
    """(m, m) graph of the faces that share an edge with no third face, weighted by distance."""
    edges = _edges(faces)
    f, g = edges.neighbours
    i, j = edges.ends[edges.n_faces == 2].T
    midpoints = (vertices[i] + vertices[j]) / 2
    centroids = vertices[faces].mean(axis=1)
    lengths = np.linalg.norm(centroids[f] - midpoints, axis=1)
    lengths += np.linalg.norm(centroids[g] - midpoints, axis=1)
    both = np.r_[f, g], np.r_[g, f]
    return sp.csr_matrix((np.r_[lengths, lengths], both), shape=(len(faces), len(faces)))


def clean_boundary(faces: np.ndarray) -> np.ndarray:
    """The largest edge-connected part left after removing ears and faces at pinched vertices.

    An ear hangs on by one edge; a pinched vertex is one the boundary passes twice. Removing either
    can expose new ones, so this repeats until there are none.

    Returns:
        (k,) ascending indices of the faces that are left.
    """
    kept = np.arange(len(faces))
    while len(kept):
        good = _clean_step(faces[kept])
        if good.all():
            break
        kept = kept[good]
    return kept


def defect(faces: np.ndarray) -> str | None:
    """Why the faces, edge-connected and without pinched vertices, are no disk; None if they are."""
    edges = _edges(faces)
    # In a consistently oriented manifold, an inner edge has one face on its left, one on its right.
    forward = faces < np.roll(faces, -1, axis=1)
    n_left = np.bincount(edges.of_face.ravel(), weights=forward.ravel())
    if (edges.n_faces > 2).any() or (n_left[edges.n_faces == 2] != 1).any():
        return "not manifold"
    boundary = edges.ends[edges.n_faces == 1]
    if not len(boundary):
        return "closed"
    rim, index = np.unique(boundary, return_inverse=True)
    links = index.reshape(-1, 2).T
    graph = sp.coo_matrix((np.ones(len(boundary)), links), shape=(len(rim), len(rim)))
    if csgraph.connected_components(graph, directed=False)[0] > 1:
        return "has holes"
    euler = len(np.unique(faces)) - len(edges.n_faces) + len(faces)
    return None if euler == 1 else "has a handle"


def rounded_mesh(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """The mesh with its positions rounded to float32, in float64.

    Raises:
        PatchRejectedError: rounding turns a face over, or leaves it no area.
    """
    positions = vertices.astype(np.float32).astype(np.float64)
    turned = (_area_vectors(vertices, faces) * _area_vectors(positions, faces)).sum(axis=1) <= 0
    if turned.any():
        raise PatchRejectedError("rounding")
    try:
        return Mesh(positions, faces)
    except MeshError:
        raise PatchRejectedError("rounding") from None


def has_pose(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the area vectors leave a mean normal.

    Those of a closed surface cancel, also if it was cut open, but for the rounding of m terms.
    """
    area_vectors = _area_vectors(vertices, faces)
    total = np.linalg.norm(area_vectors, axis=1).sum()
    rounding = len(faces) * np.finfo(np.float64).eps * total
    return bool(np.linalg.norm(area_vectors.sum(axis=0)) > rounding)


def align(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, float]:
    """Vertices in the canonical pose, which no rotation, translation or scaling of them changes.

    Area one, area-weighted mean of the face centroids at the origin, area-weighted mean normal
    along +z, x the direction of largest second moment in the plane. A half turn remains free: it
    is chosen so that the larger of the third moments in x and y is positive.

    Returns:
        (n, 3) aligned vertices, and the flatness |Σ nA| / ΣA.

    Raises:
        PatchRejectedError: there is no such pose, see `has_pose`.
    """
    corners = vertices[faces]
    area_vectors = _area_vectors(vertices, faces)
    areas = np.linalg.norm(area_vectors, axis=1)
    mean_normal = area_vectors.sum(axis=0)
    flatness = np.linalg.norm(mean_normal) / areas.sum()
    if not has_pose(vertices, faces):
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


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2


# -------------------------------------------------------------------- topology


class _Edges(NamedTuple):
    """Undirected edges of faces.

    Attributes:
        ends: (e, 2) their vertices.
        n_faces: (e,) how many faces share each.
        of_face: (m, 3) the edges of each face.
    """

    ends: np.ndarray
    n_faces: np.ndarray
    of_face: np.ndarray

    @property
    def neighbours(self) -> np.ndarray:
        """(2, k) the two faces at each edge that has two."""
        order = np.argsort(self.of_face, axis=None, kind="stable") // 3
        first = (self.n_faces.cumsum() - self.n_faces)[self.n_faces == 2]
        return np.stack([order[first], order[first + 1]])


def _edges(faces: np.ndarray) -> _Edges:
    pairs = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    n = np.int64(faces.max() + 1 if len(faces) else 1)
    # One integer per edge sorts many times faster than pairs do.
    keys, of_face, n_faces = np.unique(
        pairs[:, 0] * n + pairs[:, 1], return_inverse=True, return_counts=True
    )
    return _Edges(np.stack([keys // n, keys % n], axis=1), n_faces, of_face.reshape(-1, 3))


def _clean_step(faces: np.ndarray) -> np.ndarray:
    """(m,) which faces to keep: the largest part; if there is one, no ears; if none, no pinches."""
    edges = _edges(faces)
    f, g = edges.neighbours
    graph = sp.coo_matrix((np.ones(len(f)), (f, g)), shape=(len(faces), len(faces)))
    n_parts, part = csgraph.connected_components(graph, directed=False)
    if n_parts > 1:
        return np.asarray(part == np.bincount(part).argmax())
    ear = (edges.n_faces[edges.of_face] == 2).sum(axis=1) < 2
    if ear.any():
        return ~ear
    rim, passes = np.unique(edges.ends[edges.n_faces == 1], return_counts=True)
    return np.asarray(~np.isin(faces, rim[passes > 2]).any(axis=1))
