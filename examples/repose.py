"""Re-pose human bodies from pose parameters: a Neural Jacobian Field beside two baselines.

Random bodies → poses inside joint limits → training on one source and many targets a step, the
source seen by PointNet, the target told by its pose parameters → evaluation on bodies and poses
that were never seen. The baselines, a displacement field and Neural Cages, have the same data, code
and loss, and the same CPU time.

The default takes about fifteen minutes on two cores, and a minute or two more when the body model
is built for the first time; `--full` has the paper's code and points, and takes days on a CPU. Run
it again after an interruption, and it goes on where it stopped. The paper's bodies, STAR, are
licensed and can't be had here: compare ratios with its figures, not errors.

Writes to the folder `--out`: results.png, results.json, maps.json (the errors of each test map),
the bodies, training logs and checkpoints.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import time
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch

from njf_models.body_report import BodyRow, save_body_report
from njf_models.datasets.bodies import POSE_SIZE, Body, BodySettings, BodyStore, build_bodies
from njf_models.evaluation import format_table
from njf_models.reposing import PoseExamples, PoseRecord, body_loader, evaluate_reposing, summarise
from njf_models.training import NJFTraining, last_checkpoint, load_checkpoint, make_trainer

KINDS = {"njf": "ours", "displacement": "displacement", "cages": "cages"}  # and names in tables
PAPER = {"bodies": 2000, "poses": 32, "code_size": 1000, "points": 1024, "targets": 32}
N_VALIDATIONS = 10


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # no advertisements
    warnings.filterwarnings("ignore", module="lightning.pytorch.utilities._pytree")

    train, validation, test = make_bodies(options)
    steps = plan(train, options)
    records, maps, costs = {}, {}, {}
    for kind in options.models:
        title = KINDS[kind]
        checkpoint = fit(kind, steps[kind], train, validation, options)
        costs[title] = {"steps": steps[kind], **cost(checkpoint)}
        examples = examples_of(test, options)
        records[title], maps[title] = evaluate_reposing(load_checkpoint(checkpoint), examples)

    table = {"untrained": summarise(unmoved(options, test))}
    table |= {title: summarise(of_model) for title, of_model in records.items()}
    print("\nUnseen bodies and poses:\n" + format_table(table))
    results = {
        "options": {
            name: value for name, value in vars(options).items() if not isinstance(value, Path)
        },
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
        "training": costs,
        "summary": table,
    }
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    every = {title: [asdict(record) for record in of_model] for title, of_model in records.items()}
    (options.out / "maps.json").write_text(json.dumps(every))
    draw(options.out / "results.png", test, maps, records)
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/repose"), help="folder for results (runs/repose)")
    add("--data", type=Path, help="folder of the bodies, for several runs to share (OUT/bodies)")
    add("--bodies", type=int, default=64, metavar="N", help="training identities (64)")
    add("--poses", type=int, default=16, metavar="N", help="of each (16)")
    add("--held-out", type=int, default=16, metavar="N", help="test identities (16)")
    add("--faces", type=int, default=2500, help="of the triangulation (2500)")
    add("--sources", type=int, default=0, metavar="N", help="so many poses, not rest, as sources")
    add("--targets", type=int, default=8, metavar="N", help="poses per step (8)")
    add("--steps", type=int, default=1500, help="of the Neural Jacobian Field (1500)")
    add("--code-size", type=int, default=256, help="of PointNet's code (256)")
    add("--points", type=int, default=256, metavar="N", help="that PointNet sees (256)")
    add("--energies", type=int, default=50, metavar="N", help="of the wave-kernel signature (50)")
    add("--models", nargs="+", choices=KINDS, default=list(KINDS), help="which to train (all)")
    add("--full", action="store_true", help=f"the paper's scale: {PAPER}, 200,000 steps")
    add("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    if options.full:
        parser.set_defaults(**PAPER, steps=200_000)
        options = parser.parse_args(argv)
    options.data = options.data or options.out / "bodies"
    return options


def make_bodies(options: argparse.Namespace) -> list[BodyStore]:
    """Training, validation and test bodies: of different seeds, so apart in bodies and poses."""
    sizes = {"train": options.bodies, "validation": options.held_out, "test": options.held_out}
    return [
        build_bodies(
            options.data / name,
            size,
            options.faces,
            BodySettings(seed=3 * options.seed + i, n_poses=options.poses),
        )
        for i, (name, size) in enumerate(sizes.items())
    ]


def inputs(options: argparse.Namespace) -> dict[str, int]:
    """What the networks see."""
    return {"n_points": options.points, "n_energies": options.energies}


def examples_of(
    bodies: BodyStore | list[Body], options: argparse.Namespace, *, training: bool = False
) -> PoseExamples:
    """Maps to learn or to evaluate."""
    n_targets = options.targets if training else options.poses
    return PoseExamples(
        bodies,
        sources=options.sources,
        n_targets=n_targets,
        resample=training,
        **inputs(options),
    )


def make_module(kind: str, steps: int, options: argparse.Namespace) -> NJFTraining:
    lightning.seed_everything(options.seed, verbose=False)
    n_features = 6 + options.energies
    model = {
        "face_features": n_features,
        "point_features": n_features,
        "code_size": options.code_size,
        "parameters": POSE_SIZE,
    }
    return NJFTraining(model, steps=steps, inputs=inputs(options), kind=kind)


def plan(train: BodyStore, options: argparse.Namespace) -> dict[str, int]:
    """Steps of each model that cost as much CPU time; decided once for a folder of results."""
    path = options.out / "steps.json"
    steps = json.loads(path.read_text()) if path.exists() else {}
    if missing := [kind for kind in options.models if kind not in steps]:
        batch = examples_of([train[0]], options, training=True)[0]
        ours = seconds_per_step(make_module("njf", 1, options), batch)
        for kind in missing:
            n = options.steps * ours / seconds_per_step(make_module(kind, 1, options), batch)
            # A multiple of the validations, so that one follows the last step.
            steps[kind] = (
                options.steps if kind == "njf" else N_VALIDATIONS * round(n / N_VALIDATIONS)
            )
        path.write_text(json.dumps(steps))
    return steps


def seconds_per_step(module: NJFTraining, batch: Any) -> float:
    """CPU time of a step, the median of some."""
    optimizer = torch.optim.Adam(module.parameters())
    times = []
    for _ in range(11):
        start = time.process_time()
        optimizer.zero_grad()
        module.training_step(batch, 0).backward()
        optimizer.step()
        times.append(time.process_time() - start)
    return float(np.median(times))


def fit(
    kind: str, steps: int, train: BodyStore, validation: BodyStore, options: argparse.Namespace
) -> Path:
    """Train, going on from the last checkpoint if there is one; the best by validation loss."""
    folder = options.out / kind
    trainer = make_trainer(folder, steps=steps, validate_every=steps // N_VALIDATIONS)
    trainer.fit(
        make_module(kind, steps, options),
        body_loader(examples_of(train, options, training=True), shuffle=True),
        body_loader(examples_of(validation, options)),
        ckpt_path=last_checkpoint(folder),
    )
    return folder / "checkpoints" / "best.ckpt"


def cost(checkpoint: Path) -> dict[str, float | None]:
    """What the training until the last step took."""
    last = torch.load(checkpoint.with_name("last.ckpt"), weights_only=False)
    return {"cpu seconds": last["cpu_seconds"], "seconds": last["training_seconds"]}


def unmoved(options: argparse.Namespace, test: BodyStore) -> list[PoseRecord]:
    """Errors of the identity map, which an untrained model is."""
    model = make_module("njf", 1, options).model
    return evaluate_reposing(model, examples_of(test, options))[0]


def draw(
    path: Path,
    test: BodyStore,
    maps: dict[str, list[torch.Tensor]],
    records: dict[str, list[PoseRecord]],
) -> None:
    """Draw the test maps at three percentiles of the first model's error, chosen by nothing else.

    That is our model, unless it was left out.
    """
    images = {name: torch.cat(of_model) for name, of_model in maps.items()}
    first = next(iter(records.values()))
    order = np.argsort([record.l2_v for record in first])
    rows = []
    for percentile in (10, 50, 90):
        at = int(order[round(percentile / 100 * (len(order) - 1))])
        record = first[at]
        body = test[record.body]
        source = body.rest if record.source is None else body.posed[record.source]
        errors = ", ".join(f"{of_model[at].l2_v:.2f}" for of_model in records.values())
        title = f"body {record.body}, pose {record.pose}: {percentile}th percentile\nL2-V {errors}"
        predictions = {name: of_model[at] for name, of_model in images.items()}
        rows.append(BodyRow(title, body.faces, source, body.posed[record.pose], predictions))
    save_body_report(rows, path)


if __name__ == "__main__":
    main()
