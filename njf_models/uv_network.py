"""A trained UV network, and the maps it makes of disks in any pose and unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from diffpoisson.parameterization import require_disk
from njf_models.datasets.patches import PatchRejectedError, align, has_pose
from njf_models.features import Shape
from njf_models.trained import TrainedNetwork


class PreparedDisk(NamedTuple):
    """A disk as a `UVNetwork` sees it.

    Attributes:
        mesh: as it was given.
        shape: of unit area, in the canonical pose, with its factor and features.
        points: (s, f) what the encoder sees.
        scale: square root of the area of `mesh`.
    """

    mesh: dp.Mesh
    shape: Shape
    points: Float[Tensor, "s f"]
    scale: float


class UVNetwork(TrainedNetwork):
    """A network for UV maps, of two output coordinates."""

    holds: ClassVar[str] = "uv_network"

    def with_rounds(self, rounds: int) -> UVNetwork:
        """The same network, stopped after so many of its rounds: faster, and less exact.

        In training the map of each round is compared with the target, so that each may be the last.

        Raises:
            ValueError: the network has fewer rounds, or shares the weights of its corrections.
        """
        trained = self.arguments.get("rounds", 1)
        if not 1 <= rounds <= trained or self.arguments.get("shared_rounds"):
            raise ValueError(
                f"UVNetwork.with_rounds: expected 1 to {trained} rounds of separate weights, "
                f"got {rounds}"
            )
        shorter = UVNetwork(self.arguments | {"rounds": rounds}, self.inputs, self.kind)
        weights = self.model.state_dict()
        shorter.model.load_state_dict({name: weights[name] for name in shorter.model.state_dict()})
        return shorter

    def predict(self, mesh: dp.Mesh) -> Float[Tensor, "n 2"]:
        """The network's raw map of a disk, in the mesh's units: it may flip triangles.

        The same for a shape in another pose or unit, but for rounding: the network sees it as
        `datasets.patches.align` turns it.

        Args:
            mesh: a topological disk in space.

        Returns:
            (n, 2) in the dtype of the mesh.

        Raises:
            MeshError: not a disk in space, or its area vectors cancel, so that it has no pose.
        """
        return self.predict_all([mesh])[0]

    def start(self, mesh: dp.Mesh) -> Float[Tensor, "n 2"] | None:
        """What `diffpoisson.parameterize` calls for each chart: the map, or None without a pose."""
        has_one = has_pose(mesh.vertices.double().cpu().numpy(), mesh.faces.cpu().numpy())
        return self.predict(mesh) if has_one else None

    def predict_all(self, meshes: Sequence[dp.Mesh]) -> list[Float[Tensor, "n 2"]]:
        """The maps of several disks, in one pass of the network; see `predict`."""
        return self.predict_prepared([self.prepare(mesh) for mesh in meshes])

    def prepare(self, mesh: dp.Mesh) -> PreparedDisk:
        """What depends on the mesh alone: pose, factor, features and points."""
        require_disk("UVNetwork", mesh, "njf_models.parameterize(mesh, cut=True) cuts it")
        scale = math.sqrt(float(mesh.areas.double().sum()))
        shape, points = self.inputs.of(_aligned(mesh))
        return PreparedDisk(mesh, shape, points, scale)

    @torch.no_grad()
    def predict_prepared(self, disks: Sequence[PreparedDisk]) -> list[Float[Tensor, "n 2"]]:
        """The maps of several disks that were prepared before, in one pass of the network."""
        shape = Shape.concatenate([disk.shape for disk in disks])
        code = self.model.encode(torch.stack([disk.points for disk in disks]))
        vertices = self.model(shape, code).vertices
        if shape.mesh.n_parts == 1:
            vertices = vertices[0]
        maps = shape.mesh.split_vertices(vertices)
        return [
            (disk.scale * uv.double()).to(disk.mesh.dtype)
            for disk, uv in zip(disks, maps, strict=True)
        ]


def _aligned(mesh: dp.Mesh) -> dp.Mesh:
    """At unit area, in the canonical pose, in float64."""
    vertices, faces = mesh.vertices.double().cpu().numpy(), mesh.faces.cpu().numpy()
    try:
        aligned, _ = align(vertices, faces)
    except PatchRejectedError as error:
        raise dp.MeshError(
            "UVNetwork: the area vectors of this mesh cancel, as those of a closed surface do that "
            "was cut open, so it has no pose; njf_models.parameterize starts from Tutte's map then"
        ) from error
    return dp.Mesh(aligned, mesh.faces.cpu())
