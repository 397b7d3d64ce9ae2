"""UV training pairs: aligned disk patches of real meshes and the SLIM maps that flatten them.

A target uv is the minimiser of the symmetric Dirichlet energy, turned and shifted onto the
projection of its patch to the plane, since the energy does not see rigid motions but a network
must be told one.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import Dataset

from diffpoisson.mesh import Mesh, MeshError
from diffpoisson.parameterization import procrustes, slim, tutte
from diffpoisson.spectral import wave_kernel_signature
from njf_models.datasets.cache import Cache, Entry, fingerprint
from njf_models.datasets.patches import Patch, PatchOptions, PatchRejectedError, PatchSampler
from njf_models.datasets.sources import RawMesh

_VERSION = "1"  # change it with anything that changes the entries, here or in `patches`


@dataclass(frozen=True, eq=False)
class UVPatch:
    """One training pair: a patch of unit area and its map to the plane.

    Attributes:
        vertices: (n, 3) float64, aligned as `patches.align` does.
        faces: (m, 3) int64.
        uv: (n, 2) float64 flip-free target, same units, rigidly aligned with `vertices[:, :2]`.
        wks: (n, k) float32 wave-kernel signature, dimensionless.
        mesh_name: the `RawMesh` it was cut from.
        family: what near-copies of that mesh share; see `split_by_mesh`.
        flatness: |Σ nA| / ΣA, 1 where the patch is flat: the difficulty axis.
        energy: mean symmetric Dirichlet energy of uv, 4 at an isometry.
    """

    vertices: Float[Tensor, "n 3"]
    faces: Int[Tensor, "m 3"]
    uv: Float[Tensor, "n 2"]
    wks: Float[Tensor, "n k"]
    mesh_name: str
    family: str
    flatness: float
    energy: float

    @cached_property
    def mesh(self) -> Mesh:
        """The patch as the domain of operators."""
        return Mesh(self.vertices, self.faces)


class UVPatchDataset(Dataset[UVPatch]):
    """Patches as a torch data set; batches are lists, because patches differ in size."""

    def __init__(self, patches: Sequence[UVPatch]) -> None:
        self.patches = patches

    def __len__(self) -> int:
        return len(self.patches)

    def __getitem__(self, index: int) -> UVPatch:
        return self.patches[index]


def build_uv_patches(
    raw_meshes: Iterable[RawMesh],
    n_patches_per_mesh: int,
    *,
    seed: int = 0,
    options: PatchOptions | None = None,
    n_energies: int = 50,
    cache_root: Path | None = None,
    n_jobs: int = -1,
) -> tuple[list[UVPatch], Counter[str]]:
    """Cut, align and flatten random patches, in parallel and through the cache.

    Args:
        raw_meshes: the sources.
        n_patches_per_mesh: how many to try to get from each mesh.
        seed: patch i of a mesh depends on the mesh's content, i and this only.
        options: sizes and filters of the patches.
        n_energies: length k of the wave-kernel signature.
        cache_root: folder of all caches, by default `cache.default_root()`.
        n_jobs: processes, -1 for one per core.

    Returns:
        The patches, in the order of the meshes; and how many draws were "kept" or rejected, by
        reason.
    """
    options = options or PatchOptions()
    cache = Cache("uv", _VERSION, cache_root)
    draws = [
        (raw, (raw.vertices, raw.faces, (seed, i), options, n_energies))
        for raw in raw_meshes
        for i in range(n_patches_per_mesh)
    ]
    entries = cache.map(
        build_entry, [task for _, task in draws], n_jobs=n_jobs, description="UV patches"
    )
    counts: Counter[str] = Counter()
    for entry in entries:
        counts.update(json.loads(str(entry["counts"])))
    patches = [
        _from_entry(entry, raw)
        for entry, (raw, _) in zip(entries, draws, strict=True)
        if "uv" in entry
    ]
    return patches, counts


def build_entry(
    vertices: np.ndarray,
    faces: np.ndarray,
    stream: tuple[int, int],
    options: PatchOptions,
    n_energies: int,
) -> Entry:
    """One patch of a mesh as a cache entry; without arrays if every attempt was rejected.

    The stream of random numbers, (seed, index), is mixed with the content, or meshes with the
    same connectivity would be cut alike.
    """
    rng = np.random.default_rng(int(fingerprint(vertices, faces, stream), 16))
    sampler = PatchSampler(vertices, faces, options)
    counts: Counter[str] = Counter()
    for _ in range(options.attempts):
        try:
            entry = flatten(sampler.sample(rng), n_energies)
        except PatchRejectedError as rejection:
            counts[str(rejection)] += 1
        else:
            counts["kept"] += 1
            return {**entry, "counts": np.array(json.dumps(counts))}
    return {"counts": np.array(json.dumps(counts))}


def flatten(patch: Patch, n_energies: int) -> Entry:
    """A patch with its SLIM map, aligned to the projection, and its wave-kernel signature.

    Raises:
        PatchRejectedError: the patch cannot be flattened reliably.
    """
    try:
        mesh = Mesh(patch.vertices, patch.faces)
        result = slim(mesh, tutte(mesh))
    except (MeshError, RuntimeError):
        raise PatchRejectedError("nearly degenerate") from None
    if not result.converged:
        raise PatchRejectedError("SLIM did not converge")
    uv = procrustes(result.uv, mesh.vertices[:, :2], mesh.vertex_areas)
    wks = wave_kernel_signature(mesh, n_energies).float()
    return {
        "vertices": patch.vertices,
        "faces": patch.faces,
        "uv": uv.numpy(),
        "wks": wks.numpy(),
        "flatness": np.array(patch.flatness),
        "energy": np.array(result.energies[-1]),
    }


def split_by_mesh(
    patches: Sequence[UVPatch], fractions: Sequence[float], seed: int = 0
) -> list[list[UVPatch]]:
    """Split so that no mesh, and no near-copy of one, is on two sides.

    Families are ordered by a hash of their name and cut where the patches reach the fractions, so
    the same families always split the same way, in whatever order the patches come.

    Args:
        patches: to be split.
        fractions: of the patches, one per part, summing to 1.
        seed: chooses among the splits.

    Raises:
        ValueError: fractions that do not sum to one, or too few families to fill each part.
    """
    if not np.isclose(sum(fractions), 1) or min(fractions) <= 0:
        raise ValueError(f"split_by_mesh: fractions must be positive and sum to 1, got {fractions}")
    sizes = Counter(patch.family for patch in patches)
    families = sorted(sizes, key=lambda family: fingerprint(seed, family))
    size = np.array([sizes[family] for family in families], dtype=np.float64)
    middle = (size.cumsum() - size / 2) / size.sum()
    part = dict(zip(families, np.searchsorted(np.cumsum(fractions)[:-1], middle), strict=True))
    parts = [[p for p in patches if part[p.family] == k] for k in range(len(fractions))]
    if not all(parts):
        raise ValueError(
            f"split_by_mesh: {len(families)} families of meshes give parts of "
            f"{[len(p) for p in parts]} patches; use more meshes, larger fractions or another seed"
        )
    return parts


def _from_entry(entry: Entry, raw: RawMesh) -> UVPatch:
    return UVPatch(
        vertices=torch.from_numpy(entry["vertices"]),
        faces=torch.from_numpy(entry["faces"]),
        uv=torch.from_numpy(entry["uv"]),
        wks=torch.from_numpy(entry["wks"]),
        mesh_name=raw.name,
        family=raw.family,
        flatness=float(entry["flatness"]),
        energy=float(entry["energy"]),
    )
