"""Learn how a block gives way to an obstacle: a Jacobian field beside an offset of each vertex.

An elastic block in the plane is held at both ends and a rigid star is pushed into it; incremental
potential contact finds the equilibria, none of which intersects. The networks are told where the
ends and the star are. The baseline, in the spirit of the corrections of Romero et al. 2021, offsets
each vertex; it has the same features, data and loss, and the same CPU time. On trajectories that
were never seen, their maps are compared, the share of them that intersect is counted, and
contact-aware steps, each a Poisson solve with what intersects pinned to where it does not, are
taken until none does.

The default takes about ten minutes on two cores. Run it again after an interruption, and it goes on
where it stopped. Writes to the folder `--out`: results.png, results.json, the states, training logs
and checkpoints.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import lightning
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from njf_models.budget import planned_steps
from njf_models.contact_maps import (
    ContactRecord,
    block_handles,
    block_shape,
    evaluate_contact,
    summarise,
)
from njf_models.datasets.contact import ContactMaps, ContactSettings, build_contact
from njf_models.elastic_maps import ElasticBatches, elastic_loader
from njf_models.evaluation import format_table
from njf_models.experiments import circumstances, mean, quiet, spread, training_cost
from njf_models.features import Shape
from njf_models.modal_training import KnownMaps, modal_in
from njf_models.models import Model
from njf_models.training import (
    NJFTraining,
    finished,
    last_checkpoint,
    load_checkpoint,
    make_trainer,
)

KINDS = {"modal": "ours", "displacement": "offsets"}  # and names in tables
SEEDS = {"train": 0, "validation": 1, "test": 2}
N_VALIDATIONS = 10
ERROR_LIMIT = 0.1  # where the colours of the error end; the block is 1 high


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    quiet()

    maps = make_maps(options)
    test = maps["test"]
    free = block_shape(test.scene)
    held = free.with_handles(block_handles(test.scene, free.mesh, test.settings.shift))
    untrained = evaluate_contact(make_module(1, 0).model, test, free)[0]
    runs = {"untrained": [summarise(untrained)]}
    records, costs = {}, {}
    images: dict[str, torch.Tensor] = {}
    for kind, title in KINDS.items():
        shape = held if kind == "modal" else free
        fits = [fit(kind, seed, maps, shape, options) for seed in options.seeds]
        costs[title] = mean([cost for _, cost in fits])
        for number, (model, _) in enumerate(fits):
            found, before, after = evaluate_contact(model, test, shape)
            runs.setdefault(title, []).append(summarise(found))
            if number == 0:
                records[title] = found
                images |= {title: before, f"{title}, corrected": after}

    table = {name: mean(rows) for name, rows in runs.items()}
    print("\nUnseen trajectories:\n" + format_table(table))
    results = {
        **circumstances(options),
        "training": costs,
        "Newton steps of a state, mean": float(test.iterations.float().mean()),
        "summary": table,
        "spread": {name: spread(rows) for name, rows in runs.items()},
    }
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    draw(options.out / "results.png", test, images, records["ours"])
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/contact"), help="folder for results (runs/contact)")
    add("--data", type=Path, help="folder of the states, for several runs to share (OUT/data)")
    add("--columns", type=int, default=36, help="of squares of the block (36)")
    add("--trajectories", type=int, default=300, metavar="N", help="to learn from (300)")
    add("--held-out", type=int, default=50, metavar="N", help="to validate, and to test (50)")
    add("--minutes", type=float, default=2.5, help="of CPU time for each model (2.5)")
    add("--rank", type=int, default=96, help="functions of our field (96)")
    add("--rounds", type=int, default=1, help="predictions of our field (1)")
    add("--seeds", type=int, nargs="+", default=[0], help="of weights and batches (0)")
    options = parser.parse_args(argv)
    options.data = options.data or options.out / "data"
    return options


def make_maps(options: argparse.Namespace) -> dict[str, ContactMaps]:
    """Training, validation and test states: of different seeds, so of different trajectories."""
    return {
        name: build_contact(
            options.data / name,
            options.trajectories if name == "train" else options.held_out,
            ContactSettings(seed=seed, columns=options.columns),
        )
        for name, seed in SEEDS.items()
    }


def make_module(steps: int, seed: int) -> NJFTraining:
    lightning.seed_everything(seed, verbose=False)
    model = {"face_features": 6, "point_features": 0, "parameters": 10, "output_dim": 2}
    return NJFTraining(model, steps=steps, kind="displacement")


def fit(
    kind: str, seed: int, maps: dict[str, ContactMaps], shape: Shape, options: argparse.Namespace
) -> tuple[Model, dict[str, float]]:
    """Train for the wanted CPU time, or load what is trained: the model, and its cost.

    Offsets take as many steps as that time has room for, a multiple of the validations, and are the
    best of those. Their loss on Jacobians needs all neighbours of a vertex.
    """
    folder = options.out / f"{kind}-{seed}"
    if kind == "modal":
        known = {name: KnownMaps(x.parameters, x.positions) for name, x in maps.items()}
        sizes = {"rank": options.rank, "rounds": options.rounds, "output_dim": 2}
        return modal_in(
            folder,
            {"parameters": 10, "amounts": 8, **sizes},
            shape,
            known["train"],
            known["validation"],
            minutes=options.minutes,
            seed=seed,
        )
    data = ElasticBatches(maps["train"], shape, n_targets=16, shuffle=True)
    path = options.out / f"{kind}-steps.json"
    steps = planned_steps(path, make_module(1, seed), [data[0]], options.minutes, N_VALIDATIONS)
    if not finished(folder, steps):
        make_trainer(folder, steps=steps, validate_every=steps // N_VALIDATIONS).fit(
            make_module(steps, seed),
            elastic_loader(data),
            elastic_loader(ElasticBatches(maps["validation"], shape, n_targets=50)),
            ckpt_path=last_checkpoint(folder),
        )
    best = folder / "checkpoints" / "best.ckpt"
    return load_checkpoint(best), {"steps": float(steps), **training_cost(best)}


def draw(
    path: Path, test: ContactMaps, images: dict[str, torch.Tensor], ours: list[ContactRecord]
) -> None:
    """Draw the test maps at three percentiles of our error, chosen by nothing else."""
    order = np.argsort([record.l2_v for record in ours])
    columns = {"target": test.positions, **images}
    figure = Figure(figsize=(2.8 * len(columns), 4.8))
    axes = figure.subplots(3, len(columns), squeeze=False)
    for percentile, line in zip((10, 50, 90), axes, strict=True):
        at = int(order[round(percentile / 100 * (len(order) - 1))])
        star = test.scene.placed_obstacle(test.obstacles[at].double().numpy())
        for (title, maps), ax in zip(columns.items(), line, strict=True):
            panel(ax, test, maps[at].double().numpy(), test.positions[at].double().numpy(), star)
            ax.set_title(title if percentile == 10 else "", fontsize=9)
        line[0].set_title(f"{line[0].get_title()}\n{percentile}th percentile", fontsize=8)
    scale = ScalarMappable(Normalize(0, ERROR_LIMIT), "viridis")
    figure.colorbar(scale, ax=axes, shrink=0.5, label="distance from the target")
    figure.savefig(path, dpi=110, bbox_inches="tight")


def panel(
    ax: Axes, test: ContactMaps, phi: np.ndarray, target: np.ndarray, star: np.ndarray
) -> None:
    """One map, coloured by its distance from the target, and the star."""
    error = np.linalg.norm(phi - target, axis=1)
    block = Triangulation(phi[:, 0], phi[:, 1], test.scene.faces)
    ax.tripcolor(block, error, shading="gouraud", vmin=0, vmax=ERROR_LIMIT)
    for edge in (phi[test.scene.boundary], np.stack([star, np.roll(star, -1, axis=0)], axis=1)):
        ax.plot(*edge.transpose(2, 1, 0), color="k", lw=0.6)
    ax.set(aspect="equal", xlim=(-2.1, 2.1), ylim=(-1.2, 1.2))
    ax.set_axis_off()


if __name__ == "__main__":
    main()
