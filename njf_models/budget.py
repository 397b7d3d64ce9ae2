"""Steps that take a wanted CPU time, so that models are compared at equal cost."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from njf_models.training import Batch, NJFTraining

_REPEATS = 6


def planned_steps(
    path: Path, module: NJFTraining, batches: Sequence[Batch], minutes: float, multiple: int
) -> int:
    """How many steps take so long; decided once, and kept in a file.

    Args:
        path: of the file.
        module: what is trained; its weights change.
        batches: one of each kind that the training takes by turns.
        minutes: of CPU time.
        multiple: of which the number of steps is one, such as the number of validations.
    """
    if not path.exists():
        seconds = seconds_per_step(module, batches)
        path.write_text(json.dumps(multiple * max(1, round(60 * minutes / seconds / multiple))))
    return int(json.loads(path.read_text()))


def seconds_per_step(module: NJFTraining, batches: Sequence[Batch]) -> float:
    """CPU time of a step: the mean over the batches of the median over some steps."""
    optimizer = torch.optim.Adam(module.parameters())
    times = np.zeros((_REPEATS, len(batches)))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="You are trying to `self.log")  # no trainer
        for row in times:
            for i, batch in enumerate(batches):
                start = time.process_time()
                optimizer.zero_grad()
                module.training_step(batch, 0).backward()
                optimizer.step()
                row[i] = time.process_time() - start
    return float(np.median(times, axis=0).mean())
