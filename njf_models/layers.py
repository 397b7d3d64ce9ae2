"""Plain stacks of layers."""

from __future__ import annotations

import itertools

from torch import nn


def layered(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers with the norms and activations of `field.FieldMLP` between."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes[:-1]):
        layers += [nn.Linear(fan_in, fan_out), nn.GroupNorm(4, fan_out), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


def smooth_layers(sizes: tuple[int, ...]) -> nn.Sequential:
    """Linear layers for a smooth function of a code: with ReLU, poses end up half as far again off.

    Each hidden layer is normed as a whole.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(sizes[:-1]):
        layers += [nn.Linear(fan_in, fan_out), nn.LayerNorm(fan_out), nn.SiLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))
