"""Ship a trained UV network: its weights and their card, from what training left behind.

    python -m tests.benchmarks.uv_card STORE OUT "njf data ..." "njf train ..."

Writes `njf_models/weights/uv.safetensors` and `uv.json`.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path

import torch

from njf_models.datasets.store import PatchFilter, UVStore
from njf_models.uv_network import UVNetwork

KINDS = {
    "njf": "Neural Jacobian Field",
    "diffusion+njf": "Neural Jacobian Field with DiffusionNet as encoder",
}
CHOSEN_BY = {
    "best": "loss on the validation split",
    "last": "flips and energy of the emitted maps on the validation split, where the end of "
    "training was ahead of the step of least loss",
}
WEIGHTS = Path(__file__).parents[2] / "njf_models" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("commands", nargs="+")
    parser.add_argument(
        "--begun-with", type=Path, nargs="*", default=[], help="checkpoints of trainings before"
    )
    parser.add_argument("--machine", required=True, help="in words")
    parser.add_argument("--max-energy", type=float, default=8.0, help="as training had it")
    parser.add_argument("--checkpoint", choices=CHOSEN_BY, default="best")
    options = parser.parse_args()
    checkpoint = options.out / "checkpoints" / f"{options.checkpoint}.ckpt"
    record = torch.load(checkpoint, map_location="cpu", weights_only=False)
    trainings = [torch.load(p, weights_only=False) for p in options.begun_with] + [record]
    WEIGHTS.mkdir(exist_ok=True)
    network = UVNetwork.from_checkpoint(checkpoint)
    network.save(WEIGHTS / "uv.safetensors")

    store = UVStore(options.store, PatchFilter(0.0, None, options.max_energy))
    split = json.loads((options.out / "split.json").read_text())
    counts = {n: sum(f in set(names) for f in store.family) for n, names in split.items()}
    licences = Counter(source["licence"] for source in store.sources)
    card = {
        "what": f"UV maps of disk patches: {KINDS[network.kind]}, "
        f"{network.arguments['rounds']} rounds, {network.arguments['width']} wide",
        "parameters": sum(p.numel() for p in network.model.parameters()),
        "bytes": (WEIGHTS / "uv.safetensors").stat().st_size,
        "licence of the weights": "MIT",
        "data": f"{len(store)} patches of {len(store.sources)} meshes, {store.n_faces.mean():.0f} "
        f"faces on average, targets by SLIM with energies up to {options.max_energy}",
        "licences of the meshes": ", ".join(f"{n} {name}" for name, n in licences.most_common()),
        "split by mesh family": ", ".join(f"{n} {name}" for name, n in counts.items()),
        "chosen by": CHOSEN_BY[options.checkpoint],
        "optimiser steps": sum(int(training["global_step"]) for training in trainings),
        "minutes of processor time": round(
            sum(float(training["cpu_seconds"]) for training in trainings) / 60, 1
        ),
        "machine": options.machine,
        "commands": " ; ".join(options.commands),
        "limits": "trained on disk patches of 500 to 2,000 faces; closed surfaces cut open have no "
        "pose to be seen in, and start from Tutte's embedding",
        "families": split,
        "meshes": [[s["name"], s["licence"], s["origin"]] for s in store.sources],
    }
    (WEIGHTS / "uv.json").write_text(json.dumps(card, indent=1) + "\n")


if __name__ == "__main__":
    main()
