"""Partial surfaces, as scans are: pieces of a mesh cut away."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

import diffpoisson as dp
from diffpoisson.topology import component_labels


class Partial(NamedTuple):
    """What is left of a mesh.

    Attributes:
        mesh: one component.
        kept: (k,) vertices of the whole mesh that its vertices are.
        faces: (j,) faces of the whole mesh that its faces are.
    """

    mesh: dp.Mesh
    kept: Int[Tensor, "k"]
    faces: Int[Tensor, "j"]


def cut_pieces(
    mesh: dp.Mesh,
    n_pieces: int,
    radii: tuple[float, float],
    generator: torch.Generator | None = None,
) -> Partial:
    """Cut balls around random points out of a surface, and keep the largest part that is left.

    Args:
        mesh: the whole surface.
        n_pieces: number of balls, whose centres are drawn by area.
        radii: least and largest radius, in the mesh's units; uniform.
        generator: source of randomness; torch's global one if omitted.

    Raises:
        ValueError: nothing is left.
    """
    centres = dp.sample_surface(mesh, n_pieces, generator=generator)
    at = centres.interpolate(mesh, mesh.vertices)
    low, high = radii
    radius = low + (high - low) * torch.rand(n_pieces, dtype=mesh.dtype, generator=generator)
    outside = (torch.cdist(mesh.centroids, at) > radius).all(dim=1)
    if not outside.any():
        raise ValueError(f"cut_pieces: {n_pieces} balls of radii {radii} leave nothing of the mesh")
    left = outside.nonzero()[:, 0]
    labels = torch.from_numpy(component_labels(mesh.faces[left].numpy(), mesh.n_vertices)).long()
    component = labels[mesh.faces[left, 0]]
    areas = mesh.areas.new_zeros(mesh.n_vertices)
    areas.index_add_(0, component, mesh.areas[left])
    left = left[component == areas.argmax()]
    kept, numbers = mesh.faces[left].unique(return_inverse=True)
    return Partial(dp.Mesh(mesh.vertices[kept], numbers), kept, left)
