"""Bodies as a chain of networks carries them, for the next network of the chain to learn from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors.torch import load_file, save
from torch import Tensor
from tqdm import tqdm

import diffpoisson as dp
from njf_models.chain import ChainedNJF
from njf_models.datasets.bodies import Body
from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.store import write_atomically
from njf_models.features import Shape
from njf_models.njf import NeuralJacobianField


@torch.no_grad()
def carry(
    bodies: Iterable[Body],
    networks: Sequence[NeuralJacobianField],
    folder: Path,
    *,
    n_sources: int,
    n_points: int,
    progress: bool = True,
) -> list[Body]:
    """Bodies, and where networks take them from their first poses, for the next one to start from.

    Kept in files; an interrupted call goes on where it stopped when it is repeated.

    Args:
        bodies: the data set.
        networks: a chain, each told nothing of a target.
        folder: for the files.
        n_sources: how many poses of each body.
        n_points: how many points the encoders see.
        progress: show a progress bar.
    """
    chain = ChainedNJF.of(networks, n_points)
    state = {name: value.numpy() for name, value in chain.state_dict().items()}
    key = fingerprint(state, n_sources, n_points)[:16]
    carried = []
    for body in tqdm(bodies, desc="carried", disable=not progress):
        path = folder / f"body-{body.number:06d}-{key}.safetensors"
        if not path.exists():
            vertices = torch.stack([_carried(chain, x, body.faces) for x in body.posed[:n_sources]])
            write_atomically(path, save({"vertices": vertices.float()}))
        carried.append(replace(body, carried=load_file(path)["vertices"]))
    return carried


def _carried(
    chain: ChainedNJF, vertices: Float[Tensor, "n 3"], faces: Int[Tensor, "m 3"]
) -> Float[Tensor, "n 3"]:
    shape = Shape.prepare(dp.Mesh(vertices.double(), faces))
    return chain(shape, vertices.new_zeros(0)).vertices
