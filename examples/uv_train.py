"""Train a Neural Jacobian Field to flatten patches of real meshes, and show how well it does.

Meshes → disk patches → SLIM targets → split by mesh → training → evaluation on unseen meshes. The
default takes about ten minutes on two cores; `--full` trains until it no longer improves. Run it
again after an interruption, and it goes on where it stopped: patches and checkpoints are kept.

Writes to the folder `--out`: results.png, results.json, the patches, the training log and
checkpoints.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import time
import warnings
from collections.abc import Iterable
from dataclasses import asdict
from itertools import chain, islice
from pathlib import Path

import lightning
import numpy as np
import torch

from njf_models.datasets.build import StoreSettings, build_store
from njf_models.datasets.patches import PatchOptions
from njf_models.datasets.sources import CSGParts, DogBones, MeshFolder, RawMesh, Thingi10K
from njf_models.datasets.store import UVStore, split_by_mesh
from njf_models.evaluation import UVRecord, evaluate_uv, format_table, summarise
from njf_models.report import UVRow, save_uv_report
from njf_models.training import (
    NJFTraining,
    UVExamples,
    last_checkpoint,
    load_checkpoint,
    loader,
    make_trainer,
)

SPLIT = (0.8, 0.1, 0.1)  # of the patches, by families of meshes: train, validation, test


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    lightning.seed_everything(options.seed, verbose=False)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # no advertisements
    warnings.filterwarnings("ignore", module="lightning.pytorch.utilities._pytree")

    patches = collect_patches(options)
    train, validation, test = split_by_mesh(patches, SPLIT, seed=options.seed)
    print(f"{len(train)} training, {len(validation)} validation, {len(test)} test patches")

    module = make_module(options, n_wks=patches[0].wks.shape[1])
    test_examples = UVExamples(test, use_wks=options.wks)
    before, _ = evaluate_uv(module.model, test_examples)  # identity, so projection to the plane
    seconds = fit(module, train, validation, options)
    model = load_checkpoint(options.out / "checkpoints" / "best.ckpt")
    after, maps = evaluate_uv(model, test_examples)

    table = {"untrained": summarise(before), "trained": summarise(after)}
    print("\nUnseen meshes (test split):\n" + format_table(table))
    results = {
        "options": {name: str(value) for name, value in vars(options).items()},
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        "draws": dict(patches.counts),
        "splits": {"train": names(train), "validation": names(validation), "test": names(test)},
        "training_seconds": seconds,
        "summary": table,
        "patches": [asdict(record) for record in after],
    }
    # JSON has no infinity: a map with a flip has the energy null.
    finite = json.loads(json.dumps(results), parse_constant=lambda _: None)
    (options.out / "results.json").write_text(json.dumps(finite, indent=1))
    draw(options.out, test, maps, before, after)
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/uv"), help="folder for results (default: runs/uv)")
    add("--meshes", type=Path, help="folder of obj, ply, off or stl files, instead of the built-in")
    add("--thingi10k", type=int, metavar="N", help="N meshes of Thingi10K, instead of the built-in")
    add("--csg", type=int, default=60, metavar="N", help="number of generated parts (60)")
    add("--patches", type=int, default=12, metavar="N", help="patches per mesh (12)")
    add("--faces", type=int, nargs=2, default=(500, 2000), help="size of a patch (500 2000)")
    add("--min-flatness", type=float, default=0.3, help="reject patches below |Σ nA| / ΣA (0.3)")
    add("--no-wks", dest="wks", action="store_false", help="without the wave-kernel signature")
    add(
        "--code-size", type=int, default=256, help="size of PointNet's code (256; the paper's 1000)"
    )
    add("--loss", choices=("paper", "official"), default="paper", help="see njf_models.losses")
    add("--batch-size", type=int, default=4, help="patches per step (4)")
    add("--minutes", type=float, default=6, help="training time (6)")
    add("--full", action="store_true", help="train until the validation loss stops improving")
    add("--restart", action="store_true", help="ignore the checkpoint of an earlier run in --out")
    add("--seed", type=int, default=0)
    return parser.parse_args(argv)


def collect_patches(options: argparse.Namespace) -> UVStore:
    """Patches with their SLIM targets; those that an earlier run has made are not made again."""
    sources: Iterable[RawMesh] = chain(DogBones(), CSGParts(options.csg, options.seed))
    if options.meshes is not None:
        sources = MeshFolder(options.meshes)
    elif options.thingi10k is not None:
        sources = islice(Thingi10K(), options.thingi10k)
    smallest, largest = options.faces
    limits = PatchOptions(smallest, largest, min_flatness=options.min_flatness)
    settings = StoreSettings(limits, seed=options.seed)
    store = build_store(options.out / "patches", sources, options.patches, settings)
    draws = (f"{n} {reason}" for reason, n in store.counts.most_common())
    print("patches drawn: " + ", ".join(draws))
    return store


def make_module(options: argparse.Namespace, n_wks: int) -> NJFTraining:
    n_features = 6 + (n_wks if options.wks else 0)
    model = {
        "face_features": n_features,
        "point_features": n_features,
        "code_size": options.code_size,
        "output_dim": 2,
        "centering": "area" if options.loss == "paper" else "vertex",
    }
    return NJFTraining(model, {"supervised": options.loss})


def fit(
    module: NJFTraining,
    train: UVStore,
    validation: UVStore,
    options: argparse.Namespace,
) -> float:
    """Train, going on from the last checkpoint if there is one; the seconds it took."""
    trainer = make_trainer(
        options.out,
        minutes=None if options.full else options.minutes,
        stop_after=40 if options.full else None,
    )
    start = time.perf_counter()
    trainer.fit(
        module,
        loader(
            UVExamples(train, resample=True, use_wks=options.wks), options.batch_size, shuffle=True
        ),
        loader(UVExamples(validation, use_wks=options.wks), 16),
        ckpt_path=None if options.restart else last_checkpoint(options.out),
    )
    return time.perf_counter() - start


def names(patches: UVStore) -> list[str]:
    return sorted(set(patches.mesh_name))


def draw(
    out: Path,
    test: UVStore,
    maps: list[torch.Tensor],
    before: list[UVRecord],
    after: list[UVRecord],
) -> None:
    """Draw the test patches at three percentiles of the loss, chosen by nothing else."""
    order = np.argsort([record.loss for record in after])
    rows = []
    for percentile in (10, 50, 90):
        i = int(order[round(percentile / 100 * (len(order) - 1))])
        patch, record = test[i], after[i]
        title = (
            f"{record.mesh_name}, {record.n_faces} faces\n{percentile}th percentile of the loss\n"
            f"loss {record.loss:.2f} (untrained {before[i].loss:.2f}), {record.flips} flips"
        )
        rows.append(UVRow(title, patch.mesh, {"network": maps[i], "SLIM": patch.uv}))
    log = max((out / "csv").glob("version_*/metrics.csv"), key=lambda p: p.stat().st_mtime)
    save_uv_report(rows, log, out / "results.png")


if __name__ == "__main__":
    main()
