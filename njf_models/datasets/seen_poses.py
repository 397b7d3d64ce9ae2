"""Bodies as basis points see them, and their poses: pairs to learn poses from, without a mesh.

They cost a tenth of the bodies of `datasets.bodies`: nothing of a surface is kept, and poses in
which it cuts itself are not drawn again.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from safetensors import safe_open
from safetensors.torch import load_file, save
from torch import Tensor
from tqdm import tqdm

import diffpoisson as dp
from njf_models.basis_points import basis_features
from njf_models.datasets.bodies import PHENOTYPES, BodyModel
from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.poses import sample_pose
from njf_models.datasets.store import StoreError, write_atomically
from njf_models.datasets.triangulation import Triangulation

PER_FILE = 1000
_PER_IDENTITY = 8
_FORMAT = 1  # change it with anything that changes the pairs


class SeenPoses(NamedTuple):
    """What is seen of bodies, and their poses.

    Attributes:
        features: (n, pairs, 8) `basis_points.basis_features`, in half precision.
        poses: (n, 60) rotation vectors of `datasets.poses.JOINTS`, radians.
    """

    features: Float[Tensor, "n pairs 8"]
    poses: Float[Tensor, "n 60"]


def build_seen_poses(
    folder: Path | str,
    n_files: int,
    *,
    n_basis: int,
    n_faces: int = 2500,
    seed: int = 0,
    progress: bool = True,
) -> SeenPoses:
    """Pairs in files of a thousand; an interrupted call goes on where it stopped when repeated.

    Args:
        folder: for the files.
        n_files: how many.
        n_basis: how many basis points.
        n_faces: of the triangulation that they see.
        seed: file i depends on (seed, i) only.
        progress: show a progress bar.

    Raises:
        StoreError: the folder holds pairs of other settings.
        ModuleNotFoundError: pairs are missing, and anny is not installed.
    """
    paths = [Path(folder) / f"seen-{number:04d}.safetensors" for number in range(n_files)]
    key = fingerprint(_FORMAT, n_basis, n_faces, seed)
    missing = [number for number, path in enumerate(paths) if not _present(path, key)]
    if missing:
        model = BodyModel()
        triangulation = Triangulation.decimated(model.reference, n_faces)
        for number in tqdm(missing, desc="seen poses", disable=not progress):
            pairs = _draw(model, triangulation, n_basis, np.random.default_rng([seed, number]))
            write_atomically(paths[number], save(pairs._asdict(), metadata={"key": key}))
    pieces = [SeenPoses(**load_file(path)) for path in paths]
    return SeenPoses(*(torch.cat(arrays) for arrays in zip(*pieces, strict=True)))


def _draw(
    model: BodyModel, triangulation: Triangulation, n_basis: int, rng: np.random.Generator
) -> SeenPoses:
    features, poses = [], []
    for _ in range(PER_FILE // _PER_IDENTITY):
        phenotype = torch.tensor([rng.uniform(*limits) for limits in PHENOTYPES.values()])
        some = [torch.from_numpy(sample_pose(rng)).float().flatten() for _ in range(_PER_IDENTITY)]
        vertices = triangulation.deformed(model.vertices(phenotype, torch.stack(some)).double())
        features += [basis_features(dp.Mesh(x, triangulation.faces), n_basis) for x in vertices]
        poses += some
    return SeenPoses(torch.stack(features).half(), torch.stack(poses))


def _present(path: Path, key: str) -> bool:
    if not path.exists():
        return False
    with safe_open(path, framework="pt") as file:
        if file.metadata()["key"] != key:
            raise StoreError(
                f"build_seen_poses: {path.parent} holds pairs of other settings; use another folder"
            )
    return True
