"""Write the tables in README.md and docs/ from the JSON results beside this file.

A table stands between the lines `<!-- table:NAME -->` and `<!-- end -->`. `--check` only says
whether anything would change.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from pathlib import Path

DOCS = Path(__file__).parent
RESULTS = DOCS / "results"


def uv_train() -> str:
    """The example's test split, beside the paper's figures on other data."""
    results = json.loads((RESULTS / "uv_train.json").read_text())
    before, after = results["summary"]["untrained"], results["summary"]["trained"]
    paper = {  # Table 1 of the paper: Thingi10K patches / other meshes
        "patches with a flip, raw, %": "19 / 10",
        "flips per patch, raw": "3.44 / 0.77",
        "D>10 per patch, raw": "5.67 / 1.99",
    }
    rows = [
        f"| {name} | {number(before[name])} | {number(after[name])} | {paper.get(name, '–')} |"
        for name in after
        if name not in ("patches", "milliseconds per patch, median")  # times depend on the load
    ]
    return "\n".join(
        [
            f"| {after['patches']:.0f} patches of unseen meshes | untrained: projection | trained "
            "| paper, other data |",
            "|---|---|---|---|",
            *rows,
        ]
    )


def transforms() -> str:
    """Peers under torch's transforms, from `tests/benchmarks/transforms_table.py`."""
    results = json.loads((RESULTS / "transforms.json").read_text())
    columns = {
        f"{name}, {what}": cells
        for name, kinds in results["rows"].items()
        if "missing" not in kinds
        for what, cells in kinds.items()
    }
    lines = ["| | " + " | ".join(columns) + " |", "|---|" + "---|" * len(columns)]
    for name in results["transforms"]:
        row = [transforms_cell(cells[name]) for cells in columns.values()]
        lines.append(f"| {name} | " + " | ".join(row) + " |")
    missing = [name for name, kinds in results["rows"].items() if "missing" in kinds]
    listed = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    absent = f" Not installed: {', '.join(missing)}." if missing else ""
    return "\n".join([*lines, "", f"Measured with {listed}.{absent}"])


def transforms_cell(result: dict) -> str:
    """✓, raises, or WRONG with the relative error."""
    if result["outcome"] == "WRONG":
        return f"**WRONG** ({result['relative error']:.0e})"
    return {"correct": "✓", "raises": "raises"}[result["outcome"]]


def poisson_cost() -> str:
    """Seconds of the Poisson layer over mesh sizes."""
    rows = json.loads((RESULTS / "poisson_cost.json").read_text())["rows"]
    columns = ("vertices", "mesh_and_factor", "solve", "solve_and_backward")
    head = (
        "| vertices | mesh, operators and factor | solve | solve and backward |\n|---|---|---|---|"
    )
    body = (
        "| " + " | ".join(f"{row[column]:.3g}" for column in columns[1:]) + " |" for row in rows
    )
    return "\n".join(
        [head, *(f"| {r['vertices']:,} {line}" for r, line in zip(rows, body, strict=True))]
    )


def mutations() -> str:
    """Mutants of each file: how many there are, how many were run, and what came of them."""
    result = json.loads((RESULTS / "mutations.json").read_text())
    population = result["population"]
    counts = Counter((mutant["file"], mutant["outcome"]) for mutant in result["mutants"])
    rows = []
    for file, total in population.items():
        survived = counts[file, "survived"]
        killed = counts[file, "killed"] + counts[file, "hung"]
        rows.append((f"`{file}.py`", total, killed + survived, killed, survived))
    rows.append(("all", *(sum(column) for column in list(zip(*rows, strict=True))[1:])))
    head = "| file | mutants | run | killed | survived |\n|---|---|---|---|---|"
    return "\n".join([head, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


TABLES = {
    "uv_train": uv_train,
    "transforms": transforms,
    "poisson_cost": poisson_cost,
    "mutations": mutations,
}


def number(value: float | None) -> str:
    """Three significant digits; JSON's null stands for infinity."""
    return "∞" if value is None else f"{value:.3g}"


def updated(text: str) -> str:
    """The text with each of its tables made anew."""

    def table(match: re.Match[str]) -> str:
        return f"<!-- table:{match[1]} -->\n{TABLES[match[1]]()}\n<!-- end -->"

    return re.sub(r"<!-- table:(\w+) -->\n.*?<!-- end -->", table, text, flags=re.DOTALL)


def main() -> bool:
    """Update every page; true if `--check` found one to be stale."""
    stale = []
    for path in (DOCS.parent / "README.md", *sorted(DOCS.glob("*.md"))):
        text = path.read_text()
        if (new := updated(text)) != text:
            stale.append(path.name)
            if "--check" not in sys.argv:
                path.write_text(new)
    print("changed: " + (", ".join(stale) or "nothing"))
    return bool(stale) and "--check" in sys.argv


if __name__ == "__main__":
    sys.exit(main())
