"""Other triangulations of a reference surface, which deform exactly as it does.

Every vertex of such a triangulation is a point of the reference, given by a face and barycentric
weights. When the vertices of the reference move, linearly on each of its faces, so do the points:
corresponding points are known exactly, in whatever way the surface is cut into triangles.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Triangles between points of a reference mesh.

    Attributes:
        reference: the surface, in any one position.
        points: the n vertices, as points of the reference.
        faces: (m, 3) int64 triangles between them.
    """

    reference: dp.Mesh
    points: dp.SurfaceSamples
    faces: Int[Tensor, "m 3"]

    @classmethod
    def original(cls, reference: dp.Mesh) -> Triangulation:
        """The reference's own, whose vertices it gives back to the last bit."""
        some_face = torch.empty(reference.n_vertices, dtype=torch.int64)
        some_face[reference.faces] = torch.arange(reference.n_faces)[:, None].expand(-1, 3)
        itself = torch.arange(reference.n_vertices)[:, None]
        weights = (reference.faces[some_face] == itself).to(reference.dtype)
        return cls(reference, dp.SurfaceSamples(some_face, weights), reference.faces)

    @classmethod
    def embedded(
        cls, reference: dp.Mesh, vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]
    ) -> Triangulation:
        """A mesh near the reference, its vertices moved to the closest points of it."""
        V, F = reference.vertices.double().numpy(), reference.faces.numpy()
        _, at, closest = igl.point_mesh_squared_distance(vertices.double().numpy(), V, F)
        # Inside of a face but for rounding; on its border a weight may be rounded below zero.
        weights = igl.barycentric_coordinates(closest, *(V[F[at, k]] for k in range(3))).clip(0)
        weights /= weights.sum(axis=1, keepdims=True)
        barycentric = torch.from_numpy(np.ascontiguousarray(weights)).to(reference.dtype)
        return cls(reference, dp.SurfaceSamples(torch.from_numpy(at).long(), barycentric), faces)

    @classmethod
    def decimated(cls, reference: dp.Mesh, n_faces: int, grading: float = 0.0) -> Triangulation:
        """Edges collapsed in the order of their quadric error (Garland and Heckbert 1997).

        Args:
            reference: the surface.
            n_faces: how many faces to leave.
            grading: natural logarithm of how much shorter edges are at the top than at the bottom.

        Raises:
            ValueError: no more edges could be collapsed before so few faces were left.
        """
        stretched = _stretched(reference, grading)
        V, F = stretched.vertices.numpy(), stretched.faces.numpy().astype(np.int32)
        vertices, faces, _, _ = igl.qslim(np.asfortranarray(V), np.asfortranarray(F), n_faces)
        if len(faces) > n_faces:
            raise ValueError(
                f"Triangulation.decimated: {len(faces)} faces are left, not {n_faces}; ask for more"
            )
        vertices, faces = (torch.from_numpy(array.copy()) for array in (vertices, faces))
        return cls(reference, cls.embedded(stretched, vertices, faces).points, faces)

    def subdivided(self) -> Triangulation:
        """One step of Loop's subdivision, whose vertices are moved back to the reference."""
        vertices, faces = igl.loop(
            self.deformed(self.reference.vertices.double()).numpy(), self.faces.numpy()
        )
        smooth, faces = torch.from_numpy(vertices.copy()), torch.from_numpy(faces.copy()).long()
        return Triangulation.embedded(self.reference, smooth, faces)

    def deformed(self, values: Float[Tensor, "*batch N c"]) -> Float[Tensor, "*batch n c"]:
        """Values at these vertices, from those at the reference's, such as its other positions."""
        return self.points.interpolate(self.reference, values)


def _stretched(reference: dp.Mesh, grading: float) -> dp.Mesh:
    """The surface in float64, scaled up by e^grading at its top as compared to its bottom.

    Space is mapped by (x, y, z) ↦ (s x, s y, ∫ s dz) with s = e^(k z), so that all directions are
    scaled alike where x and y are small.
    """
    x = reference.vertices.double()
    if not grading:
        return dp.Mesh(x, reference.faces)
    low, high = x[:, 2].min(), x[:, 2].max()
    k = grading / (high - low)
    scale = (k * (x[:, 2:] - low)).exp()
    return dp.Mesh(torch.cat([scale * x[:, :2], (scale - 1) / k], dim=1), reference.faces)
