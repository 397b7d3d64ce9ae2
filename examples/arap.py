"""Learn volumetric as-rigid-as-possible deformation from six handles: a field beside a global MLP.

A lizard is generated, filled with tetrahedra and deformed by ARAP to convergence, many times, with
its handles (head, end of the tail, feet, hands) moved at random. A Neural Jacobian Field learns how
its surface deforms; all that it is told are the positions of the handles. "Ours" is a field of few
functions on the surface, pinned to the handles; its coefficients come from a network of the code,
and rounds correct them by what the map strains. The baseline, an MLP that emits the Jacobians of
all faces at once, has the same data and loss, and the same CPU time, as the paper has it and with
pins in training too; so has the paper's field, an MLP of each face and the code. All are evaluated
on positions that were never seen, and timed against the solver.

The default takes about ten minutes on two cores; `--full` is the experiment of docs/elastic.md and
takes most of an hour. Run it again after an interruption, and it goes on with what is not trained
yet. The paper's Raptor is not free: compare ratios with its figures, not errors.

Writes to the folder `--out`: results.png, results.json, the solid, its deformations, training logs
and checkpoints.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import torch

import diffpoisson as dp
from njf_models.body_report import BodyRow, save_body_report
from njf_models.budget import planned_steps
from njf_models.datasets.arap import (
    ArapMaps,
    ArapSettings,
    ArapSolver,
    build_arap,
    draw_offsets,
    load_solid,
    save_solid,
)
from njf_models.datasets.solids import Solid, lizard
from njf_models.elastic_maps import (
    ElasticBatches,
    ElasticRecord,
    elastic_loader,
    evaluate_elastic,
    solid_handles,
    summarise,
)
from njf_models.evaluation import format_table
from njf_models.experiments import circumstances, mean, quiet, spread, training_cost
from njf_models.features import Shape
from njf_models.modal_njf import ModalNJF
from njf_models.modal_training import KnownMaps, modal_in
from njf_models.models import Model
from njf_models.training import (
    NJFTraining,
    finished,
    last_checkpoint,
    load_checkpoint,
    make_trainer,
)

KINDS = {  # and names in tables
    "modal": "ours",
    "global": "global MLP",
    "pinned": "global MLP, trained pinned",
    "field": "the paper's field",
}
PINNED = ("modal", "pinned")  # whose solves meet the handles, in training too
SEEDS = {"train": 0, "validation": 1, "test": 2}
N_VALIDATIONS = 10


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    quiet()

    solid = make_solid(options)
    maps = make_maps(solid, options)
    free = Shape.prepare(dp.Mesh(solid.vertices[solid.surface], solid.faces))
    held = free.with_handles(solid_handles(solid, free.mesh, maps["train"].settings.reach))
    runs: dict[str, list[dict[str, float]]] = {
        "untrained": [summarise(unmoved(maps["test"], free))]
    }
    records, images, costs = {}, {}, {}
    for kind, title in KINDS.items():
        if kind not in options.models:
            continue
        shape = held if kind in PINNED else free
        fits = [fit(kind, seed, maps, shape, options) for seed in options.seeds]
        costs[title] = mean([cost for _, cost in fits])
        for number, (model, _) in enumerate(fits):
            for name, found in evaluations(kind, model, maps["test"], shape).items():
                runs.setdefault(name, []).append(summarise(found[0]))
                if number == 0:
                    records[name], images[name] = found

    table = {name: mean(rows) for name, rows in runs.items()}
    solver = time_solver(solid, maps["test"], options)
    print("\nUnseen positions of the handles:\n" + format_table(table))
    print("\nThe solver:\n" + "\n".join(f"{name}: {value:.4g}" for name, value in solver.items()))
    results = {
        **circumstances(options),
        "training": costs,
        "solver": solver,
        "summary": table,
        "spread": {name: spread(rows) for name, rows in runs.items()},
    }
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    draw(options.out / "results.png", free, maps["test"], images, records)
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return table


def evaluations(
    kind: str, model: Model, test: ArapMaps, shape: Shape
) -> dict[str, tuple[list[ElasticRecord], torch.Tensor]]:
    """Records and maps of a model by the name of its column: as it comes, and pinned afterwards.

    Of ours, besides, those of its first prediction.
    """
    title = KINDS[kind]
    if isinstance(model, ModalNJF):
        first = model.with_rounds(1)
        return {
            title: evaluate_elastic(model.on(shape), test, shape),
            f"{title}, one round": evaluate_elastic(first.on(shape), test, shape),
        }
    found = {title: evaluate_elastic(model, test, shape)}
    if kind not in PINNED:
        found[f"{title}, pinned"] = evaluate_elastic(model, test, shape, pinned=True)
    return found


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/arap"), help="folder for results (runs/arap)")
    add("--data", type=Path, help="folder of the maps, for several runs to share (OUT/data)")
    add("--edge", type=float, default=0.035, help="length of edges over the size (0.035)")
    add("--maps", type=int, default=1000, metavar="N", help="to learn from (1000)")
    add("--held-out", type=int, default=100, metavar="N", help="to validate, and to test (100)")
    add("--minutes", type=float, default=2, help="of CPU time for each model (2)")
    add("--rank", type=int, default=96, help="functions of our field (96)")
    add("--rounds", type=int, default=5, help="predictions of our field (5)")
    add("--global-width", type=int, default=512, help="of the global MLP's (512)")
    add("--timed", type=int, default=3, metavar="N", help="test maps to time the solver on (3)")
    add("--models", nargs="+", choices=KINDS, default=["modal", "global"], help="to train")
    add("--full", action="store_true", help="2500 maps, 200 held out, all models, three seeds")
    add("--seeds", type=int, nargs="+", default=[0], help="of weights and batches (0)")
    options = parser.parse_args(argv)
    if options.full:
        parser.set_defaults(maps=2500, held_out=200, models=list(KINDS), seeds=[0, 1, 2])
        options = parser.parse_args(argv)
    options.data = options.data or options.out / "data"
    return options


def make_solid(options: argparse.Namespace) -> Solid:
    """The lizard; the same one in all runs that share their data."""
    path = options.data / "solid.safetensors"
    if not path.exists():
        save_solid(path, lizard(options.edge))
    return load_solid(path)


def make_maps(solid: Solid, options: argparse.Namespace) -> dict[str, ArapMaps]:
    """Training, validation and test maps: of different seeds, so apart in handle positions."""
    return {
        name: build_arap(
            options.data / name,
            options.maps if name == "train" else options.held_out,
            solid,
            ArapSettings(seed=seed),
        )
        for name, seed in SEEDS.items()
    }


def batches(kind: str, maps: ArapMaps, shape: Shape) -> ElasticBatches:
    """What a model learns from; the global one can't make use of a few faces alone."""
    if kind == "field":
        return ElasticBatches(maps, shape, sampled=64, shuffle=True)
    return ElasticBatches(maps, shape, n_targets=32, shuffle=True)


def make_module(kind: str, steps: int, shape: Shape, seed: int, width: int) -> NJFTraining:
    lightning.seed_everything(seed, verbose=False)
    if kind == "field":
        model = {"parameters": 18, "face_features": 6, "point_features": 0}
        return NJFTraining(model, steps=steps)
    model = {"parameters": 18, "n_faces": shape.mesh.n_faces, "width": width}
    return NJFTraining(model, steps=steps, kind="global")


def fit(
    kind: str, seed: int, maps: dict[str, ArapMaps], shape: Shape, options: argparse.Namespace
) -> tuple[Model, dict[str, float]]:
    """Train for the wanted CPU time, or load what is trained: the model, and its cost."""
    folder = options.out / f"{kind}-{seed}"
    if kind == "modal":
        known = {name: KnownMaps(x.parameters, x.positions) for name, x in maps.items()}
        model, cost = modal_in(
            folder,
            {"parameters": 18, "amounts": 18, "relative": True, "rank": options.rank},
            shape,
            known["train"],
            known["validation"],
            minutes=options.minutes,
            seed=seed,
        )
        return model.with_rounds(options.rounds), cost  # training is the same for all
    data, path = batches(kind, maps["train"], shape), options.out / f"{kind}-steps.json"
    turns = [data[i] for i in range(data.period)]
    module = make_module(kind, 1, shape, seed, options.global_width)
    steps = planned_steps(path, module, turns, options.minutes, N_VALIDATIONS)
    if not finished(folder, steps):
        make_trainer(folder, steps=steps, validate_every=steps // N_VALIDATIONS).fit(
            make_module(kind, steps, shape, seed, options.global_width),
            elastic_loader(data),
            elastic_loader(ElasticBatches(maps["validation"], shape, n_targets=20)),
            ckpt_path=last_checkpoint(folder),
        )
    best = folder / "checkpoints" / "best.ckpt"
    return load_checkpoint(best), {"steps": float(steps), **training_cost(best)}


def unmoved(test: ArapMaps, shape: Shape) -> list[ElasticRecord]:
    """Errors of the identity map, which an untrained model is."""
    return evaluate_elastic(make_module("field", 1, shape, 0, 0).model, test, shape)[0]


def time_solver(solid: Solid, test: ArapMaps, options: argparse.Namespace) -> dict[str, float]:
    """How libigl's ARAP converged on the test maps, and what some of them take again.

    Without acceleration, as it comes, and with it, as the data was made; both to the tolerance of
    the data.
    """
    result = {
        "tetrahedra": len(solid.tetrahedra),
        "largest residual": float(test.residuals.max()),
        "iterations, mean": float(test.iterations.float().mean()),
        "flipped tetrahedra, mean": float(test.flips.float().mean()),
        "flipped tetrahedra, most": float(test.flips.max()),
    }
    for name, memory in (("as it comes", 0), ("accelerated", 6)):
        solver = ArapSolver(solid, memory=memory, tolerance=test.settings.tolerance)
        seconds, iterations = [], []
        for number in range(min(options.timed, len(test))):
            start = time.process_time()
            iterations.append(
                solver(draw_offsets(test.settings, number, solid.n_handles)).iterations
            )
            seconds.append(time.process_time() - start)
        result[f"iterations {name}, mean"] = float(np.mean(iterations))
        result[f"CPU seconds {name}, median"] = float(np.median(seconds))
    return result


def draw(
    path: Path,
    shape: Shape,
    test: ArapMaps,
    images: dict[str, torch.Tensor],
    records: dict[str, list[ElasticRecord]],
) -> None:
    """Draw the test maps at three percentiles of the first model's error, chosen by nothing else.

    That is our model, unless it was left out.
    """
    first = next(iter(records.values()))
    order = np.argsort([record.l2_v for record in first])
    rows = []
    for percentile in (10, 50, 90):
        at = int(order[round(percentile / 100 * (len(order) - 1))])
        errors = ", ".join(f"{of_model[at].l2_v:.2f}" for of_model in records.values())
        title = f"test map {at}: {percentile}th percentile\nL2-V {errors}"
        predictions: dict[str, Any] = {
            name.replace(", ", ",\n"): of_model[at] for name, of_model in images.items()
        }
        mesh = shape.mesh
        rows.append(BodyRow(title, mesh.faces, mesh.vertices, test.positions[at], predictions))
    save_body_report(rows, path, limit=0.05)


if __name__ == "__main__":
    main()
