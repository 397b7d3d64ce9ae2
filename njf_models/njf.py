"""Neural Jacobian Fields (Aigerman et al. 2022): predict a matrix per face, then solve Poisson.

The paper predicts once. With more rounds, a network reads the Jacobians of the solved map back and
corrects them, and the map is solved again with the same factor: a learned alternation of a local
and a global step, as in local/global optimisation of a distortion energy (Liu et al. 2008).
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

import diffpoisson as dp
from diffpoisson.arguments import require_integer
from njf_models.encoding import CodedModel
from njf_models.features import Shape
from njf_models.field import FieldMLP, PartField
from njf_models.sampled import CellKind, Cells

Centering = Literal["area", "vertex"]


class Prediction(NamedTuple):
    """Output of `NeuralJacobianField`.

    Attributes:
        matrices: (…, m, c, 3) P, the matrix predicted for each face.
        jacobians: (…, m, c, 2) R = P B, its restriction to the tangent plane.
        vertices: (…, n, c) Φ, the map whose Jacobians are closest to R.
    """

    matrices: Float[Tensor, "*batch m c 3"]
    jacobians: Float[Tensor, "*batch m c 2"]
    vertices: Float[Tensor, "*batch n c"]


class NeuralJacobianField(CodedModel):
    """The paper's network: PointNet codes, a field of matrices, restriction, Poisson solve.

    Args:
        face_features: number of centroid features (6, or 6 + k with a k-dimensional WKS).
        point_features: number of features of the points the encoder sees; 0 for no encoder.
        encodes_target: the code is [source code | target code] from one shared encoder, not the
            source's alone.
        code_size: size z of one code.
        parameters: number of user parameters appended to the code (a target pose, handle
            positions).
        output_dim: c, 3 for maps to space, 2 for maps to the plane.
        rounds: number of predictions, each followed by a solve; 1 is the paper's network.
        shared_rounds: whether all corrections have one network, or each its own.
        local_step: what a correction adds to: rotations closest to the Jacobians of the solved map,
            as in local/global methods, or these Jacobians themselves. For maps to the plane.
        centering: whether the emitted map has area-weighted mean zero on each component (the
            paper), or its plain mean over vertices is zero (the authors' experiments).
        width: size of the field's hidden layers.
        parts: make the first field a `field.PartField` of so many parts; 0 for the paper's MLP.
        octaves: of a `field.PartField`.
        coding: `rotations`, `basis`, `joints` and `code_scale` of `encoding.CodedModel`.
    """

    samples: ClassVar[CellKind | None] = "faces"

    def __init__(
        self,
        face_features: int,
        point_features: int,
        *,
        encodes_target: bool = False,
        code_size: int = 1000,
        parameters: int = 0,
        output_dim: int = 3,
        rounds: int = 1,
        shared_rounds: bool = False,
        centering: Centering = "area",
        width: int = 128,
        local_step: bool = False,
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
        if centering not in ("area", "vertex"):
            raise ValueError(f"centering must be 'area' or 'vertex', got {centering!r}")
        require_integer("NeuralJacobianField", "rounds", rounds, least=1)
        if local_step and output_dim != 2:
            raise ValueError(f"local_step is for maps to the plane, got output_dim={output_dim}")
        self.output_dim, self.centering = output_dim, centering
        self.rounds, self.shared_rounds, self.local_step = rounds, shared_rounds, local_step
        entries = output_dim * 3
        self.field: FieldMLP | PartField
        if parts:
            self.field = PartField(
                self.code_size,
                self.source_size,
                face_features,
                entries,
                parts=parts,
                width=width,
                octaves=octaves,
                rotations=self.n_matrices,
            )
        else:
            self.field = FieldMLP(self.code_size, face_features, entries, width)
        self.corrections = nn.ModuleList(
            FieldMLP(self.code_size, face_features + (2 + local_step) * entries, entries, width)
            for _ in range(min(rounds - 1, 1) if shared_rounds else rounds - 1)
        )

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of a shape for each code; that of the last round.

        Args:
            shape: one prepared shape, or several concatenated.
            code: (…, z) codes for one shape, or (parts, z) one code for each of the concatenated
                shapes.
        """
        return self.iterates(shape, code)[-1]

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The maps after each round; arguments as for a call."""
        mesh = shape.mesh
        part_of_face = mesh.part_of_face if mesh.n_parts > 1 else None
        if part_of_face is not None and code.shape[:-1] != (mesh.n_parts,):
            raise ValueError(
                f"NeuralJacobianField: {mesh.n_parts} concatenated shapes need codes of shape "
                f"({mesh.n_parts}, z), got {tuple(code.shape)}"
            )
        predictions = [self.solved(shape, self.matrices(shape.features, code, part_of_face))]
        for k in range(self.rounds - 1):
            correction = self.corrections[0 if self.shared_rounds else k]
            base, seen = self._read_back(shape, predictions[-1])
            offsets = correction(seen, code, part_of_face)
            predictions.append(self.solved(shape, base + self._matrices(offsets)))
        return predictions

    def at(self, cells: Cells, code: Float[Tensor, "b t z"]) -> Float[Tensor, "b t k c 2"]:
        """The Jacobians R of sampled faces alone, for which nothing is solved.

        Args:
            cells: faces of b shapes.
            code: (b, t, z) codes of the maps of each.

        Raises:
            ValueError: the cells are vertices; or the model has more rounds, which read a solved
                map.
        """
        if self.rounds > 1:
            raise ValueError(
                f"NeuralJacobianField.at: samples train a single prediction, not {self.rounds} "
                "rounds"
            )
        if cells.frames is None:
            raise ValueError("NeuralJacobianField.at: cells must be faces, with their frames")
        P = self.matrices(cells.features[:, None], code).to(cells.frames.dtype)
        # `restrict` has one frame for each face, here of all shapes: (t, b k, c, 3).
        R = dp.restrict(P.transpose(0, 1).flatten(1, 2), cells.frames.flatten(0, 1))
        return R.unflatten(1, (len(P), -1)).transpose(0, 1)

    def matrices(
        self,
        features: Float[Tensor, "*#batch m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any c 3"]:
        """P of the first prediction, I plus what the field says; arguments as of `FieldMLP`."""
        return self.from_identity(self.field(features, code, part_of_face))

    def from_identity(self, offsets: Float[Tensor, "*any entries"]) -> Float[Tensor, "*any c 3"]:
        """I plus matrices of which these are the entries."""
        identity = torch.eye(self.output_dim, 3, dtype=offsets.dtype, device=offsets.device)
        return identity + self._matrices(offsets)

    def _matrices(self, outputs: Float[Tensor, "*any entries"]) -> Float[Tensor, "*any c 3"]:
        return outputs.unflatten(-1, (self.output_dim, 3))

    def solved(
        self,
        shape: Shape,
        P: Float[Tensor, "*batch m c 3"],
        base: Float[Tensor, "m 3 2"] | None = None,
    ) -> Prediction:
        """The map of matrices: R = P B, solved and centred.

        Args:
            shape: the source.
            P: matrices of its faces.
            base: (m, 3, 2) Jacobians of a map that this one follows, instead of B: R = P J.
        """
        P = P.to(shape.frames.dtype)  # under autocast the field answers in half precision
        R = dp.restrict(P, shape.frames if base is None else base)
        phi = shape.solver(R)
        if self.centering == "vertex":
            phi = centre_vertices(shape, phi)
        return Prediction(P, R, phi)

    def _read_back(
        self, shape: Shape, prediction: Prediction
    ) -> tuple[Float[Tensor, "*batch m c 3"], Float[Tensor, "*batch m f"]]:
        """What a correction adds to, and what it sees: J, how far it misses R, closest rotations.

        On ambient vectors, where nothing depends on the frames.
        """
        J = dp.jacobians(shape.mesh, prediction.vertices)
        seen = [J, prediction.jacobians - J]
        if self.local_step:
            seen.append(dp.closest_rotation(J))
        seen = [dp.extend(matrices, shape.frames) for matrices in seen]
        features = shape.features.expand(*J.shape[:-2], -1)
        base = seen[-1] if self.local_step else seen[0]
        return base, torch.cat([features, *(matrices.flatten(-2) for matrices in seen)], dim=-1)


def centre_vertices(shape: Shape, phi: Float[Tensor, "*batch n c"]) -> Float[Tensor, "*batch n c"]:
    """Translate the map of each part so that the plain mean of its vertices is zero."""
    parts = shape.mesh.split_vertices(phi, dim=-2)
    return torch.cat([part - part.mean(dim=-2, keepdim=True) for part in parts], dim=-2)


def centre_areas(shape: Shape, phi: Float[Tensor, "*batch n c"]) -> Float[Tensor, "*batch n c"]:
    """Translate the map of each part so that its area-weighted mean is zero."""
    weighted = shape.vertex_weights.to(phi.dtype)[:, None] * phi
    means = [part.sum(dim=-2, keepdim=True) for part in shape.mesh.split_vertices(weighted, dim=-2)]
    parts = shape.mesh.split_vertices(phi, dim=-2)
    return torch.cat([part - mean for part, mean in zip(parts, means, strict=True)], dim=-2)
