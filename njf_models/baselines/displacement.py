"""The displacement field: an MLP that moves each vertex, instead of the Jacobian of each face."""

from __future__ import annotations

from typing import Any, ClassVar

from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.encoding import CodedModel
from njf_models.features import Shape
from njf_models.field import FieldMLP, PartField
from njf_models.njf import Centering, Prediction, centre_areas, centre_vertices
from njf_models.sampled import CellKind, Cells


class DisplacementField(CodedModel):
    """Φ(v) = v + f(features of v, code): the paper's baseline, with its network and code.

    Args:
        face_features: number of features of a vertex, the same as of a face (6, or 6 + k).
        point_features: number of features of the points the encoder sees; 0 for no encoder.
        encodes_target: as of `NeuralJacobianField`; the same holds for the rest.
        code_size: size of one code.
        parameters: number of user parameters appended to the code.
        output_dim: c, 3 for maps to space, 2 for maps to the plane.
        centering: see `NeuralJacobianField`.
        width: size of the hidden layers.
        parts: as of `NeuralJacobianField`, to tell what its field alone brings.
        octaves: of a `field.PartField`.
        coding: `rotations`, `basis`, `joints` and `code_scale` of `encoding.CodedModel`.
    """

    samples: ClassVar[CellKind | None] = "vertices"

    def __init__(
        self,
        face_features: int,
        point_features: int,
        *,
        encodes_target: bool = False,
        code_size: int = 1000,
        parameters: int = 0,
        output_dim: int = 3,
        centering: Centering = "area",
        width: int = 128,
        parts: int = 0,
        octaves: int = 0,
        **coding: Any,
    ) -> None:
        super().__init__(
            point_features,
            encodes_target=encodes_target,
            code_size=code_size,
            parameters=parameters,
            **coding,
        )
        self.output_dim, self.centering = output_dim, centering
        self.field: FieldMLP | PartField
        if parts:
            self.field = PartField(
                self.code_size,
                self.source_size,
                face_features,
                output_dim,
                parts=parts,
                width=width,
                octaves=octaves,
                rotations=self.n_matrices,
            )
        else:
            self.field = FieldMLP(self.code_size, face_features, output_dim, width)

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of a shape for each code; arguments as of `NeuralJacobianField`.

        Its Jacobians are those of the map, on the tangent planes and nought along the normals.
        """
        mesh = shape.mesh
        owner = mesh.part_of_vertex if mesh.n_parts > 1 else None
        moves = self.field(shape.vertex_features, code, owner)
        phi = shape.vertex_features[:, : self.output_dim] + moves
        phi = (centre_areas if self.centering == "area" else centre_vertices)(shape, phi)
        J = dp.jacobians(mesh, phi)
        return Prediction(dp.extend(J, shape.frames), J, phi)

    def at(self, cells: Cells, code: Float[Tensor, "b t z"]) -> Float[Tensor, "b t k c"]:
        """The images of sampled vertices alone, before the map is centred.

        Args:
            cells: vertices of b shapes.
            code: (b, t, z) codes of the maps of each.
        """
        features = cells.features[:, None]
        return features[..., : self.output_dim] + self.field(features, code)

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The one map; for training as of a model with rounds."""
        return [self(shape, code)]
