"""Maps between bodies: batches of one source and many targets, and the errors of their maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.datasets.bodies import Body, BodyStore
from njf_models.datasets.partial import Partial, cut_pieces
from njf_models.features import Shape, point_features
from njf_models.map_errors import MapErrors, map_errors
from njf_models.models import Model
from njf_models.sampled import CellKind, Cells
from njf_models.training import Batch, encoded

_KEPT_SOURCES = 512  # each half a megabyte, and some of them with a factor


@dataclass(frozen=True)
class Task:
    """Which maps are learned, and what the network is told of the target.

    Attributes:
        sources: how many poses of each body are sources, the first ones; 0 for the rest pose.
        told: the target's pose parameters, or points on its surface.
        others: whether targets are poses of other bodies, not of the source's own.
        pieces: how many pieces are cut away from a source.
        radii: least and largest radius of a piece, in metres.
    """

    sources: int = 0
    told: Literal["pose", "points"] = "pose"
    others: bool = False
    pieces: int = 0
    radii: tuple[float, float] = (0.08, 0.2)


TASKS = {
    "repose": Task(),
    "any-pose": Task(sources=2),
    "registration": Task(sources=2, told="points", pieces=3),
    "morphing": Task(sources=2, told="points", others=True),
}
"""The paper's experiments: from rest to pose parameters; from any pose to pose parameters; a body
with pieces cut away onto points of itself in another pose; a body onto points of another one."""


@dataclass(frozen=True, eq=False)
class Source:
    """A source of maps.

    Attributes:
        body: its identity.
        pose: number of its pose; None for the rest pose.
        mesh: its surface, or what is left of it.
        kept: (n,) which vertices of the body its vertices are.
        wks: its wave-kernel signature, if the network sees one.
    """

    body: Body
    pose: int | None
    mesh: dp.Mesh
    kept: Int[Tensor, "n"]
    wks: Float[Tensor, "n k"] | None

    @cached_property
    def shape(self) -> Shape:
        """With operators, factor and features."""
        return Shape.prepare(self.mesh, self.wks)


class _Targets(NamedTuple):
    """Targets of one source: vertices of the whole body, and what the network is told of them."""

    vertices: Float[Tensor, "t n 3"]
    parameters: Float[Tensor, "t p"] | None
    points: Float[Tensor, "t s f"] | None


class BodyMaps(Dataset[Batch]):
    """Maps from a body to others, or to itself in other poses: one shape and one factor a batch.

    Args:
        bodies: the identities, on one triangulation and in as many poses each.
        task: which maps, and what the network is told of the target.
        n_targets: how many targets a source has, at most.
        n_points: how many points the encoder sees.
        n_energies: length of the wave-kernel signature that the network sees, 0 for none.
        resample: draw points, pieces and targets anew at each access (training), or always the
            same (evaluation).

    Raises:
        ValueError: other bodies are asked for, and there is one only.
    """

    def __init__(
        self,
        bodies: BodyStore | Sequence[Body],
        task: Task | None = None,
        *,
        n_targets: int = 32,
        n_points: int = 1024,
        n_energies: int = 50,
        resample: bool = False,
    ) -> None:
        self.bodies, self.task, self.resample = bodies, task or Task(), resample
        self.n_targets, self.n_points, self.n_energies = n_targets, n_points, n_energies
        if self.task.others and len(bodies) < 2:
            raise ValueError("BodyMaps: maps to other bodies need two of them at least")
        self._n_poses = len(bodies[0].poses)
        self._body = lru_cache(maxsize=_KEPT_SOURCES)(bodies.__getitem__)  # a store reads files
        self._kept_source = lru_cache(maxsize=_KEPT_SOURCES)(self._make_source)

    def __len__(self) -> int:
        return len(self.bodies) * max(1, self.task.sources)

    def source(self, index: int) -> Source:
        """The source of a batch; with other pieces cut away at each call if resampled."""
        anew = self.resample and self.task.pieces
        return self._make_source(index) if anew else self._kept_source(index)

    def targets(self, index: int) -> Int[Tensor, "t 2"]:
        """Body and pose of the targets of a source; others at each call if resampled."""
        own, n_poses = index // max(1, self.task.sources), self._n_poses
        if self.task.others:
            generator, n = self._generator(index), min(self.n_targets, n_poses)
            # Any body but the source's own.
            step = torch.randint(1, len(self.bodies), (n,), generator=generator)
            poses = torch.randperm(n_poses, generator=generator)[:n]
            return torch.stack([(own + step) % len(self.bodies), poses], dim=1)
        poses = torch.randperm(n_poses) if self.resample else torch.arange(n_poses)
        if self.task.sources:
            poses = poses[poses != index % self.task.sources]
        poses = poses[: self.n_targets]
        return torch.stack([torch.full_like(poses, own), poses], dim=1)

    def __getitem__(self, index: int) -> Batch:
        source, targets = self.source(index), self._targets(index)
        vertices = targets.vertices[:, source.kept]
        points = self._points(source.mesh, source.wks, index)[None]
        return Batch(source.shape, points, vertices, targets.parameters, targets.points)

    def cells(self, index: int, kind: CellKind, n_cells: int) -> Cells:
        """Random cells of a source; nothing is factorised."""
        source, targets = self.source(index), self._targets(index)
        return Cells.draw(
            kind,
            n_cells,
            source.mesh,
            source.wks,
            targets.vertices[:, source.kept],
            points=self._points(source.mesh, source.wks, index),
            parameters=targets.parameters,
            target_points=targets.points,
        )

    def posed_points(self, index: int) -> PosedPoints:
        """A source, and the points that the encoder sees of it."""
        source = self.source(index)
        return PosedPoints(source, self._points(source.mesh, source.wks, index))

    def _make_source(self, index: int) -> Source:
        body = self._body(index // max(1, self.task.sources))
        pose = index % self.task.sources if self.task.sources else None
        vertices = body.rest if pose is None else body.posed[pose]
        whole = dp.Mesh(vertices.double(), body.faces)
        part = Partial(whole, torch.arange(whole.n_vertices))
        if self.task.pieces:
            part = cut_pieces(whole, self.task.pieces, self.task.radii, self._generator(index))
        return Source(body, pose, *part, self._wks(part.mesh))

    def _targets(self, index: int) -> _Targets:
        numbers = self.targets(index).tolist()
        bodies = {body: self._body(body) for body in {body for body, _ in numbers}}
        vertices = torch.stack([bodies[body].posed[pose] for body, pose in numbers])
        if self.task.told == "pose":
            parameters = torch.stack([bodies[body].poses[pose] for body, pose in numbers])
            return _Targets(vertices, parameters, None)
        meshes = [dp.Mesh(x.double(), bodies[numbers[0][0]].faces) for x in vertices]
        points = [self._points(mesh, self._wks(mesh), index) for mesh in meshes]
        return _Targets(vertices, None, torch.stack(points))

    def _points(self, mesh: dp.Mesh, wks: Tensor | None, index: int) -> Float[Tensor, "s f"]:
        """What the encoder sees of a surface."""
        samples = dp.sample_surface(mesh, self.n_points, generator=self._generator(index))
        return point_features(mesh, samples, wks).float()

    def _wks(self, mesh: dp.Mesh) -> Float[Tensor, "n k"] | None:
        return dp.wave_kernel_signature(mesh, self.n_energies) if self.n_energies else None

    def _generator(self, index: int) -> torch.Generator | None:
        """Of a batch; torch's own where it is resampled."""
        return None if self.resample else torch.Generator().manual_seed(index)


class BodyCells(Dataset[Cells]):
    """Random cells of each source, to train on without solves.

    Args:
        maps: the sources and targets.
        kind: faces or vertices, as the model wants.
        n_cells: how many of each source.
    """

    def __init__(self, maps: BodyMaps, kind: CellKind, n_cells: int) -> None:
        self.maps, self.kind, self.n_cells = maps, kind, n_cells

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, index: int) -> Cells:
        return self.maps.cells(index, self.kind, self.n_cells)


class PosedPoints(NamedTuple):
    """A source that is a target of others, too.

    Attributes:
        source: the body in its pose.
        points: (s, f) what the encoder sees of it.
    """

    source: Source
    points: Float[Tensor, "s f"]


class PosedBodies(Dataset[PosedPoints]):
    """The sources of maps, to be each other's targets.

    Args:
        maps: whose sources, all of them whole.

    Raises:
        ValueError: pieces are cut away, so that vertices of one are not those of another.
    """

    def __init__(self, maps: BodyMaps) -> None:
        if maps.task.pieces:
            raise ValueError("PosedBodies: bodies with pieces cut away are no targets of others")
        self.maps = maps

    def __len__(self) -> int:
        return len(self.maps)

    def __getitem__(self, index: int) -> PosedPoints:
        return self.maps.posed_points(index)


def paired_cells(
    posed: Sequence[PosedPoints], kind: CellKind, n_cells: int, n_targets: int
) -> Cells:
    """Random cells of maps among some bodies, each a source and a target of as many others.

    A body is encoded once for all maps from it and to it, so that a step has many more maps than
    points to encode.

    Args:
        posed: the bodies.
        kind: faces or vertices, as the model wants.
        n_cells: how many of each source.
        n_targets: of each source; all others, if they are fewer.
    """
    n = len(posed)
    steps = 1 + torch.randperm(n - 1)[:n_targets]  # round to any but itself
    partners = (torch.arange(n)[:, None] + steps) % n
    x = torch.stack([body.source.mesh.vertices.float() for body in posed])
    cells = [
        Cells.draw(kind, n_cells, source.mesh, source.wks, x[others], points=points)
        for (source, points), others in zip(posed, partners, strict=True)
    ]
    return replace(Cells.stack(cells), partners=partners)


def body_loader(maps: BodyMaps, *, shuffle: bool = False) -> DataLoader[Batch]:
    """One body a step. Factors live in this process, so there are no workers."""
    return DataLoader(maps, batch_size=None, shuffle=shuffle)


def cell_loader(cells: BodyCells, n_sources: int) -> DataLoader[Cells]:
    """Cells of so many sources a step, shuffled; of all, if there are fewer."""
    n = min(n_sources, len(cells))
    return DataLoader(cells, batch_size=n, shuffle=True, drop_last=True, collate_fn=Cells.stack)


def pair_loader(
    maps: BodyMaps, kind: CellKind, n_cells: int, n_sources: int, n_targets: int
) -> DataLoader[Cells]:
    """Cells of maps among so many sources a step, by `paired_cells`, shuffled."""
    collate = partial(paired_cells, kind=kind, n_cells=n_cells, n_targets=n_targets)
    n = min(n_sources, len(maps))
    posed: Dataset[Any] = PosedBodies(maps)
    return DataLoader(posed, batch_size=n, shuffle=True, drop_last=True, collate_fn=collate)


# -------------------------------------------------------------------- evaluation


@dataclass(frozen=True, kw_only=True)
class MapRecord(MapErrors):
    """Errors of one map, and which it is.

    Attributes:
        body: number of the source's identity in its data set.
        source: number of the source's pose; None for the rest pose.
        target: number of the target's identity.
        pose: number of the target's pose.
    """

    body: int
    source: int | None
    target: int
    pose: int


@torch.no_grad()
def evaluate_maps(
    model: Model, maps: BodyMaps
) -> tuple[list[MapRecord], list[Float[Tensor, "t n 3"]]]:
    """The maps of each source: the records, and the maps by source.

    Args:
        model: what makes the maps.
        maps: sources and targets, not resampled.
    """
    was_training = model.training
    model.eval()
    records: list[MapRecord] = []
    emitted = []
    for index in range(len(maps)):
        batch, source = maps[index], maps.source(index)
        prediction = model(batch.shape, encoded(model, batch))
        records += [
            MapRecord(
                **vars(errors),
                body=source.body.number,
                source=source.pose,
                target=maps.bodies[body].number,
                pose=pose,
            )
            for (body, pose), errors in zip(
                maps.targets(index).tolist(),
                map_errors(batch.shape.mesh, prediction, batch.target),
                strict=True,
            )
        ]
        emitted.append(prediction.vertices)
    model.train(was_training)
    return records, emitted
