"""A trained network that re-poses bodies, on any triangulation."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import diffpoisson as dp
from njf_models.features import Shape, point_features
from njf_models.njf import NeuralJacobianField
from njf_models.uv_network import Inputs


class Stance(NamedTuple):
    """How coordinates of a character are related to those that the network knows.

    Attributes:
        y_up: its y is up and its z to its front; else z is up and y to its back, as in the network.
        scale: metres in a unit.
    """

    y_up: bool = False
    scale: float = 1.0

    def standing(self, x: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """The network's coordinates from the character's."""
        x = self.scale * x
        return torch.stack([x[..., 0], -x[..., 2], x[..., 1]], dim=-1) if self.y_up else x

    def back(self, x: Float[Tensor, "*batch n 3"]) -> Float[Tensor, "*batch n 3"]:
        """The character's coordinates from the network's."""
        x = torch.stack([x[..., 0], x[..., 2], -x[..., 1]], dim=-1) if self.y_up else x
        return x / self.scale

    def height(self, x: Float[Tensor, "n 3"]) -> float:
        """Of a character, in its own units."""
        upward = x[:, 1 if self.y_up else 2]
        return float(upward.max() - upward.min())


class PreparedBody(NamedTuple):
    """A body as a `ReposeNetwork` sees it; what depends on the pose is not in it.

    Attributes:
        shape: with its factor and features.
        code: (z,) what the encoder makes of its surface.
        centre: (3,) area-weighted mean of the surface.
    """

    shape: Shape
    code: Float[Tensor, "z"]
    centre: Float[Tensor, "3"]


class ReposeNetwork:
    """A network for the maps of bodies from rest to poses, and how its inputs are made.

    Args:
        arguments: of the model, a `NeuralJacobianField` with pose parameters.
        inputs: what it sees.

    Attributes:
        model: the network.
    """

    def __init__(self, arguments: dict[str, Any], inputs: Inputs) -> None:
        self.arguments, self.inputs = arguments, inputs
        self.model = NeuralJacobianField(**arguments).eval()

    def repose(self, mesh: dp.Mesh, poses: Float[Tensor, "p k"]) -> Float[Tensor, "p n 3"]:
        """A body in other poses.

        Args:
            mesh: a body in the rest pose of `datasets.poses`, in metres: x to its left, y to its
                back, z up. It may have any triangulation, and stand anywhere.
            poses: rotation vectors of `datasets.poses.JOINTS`, in radians.

        Returns:
            (p, n, 3) in the dtype of the mesh; its mean over the area stays where it was.
        """
        return self.repose_prepared(self.prepare(mesh), poses).to(mesh.dtype)

    @torch.no_grad()
    def prepare(self, mesh: dp.Mesh) -> PreparedBody:
        """What depends on the body alone: factor, features and code."""
        mesh = mesh.to(torch.float64)
        solver, wks = dp.PoissonSolver(mesh), None
        if self.inputs.n_energies:
            wks = dp.wave_kernel_signature(mesh, self.inputs.n_energies, solver=solver)
        generator = torch.Generator().manual_seed(0)  # the same map at every call
        samples = dp.sample_surface(mesh, self.inputs.n_points, generator=generator)
        points = point_features(mesh, samples, wks).float()
        centre = mesh.vertex_areas @ mesh.vertices / mesh.areas.sum()
        assert self.model.encoder is not None
        code = self.model.encoder(points[None])[0]
        return PreparedBody(Shape.prepare(mesh, wks, solver=solver), code, centre)

    @torch.no_grad()
    def repose_prepared(
        self, body: PreparedBody, poses: Float[Tensor, "p k"]
    ) -> Float[Tensor, "p n 3"]:
        """A body that was prepared before, in other poses; float64."""
        code = torch.cat([body.code.expand(len(poses), -1), poses.float()], dim=-1)
        return self.model(body.shape, code).vertices.double() + body.centre

    # ---------------------------------------------------------------- files

    def save(self, path: Path | str) -> None:
        """Write weights and arguments to one safetensors file."""
        about = {"arguments": self.arguments, "inputs": asdict(self.inputs)}
        state = {name: value.contiguous() for name, value in self.model.state_dict().items()}
        save_file(state, path, metadata={"repose_network": json.dumps(about)})

    @classmethod
    def load(cls, path: Path | str) -> ReposeNetwork:
        """The network in a file of `save`.

        Raises:
            ValueError: the file is of something else.
        """
        with safe_open(path, "pt") as file:
            about = (file.metadata() or {}).get("repose_network")
        if about is None:
            raise ValueError(f"ReposeNetwork.load: {path} holds no network for poses")
        arguments, inputs = (json.loads(about)[key] for key in ("arguments", "inputs"))
        network = cls(arguments, Inputs(**inputs))
        network.model.load_state_dict(load_file(path))
        return network

    @classmethod
    def from_checkpoint(cls, path: Path | str) -> ReposeNetwork:
        """The network in a checkpoint of `training.NJFTraining`, of kind "njf"."""
        from njf_models.training import NJFTraining  # noqa: PLC0415  (seconds to import)

        trained = NJFTraining.load_from_checkpoint(path, map_location="cpu")
        network = cls(dict(trained.hparams["model"]), Inputs(**trained.hparams["inputs"]))
        network.model.load_state_dict(trained.model.state_dict())
        return network
