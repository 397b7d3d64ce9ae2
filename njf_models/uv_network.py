"""A trained UV network, and the maps it makes of disks in any pose and unit."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import diffpoisson as dp
from diffpoisson.parameterization import require_disk
from njf_models.datasets.patches import PatchRejectedError, align, has_pose
from njf_models.features import Shape, point_features
from njf_models.njf import NeuralJacobianField


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


@dataclass(frozen=True)
class Inputs:
    """What a network sees of a shape.

    Attributes:
        n_points: number of surface points for the encoder.
        n_energies: length of the wave-kernel signature, 0 for none.
    """

    n_points: int = 1024
    n_energies: int = 0


class UVNetwork:
    """A network for UV maps, and how its inputs are made.

    Args:
        arguments: of the `NeuralJacobianField`, of two output coordinates.
        inputs: what it sees.

    Attributes:
        model: the network.
    """

    def __init__(self, arguments: dict[str, Any], inputs: Inputs) -> None:
        self.arguments, self.inputs = arguments, inputs
        self.model = NeuralJacobianField(**arguments).eval()

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
        aligned = _aligned(mesh)
        solver = dp.PoissonSolver(aligned)
        wks = None
        if self.inputs.n_energies:
            wks = dp.wave_kernel_signature(aligned, self.inputs.n_energies, solver=solver)
        generator = torch.Generator().manual_seed(0)  # the same map at every call
        samples = dp.sample_surface(aligned, self.inputs.n_points, generator=generator)
        points = point_features(aligned, samples, wks).float()
        return PreparedDisk(mesh, Shape.prepare(aligned, wks, solver=solver), points, scale)

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

    # ---------------------------------------------------------------- files

    def save(self, path: Path | str) -> None:
        """Write weights and arguments to one safetensors file."""
        about = {"arguments": self.arguments, "inputs": asdict(self.inputs)}
        state = {name: value.contiguous() for name, value in self.model.state_dict().items()}
        save_file(state, path, metadata={"uv_network": json.dumps(about)})

    @classmethod
    def load(cls, path: Path | str) -> UVNetwork:
        """The network in a file of `save`.

        Raises:
            ValueError: the file is of something else.
        """
        with safe_open(path, "pt") as file:
            about = (file.metadata() or {}).get("uv_network")
        if about is None:
            raise ValueError(f"UVNetwork.load: {path} holds no UV network written by `save`")
        arguments, inputs = (json.loads(about)[key] for key in ("arguments", "inputs"))
        network = cls(arguments, Inputs(**inputs))
        network.model.load_state_dict(load_file(path))
        return network

    @classmethod
    def from_checkpoint(cls, path: Path | str) -> UVNetwork:
        """The network in a checkpoint of `training.NJFTraining` that records its inputs."""
        from njf_models.training import NJFTraining  # noqa: PLC0415  (seconds to import)

        trained = NJFTraining.load_from_checkpoint(path, map_location="cpu")
        network = cls(dict(trained.hparams["model"]), Inputs(**trained.hparams["inputs"]))
        network.model.load_state_dict(trained.model.state_dict())
        return network


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
