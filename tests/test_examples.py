"""Each example runs, at its smallest size, and its numbers are asserted on."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest
import torch
import trimesh

from njf_models.datasets.bodies import BodyStore
from tests import meshes

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


@pytest.mark.slow
def test_repose_and_triangulations(tmp_path):
    """Both models learn, on bodies that are nowhere twice; then their maps on other meshes."""
    main = runpy.run_path(str(ROOT / "examples" / "repose.py"))["main"]
    sizes = ["--bodies", "3", "--poses", "4", "--held-out", "2", "--faces", "600"]
    model = ["--code-size", "16", "--points", "32", "--energies", "0", "--targets", "4"]
    table = main([*sizes, *model, "--steps", "60", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["summary"] == table
    assert results["training"]["ours"]["steps"] == 60
    for name in ("ours", "displacement", "cages"):
        assert table[name]["maps"] == 2 * 4
        assert table[name]["L2-V"] < 1.2 * table["untrained"]["L2-V"]
        assert results["training"][name]["cpu seconds"] > 0
    kept = {name: BodyStore(tmp_path / "bodies" / name) for name in ("train", "validation", "test")}
    phenotypes = [tuple(body.phenotype.tolist()) for store in kept.values() for body in store]
    assert len(set(phenotypes)) == 3 + 2 + 2
    assert (tmp_path / "results.png").stat().st_size > 50_000

    main = runpy.run_path(str(ROOT / "examples" / "triangulations.py"))["main"]
    deviations = main(["--run", str(tmp_path), "--bodies", "1", "--poses", "2"])["ours"]
    assert deviations["trained on"].deviation < 1e-6
    assert deviations["original"].n_faces == 26692
    for name in ("original", "Loop-subdivided", "four times as many"):
        assert 0 < deviations[name].share < 0.2


def test_fit_source(tmp_path):
    """Newton's convergence: only an exact derivative by the geometry squares the error."""
    main = runpy.run_path(str(ROOT / "examples" / "fit_source.py"))["main"]
    results = main(["--edge", "0.6", "--steps", "4", "--out", str(tmp_path)])
    before, after = results["distances"][0], results["distances"][-1]
    assert 0.1 < before < 0.2
    assert after < 1e-6 * before
    assert (tmp_path / "source.png").stat().st_size > 50_000
    assert (tmp_path / "source.obj").stat().st_size > 1_000


def test_unroll(tmp_path):
    """From a ball, cut open, to its map in the plane."""
    vertices, faces = meshes.sphere(subdivisions=2)
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "ball.ply")
    main = runpy.run_path(str(ROOT / "examples" / "unroll.py"))["main"]
    options = ["--mesh", str(tmp_path / "ball.ply"), "--frames", "5", "--size", "60"]
    shapes = main([*options, "--out", str(tmp_path)])
    surface, *between, flat = shapes
    assert len(surface) > len(vertices)  # seams split them
    width = float(torch.pdist(torch.from_numpy(vertices)).max())
    assert float(torch.pdist(surface).max()) == pytest.approx(width, rel=1e-6)
    assert float(flat[:, 2].abs().max()) < 1e-9
    widths = [float(torch.pdist(shape).max()) for shape in (surface, *between, flat)]
    assert widths == sorted(widths)  # it opens all the way, and never shrinks to a heap
    assert (tmp_path / "unroll.gif").stat().st_size > 1_000


def test_texel_density(tmp_path):
    """The gradient of a loss on the map reaches the code through the solves and the network."""
    main = runpy.run_path(str(ROOT / "examples" / "texel_density.py"))["main"]
    results = main(["--size", "12", "--steps", "40", "--out", str(tmp_path)])
    assert results["ratio"][0] < 0.8
    assert results["ratio"][-1] > 1.4
    assert results["flips"][-1] == 0
    assert (tmp_path / "density.png").stat().st_size > 20_000


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
