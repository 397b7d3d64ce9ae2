"""Re-posing bodies: batches of one source and many poses of it, and the errors of their maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.datasets.bodies import Body, BodyStore
from njf_models.features import Shape, point_features
from njf_models.metrics import l2_jacobians, l2_normals, l2_vertices
from njf_models.njf import Prediction
from njf_models.training import Batch, Model


@dataclass(frozen=True)
class _Prepared:
    """A source that was prepared once, and the targets of the same identity."""

    body: Body
    shape: Shape
    wks: Float[Tensor, "n k"] | None


class RestToPoses(Dataset[Batch]):
    """For each body, maps from its rest pose to its other poses: one shape, one factor.

    Args:
        bodies: the identities.
        n_targets: how many of its poses, at most.
        n_points: how many points the encoder sees.
        n_energies: length of the wave-kernel signature that the network sees, 0 for none.
        resample: draw points and poses anew at each access (training), or always the same points
            and the first poses (evaluation).
    """

    def __init__(
        self,
        bodies: BodyStore | Sequence[Body],
        *,
        n_targets: int = 32,
        n_points: int = 1024,
        n_energies: int = 50,
        resample: bool = False,
    ) -> None:
        self.bodies, self.n_targets, self.resample = bodies, n_targets, resample
        self.n_points, self.n_energies = n_points, n_energies
        self._kept: dict[int, _Prepared] = {}

    def __len__(self) -> int:
        return len(self.bodies)

    def body(self, index: int) -> Body:
        """The identity of a batch."""
        return self._prepared(index).body

    def __getitem__(self, index: int) -> Batch:
        source = self._prepared(index)
        generator = None if self.resample else torch.Generator().manual_seed(index)
        samples = dp.sample_surface(source.shape.mesh, self.n_points, generator=generator)
        points = point_features(source.shape.mesh, samples, source.wks).float()
        n_poses = len(source.body.poses)
        order = torch.randperm(n_poses) if self.resample else torch.arange(n_poses)
        chosen = order[: self.n_targets]
        return Batch(
            source.shape, points[None], source.body.posed[chosen], source.body.poses[chosen]
        )

    def _prepared(self, index: int) -> _Prepared:
        if index not in self._kept:
            body = self.bodies[index]
            mesh = dp.Mesh(body.rest.double(), body.faces)
            solver, wks = dp.PoissonSolver(mesh), None
            if self.n_energies:
                wks = dp.wave_kernel_signature(mesh, self.n_energies, solver=solver)
            shape = Shape.prepare(mesh, wks, solver=solver)
            self._kept[index] = _Prepared(body, shape, wks)
        return self._kept[index]


def body_loader(examples: RestToPoses, *, shuffle: bool = False) -> DataLoader[Batch]:
    """One body a step. Factors live in this process, so there are no workers."""
    return DataLoader(examples, batch_size=None, shuffle=shuffle)


# -------------------------------------------------------------------- evaluation


@dataclass(frozen=True)
class PoseRecord:
    """Errors of one map, by the paper's metrics.

    Attributes:
        body: number of the identity in its data set.
        pose: number of its pose.
        l2_v: L2-V.
        l2_j: L2-J of the Jacobians before the Poisson solve, as the paper has it.
        l2_j_emitted: L2-J of those of the emitted map.
        l2_n: L2-N, in degrees.
    """

    body: int
    pose: int
    l2_v: float
    l2_j: float
    l2_j_emitted: float
    l2_n: float


@torch.no_grad()
def evaluate_reposing(
    model: Model, examples: RestToPoses
) -> tuple[list[PoseRecord], list[Float[Tensor, "t n 3"]]]:
    """The maps of each body to its poses: the records, and the maps by body."""
    was_training = model.training
    model.eval()
    records: list[PoseRecord] = []
    maps = []
    for index in range(len(examples)):
        batch = examples[index]
        prediction = model(batch.shape, model.encode(batch.points, parameters=batch.parameters))
        records += _records(examples.body(index).number, batch, prediction)
        maps.append(prediction.vertices)
    model.train(was_training)
    return records, maps


def summarise(records: Sequence[PoseRecord]) -> dict[str, float]:
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


def _records(number: int, batch: Batch, prediction: Prediction) -> list[PoseRecord]:
    mesh, phi, target = batch.shape.mesh, prediction.vertices.double(), batch.target.double()
    J = dp.jacobians(mesh, target)
    columns = (
        l2_vertices(phi, target),
        l2_jacobians(prediction.jacobians.double(), J),
        l2_jacobians(dp.jacobians(mesh, phi), J),
        l2_normals(phi, target, mesh.faces),
    )
    rows = torch.stack(columns, dim=-1).tolist()
    return [PoseRecord(number, pose, *row) for pose, row in enumerate(rows)]
