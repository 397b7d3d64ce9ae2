"""A trained UV network, and the maps it makes of disks in any pose and unit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor

import diffpoisson as dp
from njf_models.datasets.patches import PatchRejectedError, align
from njf_models.features import Shape, point_features
from njf_models.njf import NeuralJacobianField


@dataclass(frozen=True)
class UVNetwork:
    """A network for UV maps and how its inputs are made.

    Attributes:
        model: of two output coordinates.
        arguments: those that `model` was made with.
        n_points: how many points its encoder sees.
        n_energies: length of the wave-kernel signature in its features, 0 for none.
    """

    model: NeuralJacobianField
    arguments: dict[str, Any]
    n_points: int = 1024
    n_energies: int = 0

    def predict(self, mesh: dp.Mesh) -> Float[Tensor, "n 2"]:
        """The network's raw map of a disk, in the mesh's units: it may flip triangles.

        Equal for the same shape in another pose or unit, but for rounding: the network sees the
        mesh in the pose of `align`.

        Args:
            mesh: a topological disk in space.

        Returns:
            (n, 2) in the dtype of the mesh.

        Raises:
            MeshError: not a disk in space, or its area vectors cancel and it has no pose.
        """
        return self.predict_all([mesh])[0]

    @torch.no_grad()
    def predict_all(self, meshes: Sequence[dp.Mesh]) -> list[Float[Tensor, "n 2"]]:
        """The maps of several disks, as one batch; see `predict`."""
        return self.predict_prepared([self.prepare(mesh) for mesh in meshes])

    def prepare(self, mesh: dp.Mesh) -> PreparedDisk:
        """What depends on the mesh alone: pose, factor, features, points."""
        aligned, scale = _aligned(mesh)
        shape = Shape.prepare(aligned)
        wks = None
        if self.n_energies:
            wks = dp.wave_kernel_signature(aligned, self.n_energies, solver=shape.solver).float()
            shape = Shape(aligned, shape.solver, torch.cat([shape.features, ...]), shape.frames)
        samples = dp.sample_surface(
            aligned, self.n_points, generator=torch.Generator().manual_seed(0)
        )
        return PreparedDisk(mesh, shape, point_features(aligned, samples, wks).float(), scale)
