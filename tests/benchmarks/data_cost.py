"""What UV training data cost: CPU time of each stage, and bytes of each array, per patch kept.

`python -m tests.benchmarks.data_cost` writes `docs/results/data_cost.json`, on one thread: patches
of 500 to 2,000 faces of generated parts, read from binary PLY files as those of a folder are.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
import trimesh
from safetensors import safe_open

from njf_models.datasets import build, patches, sources, uv
from njf_models.datasets.build import StoreSettings, build_store
from njf_models.datasets.sources import CSGParts, MeshFolder
from njf_models.datasets.store import UVStore

RESULT = Path(__file__).parents[2] / "docs" / "results" / "data_cost.json"

# The functions that make up a stage; what they call is theirs.
ONCE_PER_MESH = ("read", "graph of its faces")  # the graph, once per shard
STAGES: dict[str, list[tuple[Any, str]]] = {
    "read": [(sources, "read_mesh")],
    "graph of its faces": [(patches, "dual_graph")],
    "grow": [(patches.PatchSampler, "nearest")],
    "clean and check": [(patches, "clean_boundary"), (patches, "defect")],
    "align": [(patches, "align")],
    "check as a `Mesh`": [(patches, "rounded_mesh")],
    "Tutte": [(uv, "tutte")],
    "SLIM": [(uv, "slim")],
    "wave-kernel signature": [(uv, "wave_kernel_signature")],
    "align the map": [(uv, "procrustes")],
    "encode": [(build, "encode_shard")],
    "write": [(build, "write_atomically")],
}


@contextmanager
def timed_stages() -> Iterator[Counter[str]]:
    """CPU seconds spent in each stage while the context is open."""
    seconds: Counter[str] = Counter()

    def timed(stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds[stage] += time.process_time() - start

        return wrapper

    with ExitStack() as stack:
        for stage, functions in STAGES.items():
            for owner, name in functions:
                replacement = timed(stage, getattr(owner, name))
                stack.enter_context(patch.object(owner, name, replacement))
        yield seconds


def write_parts(folder: Path, n: int) -> None:
    """Generated parts as files."""
    for raw in CSGParts(n):
        mesh = trimesh.Trimesh(raw.vertices, raw.faces, process=False)
        mesh.export(folder / f"{raw.name.replace('/', '-')}.ply")


def bytes_by_array(store: UVStore) -> dict[str, int]:
    """Bytes in a store by array; columns of numbers about patches, and headers, are the rest."""
    sizes: Counter[str] = Counter()
    for shard in store.shards:
        with safe_open(shard.path, framework="numpy") as file:
            for name in ("vertices", "faces", "uv", "wks"):
                sizes[name] += file.get_tensor(name).nbytes
    total = sum(shard.path.stat().st_size for shard in store.shards)
    return dict(sizes) | {"the rest": total - sizes.total()}


def measure(folder: Path, n_meshes: int, n_patches: int) -> dict[str, Any]:
    """The cost of a store of so many patches of each of so many meshes."""
    (folder / "in").mkdir()
    write_parts(folder / "in", n_meshes)
    options = {"n_jobs": 1, "backend": "sequential", "progress": False}
    settings = StoreSettings()
    meshes = MeshFolder(folder / "in")
    build_store(folder / "warm", list(meshes)[:1], 1, settings, **options)
    with timed_stages() as seconds:
        start = time.process_time()
        store = build_store(folder / "store", meshes, n_patches, settings, **options)
        seconds["the rest"] = time.process_time() - start - seconds.total()
    kept = len(store)
    return {
        "patches": kept,
        "meshes": n_meshes,
        "draws": dict(store.counts.most_common()),
        "mean_faces": float(store.n_faces.mean()),
        "mean_vertices": float(store.n_vertices.mean()),
        "energies": settings.n_energies,
        "mesh_faces": int(sum(source["n_faces"] for source in store.sources) / n_meshes),
        "milliseconds per mesh": {n: 1000 * seconds.pop(n) / n_meshes for n in ONCE_PER_MESH},
        "milliseconds per patch": {
            n: 1000 * seconds[n] / kept for n in (*STAGES, "the rest") if n in seconds
        },
        "bytes per patch": {name: size / kept for name, size in bytes_by_array(store).items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", type=int, default=8)
    parser.add_argument("--patches", type=int, default=25, help="of each mesh")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder), options.meshes, options.patches)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
