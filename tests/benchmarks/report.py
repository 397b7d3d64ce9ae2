"""The page of figures: its tables and plots from JSON, and what got worse since another JSON.

    python -m tests.benchmarks.report
    python -m tests.benchmarks.report --against OLD.json

The first writes the tables of `docs/performance.md` and its plots in `docs/images/`; the second
compares ratios, not seconds, and prints those that got worse by more than their spread.
"""

from __future__ import annotations

import argparse
import json
import runpy
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture

from tests.benchmarks.figures import RESULT, Figure, Spread, read, shown

DOCS = Path(__file__).parents[2] / "docs"

# ------------------------------------------------------- tables


def figures_table(results: Path = RESULT) -> str:
    """Each figure with its target and the limit of the machine."""
    lines = [
        "| what | against | target | measured | quartiles | our time | the limit takes |",
        "|---|---|---|---|---|---|---|",
    ]
    for figures in read(results).values():
        lines += (_row(figure) for figure in figures)
    return "\n".join(lines)


def _row(figure: Figure) -> str:
    low, median, high = (f"{value:.3g}" for value in figure.value)
    unit = "" if figure.unit in ("", "exponent") else f" {figure.unit}"
    target = f"{figure.target.sense} {figure.target.value:g}{unit}" if figure.target else "–"
    measured = f"{median}{unit}" if met(figure) else f"**{median}{unit}**"
    spread = "–" if low == high else f"{low} … {high}"
    ours = _our_seconds(figure)
    limit = "–"
    if figure.limit is not None and ours is not None:
        share = figure.limit.seconds / ours
        limit = f"{100 * share:.2g} % ({figure.limit.bound})"
    time = "–" if ours is None else _time(ours)
    cells = (figure.what, figure.against, target, measured, spread, time, limit)
    return "| " + " | ".join(cells) + " |"


def met(figure: Figure) -> bool:
    """Whether a figure reaches its target; true of those that have none."""
    if figure.target is None:
        return True
    sense, value = figure.target
    return figure.value.median <= value if sense == "≤" else figure.value.median >= value


def _our_seconds(figure: Figure) -> float | None:
    ours = [times.median for name, times in figure.seconds.items() if name.startswith("ours")]
    return ours[0] if len(ours) == 1 else None


def _time(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1 else f"{1000 * seconds:.3g} ms"


def machines_table(results: Path = RESULT) -> str:
    """What was measured on what: a line for each machine and state of the software."""
    measured: dict[str, list[str]] = {}
    loads: dict[str, list[float]] = {}
    for name, part in json.loads(results.read_text()).items():
        about = part["machine"]
        facts = (f"{k} {v}" for k, v in about.items() if k != "load" and not _is_rate(k))
        described = ", ".join(facts).removeprefix("processor ")
        measured.setdefault(described, []).append(name)
        loads.setdefault(described, []).extend(about["load"])
    return "\n".join(
        f"- {described}; load average {min(loads[described]):.1f} to {max(loads[described]):.1f}: "
        f"{', '.join(names)}."
        for described, names in measured.items()
    )


def limits_table(results: Path = RESULT) -> str:
    """What one thread can do at best, the best that any measurement found."""
    best: dict[str, float] = {}
    for part in json.loads(results.read_text()).values():
        for key, value in part["machine"].items():
            if _is_rate(key):
                best[key] = max(value, best.get(key, 0.0))
    return "\n".join(["| | |", "|---|---|", *(f"| {k} | {v:g} |" for k, v in best.items())])


def _is_rate(key: str) -> bool:
    return key.endswith("/s")


TABLES = {
    "performance": figures_table,
    "performance_machines": machines_table,
    "performance_limits": limits_table,
}


# ------------------------------------------------------- plots


def plot(results: Path, folder: Path) -> list[Path]:
    """All plots that the results have figures for."""
    parts = read(results)
    written = []
    ratios = [f for figures in parts.values() for f in figures if f.unit == "×" and f.target]
    if ratios:
        written.append(plot_ratios(ratios, folder / "performance_ratios.png"))
    if (scaling := parts.get("scaling.sizes")) is not None:
        written.append(plot_scaling(scaling, folder / "performance_scaling.png"))
    if (maps := parts.get("maps.front")) is not None:
        written.append(plot_front(maps, folder / "performance_maps.png"))
    return written


def plot_ratios(figures: list[Figure], path: Path) -> Path:
    """Each ratio over its target, such that right of one is better than asked."""
    low, median, high = np.array([_over_target(figure) for figure in figures])[::-1].T
    names = [f"{figure.what}\nagainst {figure.against}" for figure in figures][::-1]
    picture = Picture(figsize=(10, 0.42 * len(figures) + 1), layout="constrained")
    axes = picture.subplots()
    rows = np.arange(len(figures))
    for chosen, colour in ((median >= 1, "tab:green"), (median < 1, "tab:red")):
        spread = (median[chosen] - low[chosen], high[chosen] - median[chosen])
        axes.errorbar(median[chosen], rows[chosen], xerr=spread, fmt="o", color=colour, capsize=3)
    axes.axvline(1, color="black", linewidth=0.8)
    axes.set(xscale="log", xlabel="measured over target (right of 1: better than asked)")
    axes.set_yticks(rows, names, fontsize=7)
    axes.set_ylim(-1, len(figures))
    ticks = (0.2, 0.5, 1, 2, 5)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", alpha=0.3)
    return _saved(picture, path)


def _over_target(figure: Figure) -> Spread:
    assert figure.target is not None
    ratios = np.array(figure.value) / figure.target.value
    return Spread(*(1 / ratios[::-1] if figure.target.sense == "≤" else ratios).tolist())


def plot_scaling(figures: list[Figure], path: Path) -> Path:
    """Seconds of each stage over the number of vertices."""
    picture = Picture(figsize=(7, 5), layout="constrained")
    axes = picture.subplots()
    for figure in (figure for figure in figures if figure.unit == "exponent"):
        sizes = [int(name.replace(",", "")) for name in figure.seconds]
        seconds = [times.median for times in figure.seconds.values()]
        stage = figure.what.split(": ")[-1]
        axes.plot(sizes, seconds, "o-", label=f"{stage}: n^{figure.value.median:.2f}")
    axes.set(xscale="log", yscale="log", xlabel="vertices", ylabel="seconds, one thread")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return _saved(picture, path)


def plot_front(figures: list[Figure], path: Path) -> Path:
    """Time and energy of UV maps, a panel for each size: medians, and each mesh faintly."""
    panels = {figure.details["title"]: figure.details["points"] for figure in figures}
    picture = Picture(figsize=(5.5 * len(panels), 4.5), layout="constrained")
    for axes, (title, points) in zip(
        picture.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
    ):
        energies = [_of_one_chart(values) for values in points.values()]
        for name, values in points.items():
            _scatter(axes, name, values, np.min(energies, axis=0))
        axes.set(xscale="log", yscale="log", xlabel="seconds from (V, F), one thread")
        axes.set(ylabel="energy over the least of one chart, minus 1")
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    return _saved(picture, path)


def _of_one_chart(values: dict[str, Any]) -> list[float]:
    """Energies of the maps that neither flip nor cut the patch; infinite of the others."""
    pairs = zip(values["energy"], values["charts"], strict=True)
    return [energy if energy and charts == 1 else np.inf for energy, charts in pairs]


def _scatter(axes: Any, name: str, values: dict[str, Any], best: np.ndarray) -> None:
    """A contestant's meshes; those that it flips are not in the picture, but counted.

    Energies that seams lower below the least of one chart stand at the lower edge.
    """
    excess = np.array([e or np.nan for e in values["energy"]]) / best - 1
    kept = np.isfinite(excess)
    label = name if kept.all() else f"{name} ({(~kept).sum()} of {len(kept)} flip)"
    if max(values["charts"]) > 1:
        label += f", {min(values['charts'])} to {max(values['charts'])} charts"
    marker = "*" if name.startswith("ours") else "o"
    x, y = np.array(values["seconds"])[kept], np.maximum(excess[kept], 1e-7)
    middle = (np.median(x), np.median(y)) if kept.any() else ([], [])
    (drawn,) = axes.plot(*middle, marker, markersize=10, label=label)
    axes.plot(x, y, marker, markersize=4, alpha=0.4, color=drawn.get_color())


def _saved(picture: Picture, path: Path) -> Path:
    picture.savefig(path, dpi=110)
    return path


# ------------------------------------------------------- comparing


def worse(new: Path, old: Path) -> list[str]:
    """What got worse: figures whose whole spread is on the wrong side of the old one.

    Of figures without a spread, those that now miss a target that they met, or miss it by 5% more.
    """
    before = {_key(figure): figure for figure in _all(old)}
    pairs = ((figure, before.get(_key(figure))) for figure in _all(new))
    return [
        f"{shown(figure)}\n    was {earlier.value.median:.3g} "
        f"[{earlier.value.low:.3g}, {earlier.value.high:.3g}]"
        for figure, earlier in pairs
        if earlier is not None and figure.target is not None and _is_worse(figure, earlier)
    ]


def _is_worse(figure: Figure, earlier: Figure) -> bool:
    """Whether it moved away from its target, beyond the spread."""
    assert figure.target is not None
    now, then = figure.value, earlier.value
    upwards = figure.target.sense == "≤"  # is worse
    if now.low == now.high:
        slack = 0.0 if met(earlier) else 0.05 * abs(then.median)
        moved = now.median - then.median if upwards else then.median - now.median
        return not met(figure) and moved > slack
    return now.low > then.high if upwards else now.high < then.low


def _key(figure: Figure) -> tuple[str, str]:
    return figure.what, figure.against


def _all(path: Path) -> Iterable[Figure]:
    return (figure for figures in read(path).values() for figure in figures)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, default=RESULT)
    parser.add_argument("--against", type=Path, metavar="OLD.json")
    options = parser.parse_args()
    if options.against is not None:
        print("\n".join(worse(options.json, options.against)) or "nothing got worse")
        return
    for path in plot(options.json, DOCS / "images"):
        print(f"wrote {path}")
    runpy.run_path(str(DOCS / "update_tables.py"))["main"]()


if __name__ == "__main__":
    main()
