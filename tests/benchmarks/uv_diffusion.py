"""DiffusionNet as a UV network, and as the encoder of a Neural Jacobian Field, at equal time.

    python -m tests.benchmarks.uv_diffusion STORE --split SPLIT.json --minutes 4

The store needs wave-kernel signatures. As `uv_ablation`: the same patches, minutes of processor
time and cosine for each, figures of the validation split. Writes `docs/results/uv_diffusion.json`
after each model and goes on with those that are not in it.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import torch

from njf_models.datasets.store import PatchFilter, UVStore
from njf_models.evaluation import evaluate_uv
from njf_models.training import UVExamples
from tests.benchmarks.uv_ablation import OBJECTIVE, SHIPPED, TimedTraining, figures, fit

RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv_diffusion.json"
PAPER = {"supervised": "paper", "augment": True}


class Contestant(NamedTuple):
    """A model, what it learns by, and what it sees."""

    kind: str
    model: dict[str, Any]
    objective: dict[str, Any]
    wks: bool = False
    eigenpairs: int = 64


CODED = {"face_features": 6, "point_features": 6, "code_size": 256}
SIGNED = {"face_features": 56, "point_features": 56, "code_size": 256}


def diffusing(channels: int, width: int, **options: int) -> Contestant:
    """Four rounds with DiffusionNet as their encoder."""
    model = {"features": 6, "net_width": channels} | SHIPPED | {"width": width}
    return Contestant("diffusion+njf", model, OBJECTIVE, **options)


CONTESTANTS = {
    "NJF of the paper: PointNet and WKS, 1 round": Contestant("njf", SIGNED, PAPER, wks=True),
    "DiffusionNet predicts UVs": Contestant("diffusion", {"features": 6}, PAPER),
    "the paper's NJF with DiffusionNet as encoder": Contestant(
        "diffusion+njf", {"features": 6}, PAPER
    ),
    "4 rounds, 64 wide, PointNet": Contestant("njf", CODED | SHIPPED, OBJECTIVE),
    "4 rounds, 64 wide, DiffusionNet of 64 channels": diffusing(64, 64),
    "4 rounds, 32 wide, DiffusionNet of 64 channels": diffusing(64, 32),
    "4 rounds, 32 wide, DiffusionNet of 32 channels": diffusing(32, 32),
    "4 rounds, 32 wide, DiffusionNet of 32 channels, 32 eigenpairs": diffusing(
        32, 32, eigenpairs=32
    ),
}


def measure(module: TimedTraining, examples: UVExamples) -> dict[str, float | None]:
    """Those of the ablation, and the faces that the paper counts in this comparison."""
    records, _ = evaluate_uv(module.model, examples)
    return figures(module, examples) | {
        "D>10 per patch, raw": sum(r.distorted_raw for r in records) / len(records),
        "D>10 per patch": sum(r.distorted for r in records) / len(records),
        "parameters": sum(p.numel() for p in module.model.parameters()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=4.0, help="of processor time each")
    parser.add_argument("--only", nargs="+", choices=CONTESTANTS, default=list(CONTESTANTS))
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    store = UVStore(options.store, PatchFilter(0.0, None, 8.0))
    families = {k: set(v) for k, v in json.loads(options.split.read_text()).items()}
    result = json.loads(options.json.read_text()) if options.json.exists() else {"models": {}}
    for name in options.only:
        if name in result["models"]:
            continue
        contestant = CONTESTANTS[name]
        train, validation = (
            UVExamples(
                store.subset([i for i, f in enumerate(store.family) if f in families[part]]),
                n_points=256,
                resample=part == "train",
                use_wks=contestant.wks,
                n_eigenpairs=contestant.eigenpairs
                if contestant.kind.startswith("diffusion")
                else 0,
            )
            for part in ("train", "validation")
        )
        lightning.seed_everything(0, verbose=False)
        model = contestant.model | {"output_dim": 2}
        module = TimedTraining(model, contestant.objective, kind=contestant.kind)
        fit(module, train, 60 * options.minutes)
        result["models"][name] = measure(module, validation)
        result |= {"minutes": options.minutes, "training patches": len(train)}
        options.json.write_text(json.dumps(result, indent=1) + "\n")
        print(name, result["models"][name], flush=True)


if __name__ == "__main__":
    main()
