"""For tests of code that works on meshes: small meshes of every kind, and invariances to assert.

Not imported by `import diffpoisson`; needs hypothesis. In a test::

    from hypothesis import given
    from diffpoisson import testing

    @given(testing.meshes())
    def test_my_descriptor(mesh):
        testing.assert_frame_invariant(my_descriptor, mesh)
        testing.assert_equivariant(my_descriptor, mesh, per="vertex")

Positions are float64 and generic (jittered, no symmetry), so that a test cannot pass by luck.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import scipy.spatial
import torch
from hypothesis import strategies as st
from torch import Tensor

from diffpoisson.mesh import Mesh

Arrays = tuple[np.ndarray, np.ndarray]
Builder = Callable[[int], Arrays]
Transformation = Literal["rotation", "translation", "scale", "permutation"]


# -------------------------------------------------------------------- triangles in space


def triangle(seed: int = 0) -> Arrays:
    """A single triangle in space."""
    vertices = np.array([[0.0, 0, 0], [1, 0.1, 0.2], [0.3, 0.8, -0.1]])
    return vertices + 0.1 * np.random.default_rng(seed).standard_normal((3, 3)), _one_cell(3)


def disk(seed: int = 0, size: int = 5) -> Arrays:
    """A jittered size × size grid, bent out of the plane."""
    vertices, faces = planar_disk(seed, size)
    return _bent(vertices), faces


def annulus(seed: int = 0, around: int = 7, across: int = 3) -> Arrays:
    """Two boundaries."""
    angle, radius = _periodic(around), 1 + np.arange(across) / across
    flat = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    grid = np.arange(around * across).reshape(across, around)
    faces = _quads(np.concatenate([grid, grid[:, :1]], axis=1))
    return _jittered(_bent(flat.reshape(-1, 2)), seed), faces


def sphere(seed: int = 0, subdivisions: int = 1) -> Arrays:
    """A jittered ellipsoid of 20 · 4^subdivisions faces."""
    golden = (1 + np.sqrt(5)) / 2
    corners = np.array([[0, s, t * golden] for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([np.roll(corners, shift, axis=1) for shift in range(3)])
    vertices /= np.linalg.norm(vertices[0])
    hull = scipy.spatial.ConvexHull(vertices)
    outward = np.linalg.det(vertices[hull.simplices]) > 0
    faces = np.where(outward[:, None], hull.simplices, hull.simplices[:, [0, 2, 1]])
    faces = faces.astype(np.int64)
    for _ in range(subdivisions):
        vertices, faces = _subdivided(vertices, faces)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return _jittered(vertices * [1, 1.3, 0.7], seed), faces


def torus(seed: int = 0, around: int = 7, across: int = 5) -> Arrays:
    """Closed, of genus one."""
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


# -------------------------------------------------------------------- triangles in the plane


def planar_disk(seed: int = 0, size: int = 5) -> Arrays:
    """A jittered grid of the unit square, D = 2, counter-clockwise; its boundary is not moved."""
    vertices = _grid(size, 2)
    inner = ((vertices > 0) & (vertices < 1)).all(axis=1)
    jitter = np.random.default_rng(seed).uniform(-1, 1, (inner.sum(), 2))
    vertices[inner] += 0.2 / (size - 1) * jitter
    return vertices, _quads(np.arange(size**2).reshape(size, size))


def clockwise_disk(seed: int = 0, size: int = 5) -> Arrays:
    """D = 2, every second face turned clockwise."""
    vertices, faces = planar_disk(seed, size)
    faces[::2] = faces[::2, [0, 2, 1]]
    return vertices, faces


# -------------------------------------------------------------------- tetrahedra


def tetrahedron(seed: int = 0) -> Arrays:
    """A single tetrahedron."""
    vertices = np.array([[0.0, 0, 0], [1, 0.1, 0.2], [0.3, 0.8, -0.1], [0.2, 0.3, 0.9]])
    return vertices + 0.1 * np.random.default_rng(seed).standard_normal((4, 3)), _one_cell(4)


def box(seed: int = 0, size: int = 3) -> Arrays:
    """A jittered grid, six tetrahedra a cell; its boundary stays that of the unit cube."""
    vertices = _grid(size, 3)
    inside = (vertices > 0) & (vertices < 1)  # along each axis
    jitter = np.random.default_rng(seed).uniform(-1, 1, vertices.shape)
    vertices += 0.2 / (size - 1) * jitter * inside
    grid = np.arange(size**3).reshape(size, size, size)
    # Kuhn: one tetrahedron for each order in which the axes can be walked along.
    paths = [((0, 1, 2), 1), ((1, 2, 0), 1), ((2, 0, 1), 1)]
    paths += [((0, 2, 1), -1), ((2, 1, 0), -1), ((1, 0, 2), -1)]
    cells = []
    for axes, orientation in paths:
        corner = np.zeros(3, dtype=int)
        path = [_shifted(grid, corner)]
        for axis in axes:
            corner[axis] = 1
            path.append(_shifted(grid, corner))
        cells.append(np.stack(path if orientation == 1 else [path[i] for i in (0, 2, 1, 3)], 1))
    return vertices, np.concatenate(cells)


def delaunay(seed: int = 0, size: int = 12) -> Arrays:
    """The Delaunay tetrahedra of random points and the corners of a cube, slivers left out."""
    rng = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(*3 * [[0.0, 1]]), axis=-1).reshape(-1, 3)
    vertices = np.concatenate([corners, rng.uniform(0.05, 0.95, (size, 3))])
    cells = scipy.spatial.Delaunay(vertices).simplices.astype(np.int64)
    volumes = np.linalg.det(vertices[cells[:, 1:]] - vertices[cells[:, :1]])
    cells[volumes < 0] = cells[volumes < 0][:, [0, 2, 1, 3]]
    cells = cells[np.abs(volumes) > 1e-3]
    used, cells = np.unique(cells, return_inverse=True)
    return vertices[used], cells.reshape(-1, 4)


def inverted_box(seed: int = 0, size: int = 3) -> Arrays:
    """Every second tetrahedron negatively oriented."""
    vertices, cells = box(seed, size)
    cells[::2] = cells[::2, [0, 2, 1, 3]]
    return vertices, cells


def tetrahedral_parts(seed: int = 0) -> Arrays:
    """Two tetrahedra at an edge, two at a vertex, and a box, of different sizes."""
    vertices, cells = box(seed, 2)
    hinge = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0.4], [1, 1, 0], [-1, -1, 0.3], [-1, 0, 0.6]])
    fan = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    pieces = (
        (_jittered(hinge, seed), np.array([[0, 2, 3, 1], [0, 5, 4, 1]])),
        (_jittered(2 * fan, seed) + 4, np.array([[0, 1, 2, 3], [0, 5, 4, 6]])),
        (_jittered(0.5 * vertices - 4, seed), cells),
    )
    return union(*pieces)


def union(*meshes: Arrays) -> Arrays:
    """The disjoint union, in order."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    return vertices, np.concatenate([f + s for (_, f), s in zip(meshes, starts, strict=False)])


SPATIAL: dict[str, Builder] = {
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
PLANAR: dict[str, Builder] = {"planar_disk": planar_disk, "clockwise_disk": clockwise_disk}
TETRAHEDRAL: dict[str, Builder] = {
    "tetrahedron": tetrahedron,
    "box": box,
    "delaunay": delaunay,
    "inverted_box": inverted_box,
    "tetrahedral_parts": tetrahedral_parts,
}
TRIANGULAR = SPATIAL | PLANAR
TOPOLOGIES = TRIANGULAR | TETRAHEDRAL


# -------------------------------------------------------------------- strategies


seeds = st.integers(0, 2**16)


@st.composite
def mesh_arrays(
    draw: Callable[..., Any],  # hypothesis.strategies.DrawFn, which beartype cannot check
    topologies: Mapping[str, Builder] = TRIANGULAR,
    *,
    max_log_aspect: float | int = 0,
    max_log_scale: float | int = 6,
) -> Arrays:
    """Strategy: (vertices, faces) of a drawn topology, somewhere in space, renumbered.

    Args:
        draw: supplied by hypothesis.
        topologies: builders to choose from: `SPATIAL`, `PLANAR`, `TETRAHEDRAL`, unions of them with
            |, or your own.
        max_log_aspect: squeeze along one axis by up to ten to this power.
        max_log_scale: scale by up to ten to plus or minus this power.
    """
    vertices, faces = topologies[draw(st.sampled_from(sorted(topologies)))](draw(seeds))
    rng = np.random.default_rng(draw(seeds))
    vertices[:, 0] *= 10.0 ** -draw(st.floats(0, max_log_aspect))
    vertices = (vertices + rng.standard_normal(vertices.shape[1])) @ rotation(rng, vertices).T
    vertices = vertices * 10.0 ** draw(st.floats(-max_log_scale, max_log_scale))
    return renumbered(rng, vertices, faces)[:2]


def meshes(
    topologies: Mapping[str, Builder] = TRIANGULAR,
    *,
    max_log_aspect: float | int = 0,
    max_log_scale: float | int = 6,
) -> st.SearchStrategy[Mesh]:
    """Strategy: a float64 `Mesh`; see `mesh_arrays` for the arguments."""
    arrays = mesh_arrays(topologies, max_log_aspect=max_log_aspect, max_log_scale=max_log_scale)
    return arrays.map(lambda drawn: Mesh(*drawn))


def rotation(rng: np.random.Generator, vertices: np.ndarray) -> np.ndarray:
    """A random rotation of the space the vertices (n, D) lie in, (D, D)."""
    Q, _ = np.linalg.qr(rng.standard_normal(2 * vertices.shape[1:]))
    Q[0] *= np.sign(np.linalg.det(Q))
    return Q


def renumbered(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices and faces in random order, and the two permutations (new = old[permutation])."""
    p, q = rng.permutation(len(vertices)), rng.permutation(len(faces))
    return vertices[p], np.argsort(p)[faces][q], p, q


# -------------------------------------------------------------------- invariances


def assert_frame_invariant(
    function: Callable[..., Tensor],
    mesh: Mesh,
    *fields: Tensor,
    intrinsic_output: bool = False,
    rtol: float = 1e-9,
    seed: int = 0,
) -> None:
    """Assert that a function's result does not depend on how the faces' frames were chosen.

    Each face's corners are cycled at random, which turns its frame and changes nothing else, and
    the fields are re-expressed in the new frames.

    Args:
        function: takes a mesh and the fields, returns a tensor.
        mesh: triangles in space; in the plane and for tetrahedra frames leave no choice.
        fields: (…, m, c, 2) matrices in the coordinates of `mesh.frames`.
        intrinsic_output: the result is such a field too, to be re-expressed likewise.
        rtol: allowed error, relative to the largest entry of the result.
        seed: of the random choice.

    Raises:
        AssertionError: the result depends on the frames.
        ValueError: the mesh is not made of triangles in space.
    """
    if (mesh.cell_dim, mesh.dim) != (2, 3):
        raise ValueError(
            "assert_frame_invariant: needs triangles in space; other frames are the identity"
        )
    rng = np.random.default_rng(seed)
    shifts = torch.from_numpy(rng.integers(1, 3, (mesh.n_faces, 1))).to(mesh.device)
    corners = (torch.arange(3, device=mesh.device) + shifts) % 3
    turned = Mesh(mesh.vertices, mesh.faces.gather(1, corners))
    turn = mesh.frames.mT @ turned.frames  # (m, 2, 2): the new frames in terms of the old
    expected = function(mesh, *fields)
    if intrinsic_output:
        expected = expected @ turn.to(expected)
    actual = function(turned, *(R @ turn.to(R) for R in fields))
    _assert_near(actual, expected, rtol, "the result depends on the choice of frames")


def assert_equivariant(
    function: Callable[[Mesh], Tensor],
    mesh: Mesh,
    *,
    per: Literal["mesh", "vertex", "face"] = "mesh",
    dim: int = 0,
    rotates: bool = False,
    translates: bool = False,
    degree: float | int = 0,
    under: Sequence[Transformation] = ("rotation", "translation", "scale", "permutation"),
    rtol: float = 1e-9,
    seed: int = 0,
) -> None:
    """Assert that a function of a mesh follows when the mesh is moved, scaled, or renumbered.

    By default the result must be invariant; the arguments say how it changes instead.

    Args:
        function: takes a mesh, returns a tensor.
        mesh: the mesh to transform.
        per: what the entries along `dim` belong to, and are renumbered with.
        dim: that dimension.
        rotates: the last dimension holds vectors of the ambient space, which rotate with the mesh.
        translates: and points, which are translated with it.
        degree: the result is multiplied by the scale to this power: 1 for lengths, 2 for areas.
        under: the transformations to try.
        rtol: allowed error, relative to the largest entry of the result.
        seed: of the random transformations.

    Raises:
        AssertionError: naming the transformation that the result does not follow.
    """
    rng = np.random.default_rng(seed)
    expected = function(mesh)
    Q = torch.from_numpy(rotation(rng, mesh.vertices.cpu().numpy())).to(mesh.vertices)
    size = (mesh.vertices.amax(0) - mesh.vertices.amin(0)).max()
    shift = torch.from_numpy(rng.standard_normal(mesh.dim)).to(mesh.vertices) * size
    scale = 2 ** float(rng.uniform(1, 3))
    p, q = (torch.from_numpy(rng.permutation(k)) for k in (mesh.n_vertices, mesh.n_faces))
    p, q = p.to(mesh.device), q.to(mesh.device)
    order = {"mesh": None, "vertex": p, "face": q}[per]

    cases: dict[str, tuple[Mesh, Tensor]] = {
        "rotation": (
            Mesh(mesh.vertices @ Q.T, mesh.faces),
            expected @ Q.T.to(expected) if rotates else expected,
        ),
        "translation": (
            Mesh(mesh.vertices + shift, mesh.faces),
            expected + shift.to(expected) if translates else expected,
        ),
        "scale": (Mesh(mesh.vertices * scale, mesh.faces), expected * scale**degree),
        "permutation": (
            Mesh(mesh.vertices[p], p.argsort()[mesh.faces][q]),
            expected if order is None else expected.index_select(dim, order),
        ),
    }
    for name in under:
        moved, followed = cases[name]
        _assert_near(function(moved), followed, rtol, f"the result does not follow a {name}")


def _assert_near(actual: Tensor, expected: Tensor, rtol: float, complaint: str) -> None:
    if actual.shape != expected.shape:
        raise AssertionError(
            f"{complaint}: shape {tuple(actual.shape)} instead of {tuple(expected.shape)}"
        )
    if expected.numel() == 0:
        return
    error, size = (actual - expected).abs().max().item(), expected.abs().max().item()
    if not error <= rtol * size:  # also if it is NaN
        raise AssertionError(f"{complaint}: error {error:.2e} on values up to {size:.2e}")


# -------------------------------------------------------------------- pieces of the builders


def _one_cell(corners: int) -> np.ndarray:
    return np.arange(corners)[None]


def _quads(grid: np.ndarray) -> np.ndarray:
    """Two triangles for each cell of a grid of vertex indices."""
    a, b, c, d = (x.ravel() for x in (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _shifted(grid: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """The given corner's vertex of each cell of a three-dimensional grid."""
    x, y, z = (slice(c, c + size - 1) for c, size in zip(corner, grid.shape, strict=True))
    return grid[x, y, z].ravel()


def _subdivided(vertices: np.ndarray, faces: np.ndarray) -> Arrays:
    """Each triangle in four, at the midpoints of its edges."""
    m = len(faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    ab, bc, ca = (len(vertices) + inverse.reshape(3, m)).astype(np.int64)
    a, b, c = faces.T
    quarters = ([a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca])
    midpoints = vertices[unique].mean(axis=1)
    return np.concatenate([vertices, midpoints]), np.concatenate([np.stack(q, 1) for q in quarters])


def _grid(size: int, D: int) -> np.ndarray:
    """(size^D, D) points of the unit cube."""
    axes = np.meshgrid(*D * [np.linspace(0, 1, size)], indexing="ij")
    return np.stack([x.ravel() for x in axes], axis=1)


def _periodic(count: int) -> np.ndarray:
    return 2 * np.pi * np.arange(count) / count


def _bent(flat: np.ndarray) -> np.ndarray:
    return np.c_[flat, 0.3 * np.sin(2 * flat[:, 0]) + 0.2 * flat[:, 1] ** 2]


def _jittered(vertices: np.ndarray, seed: int) -> np.ndarray:
    return vertices + 0.04 * np.random.default_rng(seed).uniform(-1, 1, vertices.shape)
