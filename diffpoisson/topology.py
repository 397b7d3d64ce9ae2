"""Connectivity of triangle meshes, as functions of the (m, 3) array of faces alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse import csgraph


def half_edges(faces: np.ndarray) -> np.ndarray:
    """(3m, 2) directed edges, all first edges, then all second, then all third."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def undirected_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) sorted unique edges, and the number of faces at each."""
    edges = np.sort(half_edges(faces), axis=1)
    _, first, counts = np.unique(_keys(edges), return_index=True, return_counts=True)
    return edges[first], counts


def component_labels(cells: np.ndarray, n_vertices: int) -> np.ndarray:
    """Component of each vertex; cells (m, k) that share a vertex are connected."""
    links = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    graph = sp.coo_matrix((np.ones(len(links[0])), links), shape=(n_vertices,) * 2)
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


class Part(NamedTuple):
    """A connected component: indices of its cells and vertices, and the cells renumbered."""

    cells: np.ndarray
    vertices: np.ndarray
    renumbered: np.ndarray


def connected_parts(cells: np.ndarray, n_vertices: int) -> list[Part]:
    """The connected components, in the order of their first vertices."""
    of_vertex = component_labels(cells, n_vertices)
    of_cell = of_vertex[cells[:, 0]]
    sizes = np.bincount(of_vertex)
    starts = np.cumsum(sizes) - sizes
    order = np.argsort(of_vertex, kind="stable")
    position = np.empty(n_vertices, dtype=np.int64)  # within the component
    position[order] = np.arange(n_vertices) - np.repeat(starts, sizes)
    by_part = np.argsort(of_cell, kind="stable")
    cell_groups = np.split(by_part, np.cumsum(np.bincount(of_cell))[:-1])
    vertex_groups = np.split(order, starts[1:])
    return [Part(c, v, position[cells[c]]) for c, v in zip(cell_groups, vertex_groups, strict=True)]


def is_manifold(faces: np.ndarray, n_vertices: int) -> bool:
    """Whether edges have at most two, consistently oriented faces and vertices one fan of faces."""
    directed = half_edges(faces)
    if len(np.unique(_keys(directed))) < len(directed):
        return False
    return _count_fans(faces) == n_vertices


def boundary_half_edges(faces: np.ndarray) -> np.ndarray:
    """(b, 2) half-edges of the edges that have one face."""
    edges, counts = undirected_edges(faces)
    directed = half_edges(faces)
    return directed[are_among(directed, edges[counts == 1])]


def are_among(edges: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(k,) whether each of the edges (k, 2), in whatever direction, is one of the others (l, 2)."""
    return np.isin(_keys(np.sort(edges, axis=1)), _keys(np.sort(others, axis=1)))


def cycles(tails: np.ndarray, heads: np.ndarray) -> list[np.ndarray]:
    """Vertex cycles of a graph in which each vertex has one successor, longest first."""
    if len(tails) == 0:
        return []
    size = int(max(tails.max(), heads.max())) + 1
    graph = sp.csr_matrix((np.ones(len(tails)), (tails, heads)), shape=(size, size))
    labels = csgraph.connected_components(graph, directed=False)[1]
    starts = tails[np.unique(labels[tails], return_index=True)[1]]
    loops = [csgraph.depth_first_order(graph, s, return_predecessors=False) for s in starts]
    return sorted((loop.astype(np.int64) for loop in loops), key=len, reverse=True)


def _count_fans(faces: np.ndarray) -> int:
    """Number of face fans around all vertices, of a mesh whose half-edges are unique.

    Corners are glued where their faces share an edge; a vertex is manifold if all its corners
    become one.
    """
    m = len(faces)
    tails, heads = half_edges(faces).T
    tail_corner = np.arange(3 * m)
    head_corner = np.roll(tail_corner, -m)  # the next corner of the same face
    # Half-edge index + 1 at (tail, head), so that 0 means none.
    index = sp.csr_matrix((tail_corner + 1, (tails, heads)), shape=(faces.max() + 1,) * 2)
    opposite = np.asarray(index[heads, tails]).ravel() - 1
    inner = np.flatnonzero(opposite >= 0)
    pairs = (tail_corner[inner], head_corner[opposite[inner]])
    glue = sp.coo_matrix((np.ones(len(inner)), pairs), shape=(3 * m, 3 * m))
    return int(csgraph.connected_components(glue, directed=False)[0])


def _keys(edges: np.ndarray) -> np.ndarray:
    """One integer per (i, j), injective for indices below 2³¹."""
    return edges[:, 0] * np.int64(2**31) + edges[:, 1]
