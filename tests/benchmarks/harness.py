"""Work timed in turns in one process, and the command line of each theme of figures.

The themes `operators`, `factorisation`, `distortion`, `network`, `startup`, `scaling` and `maps`
each hold some figures. `python -m tests.benchmarks.THEME` measures them, or those that `--only`
names, and puts them in their place in `docs/results/performance.json`; `report` makes the page.

Contestants take turns, since the speed of a shared machine drifts: what is compared is their ratio
in each turn, and a figure is the median over the turns with its quartiles. (pytest-benchmark, which
runs one contestant to its end before the next, leaves the drift in the ratio.) Work has one thread,
and its time is that of the processor: other processes cost caches and bandwidth, but no waiting.
"""

from __future__ import annotations

import argparse
import gc
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from tests.benchmarks import limits
from tests.benchmarks.figures import RESULT, Figure, Seconds, record, shown

VERSIONS = ("torch", "numpy", "scipy", "cholespy", "libigl")

Work = Callable[[], object]


# ------------------------------------------------------- measuring


def alternate(contestants: Mapping[str, Work], turns: int = 9, at_least: float = 0.02) -> Seconds:
    """Processor seconds per call of each contestant in each turn; each goes first at times.

    Args:
        contestants: what to call.
        turns: how often each has its turn, after one call to warm up.
        at_least: seconds in which short work is repeated within a turn.
    """
    names = list(contestants)
    gc.collect()
    repeats = {name: _repeats(contestants[name], at_least) for name in names}
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(turns):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            seconds[name].append(_timed(contestants[name], repeats[name]))
    return {name: np.array(times) for name, times in seconds.items()}


def _repeats(work: Work, at_least: float) -> int:
    """How often work fits into a time, after a call to warm up; long work is warm at once."""
    first = _timed(work, 1)
    return 1 if first > at_least else max(1, round(at_least / max(_timed(work, 1), 1e-9)))


def _timed(work: Work, repeats: int) -> float:
    gc.disable()
    try:
        start = time.process_time()
        for _ in range(repeats):
            work()
        return (time.process_time() - start) / repeats
    finally:
        gc.enable()


# ------------------------------------------------------- records


def machine() -> dict[str, Any]:
    """What the figures were measured on, and how busy it is."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "system": platform.system(),
        "python": platform.python_version(),
        **{name: version(name) for name in VERSIONS},
        "bandwidth, GB/s": round(limits.bandwidth() / 1e9, 1),
        "float32 matmul, GFLOP/s": round(limits.peak_flops(torch.float32) / 1e9, 1),
        "float64 matmul, GFLOP/s": round(limits.peak_flops(torch.float64) / 1e9, 1),
        "bfloat16 matmul, GFLOP/s": round(limits.peak_flops(torch.bfloat16) / 1e9, 1),
    }


def _processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    fields = dict(line.split("\t: ", 1) for line in reversed(lines) if "\t: " in line)
    numbers = (f"{n} {fields[n]}" for n in ("cpu family", "model\t") if n in fields)
    name = fields.get("model name\t", fields.get("model name", platform.processor()))
    return ", ".join([name, *(number.replace("\t", "") for number in numbers)])


def main(theme: str, measurements: Mapping[str, Callable[[bool], Iterable[Figure]]]) -> None:
    """The command line of a theme: measure, print, and put each measurement in its place.

    Args:
        theme: its name.
        measurements: functions of `quick`, which asks for the smallest sizes, that return figures.
    """
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks.{theme}")
    parser.add_argument("--only", nargs="+", choices=measurements, default=list(measurements))
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that it runs")
    parser.add_argument("--json", type=Path, default=RESULT)
    options = parser.parse_args()
    if options.quick and options.json == RESULT:
        parser.error("--quick measures nothing worth keeping; name another file with --json")
    torch.set_num_threads(1)
    with threadpool_limits(1):
        for name in options.only:
            load = os.getloadavg()[0]
            figures = list(measurements[name](options.quick))
            about = machine() | {"load": [round(load, 2), round(os.getloadavg()[0], 2)]}
            record(options.json, f"{theme}.{name}", figures, about)
            for figure in figures:
                print(shown(figure), flush=True)
