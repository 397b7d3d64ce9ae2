"""Samples of maps: some cells of several shapes, to train on without a Poisson solve.

The Jacobian term of the loss compares each face's matrix with a target of its own, so that some
faces of many shapes do for a step, instead of all faces of one. Cells are drawn by area, so that
plain means over them have the area-weighted sums of the paper's loss for their expectation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from njf_models.basis_points import reflected_basis

CellKind = Literal["faces", "vertices"]


@dataclass(frozen=True)
class Cells:
    """Samples of maps of b shapes, of each to t targets.

    Attributes:
        features: (b, k, f) features of the cells, faces or vertices.
        target: (b, t, k, c, 2) Jacobians of faces, or (b, t, k, c) images of vertices.
        points: (b, s, g) what the encoder sees of the sources: features of points on them, or of
            basis points.
        frames: (b, k, 3, 2) tangent bases of faces; None for vertices.
        target_points: (b, t, s, g) the same of the targets, if the code is made from them;
            (1, t, s, g) if all shapes have the same targets.
        parameters: (b, t, p) parameters of the targets, if they have any.
        basis: whether the points are basis points.
    """

    features: Float[Tensor, "b k f"]
    target: Float[Tensor, "b t k *c"]
    points: Float[Tensor, "b s g"]
    frames: Float[Tensor, "b k 3 2"] | None = None
    target_points: Float[Tensor, "#b t s g"] | None = None
    parameters: Float[Tensor, "b t p"] | None = None
    basis: bool = False

    @classmethod
    def draw(
        cls,
        kind: CellKind,
        n_cells: int,
        surfaces: Surfaces,
        targets: Float[Tensor, "#b t n 3"],
        **code: Any,
    ) -> Cells:
        """Cells of several shapes, drawn with replacement by their area.

        Args:
            kind: faces with their Jacobians, or vertices with their images, of which the target's
                mean over the source's area is the origin.
            n_cells: how many of each.
            surfaces: the sources.
            targets: images of their vertices; (1, t, n, 3) if the same for all.
            code: `points`, and `target_points`, `parameters` and `basis` if there are any.
        """
        return (_faces if kind == "faces" else _vertices)(n_cells, surfaces, targets, code)

    def reflected(self, signs: Float[Tensor, "#b"]) -> Cells:
        """The same maps of the shapes' mirror images in x = 0, and of their targets', where told.

        Args:
            signs: -1 for the shapes to reflect, 1 for the others. Parameters stay as they are.
        """
        axes = torch.stack([signs, torch.ones_like(signs), torch.ones_like(signs)], dim=-1)

        def moved(features: Tensor) -> Tensor:
            """Positions and normals, and what else there may be as it was."""
            shape = (len(axes), *[1] * (features.ndim - 2), 3)
            x, n, rest = features.split((3, 3, features.shape[-1] - 6), dim=-1)
            return torch.cat([x * axes.view(shape), n * axes.view(shape), rest], dim=-1)

        def seen(points: Tensor) -> Tensor:
            """What the encoder sees."""
            if not self.basis:
                return moved(points)
            mirrored = signs.view(-1, *[1] * (points.ndim - 1)) < 0
            return reflected_basis(points).where(mirrored, points)

        rows = axes.view(-1, 1, 1, 3)
        return replace(
            self,
            features=moved(self.features),
            points=seen(self.points),
            target=self.target * (rows if self.frames is None else rows[..., None]),
            frames=None if self.frames is None else self.frames * axes[:, None, :, None],
            target_points=None if self.target_points is None else seen(self.target_points),
        )


@dataclass(frozen=True)
class Surfaces:
    """Several surfaces of one triangulation, each with all of its faces or some.

    Attributes:
        vertices: (b, n, 3).
        faces: (m, 3) of all of them.
        present: (b, m) 1 for the faces that a surface has, 0 for the others; None if it has all.
        wks: (b, n, k) wave-kernel signatures, if the network sees them.
    """

    vertices: Float[Tensor, "b n 3"]
    faces: Int[Tensor, "m 3"]
    present: Float[Tensor, "b m"] | None = None
    wks: Float[Tensor, "b n k"] | None = None

    def points(self, n_points: int) -> Float[Tensor, "b s f"]:
        """What PointNet sees, as `features.point_features` has it, of points drawn by area."""
        chosen = self.draw(n_points)
        u, v = torch.rand(2, *chosen.shape)
        root = u.sqrt()  # uniform on the triangle: Osada et al. 2002
        weights = torch.stack([1 - root, root * (1 - v), root * v], dim=-1)
        return (self._at(self.vertex_features, chosen) * weights[..., None]).sum(-2)

    def draw(self, n_faces: int) -> Int[Tensor, "b k"]:
        """Faces of each surface, by area, with replacement."""
        return torch.multinomial(self.areas, n_faces, replacement=True)

    def corners(self, chosen: Int[Tensor, "b k"]) -> Float[Tensor, "b k 3 3"]:
        """Corners of faces."""
        return self._at(self.vertices, chosen)

    @cached_property
    def areas(self) -> Float[Tensor, "b m"]:
        """Of the faces; none of those that a surface does not have."""
        return torch.linalg.vector_norm(self._area_vectors, dim=-1)

    @cached_property
    def centres(self) -> Float[Tensor, "b 1 3"]:
        """Of the bounding boxes."""
        x = self.vertices
        if self.present is None:
            return (x.amax(1, keepdim=True) + x.amin(1, keepdim=True)) / 2
        absent = (self._vertex_sums(self.areas[..., None]) == 0).expand_as(x)
        high = x.masked_fill(absent, -torch.inf).amax(1, keepdim=True)
        low = x.masked_fill(absent, torch.inf).amin(1, keepdim=True)
        return (high + low) / 2

    @cached_property
    def vertex_features(self) -> Float[Tensor, "b n f"]:
        """As of `features.vertex_features`; not numbers where a surface has no face."""
        sums = self._vertex_sums(self._area_vectors)
        normals = sums / torch.linalg.vector_norm(sums, dim=-1, keepdim=True)
        columns = [self.vertices - self.centres, normals]
        return torch.cat(columns if self.wks is None else [*columns, self.wks], dim=-1)

    @cached_property
    def vertex_shares(self) -> Float[Tensor, "b n"]:
        """Area of each vertex as a share of the surface's."""
        third = self._vertex_sums(self.areas[..., None])[..., 0] / 3
        return third / self.areas.sum(dim=1, keepdim=True)

    @cached_property
    def _area_vectors(self) -> Float[Tensor, "b m 3"]:
        a, b, c = self.vertices[:, self.faces].unbind(-2)
        vectors = torch.linalg.cross(b - a, c - a) / 2
        return vectors if self.present is None else vectors * self.present[..., None]

    def _vertex_sums(self, values: Float[Tensor, "b m c"]) -> Float[Tensor, "b n c"]:
        """At each vertex, over its faces."""
        sums = values.new_zeros(len(values), self.vertices.shape[1], values.shape[-1])
        for corner in self.faces.T:
            sums.index_add_(1, corner, values)
        return sums

    def _at(
        self, values: Float[Tensor, "b n c"], chosen: Int[Tensor, "b k"]
    ) -> Float[Tensor, "b k 3 c"]:
        """Values at the corners of faces."""
        rows = torch.arange(len(values))[:, None, None]
        return values[rows, self.faces[chosen]]


def _faces(n: int, surfaces: Surfaces, targets: Tensor, code: dict[str, Any]) -> Cells:
    chosen = surfaces.draw(n)
    corners = surfaces.corners(chosen)
    edges = _edges(corners)
    normal = torch.linalg.cross(*edges.unbind(-1))
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    first = edges[..., 0] / torch.linalg.vector_norm(edges[..., 0], dim=-1, keepdim=True)
    frames = torch.stack([first, torch.linalg.cross(normal, first)], dim=-1)
    columns = [corners.mean(-2) - surfaces.centres, normal]
    if surfaces.wks is not None:
        columns.append(surfaces._at(surfaces.wks, chosen).mean(-2))
    # J takes the edges of the source, in its frame, to those of the target.
    to_frame = torch.linalg.inv(frames.mT @ edges)
    J = _edges(_images(targets, surfaces.faces[chosen])) @ to_frame[:, None]
    return Cells(torch.cat(columns, dim=-1), J, frames=frames, **code)


def _vertices(n: int, surfaces: Surfaces, targets: Tensor, code: dict[str, Any]) -> Cells:
    # A corner of a face drawn by area: a vertex has a third of the area of each of its faces.
    corner = torch.randint(3, (len(surfaces.vertices), n))
    chosen = surfaces.faces[surfaces.draw(n), corner]
    origin = torch.einsum(
        "bn,btnc->btc", surfaces.vertex_shares, targets.expand(len(corner), -1, -1, -1)
    )
    images = _images(targets, chosen) - origin[:, :, None]
    features = surfaces.vertex_features[torch.arange(len(corner))[:, None], chosen]
    return Cells(features, images, **code)


def _edges(corners: Float[Tensor, "*b 3 c"]) -> Float[Tensor, "*b c 2"]:
    a, b, c = corners.unbind(-2)
    return torch.stack([b - a, c - a], dim=-1)


def _images(
    targets: Float[Tensor, "#b t n c"], at: Int[Tensor, "b *k"]
) -> Float[Tensor, "b t *k c"]:
    """Of vertices of each source in each of its targets."""
    return torch.stack(
        [x[:, i] for x, i in zip(targets.expand(len(at), -1, -1, -1), at, strict=True)]
    )


class WholeShapes:
    """What a model has in place of samples, if it is trained on whole shapes alone."""

    samples: ClassVar[CellKind | None] = None

    def at(self, cells: Cells, code: Float[Tensor, "b t z"]) -> Tensor:
        """None.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"{type(self).__name__}.at: this model is trained on whole shapes, not on samples"
        )
