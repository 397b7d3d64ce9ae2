"""Small meshes of every topology as (vertices, faces) arrays, and hypothesis strategies over them.

Positions are float64 and generic (jittered, no symmetry), so that a test cannot pass by luck.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from hypothesis import strategies as st

Arrays = tuple[np.ndarray, np.ndarray]


# ------------------------------------------------------- one builder per topology


def triangle(seed: int = 0) -> Arrays:
    vertices = np.array([[0.0, 0, 0], [1, 0.1, 0.2], [0.3, 0.8, -0.1]])
    return vertices + 0.1 * np.random.default_rng(seed).standard_normal((3, 3)), _one_face()


def disk(seed: int = 0, size: int = 5) -> Arrays:
    """A jittered size × size grid, bent out of the plane."""
    vertices, faces = planar_disk(seed, size)
    return _bent(vertices), faces


def planar_disk(seed: int = 0, size: int = 5) -> Arrays:
    """A jittered grid of the unit square, D = 2, counter-clockwise; its boundary is not moved."""
    u, v = (x.ravel() for x in np.meshgrid(*2 * [np.linspace(0, 1, size)], indexing="ij"))
    vertices = np.stack([u, v], axis=1)
    inner = ((vertices > 0) & (vertices < 1)).all(axis=1)
    jitter = np.random.default_rng(seed).uniform(-1, 1, (inner.sum(), 2))
    vertices[inner] += 0.2 / (size - 1) * jitter
    return vertices, _quads(np.arange(size**2).reshape(size, size))


def clockwise_disk(seed: int = 0, size: int = 5) -> Arrays:
    """D = 2, every second face turned clockwise."""
    vertices, faces = planar_disk(seed, size)
    faces[::2] = faces[::2, [0, 2, 1]]
    return vertices, faces


def annulus(seed: int = 0, around: int = 7, across: int = 3) -> Arrays:
    angle, radius = _periodic(around), 1 + np.arange(across) / across
    flat = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    grid = np.arange(around * across).reshape(across, around)
    faces = _quads(np.concatenate([grid, grid[:, :1]], axis=1))
    return _jittered(_bent(flat.reshape(-1, 2)), seed), faces


def sphere(seed: int = 0, subdivisions: int = 1) -> Arrays:
    """A jittered ellipsoid."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.asarray(ball.vertices) * [1, 1.3, 0.7]
    return _jittered(vertices, seed), np.array(ball.faces, dtype=np.int64)


def torus(seed: int = 0, around: int = 7, across: int = 5) -> Arrays:
    u, v = np.meshgrid(_periodic(around), _periodic(across), indexing="ij")
    ring = 1.0 + 0.4 * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), 0.4 * np.sin(v)], axis=-1)
    grid = np.arange(around * across).reshape(around, across)
    grid = np.concatenate([grid, grid[:1]])
    faces = _quads(np.concatenate([grid, grid[:, :1]], axis=1))
    return _jittered(vertices.reshape(-1, 3), seed), faces


def moebius(seed: int = 0, around: int = 9) -> Arrays:
    """A strip with half a twist: one boundary, not orientable, hence no consistent faces."""
    u, v = np.meshgrid(_periodic(around), np.array([-0.3, 0, 0.3]), indexing="ij")
    ring = 1 + v * np.cos(u / 2)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), v * np.sin(u / 2)], axis=-1)
    grid = np.arange(3 * around).reshape(around, 3)
    return _jittered(vertices.reshape(-1, 3), seed), _quads(np.r_[grid, grid[:1, ::-1]])


def book(seed: int = 0) -> Arrays:
    """Three faces at one edge."""
    vertices = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0.4], [-0.5, 1, 0.6], [-0.6, -1, 0.5]])
    return _jittered(vertices, seed), np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])


def bowtie(seed: int = 0) -> Arrays:
    """Two triangles that share one vertex only."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0.2], [-1, 0, 0.1], [-1, -1, 0]])
    return _jittered(vertices, seed), np.array([[0, 1, 2], [0, 3, 4]])


def parts(seed: int = 0) -> Arrays:
    """A disk, an ellipsoid and a triangle, of different sizes, apart from each other."""
    vertices, faces = union(disk(seed, 4), sphere(seed), triangle(seed))
    sizes = np.repeat([1.0, 0.3, 2.0], [16, 42, 3])[:, None]
    return vertices * sizes + 4 * np.sqrt(sizes), faces


def union(*meshes: Arrays) -> Arrays:
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    return vertices, np.concatenate([f + s for (_, f), s in zip(meshes, starts, strict=False)])


SPATIAL: dict[str, Callable[[int], Arrays]] = {
    "triangle": triangle,
    "disk": disk,
    "annulus": annulus,
    "sphere": sphere,
    "torus": torus,
    "parts": parts,
    "moebius": moebius,
    "book": book,
    "bowtie": bowtie,
}
PLANAR: dict[str, Callable[[int], Arrays]] = {
    "planar_disk": planar_disk,
    "clockwise_disk": clockwise_disk,
}
TOPOLOGIES = SPATIAL | PLANAR


# ------------------------------------------------------- strategies


@st.composite
def meshes(draw: st.DrawFn, topologies: dict = TOPOLOGIES, max_log_aspect: float = 0.0) -> Arrays:
    """A mesh of a drawn topology, moved, scaled by 10^[-6, 6], stretched, and renumbered."""
    vertices, faces = topologies[draw(st.sampled_from(sorted(topologies)))](draw(seeds))
    rng = np.random.default_rng(draw(seeds))
    vertices[:, 0] *= 10.0 ** -draw(st.floats(0, max_log_aspect))
    vertices = (vertices + rng.standard_normal(vertices.shape[1])) @ rotation(rng, vertices).T
    vertices = vertices * 10.0 ** draw(st.floats(-6, 6))
    return renumbered(rng, vertices, faces)[:2]


seeds = st.integers(0, 2**16)


def rotation(rng: np.random.Generator, vertices: np.ndarray) -> np.ndarray:
    """A random rotation of the space the vertices lie in."""
    Q, _ = np.linalg.qr(rng.standard_normal(2 * vertices.shape[1:]))
    Q[0] *= np.sign(np.linalg.det(Q))
    return Q


def renumbered(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices and faces in random order, and the two permutations (new = old[permutation])."""
    p, q = rng.permutation(len(vertices)), rng.permutation(len(faces))
    return vertices[p], np.argsort(p)[faces][q], p, q


# ------------------------------------------------------- pieces of the builders


def _one_face() -> np.ndarray:
    return np.array([[0, 1, 2]])


def _quads(grid: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid of vertex indices."""
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _periodic(count: int) -> np.ndarray:
    return 2 * np.pi * np.arange(count) / count


def _bent(flat: np.ndarray) -> np.ndarray:
    return np.c_[flat, 0.3 * np.sin(2 * flat[:, 0]) + 0.2 * flat[:, 1] ** 2]


def _jittered(vertices: np.ndarray, seed: int) -> np.ndarray:
    return vertices + 0.04 * np.random.default_rng(seed).uniform(-1, 1, vertices.shape)
