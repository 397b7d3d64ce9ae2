"""Neural Jacobian Fields, assembled from diffpoisson's layers."""

from __future__ import annotations

from njf_models.features import Shape
from njf_models.njf import NeuralJacobianField, Prediction

__all__ = ["NeuralJacobianField", "Prediction", "Shape"]
