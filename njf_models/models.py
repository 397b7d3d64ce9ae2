"""The networks that `training` trains and `trained` keeps, by the names of their kinds."""

from __future__ import annotations

from njf_models.baselines.cages import CageDeformation
from njf_models.baselines.diffusion import DiffusionMap
from njf_models.baselines.displacement import DisplacementField
from njf_models.baselines.global_mlp import GlobalMLP
from njf_models.chain import ChainedNJF
from njf_models.diffusion_njf import DiffusionEncodedNJF
from njf_models.modal_njf import ModalNJF
from njf_models.njf import NeuralJacobianField

Model = (
    NeuralJacobianField
    | DisplacementField
    | CageDeformation
    | GlobalMLP
    | DiffusionMap
    | DiffusionEncodedNJF
    | ModalNJF
    | ChainedNJF
)
MODELS: dict[str, type[Model]] = {
    "njf": NeuralJacobianField,
    "displacement": DisplacementField,
    "cages": CageDeformation,
    "global": GlobalMLP,
    "diffusion": DiffusionMap,
    "diffusion+njf": DiffusionEncodedNJF,
    "modal": ModalNJF,
    "chain": ChainedNJF,
}
