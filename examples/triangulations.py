"""Does the map depend on how the surface is cut into triangles? Bodies re-posed on several meshes.

Takes the networks that `examples/body_maps.py` has trained, on one coarse triangulation, and
re-poses the test bodies on others: the original, decimated and subdivided ones, and one that is
fine at the head and coarse at the feet. Corresponding points are known exactly, so the maps can be
compared.

The default takes a few minutes on two cores; `--full` takes all test bodies and poses. Writes
triangulations.json to the folder of the run.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, replace
from pathlib import Path

import torch

from njf_models.agnosticism import Deviation, compare_triangulations
from njf_models.datasets.bodies import Body, BodyModel, BodyStore
from njf_models.datasets.triangulation import Triangulation
from njf_models.trained import Inputs
from njf_models.training import NJFTraining

KINDS = {"njf": "ours", "displacement": "displacement", "cages": "cages"}  # and names in tables


def main(argv: list[str] | None = None) -> dict[str, dict[str, Deviation]]:
    options = parse(argv)
    model = BodyModel()
    bodies = test_bodies(options)
    trained_on = Triangulation.decimated(model.reference, len(bodies[0].faces))
    others = triangulations(model, trained_on)
    table = {}
    for kind, title in KINDS.items():
        checkpoint = options.run / kind / "checkpoints" / "best.ckpt"
        if not checkpoint.exists():
            continue
        module = NJFTraining.load_from_checkpoint(checkpoint, map_location="cpu").eval()
        table[title] = compare_triangulations(
            module.model,
            Inputs(**module.hparams["inputs"]),
            body_model=model,
            trained_on=trained_on,
            others=others,
            bodies=bodies,
        )
        print(f"\n{title}: triangulation, faces, error, deviation, exact maps', in mm; / own error")
        for name, d in table[title].items():
            print(
                f"{name:<24}{d.n_faces:>8}{1000 * d.error:>8.2f}{1000 * d.deviation:>8.2f}"
                f"{1000 * d.exact:>8.2f}"
                f"{100 * d.share:>8.1f}%"
            )
    results = {
        "bodies": len(bodies),
        "poses": len(bodies[0].poses),
        "torch": torch.__version__,
        "deviations": {
            title: {name: asdict(d) for name, d in of_model.items()}
            for title, of_model in table.items()
        },
    }
    (options.run / "triangulations.json").write_text(json.dumps(results, indent=1))
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--run", type=Path, default=Path("runs/repose"), help="a run of body_maps.py")
    add("--data", type=Path, help="folder of the bodies (RUN/bodies)")
    add("--bodies", type=int, default=4, metavar="N", help="test identities (4)")
    add("--poses", type=int, default=4, metavar="N", help="of each (4)")
    add("--full", action="store_true", help="all test bodies in all of their poses")
    options = parser.parse_args(argv)
    if not (options.run / "njf" / "checkpoints" / "best.ckpt").exists():
        parser.error(f"no trained networks in {options.run}: run examples/body_maps.py first")
    options.data = options.data or options.run / "bodies"
    return options


def test_bodies(options: argparse.Namespace) -> list[Body]:
    store = BodyStore(options.data / "test", None if options.full else options.bodies)
    n_poses = None if options.full else options.poses
    return [replace(b, poses=b.poses[:n_poses], posed=b.posed[:n_poses]) for b in store]


def triangulations(model: BodyModel, trained_on: Triangulation) -> dict[str, Triangulation]:
    """Other ways to cut the reference surface into triangles."""
    reference, m = model.reference, len(trained_on.faces)
    return {
        "trained on": trained_on,
        "half as many": Triangulation.decimated(reference, m // 2),
        "four times as many": Triangulation.decimated(reference, 4 * m),
        "Loop-subdivided": trained_on.subdivided(),
        "mixed density": Triangulation.decimated(reference, 2 * m, grading=1.5),
        "original": Triangulation.original(reference),
    }


if __name__ == "__main__":
    main()
