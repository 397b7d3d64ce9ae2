"""Neural fields: networks that turn a triangle's features and a code into a 3×3 matrix."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from njf_models.layers import smooth_layers
from njf_models.products import MatrixProducts

# A large batch goes through the layers so many rows at a time: in memory that the allocator reuses.
# Of larger arrays it returns every one to the system, and page faults cost as much as the layers.
_ROWS = 2048

# Shares of parts, at the start of a training, are those of the nearest few parts, not of all alike.
_SHARPNESS = 3.0

_OCTAVE = 2  # how much shorter each wave of a coordinate is than the one before


class FieldMLP(nn.Module):
    """Five linear layers, 128 wide, group norms between; the last starts at zero: the identity map.

    `layers` is the network on [code | features]. `forward` computes the same faster. The halves of
    the first layer are applied apart, W [c | f] = W₁c + W₂f, so that the code is multiplied once
    per shape and no (faces × code) array exists. And the mean of a group of channels is linear in
    them, so it is taken out of the weights instead of every row.

    Args:
        code_size: size of the global code; 0 for none.
        in_features: number of features of each face.
        out_features: number of outputs per face, the entries of its matrix.
        width: size of the hidden layers.
    """

    def __init__(
        self, code_size: int, in_features: int, out_features: int = 9, width: int = 128
    ) -> None:
        super().__init__()
        self.code_size = code_size
        sizes = (code_size + in_features, width, width, width, width)
        layers: list[nn.Module] = []
        for fan_in in sizes[:-1]:
            layers += [nn.Linear(fan_in, width), nn.GroupNorm(4, width), nn.ReLU()]
        last = nn.Linear(width, out_features)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*layers, last)

    def forward(
        self,
        features: Float[Tensor, "*#batch m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face.

        Args:
            features: (m, f) features of the faces, or (…, m, f) with a code for each.
            code: (…, z), every code with every face, if `part_of_face` is None; else (parts, z),
                one code for the faces of each part of a packed batch.
            part_of_face: (m,) the code that belongs to each face.

        Returns:
            (…, m, out), or (m, out) if packed.
        """
        (weight, bias, norm), *others = self._centred_layers()
        of_code, of_features = weight.split((self.code_size, features.shape[-1]), dim=1)
        per_code = functional.linear(code, of_code, bias)

        def outputs(x: Tensor) -> Tensor:
            x = _scaled_relu(x, norm)
            for weight, bias, scale in others:
                x = _scaled_relu(functional.linear(x, weight, bias), scale)
            return self.layers[-1](x)

        if part_of_face is not None:
            pieces = zip(features.split(_ROWS), part_of_face.split(_ROWS), strict=True)
            return torch.cat(
                [outputs(per_code[i] + functional.linear(x, of_features)) for x, i in pieces]
            )
        per_face = functional.linear(features, of_features)
        batch, (n_faces, width) = per_code.shape[:-1], per_face.shape[-2:]
        n_codes = max(1, _ROWS // max(1, n_faces))
        codes = per_code.reshape(-1, 1, width).split(n_codes)
        if per_face.ndim == 2:
            faces = [per_face] * len(codes)
        else:
            faces = per_face.expand(*batch, -1, -1).reshape(-1, n_faces, width).split(n_codes)
        rows = torch.cat(
            [
                torch.cat([outputs(c + piece) for piece in f.split(_ROWS, dim=-2)], dim=-2)
                for c, f in zip(codes, faces, strict=True)
            ]
        )
        return rows.unflatten(0, batch) if batch else rows[0]

    def _centred_layers(self) -> Iterator[tuple[Tensor, Tensor, nn.GroupNorm]]:
        """Weight and bias of the hidden layers, so that each group of outputs has mean zero."""
        layers = list(self.layers)
        for linear, norm in zip(layers[:-1:3], layers[1:-1:3], strict=True):
            assert isinstance(linear, nn.Linear)
            assert isinstance(norm, nn.GroupNorm)
            yield _centred(linear.weight, norm), _centred(linear.bias, norm), norm


def _centred(values: Float[Tensor, "channels *any"], norm: nn.GroupNorm) -> Tensor:
    groups = values.unflatten(0, (norm.num_groups, -1))
    return (groups - groups.mean(1, keepdim=True)).flatten(0, 1)


def _scaled_relu(x: Float[Tensor, "*rows channels"], norm: nn.GroupNorm) -> Tensor:
    """The group norm of rows whose groups have mean zero, and ReLU."""
    groups = x.unflatten(-1, (norm.num_groups, -1))
    scaled = functional.rms_norm(groups, groups.shape[-1:], eps=norm.eps).flatten(-2)
    return torch.addcmul(norm.bias, scaled, norm.weight).relu_()


class PartField(nn.Module):
    """Σₖ wₖ(face, source) Mₖ(code): a few matrices for each map, blended over the surface.

    As in skinning, where a surface moves with its bones. The weights w are a network of each face
    and of the source's part of the code, so that a step evaluates them once for all maps of a
    source; the matrices M are a network of the whole code, evaluated once for each map. So a map
    costs a product of two small arrays. Some weights are shares, which sum to one at each face, as
    of bones; others may be anything, for what happens between the bones.

    Weights change quickly over a surface, as at the armpits, which a network of positions is slow
    to learn; so w may see waves of the positions, too (Tancik et al. 2020). And where a code tells
    rotations, M has products of them (`products.MatrixProducts`) beside what the network adds.

    Args:
        code_size: size of the global code, of which the source's part comes first.
        source_size: size of the source's part.
        in_features: number of features of each face.
        out_features: number of outputs per face, the entries of its matrix.
        parts: number of matrices, a quarter of which have shares for weights.
        width: size of the hidden layers of w; those of M are half as wide again.
        octaves: how many waves of each coordinate w sees, the first of which is 2 units long, each
            other half as long as the one before.
        rotations: how many 3×3 matrices less the identity end the code.
    """

    def __init__(
        self,
        code_size: int,
        source_size: int,
        in_features: int,
        out_features: int = 9,
        *,
        parts: int = 128,
        width: int = 128,
        octaves: int = 0,
        rotations: int = 0,
    ) -> None:
        super().__init__()
        if parts % 4:
            raise ValueError(f"PartField: the number of parts must be a multiple of 4, got {parts}")
        self.source_size, self.out_features = source_size, out_features
        self.shares = parts // 4
        self.octaves, self.rotations = octaves, rotations
        self.of_face = FieldMLP(source_size, in_features + 6 * octaves, parts, width)
        last = self.of_face.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.normal_(last.weight, std=width**-0.5)  # not zero, or no part would differ
        self.of_code = smooth_layers((code_size, *[3 * width // 2] * 3, parts * out_features))
        last = self.of_code[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        if rotations:
            self.of_rotations = MatrixProducts(rotations, parts, out_features // 3)

    def forward(
        self,
        features: Float[Tensor, "*#batch m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face.

        Args:
            features: (m, f) features of the faces of one source; or (b, 1, m, f), of several.
            code: (…, z) codes of maps of the one source, or (b, t, z) of t maps of each of several.
            part_of_face: (m,) the code, one of (parts, z), that belongs to each face, if the
                surface is packed.

        Returns:
            (…, m, out), or (m, out) if packed.

        Raises:
            ValueError: maps of one source have codes of different sources.
        """
        M = self.parts(code)
        if part_of_face is not None:
            w = self.weights(features, code[:, : self.source_size], part_of_face)
            return torch.einsum("mk,mko->mo", w, M[part_of_face])
        if features.ndim > 2:
            source = self._one_source(code[..., : self.source_size])
            return self.weights(features[:, 0], source)[:, None] @ M
        source = self._one_source(code.reshape(-1, code.shape[-1])[:, : self.source_size])
        return self.weights(features, source) @ M

    def weights(
        self,
        features: Float[Tensor, "*any f"],
        source: Float[Tensor, "*b z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any k"]:
        """w of each face; arguments as of `FieldMLP`, but the source's part of the codes only."""
        x = features[..., :3]
        waves = [
            f(torch.pi * _OCTAVE**k * x)
            for k in range(self.octaves)
            for f in (torch.sin, torch.cos)
        ]
        w = self.of_face(torch.cat([features, *waves], dim=-1), source, part_of_face)
        shares, others = w.split((self.shares, w.shape[-1] - self.shares), dim=-1)
        return torch.cat([(_SHARPNESS * shares).softmax(-1), others], dim=-1)

    def parts(self, code: Float[Tensor, "*batch z"]) -> Float[Tensor, "*batch k out"]:
        """M of each map."""
        codes = code.reshape(-1, code.shape[-1])
        M = self.of_code(codes)
        if self.rotations:
            told = codes[:, -9 * self.rotations :].unflatten(-1, (-1, 3, 3))
            M = M + self.of_rotations(told).reshape(M.shape)
        return M.view(*code.shape[:-1], -1, self.out_features)

    def _one_source(self, sources: Float[Tensor, "*b t z"]) -> Float[Tensor, "*b z"]:
        first = sources[..., :1, :]
        if not torch.equal(first.expand_as(sources), sources):
            raise ValueError(
                "PartField: the maps of one shape have codes of different sources; encode the "
                "shape once, for all of its maps"
            )
        return first.squeeze(-2)
