"""Re-pose bodies unlike those of training: a child, a tall body, or a character of yours.

Takes the network that `examples/body_maps.py` has trained on adults of moderate proportions, on a
coarse triangulation. The built-in bodies have parameters outside of the range of training, and the
triangulation of the original, with face, fingers and toes; their maps are compared with the body
model's own. A character of yours, `--mesh FILE`, has no such reference; its maps are drawn.

It should stand as the training bodies do, with arms half lowered, in metres: x to its left, y to
its back, z up. `--y-up` turns one whose y is up and whose z is to its front; `--height` scales it.
One that stands otherwise, with its arms held out say, needs a network for any pose: `--run` of a
run of `body_maps.py --task any-pose`.

Takes a minute, and more when the body model is built for the first time. Writes to the folder
`--out`: far.png, far.json, and the first re-posed character as an OBJ.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import diffpoisson as dp
from njf_models.body_maps import BodyMaps, MapRecord, evaluate_maps
from njf_models.body_report import BodyRow, save_body_report
from njf_models.datasets.bodies import PHENOTYPES, Body, BodyModel, BodyStore, retriangulated
from njf_models.datasets.triangulation import Triangulation
from njf_models.evaluation import format_table
from njf_models.map_errors import summarise
from njf_models.meshfiles import read_mesh_file
from njf_models.repose_network import ReposeNetwork, Stance

# Parameters of the body model that are set; all others are in the middle of their range. The range
# of training is 0.55 to 0.95 in age, 0.1 to 0.9 in weight and muscle, 0.2 to 0.8 in height.
FAR = {
    "a child": {"age": 0.3, "weight": 0.5},
    "a tall body": {"height": 1.0, "muscle": 1.0, "gender": 1.0},
    "very heavy": {"weight": 1.0, "muscle": 0.3},
}


def main(argv: list[str] | None = None) -> dict[str, dict[str, float]]:
    options = parse(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    runs = [*options.after, options.run]
    network = ReposeNetwork.chained([run / "njf" / "checkpoints" / "best.ckpt" for run in runs])
    near = BodyStore(options.data / "test", 1)[0]
    near = replace(near, poses=near.poses[: options.poses], posed=near.posed[: options.poses])
    table: dict[str, dict[str, float]] = {}
    if options.mesh:
        rows = own_character(network, near.poses, options)
    else:
        rows, table = built_in(network, near)
        print("\nThe body model's maps are the reference:\n" + format_table(table))
        (options.out / "far.json").write_text(json.dumps(table, indent=1))
    save_body_report(rows, options.out / "far.png")
    print(f"\n{options.out / 'far.png'}")
    return table


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("--run", type=Path, default=Path("runs/repose"), help="a run of body_maps.py")
    add("--after", type=Path, nargs="+", default=[], metavar="RUN", help="as of body_maps.py")
    add("--data", type=Path, help="folder of the bodies (RUN/bodies)")
    add("--out", type=Path, default=Path("runs/far"), help="folder for results (runs/far)")
    add("--poses", type=int, default=8, metavar="N", help="test poses (8)")
    add("--mesh", type=Path, metavar="FILE", help="a character of yours")
    add("--y-up", action="store_true", help="its y is up and its z to the front")
    add("--height", type=float, help="scale it to this height, in metres")
    options = parser.parse_args(argv)
    if not (options.run / "njf" / "checkpoints" / "best.ckpt").exists():
        parser.error(f"no trained network in {options.run}: run examples/body_maps.py first")
    options.data = options.data or options.run / "bodies"
    return options


def built_in(
    network: ReposeNetwork, near: Body
) -> tuple[list[BodyRow], dict[str, dict[str, float]]]:
    """Maps of a body of the test set, and of others in its poses, on the original triangulation."""
    model = BodyModel()
    original = Triangulation.original(model.reference)
    phenotypes = {
        "a test body": near.phenotype,
        **{name: phenotype(**x) for name, x in FAR.items()},
    }
    rows, table = [], {}
    for name, parameters in phenotypes.items():
        body = retriangulated(model, original, replace(near, phenotype=parameters))
        seen = network.inputs
        maps = BodyMaps(
            [body],
            n_points=seen.n_points,
            n_energies=seen.n_energies,
            n_basis=seen.n_basis,
            basis_at=seen.basis_at,
        )
        records, emitted = evaluate_maps(network.model, maps)
        table[name] = summarise(records)
        at = median(records)
        target, phi = body.posed[at], emitted[0][at]
        title = f"{name}, pose {at}\nL2-V {records[at].l2_v:.2f}"
        rows.append(BodyRow(title, body.faces, body.rest, target, {"ours": phi}))
    return rows, table


def phenotype(**values: float) -> Float[Tensor, "k=6"]:
    """The middle of all parameters' ranges, but for those that are given."""
    return torch.tensor([values.get(name, sum(x) / 2) for name, x in PHENOTYPES.items()])


def median(records: list[MapRecord]) -> int:
    """The map with the median error."""
    return int(np.argsort([record.l2_v for record in records])[len(records) // 2])


def own_character(
    network: ReposeNetwork, poses: Float[Tensor, "p k"], options: argparse.Namespace
) -> list[BodyRow]:
    """A mesh file in some poses, and the first of them written."""
    character = read_mesh_file(options.mesh).cleaned().mesh
    stance = Stance(options.y_up)
    if options.height:
        stance = stance._replace(scale=options.height / stance.height(character.vertices))
    mesh = dp.Mesh(stance.standing(character.vertices), character.faces)
    posed = network.repose(mesh, poses)
    write_obj(options.out / "far.obj", stance.back(posed[0]), mesh.faces)
    maps = {f"pose {i}": phi for i, phi in enumerate(posed[:4])}
    return [BodyRow("", mesh.faces, mesh.vertices, None, maps)]


def write_obj(path: Path, vertices: Tensor, faces: Tensor) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
