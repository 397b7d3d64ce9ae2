"""What each part of the UV network is worth: variants trained for the same processor time.

    python -m tests.benchmarks.uv_ablation STORE --split SPLIT.json --minutes 5

The store needs wave-kernel signatures. Each variant differs in one thing from the shipped network,
sees the same patches, and trains for the same minutes of processor time, in which its rate falls to
zero along a cosine. Figures are of the validation split: the test split decides nothing. Writes
`docs/results/uv_ablation.json` after each variant and goes on with those that are not in it.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch.utilities.types import STEP_OUTPUT
from tqdm import tqdm

from njf_models.datasets.store import PatchFilter, UVStore
from njf_models.evaluation import evaluate_uv
from njf_models.training import Batch, NJFTraining, UVExamples, loader

RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv_ablation.json"
SHIPPED = {"rounds": 4, "width": 64, "local_step": True}
OBJECTIVE = {"supervised": "turned", "distortion": 0.3, "augment": True}


@dataclass(frozen=True)
class Variant:
    """What differs from the shipped network."""

    model: dict[str, Any] = field(default_factory=dict)
    objective: dict[str, Any] = field(default_factory=dict)
    wks: bool = False


VARIANTS = {
    "4 rounds": Variant(),
    "1 round": Variant({"rounds": 1, "local_step": False}),
    "1 round, 128 wide, the paper's loss, WKS": Variant(
        {"rounds": 1, "local_step": False, "width": 128},
        {"supervised": "paper", "distortion": 0.0},
        wks=True,
    ),
    "2 rounds": Variant({"rounds": 2}),
    "6 rounds": Variant({"rounds": 6}),
    "the rounds share their weights": Variant({"shared_rounds": True}),
    "corrections of the Jacobians, no local step": Variant({"local_step": False}),
    "128 wide": Variant({"width": 128}),
    "targets as they are, not turned": Variant({}, {"supervised": "paper"}),
    "no distortion term": Variant({}, {"distortion": 0.0}),
    "no targets": Variant({}, {"supervised": None, "distortion": 1.0}),
    "hard patches pull no harder": Variant({}, {"robust": True}),
    "WKS": Variant(wks=True),
}


class TimedTraining(NJFTraining):
    """Training that ends after some processor time; its rate follows a cosine of that time."""

    seconds: float

    def on_train_start(self) -> None:
        super().on_train_start()
        self._began = time.process_time()

    def on_train_batch_end(self, outputs: STEP_OUTPUT, batch: Batch, batch_idx: int) -> None:
        spent = min((time.process_time() - self._began) / self.seconds, 1.0)
        for group in self.optimizers().param_groups:  # type: ignore[union-attr]
            group["lr"] = self.learning_rate * (1 + math.cos(math.pi * spent)) / 2
        self.trainer.should_stop = spent == 1.0

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=self.learning_rate)


def trained(variant: Variant, examples: UVExamples, seconds: float) -> TimedTraining:
    """A network after its time."""
    lightning.seed_everything(0, verbose=False)
    n_features = 6 + (examples.patches[0].wks.shape[1] if variant.wks else 0)
    model = {"face_features": n_features, "point_features": n_features, "code_size": 256}
    module = TimedTraining(
        model | {"output_dim": 2} | SHIPPED | variant.model, OBJECTIVE | variant.objective
    )
    fit(module, examples, seconds)
    return module


def fit(module: TimedTraining, examples: UVExamples, seconds: float) -> None:
    """Train for a time, in which factors and features are not counted."""
    for index in tqdm(range(len(examples)), desc="factors and features"):
        examples[index]  # kept
    module.seconds = seconds
    trainer = lightning.Trainer(
        accelerator="cpu",
        max_epochs=-1,
        logger=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    )
    trainer.fit(module, loader(examples, 8, shuffle=True))


def figures(module: TimedTraining, examples: UVExamples) -> dict[str, float | None]:
    """Of the validation patches; None for infinity, which JSON lacks."""
    records, _ = evaluate_uv(module.model, examples)
    raw, emitted = (np.array([getattr(r, n) for r in records]) for n in ("flips_raw", "flips"))
    median = float(np.median([r.energy / r.slim_energy for r in records]))
    return {
        "steps": module.global_step,
        "patches": len(records),
        "patches with a flip, raw, %": 100 * float((raw > 0).mean()),
        "flips per patch, raw": float(raw.mean()),
        "patches with a flip, %": 100 * float((emitted > 0).mean()),
        "energy over SLIM's, median": median if median < math.inf else None,
        "L2-J, median": float(np.median([r.l2_j for r in records])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", type=Path)
    parser.add_argument("--split", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=5.0, help="of processor time each")
    parser.add_argument("--only", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    store = UVStore(options.store, PatchFilter(0.0, None, 8.0))
    families = json.loads(options.split.read_text())
    result = json.loads(options.json.read_text()) if options.json.exists() else {"variants": {}}
    for wks in (False, True):
        todo = [n for n in options.only if VARIANTS[n].wks == wks and n not in result["variants"]]
        if not todo:
            continue
        train, validation = (
            UVExamples(
                store.subset([i for i, f in enumerate(store.family) if f in set(families[part])]),
                n_points=256,
                resample=part == "train",
                use_wks=wks,
            )
            for part in ("train", "validation")
        )
        for name in todo:
            module = trained(VARIANTS[name], train, 60 * options.minutes)
            result["variants"][name] = figures(module, validation)
            result |= {"minutes": options.minutes, "training patches": len(train)}
            options.json.write_text(json.dumps(result, indent=1) + "\n")
            print(name, result["variants"][name], flush=True)


if __name__ == "__main__":
    main()
