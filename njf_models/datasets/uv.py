"""UV training pairs: aligned disk patches of real meshes and the SLIM maps that flatten them.

A target uv is the minimiser of the symmetric Dirichlet energy, turned and shifted onto the
projection of its patch to the plane, since the energy does not see rigid motions but a network
must be told one. All numbers are rounded here as `store` stores them, before anything is derived
from them: a target is the map of the patch that will be read.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from diffpoisson.distortion import symmetric_dirichlet
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh, MeshError
from diffpoisson.parameterization import procrustes, slim, tutte
from diffpoisson.spectral import wave_kernel_signature
from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.patches import Patch, PatchRejectedError, PatchSampler


@dataclass(frozen=True, eq=False)
class UVPatch:
    """One training pair: a patch of unit area and its map to the plane.

    Attributes:
        vertices: (n, 3) float64, aligned as `patches.align` does.
        faces: (m, 3) int64.
        uv: (n, 2) float64 flip-free target, same units, rigidly aligned with `vertices[:, :2]`.
        wks: (n, k) float32 wave-kernel signature, dimensionless; k may be 0.
        mesh_name: the `RawMesh` it was cut from.
        family: what near-copies of that mesh share; see `store.split_by_mesh`.
        flatness: |Σ nA| / ΣA, 1 where the patch is flat: the difficulty axis.
        energy: mean symmetric Dirichlet energy of uv, 4 at an isometry.
        iterations: how many SLIM took to converge.
    """

    vertices: Float[Tensor, "n 3"]
    faces: Int[Tensor, "m 3"]
    uv: Float[Tensor, "n 2"]
    wks: Float[Tensor, "n k"]
    mesh_name: str
    family: str
    flatness: float
    energy: float
    iterations: int = 0

    @cached_property
    def mesh(self) -> Mesh:
        """The patch as the domain of operators."""
        return Mesh(self.vertices, self.faces)


@dataclass(frozen=True, eq=False)
class FlatPatch:
    """A patch with its target.

    Attributes:
        patch: the disk.
        uv: (n, 2) float32 target.
        wks: (n, k) float16 wave-kernel signature.
        energy: mean symmetric Dirichlet energy of uv, 4 at an isometry.
        iterations: how many SLIM took to converge.
    """

    patch: Patch
    uv: Float[Tensor, "n 2"]
    wks: Float[Tensor, "n k"]
    energy: float
    iterations: int


def draw(
    sampler: PatchSampler, mesh_key: str, seed: int, index: int, n_energies: int
) -> tuple[FlatPatch | None, Counter[str]]:
    """Patch number `index` of a mesh, which depends on the arguments only.

    The stream of random numbers is mixed with the content of the mesh, or meshes of the same
    connectivity would be cut alike.

    Args:
        sampler: of the mesh.
        mesh_key: fingerprint of the mesh's arrays.
        seed: of the data set.
        index: number of the patch.
        n_energies: length k of the wave-kernel signature, 0 for none.

    Returns:
        The patch, or None if every attempt was rejected; and how many attempts were "kept" or
        rejected, by reason.
    """
    rng = np.random.default_rng(int(fingerprint(mesh_key, seed, index), 16))
    counts: Counter[str] = Counter()
    for _ in range(sampler.options.attempts):
        try:
            flat = flatten(sampler.sample(rng), n_energies)
        except PatchRejectedError as rejection:
            counts[str(rejection)] += 1
        else:
            counts["kept"] += 1
            return flat, counts
    return None, counts


def flatten(patch: Patch, n_energies: int) -> FlatPatch:
    """A patch with its SLIM map, aligned to the projection, and its wave-kernel signature.

    Raises:
        PatchRejectedError: the patch cannot be flattened reliably.
    """
    mesh = patch.mesh
    try:
        result = slim(mesh, tutte(mesh))
        wks = wave_kernel_signature(mesh, n_energies) if n_energies else mesh.vertices[:, :0]
    except (MeshError, RuntimeError, ValueError):
        raise PatchRejectedError("nearly degenerate") from None
    if not result.converged:
        raise PatchRejectedError("SLIM did not converge")
    uv = procrustes(result.uv, mesh.vertices[:, :2], mesh.vertex_areas).float()
    density = symmetric_dirichlet(jacobians(mesh, uv.double()))
    energy = float((mesh.areas * density).sum() / mesh.areas.sum())
    if not math.isfinite(energy) or not wks.half().isfinite().all():
        raise PatchRejectedError("rounding")
    return FlatPatch(patch, uv, wks.half(), energy, len(result.energies) - 1)
