"""How much of the packages the tests run, from coverage's own JSON.

    pytest --cov --cov-report=json:coverage.json
    python -m tests.coverage_table coverage.json

The second keeps the counts of each file in `docs/results/coverage.json`, for CONTRIBUTING.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

RESULT = Path(__file__).parents[1] / "docs" / "results" / "coverage.json"
COUNTS = ("num_statements", "missing_lines", "num_branches", "missing_branches")


def boiled_down(measured: dict) -> dict:
    """The counts of each file, and the numbers of the lines that no test runs."""
    files = {}
    for name, file in sorted(measured["files"].items()):
        files[name] = {count: file["summary"][count] for count in COUNTS}
        files[name]["lines missed"] = file["missing_lines"]
    about = measured["meta"]
    return {"coverage": about["version"], "branches": about["branch_coverage"], "files": files}


def table(result: dict) -> str:
    """A row for each package and one for both, with shares of statements and of branches."""
    lines = [
        "| | statements | run, % | branches | taken, % | both, % |",
        "|---|---|---|---|---|---|",
    ]
    for title, prefix in (("`diffpoisson`", "diffpoisson/"), ("`njf_models`", "njf_models/")):
        lines.append(_row(title, [f for n, f in result["files"].items() if n.startswith(prefix)]))
    return "\n".join([*lines, _row("both", list(result["files"].values()))])


def _row(title: str, files: list[dict]) -> str:
    lines, missed, branches, untaken = (sum(file[count] for file in files) for count in COUNTS)
    whole = lines + branches
    shares = (1 - missed / lines, 1 - untaken / branches, 1 - (missed + untaken) / whole)
    ran, taken, both = (f"{100 * share:.1f}" for share in shares)
    return f"| {title} | {lines:,} | {ran} | {branches:,} | {taken} | {both} |"


def main(path: str) -> None:
    result = boiled_down(json.loads(Path(path).read_text()))
    RESULT.write_text(json.dumps(result, indent=1) + "\n")
    print(table(result))


if __name__ == "__main__":
    main(sys.argv[1])
