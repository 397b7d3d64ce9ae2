"""How good a UV network is: one record per patch, and the figures that people compare."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.datasets.uv import UVPatch
from njf_models.losses import paper_loss
from njf_models.metrics import count_distorted, count_flips, l2_jacobians, l2_vertices
from njf_models.models import Model
from njf_models.njf import Prediction
from njf_models.training import Batch, UVExamples


@dataclass(frozen=True)
class UVRecord:
    """Errors of the map of one patch: "raw" before the Poisson solve, the rest of the emitted map.

    Attributes:
        mesh_name: the mesh it was cut from.
        n_faces: its size.
        flatness: |Σ nA| / ΣA, 1 where the patch is flat.
        slim_energy: mean symmetric Dirichlet energy of the converged SLIM map.
        energy: mean symmetric Dirichlet energy of the emitted map, infinite if it flips.
        loss: the paper's, 10 vertices + Jacobians.
        l2_v: the paper's L2-V.
        l2_j: the paper's L2-J, of raw Jacobians.
        flips: faces with det ≤ 0 (#I).
        flips_raw: the same of the raw Jacobians, as the paper counts them.
        distorted: faces with max(σ₁, 1/σ₂) > 10 (D > 10).
        distorted_raw: the same of the raw Jacobians, as the paper counts them.
        milliseconds: code, field and solve, features and factor given.
    """

    mesh_name: str
    n_faces: int
    flatness: float
    slim_energy: float
    energy: float
    loss: float
    l2_v: float
    l2_j: float
    flips: int
    flips_raw: int
    distorted: int
    distorted_raw: int
    milliseconds: float


@torch.no_grad()
def evaluate_uv(
    model: Model, examples: UVExamples
) -> tuple[list[UVRecord], list[Float[Tensor, "n 2"]]]:
    """Map each patch on its own: the records, and the maps."""
    was_training = model.training
    model.eval()
    records, maps = [], []
    for index in range(len(examples)):
        batch = Batch.pack([examples[index]])
        start = time.perf_counter()
        prediction = model(batch.shape, model.encode(batch.points))
        milliseconds = 1000 * (time.perf_counter() - start)
        records.append(_record(examples.patch(index), batch, prediction, milliseconds))
        maps.append(prediction.vertices[0])
    model.train(was_training)
    return records, maps


def summarise(records: Sequence[UVRecord]) -> dict[str, float]:
    """The figures of the paper's UV table over a set of patches, and their neighbours."""

    def column(name: str) -> np.ndarray:
        return np.array([getattr(record, name) for record in records], dtype=np.float64)

    summary = {
        "patches": len(records),
        "loss": column("loss").mean(),
        "L2-V": column("l2_v").mean(),
        "L2-J": column("l2_j").mean(),
        "patches with a flip, %": 100 * (column("flips") > 0).mean(),
        "patches with a flip, raw, %": 100 * (column("flips_raw") > 0).mean(),
        "flips per patch": column("flips").mean(),
        "flips per patch, raw": column("flips_raw").mean(),
        "D>10 per patch": column("distorted").mean(),
        "D>10 per patch, raw": column("distorted_raw").mean(),
        "symmetric Dirichlet, median": np.median(column("energy")),
        "symmetric Dirichlet of SLIM, median": np.median(column("slim_energy")),
        "milliseconds per patch, median": np.median(column("milliseconds")),
    }
    return {name: float(value) for name, value in summary.items()}


def format_table(columns: dict[str, dict[str, float]]) -> str:
    """Summaries side by side, as plain text."""
    names = list(next(iter(columns.values())))
    width = max(map(len, names))
    header = " " * width + "".join(f"{title:>14}" for title in columns)
    rows = [
        f"{name:<{width}}" + "".join(f"{values[name]:>14.4g}" for values in columns.values())
        for name in names
    ]
    return "\n".join([header, *rows])


def _record(patch: UVPatch, batch: Batch, prediction: Prediction, milliseconds: float) -> UVRecord:
    mesh, target = batch.shape.mesh, batch.target
    J = dp.jacobians(mesh, prediction.vertices)
    density = dp.symmetric_dirichlet(J).to(mesh.dtype)
    return UVRecord(
        mesh_name=patch.mesh_name,
        n_faces=mesh.n_faces,
        flatness=patch.flatness,
        slim_energy=patch.energy,
        energy=float((mesh.areas * density).sum() / mesh.areas.sum()),
        loss=float(paper_loss(batch.shape, prediction, target).total),
        l2_v=float(l2_vertices(prediction.vertices, target)),
        l2_j=float(l2_jacobians(prediction.jacobians, dp.jacobians(mesh, target))),
        flips=int(count_flips(J)),
        flips_raw=int(count_flips(prediction.jacobians)),
        distorted=int(count_distorted(J)),
        distorted_raw=int(count_distorted(prediction.jacobians)),
        milliseconds=milliseconds,
    )
