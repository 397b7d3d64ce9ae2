"""The global network: all Jacobians of one mesh at once, from the code alone."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.encoding import CodedModel
from njf_models.features import Shape
from njf_models.layers import layered
from njf_models.njf import Centering, Prediction, centre_vertices
from njf_models.sampled import WholeShapes


class GlobalMLP(WholeShapes, CodedModel):
    """Code ↦ all m matrices R, then the Poisson solve: the paper's baseline for one fixed mesh.

    Of a shape with handles the solve is pinned to them, where the code says they are.

    Four hidden layers with the norms and activations of `FieldMLP`; the last starts at the
    identity map.

    Args:
        n_faces: of the one mesh that it maps.
        parameters: number of user parameters, which are the whole code.
        output_dim: c, 3 for maps to space, 2 for maps to the plane.
        centering: see `NeuralJacobianField`.
        width: size of the hidden layers.
    """

    def __init__(
        self,
        n_faces: int,
        parameters: int,
        *,
        output_dim: int = 3,
        centering: Centering = "area",
        width: int = 512,
    ) -> None:
        super().__init__(0, encodes_target=False, code_size=0, parameters=parameters)
        self.n_faces, self.output_dim, self.centering = n_faces, output_dim, centering
        self.layers = layered((parameters, *[width] * 4, n_faces * output_dim * 2))
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of the mesh for each code.

        Raises:
            ValueError: a mesh with another number of faces, or several packed ones.
        """
        mesh = shape.mesh
        if mesh.n_faces != self.n_faces or mesh.n_parts > 1:
            raise ValueError(
                f"GlobalMLP: this network is of one mesh with {self.n_faces} faces, got {mesh}"
            )
        rows = self.layers(code.reshape(-1, self.code_size))
        offsets = rows.view(*code.shape[:-1], self.n_faces, self.output_dim, 2)
        R = shape.frames[:, : self.output_dim] + offsets.to(shape.frames.dtype)
        phi = shape.solver(R) if shape.handles is None else shape.handles.solved(R, code)
        if self.centering == "vertex":
            phi = centre_vertices(shape, phi)
        return Prediction(dp.extend(R, shape.frames), R, phi)

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The one map; for training as of a model with rounds."""
        return [self(shape, code)]

    def extra_repr(self) -> str:
        """What it is made for."""
        return f"n_faces={self.n_faces}, weights={sum(map(torch.numel, self.parameters()))}"
