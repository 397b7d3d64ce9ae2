"""What the network sees of a shape: features of its triangles' centroids and of its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.handles import Handles
from njf_models.spectrum import Spectrum


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
    return samples.interpolate(mesh, vertex_features(mesh, wks))


def vertex_features(mesh: dp.Mesh, wks: Float[Tensor, "n k"] | None = None) -> Float[Tensor, "n f"]:
    """Features of each vertex: position, unit normal, WKS.

    Args:
        mesh: a mesh in space; positions are taken relative to its bounding box's centre.
        wks: (n, k) wave-kernel signature of the vertices, or None to do without.

    Returns:
        (n, 6 + k).
    """
    columns = [mesh.vertices - bounding_box_centre(mesh), mesh.vertex_normals]
    if wks is not None:
        columns.append(wks.to(mesh.dtype))
    return torch.cat(columns, dim=1)


def bounding_box_centre(mesh: dp.Mesh) -> Float[Tensor, "3"]:
    """Centre of the axis-aligned bounding box."""
    return (mesh.vertices.amin(dim=0) + mesh.vertices.amax(dim=0)) / 2


class Motions(NamedTuple):
    """A similarity for each of several parts, for augmentation.

    Attributes:
        turns: (parts, 3, 3) orthogonal matrices, rotations or reflections of the shape.
        images: (parts, 2, 2) the matrices that turn its planar map along.
        scales: (parts,) positive factors on lengths.
    """

    turns: Float[Tensor, "parts 3 3"]
    images: Float[Tensor, "parts 2 2"]
    scales: Float[Tensor, "parts"]

    @classmethod
    def random(
        cls,
        n: int,
        *,
        tilt: float = 0.1,
        log_scale: float = 0.1,
        generator: torch.Generator | None = None,
    ) -> Motions:
        """Any turn about z, mirrored half of the time, after a small turn about another axis.

        Args:
            n: number of parts.
            tilt: standard deviation of each of the two small angles, in radians.
            log_scale: standard deviation of the logarithm of the scale.
            generator: source of randomness; torch's global one if omitted.
        """
        angle = 2 * torch.pi * torch.rand(n, generator=generator)
        mirror = torch.randint(2, (n,), generator=generator) * 2.0 - 1
        small = tilt * torch.randn(n, 2, generator=generator)
        scales = (log_scale * torch.randn(n, generator=generator)).exp()
        zero = torch.zeros(n)
        cos, sin = angle.cos(), angle.sin()
        images = torch.stack([cos, -sin * mirror, sin, cos * mirror], dim=-1).view(n, 2, 2)
        turns = torch.eye(3).repeat(n, 1, 1)
        turns[:, :2, :2] = images
        # exp of the cross product with (a, b, 0): a rotation about an axis in the plane.
        a, b = small.unbind(-1)
        cross = torch.stack([zero, zero, b, zero, zero, -a, -b, a, zero], dim=-1).view(n, 3, 3)
        return cls(turns @ torch.linalg.matrix_exp(cross), images, scales)

    def points(self, points: Float[Tensor, "parts s f"]) -> Float[Tensor, "parts s f"]:
        """Point features of the parts, moved."""
        return _moved_features(
            points, self.turns.to(points.dtype)[:, None], self.scales.to(points.dtype)[:, None]
        )


def _moved_features(features: Tensor, turns: Tensor, scales: Tensor) -> Tensor:
    """Position and normal, the first six columns, turned; the rest knows no pose."""
    position, normal, rest = features.split([3, 3, features.shape[-1] - 6], dim=-1)
    position = scales[..., None] * (turns @ position[..., None])[..., 0]
    return torch.cat([position, (turns @ normal[..., None])[..., 0], rest], dim=-1)


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
        frames: (m, 3, 2) the faces' tangent bases in the pose that the features describe; the
            operators are intrinsic and know no pose.
        vertex_features: (n, v) features of the vertices, for models of maps by their values.
        spectra: of each part, for models that diffuse; none if not asked for.
        handles: of a single mesh: what its maps are pinned to, if a code says where that is.
    """

    mesh: dp.Mesh
    solver: dp.PoissonSolver
    features: Float[Tensor, "m f"]
    frames: Float[Tensor, "m 3 2"]
    vertex_features: Float[Tensor, "n v"]
    spectra: tuple[Spectrum, ...] = ()
    handles: Handles | None = None

    @classmethod
    def prepare(
        cls,
        mesh: dp.Mesh,
        wks: Float[Tensor, "n k"] | None = None,
        dtype: torch.dtype = torch.float32,
        solver: dp.PoissonSolver | None = None,
        n_eigenpairs: int = 0,
    ) -> Shape:
        """The features of a mesh's faces and vertices, and its solver if it is not given.

        With so many eigenpairs in its spectrum, if any.
        """
        features = face_features(mesh, wks).to(dtype)
        at_vertices = vertex_features(mesh, wks).to(dtype)
        solver = solver or dp.PoissonSolver(mesh)
        spectra = (Spectrum.of(mesh, n_eigenpairs, solver),) if n_eigenpairs else ()
        return cls(mesh, solver, features, mesh.frames.to(dtype), at_vertices, spectra)

    @classmethod
    def concatenate(cls, shapes: Sequence[Shape]) -> Shape:
        """The disjoint union as one batch, reusing the factors."""
        solver = dp.PoissonSolver.concatenate([shape.solver for shape in shapes])
        features, frames, at_vertices = (
            torch.cat([getattr(shape, name) for shape in shapes])
            for name in ("features", "frames", "vertex_features")
        )
        spectra = tuple(spectrum for shape in shapes for spectrum in shape.spectra)
        return cls(solver.mesh, solver, features, frames, at_vertices, spectra)

    @cached_property
    def face_weights(self) -> Float[Tensor, "m"]:
        """Area of each face as a share of its part's area, float64: weights of a mean per part."""
        return _shares(self.mesh.areas.double(), self.mesh.part_of_face, self.mesh.n_parts)

    @cached_property
    def vertex_weights(self) -> Float[Tensor, "n"]:
        """Area of each vertex as a share of its part's area, float64."""
        return _shares(self.mesh.vertex_areas.double(), self.mesh.part_of_vertex, self.mesh.n_parts)

    def moved(self, motions: Motions) -> Shape:
        """Each part as the network would see it turned and scaled.

        Nothing intrinsic changes, so operators and factor stay. (A mirrored part counts as
        reoriented too, so that its normals are the mirrored ones.)
        """
        turns, scales = (x.to(self.features.dtype) for x in (motions.turns, motions.scales))
        parts, owners = self.mesh.part_of_face, self.mesh.part_of_vertex
        return replace(
            self,
            features=_moved_features(self.features, turns[parts], scales[parts]),
            frames=turns[parts] @ self.frames,
            vertex_features=_moved_features(self.vertex_features, turns[owners], scales[owners]),
        )

    def with_handles(self, handles: Handles) -> Shape:
        """The same shape, whose maps are pinned."""
        return replace(self, handles=handles)

    def with_features(self, features: Float[Tensor, "m f"]) -> Shape:
        """The same operators under other features."""
        return replace(self, features=features)


def _shares(sizes: Tensor, parts: Tensor, n_parts: int) -> Tensor:
    return sizes / sizes.new_zeros(n_parts).index_add(0, parts, sizes)[parts]
