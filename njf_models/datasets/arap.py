"""As-rigid-as-possible deformations of a solid whose handles are moved at random: maps to learn.

The minimiser is libigl's, local and global steps in turn (Sorkine and Alexa 2007; Chao et al. 2010
for tetrahedra). Alone they converge slowly, by a percent or two an iteration where limbs twist, so
Anderson's acceleration extrapolates from some iterates (Peng et al. 2018). What it converges to is
a fixed point of libigl's own iteration: how far one more step moves a vertex is kept as a residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch import Tensor
from tqdm import tqdm

from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.solids import Points, Solid
from njf_models.datasets.store import StoreError, write_atomically

_FORMAT = 1  # change it with anything that changes the maps
_CHUNK = 100  # maps in a file
_ARRAYS = ("offsets", "positions", "iterations", "residuals", "flips")


@dataclass(frozen=True, eq=False)
class Deformation:
    """A minimiser of the ARAP energy.

    Attributes:
        positions: (n, 3) of all vertices of the solid.
        iterations: local and global steps that were taken.
        residual: largest distance by which one more step moves a vertex, over the solid's size.
        flips: tetrahedra that are flat or inside out.
    """

    positions: Points
    iterations: int
    residual: float
    flips: int


class ArapSolver:
    """libigl's ARAP iteration on tetrahedra, prepared for given handles.

    Args:
        solid: what is deformed.
        memory: number of earlier iterates that Anderson's acceleration combines; 0 for none.
        accelerated: iterations after which it is given up. Where tetrahedra are about to flip their
            rotations jump, and it may wander for ever; plain steps always lower the energy.
        tolerance: of the residual.
        max_iterations: after which it raises.
    """

    def __init__(
        self,
        solid: Solid,
        *,
        memory: int = 6,
        accelerated: int = 200,
        tolerance: float = 1e-6,
        max_iterations: int = 5000,
    ) -> None:
        self.solid, self.memory, self.accelerated = solid, memory, accelerated
        self.tolerance, self.max_iterations = tolerance, max_iterations
        self._free = np.flatnonzero(solid.handle_of < 0)
        self._data = igl.ARAPData()
        self._data.energy = igl.ARAPEnergyType.ARAP_ENERGY_TYPE_ELEMENTS
        self._data.max_iter = 1
        held = solid.held.astype(np.int32)
        igl.arap_precomputation(solid.vertices, solid.tetrahedra, 3, held, self._data)

    def step(self, positions: Points, held: Float[np.ndarray, "k 3"]) -> Points:
        """Closest rotations, and the map whose Jacobians are closest to them."""
        return igl.arap_solve(held, self._data, positions)

    def __call__(self, offsets: Float[np.ndarray, "h 3"]) -> Deformation:
        """The minimiser that is reached from rest when each handle moves by its offset.

        Raises:
            RuntimeError: the residual is above the tolerance after so many iterations.
        """
        held = self.solid.moved_handles(offsets)
        x = self.step(self.solid.vertices.copy(), held)
        recent = _Anderson(self.memory)
        for iteration in range(1, self.max_iterations + 1):
            image = self.step(x, held)
            move = (image - x)[self._free]
            residual = float(np.linalg.norm(move, axis=1).max()) / self.solid.size
            if residual <= self.tolerance:
                flips = int((self.solid.volumes(image) <= 0).sum())
                return Deformation(image, iteration, residual, flips)
            x = image.copy()
            if iteration <= self.accelerated:
                x[self._free] = recent.next(x[self._free] - move, move)
        raise RuntimeError(
            f"ArapSolver: after {self.max_iterations} iterations a step still moves a vertex by "
            f"{residual:.1e} of the size, more than the tolerance {self.tolerance:.1e}"
        )


class _Anderson:
    """Extrapolation of a fixed-point iteration x ↦ x + f(x) from its last few iterates.

    The next iterate is that of the affine combination of the last ones whose f is smallest. Where f
    has doubled since, the last ones say nothing of here, and it starts anew.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self._x: list[np.ndarray] = []
        self._f: list[np.ndarray] = []

    def next(self, x: np.ndarray, f: np.ndarray) -> np.ndarray:
        """The next iterate after x, at which f was found."""
        if self._f and np.linalg.norm(f) > 2 * np.linalg.norm(self._f[-1]):
            self._x, self._f = [], []
        self._x = [*self._x, x.ravel()][-1 - self.memory :]
        self._f = [*self._f, f.ravel()][-1 - self.memory :]
        if len(self._f) == 1:
            return x + f
        dx, df = (np.diff(np.stack(rows), axis=0) for rows in (self._x, self._f))
        weights = np.linalg.lstsq(df.T, f.ravel(), rcond=None)[0]
        return x + f - (weights @ (dx + df)).reshape(x.shape)


# -------------------------------------------------------------------- files


@dataclass(frozen=True)
class ArapSettings:
    """What the maps of a data set have in common.

    Attributes:
        seed: map i depends on (seed, i) only: different seeds give sets without a common map.
        reach: each coordinate of a handle's offset is uniform between -reach and reach, in metres.
        tolerance: of `ArapSolver`.
    """

    seed: int = 0
    reach: float = 0.25
    tolerance: float = 1e-6


@dataclass(frozen=True, eq=False)
class ArapMaps:
    """Deformations of one solid, all of them in memory.

    Attributes:
        solid: which is deformed.
        settings: of the data set.
        offsets: (k, h, 3) float32 by how much each handle is moved.
        positions: (k, b, 3) float32 vertices of the deformed surface.
        iterations: (k,) local and global steps that each took.
        residuals: (k,) see `Deformation`.
        flips: (k,) see `Deformation`.
    """

    solid: Solid
    settings: ArapSettings
    offsets: Float[Tensor, "k h 3"]
    positions: Float[Tensor, "k b 3"]
    iterations: Int[Tensor, "k"]
    residuals: Float[Tensor, "k"]
    flips: Int[Tensor, "k"]

    def __len__(self) -> int:
        return len(self.offsets)

    @property
    def parameters(self) -> Float[Tensor, "k p"]:
        """(k, 3h) what a network is told: the handles' positions, from rest, in units of reach."""
        return self.offsets.flatten(1) / self.settings.reach

    @property
    def held(self) -> Bool[Tensor, "b"]:
        """Which vertices of the surface some handle holds."""
        return torch.from_numpy(self.solid.handle_of[self.solid.surface] >= 0)

    def held_positions(self, index: int) -> Float[Tensor, "p 3"]:
        """Where these are in one of the maps, float64."""
        at = self.solid.surface[self.held.numpy()]
        moved = self.offsets[index].double()[torch.from_numpy(self.solid.handle_of[at])]
        return torch.from_numpy(self.solid.vertices[at]) + moved


def draw_offsets(settings: ArapSettings, number: int, n_handles: int) -> Float[np.ndarray, "h 3"]:
    """By how much the handles are moved in one map of a data set."""
    rng = np.random.default_rng([settings.seed, number])
    return rng.uniform(-settings.reach, settings.reach, (n_handles, 3))


def build_arap(
    folder: Path | str,
    n_maps: int,
    solid: Solid,
    settings: ArapSettings | None = None,
    *,
    progress: bool = True,
) -> ArapMaps:
    """A data set of deformations, kept in a folder.

    Files that are there already are kept: an interrupted call goes on where it stopped when it is
    repeated, and a call with more maps adds to a data set, whose first ones stay the same.

    Args:
        folder: of the data set.
        n_maps: how many.
        solid: which is deformed.
        settings: of all maps.
        progress: show a progress bar.

    Raises:
        StoreError: the folder holds maps of another solid or of other settings.
        RuntimeError: a map that does not converge.
    """
    folder, settings = Path(folder), settings or ArapSettings()
    key = fingerprint(_FORMAT, solid, settings)
    solver = ArapSolver(solid, tolerance=settings.tolerance)
    chunks = []
    with tqdm(total=n_maps, desc="maps", disable=not progress) as bar:
        for start in range(0, n_maps, _CHUNK):
            path = folder / f"maps-{start:06d}.safetensors"
            wanted = range(start, min(start + _CHUNK, n_maps))
            chunk = _read(path, key) if path.exists() else None
            if chunk is None or len(chunk["flips"]) < len(wanted):
                chunk = _drawn(solver, settings, wanted, bar)
                write_atomically(path, save(chunk, metadata={"key": key}))
            else:
                bar.update(len(wanted))
            chunks.append({name: chunk[name][: len(wanted)] for name in _ARRAYS})
    arrays = (
        torch.from_numpy(np.concatenate([chunk[name] for chunk in chunks])) for name in _ARRAYS
    )
    return ArapMaps(solid, settings, *arrays)


def _drawn(
    solver: ArapSolver, settings: ArapSettings, numbers: Sequence[int], bar: tqdm
) -> dict[str, np.ndarray]:
    """The arrays of some maps."""
    solid = solver.solid
    offsets, found = [], []
    for number in numbers:
        offsets.append(draw_offsets(settings, number, solid.n_handles))
        found.append(solver(offsets[-1]))
        bar.update()
    return {
        "offsets": np.stack(offsets).astype(np.float32),
        "positions": np.stack([one.positions[solid.surface] for one in found]).astype(np.float32),
        "iterations": np.array([one.iterations for one in found], dtype=np.int32),
        "residuals": np.array([one.residual for one in found]),
        "flips": np.array([one.flips for one in found], dtype=np.int32),
    }


def _read(path: Path, key: str) -> dict[str, np.ndarray]:
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = {name: file.get_tensor(name) for name in _ARRAYS}
            of_file = file.metadata()["key"]
    except (SafetensorError, OSError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}): delete it and build the maps again"
        ) from error
    if of_file != key:
        raise StoreError(
            f"build_arap: {path.parent} holds maps of another solid or of other settings; use "
            "another folder"
        )
    return arrays


def save_solid(path: Path, solid: Solid) -> None:
    """Keep a solid in a file, so that several data sets and runs are of the same one."""
    arrays = {name: getattr(solid, name) for name in ("vertices", "tetrahedra", "handle_of")}
    write_atomically(path, save({name: np.ascontiguousarray(x) for name, x in arrays.items()}))


def load_solid(path: Path) -> Solid:
    """The solid that `save_solid` kept."""
    with safe_open(path, framework="numpy") as file:
        return Solid(*(file.get_tensor(name) for name in ("vertices", "tetrahedra", "handle_of")))
