"""Every fault is noticed by the check that claims to: the tests are tested."""

from __future__ import annotations

import pytest

from tests.fault_table import CHECKS, FAULTS, outcome


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_noticed(name):
    fault = FAULTS[name]
    check = CHECKS[fault.noticed_by]
    with fault.injected():
        # By a failed assertion: a crash would only show that the patch is broken.
        assert outcome(check) == "✗", f"{fault.noticed_by} accepts a layer with {name}"
    assert outcome(check) == "", "the patch was not undone"


def test_every_fault_is_described():
    assert all(fault.description for fault in FAULTS.values())
