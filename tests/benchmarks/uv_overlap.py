"""How often SLIM ends with an overlap on patches of real meshes, and what avoiding that costs.

`python -m tests.benchmarks.uv_overlap FOLDER` grows disk patches as the data set does, maps each
with and without `injective`, and writes `docs/results/uv_overlap.json`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffpoisson as dp
from njf_models.datasets.patches import PatchOptions, PatchRejectedError, PatchSampler
from njf_models.datasets.sources import MeshFolder

RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv_overlap.json"


def patches(folder: Path, per_mesh: int, max_faces: int) -> Iterator[dp.Mesh]:
    """Disks of 500 to 2,000 faces."""
    rng = np.random.default_rng(0)
    for raw in MeshFolder(folder):
        if not 1000 < len(raw.faces) <= max_faces:
            continue
        sampler, found = PatchSampler(raw.vertices, raw.faces, PatchOptions()), 0
        for _ in range(5 * per_mesh):
            try:
                patch = sampler.sample(rng)
            except PatchRejectedError:
                continue
            yield dp.Mesh(patch.vertices, patch.faces)
            if (found := found + 1) == per_mesh:
                break


def compare(mesh: dp.Mesh) -> dict[str, Any]:
    """One patch with and without `injective`."""
    record: dict[str, Any] = {"faces": mesh.n_faces}
    for name, injective in (("free", False), ("injective", True)):
        start = time.perf_counter()
        uvmap = dp.parameterize(mesh, injective=injective)
        record[name] = {
            "seconds": time.perf_counter() - start,
            "energy": uvmap.energy,
            "certified": uvmap.certified,
            "flipped": uvmap.flipped,
        }
    return record


def summary(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Of all patches, and of those on which plain SLIM overlaps."""
    overlapping = [r for r in records if not r["free"]["certified"]]
    ratios = np.array([r["injective"]["energy"] / r["free"]["energy"] for r in records])
    worse = np.array([r["injective"]["energy"] / r["free"]["energy"] for r in overlapping])
    seconds = {name: [r[name]["seconds"] for r in records] for name in ("free", "injective")}
    return {
        "patches": len(records),
        "flips": sum(r[name]["flipped"] for r in records for name in ("free", "injective")),
        "overlapping_percent": 100 * len(overlapping) / len(records),
        "certified_percent": 100 * float(np.mean([r["injective"]["certified"] for r in records])),
        "energy_ratio_p99": float(np.quantile(ratios, 0.99)),
        "energy_ratio_median_of_overlapping": float(np.median(worse)),
        "energy_ratio_worst": float(ratios.max()),
        "median_seconds": {name: float(np.median(s)) for name, s in seconds.items()},
        "mean_seconds": {name: float(np.mean(s)) for name, s in seconds.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--per-mesh", type=int, default=4)
    parser.add_argument("--max-faces", type=int, default=60_000)
    args = parser.parse_args()
    torch.set_num_threads(1)
    records = [compare(mesh) for mesh in patches(args.folder, args.per_mesh, args.max_faces)]
    result = summary(records)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
