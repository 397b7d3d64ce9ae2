"""How good a UV network is on meshes that it never saw, before and after `parameterize`.

    python -m tests.benchmarks.uv_results STORE OUT/split.json --weights uv

Maps the test patches of a store: the network's raw map, what `parameterize` makes of it, and SLIM
from Tutte's embedding beside it. Then times the raw map, in batches, against 20 SLIM iterations,
in turns. Writes `docs/results/uv.json`; nothing is chosen by these figures.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

import diffpoisson as dp
from njf_models.datasets.store import UVStore
from njf_models.evaluation import evaluate_uv, summarise
from njf_models.pretrained import load_pretrained, parameterize
from njf_models.training import UVExamples
from njf_models.uv_network import UVNetwork

RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv.json"
FILTERED = 0.3  # flatness |Σ nA| / ΣA of "filtered" patches
MILD = 8.0  # energy of SLIM's map of "filtered" patches, at most


def test_patches(store: Path, split: Path) -> UVStore:
    """The patches of the families that training held back."""
    families = set(json.loads(split.read_text())["test"])
    everything = UVStore(store)
    return everything.subset([i for i, f in enumerate(everything.family) if f in families])


def raw_summaries(network: UVNetwork, patches: UVStore) -> dict[str, Any]:
    """The paper's figures, of all and of filtered patches, and of fewer rounds."""
    inputs = network.inputs
    examples = UVExamples(
        patches,
        n_points=inputs.n_points,
        use_wks=inputs.n_energies > 0,
        n_eigenpairs=inputs.n_eigenpairs,
    )
    summaries = {}
    for rounds, stopped in by_rounds(network).items():
        records, _ = evaluate_uv(stopped.model, examples)
        kept = [r for r in records if r.flatness >= FILTERED and r.slim_energy <= MILD]
        summaries[rounds] = {"all": summarise(records), "filtered": summarise(kept)}
    return summaries[network.arguments["rounds"]] | {"rounds": summaries}


def by_rounds(network: UVNetwork) -> dict[int, UVNetwork]:
    """The network, stopped after each of its rounds."""
    return {k: network.with_rounds(k) for k in range(1, network.arguments["rounds"] + 1)}


def mapped(network: UVNetwork, mesh: dp.Mesh) -> dict[str, Any]:
    """One patch through `parameterize`, and by SLIM from either start."""
    uvmap = parameterize(mesh, model=network)
    from_tutte = dp.slim(mesh, dp.tutte(mesh))
    best = from_tutte.energies[-1]
    start = _repaired(network, mesh)
    record: dict[str, Any] = {
        "faces": mesh.n_faces,
        "flipped": uvmap.flipped,
        "certified": uvmap.certified,
        "method": uvmap.method,
        "milliseconds": uvmap.milliseconds,
        "energy_over_slim": uvmap.energy / best,
        "iterations_from_tutte": _iterations_to(from_tutte.energies, 1.01 * best),
    }
    if start is not None:
        ours = dp.slim(mesh, start)
        record["iterations_from_network"] = _iterations_to(ours.energies, 1.01 * best)
    return record


def _repaired(network: UVNetwork, mesh: dp.Mesh) -> torch.Tensor | None:
    """The network's map without flips, as `parameterize` repairs it; None if it does not."""
    solver = dp.PoissonSolver(mesh)
    uv, _ = dp.clamp_flips(solver, network.predict(mesh))
    uv, _ = dp.untangle(mesh, uv)
    return None if dp.flipped(dp.jacobians(mesh, uv)).any() else uv


def _iterations_to(energies: Sequence[float], goal: float) -> int | None:
    """How many iterations reach a goal; None if none does."""
    return next((i for i, energy in enumerate(energies) if energy <= goal), None)


def quartile_of_iterations(records: list[dict[str, Any]]) -> dict[str, float]:
    """Median iterations to 1% of SLIM's energy on the quarter that takes most from Tutte's map.

    A prediction that is not mended, or does not get there, counts like Tutte's map, which takes its
    place.
    """
    pairs = []
    for record in records:
        theirs, ours = record["iterations_from_tutte"], record.get("iterations_from_network")
        pairs.append((theirs, theirs if ours is None else ours))
    hardest = np.array(sorted(pairs, reverse=True)[: -(-len(pairs) // 4)], dtype=np.float64)
    return {"from Tutte": float(np.median(hardest[:, 0])), "ours": float(np.median(hardest[:, 1]))}


Contestant = tuple[str, Callable[[], None]]


def raw_name(rounds: int) -> str:
    return f"raw, prepared, {rounds} rounds"


def rates(network: UVNetwork, meshes: list[dp.Mesh], batch: int, rounds: int) -> dict[str, Any]:
    """Patches per second, raw from prepared and from plain meshes, and of 20 SLIM iterations."""
    prepared = [network.prepare(mesh) for mesh in meshes]
    plain = [(mesh.vertices, mesh.faces) for mesh in meshes]
    starts = [dp.tutte(mesh) for mesh in meshes]

    def in_batches(predict: Callable[[Any], Any], items: list[Any]) -> None:
        for i in range(0, len(items), batch):
            predict(items[i : i + batch])

    def from_arrays(items: list[Any]) -> None:
        network.predict_all([dp.Mesh(*arrays) for arrays in items])

    def slim_from(items: list[Any]) -> None:
        for mesh, start in items:
            dp.slim(mesh, start, tolerance=0, max_iterations=20)

    def tutte_and_slim(items: list[Any]) -> None:
        for arrays in items:
            mesh = dp.Mesh(*arrays)
            dp.slim(mesh, dp.tutte(mesh), tolerance=0, max_iterations=20)

    def raw(rounds: int, stopped: UVNetwork) -> Contestant:
        return raw_name(rounds), lambda: in_batches(stopped.predict_prepared, prepared)

    contestants = [
        *(raw(rounds, stopped) for rounds, stopped in by_rounds(network).items()),
        ("20 SLIM iterations", lambda: slim_from(list(zip(meshes, starts, strict=True)))),
        ("raw, from (V, F)", lambda: in_batches(from_arrays, plain)),
        ("Tutte and 20 SLIM iterations, from (V, F)", lambda: tutte_and_slim(plain)),
    ]
    seconds: dict[str, list[float]] = {name: [] for name, _ in contestants}
    for _ in range(rounds):
        for name, work in contestants:
            start = time.process_time()  # of one thread; what else runs must not count
            work()
            seconds[name].append(time.process_time() - start)
    rate = {n: sorted(len(meshes) / s for s in times[1:]) for n, times in seconds.items()}

    def ratio(ours: str, theirs: str) -> float:
        pairs = zip(seconds[ours][1:], seconds[theirs][1:], strict=True)
        return float(np.median([b / a for a, b in pairs]))

    return {
        "patches per second": {n: [r[0], float(np.median(r)), r[-1]] for n, r in rate.items()},
        "prepared over SLIM": {
            k: ratio(raw_name(k), "20 SLIM iterations") for k in by_rounds(network)
        },
        "from (V, F) over Tutte and SLIM": ratio(
            "raw, from (V, F)", "Tutte and 20 SLIM iterations, from (V, F)"
        ),
        "faces per patch": float(np.mean([mesh.n_faces for mesh in meshes])),
        "batch": batch,
        "rounds": rounds - 1,
        "threads": torch.get_num_threads(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("split", type=Path)
    parser.add_argument("--weights", default="uv", help="name, or file of UVNetwork.save")
    parser.add_argument("--limit", type=int, help="no more than so many patches")
    parser.add_argument("--timed", type=int, default=24, help="patches to time (24)")
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args()
    path = Path(options.weights)
    network = UVNetwork.load(path) if path.suffix else load_pretrained(options.weights)
    patches = test_patches(options.store, options.split)[: options.limit]
    raw = raw_summaries(network, patches)
    records = [mapped(network, patch.mesh) for patch in tqdm(patches, total=len(patches))]
    ratio = np.array([record["energy_over_slim"] for record in records])
    chosen = [patches[i].mesh for i in range(0, len(patches), -(-len(patches) // options.timed))]
    results = {
        "patches": len(patches),
        "meshes": sorted(set(patches.mesh_name)),
        "raw": raw,
        "parameterize": {
            "patches with a flip": sum(record["flipped"] > 0 for record in records),
            "not certified": sum(not record["certified"] for record in records),
            "energy over SLIM, median": float(np.median(ratio)),
            "energy over SLIM, p99": float(np.quantile(ratio, 0.99)),
            "from the network": float(np.mean(["init" in r["method"] for r in records])),
        },
        "iterations to 1%, hardest quarter": quartile_of_iterations(records),
        "rates": rates(network, chosen, batch=8, rounds=8),
        "records": records,
    }
    finite = json.loads(json.dumps(results), parse_constant=lambda _: None)
    options.json.write_text(json.dumps(finite, indent=1) + "\n")
    shown = {name: value for name, value in finite.items() if name not in ("records", "meshes")}
    print(json.dumps(shown, indent=1))


if __name__ == "__main__":
    main()
