"""Maps between human bodies: a Neural Jacobian Field beside baselines, on five tasks.

`--task repose`: from the rest pose to pose parameters; `unpose`: from any pose to rest; `any-pose`:
from any pose to pose parameters; `registration`: a body with pieces cut away onto points of the
same body in another pose; `morphing`: a body in any pose onto points of another body in any pose.
`--pose RUN` tells networks the pose that `examples/body_pose.py` reads off a source that is taken
to rest, or off the target of morphing. With `--after RUN ...` the maps are a chain: they start from
where the networks of other folders, trained to unpose, take the bodies. With `--also N ...` sampled
steps see the bodies on triangulations of so many faces, too.

Random bodies → poses inside joint limits → training → evaluation on bodies and poses that were
never seen. Training has two phases, one optimizer and one schedule: first on random faces of
several bodies a step, by the Jacobian loss alone, which needs no solve; then on one whole body a
step, by the paper's loss on Jacobians and solved map. The displacement field, a baseline, is
trained on random vertices first; Neural Cages on whole bodies throughout, for their cages are
small. All have the same data, code and CPU time.

The default takes about fifteen minutes of CPU time, and a minute or two more when the body model
is built for the first time; `--full` has the paper's code and points, and takes days on a CPU. Run
it again after an interruption, and it goes on where it stopped. The paper's bodies, STAR, are
licensed and can't be had here: compare ratios with its figures, not errors.

Writes to the folder `--out`: results.png, results.json, maps.json (the errors of each test map),
the bodies, training logs and checkpoints.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import lightning
import numpy as np
import torch
from torch.utils.data import DataLoader

from njf_models.baselines.cages import CageDeformation
from njf_models.body_maps import (
    TASKS,
    BodyMaps,
    CellSampler,
    MapRecord,
    MixedSampler,
    body_loader,
    cell_loader,
    evaluate_maps,
)
from njf_models.body_report import BodyRow, save_body_report
from njf_models.carried import carry
from njf_models.chain import ChainedNJF
from njf_models.datasets.bodies import (
    POSE_SIZE,
    Body,
    BodySettings,
    BodyStore,
    build_bodies,
    build_retriangulated,
)
from njf_models.datasets.poses import JOINTS
from njf_models.evaluation import format_table
from njf_models.experiments import circumstances, quiet, training_cost
from njf_models.map_errors import summarise
from njf_models.models import MODELS
from njf_models.pose_training import PoseTraining
from njf_models.training import (
    NJFTraining,
    Phase,
    fit_phases,
    last_checkpoint,
    load_checkpoint,
)

KINDS = {  # and names in tables
    "njf": "ours",
    "displacement": "displacement",
    "cages": "cages",
    "displacement-parts": "displacement, our field",
}
PAPER = {"bodies": 2000, "poses": 32, "code_size": 1000, "points": 1024, "targets": 32}
CODE_SCALE = 0.1  # of encoders: without it, a network is slow to see that bodies differ in pose


class Recipe(NamedTuple):
    """How a model is trained, if the command line does not say otherwise.

    Attributes:
        per_step: bodies per sampled step.
        targets: of each per step.
        cells: sampled of each.
        learning_rate: at its height.
        arguments: of the model.
    """

    per_step: int
    targets: int
    cells: int
    learning_rate: float
    arguments: dict[str, int]


IN_PARTS = Recipe(16, 8, 192, 3e-3, {"parts": 128, "octaves": 5})
OF_EACH_FACE = Recipe(8, 8, 100, 2e-3, {})
ONE_TARGET = Recipe(32, 1, 128, 3e-3, {"parts": 128, "octaves": 4})
EARLIER = "earlier, cpu seconds"
WARMUP = 300  # steps; begun at the full rate, a field of parts may stay near the identity


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    quiet()

    train, validation, test = make_bodies(options)
    if options.after:
        train, validation = (
            carried(bodies, options, name)
            for bodies, name in ((train, "train"), (validation, "validation"))
        )
    steps = plan(train, options)
    records, maps, costs = {}, {}, {}
    for kind in options.models:
        title = KINDS[kind]
        checkpoint = fit(kind, steps[kind], train, validation, options)
        costs[title] = {
            "steps": steps[kind],
            "recipe": recipe(kind, options)._asdict(),
            **cost(checkpoint),
            **earlier(title, options),
        }
        network = load_checkpoint(checkpoint)
        if options.after:
            network = ChainedNJF.of([*earlier_networks(options), network], options.points)
        records[title], maps[title] = evaluate_maps(network, maps_of(test, options))

    table = {"untrained": summarise(unmoved(options, test))}
    table |= {title: summarise(of_model) for title, of_model in records.items()}
    print("\nUnseen bodies and poses:\n" + format_table(table))
    results = {
        **circumstances(options),
        "training": costs,
        "summary": table,
    }
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    every = {title: [asdict(record) for record in of_model] for title, of_model in records.items()}
    (options.out / "maps.json").write_text(json.dumps(every))
    draw(options.out / "results.png", maps_of(test, options), maps, records)
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--task", choices=TASKS, default="repose", help="which maps (repose)")
    add("--out", type=Path, help="folder for results (runs/TASK)")
    add("--data", type=Path, help="folder of the bodies, for several runs to share (OUT/bodies)")
    add("--bodies", type=int, default=64, metavar="N", help="training identities (64)")
    add("--poses", type=int, default=16, metavar="N", help="of each (16)")
    add("--held-out", type=int, default=16, metavar="N", help="test identities (16)")
    add("--faces", type=int, default=2500, help="of the triangulation (2500)")
    add("--also", type=int, nargs="+", default=[], metavar="N", help="other triangulations' faces")
    add("--sources", type=int, metavar="N", help="poses of a body that are sources (the task's)")
    add("--targets", type=int, metavar="N", help="of a source per step (the model's)")
    add("--steps", type=int, default=3000, help="of the Neural Jacobian Field (3000)")
    add(
        "--whole", type=float, default=0.13, metavar="X", help="share of whole bodies' steps (0.13)"
    )
    add("--per-step", type=int, metavar="N", help="bodies per sampled step (the model's)")
    add("--cells", type=int, metavar="N", help="sampled of each (the model's)")
    add("--code-size", type=int, default=128, help="of a code (128)")
    add(
        "--basis", type=int, metavar="N", help="points to see shapes from; 0: PointNet (256; RUN's)"
    )
    add("--basis-at", choices=("box", "body"), default="box", help="where these are (box)")
    add("--points", type=int, default=256, metavar="N", help="that PointNet sees (256)")
    add("--pose", type=Path, metavar="RUN", help="of body_pose.py: read poses off shapes")
    add("--energies", type=int, default=0, metavar="N", help="of the wave-kernel signature (0)")
    add("--models", nargs="+", choices=KINDS, help="which to train (ours, displacement, cages)")
    add("--validations", type=int, default=10, metavar="N", help="in a training (10)")
    add("--after", type=Path, nargs="+", default=[], metavar="RUN", help="start where these lead")
    add("--carried", type=int, default=8, metavar="N", help="of a body's poses, for that (8)")
    add("--init", type=Path, metavar="RUN", help="begin with the networks of another folder")
    add("--full", action="store_true", help=f"the paper's scale: {PAPER}, 200,000 steps")
    add("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    if options.full:
        parser.set_defaults(**PAPER, steps=200_000)
        options = parser.parse_args(argv)
    options.out = options.out or Path("runs") / options.task
    options.carried = min(options.carried, options.poses)
    if options.pose is not None:
        if options.basis_at != "box":
            parser.error("--pose reads poses off what points of the box see, not --basis-at body")
        options.basis = pose_training(options).hparams["estimator"]["basis"]
    elif options.basis is None:
        options.basis = 0 if TASKS[options.task].pieces else 256
    if options.also and options.after:
        parser.error("--also is for maps from bodies as they are, not --after others")
    options.models = options.models or ["njf", "displacement", "cages"]
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


def inputs(options: argparse.Namespace) -> dict[str, Any]:
    """What the networks see."""
    return {
        "n_points": options.points,
        "n_energies": options.energies,
        "n_basis": options.basis,
        "basis_at": options.basis_at,
    }


def maps_of(
    bodies: BodyStore | list[Body],
    options: argparse.Namespace,
    *,
    kind: str = "njf",
    training: bool = False,
) -> BodyMaps:
    """Maps to learn or to evaluate."""
    task = TASKS[options.task]
    if options.sources is not None:
        task = replace(task, sources=options.sources)
    if training and task.sources:
        n_sources = options.carried if options.after else options.poses  # all that there are
        task = replace(task, sources=n_sources)
    n_targets = recipe(kind, options).targets if training else options.poses
    return BodyMaps(bodies, task, n_targets=n_targets, resample=training, **inputs(options))


def recipe(kind: str, options: argparse.Namespace) -> Recipe:
    """How a model is trained on a task, with what the command line says."""
    if TASKS[options.task].told == "nothing":
        chosen = ONE_TARGET
    else:
        chosen = IN_PARTS if kind in ("njf", "displacement-parts") else OF_EACH_FACE
    said = {name: getattr(options, name) for name in ("per_step", "targets", "cells")}
    return chosen._replace(**{name: n for name, n in said.items() if n is not None})


def make_module(kind: str, steps: int, options: argparse.Namespace) -> NJFTraining:
    lightning.seed_everything(options.seed, verbose=False)
    n_features, how = 6 + options.energies, recipe(kind, options)
    model: dict[str, Any] = {
        "face_features": n_features,
        "point_features": n_features,
        "code_size": options.code_size,
        "basis": options.basis,
        "basis_at": options.basis_at,
        "code_scale": CODE_SCALE,
        **how.arguments,
    }
    told = TASKS[options.task].told
    if told == "pose":
        model |= {"parameters": POSE_SIZE, "rotations": True}
    elif told == "points":
        model["encodes_target"] = True
    if options.pose is not None:
        model["joints"] = len(JOINTS)
    module = NJFTraining(
        model,
        learning_rate=how.learning_rate,
        steps=steps,
        warmup=WARMUP,
        inputs=inputs(options),
        kind=kind.removesuffix("-parts"),
    )
    if options.pose is not None:
        estimator = pose_training(options).estimator
        module.model.estimator.load_state_dict(estimator.state_dict())
    return module


def pose_training(options: argparse.Namespace) -> PoseTraining:
    """Of the folder of `--pose`."""
    return PoseTraining.load_from_checkpoint(options.pose / "checkpoints" / "best.ckpt")


def loaders(
    kind: str, train: BodyStore | list[Body], options: argparse.Namespace
) -> dict[str, DataLoader[Any]]:
    """What each phase of a training sees."""
    maps, how = maps_of(train, options, kind=kind, training=True), recipe(kind, options)
    phases: dict[str, DataLoader[Any]] = {}
    samples = MODELS[kind.removesuffix("-parts")].samples
    if samples is not None:
        others = [
            maps_of(x, options, kind=kind, training=True) for x in elsewhere(len(train), options)
        ]
        samplers = [CellSampler(x, samples, how.cells) for x in (maps, *others)]
        phases["sampled"] = cell_loader(MixedSampler(samplers), how.per_step)
    if samples is None or options.whole > 0:
        phases["whole"] = body_loader(maps, shuffle=True)
    return phases


def elsewhere(n: int, options: argparse.Namespace) -> list[BodyStore]:
    """The first training bodies on the triangulations of `--also`, which are finer at the feet."""
    train = BodyStore(options.data / "train", n)
    return [
        build_retriangulated(options.data / f"train-{n_faces}", train, n_faces, grading=-1.0)
        for n_faces in options.also
    ]


def carried(bodies: BodyStore, options: argparse.Namespace, name: str) -> list[Body]:
    """Bodies and where the networks of `--after` take them."""
    maps = maps_of(bodies, options, training=name == "train")
    return carry(
        bodies,
        earlier_networks(options),
        options.out / "carried" / name,
        n_sources=maps.task.sources,
        n_points=options.points,
    )


def earlier_networks(options: argparse.Namespace) -> list[Any]:
    """The networks of `--after`, which end where this one's maps start."""
    return [load_checkpoint(run / "njf" / "checkpoints" / "best.ckpt") for run in options.after]


def plan(train: BodyStore, options: argparse.Namespace) -> dict[str, dict[str, int]]:
    """Steps of each phase of each model, at equal CPU time; decided once for a folder of results.

    The time of a phase that a model does without is added to the other.
    """
    path = options.out / "steps.json"
    steps: dict[str, dict[str, int]] = json.loads(path.read_text()) if path.exists() else {}
    if missing := [kind for kind in options.models if kind not in steps]:
        shares = {"sampled": 1 - options.whole, "whole": options.whole}
        ours = seconds_per_step("njf", train, options)
        seconds = {phase: options.steps * shares[phase] * ours[phase] for phase in ours}
        for kind in missing:
            each = ours if kind == "njf" else seconds_per_step(kind, train, options)
            left = sum(seconds[phase] for phase in seconds if phase not in each)
            n = {phase: round(seconds[phase] / second) for phase, second in each.items()}
            last = list(n)[-1]
            n[last] += round(left / each[last])
            n[last] += -sum(n.values()) % options.validations  # so that one follows the last step
            steps[kind] = n
        path.write_text(json.dumps(steps))
    return steps


def seconds_per_step(kind: str, train: BodyStore, options: argparse.Namespace) -> dict[str, float]:
    """CPU time of a step of each phase, the median of some; without what is made once for a body.

    That is its factor, and its cage if the model has cages.
    """
    module = make_module(kind, 1, options)
    optimizer = torch.optim.Adam(module.parameters())
    few = [train[i] for i in range(min(len(train), recipe(kind, options).per_step))]
    seconds = {}
    for phase, loader in loaders(kind, few, options).items():
        for batch in islice(loader, len(few)):
            module.training_step(batch, 0)
        times = []
        batches: Iterator[Any] = repeated(loader)
        for _ in range(11):
            start = time.process_time()
            optimizer.zero_grad()
            module.training_step(next(batches), 0).backward()
            optimizer.step()
            times.append(time.process_time() - start)
        seconds[phase] = float(np.median(times))
    return seconds


def repeated(loader: DataLoader[Any]) -> Iterator[Any]:
    """Batches of one pass after another, each drawn anew."""
    while True:
        yield from loader


def fit(
    kind: str,
    steps: dict[str, int],
    train: BodyStore,
    validation: BodyStore,
    options: argparse.Namespace,
) -> Path:
    """Train, going on from the last checkpoint if there is one; the best by validation loss."""
    module = make_module(kind, sum(steps.values()), options)
    if options.init is not None:
        other = load_checkpoint(options.init / kind / "checkpoints" / "best.ckpt")
        module.model.load_state_dict(other.state_dict())
    ends = dict(zip(steps, np.cumsum(list(steps.values())).tolist(), strict=True))
    total = max(ends.values())
    data = loaders(kind, train, options)
    if isinstance(module.model, CageDeformation) and steps_done(options.out / kind) < total:
        make_cages(module.model, data["whole"].dataset, options.out / kind / "cages.json")
    fit_phases(
        module,
        options.out / kind,
        [Phase(batches, ends[phase]) for phase, batches in data.items()],
        body_loader(maps_of(validation, options)),
        validate_every=total // options.validations,
    )
    return options.out / kind / "checkpoints" / "best.ckpt"


def steps_done(folder: Path) -> int:
    """Of a training, until now."""
    checkpoint = last_checkpoint(folder)
    return torch.load(checkpoint, weights_only=False)["global_step"] if checkpoint else 0


def make_cages(model: CageDeformation, maps: Any, path: Path) -> None:
    """The cages of all sources, ahead of the training; and a file with the CPU time of that."""
    start = time.process_time()
    for index in range(len(maps)):
        model.prepare(maps.source(index).shape)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"cages, cpu seconds": time.process_time() - start}))


def cost(checkpoint: Path) -> dict[str, float | None]:
    """What the training took, and the cages before it."""
    cages = checkpoint.parents[1] / "cages.json"
    before = json.loads(cages.read_text()) if cages.exists() else {}
    return training_cost(checkpoint) | before


def earlier(title: str, options: argparse.Namespace) -> dict[str, Any]:
    """The runs this one comes after; CPU time of all trainings before it, where on record."""
    seconds, counted = 0.0, set()
    for run in [options.init, *options.after]:
        if run is not None and (run / "results.json").exists() and run.name not in counted:
            before = json.loads((run / "results.json").read_text())["training"][title]
            seconds += before["cpu seconds"]
            if run == options.init:
                seconds += before.get(EARLIER, 0.0)
                counted = set(before.get("after", ()))
    about: dict[str, Any] = {"after": [run.name for run in options.after]} if options.after else {}
    return about | ({EARLIER: seconds} if seconds else {})


def unmoved(options: argparse.Namespace, test: BodyStore) -> list[MapRecord]:
    """Errors of the identity map, which an untrained model is."""
    model = make_module("njf", 1, options).model
    return evaluate_maps(model, maps_of(test, options))[0]


def draw(
    path: Path,
    examples: BodyMaps,
    maps: dict[str, list[torch.Tensor]],
    records: dict[str, list[MapRecord]],
) -> None:
    """Draw the test maps at three percentiles of the first model's error, chosen by nothing else.

    That is our model, unless it was left out.
    """
    images = {
        name: [phi for source in of_model for phi in source] for name, of_model in maps.items()
    }
    first = next(iter(records.values()))
    places = [(i, k) for i in range(len(examples)) for k in range(len(examples.targets(i)))]
    order = np.argsort([record.l2_v for record in first])
    rows = []
    for percentile in (10, 50, 90):
        at = int(order[round(percentile / 100 * (len(order) - 1))])
        (index, k), record = places[at], first[at]
        source, target = examples.source(index), examples[index].target[k]
        errors = ", ".join(f"{of_model[at].l2_v:.2f}" for of_model in records.values())
        other = f" of body {record.target}" if record.target != record.body else ""
        title = (
            f"body {record.body}, pose {record.pose}{other}: {percentile}th percentile\n"
            f"L2-V {errors}"
        )
        predictions = {name: of_model[at] for name, of_model in images.items()}
        mesh = source.mesh
        rows.append(BodyRow(title, mesh.faces, mesh.vertices.float(), target, predictions))
    save_body_report(rows, path)


if __name__ == "__main__":
    main()
