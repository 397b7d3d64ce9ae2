"""A solid with limbs: its surface from a union of convex hulls, tetrahedra inside, six handles.

The lizard stands in for the paper's Raptor, which is not free: trunk, head, tail, two legs and two
arms. Its surface is manifold3d's, its tetrahedra are fTetWild's (Hu et al. 2020; MPL-2.0), from the
package wildmeshing, which the extra `elastic` installs.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import igl
import numpy as np
from jaxtyping import Float, Int

Points = Float[np.ndarray, "n 3"]

# Joints and radii of the trunk, the neck and the tail; and of a leg and an arm, of which each is
# there twice. In metres; x to the front, z up, y = 0 the plane of symmetry.
_Limb = tuple[list[tuple[float, ...]], list[float]]
_MIDDLE: list[_Limb] = [
    ([(-0.25, 0.0, 0.62), (0.15, 0.0, 0.66)], [0.15, 0.13]),
    ([(0.15, 0.0, 0.66), (0.38, 0.0, 0.88), (0.58, 0.0, 0.90)], [0.11, 0.07, 0.06]),
    ([(-0.25, 0.0, 0.62), (-0.6, 0.0, 0.58), (-0.95, 0.0, 0.66)], [0.12, 0.07, 0.035]),
]
_SIDES: list[_Limb] = [
    (
        [(-0.12, 0.1, 0.56), (0.02, 0.16, 0.34), (-0.1, 0.16, 0.12), (0.02, 0.18, 0.05)],
        [0.11, 0.07, 0.045, 0.045],
    ),
    ([(0.2, 0.08, 0.6), (0.28, 0.16, 0.48), (0.42, 0.17, 0.44)], [0.06, 0.042, 0.035]),
]
LIZARD_HANDLES: Float[np.ndarray, "h=6 3"] = np.array(
    [
        (0.58, 0, 0.90),
        (-0.95, 0, 0.66),
        (0.02, 0.18, 0.05),
        (0.02, -0.18, 0.05),
        (0.42, 0.17, 0.44),
        (0.42, -0.17, 0.44),
    ]
)
"""Head, end of the tail, left and right foot, left and right hand."""
HANDLE_RADIUS = 0.08
_SEGMENTS = 24  # of a ball's equator


@dataclass(frozen=True, eq=False)
class Solid:
    """Tetrahedra, and the vertices that each handle holds.

    Attributes:
        vertices: (n, 3) float64.
        tetrahedra: (t, 4) int64, all of positive volume.
        handle_of: (n,) int64, the number of the handle that holds a vertex, -1 for none.
    """

    vertices: Float[np.ndarray, "n 3"]
    tetrahedra: Int[np.ndarray, "t 4"]
    handle_of: Int[np.ndarray, "n"]

    def __post_init__(self) -> None:
        flat = int((self.volumes(self.vertices) <= 0).sum())
        if flat:
            raise ValueError(f"Solid: {flat} tetrahedra are flat or inside out")
        held = np.bincount(self.handle_of[self.held], minlength=1)
        if (held < 3).any():
            raise ValueError(
                f"Solid: each handle must hold three vertices at least, these hold {held.tolist()}"
            )

    @property
    def held(self) -> Int[np.ndarray, "k"]:
        """Vertices that some handle holds, ascending."""
        return np.flatnonzero(self.handle_of >= 0)

    @property
    def n_handles(self) -> int:
        """Number of handles."""
        return int(self.handle_of.max()) + 1

    @property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    @cached_property
    def surface(self) -> Int[np.ndarray, "b"]:
        """The vertices on the boundary, ascending."""
        return np.unique(self._boundary)

    @cached_property
    def faces(self) -> Int[np.ndarray, "m 3"]:
        """The boundary's triangles, normals outwards, between the vertices of `surface`."""
        return np.searchsorted(self.surface, self._boundary)

    @cached_property
    def _boundary(self) -> np.ndarray:
        faces = np.asarray(igl.boundary_facets(self.tetrahedra)[0], dtype=np.int64)
        a, b, c = (self.vertices[faces[:, k]] for k in range(3))
        volume = np.einsum("ij,ij->", np.cross(a, b), c)  # six times what the faces enclose
        return faces if volume > 0 else faces[:, ::-1].copy()

    def volumes(self, positions: Points) -> Float[np.ndarray, "t"]:
        """Signed volume of each tetrahedron; not positive where it is flipped."""
        a, b, c, d = (positions[self.tetrahedra[:, k]] for k in range(4))
        return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6

    def moved_handles(self, offsets: Float[np.ndarray, "h 3"]) -> Float[np.ndarray, "k 3"]:
        """Where the held vertices are when each handle is moved by its offset."""
        return self.vertices[self.held] + offsets[self.handle_of[self.held]]

    def refined(self) -> Solid:
        """Each tetrahedron cut into eight at the middles of its edges; handles hold what they held.

        A vertex on an edge between two held ones is held too.
        """
        T, n = self.tetrahedra, len(self.vertices)
        ends = np.sort(T[:, _EDGES], axis=-1).reshape(-1, 2)
        edges, which = np.unique(ends, axis=0, return_inverse=True)
        corners = np.concatenate([T, n + which.reshape(-1, 6)], axis=1)
        first, second = self.handle_of[edges].T
        middles = self.vertices[edges].mean(axis=1)
        return Solid(
            np.concatenate([self.vertices, middles]),
            corners[:, _EIGHT].reshape(-1, 4),
            np.concatenate([self.handle_of, np.where(first == second, first, -1)]),
        )


# Edges of a tetrahedron, and the eight that it is cut into: corners 0 to 3, middles 4 to 9.
_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_EIGHT = np.array(
    [
        *[(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3)],  # at the corners
        *[(4, 5, 6, 8), (4, 7, 5, 8), (5, 6, 8, 9), (5, 8, 7, 9)],  # around the edge from 5 to 8
    ]
)


def lizard(edge: float = 0.035) -> Solid:
    """The lizard, 1.6 m long; of some four thousand tetrahedra by default.

    fTetWild is deterministic on one machine, but not promised to be across versions and compilers.

    Args:
        edge: wanted length of edges, as a share of the diagonal of the bounding box.

    Raises:
        ModuleNotFoundError: manifold3d or wildmeshing is not installed.
    """
    vertices, tetrahedra = tetrahedralise(*lizard_surface(), edge)
    distance = np.linalg.norm(vertices[:, None] - LIZARD_HANDLES, axis=-1)
    near = distance.argmin(axis=1)
    handle_of = np.where(distance.min(axis=1) < HANDLE_RADIUS, near, -1)
    return Solid(vertices, tetrahedra, handle_of)


def lizard_surface() -> tuple[Points, Int[np.ndarray, "m 3"]]:
    """The lizard's closed surface, of genus 0."""
    _require("manifold3d")
    import manifold3d  # noqa: PLC0415  (only where data is made)

    solid = manifold3d.Manifold()
    for joints, radii in _MIDDLE:
        solid = solid + _limb(joints, radii)
    for joints, radii in _SIDES:
        limb = _limb(joints, radii)
        solid = solid + limb + limb.mirror((0, 1, 0))
    mesh = solid.to_mesh()
    return np.array(mesh.vert_properties[:, :3], dtype=np.float64), np.array(
        mesh.tri_verts, dtype=np.int64
    )


def _limb(joints: Sequence[tuple[float, ...]], radii: Sequence[float]) -> Any:
    """Balls at the joints, and the convex hull of each with the next."""
    from manifold3d import Manifold  # noqa: PLC0415

    balls = [
        Manifold.sphere(radius, _SEGMENTS).translate(joint)
        for joint, radius in zip(joints, radii, strict=True)
    ]
    limb = Manifold()
    for ball, following in pairwise(balls):
        limb = limb + Manifold.batch_hull([ball, following])
    return limb


def tetrahedralise(
    vertices: Points, faces: Int[np.ndarray, "m 3"], edge: float, tolerance: float = 2e-3
) -> tuple[Float[np.ndarray, "p 3"], Int[np.ndarray, "t 4"]]:
    """Tetrahedra inside of a closed surface, by fTetWild; all of positive volume.

    Args:
        vertices: of the surface.
        faces: of the surface.
        edge: wanted length of edges, as a share of the diagonal of the bounding box.
        tolerance: how far the new surface may be from the given one, as a share of the diagonal.

    Raises:
        ModuleNotFoundError: wildmeshing is not installed.
    """
    _require("wildmeshing")
    import wildmeshing  # noqa: PLC0415  (only where data is made)

    # It writes files to the working folder.
    with _silenced(), tempfile.TemporaryDirectory() as folder, chdir(folder):
        mesher = wildmeshing.Tetrahedralizer(edge_length_r=edge, epsilon=tolerance, max_threads=1)
        mesher.set_log_level(6)
        mesher.set_mesh(vertices, faces.astype(np.int32))
        mesher.tetrahedralize()
        result = mesher.get_tet_mesh(manifold_surface=True, correct_surface_orientation=True)
    points, tetrahedra = np.asarray(result[0], np.float64), np.asarray(result[1], np.int64)
    used, renumbered = np.unique(tetrahedra, return_inverse=True)
    return points[used], renumbered.reshape(-1, 4)


def _require(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise ModuleNotFoundError(
            f'the lizard is made with {package}: pip install "diffpoisson[elastic]"'
        )


@contextmanager
def _silenced() -> Iterator[None]:
    """Nothing on the standard output, also of what libraries write there past Python."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123  (a descriptor is wanted)
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
