"""The reasons for surviving mutants speak of mutants that survive."""

from __future__ import annotations

import json
from pathlib import Path

from tests.mutation import named, verdicts

RESULT = Path(__file__).parents[1] / "docs" / "results" / "mutations.json"


def test_every_verdict_is_of_a_survivor() -> None:
    records = json.loads(RESULT.read_text())["mutants"]
    survivors = {(r["file"], named(r)) for r in records if r["outcome"] == "survived"}
    argued = {(file, name) for file, names in verdicts().items() for name in names}
    assert argued <= survivors
