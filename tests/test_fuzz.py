"""Malformed arguments end in an error that says so, or in a right answer: see `tests/fuzz.py`."""

from __future__ import annotations

import subprocess
import sys


def test_fuzz():
    """In processes of its own, where no shape checks are installed, as in users' programs."""
    run = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", "--n", "2000", "--seed", "1"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
