"""Ten thousand patches that no network saw, through `njf_models.parameterize`.

    python -m tests.benchmarks.uv_certified FOLDER

Patches of 500 to 2,000 faces, up to 16 of a mesh: the folder's meshes whose families training held
back, and generated parts of another seed. Flips are counted from the coordinates, not taken from
the certificate. Writes `docs/results/uv_certified.json` after each mesh, and goes on from there.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import diffpoisson as dp
from njf_models.datasets.patches import PatchOptions, PatchRejectedError, PatchSampler
from njf_models.datasets.sources import CSGParts, MeshFolder, RawMesh
from njf_models.pretrained import card, parameterize

RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv_certified.json"
PER_MESH = 16
SEED = 1  # of the parts; training had 0


def unseen(folder: Path) -> Iterator[RawMesh]:
    """Meshes of families that training held back, and parts without end."""
    families = card("uv")["families"]
    held_back = {*families["validation"], *families["test"]}
    return chain(
        (raw for raw in MeshFolder(folder) if raw.family in held_back), CSGParts(10**6, SEED)
    )


def patches(raw: RawMesh) -> Iterator[dp.Mesh]:
    """Disks, the same ones at each call."""
    rng = np.random.default_rng(0)
    sampler = PatchSampler(raw.vertices, raw.faces, PatchOptions(500, 2000))
    found = 0
    for _ in range(4 * PER_MESH):
        try:
            patch = sampler.sample(rng)
        except PatchRejectedError:
            continue
        yield patch.mesh
        found += 1
        if found == PER_MESH:
            return


def outcome(mesh: dp.Mesh) -> dict[str, Any]:
    """One patch."""
    start = time.process_time()
    uvmap = parameterize(mesh)
    seconds = time.process_time() - start
    a, b, c = uvmap.uv[uvmap.mesh.faces].double().unbind(1)
    twice_area = torch.linalg.det(torch.stack([b - a, c - a], dim=-1))
    return {
        "seconds": seconds,
        "flips": int((twice_area <= 0).sum()),
        "certified": uvmap.certified,
        "energy": uvmap.energy,
        "method": uvmap.method,
    }


def summary(meshes: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Of all patches."""
    records = [record for found in meshes.values() for record in found]
    energies = [record["energy"] for record in records]
    return {
        "patches": len(records),
        "meshes": sum(bool(found) for found in meshes.values()),
        "patches with a flip": sum(record["flips"] > 0 for record in records),
        "not certified": sum(not record["certified"] for record in records),
        "energy, median": float(np.median(energies)),
        "energy, 99%": float(np.quantile(energies, 0.99)),
        "energy, worst": float(np.max(energies)),
        "processor seconds, median": float(np.median([r["seconds"] for r in records])),
        "processor seconds, worst": float(np.max([r["seconds"] for r in records])),
        "methods": dict(Counter(record["method"] for record in records).most_common()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--patches", type=int, default=10_000)
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    kept = options.json.with_suffix(".jsonl")  # one line for each mesh that is done
    lines = kept.read_text().splitlines() if kept.exists() else []
    meshes = {line["mesh"]: line["patches"] for line in map(json.loads, lines)}
    with tqdm(total=options.patches, initial=sum(map(len, meshes.values()))) as bar:
        for raw in unseen(options.folder):
            if bar.n >= options.patches:
                break
            if raw.name in meshes:
                continue
            meshes[raw.name] = []
            for mesh in patches(raw):
                meshes[raw.name].append(outcome(mesh))
                bar.update()
            with kept.open("a") as file:
                file.write(json.dumps({"mesh": raw.name, "patches": meshes[raw.name]}) + "\n")
            options.json.write_text(json.dumps(summary(meshes), indent=1) + "\n")


if __name__ == "__main__":
    main()
