"""What every test runs under: shape checks, seeds, hypothesis profile, the one tolerance table."""

from __future__ import annotations

import os
import random
from collections.abc import Callable

import hypothesis
import jaxtyping
import numpy as np
import pytest
import torch

# Checks shapes and dtypes at run time in modules imported from here on, so before any test module.
jaxtyping.install_import_hook(["diffpoisson", "njf_models"], "beartype.beartype")

hypothesis.settings.register_profile("local", deadline=None, max_examples=25)
hypothesis.settings.register_profile(
    "ci", deadline=None, max_examples=25, derandomize=True, print_blob=True
)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")

# Bounds on |actual - expected| <= atol + rtol * |expected|, for quantities of order one.
TOLERANCES = {
    # Closed forms per face or vertex: a few hundred roundings.
    "local": {torch.float64: 1e-12, torch.float32: 1e-5},
    # Through a sparse solve: roundings times the condition number, which grows like n.
    "solve": {torch.float64: 1e-9, torch.float32: 1e-4},
}


@pytest.fixture(scope="session")
def tol() -> Callable[..., dict[str, float]]:
    """`assert_close(actual, expected, **tol(actual.dtype))`; `tol(dtype, "solve")` past a solve."""

    def tolerance(dtype: torch.dtype, kind: str = "local") -> dict[str, float]:
        bound = TOLERANCES[kind][dtype]
        return {"rtol": bound, "atol": bound}

    return tolerance


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shape checks off: for errors as users see them, and for `torch.compile`."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


@pytest.fixture(autouse=True)
def _seeded() -> None:
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - third parties still draw from numpy's global state
    torch.manual_seed(0)
