"""What each part of the re-posing network brings: variants without it, trained for the same time.

`python -m tests.benchmarks.body_tricks --data FOLDER` writes `docs/results/body_tricks.json`. The
folder is that of the bodies of `examples/body_maps.py`, or becomes one. Each variant is trained for
two minutes of CPU time, on samples alone; its errors are those of the test bodies.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from njf_models import njf
from njf_models.field import PartField

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "body_tricks.json"

VARIANTS: dict[str, list[str]] = {
    "ours": [],
    "PointNet, not basis points": ["--basis", "0"],
    "no waves of the position": [],
    "no products of rotations": [],
    "24 poses and 64 faces of a body a step, not 8 and 192": ["--targets", "24", "--cells", "64"],
    "the paper's field": [],
}


class WithoutProducts(PartField):
    """A field of parts that makes nothing of the rotations in its code but what layers make."""

    def __init__(self, *sizes: int, rotations: int, **arguments: Any) -> None:
        super().__init__(*sizes, rotations=0, **arguments)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("runs/body_tricks"))
    parser.add_argument("--minutes", type=float, default=2.0)
    parser.add_argument("--bodies", type=int, default=400)
    parser.add_argument("--poses", type=int, default=24)
    options = parser.parse_args()
    common = ["--data", str(options.data), "--bodies", str(options.bodies)]
    common += ["--poses", str(options.poses), "--models", "njf", "--whole", "0"]
    rows = {}
    for number, (name, arguments) in enumerate(VARIANTS.items()):
        folder = options.out / str(number)
        rows[name] = run(name, [*common, *arguments, "--out", str(folder)], options.minutes)
        print(name, rows[name])
    results = {"minutes": options.minutes, "torch": torch.__version__, "variants": rows}
    RESULT.write_text(json.dumps(results, indent=1) + "\n")


def run(name: str, arguments: list[str], minutes: float) -> dict[str, float]:
    """Train a variant and evaluate it."""
    example = load_example()
    if name == "no waves of the position":
        example.IN_PARTS = example.IN_PARTS._replace(arguments={"parts": 128})
    elif name == "the paper's field":
        example.IN_PARTS = example.OF_EACH_FACE
    field = njf.PartField
    if name == "no products of rotations":
        njf.PartField = WithoutProducts
    try:
        options = example.parse(arguments)
        train, *_ = example.make_bodies(options)
        seconds = example.seconds_per_step("njf", train, options)["sampled"]
        steps = round(60 * minutes / seconds / options.validations) * options.validations
        table = example.main([*arguments, "--steps", str(steps)])
    finally:
        njf.PartField = field
    return {"steps": steps} | {error: table["ours"][error] for error in ("L2-V", "L2-J")}


def load_example() -> ModuleType:
    """A fresh copy of `examples/body_maps.py`."""
    spec = importlib.util.spec_from_file_location("body_maps", ROOT / "examples" / "body_maps.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
