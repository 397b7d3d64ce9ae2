"""Ship a trained network for poses: its weights and their card, from a run of the example.

    python -m tests.benchmarks.repose_card RUN --machine "..." "python examples/body_maps.py ..."

Writes `njf_models/weights/repose.safetensors` and `repose.json`; `repose-any` of a chain, whose
first networks are of the runs `--after`.
"""

from __future__ import annotations

import argparse
import json
from importlib.metadata import version
from pathlib import Path

import torch

from njf_models.repose_network import ReposeNetwork

EARLIER = "earlier, cpu seconds"
WEIGHTS = Path(__file__).parents[2] / "njf_models" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("command")
    parser.add_argument("--machine", required=True, help="in words")
    parser.add_argument("--after", type=Path, nargs="+", default=[], help="runs before it")
    options = parser.parse_args()
    runs = [*options.after, options.run]
    network = ReposeNetwork.chained([run / "njf" / "checkpoints" / "best.ckpt" for run in runs])
    name, start = ("repose-any", "any pose") if options.after else ("repose", "the rest pose")
    network.save(WEIGHTS / f"{name}.safetensors", torch.float16)
    results = json.loads((options.run / "results.json").read_text())
    told, training, errors = (results[key] for key in ("options", "training", "summary"))
    steps = " and ".join(f"{n} {phase}" for phase, n in training["ours"]["steps"].items())
    card = {
        "what": f"bodies from {start} to poses of twenty joints: Neural Jacobian Field",
        "parameters": sum(p.numel() for p in network.model.parameters()),
        "precision": "half in the file, single in use",
        "bytes": (WEIGHTS / f"{name}.safetensors").stat().st_size,
        "licence of the weights": "MIT",
        "data": f"{told['bodies']} random adults in {told['poses']} random poses each, of "
        f"{told['faces']} faces, by anny {version('anny')} (code Apache-2.0, assets CC0)",
        "split": f"{told['bodies']} train, {told['held_out']} validation, {told['held_out']} test "
        "identities, no pose in two of them",
        "chosen by": "loss on the validation split",
        "optimiser steps": steps,
        "minutes of CPU time": round(training["ours"]["cpu seconds"] / 60, 1),
        "minutes of earlier trainings": round(training["ours"].get(EARLIER, 0.0) / 60, 1),
        "machine": options.machine,
        "command": options.command,
        "test maps": int(errors["ours"]["maps"]),
        **{
            f"test {error}": round(errors["ours"][error], 2)
            for error in ("L2-V", "L2-J", "L2-N, degrees")
        },
        "limits": f"characters of human proportions that stand in {start}, in metres; linear "
        "skinning is what it has learned, hands and face do not move",
    }
    (WEIGHTS / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


if __name__ == "__main__":
    main()
