"""Neural Jacobian Fields, assembled from diffpoisson's layers.

Names are imported when they are first used: the command line starts without torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from njf_models.features import Shape
    from njf_models.njf import NeuralJacobianField, Prediction
    from njf_models.pretrained import load_pretrained, parameterize

__all__ = ["NeuralJacobianField", "Prediction", "Shape", "load_pretrained", "parameterize"]

_HOMES = {
    "NeuralJacobianField": "njf",
    "Prediction": "njf",
    "Shape": "features",
    "load_pretrained": "pretrained",
    "parameterize": "pretrained",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'njf_models' has no attribute {name!r}")
    return getattr(import_module(f"njf_models.{_HOMES[name]}"), name)
