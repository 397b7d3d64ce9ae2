"""A trained network with a record of what it is and what it sees, in one file."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import diffpoisson as dp
from njf_models.basis_points import BasisPlace, basis_features
from njf_models.features import Shape, point_features
from njf_models.models import MODELS

Network = TypeVar("Network", bound="TrainedNetwork")


@dataclass(frozen=True)
class Inputs:
    """What a network sees of a shape.

    Attributes:
        n_points: number of surface points for the encoder.
        n_energies: length of the wave-kernel signature, 0 for none.
        n_eigenpairs: of the spectrum, for networks that diffuse, 0 for none.
        n_basis: how many basis points the encoder sees a shape from, instead of points on it.
        basis_at: where these are.
    """

    n_points: int = 1024
    n_energies: int = 0
    n_eigenpairs: int = 0
    n_basis: int = 0
    basis_at: BasisPlace = "box"

    def of(self, mesh: dp.Mesh) -> tuple[Shape, Float[Tensor, "s f"]]:
        """A mesh prepared for the network, and what the encoder sees of it, float32.

        The same at every call. A mesh of fewer vertices than `n_eigenpairs` has all of its own.
        """
        solver, wks = dp.PoissonSolver(mesh), None
        if self.n_energies:
            wks = dp.wave_kernel_signature(mesh, self.n_energies, solver=solver)
        if self.n_basis:
            points = basis_features(mesh, self.n_basis, self.basis_at).float()
        else:
            generator = torch.Generator().manual_seed(0)
            samples = dp.sample_surface(mesh, self.n_points, generator=generator)
            points = point_features(mesh, samples, wks).float()
        n_eigenpairs = min(self.n_eigenpairs, mesh.n_vertices)
        return Shape.prepare(mesh, wks, solver=solver, n_eigenpairs=n_eigenpairs), points


class TrainedNetwork:
    """A model and how its inputs are made.

    Args:
        arguments: of the model.
        inputs: what it sees.
        kind: of `models.MODELS`.

    Attributes:
        model: the network, in evaluation mode.
    """

    holds: ClassVar[str]  # what files of the class say that they hold

    def __init__(self, arguments: dict[str, Any], inputs: Inputs, kind: str = "njf") -> None:
        self.arguments, self.inputs, self.kind = arguments, inputs, kind
        self.model = MODELS[kind](**arguments).eval()

    def save(self, path: Path | str, dtype: torch.dtype | None = None) -> None:
        """Write weights, arguments and inputs to one safetensors file.

        Args:
            path: of the file.
            dtype: of the weights in it, if not their own: half precision makes it half as large.
        """
        about = {"kind": self.kind, "arguments": self.arguments, "inputs": asdict(self.inputs)}
        weights = self.model.state_dict()
        state = {name: value.to(dtype).contiguous() for name, value in weights.items()}
        save_file(state, path, metadata={self.holds: json.dumps(about)})

    @classmethod
    def load(cls: type[Network], path: Path | str) -> Network:
        """The network in a file of `save`.

        Raises:
            ValueError: the file is of something else.
        """
        with safe_open(path, "pt") as file:
            about = (file.metadata() or {}).get(cls.holds)
        if about is None:
            raise ValueError(f"{cls.__name__}.load: {path} holds no {cls.__name__}")
        kind, arguments, inputs = (json.loads(about)[k] for k in ("kind", "arguments", "inputs"))
        network = cls(arguments, Inputs(**inputs), kind)
        network.model.load_state_dict(load_file(path))
        return network

    @classmethod
    def from_checkpoint(cls: type[Network], path: Path | str) -> Network:
        """The network in a checkpoint of `training.NJFTraining` that records its inputs."""
        from njf_models.training import NJFTraining  # noqa: PLC0415  (seconds to import)

        trained = NJFTraining.load_from_checkpoint(path, map_location="cpu")
        about = trained.hparams
        network = cls(dict(about["model"]), Inputs(**about["inputs"]), about["kind"])
        network.model.load_state_dict(trained.model.state_dict())
        return network
