"""Maps of the block that meets an obstacle: errors, intersections, and steps that remove them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

import diffpoisson as dp
from njf_models.datasets.contact import ContactMaps, ContactSolver, Scene
from njf_models.features import Shape
from njf_models.handles import Handles
from njf_models.metrics import l2_jacobians, l2_vertices
from njf_models.models import Model

MARGIN = 0.005  # by how much a step moves what intersects past the place where it touches
MAX_STEPS = 20


def block_shape(scene: Scene) -> Shape:
    """The block prepared for the networks: in the plane z = 0 of space."""
    flat = np.concatenate([scene.vertices, np.zeros((len(scene.vertices), 1))], axis=1)
    return Shape.prepare(dp.Mesh(flat, scene.faces))


def block_handles(scene: Scene, mesh: dp.Mesh, shift: float) -> Handles:
    """The ends of the block as pins, told by `ContactMaps.parameters`.

    An end at x + t + Rx, R a turn by an angle about its middle: linear in t, cos - 1 and sin.

    Args:
        scene: the block.
        mesh: of `block_shape`.
        shift: of `ContactSettings`.
    """
    held = scene.handle_of >= 0
    at, of = scene.vertices[held], scene.handle_of[held]
    moves = np.zeros((2, 4, len(at), 2))
    for k in range(2):
        arm = at[of == k] - at[of == k].mean(axis=0)
        ones, zeros = np.ones(len(arm)), np.zeros(len(arm))
        rows = [(ones, zeros), (zeros, ones), arm.T, (-arm[:, 1], arm[:, 0])]
        moves[k, :, of == k] = np.array(rows).transpose(2, 0, 1)

    def amounts(code: Tensor) -> Tensor:
        x, y, angle = (shift * code[..., :6].double()).unflatten(-1, (2, 3)).unbind(-1)
        return torch.stack([x, y, angle.cos() - 1, angle.sin()], dim=-1).flatten(-2)

    pins, origin = torch.from_numpy(held), torch.from_numpy(at)
    return Handles(mesh, pins, origin, torch.from_numpy(moves.reshape(8, -1, 2)), amounts)


@dataclass(frozen=True)
class ContactRecord:
    """Errors of one map, and how it meets the obstacle.

    Attributes:
        l2_v: L2-V.
        l2_j: L2-J of the emitted map.
        intersects: whether boundaries cross, with the map put where its ends belong.
        steps: contact-aware steps after which they don't; None if `MAX_STEPS` are too few.
        l2_v_corrected: L2-V after these steps.
        milliseconds: of CPU time for the map, without steps.
    """

    l2_v: float
    l2_j: float
    intersects: bool
    steps: int | None
    l2_v_corrected: float
    milliseconds: float


@torch.no_grad()
def evaluate_contact(
    model: Model, maps: ContactMaps, shape: Shape
) -> tuple[list[ContactRecord], Float[Tensor, "k n 2"], Float[Tensor, "k n 2"]]:
    """The map for each state: the records, the maps in place, and the corrected maps."""
    solver = ContactSolver(maps.scene)
    records, images, corrected = [], [], []
    for index in range(len(maps)):
        start = time.process_time()
        prediction = model(shape, model.encode(parameters=maps.parameters[index : index + 1]))
        milliseconds = 1000 * (time.process_time() - start)
        target = maps.positions[index].double()
        handles, obstacle = (x[index].double().numpy() for x in (maps.handles, maps.obstacles))
        contact = Contact(solver, shape.mesh, handles, obstacle)
        phi = contact.placed(prediction.vertices[0].double())
        R = dp.jacobians(shape.mesh, phi)
        intersects = contact.intersects(phi)
        steps, free = (0, phi) if not intersects else contact.corrected(R)
        records.append(
            ContactRecord(
                float(l2_vertices(phi, target)),
                float(l2_jacobians(R, dp.jacobians(shape.mesh, target))),
                intersects,
                steps,
                float(l2_vertices(free, target)),
                milliseconds,
            )
        )
        images.append(phi)
        corrected.append(free)
    return records, torch.stack(images), torch.stack(corrected)


def summarise(records: Sequence[ContactRecord]) -> dict[str, float]:
    """Means over all maps, shares of those that intersect, and the median time."""

    def column(name: str) -> np.ndarray:
        return np.array([getattr(record, name) for record in records], dtype=np.float64)

    needed = [record for record in records if record.intersects]
    solved = [record.steps for record in needed if record.steps is not None]
    summary = {
        "maps": len(records),
        "L2-V": column("l2_v").mean(),
        "L2-V, 90%": np.percentile(column("l2_v"), 90),
        "L2-J, emitted": column("l2_j").mean(),
        "maps that intersect, %": 100 * column("intersects").mean(),
        "steps until none does, most": max(solved, default=0),
        "steps, mean of those that intersect": np.mean(solved) if solved else 0,
        f"maps that intersect after {MAX_STEPS} steps, %": 100
        * (len(needed) - len(solved))
        / len(records),
        "L2-V after the steps": column("l2_v_corrected").mean(),
        "CPU milliseconds, median": np.median(column("milliseconds")),
    }
    return {name: float(value) for name, value in summary.items()}


class _Pushes(NamedTuple):
    """Where some vertices of the block should go."""

    vertices: Int[np.ndarray, "p"]
    targets: Float[np.ndarray, "p 2"]


class Contact:
    """One state of block and star, in which a map of the block is to be without intersections.

    Args:
        solver: knows what intersects.
        mesh: the block, in the plane z = 0.
        handles: (2, 3) motions of its ends.
        obstacle: (3,) motion of the star.
    """

    def __init__(
        self,
        solver: ContactSolver,
        mesh: dp.Mesh,
        handles: Float[np.ndarray, "2 3"],
        obstacle: Float[np.ndarray, "3"],
    ) -> None:
        self.solver, self.mesh = solver, mesh
        self.held = torch.from_numpy(solver.scene.handle_of >= 0)
        self.ends = torch.from_numpy(solver.scene.placed_handles(handles))[self.held]
        self.star = solver.scene.placed_obstacle(obstacle)

    def placed(self, phi: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """The map moved so that its ends are in the mean where they belong."""
        return phi + (self.ends - phi[self.held]).mean(dim=0)

    def intersects(self, phi: Float[Tensor, "n 2"]) -> bool:
        """Whether the boundary of the block crosses itself or the star."""
        return self.solver.intersects(np.concatenate([phi.numpy(), self.star]))

    def corrected(
        self, R: Float[Tensor, "m 2 2"], max_steps: int = MAX_STEPS
    ) -> tuple[int | None, Float[Tensor, "n 2"]]:
        """Solve Poisson with the ends pinned, and what intersects pinned to where it does not.

        Each step adds the vertices that intersect to the pins; the Jacobians remain those of the
        prediction.

        Args:
            R: (m, 2, 2) Jacobians of the predicted map.
            max_steps: after which it gives up.

        Returns:
            The number of steps, each a solve, or None if the last map still intersects; that map.
        """
        pinned = self.held.clone()
        goal = torch.zeros(self.mesh.n_vertices, 2, dtype=torch.float64)
        goal[self.held] = self.ends
        for step in range(1, max_steps + 1):
            phi = dp.PoissonSolver(self.mesh, pins=pinned)(R, pins=goal[pinned])
            if not self.intersects(phi):
                return step, phi
            pushes = self._pushes(phi.numpy())
            vertices, targets = (torch.from_numpy(array) for array in pushes)
            free = ~self.held[vertices]
            pinned[vertices[free]] = True
            goal[vertices[free]] = targets[free]
        return None, phi

    def _pushes(self, phi: Float[np.ndarray, "n 2"]) -> _Pushes:
        """Vertices inside the star to its outline; edges that its points have passed, to these."""
        edges = self.solver.scene.boundary
        star = np.stack([self.star, np.roll(self.star, -1, axis=0)], axis=1)
        block = phi[edges]
        boundary = np.unique(edges)
        inside = boundary[_inside(phi[boundary], star)]
        out, _ = _nearest(phi[inside], star)
        first = _Pushes(inside, _beyond(phi[inside], out))
        passed = self.star[_inside(self.star, block)]
        touched, which = _nearest(passed, block)
        moves = _beyond(touched, passed) - touched
        ends = edges[which].ravel()
        second = _Pushes(ends, phi[ends] + np.repeat(moves, 2, axis=0))
        return _Pushes(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def _beyond(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """From start to end, and a little farther."""
    way = end - start
    length = np.linalg.norm(way, axis=1, keepdims=True)
    return end + MARGIN * way / np.where(length > 0, length, 1)


def _inside(
    points: Float[np.ndarray, "p 2"], edges: Float[np.ndarray, "e 2 2"]
) -> Bool[np.ndarray, "p"]:
    """Whether a ray to the right crosses the closed polygon an odd number of times."""
    (ax, ay), (bx, by) = edges[:, 0].T, edges[:, 1].T
    x, y = points[:, :1], points[:, 1:]
    spans = (ay > y) != (by > y)
    height = np.where(by == ay, 1, by - ay)  # those span nothing
    right = x < ax + (y - ay) / height * (bx - ax)
    return (spans & right).sum(axis=1) % 2 == 1


def _nearest(
    points: Float[np.ndarray, "p 2"], edges: Float[np.ndarray, "e 2 2"]
) -> tuple[Float[np.ndarray, "p 2"], Int[np.ndarray, "p"]]:
    """The nearest point of some edges, and on which it is."""
    a, way = edges[:, 0], edges[:, 1] - edges[:, 0]
    along = ((points[:, None] - a) * way).sum(-1) / (way**2).sum(-1)
    feet = a + along.clip(0, 1)[..., None] * way
    which = np.linalg.norm(points[:, None] - feet, axis=-1).argmin(axis=1)
    return feet[np.arange(len(points)), which], which
