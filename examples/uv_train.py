"""Train a Neural Jacobian Field to flatten patches of real meshes, and show how well it does.

Meshes → disk patches → SLIM targets → split by mesh → training → evaluation on unseen meshes. The
default takes about ten minutes on two cores; `--full` trains until it no longer improves. Run it
again after an interruption, and it goes on where it stopped: patches and checkpoints are kept.

The network is that of the shipped weights: it learns of the whole patch by diffusion, and predicts,
solves and corrects four times. `--paper` trains the paper's: PointNet, wave-kernel signatures, one
prediction, and the paper's loss.

Writes to the folder `--out`: results.png, results.json, the network as uv.safetensors, the patches,
the training log and checkpoints.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict
from itertools import chain, islice
from pathlib import Path

import lightning
import numpy as np
import torch

from njf_models.budget import planned_steps
from njf_models.datasets.build import StoreSettings, build_store
from njf_models.datasets.patches import PatchOptions
from njf_models.datasets.sources import CSGParts, DogBones, MeshFolder, RawMesh, Thingi10K
from njf_models.datasets.store import UVStore, split_by_mesh
from njf_models.evaluation import UVRecord, evaluate_uv, format_table, summarise
from njf_models.experiments import circumstances, quiet, training_cost
from njf_models.report import UVRow, save_uv_report
from njf_models.trained import Inputs
from njf_models.training import (
    Batch,
    NJFTraining,
    UVExamples,
    last_checkpoint,
    loader,
    make_trainer,
)
from njf_models.uv_network import UVNetwork

SPLIT = (0.8, 0.1, 0.1)  # of the patches, by families of meshes: train, validation, test
N_VALIDATIONS = 10


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    quiet()

    patches = collect_patches(options)
    train, validation, test = split_by_mesh(patches, SPLIT, seed=options.seed)
    print(f"{len(train)} training, {len(validation)} validation, {len(test)} test patches")

    test_examples = examples(test, options)
    # The projection to the plane, or with our network four local/global steps from there.
    untrained = make_module(options, steps=1).model
    before, _ = evaluate_uv(untrained, test_examples)
    checkpoint = fit(train, validation, options)
    network = UVNetwork.from_checkpoint(checkpoint)
    network.save(options.out / "uv.safetensors")
    after, maps = evaluate_uv(network.model, test_examples)

    table = {"untrained": summarise(before), "trained": summarise(after)}
    print("\nUnseen meshes (test split):\n" + format_table(table))
    results = {
        **circumstances(options),
        "draws": dict(patches.counts),
        "splits": {"train": names(train), "validation": names(validation), "test": names(test)},
        "training": training_cost(checkpoint),
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
    add("--out", type=Path, help="folder for results (runs/uv, or runs/uv-paper)")
    add("--paper", action="store_true", help="train the paper's network, by its loss")
    add("--meshes", type=Path, help="folder of obj, ply, off or stl files, instead of the built-in")
    add("--thingi10k", type=int, metavar="N", help="N meshes of Thingi10K, instead of the built-in")
    add("--csg", type=int, default=60, metavar="N", help="number of generated parts (60)")
    add("--patches", type=int, default=12, metavar="N", help="patches per mesh (12)")
    add("--faces", type=int, nargs=2, default=(500, 2000), help="size of a patch (500 2000)")
    add("--min-flatness", type=float, default=0.3, help="reject patches below |Σ nA| / ΣA (0.3)")
    add("--batch-size", type=int, default=8, help="patches per step (8)")
    add("--minutes", type=float, default=6, help="of processor time for training (6)")
    add("--full", action="store_true", help="train until the validation loss stops improving")
    add("--restart", action="store_true", help="ignore the checkpoint of an earlier run in --out")
    add("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    options.out = options.out or Path("runs/uv-paper" if options.paper else "runs/uv")
    return options


def collect_patches(options: argparse.Namespace) -> UVStore:
    """Patches with their SLIM targets; those that an earlier run has made are not made again."""
    sources: Iterable[RawMesh] = chain(DogBones(), CSGParts(options.csg, options.seed))
    if options.meshes is not None:
        sources = MeshFolder(options.meshes)
    elif options.thingi10k is not None:
        sources = islice(Thingi10K(), options.thingi10k)
    smallest, largest = options.faces
    limits = PatchOptions(smallest, largest, min_flatness=options.min_flatness)
    n_energies = inputs(options).n_energies
    settings = StoreSettings(limits, n_energies=n_energies, seed=options.seed)
    store = build_store(options.out / "patches", sources, options.patches, settings)
    draws = (f"{n} {reason}" for reason, n in store.counts.most_common())
    print("patches drawn: " + ", ".join(draws))
    return store


def inputs(options: argparse.Namespace) -> Inputs:
    """What the network sees."""
    if options.paper:
        return Inputs(n_points=1024, n_energies=50)
    return Inputs(n_points=1, n_eigenpairs=32)


def examples(
    patches: UVStore, options: argparse.Namespace, *, resample: bool = False
) -> UVExamples:
    seen = inputs(options)
    return UVExamples(
        patches,
        n_points=seen.n_points,
        resample=resample,
        use_wks=seen.n_energies > 0,
        n_eigenpairs=seen.n_eigenpairs,
    )


def make_module(options: argparse.Namespace, steps: int | None) -> NJFTraining:
    """The network and its loss."""
    lightning.seed_everything(options.seed, verbose=False)
    seen = {"steps": steps, "inputs": asdict(inputs(options))}
    if options.paper:
        model = {"face_features": 56, "point_features": 56, "code_size": 1000, "output_dim": 2}
        return NJFTraining(model, {"supervised": "paper"}, **seen)
    model = {"features": 6, "net_width": 32, "width": 32, "output_dim": 2}
    rounds = {"rounds": 4, "local_step": True}
    objective = {"supervised": "turned", "distortion": 0.3, "augment": True}
    return NJFTraining(model | rounds, objective, kind="diffusion+njf", **seen)


def fit(train: UVStore, validation: UVStore, options: argparse.Namespace) -> Path:
    """Train, going on from the last checkpoint if there is one; the best by validation loss."""
    learned = examples(train, options, resample=True)
    steps = None if options.full else plan(learned, options)
    trainer = make_trainer(
        options.out,
        steps=steps,
        stop_after=40 if options.full else None,
        validate_every=None if steps is None else steps // N_VALIDATIONS,
    )
    trainer.fit(
        make_module(options, steps),
        loader(learned, options.batch_size, shuffle=True),
        loader(examples(validation, options), 16),
        ckpt_path=None if options.restart else last_checkpoint(options.out),
    )
    return options.out / "checkpoints" / "best.ckpt"


def plan(learned: UVExamples, options: argparse.Namespace) -> int:
    """Steps that take the wanted time, a multiple of the validations: one follows the last."""
    first = [learned[i] for i in range(min(options.batch_size, len(learned)))]
    module = make_module(options, steps=1)
    path = options.out / "steps.json"
    if options.restart:
        path.unlink(missing_ok=True)
    return planned_steps(path, module, [Batch.pack(first)], options.minutes, N_VALIDATIONS)


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
