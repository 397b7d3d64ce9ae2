"""DiffusionNet (Sharp, Attaiki, Crane and Ovsjanikov 2022) on diffpoisson's own operators.

A vertex learns of the rest of the surface by heat that spreads for a learned time, one for each
channel, and of directions by inner products of gradients. Neither knows the triangulation.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from njf_models.features import Shape
from njf_models.spectrum import Spectrum


class DiffusionBlock(nn.Module):
    """u + MLP(u, diffused u, gradient features), one layer of the network.

    Gradient features of the diffused channels are tanh(Re(conj z ⊙ A z)), where z are their
    gradients in the tangent plane as complex numbers and A is a learned complex matrix. On vectors
    in space, with the normal n, that is tanh(z · (A' z) + n · (A'' z × z)), and needs no basis.

    Args:
        width: number of channels.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        # From the neighbourhood to half of the shape, whose area is one.
        self.log_times = nn.Parameter(torch.linspace(-9, -2, width))
        self.real, self.imaginary = (nn.Linear(width, width, bias=False) for _ in range(2))
        self.mlp = nn.Sequential(
            nn.Linear(3 * width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, width),
        )  # fmt: skip

    def forward(self, shape: Shape, u: Float[Tensor, "n w"]) -> Float[Tensor, "n w"]:
        """The channels at the vertices of a shape with spectra."""
        times = self.log_times.exp()
        parts = zip(shape.spectra, shape.mesh.split_vertices(u), strict=True)
        seen = [torch.cat([x, *self._diffused(spectrum, x, times)], dim=1) for spectrum, x in parts]
        return u + self.mlp(torch.cat(seen))

    def _diffused(
        self, spectrum: Spectrum, u: Float[Tensor, "n w"], times: Float[Tensor, "w"]
    ) -> tuple[Float[Tensor, "n w"], Float[Tensor, "n w"]]:
        """The diffused channels of one shape, and their gradient features."""
        spread = spectrum.diffused(u, times)
        z = spectrum.gradients(spread)
        turned = _triple_product(spectrum.normals.to(u.dtype).T[..., None], self.imaginary(z), z)
        return spread, torch.tanh((z * self.real(z)).sum(0) + turned)


def _triple_product(
    n: Float[Tensor, "3 n 1"], a: Float[Tensor, "3 n w"], b: Float[Tensor, "3 n w"]
) -> Float[Tensor, "n w"]:
    """n · (a × b), a few times faster than `torch.linalg.cross`."""
    cyclic = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    terms = [n[i] * (a[j] * b[k] - a[k] * b[j]) for i, j, k in cyclic]
    return terms[0] + terms[1] + terms[2]


class DiffusionNet(nn.Module):
    """Features of the vertices to outputs at the vertices.

    Args:
        in_features: number of the features of a vertex.
        out_features: number of outputs.
        width: channels of the blocks.
        n_blocks: how many.
    """

    def __init__(
        self, in_features: int, out_features: int, width: int = 64, n_blocks: int = 4
    ) -> None:
        super().__init__()
        self.first = nn.Linear(in_features, width)
        self.blocks = nn.ModuleList(DiffusionBlock(width) for _ in range(n_blocks))
        self.last = nn.Linear(width, out_features)

    def forward(self, shape: Shape) -> Float[Tensor, "n out"]:
        """Outputs at the vertices of a shape, or of several concatenated.

        Raises:
            ValueError: the shape was prepared without spectra.
        """
        if len(shape.spectra) != shape.mesh.n_parts:
            raise ValueError(
                f"DiffusionNet: a shape of {shape.mesh.n_parts} parts has {len(shape.spectra)} "
                "spectra; prepare it with n_eigenpairs"
            )
        u = self.first(shape.vertex_features)
        for block in self.blocks:
            u = block(shape, u)
        return self.last(u)
