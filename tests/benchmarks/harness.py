"""Figures of speed: work timed in turns in one process, ratios with their spread, fitted exponents.

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
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from tests.benchmarks import limits

RESULT = Path(__file__).parents[2] / "docs" / "results" / "performance.json"
VERSIONS = ("torch", "numpy", "scipy", "cholespy", "libigl")

Work = Callable[[], object]
Seconds = Mapping[str, np.ndarray]


class Spread(NamedTuple):
    """A median between its quartiles."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Spread:
        """The spread of some values, such as one for each turn."""
        return cls(*np.quantile(np.array(list(values)), [0.25, 0.5, 0.75]).tolist())


class Target(NamedTuple):
    """What a figure should reach."""

    sense: Literal["≤", "≥"]
    value: float


class Limit(NamedTuple):
    """What the machine allows at best: `bound` says which of its resources."""

    bound: str
    seconds: float


@dataclass(frozen=True)
class Figure:
    """One figure of the page.

    Attributes:
        what: what is measured.
        against: the peer.
        value: the figure.
        unit: "×", or the unit of an absolute figure.
        target: what it should be.
        seconds: (median) time of each contestant.
        limit: a bound on our time, if one is known.
        details: sizes, and whatever else belongs to the record.
    """

    what: str
    against: str
    value: Spread
    unit: str = "×"
    target: Target | None = None
    seconds: dict[str, Spread] = field(default_factory=dict)
    limit: Limit | None = None
    details: dict[str, Any] = field(default_factory=dict)


# ------------------------------------------------------- measuring


def alternate(contestants: Mapping[str, Work], turns: int = 9, at_least: float = 0.02) -> Seconds:
    """Processor seconds per call of each contestant in each turn, who goes first changing from turn to turn.

    Args:
        contestants: what to call.
        turns: how often each has its turn, after one call to warm up.
        at_least: seconds in which short work is repeated within a turn.
    """
    names = list(contestants)
    repeats = {name: _repeats(contestants[name], at_least) for name in names}
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(turns):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            seconds[name].append(_timed(contestants[name], repeats[name]))
    return {name: np.array(times) for name, times in seconds.items()}


def _repeats(work: Work, at_least: float) -> int:
    work()
    return max(1, round(at_least / max(_timed(work, 1), 1e-9)))


def _timed(work: Work, repeats: int) -> float:
    gc.collect()
    gc.disable()
    try:
        start = time.process_time()
        for _ in range(repeats):
            work()
        return (time.process_time() - start) / repeats
    finally:
        gc.enable()


def speed_up(
    what: str,
    seconds: Seconds,
    against: str,
    at_least: float | None = None,
    *,
    ours: str = "ours",
    **more: Any,
) -> Figure:
    """How many times as fast as a peer."""
    target = None if at_least is None else Target("≥", at_least)
    return _ratio(what, seconds, against, ours, against, target, **more)


def cost(
    what: str, seconds: Seconds, against: str, at_most: float, *, ours: str = "ours", **more: Any
) -> Figure:
    """How many times a peer's time."""
    return _ratio(what, seconds, ours, against, against, Target("≤", at_most), **more)


def _ratio(
    what: str,
    seconds: Seconds,
    numerator: str,
    denominator: str,
    against: str,
    target: Target | None,
    **more: Any,
) -> Figure:
    return Figure(
        what,
        against,
        Spread.of(seconds[numerator] / seconds[denominator]),
        target=target,
        seconds={name: Spread.of(seconds[name]) for name in sorted({numerator, denominator})},
        **more,
    )


def exponent(
    what: str, sizes: Iterable[int], seconds: Iterable[float], at_most: float, **more: Any
) -> Figure:
    """The power of the size that fits times best, with its standard error, over four sizes or more.

    Raises:
        ValueError: fewer than four sizes.
    """
    x, y = np.log(np.array(list(sizes), dtype=float)), np.log(np.array(list(seconds)))
    if len(x) < 4:
        raise ValueError(f"exponent: four sizes or more, got {len(x)}")
    x = x - x.mean()
    power = x @ y / (x @ x)
    misfit = y - y.mean() - power * x
    error = float(np.sqrt(misfit @ misfit / (len(x) - 2) / (x @ x)))
    value = Spread(power - error, float(power), power + error)
    return Figure(what, "smaller sizes", value, "exponent", Target("≤", at_most), **more)


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


def record(path: Path, name: str, figures: list[Figure], about: dict[str, Any]) -> None:
    """Put the figures of one measurement into the file, in place of earlier ones."""
    results = json.loads(path.read_text()) if path.exists() else {}
    results[name] = {"machine": about, "figures": [asdict(figure) for figure in figures]}
    path.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")


def read(path: Path) -> dict[str, list[Figure]]:
    """The figures in a file, by measurement."""
    results = json.loads(path.read_text())
    return {name: [_figure(entry) for entry in part["figures"]] for name, part in results.items()}


def _figure(entry: dict[str, Any]) -> Figure:
    made: dict[str, Any] = {"value": Spread(*entry["value"])}
    made["seconds"] = {name: Spread(*values) for name, values in entry["seconds"].items()}
    for name, kind in (("target", Target), ("limit", Limit)):
        made[name] = entry[name] and kind(*entry[name])
    return Figure(**entry | made)


def shown(figure: Figure) -> str:
    """A line for the terminal."""
    low, median, high = figure.value
    target = f", target {figure.target.sense} {figure.target.value:g}" if figure.target else ""
    times = ", ".join(f"{n} {1e3 * s.median:.4g} ms" for n, s in figure.seconds.items())
    limit = f" [{figure.limit.bound}: {1e3 * figure.limit.seconds:.3g} ms]" if figure.limit else ""
    return (
        f"{figure.what}, against {figure.against}: {median:.3g} {figure.unit} "
        f"[{low:.3g}, {high:.3g}]{target}; {times}{limit}"
    )
