"""`python -m diffpoisson`: what it prints, and that it notices a broken layer."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata

import pytest

import diffpoisson as dp
from diffpoisson import __main__ as self_check
from diffpoisson.linear_map import LinearMap

CHECKS = list(self_check._CHECKS)


def verdicts(output: str) -> dict[str, str]:
    """What the report says of each check, on the CPU and on the GPU if there is one."""
    lines = [line for line in output.splitlines() if line.startswith("  ")]
    return {line[:44].strip(): line[44:] for line in lines}


def test_report():
    run = subprocess.run(
        [sys.executable, "-m", "diffpoisson"], capture_output=True, text=True, check=False
    )
    assert (run.returncode, run.stderr) == (0, "")
    assert verdicts(run.stdout) == dict.fromkeys(CHECKS, "ok")
    for name in ("torch", "numpy", "scipy", "cholespy", "libigl"):
        assert f"{name:<12}{metadata.version(name)}\n" in run.stdout


def by_another_scale(self, R, _call=dp.PoissonSolver.__call__, **options):
    return (1 + 1e-9) * _call(self, R, **options)


def without_derivative(self, x, _call=LinearMap.__call__):
    """Right values with zero derivatives, as of an op whose registration lacks a rule."""
    return _call(self, x.detach()) + 0 * x.sum()


def raising(*arguments, **options):
    raise RuntimeError("libigl was built for another numpy")


@pytest.mark.parametrize(
    ("target", "broken", "found"),
    [
        ("diffpoisson.PoissonSolver.__call__", by_another_scale, CHECKS[:3]),
        ("diffpoisson.linear_map.LinearMap.__call__", without_derivative, CHECKS[2:3]),
        ("diffpoisson.parameterize", raising, CHECKS[3:]),
    ],
    ids=["scale", "derivative", "libigl"],
)
def test_broken_layers_are_found(monkeypatch, capsys, target, broken, found):
    monkeypatch.setattr(target, broken)
    assert self_check.main() == 1
    outcome = verdicts(capsys.readouterr().out)
    assert [check for check in CHECKS if outcome[check].startswith("FAILED: ")] == found
    if broken is raising:
        assert "RuntimeError: libigl was built for another numpy" in outcome[found[0]]
