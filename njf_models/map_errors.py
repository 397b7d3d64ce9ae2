"""Errors of maps to space by the paper's metrics, and what is reported of many."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.metrics import l2_jacobians, l2_normals, l2_vertices
from njf_models.njf import Prediction


@dataclass(frozen=True)
class MapErrors:
    """Errors of one map.

    Attributes:
        l2_v: L2-V.
        l2_j: L2-J of the Jacobians before the Poisson solve, as the paper has it.
        l2_j_emitted: L2-J of those of the emitted map.
        l2_n: L2-N, in degrees.
    """

    l2_v: float
    l2_j: float
    l2_j_emitted: float
    l2_n: float


def map_errors(
    mesh: dp.Mesh, prediction: Prediction, target: Float[Tensor, "t n 3"]
) -> list[MapErrors]:
    """The errors of each of several maps of one mesh, computed in float64."""
    phi, target = prediction.vertices.double(), target.double()
    J = dp.jacobians(mesh, target)
    columns = (
        l2_vertices(phi, target),
        l2_jacobians(prediction.jacobians.double(), J),
        l2_jacobians(dp.jacobians(mesh, phi), J),
        l2_normals(phi, target, mesh.faces),
    )
    return [MapErrors(*row) for row in torch.stack(columns, dim=-1).tolist()]


def summarise(records: Sequence[MapErrors]) -> dict[str, float]:
    """Means over all maps, and the spread of L2-V."""

    def column(name: str) -> np.ndarray:
        return np.array([getattr(record, name) for record in records])

    summary = {
        "maps": len(records),
        "L2-V": column("l2_v").mean(),
        "L2-V, median": np.median(column("l2_v")),
        "L2-V, 90%": np.percentile(column("l2_v"), 90),
        "L2-J": column("l2_j").mean(),
        "L2-J, emitted": column("l2_j_emitted").mean(),
        "L2-N, degrees": column("l2_n").mean(),
    }
    return {name: float(value) for name, value in summary.items()}
