"""Samples of maps: some cells of several shapes, to train on without a Poisson solve.

The Jacobian term of the loss compares each face's matrix with a target of its own, so that some
faces of many shapes do for a step, instead of all faces of one. Cells are drawn by area, so that
plain means over them have the area-weighted sums of the paper's loss for their expectation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp
from njf_models.features import face_features, vertex_features

CellKind = Literal["faces", "vertices"]


@dataclass(frozen=True)
class Cells:
    """Samples of the maps of one shape to t targets; with an axis in front, of several shapes.

    Attributes:
        features: (k, f) features of the cells, faces or vertices.
        target: (t, k, c, 2) Jacobians of faces, or (t, k, c) images of vertices.
        points: (s, f) point features of the source, for the encoder.
        frames: (k, 3, 2) tangent bases of faces; None for vertices.
        target_points: (t, s, f) point features of the targets, if the code is made from them.
        parameters: (t, p) parameters of the targets, if they have any.
        partners: (b, t) which of the b shapes the targets are, if each is source and target: their
            points are then those of the sources, encoded once.
    """

    features: Float[Tensor, "*b k f"]
    target: Float[Tensor, "*b t k *c"]
    points: Float[Tensor, "*b s f"]
    frames: Float[Tensor, "*b k 3 2"] | None = None
    target_points: Float[Tensor, "*b t s f"] | None = None
    parameters: Float[Tensor, "*b t p"] | None = None
    partners: Int[Tensor, "b t"] | None = None

    @classmethod
    def draw(
        cls,
        kind: CellKind,
        n_cells: int,
        mesh: dp.Mesh,
        wks: Float[Tensor, "n k"] | None,
        target: Float[Tensor, "t n c"],
        **code: Any,
    ) -> Cells:
        """Cells of one shape, drawn with replacement by their area.

        Args:
            kind: faces with their Jacobians, or vertices with their images, of which the target's
                mean over the area is the origin.
            n_cells: how many.
            mesh: the source.
            wks: its wave-kernel signature, if the network sees one.
            target: images of its vertices.
            code: `points`, and `target_points` and `parameters` if there are any.
        """
        faces = dp.sample_surface(mesh, n_cells).faces
        if kind == "faces":
            J = dp.jacobians(mesh, target)[:, faces]
            features, frames = face_features(mesh, wks)[faces], mesh.frames[faces]
            return cls(features.float(), J, frames=frames.float(), **code)
        # A corner of a face drawn by area: a vertex has a third of the area of each of its faces.
        chosen = mesh.faces[faces, torch.randint(3, (n_cells,))]
        weights = (mesh.vertex_areas / mesh.areas.sum()).to(target.dtype)
        images = (target - (weights @ target)[:, None])[:, chosen]
        return cls(vertex_features(mesh, wks)[chosen].float(), images, **code)

    @classmethod
    def stack(cls, samples: Sequence[Cells]) -> Cells:
        """Samples of several shapes, of as many cells and targets each."""
        columns = {field.name: [getattr(s, field.name) for s in samples] for field in fields(cls)}
        stacked: dict[str, Any] = {
            name: None if column[0] is None else torch.stack(column)
            for name, column in columns.items()
        }
        return cls(**stacked)


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
