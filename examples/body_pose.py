"""Learn to read the pose of a body off its shape: the rotations of twenty joints.

What `examples/body_maps.py --pose RUN` tells its networks of bodies that nobody gives the pose of.
Random bodies in random poses are seen from fixed points in space, and a network of a few layers
learns the rotations; no mesh and no map is needed for that, so that a step sees many bodies.

The default takes about fifteen minutes of CPU time, most of them to draw the bodies. Run it again
after an interruption, and it goes on where it stopped. Writes to the folder `--out`: results.png
and results.json (errors of unseen bodies, by joint), the pairs, training logs and checkpoints.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import lightning
import numpy as np
from matplotlib.figure import Figure

from njf_models.datasets.poses import JOINTS
from njf_models.datasets.seen_poses import SeenPoses, build_seen_poses
from njf_models.experiments import circumstances, quiet, training_cost
from njf_models.pose_training import PoseTraining, joint_errors, pose_loader
from njf_models.training import last_checkpoint, make_trainer

SEEDS = {"train": 10, "validation": 11, "test": 12}  # apart from those of maps of the same --seed
N_VALIDATIONS = 10


def main(argv: list[str] | None = None) -> dict[str, float]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    quiet()

    seen = make_pairs(options)
    checkpoint = fit(seen, options)
    module = PoseTraining.load_from_checkpoint(checkpoint, map_location="cpu").eval()
    errors = joint_errors(module.estimator, seen["test"])
    results = {
        **circumstances(options),
        "bodies": {name: len(pairs.poses) for name, pairs in seen.items()},
        "training": training_cost(checkpoint),
        "degrees": {
            "mean": float(errors.mean()),
            "median": float(errors.median()),
            "joints": dict(zip(JOINTS, errors.mean(0).tolist(), strict=True)),
        },
    }
    (options.out / "results.json").write_text(json.dumps(results, indent=1))
    draw(options.out / "results.png", errors.numpy())
    degrees: dict[str, float] = {name: results["degrees"][name] for name in ("mean", "median")}
    print(f"\nUnseen bodies, degrees: {degrees}")
    print(f"\n{options.out / 'results.png'}  {options.out / 'results.json'}")
    return degrees


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/pose"), help="folder for results (runs/pose)")
    add("--data", type=Path, help="folder of the pairs, for several runs to share (OUT/seen)")
    add("--files", type=int, default=60, metavar="N", help="of a thousand bodies (60)")
    add("--faces", type=int, default=2500, help="of the triangulation (2500)")
    add("--basis", type=int, default=256, metavar="N", help="points to see shapes from (256)")
    add("--steps", type=int, default=10000, help="of the training (10000)")
    add("--per-step", type=int, default=128, metavar="N", help="bodies (128)")
    add("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    options.data = options.data or options.out / "seen"
    return options


def make_pairs(options: argparse.Namespace) -> dict[str, SeenPoses]:
    """For training, validation and test: of different seeds, so apart in bodies and poses."""
    sizes = {"train": options.files, "validation": 1, "test": 1}
    return {
        name: build_seen_poses(
            options.data / name,
            size,
            n_basis=options.basis,
            n_faces=options.faces,
            seed=SEEDS[name] + 3 * options.seed,
        )
        for name, size in sizes.items()
    }


def fit(seen: dict[str, SeenPoses], options: argparse.Namespace) -> Path:
    """Train, going on from the last checkpoint if there is one; the best by validation loss."""
    lightning.seed_everything(options.seed, verbose=False)
    module = PoseTraining({"basis": options.basis}, steps=options.steps)
    trainer = make_trainer(
        options.out, steps=options.steps, validate_every=options.steps // N_VALIDATIONS
    )
    trainer.fit(
        module,
        pose_loader(seen["train"], options.per_step, shuffle=True),
        pose_loader(seen["validation"], 500),
        ckpt_path=last_checkpoint(options.out),
    )
    return options.out / "checkpoints" / "best.ckpt"


def draw(path: Path, errors: np.ndarray) -> None:
    """Half of the bodies, and nine tenths, by joint."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.add_subplot()
    places = np.arange(len(JOINTS))
    for percentile, colour in ((90, "#c6dbef"), (50, "#2171b5")):
        values = np.percentile(errors, percentile, axis=0)
        axes.barh(places, values, color=colour, label=f"{percentile}% of the bodies")
    axes.set_yticks(places, JOINTS)
    axes.invert_yaxis()
    axes.set_xlabel("angle between estimated and true rotation at most, in degrees")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
