"""A Jacobian field of few functions, whose coefficients are corrected by what the map strains.

The matrices are a sum Σₖ hₖ Tₖ of functions on the surface, and the Poisson solve is linear: it is
done once for each function, not for each map. In each further round a network reads how far the
Jacobians of the map are from isometries, pooled over the surface against the functions' own
Jacobians, ∂/∂hₖ of ½ Σ |t| ‖J - Q‖²: the gradient of the surface's energy of as-rigid-as-possible
maps. What strains a map tells a network more of where it should be than its code alone does.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

import diffpoisson as dp
from diffpoisson.arguments import require_integer
from njf_models.encoding import CodedModel
from njf_models.features import Shape
from njf_models.handles import Handles
from njf_models.layers import layered
from njf_models.njf import Prediction
from njf_models.sampled import WholeShapes


class Basis(NamedTuple):
    """The functions of a `ModalNJF` on one shape, and where its rounds read; float32.

    Attributes:
        fields: (r, m, c, 2) T B, what each adds to the Jacobians.
        maps: (r, n, c) U, what each adds to the map: its Poisson solve, nought at the handles.
        rest: (n, c) the map without any of them, if nothing is moved.
        harmonic: (k, n, c) what each amount of the handles adds to it.
        read: (r, f, c, 2) Jacobians of U at the faces that are read.
        read_rest: (f, c, 2) those of `rest`.
        read_harmonic: (k, f, c, 2) those of `harmonic`.
        weights: (f,) of these faces, of sum one.
    """

    fields: Float[Tensor, "r m c 2"]
    maps: Float[Tensor, "r n c"]
    rest: Float[Tensor, "n c"]
    harmonic: Float[Tensor, "k n c"]
    read: Float[Tensor, "r f c 2"]
    read_rest: Float[Tensor, "f c 2"]
    read_harmonic: Float[Tensor, "k f c 2"]
    weights: Float[Tensor, "f"]


class ModalNJF(WholeShapes, CodedModel):
    """Code ↦ coefficients; R = J + Σₖ hₖ Tₖ B, J that of the harmonic map; pinned Poisson solve.

    For shapes with handles, see `Shape.with_handles`. T is a network of each face's centroid and
    normal, and of the harmonic weights of the handles there, so that any triangulation has it.
    `modal_training.fit_modal` trains it.

    Args:
        parameters: size of the code.
        amounts: number of amounts of the handles (`Handles.moves`).
        output_dim: c, 3 for maps to space, 2 for maps to the plane.
        rank: number of functions.
        rounds: number of predictions: the first from the code alone, the others from what they read
            too, all by one network.
        width: size of the hidden layers of T.
        code_width: size of those of the networks of the coefficients.
        reads: faces that are read, drawn by area once for each shape; all of them if they are no
            more.
        relative: the code is points in space, whose mean is taken off before a network sees them:
            moved all alike, they move the map alone.
    """

    mean: Tensor
    scale: Tensor
    reading_mean: Tensor
    reading_scale: Tensor
    step_scale: Tensor

    def __init__(
        self,
        parameters: int,
        amounts: int,
        *,
        output_dim: int = 3,
        rank: int = 96,
        rounds: int = 3,
        width: int = 128,
        code_width: int = 256,
        reads: int = 1024,
        relative: bool = False,
    ) -> None:
        super().__init__(0, encodes_target=False, code_size=0, parameters=parameters)
        require_integer("ModalNJF", "rounds", rounds, least=1)
        self.output_dim, self.rank, self.rounds = output_dim, rank, rounds
        self.reads, self.relative = reads, relative
        self.of_face = layered((6 + amounts, *[width] * 3, rank * output_dim * 3))
        self.first = layered((parameters, *[code_width] * 3, rank))
        self.correction = layered((parameters + 2 * rank, *[code_width] * 3, rank))
        self.step = nn.Linear(rank, rank)
        for last in (self.first[-1], self.correction[-1], self.step):
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)
        for name in ("mean", "reading_mean"):
            self.register_buffer(name, torch.zeros(rank))
        for name in ("scale", "reading_scale", "step_scale"):
            self.register_buffer(name, torch.ones(rank))
        self._kept: tuple[Shape, Basis] | None = None

    # ---------------------------------------------------------------- of the shape alone

    def face_inputs(self, shape: Shape) -> Float[Tensor, "m f"]:
        """What T sees of each face: centroid, normal, and how far each amount moves it."""
        weights = torch.linalg.vector_norm(_handles(shape).harmonic, dim=-1).T  # (n, k)
        return torch.cat([shape.features[:, :6], weights[shape.mesh.faces].mean(1).float()], dim=1)

    @torch.no_grad()
    def basis(self, shape: Shape) -> Basis:
        """The functions on a shape.

        Raises:
            ValueError: a shape without handles.
        """
        handles, mesh, c = _handles(shape), shape.mesh, self.output_dim
        P = self.of_face(self.face_inputs(shape)).view(-1, self.rank, c, 3).transpose(0, 1)
        fields = dp.restrict(P.to(shape.frames.dtype), shape.frames)
        nought = handles.origin.new_zeros(self.rank, *handles.origin.shape)
        maps = handles.solver(fields, pins=nought)
        faces, weights = self._read_faces(mesh)
        read, of_rest, of_harmonic = (
            dp.jacobians(mesh, phi)[..., faces, :, :].float()
            for phi in (maps, handles.rest, handles.harmonic)
        )
        rest, harmonic = handles.rest.float(), handles.harmonic.float()
        parts = (fields, maps, rest, harmonic, read, of_rest, of_harmonic, weights)
        return Basis(*(part.contiguous() for part in parts))  # sums over them would copy them

    def _read_faces(self, mesh: dp.Mesh) -> tuple[Int[Tensor, "f"], Float[Tensor, "f"]]:
        if mesh.n_faces <= self.reads:
            return torch.arange(mesh.n_faces), (mesh.areas / mesh.areas.sum()).float()
        generator = torch.Generator().manual_seed(0)
        faces = dp.sample_surface(mesh, self.reads, generator=generator).faces
        return faces, torch.full((self.reads,), 1 / self.reads)

    def with_rounds(self, rounds: int) -> ModalNJF:
        """The same network, stopped after so many rounds, or going on."""
        require_integer("ModalNJF", "rounds", rounds, least=1)
        model = copy.copy(self)
        model.rounds = rounds
        return model

    def on(self, shape: Shape) -> ModalNJF:
        """A network for inference on this shape, for many maps: its functions are kept."""
        model = copy.copy(self)
        model._kept = shape, self.basis(shape)
        return model.eval()

    # ---------------------------------------------------------------- of the code

    def coefficients(
        self, shape: Shape, basis: Basis, code: Float[Tensor, "t z"]
    ) -> list[Float[Tensor, "t r"]]:
        """h after each round."""
        rounds = [self.first_guess(code)]
        amounts = _handles(shape).amounts(code)
        for _ in range(self.rounds - 1):
            reading = self.reading(basis, amounts, rounds[-1])
            rounds.append(self.corrected(code, rounds[-1], reading))
        return rounds

    def first_guess(self, code: Float[Tensor, "t z"]) -> Float[Tensor, "t r"]:
        """h from the code alone."""
        return self.mean + self.scale * self.first(self._seen(code))

    def corrected(
        self, code: Float[Tensor, "t z"], h: Float[Tensor, "t r"], reading: Float[Tensor, "t r"]
    ) -> Float[Tensor, "t r"]:
        """h of the next round."""
        z = (reading - self.reading_mean) / self.reading_scale
        seen = torch.cat([self._seen(code), (h - self.mean) / self.scale, z], dim=-1)
        return h + self.step_scale * (self.correction(seen) + self.step(z))

    def reading(
        self, basis: Basis, amounts: Float[Tensor, "t k"], h: Float[Tensor, "t r"]
    ) -> Float[Tensor, "t r"]:
        """Σ |t| ⟨J - Q, ∇Uₖ⟩ over the faces that are read, Q the isometry closest to J."""
        J = basis.read_rest + _combined(amounts, basis.read_harmonic) + _combined(h, basis.read)
        strain = basis.weights[:, None, None] * (J - closest_isometry(J))
        return strain.flatten(1) @ basis.read.flatten(1).T

    def _seen(self, code: Float[Tensor, "t z"]) -> Float[Tensor, "t z"]:
        if not self.relative:
            return code
        points = code.unflatten(-1, (-1, self.output_dim))
        return (points - points.mean(dim=-2, keepdim=True)).flatten(-2)

    # ---------------------------------------------------------------- maps

    def forward(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> Prediction:
        """The map of a shape with handles for each code; that of the last round.

        Raises:
            ValueError: a shape without handles.
        """
        return self._maps(shape, code, only_last=True)[-1]

    def iterates(self, shape: Shape, code: Float[Tensor, "*batch z"]) -> list[Prediction]:
        """The maps after each round; arguments as for a call."""
        return self._maps(shape, code, only_last=False)

    def _maps(
        self, shape: Shape, code: Float[Tensor, "*batch z"], *, only_last: bool
    ) -> list[Prediction]:
        kept = self._kept is not None and self._kept[0] is shape
        basis = self._kept[1] if kept and self._kept is not None else self.basis(shape)
        codes, batch = code.reshape(-1, code.shape[-1]), code.shape[:-1]
        start = basis.rest + _combined(_handles(shape).amounts(codes), basis.harmonic)
        J = dp.jacobians(shape.mesh, start)
        rounds = self.coefficients(shape, basis, codes)
        predictions = []
        for h in rounds[-1:] if only_last else rounds:
            R, phi = J + _combined(h, basis.fields), start + _combined(h, basis.maps)
            R, phi = R.view(*batch, *R.shape[1:]), phi.view(*batch, *phi.shape[1:])
            predictions.append(Prediction(dp.extend(R, shape.frames), R, phi))
        return predictions


def _handles(shape: Shape) -> Handles:
    if shape.handles is None:
        raise ValueError("ModalNJF: this maps shapes with handles; see Shape.with_handles")
    return shape.handles


def _combined(h: Float[Tensor, "t r"], parts: Float[Tensor, "r *any"]) -> Float[Tensor, "t *any"]:
    return (h.to(parts.dtype) @ parts.flatten(1)).unflatten(-1, parts.shape[1:])


def closest_isometry(J: Float[Tensor, "*batch c 2"]) -> Float[Tensor, "*batch c 2"]:
    """`diffpoisson.closest_rotation` of triangles, by a square root of JᵀJ instead of an SVD.

    (JᵀJ)^½ = (JᵀJ + s) / t with s² = det JᵀJ, t² = tr JᵀJ + 2s. Nought where the triangle has
    collapsed to a line.
    """
    if J.shape[-2] == 2:
        return dp.closest_rotation(J)
    u, v = J.unbind(-1)
    a, b, c = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    s = torch.linalg.vector_norm(torch.linalg.cross(u, v), dim=-1)
    product = s * (a + c + 2 * s).sqrt()
    scale = torch.where(product > 0, product, 1).reciprocal()
    columns = [(c + s)[..., None] * u - b[..., None] * v, (a + s)[..., None] * v - b[..., None] * u]
    return scale[..., None, None] * torch.stack(columns, dim=-1)
