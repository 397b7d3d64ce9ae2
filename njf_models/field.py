"""Neural fields: networks that turn a triangle's features and a code into a 3×3 matrix."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

# A large batch goes through the layers so many rows at a time: in memory that the allocator reuses.
# Of larger arrays it returns every one to the system, and page faults cost as much as the layers.
_ROWS = 2048


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


class BilinearField(nn.Module):
    """Σₖ hₖ(code) Tₖ(features): a network of the code and one of the face, multiplied at last.

    As many functions on the surface as `rank`, and coefficients for each map. T does not depend on
    the code, so that a step evaluates it once for all of its maps, and a map costs a product. Good
    where one source has many targets, and a nonlinear code: T is a small network, h may be a large
    one.

    Args:
        code_size: size of the global code.
        in_features: number of features of each face.
        out_features: number of outputs per face, the entries of its matrix.
        width: size of the hidden layers of T; those of h are four times as wide.
        rank: number of functions.
    """

    def __init__(
        self,
        code_size: int,
        in_features: int,
        out_features: int = 9,
        width: int = 128,
        rank: int = 128,
    ) -> None:
        super().__init__()
        self.rank, self.out_features = rank, out_features
        self.of_code = layered((code_size, *[4 * width] * 3, rank))
        self.of_face = layered((in_features, *[width] * 3, rank * out_features))
        last = self.of_face[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(
        self,
        features: Float[Tensor, "m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face; arguments as of `FieldMLP`."""
        return self.combined(self.functions(features), code, part_of_face)

    def functions(self, features: Float[Tensor, "m f"]) -> Float[Tensor, "m k out"]:
        """T of every face, for all maps."""
        return self.of_face(features).unflatten(-1, (self.rank, self.out_features))

    def combined(
        self,
        functions: Float[Tensor, "m k out"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face from T of every face; the rest as for a call."""
        h = self.of_code(code.reshape(-1, code.shape[-1]))
        if part_of_face is not None:
            return torch.einsum("mk,mko->mo", h[part_of_face], functions)
        outputs = h @ functions.transpose(0, 1).flatten(1)  # (batch, m · out)
        return outputs.view(*code.shape[:-1], len(functions), self.out_features)

    def on(self, features: Float[Tensor, "m f"]) -> FieldOnFaces:
        """This field on given faces, of which T is evaluated now, for inference."""
        return FieldOnFaces(self, features)


class FieldOnFaces(nn.Module):
    """A bilinear field whose functions are known at the faces of one shape.

    Args:
        field: whose.
        features: (m, f) of the faces.
    """

    def __init__(self, field: BilinearField, features: Float[Tensor, "m f"]) -> None:
        super().__init__()
        self.field, self.features = field, features
        with torch.no_grad():
            self.functions = field.functions(features)

    def forward(
        self,
        features: Float[Tensor, "m f"],
        code: Float[Tensor, "*batch z"],
        part_of_face: Int[Tensor, "m"] | None = None,
    ) -> Float[Tensor, "*any out"]:
        """Outputs for every face.

        Raises:
            ValueError: other features than those it was made for.
        """
        if features is not self.features:
            raise ValueError("FieldOnFaces: this field is on the faces of another shape")
        return self.field.combined(self.functions, code, part_of_face)


def layered(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with the norms and activations of `FieldMLP` between."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes[:-1]):
        layers += [nn.Linear(fan_in, fan_out), nn.GroupNorm(4, fan_out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))
