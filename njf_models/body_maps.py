"""Maps between bodies: batches of one source and many targets, and the errors of their maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import diffpoisson as dp
from njf_models.basis_points import BasisPlace, basis_features
from njf_models.datasets.bodies import Body, BodyStore
from njf_models.datasets.partial import Partial, cut_pieces
from njf_models.datasets.poses import reflected
from njf_models.features import Shape, point_features
from njf_models.map_errors import MapErrors, map_errors
from njf_models.models import Model
from njf_models.sampled import CellKind, Cells, Surfaces
from njf_models.training import Batch, encoded

_KEPT_SOURCES = 512  # each half a megabyte, and some of them with a factor


@dataclass(frozen=True)
class Task:
    """Which maps are learned, and what the network is told of the target.

    Attributes:
        sources: how many poses of each body are sources, the first ones; 0 for the rest pose.
        told: the target's pose parameters, or points on its surface; or nothing, and the target is
            the rest pose.
        others: whether targets are poses of other bodies, not of the source's own.
        pieces: how many pieces are cut away from a source.
        radii: least and largest radius of a piece, in metres.
    """

    sources: int = 0
    told: Literal["pose", "points", "nothing"] = "pose"
    others: bool = False
    pieces: int = 0
    radii: tuple[float, float] = (0.08, 0.2)


TASKS = {
    "repose": Task(),
    "unpose": Task(sources=2, told="nothing"),
    "any-pose": Task(sources=2),
    "registration": Task(sources=2, told="points", pieces=3),
    "morphing": Task(sources=2, told="points", others=True),
}
"""From rest to pose parameters; from any pose to rest; from any pose to pose parameters; a body
with pieces cut away onto points of itself in another pose; a body onto points of another one. All
but the second are the paper's experiments."""


@dataclass(frozen=True, eq=False)
class Source:
    """A source of maps.

    Attributes:
        body: its identity.
        pose: number of its pose; None for the rest pose.
        mesh: its surface, or what is left of it.
        kept: (n,) which vertices of the body its vertices are.
        faces: (m,) which faces of the body its faces are.
        wks: its wave-kernel signature, if the network sees one.
    """

    body: Body
    pose: int | None
    mesh: dp.Mesh
    kept: Int[Tensor, "n"]
    faces: Int[Tensor, "m"]
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
        n_basis: how many basis points the encoder sees shapes from, instead of points on them.
        basis_at: where these are.
        resample: draw points, pieces and targets anew at each access (training), or always the
            same (evaluation).

    Raises:
        ValueError: other bodies are asked for, and there is one only; or pieces of bodies, seen
            from basis points.
    """

    def __init__(
        self,
        bodies: BodyStore | Sequence[Body],
        task: Task | None = None,
        *,
        n_targets: int = 32,
        n_points: int = 1024,
        n_energies: int = 50,
        n_basis: int = 0,
        basis_at: BasisPlace = "box",
        resample: bool = False,
    ) -> None:
        self.bodies, self.task, self.resample = bodies, task or Task(), resample
        self.n_targets, self.n_points, self.n_energies = n_targets, n_points, n_energies
        self.n_basis, self.basis_at = n_basis, basis_at
        if n_basis and self.task.pieces:
            raise ValueError("BodyMaps: basis points see whole sources only; use points on them")
        if self.task.others and len(bodies) < 2:
            raise ValueError("BodyMaps: maps to other bodies need two of them at least")
        self._n_poses = len(bodies[0].poses)
        self._body = lru_cache(maxsize=_KEPT_SOURCES)(bodies.__getitem__)  # a store reads files
        self._kept_source = lru_cache(maxsize=_KEPT_SOURCES)(self._make_source)
        # Nothing of what basis points see is drawn, and it is a few kilobytes.
        self._basis_of_source = cache(lambda index: self._seen_by_basis(self._vertices(index)))
        self._basis_of_target = cache(lambda *pair: self._seen_by_basis(self._posed(*pair)))

    def __len__(self) -> int:
        return len(self.bodies) * max(1, self.task.sources)

    def source(self, index: int) -> Source:
        """The source of a batch; with other pieces cut away at each call if resampled."""
        anew = self.resample and self.task.pieces
        return self._make_source(index) if anew else self._kept_source(index)

    def targets(self, index: int) -> Int[Tensor, "t 2"]:
        """Body and pose of the targets of a source, -1 for rest; others each time if resampled."""
        own, n_poses = index // max(1, self.task.sources), self._n_poses
        if self.task.told == "nothing":
            return torch.tensor([[own, -1]])
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
        if self.n_basis:
            points = self.basis_of_source(index)[None]
        else:
            points = self._points(source.mesh, source.wks, index)[None]
        return Batch(source.shape, points, vertices, targets.parameters, targets.points)

    def surfaces(self, indices: Sequence[int]) -> Surfaces:
        """Several sources, to draw cells from; nothing is factorised."""
        if not (self.task.pieces or self.n_energies):
            vertices = torch.stack([self._vertices(index) for index in indices])
            return Surfaces(vertices, self._body(0).faces)
        return self._partial_surfaces(indices)

    def _partial_surfaces(self, indices: Sequence[int]) -> Surfaces:
        """Sources that have lost pieces, or have a signature: by way of their meshes."""
        sources = [self.source(index) for index in indices]
        vertices = torch.stack([self._vertices(index) for index in indices])
        faces = self._body(0).faces
        present = torch.zeros(len(sources), len(faces))
        for row, source in zip(present, sources, strict=True):
            row[source.faces] = 1
        wks = None
        if self.n_energies:
            wks = torch.zeros(*vertices.shape[:2], self.n_energies)
            for rows, source in zip(wks, sources, strict=True):
                assert source.wks is not None
                rows[source.kept] = source.wks.float()
        return Surfaces(vertices, faces, present, wks)

    def any_targets(self, n: int) -> tuple[Float[Tensor, "1 t n 3"], Int[Tensor, "1 t 2"]]:
        """Bodies in poses, drawn at random, as targets of any sources; and which they are."""
        bodies, poses = torch.randint(len(self.bodies), (n,)), torch.randint(self._n_poses, (n,))
        numbers = torch.stack([bodies, poses], dim=1)
        return torch.stack([self._posed(*pair) for pair in numbers.tolist()])[None], numbers[None]

    def basis_of_source(self, index: int) -> Float[Tensor, "pairs 8"]:
        """What basis points see of a source; kept."""
        return self._basis_of_source(index)

    def basis_of_target(self, body: int, pose: int) -> Float[Tensor, "pairs 8"]:
        """What basis points see of a target; kept."""
        return self._basis_of_target(body, pose)

    def own_targets(
        self, index: int
    ) -> tuple[Float[Tensor, "t n 3"], Float[Tensor, "t p"], Int[Tensor, "t 2"]]:
        """Targets of a source that are its own body: vertices, parameters, and which they are."""
        numbers, body = self.targets(index), self._body(index // max(1, self.task.sources))
        if self.task.told == "nothing":
            return body.rest[None], torch.zeros(1, 0), numbers
        poses = numbers[:, 1]
        return body.posed[poses], body.poses[poses], numbers

    def _posed(self, body: int, pose: int) -> Float[Tensor, "n 3"]:
        return self._body(body).posed[pose]

    def _seen_by_basis(self, vertices: Float[Tensor, "n 3"]) -> Float[Tensor, "pairs 8"]:
        mesh = dp.Mesh(vertices, self._body(0).faces)
        return basis_features(mesh, self.n_basis, self.basis_at)

    def _vertices(self, index: int) -> Float[Tensor, "n 3"]:
        """Of the whole body that is a source, where networks took it to if they did."""
        body = self._body(index // max(1, self.task.sources))
        if not self.task.sources:
            return body.rest
        poses = body.posed if body.carried is None else body.carried
        return poses[index % self.task.sources]

    def _make_source(self, index: int) -> Source:
        body = self._body(index // max(1, self.task.sources))
        pose = index % self.task.sources if self.task.sources else None
        whole = dp.Mesh(self._vertices(index).double(), body.faces)
        part = Partial(whole, torch.arange(whole.n_vertices), torch.arange(whole.n_faces))
        if self.task.pieces:
            part = cut_pieces(whole, self.task.pieces, self.task.radii, self._generator(index))
        return Source(body, pose, *part, self._wks(part.mesh))

    def _targets(self, index: int) -> _Targets:
        numbers = self.targets(index).tolist()
        bodies = {body: self._body(body) for body in {body for body, _ in numbers}}
        if self.task.told == "nothing":
            return _Targets(bodies[numbers[0][0]].rest[None], None, None)
        vertices = torch.stack([bodies[body].posed[pose] for body, pose in numbers])
        if self.task.told == "pose":
            parameters = torch.stack([bodies[body].poses[pose] for body, pose in numbers])
            return _Targets(vertices, parameters, None)
        if self.n_basis:
            seen = torch.stack([self.basis_of_target(*pair) for pair in numbers])
            return _Targets(vertices, None, seen)
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


class CellSampler:
    """Draws random cells of some sources and their targets, to train on without solves.

    Sources that are not maps to other bodies are reflected at random, with all that belongs to
    them: as many bodies again.

    Args:
        maps: the sources and targets. Targets that may be other bodies are the same for all sources
            of a step, so that they are encoded once.
        kind: faces or vertices, as the model wants.
        n_cells: how many of each source.
    """

    def __init__(self, maps: BodyMaps, kind: CellKind, n_cells: int) -> None:
        self.maps, self.kind, self.n_cells = maps, kind, n_cells

    def __call__(self, indices: Sequence[int]) -> Cells:
        """Cells of the sources of these numbers."""
        maps, task = self.maps, self.maps.task
        surfaces = maps.surfaces(indices)
        signs = 1 - 2 * torch.randint(2, (1 if task.others else len(indices),)).float()
        code: dict[str, Any] = {"basis": maps.n_basis > 0}
        if maps.n_basis:
            code["points"] = torch.stack([maps.basis_of_source(index) for index in indices])
        else:
            code["points"] = surfaces.points(maps.n_points)
        if task.others:
            targets, numbers = maps.any_targets(maps.n_targets)
        else:
            own = [maps.own_targets(index) for index in indices]
            targets, poses, numbers = (torch.stack(of_each) for of_each in zip(*own, strict=True))
            if task.told == "pose":
                code["parameters"] = reflected(poses).where(signs[:, None, None] < 0, poses)
        if task.told == "points":
            seen = self._seen_by_basis(numbers) if maps.n_basis else self._points(targets)
            code["target_points"] = seen
        return Cells.draw(self.kind, self.n_cells, surfaces, targets, **code).reflected(signs)

    def _seen_by_basis(self, numbers: Int[Tensor, "b t 2"]) -> Float[Tensor, "b t pairs 8"]:
        seen = [self.maps.basis_of_target(*pair) for pair in numbers.flatten(0, 1).tolist()]
        return torch.stack(seen).unflatten(0, numbers.shape[:2])

    def _points(self, targets: Float[Tensor, "b t n 3"]) -> Float[Tensor, "b t s f"]:
        """What the encoder sees of the targets."""
        vertices, n_energies = targets.flatten(0, 1), self.maps.n_energies
        faces, wks = self.maps.bodies[0].faces, None
        if n_energies:
            meshes = [dp.Mesh(x.double(), faces) for x in vertices]
            wks = torch.stack([dp.wave_kernel_signature(m, n_energies).float() for m in meshes])
        points = Surfaces(vertices, faces, wks=wks).points(self.maps.n_points)
        return points.unflatten(0, targets.shape[:2])


class MixedSampler:
    """Draws the cells of each step on one of several triangulations of the same bodies.

    Args:
        samplers: of the same maps, each on another triangulation.

    Raises:
        ValueError: they have different numbers of maps.
    """

    def __init__(self, samplers: Sequence[CellSampler]) -> None:
        numbers = [len(sampler.maps) for sampler in samplers]
        if len(set(numbers)) != 1:
            raise ValueError(f"MixedSampler: samplers of the same maps are mixed, got {numbers}")
        self.samplers, self.maps = samplers, samplers[0].maps

    def __call__(self, indices: Sequence[int]) -> Cells:
        """Cells of the sources of these numbers, on a triangulation that is drawn."""
        return self.samplers[int(torch.randint(len(self.samplers), ()))](indices)


def body_loader(maps: BodyMaps, *, shuffle: bool = False) -> DataLoader[Batch]:
    """One body a step. Factors live in this process, so there are no workers."""
    return DataLoader(maps, batch_size=None, shuffle=shuffle)


def cell_loader(sampler: CellSampler | MixedSampler, n_sources: int) -> DataLoader[Cells]:
    """Cells of so many sources a step, shuffled; of all, if there are fewer."""
    numbers: Any = range(len(sampler.maps))  # a list of numbers does for a data set
    n = min(n_sources, len(sampler.maps))
    return DataLoader(numbers, batch_size=n, shuffle=True, drop_last=True, collate_fn=sampler)


# -------------------------------------------------------------------- evaluation


@dataclass(frozen=True, kw_only=True)
class MapRecord(MapErrors):
    """Errors of one map, and which it is.

    Attributes:
        body: number of the source's identity in its data set.
        source: number of the source's pose; None for the rest pose.
        target: number of the target's identity.
        pose: number of the target's pose; None for the rest pose.
    """

    body: int
    source: int | None
    target: int
    pose: int | None


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
                pose=None if pose < 0 else pose,
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
