"""`njf train`: train a UV network on a store of patches."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from njf_models.commands import UsageError

if TYPE_CHECKING:
    from torch import nn

    from njf_models.datasets.store import UVStore
    from njf_models.trained import Inputs

_EXAMPLE = """\
examples:
  njf train runs/patches runs/uv --steps 20000
  njf train runs/patches runs/paper --steps 20000 --rounds 1 --code-size 1000

An interrupted command goes on where it stopped when it is repeated. The mesh families of each
split are written to OUT/split.json at the first call, and read from there after it.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "train",
        help="train a UV network",
        description=__doc__,
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("store", type=Path, help="patches made by `njf data`")
    add("out", type=Path, help="folder for checkpoints and logs")
    add("--steps", type=int, default=20_000, metavar="N", help="optimiser steps (20000)")
    add("--minutes", type=float, help="stop after this time, to go on later")
    add("--batch-size", type=int, default=8, metavar="N", help="patches per step (8)")
    add("--rate", type=float, default=1e-3, help="learning rate at the start (1e-3)")
    add("--init", metavar="WEIGHTS", help="begin with these: a name (uv), .safetensors or .ckpt")
    add(
        "--encoder",
        choices=("pointnet", "diffusion"),
        default="pointnet",
        help="how it learns of the whole: a code of its points, or features that diffuse on it",
    )
    add("--eigenpairs", type=int, default=64, metavar="N", help="to diffuse by (64)")
    add("--net-width", type=int, default=64, metavar="N", help="channels of DiffusionNet (64)")
    add("--net-blocks", type=int, default=2, metavar="N", help="its blocks (2)")
    add("--rounds", type=int, default=2, metavar="N", help="predictions and solves (2; paper 1)")
    add("--shared-rounds", action="store_true", help="one network for all corrections")
    add("--local-step", action="store_true", help="corrections start from closest rotations")
    add("--width", type=int, default=128, metavar="N", help="of hidden layers (128)")
    add("--code-size", type=int, default=256, metavar="N", help="of PointNet's code (256)")
    add("--points", type=int, default=256, metavar="N", help="that PointNet sees (256; paper 1024)")
    add("--wks", action="store_true", help="use the store's wave-kernel signatures")
    add(
        "--loss",
        choices=("paper", "turned", "none"),
        default="paper",
        help="distance to targets; turned: after turning them onto the map (paper)",
    )
    add("--robust", action="store_true", help="hard patches pull hardly more than good ones")
    add("--distortion", type=float, default=0.3, help="weight of the distortion loss (0.3)")
    add("--no-augment", dest="augment", action="store_false", help="no random turns and scales")
    add("--min-flatness", type=float, default=0.0, help="leave out patches below |Σ nA| / ΣA (0)")
    add("--max-energy", type=float, default=8.0, help="leave out targets more distorted (8)")
    add("--processes", type=int, default=1, metavar="N", help="data-parallel processes (1)")
    add("--seed", type=int, default=0)
    return parser


def run(options: argparse.Namespace) -> int:
    """Train until the steps or minutes are over."""
    import lightning  # noqa: PLC0415  (seconds to import)

    from njf_models.experiments import quiet  # noqa: PLC0415
    from njf_models.trained import Inputs  # noqa: PLC0415
    from njf_models.training import (  # noqa: PLC0415
        NJFTraining,
        UVExamples,
        last_checkpoint,
        loader,
        make_trainer,
    )

    if not options.debug:
        quiet()
    options.out.mkdir(parents=True, exist_ok=True)
    lightning.seed_everything(options.seed, verbose=False)
    parts = _split(options)
    train, validation = parts["train"], parts["validation"]
    print(f"{len(train)} training and {len(validation)} validation patches")
    n_energies = train[0].wks.shape[1] * options.wks
    diffuses = options.encoder == "diffusion"
    inputs = Inputs(
        # The code of a network that diffuses is empty, whatever the points.
        n_points=1 if diffuses else options.points,
        n_energies=n_energies,
        n_eigenpairs=options.eigenpairs if diffuses else 0,
    )
    seen = {
        "n_points": inputs.n_points,
        "use_wks": options.wks,
        "n_eigenpairs": inputs.n_eigenpairs,
    }
    kind, model = _model(options, n_energies)
    module = NJFTraining(
        model,
        {
            "supervised": None if options.loss == "none" else options.loss,
            "distortion": options.distortion,
            "augment": options.augment,
            "robust": options.robust,
        },
        learning_rate=options.rate,
        steps=options.steps,
        inputs=asdict(inputs),
        kind=kind,
    )
    if options.init is not None:
        _begin_with(module.model, model, inputs, options.init)
    trainer = make_trainer(
        options.out,
        minutes=options.minutes,
        steps=options.steps,
        validate_every=min(500, options.steps),
        processes=options.processes,
    )
    trainer.fit(
        module,
        loader(UVExamples(train, resample=True, **seen), options.batch_size, shuffle=True),
        loader(UVExamples(validation, **seen), 16),
        ckpt_path=last_checkpoint(options.out),
    )
    print(f"best weights, for `njf uv --model`: {options.out / 'checkpoints' / 'best.ckpt'}")
    return 0


def _begin_with(model: nn.Module, arguments: dict[str, Any], inputs: Inputs, weights: str) -> None:
    """Load weights that are known by name or in a file, of a network made and fed like this one."""
    from njf_models.pretrained import load_uv_network  # noqa: PLC0415

    network = load_uv_network(weights)
    # PointNet takes any number of points; a network that diffuses has learned of its eigenpairs.
    theirs = network.arguments | {"eigenpairs": network.inputs.n_eigenpairs}
    ours = arguments | {"eigenpairs": inputs.n_eigenpairs}
    if other := [name for name in {**theirs, **ours} if theirs.get(name) != ours.get(name)]:
        said = ", ".join(f"{name} {theirs.get(name)}, not {ours.get(name)}" for name in other)
        raise UsageError(f"--init {weights} is of a network with {said}; train with its options")
    model.load_state_dict(network.model.state_dict())


def _model(options: argparse.Namespace, n_energies: int) -> tuple[str, dict[str, Any]]:
    """The kind of the network, and its arguments."""
    field = {
        "output_dim": 2,
        "rounds": options.rounds,
        "shared_rounds": options.shared_rounds,
        "width": options.width,
        "local_step": options.local_step,
    }
    n_features = 6 + n_energies
    if options.encoder == "diffusion":
        net = {"net_width": options.net_width, "n_blocks": options.net_blocks}
        return "diffusion+njf", {"features": n_features} | net | field
    coded = {"face_features": n_features, "point_features": n_features}
    return "njf", coded | {"code_size": options.code_size} | field


def _split(options: argparse.Namespace) -> dict[str, UVStore]:
    """The parts of the store, by mesh family; always the same for one folder OUT."""
    from njf_models.datasets.store import PatchFilter, UVStore, split_by_mesh  # noqa: PLC0415

    store = UVStore(options.store, PatchFilter(options.min_flatness, None, options.max_energy))
    path, names = options.out / "split.json", ("train", "validation", "test")
    if not path.exists():
        parts = split_by_mesh(store, (0.8, 0.1, 0.1), options.seed)
        families = {n: sorted(set(part.family)) for n, part in zip(names, parts, strict=True)}
        path.write_text(json.dumps(families, indent=1))
    families = json.loads(path.read_text())
    return {
        name: store.subset([i for i, f in enumerate(store.family) if f in members])
        for name, members in ((name, set(families[name])) for name in names)
    }
