"""Re-posing bodies: batches of one source and many targets, and the errors of their maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.datasets.bodies import Body, BodyStore
from njf_models.features import Shape, point_features
from njf_models.metrics import l2_jacobians, l2_normals, l2_vertices
from njf_models.njf import Prediction
from njf_models.training import Batch, Model


class _Source(NamedTuple):
    """A source that was prepared once.

    Attributes:
        body: its identity.
        shape: with operators and features.
        wks: its wave-kernel signature, if the network sees one.
    """

    body: Body
    shape: Shape
    wks: Float[Tensor, "n k"] | None


class PoseExamples(Dataset[Batch]):
    """Maps from one pose of a body to others of its poses: one shape and one factor a batch.

    Args:
        bodies: the identities.
        sources: how many poses of each are sources, the first ones; 0 for the rest pose.
        n_targets: how many other poses are targets, at most.
        n_points: how many points the encoder sees.
        n_energies: length of the wave-kernel signature that the network sees, 0 for none.
        resample: draw points and targets anew at each access (training), or always the same points
            and the first poses (evaluation).
    """

    def __init__(
        self,
        bodies: BodyStore | Sequence[Body],
        *,
        sources: int = 0,
        n_targets: int = 32,
        n_points: int = 1024,
        n_energies: int = 50,
        resample: bool = False,
    ) -> None:
        self.bodies, self.sources, self.resample = bodies, sources, resample
        self.n_targets, self.n_points, self.n_energies = n_targets, n_points, n_energies
        self._kept: dict[int, _Source] = {}

    def __len__(self) -> int:
        return len(self.bodies) * max(1, self.sources)

    def body(self, index: int) -> Body:
        """The identity of a batch."""
        return self._prepared(index).body

    def source(self, index: int) -> int | None:
        """The number of the source's pose; None for the rest pose."""
        return index % self.sources if self.sources else None

    def targets(self, index: int) -> Int[Tensor, "p"]:
        """The numbers of the poses that a source is mapped to; others at each call if resampled."""
        n_poses = len(self.body(index).poses)
        poses = torch.randperm(n_poses) if self.resample else torch.arange(n_poses)
        source = self.source(index)
        return (poses if source is None else poses[poses != source])[: self.n_targets]

    def __getitem__(self, index: int) -> Batch:
        body, shape, wks = self._prepared(index)
        generator = None if self.resample else torch.Generator().manual_seed(index)
        samples = dp.sample_surface(shape.mesh, self.n_points, generator=generator)
        points = point_features(shape.mesh, samples, wks).float()
        targets = self.targets(index)
        return Batch(shape, points[None], body.posed[targets], body.poses[targets])

    def _prepared(self, index: int) -> _Source:
        if index not in self._kept:
            body = self.bodies[index // max(1, self.sources)]
            source = self.source(index)
            vertices = body.rest if source is None else body.posed[source]
            mesh = dp.Mesh(vertices.double(), body.faces)
            solver, wks = dp.PoissonSolver(mesh), None
            if self.n_energies:
                wks = dp.wave_kernel_signature(mesh, self.n_energies, solver=solver)
            self._kept[index] = _Source(body, Shape.prepare(mesh, wks, solver=solver), wks)
        return self._kept[index]


def body_loader(examples: PoseExamples, *, shuffle: bool = False) -> DataLoader[Batch]:
    """One body a step. Factors live in this process, so there are no workers."""
    return DataLoader(examples, batch_size=None, shuffle=shuffle)


# -------------------------------------------------------------------- evaluation


@dataclass(frozen=True)
class PoseRecord:
    """Errors of one map, by the paper's metrics.

    Attributes:
        body: number of the identity in its data set.
        source: number of the source's pose; None for the rest pose.
        pose: number of the target's pose.
        l2_v: L2-V.
        l2_j: L2-J of the Jacobians before the Poisson solve, as the paper has it.
        l2_j_emitted: L2-J of those of the emitted map.
        l2_n: L2-N, in degrees.
    """

    body: int
    source: int | None
    pose: int
    l2_v: float
    l2_j: float
    l2_j_emitted: float
    l2_n: float


@torch.no_grad()
def evaluate_reposing(
    model: Model, examples: PoseExamples
) -> tuple[list[PoseRecord], list[Float[Tensor, "t n 3"]]]:
    """The maps of each source: the records, and the maps by source.

    Args:
        model: what makes the maps.
        examples: sources and targets, not resampled.
    """
    was_training = model.training
    model.eval()
    records: list[PoseRecord] = []
    maps = []
    for index in range(len(examples)):
        batch = examples[index]
        prediction = model(batch.shape, model.encode(batch.points, parameters=batch.parameters))
        body, source = examples.body(index), examples.source(index)
        poses = examples.targets(index).tolist()
        records += [
            PoseRecord(body.number, source, pose, *errors)
            for pose, errors in zip(poses, _errors(batch, prediction), strict=True)
        ]
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


def _errors(batch: Batch, prediction: Prediction) -> list[list[float]]:
    """The errors of a record, for each map."""
    mesh, phi, target = batch.shape.mesh, prediction.vertices.double(), batch.target.double()
    J = dp.jacobians(mesh, target)
    columns = (
        l2_vertices(phi, target),
        l2_jacobians(prediction.jacobians.double(), J),
        l2_jacobians(dp.jacobians(mesh, phi), J),
        l2_normals(phi, target, mesh.faces),
    )
    return torch.stack(columns, dim=-1).tolist()
