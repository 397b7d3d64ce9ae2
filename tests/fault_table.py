"""Which check notices which fault: `python -m tests.fault_table` writes `docs/faults.md`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests import (
    checks,
    constraint_checks,
    constraint_faults,
    faults,
    map_checks,
    map_faults,
)

CHECKS = checks.CHECKS | constraint_checks.CHECKS | map_checks.CHECKS
FAULTS = faults.FAULTS | constraint_faults.FAULTS | map_faults.FAULTS


def outcome(check: Callable[[], None]) -> str:
    """What a check says: nothing, ✗ for a failed assertion, ! for a crash."""
    try:
        check()
    except AssertionError:
        return "✗"
    except Exception:
        return "!"
    return ""


def table() -> str:
    """A row for each fault, with the numbers of the checks that notice, in Markdown."""
    assert not any(outcome(check) for check in CHECKS.values())
    rows = {}
    for name, fault in FAULTS.items():
        with fault.injected():
            rows[name] = [outcome(check) for check in CHECKS.values()]
    noticed = {
        name: sum(map(bool, column))
        for name, column in zip(CHECKS, zip(*rows.values(), strict=True), strict=True)
    }
    assert min(noticed.values()) > 0
    lines = [
        "# What the tests would notice",
        "",
        f"{len(FAULTS)} mistakes, put one at a time into the real package (`tests/faults.py`,",
        "`tests/constraint_faults.py`, `tests/map_faults.py`), against",
        f"{len(CHECKS)} checks (`tests/checks.py`, `tests/constraint_checks.py`,",
        "`tests/map_checks.py`). Every mistake is noticed, and every check notices some.",
        "The customary round trip through the layer's own gradient (check 4) notices",
        f"{noticed['round_trip']}.",
        "",
        "Written by `python -m tests.fault_table`; `tests/test_faults.py` asserts for each mistake",
        "that a named check fails.",
        "",
        "## Checks, and how many mistakes each notices",
        "",
        *(f"{i}. {_words(name)}: {noticed[name]}" for i, name in enumerate(CHECKS, 1)),
        "",
        "## Mistakes, and which checks notice",
        "",
        "A `!` marks a check that crashes instead of failing.",
        "",
        "| Mistake | | Noticed by |",
        "|---|---|---|",
    ]
    for name, row in rows.items():
        description = FAULTS[name].description.replace("\n", " ")
        by = [f"{i}{'!' * (said == '!')}" for i, said in enumerate(row, 1) if said]
        lines.append(f"| {_words(name)} | {description} | {', '.join(by)} |")
    return "\n".join(lines) + "\n"


def _words(name: str) -> str:
    return name.replace("_", " ")


if __name__ == "__main__":
    page = Path(__file__).parents[1] / "docs" / "faults.md"
    page.write_text(table(), encoding="utf-8")
