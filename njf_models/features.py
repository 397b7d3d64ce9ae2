"""What the network sees of a shape: features of its triangles' centroids and of its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp


def face_features(mesh: dp.Mesh, wks: Float[Tensor, "n k"] | None = None) -> Float[Tensor, "m f"]:
    """Centroid features of each face: position, unit normal, mean WKS of its corners.

    Args:
        mesh: a mesh in space; positions are taken relative to its bounding box's centre.
        wks: (n, k) wave-kernel signature of the vertices, or None to do without.

    Returns:
        (m, 6 + k).
    """
    columns = [mesh.centroids - bounding_box_centre(mesh), mesh.normals]
    if wks is not None:
        columns.append(wks[mesh.faces].mean(dim=1).to(mesh.dtype))
    return torch.cat(columns, dim=1)


def point_features(
    mesh: dp.Mesh, samples: dp.SurfaceSamples, wks: Float[Tensor, "n k"] | None = None
) -> Float[Tensor, "s f"]:
    """What PointNet sees of each sample: position, interpolated vertex normal (not unit), WKS.

    Args:
        mesh: a mesh in space; positions are taken relative to its bounding box's centre.
        samples: points on the mesh.
        wks: (n, k) wave-kernel signature of the vertices, or None to do without.

    Returns:
        (s, 6 + k).
    """
    columns = [mesh.vertices - bounding_box_centre(mesh), mesh.vertex_normals]
    if wks is not None:
        columns.append(wks.to(mesh.dtype))
    return samples.interpolate(mesh, torch.cat(columns, dim=1))


def bounding_box_centre(mesh: dp.Mesh) -> Float[Tensor, "3"]:
    """Centre of the axis-aligned bounding box."""
    return (mesh.vertices.amin(dim=0) + mesh.vertices.amax(dim=0)) / 2


def reference_wks(mesh: dp.Mesh, solver: dp.PoissonSolver) -> Float[Tensor, "n 100"]:
    """Wave-kernel signature with the constants of the authors' experiments, for their checkpoints.

    100 energies of 50 eigenpairs with Voronoi mass, of eigenvectors / 200, times 1000; in 1/units².
    """
    wks = dp.wave_kernel_signature(
        mesh, 100, n_eigenpairs=50, mass="voronoi", scale_invariant=False, solver=solver
    )
    return wks * (1000 / 200**2)


@dataclass(frozen=True)
class Shape:
    """A mesh prepared for the network: operators factorised and features computed once.

    Attributes:
        mesh: the surface, or the disjoint union of several.
        solver: its Poisson solver.
        features: (m, f) centroid features in the network's dtype.
    """

    mesh: dp.Mesh
    solver: dp.PoissonSolver
    features: Float[Tensor, "m f"]

    @classmethod
    def prepare(
        cls,
        mesh: dp.Mesh,
        wks: Float[Tensor, "n k"] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Shape:
        """Factorise the mesh's Laplacian and compute the features of its faces."""
        return cls(mesh, dp.PoissonSolver(mesh), face_features(mesh, wks).to(dtype))

    @classmethod
    def concatenate(cls, shapes: Sequence[Shape]) -> Shape:
        """The disjoint union as one batch, reusing the factors."""
        solver = dp.PoissonSolver.concatenate([shape.solver for shape in shapes])
        features = torch.cat([shape.features for shape in shapes])
        return cls(solver.mesh, solver, features)

    @cached_property
    def face_weights(self) -> Float[Tensor, "m"]:
        """Area of each face as a share of its part's area, float64: weights of a mean per part."""
        return _shares(self.mesh.areas.double(), self.mesh.part_of_face, self.mesh.n_parts)

    @cached_property
    def vertex_weights(self) -> Float[Tensor, "n"]:
        """Area of each vertex as a share of its part's area, float64."""
        return _shares(self.mesh.vertex_areas.double(), self.mesh.part_of_vertex, self.mesh.n_parts)

    def with_features(self, features: Float[Tensor, "m f"]) -> Shape:
        """The same operators under other features."""
        return replace(self, features=features)


def _shares(sizes: Tensor, parts: Tensor, n_parts: int) -> Tensor:
    return sizes / sizes.new_zeros(n_parts).index_add(0, parts, sizes)[parts]
