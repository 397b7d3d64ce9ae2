"""A surface that follows its handles: what `njf view` does when one drags, without the window.

Each handle is a spot of the surface that moves rigidly; the rest follows as rigidly as it can
(`dp.as_rigid_as_possible`), or as the Poisson solve of the undeformed Jacobians alone has it. The
factor is made when handles come or go, and serves every move after that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp

Kind = Literal["as rigid as possible", "Poisson"]


@dataclass(frozen=True, eq=False)
class Handle:
    """A spot that moves rigidly.

    Attributes:
        vertices: (h,) its vertices.
        centre: (3,) of its rest position, in the mesh's units.
        rotation: (3, 3) its rotation about the centre.
        translation: (3,) where the centre goes, less where it was.
    """

    vertices: Int[Tensor, "h"]
    centre: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    def placed(self, rest: Float[Tensor, "n 3"]) -> Float[Tensor, "h 3"]:
        """Where its vertices are."""
        spot = rest[self.vertices] - self.centre
        return spot @ self.rotation.T + self.centre + self.translation


class PosedMesh:
    """A mesh, its handles, and where it is.

    Args:
        mesh: a surface in space.
        radius: of a handle's spot, as a share of the diagonal of the mesh's bounding box.

    Attributes:
        mesh: at rest.
        handles: by their names.
        vertices: (n, 3) float64, where the mesh is now.
        kind: how the rest of the surface follows.

    Raises:
        MeshError: not a surface in space.
    """

    def __init__(self, mesh: dp.Mesh, radius: float = 0.03) -> None:
        if (mesh.dim, mesh.cell_dim) != (3, 2):
            raise dp.MeshError(
                f"PosedMesh: expected triangles in space, got cells of dimension {mesh.cell_dim} "
                f"in {mesh.dim} dimensions"
            )
        self.mesh = mesh
        self.handles: dict[str, Handle] = {}
        self.kind: Kind = "as rigid as possible"
        self.vertices = mesh.vertices.double()
        self._rest = self.vertices
        size = self._rest.amax(0) - self._rest.amin(0)
        self.diagonal = float(torch.linalg.vector_norm(size))
        self._radius = radius * self.diagonal
        self._solver: dp.PoissonSolver | None = None
        self._numbers = 0

    def add(self, vertex: int) -> str | None:
        """A handle around a vertex, where that is now; its name, or None if all of it is taken."""
        if not 0 <= vertex < self.mesh.n_vertices:
            raise IndexError(f"PosedMesh: vertex {vertex} of {self.mesh.n_vertices}")
        free = torch.ones(self.mesh.n_vertices, dtype=torch.bool)
        for handle in self.handles.values():
            free[handle.vertices] = False
        centre = self._rest[vertex]
        near = torch.linalg.vector_norm(self._rest - centre, dim=1) <= self._radius
        spot = (near & free).nonzero()[:, 0]
        # One vertex must stay free, or there is nothing to solve for.
        if not free[vertex] or len(spot) >= int(free.sum()):
            return None
        rotation, translation = rigid_motion(self._rest[spot], self.vertices[spot], centre)
        name, self._numbers = f"handle {self._numbers}", self._numbers + 1
        self.handles[name] = Handle(spot, centre, rotation, translation)
        self._solver = None
        return name

    def remove(self, name: str) -> None:
        """Let a handle go."""
        del self.handles[name]
        self._solver = None

    def move(self, name: str, position: Float[Tensor, "3"], rotation: Float[Tensor, "3 3"]) -> None:
        """Bring a handle's centre to a position, turned by a rotation from its rest."""
        old = self.handles[name]
        self.handles[name] = Handle(old.vertices, old.centre, rotation, position - old.centre)

    def reset(self) -> None:
        """Back to rest, without handles."""
        self.handles.clear()
        self.vertices, self._solver = self._rest, None

    def follow(self, steps: int = 1) -> float:
        """Let the surface follow.

        Args:
            steps: of the local and global steps in turn; a Poisson solve is done after one.

        Returns:
            The largest distance that a vertex moved, as a share of the diagonal: near zero at rest.
        """
        if self.kind not in get_args(Kind):
            raise ValueError(f"PosedMesh: unknown kind {self.kind!r}, only {get_args(Kind)}")
        if not self.handles:
            return 0.0
        handles, before = self.handles.values(), self.vertices
        spots = torch.cat([handle.vertices for handle in handles])
        loose = self._loose(spots)
        if self._solver is None:
            self._solver = dp.PoissonSolver(self.mesh, pins=torch.cat([spots, loose]))
        placed = [handle.placed(self._rest) for handle in handles]
        images = torch.cat([*placed, before[loose]])
        if self.kind == "Poisson":
            self.vertices = self._solver(self.mesh.frames.double(), pins=images)
        else:
            self.vertices = dp.as_rigid_as_possible(
                self._solver, pins=images, start=before, tolerance=None, max_steps=steps
            ).vertices
        moved = torch.linalg.vector_norm(self.vertices - before, dim=1).amax()
        return float(moved) / self.diagonal

    def _loose(self, spots: Int[Tensor, "h"]) -> Int[Tensor, "l"]:
        """The vertices of components that no handle holds: they stay where they are."""
        component = self.mesh.components
        held = torch.zeros(self.mesh.n_components, dtype=torch.bool)
        held[component[spots]] = True
        return (~held[component]).nonzero()[:, 0]


def rigid_motion(
    source: Float[Tensor, "h 3"], target: Float[Tensor, "h 3"], centre: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """The motion x ↦ Q (x - centre) + centre + t closest to a spot's (Kabsch); Q = I for a point.

    Returns:
        Q and t.
    """
    p, q = source - source.mean(0), target - target.mean(0)
    U, _, Vt = torch.linalg.svd(q.T @ p)
    U[:, 2] *= torch.linalg.det(U @ Vt)
    rotation = U @ Vt if len(source) > 2 else torch.eye(3).to(source)
    return rotation, target.mean(0) - centre - rotation @ (source.mean(0) - centre)


def hit_vertex(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    origin: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
) -> int | None:
    """The corner nearest to where a ray first meets the surface (Möller and Trumbore 1997)."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    p = np.cross(direction, c - a)
    det = ((b - a) * p).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):  # rays in a triangle's plane: no hit
        s = origin - a
        u = (s * p).sum(1) / det
        q = np.cross(s, b - a)
        v = (q @ direction) / det
        t = ((c - a) * q).sum(1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    if not hit.any():
        return None
    first = np.where(hit, t, np.inf).argmin()
    weights = np.array([1 - u[first] - v[first], u[first], v[first]])
    return int(faces[first, weights.argmax()])
