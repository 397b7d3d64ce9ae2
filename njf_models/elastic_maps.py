"""Deformations of one mesh: batches to learn from; the errors of maps of a solid's surface."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.datasets.arap import ArapMaps
from njf_models.datasets.contact import ContactMaps
from njf_models.datasets.solids import Solid
from njf_models.features import Shape
from njf_models.handles import Handles
from njf_models.map_errors import MapErrors, map_errors
from njf_models.map_errors import summarise as summarise_errors
from njf_models.models import Model
from njf_models.training import Batch


class ElasticBatches(Dataset[Batch]):
    """Batches of maps of the whole mesh, or of a few of its faces, by turns.

    A network maps each face by itself, so that few faces of many maps teach it more than all
    faces of few. A few faces are a shape too: triangles apart, each a component of its own, whose
    Poisson solve is trivial. Only the whole surface has the loss at its vertices.

    Args:
        maps: the deformations.
        shape: the surface at rest.
        n_targets: maps in a batch of the whole surface.
        sampled: sets of faces that are drawn once, to choose from; 0 for the whole surface only.
        n_faces: faces in such a set.
        n_sampled_targets: maps in a batch of some faces.
        period: one batch in so many is of the whole surface, the others of some faces.
        shuffle: draw maps and faces anew at each access (training), or take the maps in order.
    """

    def __init__(
        self,
        maps: ArapMaps | ContactMaps,
        shape: Shape,
        *,
        n_targets: int = 4,
        sampled: int = 0,
        n_faces: int = 128,
        n_sampled_targets: int = 64,
        period: int = 4,
        shuffle: bool = False,
    ) -> None:
        self.maps, self.shape, self.shuffle = maps, shape, shuffle
        self.n_targets, self.n_sampled_targets, self.period = n_targets, n_sampled_targets, period
        generator = torch.Generator().manual_seed(0)
        order = (torch.randperm(shape.mesh.n_faces, generator=generator) for _ in range(sampled))
        self._samples = [_Sample.of(shape, faces[:n_faces]) for faces in order]

    def __len__(self) -> int:
        return math.ceil(len(self.maps) / self.n_targets)

    def __getitem__(self, index: int) -> Batch:
        if self._samples and index % self.period:
            sample = self._samples[int(torch.randint(len(self._samples), ()))]
            chosen = torch.randperm(len(self.maps))[: self.n_sampled_targets]
            return self._batch(sample.shape, sample.images(self.maps.positions[chosen]), chosen)
        n_maps = len(self.maps)
        if self.shuffle:
            chosen = torch.randperm(n_maps)[: self.n_targets]
        else:
            chosen = torch.arange(n_maps)[index * self.n_targets :][: self.n_targets]
        return self._batch(self.shape, self.maps.positions[chosen], chosen)

    def _batch(self, shape: Shape, target: Tensor, chosen: Int[Tensor, "t"]) -> Batch:
        return Batch(shape, None, target, self.maps.parameters[chosen])


@dataclass(frozen=True)
class _Sample:
    """Some faces of a surface.

    Attributes:
        shape: they alone, each with three vertices of its own.
        corners: (k, 3) which vertices of the surface these are.
    """

    shape: Shape
    corners: Int[Tensor, "k 3"]

    @classmethod
    def of(cls, whole: Shape, faces: Int[Tensor, "k"]) -> _Sample:
        corners = whole.mesh.faces[faces]
        apart = torch.arange(corners.numel()).view(-1, 3)
        mesh = dp.Mesh(whole.mesh.vertices[corners].flatten(0, 1), apart)
        shape = Shape(
            mesh,
            dp.PoissonSolver(mesh),
            whole.features[faces],
            mesh.frames.to(whole.frames.dtype),
            whole.vertex_features[corners].flatten(0, 1),
        )
        return cls(shape, corners)

    def images(self, positions: Float[Tensor, "t n c"]) -> Float[Tensor, "t v c"]:
        """Targets of the corners, with the mean of each face at zero, where the solve puts it."""
        images = positions[:, self.corners]
        return (images - images.mean(dim=-2, keepdim=True)).flatten(1, 2)


def elastic_loader(batches: ElasticBatches) -> DataLoader[Batch]:
    """The batches as they are. Factors live in this process, so there are no workers."""
    return DataLoader(batches, batch_size=None, shuffle=batches.shuffle)


def solid_handles(solid: Solid, mesh: dp.Mesh, reach: float) -> Handles:
    """The handles of a solid as pins of maps of its surface, told by `ArapMaps.parameters`.

    Args:
        solid: which is deformed.
        mesh: its surface.
        reach: of `ArapSettings`.
    """
    of = torch.from_numpy(solid.handle_of[solid.surface])
    held = of >= 0
    each = torch.eye(solid.n_handles, dtype=torch.float64)[of[held]]  # (p, h)
    moves = reach * torch.einsum("ph,cd->hcpd", each, torch.eye(3, dtype=torch.float64))
    return Handles(mesh, held, mesh.vertices[held].double(), moves.flatten(0, 1))


# -------------------------------------------------------------------- evaluation


@dataclass(frozen=True, kw_only=True)
class ElasticRecord(MapErrors):
    """Errors of one map, and its time.

    Attributes:
        milliseconds: of CPU time for code, network and solve of this map alone, features and factor
            given.
    """

    milliseconds: float


@torch.no_grad()
def evaluate_elastic(
    model: Model, maps: ArapMaps, shape: Shape, *, pinned: bool = False
) -> tuple[list[ElasticRecord], Float[Tensor, "k n 3"]]:
    """The map for each of the handle positions: the records, and the maps.

    Args:
        model: what makes the maps.
        maps: what they should be.
        shape: the surface at rest.
        pinned: solve again for the predicted Jacobians, with the vertices that the handles hold
            pinned to where they are known to be.
    """
    was_training = model.training
    model.eval()
    records, images = [], []
    solver = dp.PoissonSolver(shape.mesh, pins=maps.held) if pinned else None
    for index in range(len(maps)):
        start = time.process_time()
        prediction = model(shape, model.encode(parameters=maps.parameters[index : index + 1]))
        if solver is not None:
            phi = solver(prediction.jacobians, pins=maps.held_positions(index))
            prediction = prediction._replace(vertices=phi)
        milliseconds = 1000 * (time.process_time() - start)
        (errors,) = map_errors(shape.mesh, prediction, maps.positions[index : index + 1])
        records.append(ElasticRecord(**vars(errors), milliseconds=milliseconds))
        images.append(prediction.vertices[0])
    model.train(was_training)
    return records, torch.stack(images)


def summarise(records: Sequence[ElasticRecord]) -> dict[str, float]:
    """Means over all maps, the spread of L2-V, and the median time."""
    milliseconds = [record.milliseconds for record in records]
    return summarise_errors(records) | {
        "CPU milliseconds, median": float(np.median(milliseconds)),
    }
