"""Constraints, derivatives by the geometry, and tetrahedra: `constraint_checks.py`, and errors."""

from __future__ import annotations

import pytest

from tests import constraint_checks


@pytest.mark.parametrize("check", constraint_checks.CHECKS.values(), ids=constraint_checks.CHECKS)
def test_property(check):
    check()
