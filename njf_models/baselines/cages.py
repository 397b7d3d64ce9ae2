"""Neural Cages (Yifan et al. 2020): a network moves the vertices of a cage, and it the shape."""

from __future__ import annotations

from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.baselines.mean_value import build_cage, mean_value_coordinates
from njf_models.encoding import CodedModel
from njf_models.features import Shape, vertex_features
from njf_models.field import FieldMLP
from njf_models.njf import Centering, Prediction, centre_areas, centre_vertices
from njf_models.sampled import WholeShapes


class _Cage(NamedTuple):
    """A cage as the network sees it.

    Attributes:
        features: (k, 6) of its vertices.
        weights: (n, k) mean-value coordinates of the shape's vertices.
    """

    features: Float[Tensor, "k 6"]
    weights: Float[Tensor, "n k"]


class CageDeformation(WholeShapes, CodedModel):
    """Φ = V + W D: vertices follow, by mean-value coordinates W, a cage moved by D.

    The cage of a shape is its offset surface, decimated; Neural Cages also learn the cage. D is
    predicted vertex by vertex, from the cage's position and normal there and the code.

    Args:
        face_features: not used, for the cage has its own features; as other models have it.
        point_features: number of features of the points the encoder sees; 0 for no encoder.
        encodes_target: as of `NeuralJacobianField`; the same holds for the rest.
        code_size: size of one code.
        parameters: number of user parameters appended to the code.
        centering: see `NeuralJacobianField`.
        width: size of the hidden layers.
        cage_faces: number of faces of a cage.
        coding: `rotations`, `basis` and `code_scale` of `encoding.CodedModel`.
    """

    output_dim = 3

    def __init__(
        self,
        face_features: int,
        point_features: int,
        *,
        encodes_target: bool = False,
        code_size: int = 1000,
        parameters: int = 0,
        centering: Centering = "area",
        width: int = 128,
        cage_faces: int = 400,
        **coding: Any,
    ) -> None:
        super().__init__(
            point_features,
            encodes_target=encodes_target,
            code_size=code_size,
            parameters=parameters,
            **coding,
        )
        self.centering, self.cage_faces = centering, cage_faces
        self.field = FieldMLP(self.code_size, 6, 3, width)
        self._cages: WeakKeyDictionary[dp.Mesh, _Cage] = WeakKeyDictionary()

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of one closed shape for each code.

        Raises:
            ValueError: several concatenated shapes, or one that is not closed.
        """
        cage = self._cage(shape)
        phi = shape.vertex_features[:, :3] + cage.weights @ self.field(cage.features, code)
        phi = (centre_areas if self.centering == "area" else centre_vertices)(shape, phi)
        J = dp.jacobians(shape.mesh, phi)
        return Prediction(dp.extend(J, shape.frames), J, phi)

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The one map; for training as of a model with rounds."""
        return [self(shape, code)]

    def prepare(self, shape: Shape) -> None:
        """Make the cage of a shape now, which its first map would; it is kept with the shape."""
        self._cage(shape)

    def _cage(self, shape: Shape) -> _Cage:
        mesh = shape.mesh
        if mesh.n_parts > 1:
            raise ValueError(
                f"CageDeformation: a cage is around one shape, got {mesh.n_parts} concatenated"
            )
        if mesh not in self._cages:
            cage = build_cage(mesh, self.cage_faces)
            weights = mean_value_coordinates(mesh.vertices, cage.vertices, cage.faces)
            features = vertex_features(cage)
            dtype = shape.vertex_features.dtype
            self._cages[mesh] = _Cage(features.to(dtype), weights.to(dtype))
        return self._cages[mesh]
