"""Connectivity against brute force and libigl."""

from __future__ import annotations

from collections import Counter

import igl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffpoisson import testing, topology

names = pytest.mark.parametrize("name", testing.TRIANGULAR)


@st.composite
def arbitrary_cells(draw) -> tuple[np.ndarray, int]:
    """Any cells of distinct vertices, sense or not, with isolated vertices."""
    n, k = draw(st.integers(4, 12)), draw(st.sampled_from([3, 4]))
    cell = st.permutations(range(n)).map(lambda order: order[:k])
    return np.array(draw(st.lists(cell, min_size=1, max_size=8))), n


@given(arbitrary_cells())
def test_components_against_repeated_union(drawn):
    faces, n = drawn
    groups = [{v} for v in range(n)]
    for face in faces:
        touched = [group for group in groups if group & set(face)]
        groups = [group for group in groups if group not in touched] + [set().union(*touched)]
    labels = topology.component_labels(faces, n)
    assert labels.dtype == np.int64
    assert {frozenset(np.flatnonzero(labels == i)) for i in range(labels.max() + 1)} == set(
        map(frozenset, groups)
    )
    # In the order of their first vertices: unions of meshes rely on it.
    first = [np.flatnonzero(labels == i)[0] for i in range(labels.max() + 1)]
    assert first == sorted(first)


@names
def test_edges_and_boundary_by_counting(name):
    _, faces = testing.TRIANGULAR[name](0)
    half_edges = [(f[i], f[(i + 1) % 3]) for f in faces.tolist() for i in range(3)]
    assert sorted(map(tuple, topology.half_edges(faces).tolist())) == sorted(half_edges)
    counts = Counter(tuple(sorted(edge)) for edge in half_edges)
    edges, found = topology.undirected_edges(faces)
    assert dict(zip(map(tuple, edges.tolist()), found.tolist(), strict=True)) == dict(counts)
    expected = [edge for edge in half_edges if counts[tuple(sorted(edge))] == 1]
    assert sorted(map(tuple, topology.boundary_half_edges(faces).tolist())) == sorted(expected)


@pytest.mark.parametrize("n", [9, 200, 2**31])
def test_edges_in_lexicographic_order(n):
    """Of few vertices, which share edges, and of indices as large as the keys allow."""
    faces = np.random.default_rng(0).integers(n, size=(300, 3))
    faces[::2, 1] = faces[1::2, 0]  # some first vertices are shared, however large n is
    edges, counts = topology.undirected_edges(faces)
    every = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    expected = np.unique(every, axis=0, return_counts=True)
    assert np.array_equal(edges, expected[0])
    assert np.array_equal(counts, expected[1])


@given(arbitrary_cells())
def test_manifold_by_brute_force(drawn):
    """Edges once in each direction at most, and the faces of each vertex one fan."""
    faces, _ = drawn
    faces = np.unique(faces[:, :3], return_inverse=True)[1].reshape(-1, 3)  # no isolated vertices
    n = int(faces.max()) + 1
    directed = Counter((f[i], f[(i + 1) % 3]) for f in faces.tolist() for i in range(3))
    expected = max(directed.values()) == 1
    if expected:
        for v in range(n):
            around = [frozenset(f) - {v} for f in faces.tolist() if v in f]
            reached = [around.pop()]
            for link in reached:
                joined = [other for other in around if other & link]
                reached += joined
                around = [other for other in around if other not in joined]
            expected &= not around
    assert topology.is_manifold(faces, n) == expected


def test_a_manifold_is_one_whichever_edge_comes_first():
    """Two faces, all of whose vertices are at the boundary: each of their fans counts one edge."""
    for i, j in np.ndindex(3, 3):
        for faces in ([[0, 1, 2], [1, 0, 3]], [[1, 0, 3], [0, 1, 2]]):
            turned = np.array([np.roll(faces[0], i), np.roll(faces[1], j)])
            assert topology.is_manifold(turned, 4)


@names
def test_manifold_against_libigl(name):
    vertices, faces = testing.TRIANGULAR[name](0)
    if name in ("moebius", "clockwise_disk"):
        assert not topology.is_manifold(faces, len(vertices))  # no consistent orientation
        return
    edges = igl.is_edge_manifold(faces)
    edges = edges if isinstance(edges, bool) else edges[0]
    corners = np.asarray(igl.is_vertex_manifold(faces)).all()
    assert topology.is_manifold(faces, len(vertices)) == bool(edges and corners)


def test_cycles():
    order = np.random.default_rng(0).permutation(12)
    loops = order[:3], order[3:10], order[10:]
    tails = np.concatenate(loops)
    heads = np.concatenate([np.roll(loop, -1) for loop in loops])
    shuffle = np.random.default_rng(1).permutation(12)
    found = topology.cycles(tails[shuffle], heads[shuffle])
    assert [len(loop) for loop in found] == [7, 3, 2]
    successor = dict(zip(tails, heads, strict=True))
    for loop in found:
        assert [successor[v] for v in loop] == np.roll(loop, -1).tolist()
    assert topology.cycles(np.zeros(0, dtype=int), np.zeros(0, dtype=int)) == []
