"""Maps found step by step: every property of `map_checks.py`."""

from __future__ import annotations

import pytest

from tests import map_checks


@pytest.mark.parametrize("check", map_checks.CHECKS.values(), ids=map_checks.CHECKS)
def test_property(check):
    check()
