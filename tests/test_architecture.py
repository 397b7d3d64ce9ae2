"""docs/architecture.md says what is: every file is listed, and arrows point down."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DRAWING = runpy.run_path(str(ROOT / "docs" / "draw_architecture.py"))
PACKAGES = list(DRAWING["PACKAGES"])


def listed(package: str) -> list[str]:
    """The files in the first column of a package's table, in their order."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    table = page.split(f"\n## `{package}`")[1].split("\n## ")[0]
    return re.findall(r"`([\w/]+?)(?:\.py)?`", " ".join(re.findall(r"^\| (.*?) \|", table, re.M)))


@pytest.mark.parametrize("package", PACKAGES)
def test_every_file_is_listed(package):
    assert sorted(set(listed(package)) - {"__main__"}) == sorted(DRAWING["modules"](package))


def test_the_core_imports_only_what_is_above():
    order = listed("diffpoisson")
    for name, needs in DRAWING["imports"]("diffpoisson").items():
        assert all(order.index(need) < order.index(name) for need in needs), name
    assert not DRAWING["imports"]("diffpoisson")["cells"]
    assert "factor" in DRAWING["imports"]("diffpoisson")["poisson"]  # so it does see imports


def test_the_core_knows_no_network():
    for path in (ROOT / "diffpoisson").glob("*.py"):
        assert not re.search(r"^\s*(import|from) njf_models", path.read_text(), re.M), path.name


def test_picture():
    """Also that no modules import each other in a circle, of which there is no picture."""
    assert DRAWING["PICTURE"].read_text() == DRAWING["picture"]()
