"""Each example runs, at its smallest size, and its numbers are asserted on."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_uv_train(tmp_path, monkeypatch):
    monkeypatch.setenv("DIFFPOISSON_CACHE", str(tmp_path / "cache"))
    main = runpy.run_path(str(ROOT / "examples" / "uv_train.py"))["main"]
    options = ["--csg", "4", "--patches", "3", "--faces", "150", "500", "--minutes", "0.2"]
    table = main([*options, "--out", str(tmp_path / "run")])
    assert table["trained"]["loss"] < table["untrained"]["loss"]
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert len(results["patches"]) == table["trained"]["patches"]
    splits = [set(results["splits"][name]) for name in ("train", "validation", "test")]
    assert sum(map(len, splits)) == len(set.union(*splits))  # no mesh on two sides
    assert (tmp_path / "run" / "results.png").stat().st_size > 100_000


def test_fit_source(tmp_path):
    """Newton's convergence: only an exact derivative by the geometry squares the error."""
    main = runpy.run_path(str(ROOT / "examples" / "fit_source.py"))["main"]
    results = main(["--edge", "0.6", "--steps", "4", "--out", str(tmp_path)])
    before, after = results["distances"][0], results["distances"][-1]
    assert 0.1 < before < 0.2
    assert after < 1e-6 * before
    assert (tmp_path / "source.png").stat().st_size > 50_000
    assert (tmp_path / "source.obj").stat().st_size > 1_000


def test_refine_uv(tmp_path):
    """The gradient of a loss on the map reaches the code through the solves and the network."""
    main = runpy.run_path(str(ROOT / "examples" / "refine_uv.py"))["main"]
    results = main(["--size", "12", "--steps", "40", "--out", str(tmp_path)])
    assert results["distortion"][-1] < 0.99 * results["distortion"][0]
    assert (tmp_path / "refine.png").stat().st_size > 20_000


def test_tables_are_those_of_the_results():
    script = runpy.run_path(str(ROOT / "docs" / "update_tables.py"))
    pages = [path.read_text() for path in (ROOT / "README.md", *(ROOT / "docs").glob("*.md"))]
    for name in script["TABLES"]:
        assert any(f"<!-- table:{name} -->" in text for text in pages)
    for text in pages:
        assert script["updated"](text) == text


PAGES = [
    page
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
    if "```py" in page.read_text()
]


def run_blocks(page: Path) -> dict:
    """The blocks of a page, one after the other in one namespace, with their assertions."""
    text = page.read_text()
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert len(blocks) == text.count("```py")  # none escapes by its indentation or another name
    namespace: dict = {}
    for block in blocks:
        exec(block, namespace)
    return namespace


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_examples_of_a_page(page):
    namespace = run_blocks(page)
    if page.name == "README.md":
        assert namespace["R"].grad.isfinite().all()
        assert namespace["R"].grad.abs().max() > 0
