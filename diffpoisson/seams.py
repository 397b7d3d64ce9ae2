"""Cut a surface open: along seams, into disks that flatten well.

1. Sheets that meet in a non-manifold edge, fans that meet in a pinched vertex, and faces whose
   orientations disagree across an edge are separated (libigl).
2. Each component is cut along a graph that leaves a disk (libigl), a sphere along a path between
   two vertices that are far from each other.
3. Such seams are as short as topology allows, and the map would be stretched beyond use. So they
   are extended as in Gu, Gortler and Hoppe, "Geometry images", 2002: flatten, cut along the
   shortest path of edges to the seam from where that promises most, and repeat while it pays. To
   flatten, ten local/global iterations on the ARAP energy (Liu et al. 2008) are enough: that
   energy is finite also at flips, cheap, and predicts the distortion that SLIM ends with.
"""

from __future__ import annotations

from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from scipy.sparse import csgraph
from torch import Tensor

from diffpoisson import topology
from diffpoisson.distortion import arap
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh
from diffpoisson.parameterization import harmonic_disk
from diffpoisson.poisson import PoissonSolver
from diffpoisson.repair import clamp_singular_values

# Seams end once the area-weighted mean of Σ (σ - 1)² is this small: a symmetric Dirichlet energy of
# about 4.2. Or if so many cuts in a row have lowered it by less than that fraction.
_GOOD_ENOUGH = 0.05
_PATIENCE, _WORTHWHILE = 3, 0.1
_LOCAL_GLOBAL_ITERATIONS = 10


class CutMesh(NamedTuple):
    """What `cut_to_disks` returns.

    Attributes:
        mesh: the same faces in the same order; vertices on seams are repeated, after the others.
        vertex_map: (n',) int64, the vertex of the uncut mesh that each vertex is a copy of.
    """

    mesh: Mesh
    vertex_map: Tensor


def cut_to_disks(mesh: Mesh, *, max_cuts: int = 30) -> CutMesh:
    """Cut a surface so that each connected component is a disk which flattens with low distortion.

    Args:
        mesh: any triangle mesh in space.
        max_cuts: how often the seam of a component may be extended.

    Returns:
        The cut mesh; `mesh` itself if nothing had to be cut.
    """
    faces, copied = igl.split_nonmanifold(mesh.faces.cpu().numpy())
    vertices = mesh.vertices.cpu().double().numpy()
    pieces, n_copies = [], 0
    for part in topology.connected_parts(faces, len(copied)):
        origin = copied[part.vertices]
        piece = _Piece(Mesh(vertices[origin], part.renumbered), origin)
        pieces.append(_extended(_opened(piece), max_cuts))
        faces[part.cells] = pieces[-1].mesh.faces.numpy() + n_copies
        n_copies += pieces[-1].mesh.n_vertices
    if n_copies == mesh.n_vertices:
        return CutMesh(mesh, torch.arange(mesh.n_vertices, device=mesh.device))
    faces, origin = _renumbered(faces, np.concatenate([piece.vertex_map for piece in pieces]))
    vertex_map = torch.from_numpy(origin).to(mesh.device)
    cut = Mesh(mesh.vertices[vertex_map], torch.from_numpy(faces).to(mesh.device))
    return CutMesh(cut, vertex_map)


class _Piece(NamedTuple):
    """A connected surface under the knife, and the input's vertex that each of its copies."""

    mesh: Mesh
    vertex_map: np.ndarray

    def cut(self, edges: np.ndarray) -> tuple[_Piece, np.ndarray]:
        """The piece cut along edges (e, 2), and its vertex that each vertex then copies."""
        faces = self.mesh.faces.numpy()
        on_seam = topology.are_among(topology.half_edges(faces), edges)
        flags = np.ascontiguousarray(on_seam.reshape(3, -1).T)
        vertices, faces, copied = igl.cut_mesh(self.mesh.vertices.numpy(), faces, flags)
        return _Piece(Mesh(vertices, faces), self.vertex_map[copied]), copied


def _opened(piece: _Piece) -> _Piece:
    """The piece as a disk, by seams that topology alone decides."""
    mesh = piece.mesh
    if mesh.is_disk:
        return piece
    if mesh.euler_characteristic == 2:
        paths = [_path_across(mesh)]
    else:
        paths = [np.array(path) for path in igl.cut_to_disk(mesh.faces.numpy())]
    return piece.cut(np.concatenate([_edges_of(path) for path in paths]))[0]


def _extended(piece: _Piece, max_cuts: int) -> _Piece:
    """A disk whose seam was extended while that lowered the distortion of flattening it."""
    pieces, energies, uv = [piece], [], harmonic_disk(piece.mesh)
    while True:
        mesh = pieces[-1].mesh
        uv = _local_global(mesh, uv)
        density = arap(jacobians(mesh, uv))
        energies.append(float((mesh.areas * density).sum() / mesh.areas.sum()))
        if energies[-1] > (1 - _WORTHWHILE) * min(energies[:-_PATIENCE], default=np.inf):
            return pieces[-1 - _PATIENCE]
        path = _path_to_seam(mesh, density)
        if energies[-1] <= _GOOD_ENOUGH or len(pieces) > max_cuts or len(path) == 1:
            return pieces[-1]
        cut, copied = pieces[-1].cut(_edges_of(path))
        pieces.append(cut)
        uv = uv[torch.from_numpy(copied)]


def _local_global(mesh: Mesh, uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Descend on the ARAP energy: fit rotations to the Jacobians, a map to the rotations."""
    solver = PoissonSolver(mesh)
    for _ in range(_LOCAL_GLOBAL_ITERATIONS):
        uv = solver(clamp_singular_values(jacobians(mesh, uv), 1.0, 1.0))
    return uv


# -------------------------------------------------------------------- paths


def _path_across(mesh: Mesh) -> np.ndarray:
    """A shortest path between far vertices of a closed surface, of at least two edges.

    At the ends of a seam nothing comes apart, so that one edge alone would stay closed.
    """
    graph = _edge_graph(mesh)
    start = int(csgraph.dijkstra(graph, indices=0).argmax())
    distance, before = csgraph.dijkstra(graph, indices=start, return_predecessors=True)
    path = _walk_back(before, int(distance.argmax()))
    if len(path) == 2:
        faces = mesh.faces.numpy()
        beside = faces[np.isin(faces, path).sum(axis=1) == 2][0]
        path = np.r_[path, np.setdiff1d(beside, path)]
    return path


def _path_to_seam(mesh: Mesh, density: Float[Tensor, "m"]) -> np.ndarray:
    """The shortest path to the boundary that promises most as a cut.

    That is the one whose length times the integral of the distortion along it is largest; a single
    vertex if none is inside.
    """
    boundary = mesh.boundary_loops[0].numpy()
    distance, before, _ = csgraph.dijkstra(
        _edge_graph(mesh), indices=boundary, min_only=True, return_predecessors=True
    )
    around = mesh.sum_at_vertices((mesh.areas * density)[:, None] / 3)[:, 0] / mesh.vertex_areas
    before_or_self = np.where(before < 0, np.arange(mesh.n_vertices), before)
    steps = around.numpy() * (distance - distance[before_or_self])
    promise = distance * _sums_to_the_root(before_or_self, steps)
    return _walk_back(before, int(promise.argmax()))


def _sums_to_the_root(parent: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum of the values from each node of a forest up to its root, whose own value is zero.

    By doubling: each node knows the sum below an ancestor, first its parent, then twice as far.
    """
    total, ancestor = values, parent
    while not np.array_equal(ancestor, parent[ancestor]):
        total, ancestor = total + total[ancestor], ancestor[ancestor]
    return total


def _walk_back(before: np.ndarray, end: int) -> np.ndarray:
    """The path that ends in a vertex, from each vertex's predecessor, negative at the source."""
    path = [end]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path)


def _edges_of(path: np.ndarray) -> np.ndarray:
    return np.stack([path[:-1], path[1:]], axis=1)


def _edge_graph(mesh: Mesh) -> sp.csr_matrix:
    """The graph of the edges, weighted by their lengths."""
    a, b = topology.undirected_edges(mesh.faces.numpy())[0].T
    lengths = torch.linalg.vector_norm(mesh.vertices[a] - mesh.vertices[b], dim=1).numpy()
    ends = np.r_[a, b], np.r_[b, a]
    return sp.csr_matrix((np.r_[lengths, lengths], ends), shape=(mesh.n_vertices,) * 2)


def _renumbered(faces: np.ndarray, vertex_map: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the first copy of each vertex like the vertex, the others after all of these."""
    again = np.ones(len(vertex_map), dtype=bool)
    again[np.unique(vertex_map, return_index=True)[1]] = False
    order = np.lexsort((vertex_map, again))
    return np.argsort(order)[faces], vertex_map[order]
