"""DiffusionNet (Sharp, Attaiki, Crane and Ovsjanikov 2022) on diffpoisson's own operators.

A vertex learns of the rest of the surface by heat that spreads for a learned time, one for each
channel, and of directions by inner products of gradients. Neither knows the triangulation.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

import diffpoisson as dp
from njf_models.features import Shape


class DiffusionBlock(nn.Module):
    """u + MLP(u, diffused u, gradient features), one layer of the network.

    Gradient features of the diffused channels are tanh(Re(conj z ⊙ A z)), where z are their
    gradients in the tangent plane as complex numbers and A is a learned complex matrix. On vectors
    in space, with the normal n, that is tanh(z · (A' z) + z · (n × A'' z)), and needs no basis.

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
        parts = shape.mesh.split_vertices(u)
        spread = torch.cat(
            [spectrum.diffused(x, times) for spectrum, x in zip(shape.spectra, parts, strict=True)]
        )
        z = vertex_gradients(shape, spread)
        normals = shape.vertex_features[:, 3:6, None].to(u.dtype)
        turned = torch.linalg.cross(normals.expand_as(z), self.imaginary(z), dim=1)
        products = torch.tanh((z * (self.real(z) + turned)).sum(1))
        return u + self.mlp(torch.cat([u, spread, products], dim=1))


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


def vertex_gradients(shape: Shape, u: Float[Tensor, "n w"]) -> Float[Tensor, "n 3 w"]:
    """Gradients of functions at the vertices: the mean over their faces, weighted by area.

    In space, in the pose that the features describe, for a shape of unit area.
    """
    mesh = shape.mesh
    at_faces = (dp.jacobians(mesh, u) @ shape.frames.mT.to(u.dtype)).mT  # (m, 3, w)
    areas = mesh.areas.to(u.dtype)
    sums = mesh.sum_at_vertices((areas[:, None, None] * at_faces).flatten(1))
    means = sums / (3 * mesh.vertex_areas.to(u.dtype))[:, None]
    unit = mesh.areas.new_zeros(mesh.n_parts).index_add(0, mesh.part_of_face, mesh.areas).sqrt()
    return (unit.to(u.dtype)[mesh.part_of_vertex, None] * means).unflatten(1, (3, -1))
