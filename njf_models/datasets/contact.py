"""An elastic block in the plane, held at both ends, into which a rigid star is pushed.

An open stand-in for the data of Romero et al. 2021, which is not public. Equilibria of a stable
neo-Hookean block (Smith et al. 2018) are found by incremental potential contact (Li et al. 2020):
Newton's method with a barrier between all boundaries, whose steps are cut before anything meets.
From the free block, ends and star move little by little, and no state on the way intersects. The
barrier and its collision detection are those of the IPC Toolkit (MIT), from the package ipctk,
which the extra `elastic` installs; the elastic energy is this file's.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import torch
from jaxtyping import Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import Tensor
from tqdm import tqdm

from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.store import StoreError, write_atomically

_FORMAT = 1  # change it with anything that changes the states
_ARRAYS = ("handles", "obstacles", "positions", "iterations")
_LENGTH, _HEIGHT, _HELD = 3.0, 1.0, 0.15  # of the block, and of each end that is held
_TIPS, _OUTER, _INNER = 5, 0.35, 0.18  # of the star
_CLEAR = np.array([0.0, 2 * _HEIGHT, 0.0])  # where it meets nothing


@dataclass(frozen=True, eq=False)
class Scene:
    """The block at rest, its held ends, and the obstacle's outline.

    Attributes:
        vertices: (n, 2) of the block.
        faces: (m, 3) its triangles.
        handle_of: (n,) 0 and 1 at its left and right end, -1 elsewhere.
        outline: (s, 2) the star about the origin, counterclockwise.
    """

    vertices: Float[np.ndarray, "n 2"]
    faces: Int[np.ndarray, "m 3"]
    handle_of: Int[np.ndarray, "n"]
    outline: Float[np.ndarray, "s 2"]

    @cached_property
    def boundary(self) -> Int[np.ndarray, "b 2"]:
        """Edges of the block's boundary."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        _, first, count = np.unique(
            np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
        )
        return edges[first[count == 1]]

    def placed_handles(self, motions: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "n 2"]:
        """The block at rest with each end turned about its middle and moved.

        Args:
            motions: (x, y, angle) of each end.
        """
        placed = self.vertices.copy()
        for k, motion in enumerate(motions):
            end = self.handle_of == k
            middle = self.vertices[end].mean(axis=0)
            placed[end] = middle + _moved(self.vertices[end] - middle, motion)
        return placed

    def placed_obstacle(self, motion: Float[np.ndarray, "3"]) -> Float[np.ndarray, "s 2"]:
        """The star where (x, y, angle) puts it."""
        return _moved(self.outline, motion)


def make_scene(columns: int = 36) -> Scene:
    """A block of three by one, of so many columns of squares, each of two triangles.

    Args:
        columns: a multiple of three.
    """
    rows = columns // 3
    x = np.linspace(-_LENGTH / 2, _LENGTH / 2, columns + 1)
    y = np.linspace(-_HEIGHT / 2, _HEIGHT / 2, rows + 1)
    vertices = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    a = (i * (rows + 1) + j).ravel()
    b, c, d = a + rows + 1, a + rows + 2, a + 1
    even = ((i + j) % 2 == 0).ravel()[:, None, None]  # diagonals by turns
    halves = (np.stack([[a, b, c], [a, c, d]]), np.stack([[a, b, d], [b, c, d]]))
    faces = np.where(even, *(half.transpose(2, 0, 1) for half in halves)).reshape(-1, 3)
    left, right = vertices[:, 0] < _HELD - _LENGTH / 2, vertices[:, 0] > _LENGTH / 2 - _HELD
    angle = np.pi / _TIPS * np.arange(2 * _TIPS)
    radius = np.where(np.arange(2 * _TIPS) % 2, _INNER, _OUTER)
    corners = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    outline = np.stack([corners, middles], axis=1).reshape(-1, 2)
    return Scene(vertices, faces, np.where(left, 0, np.where(right, 1, -1)), outline)


def _moved(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    x, y, angle = motion
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s], [-s, c]]) + [x, y]


class _Elastic(NamedTuple):
    """Energy of the block, and if asked for its derivatives by its coordinates."""

    energy: float
    gradient: np.ndarray
    hessian: sp.csc_matrix | None


class ContactSolver:
    """Static equilibria of the block under given motions, by incremental potential contact.

    Args:
        scene: block and obstacle.
        poisson: Poisson's ratio; Young's modulus is one.
        distance: below which the barrier acts.
        stiffness: of the barrier.
        tolerance: largest move of a vertex in the last Newton step.
        max_iterations: Newton steps after which it raises.

    Raises:
        ModuleNotFoundError: ipctk is not installed.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        poisson: float = 0.4,
        distance: float = 0.02,
        stiffness: float = 1e3,
        tolerance: float = 1e-4,
        max_iterations: int = 200,
    ) -> None:
        if importlib.util.find_spec("ipctk") is None:
            raise ModuleNotFoundError(
                'ContactSolver needs the package ipctk: pip install "diffpoisson[elastic]"'
            )
        import ipctk  # noqa: PLC0415  (only where data is made)

        ipctk.set_num_threads(1)
        self._ipc, self.scene = ipctk, scene
        self.distance, self.tolerance, self.max_iterations = distance, tolerance, max_iterations
        self._mu = 1 / (2 * (1 + poisson))
        self._lambda = poisson / ((1 + poisson) * (1 - 2 * poisson))
        self._barrier = ipctk.BarrierPotential(distance, stiffness)
        n, s = len(scene.vertices), len(scene.outline)
        self._n, self._size = n, 2 * (n + s)
        self._fixed = np.repeat(np.concatenate([scene.handle_of >= 0, np.ones(s, dtype=bool)]), 2)
        ring = n + np.stack([np.arange(s), (np.arange(s) + 1) % s], axis=1)
        self._edges = np.concatenate([scene.boundary, ring]).astype(np.int32)
        self._collisions = self._collision_mesh()
        self._assemble()

    def rest(self, obstacle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "v 2"]:
        """The free block, and the star somewhere clear of it: a state to start from.

        Raises:
            ValueError: they intersect.
        """
        state = np.concatenate([self.scene.vertices, self.scene.placed_obstacle(obstacle)])
        if self.intersects(state):
            raise ValueError("ContactSolver.rest: the obstacle intersects the free block")
        return state

    def intersects(self, state: Float[np.ndarray, "v 2"]) -> bool:
        """Whether edges of the block's boundary or of the star cross each other."""
        return bool(self._ipc.has_intersections(self._collisions, self._at(state.ravel())))

    def __call__(
        self,
        state: Float[np.ndarray, "v 2"],
        handles: Float[np.ndarray, "2 3"],
        obstacle: Float[np.ndarray, "3"],
    ) -> tuple[Float[np.ndarray, "v 2"], int]:
        """The equilibrium that is reached when ends and star go to a new place.

        They are drawn there by springs, since a step of theirs at once might pass through the
        block, and then fixed.

        Args:
            state: without intersections; the block, and then the star.
            handles: (x, y, angle) of each end, from rest.
            obstacle: (x, y, angle) of the star.

        Returns:
            The new state, without intersections, and the number of Newton steps.

        Raises:
            RuntimeError: no equilibrium after so many Newton steps.
        """
        goal = np.concatenate(
            [self.scene.placed_handles(handles), self.scene.placed_obstacle(obstacle)]
        ).ravel()
        x = state.ravel().copy()
        for iteration in range(1, self.max_iterations + 1):
            arrived = bool((x[self._fixed] == goal[self._fixed]).all())
            step = self._newton_step(x, goal, arrived)
            moved = self._descend(x, step, goal, arrived)
            if arrived and np.abs(step).max() <= self.tolerance:
                return moved.reshape(-1, 2), iteration
            x = moved if arrived else self._snapped(moved, goal)
        raise RuntimeError(
            f"ContactSolver: no equilibrium after {self.max_iterations} Newton steps"
        )

    # ---------------------------------------------------------------- Newton's method

    _SPRING = 1e4  # of what draws ends and star to their place

    def _newton_step(self, x: np.ndarray, goal: np.ndarray, arrived: bool) -> np.ndarray:
        elastic = self._elastic(x, derivatives=True)
        contacts, at = self._contacts(x)
        to_full = self._collisions.to_full_dof
        gradient = elastic.gradient + to_full(
            self._barrier.gradient(contacts, self._collisions, at)
        )
        projection = self._ipc.PSDProjectionMethod.CLAMP
        curvature = self._barrier.hessian(contacts, self._collisions, at, projection)
        hessian = elastic.hessian + to_full(curvature)
        if arrived:
            free = np.flatnonzero(~self._fixed)
            step = np.zeros_like(x)
            step[free] = spl.spsolve(hessian[free][:, free].tocsc(), -gradient[free])
            return step
        springs = self._SPRING * self._fixed
        system = (hessian + sp.diags(springs)).tocsc()
        return spl.spsolve(system, -gradient - springs * (x - goal))

    def _descend(
        self, x: np.ndarray, step: np.ndarray, goal: np.ndarray, arrived: bool
    ) -> np.ndarray:
        """As far along the step as nothing meets and the energy falls."""
        share = self._ipc.compute_collision_free_stepsize(
            self._collisions, self._at(x), self._at(x + step)
        )
        share = 1.0 if share >= 1 else 0.9 * share
        before = self._energy(x, goal, arrived)
        # Rounding of the energy: at its end Newton's method would stop for it.
        slack = 8 * np.finfo(float).eps * abs(before)
        while self._energy(x + share * step, goal, arrived) > before + slack:
            share /= 2
            if share * np.abs(step).max() <= np.finfo(float).eps:
                return x
        return x + share * step

    def _snapped(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Ends and star at their place, if they are near and nothing is on the way."""
        there = np.where(self._fixed, goal, x)
        near = np.abs(there - x).max() < 0.1 * self.distance
        free = near and self._ipc.is_step_collision_free(
            self._collisions, self._at(x), self._at(there)
        )
        return there if free else x

    def _energy(self, x: np.ndarray, goal: np.ndarray, arrived: bool) -> float:
        contacts, at = self._contacts(x)
        energy = self._elastic(x).energy + self._barrier(contacts, self._collisions, at)
        missed = 0.0 if arrived else float(((x - goal)[self._fixed] ** 2).sum())
        return energy + self._SPRING / 2 * missed

    # ---------------------------------------------------------------- contact

    def _collision_mesh(self) -> Any:
        """All that may meet: both boundaries; the star is put clear of the block for once."""
        apart = np.concatenate([self.scene.vertices, _moved(self.scene.outline, _CLEAR)])
        surface = np.zeros(len(apart), dtype=bool)
        surface[self._edges] = True
        nothing = np.zeros((0, 3), dtype=np.int32)
        return self._ipc.CollisionMesh(
            surface.tolist(),
            [False] * len(apart),
            np.asfortranarray(apart),
            self._edges,
            nothing,
        )

    def _at(self, x: np.ndarray) -> np.ndarray:
        return np.asfortranarray(self._collisions.vertices(np.asfortranarray(x.reshape(-1, 2))))

    def _contacts(self, x: np.ndarray) -> tuple[Any, np.ndarray]:
        contacts, at = self._ipc.NormalCollisions(), self._at(x)
        contacts.build(self._collisions, at, self.distance)
        return contacts, at

    # ---------------------------------------------------------------- elasticity

    def _assemble(self) -> None:
        """B with vec(F) = B x for each triangle, row 2i + j for ∂xᵢ/∂Xⱼ; and where entries go."""
        X, T = self.scene.vertices, self.scene.faces
        D = np.stack([X[T[:, 1]] - X[T[:, 0]], X[T[:, 2]] - X[T[:, 0]]], axis=2)
        self._areas = np.linalg.det(D) / 2
        inverse = np.linalg.inv(D)
        hats = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # (m, 3, 2)
        self._B = np.einsum("maj,ik->mijak", hats, np.eye(2)).reshape(len(T), 4, 6)
        self._dofs = (2 * T[:, :, None] + np.arange(2)).reshape(-1, 6)
        self._rows = np.repeat(self._dofs, 6, axis=1).ravel()
        self._columns = np.tile(self._dofs, (1, 6)).ravel()

    def _elastic(self, x: np.ndarray, derivatives: bool = False) -> _Elastic:
        """μ/2 (‖F‖² - 2) + λ/2 (det F - 1 - μ/λ)², which has its minimum at rest."""
        mu, lam, areas = self._mu, self._lambda, self._areas
        F = np.einsum("mij,mj->mi", self._B, x[self._dofs])
        a, b, c, d = F.T
        volume = a * d - b * c - (1 + mu / lam)
        density = mu / 2 * ((F**2).sum(axis=1) - 2) + lam / 2 * volume**2
        energy, gradient = float(areas @ density), np.zeros(self._size)
        if not derivatives:
            return _Elastic(energy, gradient, None)
        cofactor = np.stack([d, -c, -b, a], axis=1)
        stress = mu * F + lam * volume[:, None] * cofactor
        forces = np.einsum("m,mi,mij->mj", areas, stress, self._B)
        np.add.at(gradient, self._dofs, forces)
        swap = np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, -1, 0, 0], [1, 0, 0, 0.0]])  # ∂cof/∂F
        curvature = (
            mu * np.eye(4)
            + lam * cofactor[:, :, None] * cofactor[:, None]
            + (lam * volume)[:, None, None] * swap
        )
        values, vectors = np.linalg.eigh(curvature)
        curvature = np.einsum("mik,mk,mjk->mij", vectors, values.clip(0), vectors)
        blocks = np.einsum("m,mki,mkl,mlj->mij", areas, self._B, curvature, self._B)
        shape = (self._size, self._size)
        hessian = sp.csc_matrix((blocks.ravel(), (self._rows, self._columns)), shape)
        return _Elastic(energy, gradient, hessian)


# -------------------------------------------------------------------- data sets


@dataclass(frozen=True)
class ContactSettings:
    """What the states of a data set have in common.

    Attributes:
        seed: trajectory i depends on (seed, i) only: different seeds give sets without a common
            one.
        columns: of squares of the block.
        steps: positions of the star on its way into the block; the later half is kept, each a
            state.
        shift: largest move of an end along each axis.
        turn: largest turn of an end, in radians.
        depth: lowest place of the star's middle, from the middle of the block at rest.
    """

    seed: int = 0
    columns: int = 36
    steps: int = 8
    shift: float = 0.3
    turn: float = 0.5
    depth: float = 0.25


@dataclass(frozen=True, eq=False)
class ContactMaps:
    """Equilibria of one scene, all of them in memory.

    Attributes:
        scene: block and obstacle.
        settings: of the data set.
        handles: (k, 2, 3) motions of the ends, float32.
        obstacles: (k, 3) motions of the star, float32.
        positions: (k, n, 2) vertices of the block, float32.
        iterations: (k,) Newton steps that each took.
    """

    scene: Scene
    settings: ContactSettings
    handles: Float[Tensor, "k 2 3"]
    obstacles: Float[Tensor, "k 3"]
    positions: Float[Tensor, "k n 2"]
    iterations: Int[Tensor, "k"]

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def parameters(self) -> Float[Tensor, "k p=10"]:
        """What a network is told: both motions; the angle of the star up to its symmetry."""
        x, y, angle = self.obstacles.split(1, dim=1)
        turns = [(_TIPS * angle).cos(), (_TIPS * angle).sin()]
        return torch.cat([self.handles.flatten(1) / self.settings.shift, x, y, *turns], dim=1)


class _State(NamedTuple):
    """One state of a trajectory."""

    handles: np.ndarray
    obstacle: np.ndarray
    positions: np.ndarray
    iterations: int


def draw_trajectory(solver: ContactSolver, settings: ContactSettings, number: int) -> list[_State]:
    """The ends go to random places in the first half of the way; the star comes from above."""
    rng = np.random.default_rng([settings.seed, number])
    largest = np.array([settings.shift, settings.shift, settings.turn])
    handles = rng.uniform(-largest, largest, (2, 3))
    # Pulled apart rather than pushed together, where the block would buckle one way or another.
    handles[:, 0] = np.abs(handles[:, 0]) * [-1, 1] + [settings.shift / 3, -settings.shift / 3]
    x, angle = rng.uniform(-0.9, 0.9), rng.uniform(0, 2 * np.pi)
    state = solver.rest(np.array([x, _CLEAR[1], angle]))
    n, half = len(solver.scene.vertices), settings.steps // 2
    states = []
    for step, y in enumerate(np.linspace(1.3, settings.depth, settings.steps), 1):
        motions, obstacle = min(1.0, step / half) * handles, np.array([x, y, angle])
        state, iterations = solver(state, motions, obstacle)
        if step > half:
            states.append(_State(motions, obstacle, state[:n], iterations))
    return states


def build_contact(
    folder: Path | str,
    n_trajectories: int,
    settings: ContactSettings | None = None,
    *,
    progress: bool = True,
) -> ContactMaps:
    """A data set of equilibria, kept in a folder, a file for each trajectory.

    Files that are there already are kept: an interrupted call goes on where it stopped when it is
    repeated, and a call with more trajectories adds to a data set. Where nothing is missing, ipctk
    is not needed.

    Args:
        folder: of the data set.
        n_trajectories: how many.
        settings: of all of them.
        progress: show a progress bar.

    Raises:
        StoreError: the folder holds states of other settings, or a damaged file.
        RuntimeError: a state without an equilibrium.
    """
    folder, settings = Path(folder), settings or ContactSettings()
    scene = make_scene(settings.columns)
    key = fingerprint(_FORMAT, scene, settings)
    paths = [folder / f"trajectory-{number:06d}.safetensors" for number in range(n_trajectories)]
    missing = [number for number, path in enumerate(paths) if not path.exists()]
    if missing:
        solver = ContactSolver(scene)
        for number in tqdm(missing, desc="trajectories", disable=not progress):
            states = draw_trajectory(solver, settings, number)
            columns = (np.stack(column) for column in zip(*states, strict=True))
            arrays = {
                name: column.astype(np.int32 if name == "iterations" else np.float32)
                for name, column in zip(_ARRAYS, columns, strict=True)
            }
            write_atomically(paths[number], save(arrays, metadata={"key": key}))
    chunks = [_read(path, key) for path in paths]
    tensors = {
        name: torch.from_numpy(np.concatenate([chunk[name] for chunk in chunks]))
        for name in _ARRAYS
    }
    return ContactMaps(scene, settings, **tensors)


def _read(path: Path, key: str) -> dict[str, np.ndarray]:
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in _ARRAYS}
            of_file = file.metadata()["key"]
    except (SafetensorError, OSError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}): delete it and build the states again"
        ) from error
    if of_file != key:
        raise StoreError(
            f"build_contact: {path.parent} holds states of other settings; use another folder"
        )
    return arrays
