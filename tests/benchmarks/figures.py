"""Figures of speed as records: ratios and exponents with their spread, targets, limits; JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

RESULT = Path(__file__).parents[2] / "docs" / "results" / "performance.json"

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


# ------------------------------------------------------- making


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
    return _ratio(what, seconds, (against, ours), target, against=against, **more)


def cost(
    what: str, seconds: Seconds, against: str, at_most: float, *, ours: str = "ours", **more: Any
) -> Figure:
    """How many times a peer's time."""
    target = Target("≤", at_most)
    return _ratio(what, seconds, (ours, against), target, against=against, **more)


def _ratio(
    what: str, seconds: Seconds, parts: tuple[str, str], target: Target | None, **more: Any
) -> Figure:
    numerator, denominator = parts
    return Figure(
        what,
        value=Spread.of(seconds[numerator] / seconds[denominator]),
        target=target,
        seconds={name: Spread.of(seconds[name]) for name in sorted(parts)},
        **more,
    )


def exponent(
    what: str, sizes: Iterable[int], times: Iterable[float], at_most: float, **more: Any
) -> Figure:
    """The power of the size that fits times best, with its standard error, over four sizes or more.

    Raises:
        ValueError: fewer than four sizes.
    """
    x, y = np.log(np.array(list(sizes), dtype=float)), np.log(np.array(list(times)))
    if len(x) < 4:
        raise ValueError(f"exponent: four sizes or more, got {len(x)}")
    x = x - x.mean()
    power = x @ y / (x @ x)
    misfit = y - y.mean() - power * x
    error = float(np.sqrt(misfit @ misfit / (len(x) - 2) / (x @ x)))
    value = Spread(power - error, float(power), power + error)
    return Figure(what, "smaller sizes", value, "exponent", Target("≤", at_most), **more)


# ------------------------------------------------------- files


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
