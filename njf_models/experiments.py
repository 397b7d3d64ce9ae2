"""What the scripts of `examples/` say of an experiment: where it ran, and what training took."""

from __future__ import annotations

import argparse
import logging
import platform
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch


def quiet() -> None:
    """No advertisements and no warnings of Lightning's own doing."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning.pytorch.utilities._pytree")
    # Steps that are timed before a training have no trainer to log to.
    warnings.filterwarnings("ignore", message="You are trying to `self.log\\(\\)`")


def circumstances(options: argparse.Namespace) -> dict[str, Any]:
    """Options but for paths, torch and the machine, for a record in JSON."""
    return {
        "options": {
            name: value for name, value in vars(options).items() if not _holds_paths(value)
        },
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, {torch.get_num_threads()} threads",
    }


def _holds_paths(value: Any) -> bool:
    values = value if isinstance(value, list) else [value]
    return any(isinstance(one, Path) for one in values)


def training_cost(checkpoint: Path) -> dict[str, float | None]:
    """Seconds of the training whose last checkpoint lies beside this one, until its last step."""
    last = torch.load(checkpoint.with_name("last.ckpt"), weights_only=False)
    return {"cpu seconds": last["cpu_seconds"], "seconds": last["training_seconds"]}


def mean(rows: Sequence[Mapping[str, float | int]]) -> dict[str, float]:
    """The mean of each column."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def spread(rows: Sequence[Mapping[str, float | int]]) -> dict[str, float]:
    """The largest minus the smallest value of each column, over seeds."""
    return {name: float(np.ptp([row[name] for row in rows])) for name in rows[0]}
