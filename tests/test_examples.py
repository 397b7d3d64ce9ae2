"""Each example runs, at its smallest size, and its numbers are asserted on."""

from __future__ import annotations

import csv
import json
import re
import runpy
from pathlib import Path

import pytest
import torch
import trimesh

import diffpoisson as dp
from njf_models.datasets.bodies import BodyStore
from njf_models.datasets.seen_poses import build_seen_poses
from njf_models.meshfiles import read_mesh_file
from njf_models.repose_network import ReposeNetwork
from njf_models.uv_network import UVNetwork
from tests import meshes
from tests.njf_models.shapes import bumpy_disk

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("network", [[], ["--paper"]])
def test_uv_train(tmp_path, monkeypatch, network):
    monkeypatch.setenv("DIFFPOISSON_CACHE", str(tmp_path / "cache"))
    main = runpy.run_path(str(ROOT / "examples" / "uv_train.py"))["main"]
    options = ["--csg", "4", "--patches", "3", "--faces", "150", "500", "--minutes", "0.2"]
    out = tmp_path / "run"
    table = main([*options, *network, "--out", str(out)])
    (log,) = (out / "csv").glob("*/metrics.csv")
    with log.open() as file:
        rows = list(csv.DictReader(file))
    assert len([row for row in rows if row["validation/loss"]]) == 10
    if network:
        assert table["trained"]["loss"] < table["untrained"]["loss"]
    else:  # what is held back are a few easy patches, which need no training of ours
        epochs = [float(loss) for row in rows if (loss := row["train/loss"])]
        assert epochs[-1] < 0.9 * epochs[0]
    results = json.loads((out / "results.json").read_text())
    assert len(results["patches"]) == table["trained"]["patches"]
    splits = [set(results["splits"][name]) for name in ("train", "validation", "test")]
    assert sum(map(len, splits)) == len(set.union(*splits))  # no mesh on two sides
    assert (out / "results.png").stat().st_size > 100_000
    steps = json.loads((out / "steps.json").read_text())
    assert torch.load(out / "checkpoints" / "last.ckpt", weights_only=False)["global_step"] == steps
    uv = UVNetwork.load(out / "uv.safetensors").predict(bumpy_disk(0, 14))
    assert uv.isfinite().all()


SIZES = ["--bodies", "3", "--poses", "4", "--held-out", "2", "--faces", "600"]
SIZES += ["--code-size", "16", "--points", "32", "--energies", "0", "--targets", "4"]


@pytest.fixture(scope="module", name="bodies_run")
def re_posing(tmp_path_factory):
    """A folder of `body_maps.py`, trained for seconds, and its table."""
    folder = tmp_path_factory.mktemp("repose")
    main = runpy.run_path(str(ROOT / "examples" / "body_maps.py"))["main"]
    steps = ["--steps", "60", "--per-step", "2", "--cells", "60"]
    return folder, main([*SIZES, *steps, "--out", str(folder)])


@pytest.mark.slow
def test_bodies(bodies_run):
    """Models learn, on bodies that are nowhere twice."""
    folder, table = bodies_run
    results = json.loads((folder / "results.json").read_text())
    assert results["summary"] == table
    assert sum(results["training"]["ours"]["steps"].values()) == 60
    assert set(results["training"]["cages"]["steps"]) == {"whole"}
    for name in ("ours", "displacement", "cages"):
        assert table[name]["maps"] == 2 * 4
        assert table[name]["L2-V"] < 1.2 * table["untrained"]["L2-V"]
        assert results["training"][name]["cpu seconds"] > 0
    kept = [BodyStore(folder / "bodies" / name) for name in ("train", "validation", "test")]
    phenotypes = [tuple(body.phenotype.tolist()) for store in kept for body in store]
    assert len(set(phenotypes)) == 3 + 2 + 2
    assert (folder / "results.png").stat().st_size > 50_000


@pytest.fixture(scope="module", name="pose_run")
def poses_read_off_bodies(tmp_path_factory):
    """A folder of `body_pose.py`, trained for seconds, and its mean errors."""
    folder = tmp_path_factory.mktemp("pose")
    main = runpy.run_path(str(ROOT / "examples" / "body_pose.py"))["main"]
    sizes = ["--files", "3", "--faces", "600", "--basis", "32", "--steps", "150"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("njf_models.datasets.seen_poses.PER_FILE", 80)
        degrees = main([*sizes, "--per-step", "40", "--out", str(folder)])
        assert main([*sizes, "--per-step", "40", "--out", str(folder)]) == degrees  # done already
    return folder, degrees


@pytest.mark.slow
def test_poses_are_read_off_bodies(pose_run):
    folder, degrees = pose_run
    results = json.loads((folder / "results.json").read_text())
    assert results["bodies"] == {"train": 240, "validation": 80, "test": 80}
    assert results["degrees"]["mean"] == degrees["mean"]
    seen = build_seen_poses(folder / "seen" / "test", 1, n_basis=32, n_faces=600, seed=12)
    at_rest = torch.linalg.vector_norm(seen.poses.unflatten(-1, (-1, 3)), dim=-1)
    assert 0 < degrees["mean"] < 0.95 * float(torch.rad2deg(at_rest).mean())
    assert len(results["degrees"]["joints"]) == 20
    assert (folder / "results.png").stat().st_size > 20_000


def test_options_of_bodies_that_contradict_each_other(capsys, tmp_path):
    parse = runpy.run_path(str(ROOT / "examples" / "body_maps.py"))["parse"]
    for options, words in (
        (["--pose", str(tmp_path), "--basis-at", "body"], "--pose reads poses off"),
        (["--also", "900", "--after", str(tmp_path)], "not --after others"),
    ):
        with pytest.raises(SystemExit):
            parse(options)
        assert words in capsys.readouterr().err


@pytest.mark.slow
def test_tasks_of_bodies(bodies_run, pose_run, tmp_path):
    """The other tasks, two of them by a chain of networks; two that read poses off shapes."""
    main = runpy.run_path(str(ROOT / "examples" / "body_maps.py"))["main"]
    data = bodies_run[0] / "bodies"
    spent = {}
    for task, per_source in (("unpose", 1), ("any-pose", 3), ("registration", 3), ("morphing", 4)):
        out = tmp_path / task
        common = [*SIZES, "--steps", "20", "--sources", "2", "--models", "njf"]
        common += ["--validations", "2"]
        common += ["--init", str(bodies_run[0])] if task == "any-pose" else []
        if task in ("any-pose", "morphing"):
            common += ["--after", str(tmp_path / "unpose"), "--whole", "0"]
        if task in ("unpose", "morphing"):
            common += ["--pose", str(pose_run[0])]
        table = main([*common, "--task", task, "--out", str(out), "--data", str(data)])
        assert table["ours"]["maps"] == 2 * 2 * per_source
        assert 0 < table["ours"]["L2-V"] < 1.2 * table["untrained"]["L2-V"]
        assert (out / "results.png").stat().st_size > 50_000
        spent[task] = json.loads((out / "results.json").read_text())["training"]["ours"]
    assert spent["morphing"]["earlier, cpu seconds"] == spent["unpose"]["cpu seconds"]
    assert spent["any-pose"]["earlier, cpu seconds"] > spent["unpose"]["cpu seconds"]
    far = runpy.run_path(str(ROOT / "examples" / "far_body.py"))["main"]
    runs = ["--run", str(tmp_path / "any-pose"), "--after", str(tmp_path / "unpose")]
    table = far([*runs, "--data", str(data), "--out", str(tmp_path / "far"), "--poses", "2"])
    assert all(0 < row["L2-V"] < 60 for row in table.values())


@pytest.mark.slow
def test_bodies_on_other_meshes_and_other_bodies(bodies_run, tmp_path):
    folder, _ = bodies_run
    main = runpy.run_path(str(ROOT / "examples" / "triangulations.py"))["main"]
    deviations = main(["--run", str(folder), "--bodies", "1", "--poses", "2"])["ours"]
    assert deviations["trained on"].deviation < 1e-6
    assert deviations["original"].n_faces == 26692
    for name in ("original", "Loop-subdivided", "four times as many"):
        assert 0 < deviations[name].share < 0.2

    # Bodies unlike those of training, by the same network.
    main = runpy.run_path(str(ROOT / "examples" / "far_body.py"))["main"]
    out = tmp_path / "far"
    common = ["--run", str(folder), "--out", str(out), "--poses", "2"]
    table = main(common)
    assert set(table) == {"a test body", "a child", "a tall body", "very heavy"}
    assert all(row["maps"] == 2 and 0 < row["L2-V"] < 60 for row in table.values())
    assert json.loads((out / "far.json").read_text()) == table
    # A file whose y is up, twice as large, is the same character as the test body it was made from.
    body = BodyStore(folder / "bodies" / "test")[0]
    x, y, z = 2 * body.rest.double().T
    lines = [f"v {a} {b} {c}" for a, b, c in torch.stack([x, z, -y], 1).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (body.faces + 1).tolist()]
    (tmp_path / "own.obj").write_text("\n".join(lines))
    height = float(z.max() - z.min()) / 2
    main([*common, "--mesh", str(tmp_path / "own.obj"), "--y-up", "--height", str(height)])
    network = ReposeNetwork.from_checkpoint(folder / "njf" / "checkpoints" / "best.ckpt")
    expected = network.repose(dp.Mesh(body.rest.double(), body.faces), body.poses[:1])[0]
    x, y, z = torch.from_numpy(read_mesh_file(out / "far.obj").vertices).T / 2
    written = torch.stack([x, -z, y], dim=1)
    assert torch.cdist(written, expected).amin(1).max() < 1e-3


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


@pytest.mark.slow
def test_arap(tmp_path):
    """All models train, though too little to do well; the solver is timed, and converges."""
    main = runpy.run_path(str(ROOT / "examples" / "arap.py"))["main"]
    sizes = ["--edge", "0.2", "--maps", "16", "--held-out", "3", "--timed", "1", "--rank", "12"]
    models = ["--models", "modal", "global", "pinned"]
    table = main([*sizes, *models, "--minutes", "0.05", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["summary"] == table
    for name in ("ours", "global MLP", "global MLP, trained pinned"):
        assert table[name]["maps"] == 3
        assert table[name]["L2-J"] < 1.2 * table["untrained"]["L2-J"]
        assert table[name]["L2-J"] != table["untrained"]["L2-J"]
        assert results["training"][name]["cpu seconds"] > 0
        assert results["spread"][name]["L2-V"] == 0  # of one seed
    free, pinned = (table[f"global MLP{of}"] for of in ("", ", pinned"))
    assert pinned["L2-J"] == free["L2-J"]  # that before the solve
    assert pinned["L2-V"] < free["L2-V"]
    assert table["ours, one round"]["L2-V"] != table["ours"]["L2-V"]
    solver = results["solver"]
    assert solver["largest residual"] <= 1e-6
    assert solver["iterations accelerated, mean"] < solver["iterations as it comes, mean"]
    assert (tmp_path / "results.png").stat().st_size > 50_000


@pytest.mark.slow
def test_contact(tmp_path):
    """Both models come nearer to states of unseen trajectories than the block at rest is."""
    main = runpy.run_path(str(ROOT / "examples" / "contact.py"))["main"]
    sizes = ["--columns", "12", "--trajectories", "6", "--held-out", "3", "--minutes", "0.05"]
    table = main([*sizes, "--seeds", "3", "4", "--rank", "8", "--out", str(tmp_path)])
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["summary"] == table
    assert all(results["spread"][name]["L2-V"] > 0 for name in ("ours", "offsets"))
    for name in ("ours", "offsets"):
        assert table[name]["maps"] == 12
        assert table[name]["L2-V"] < table["untrained"]["L2-V"]
        assert table[name]["L2-V after the steps"] < table["untrained"]["L2-V after the steps"]
    assert (tmp_path / "results.png").stat().st_size > 50_000


def test_deform(tmp_path):
    """By Jacobians the same loss leads nearer to the map that made the cloud, and smoothly."""
    main = runpy.run_path(str(ROOT / "examples" / "deform.py"))["main"]
    size = ["--edge", "0.4", "--steps", "30", "--points", "300"]
    results = main([*size, "--out", str(tmp_path)])
    start, ours, theirs = (results[name] for name in ("start", "by Jacobians", "by vertices"))
    assert ours["distance of the cloud"] < 0.5 * start["distance of the cloud"]
    assert ours["error of vertices"] < 0.8 * theirs["error of vertices"]
    assert ours["angle of normals"] < 0.5 * theirs["angle of normals"]
    assert (tmp_path / "deform.png").stat().st_size > 20_000


def test_tables_are_those_of_the_results():
    script = runpy.run_path(str(ROOT / "docs" / "update_tables.py"))
    at_the_root = (ROOT / "README.md", ROOT / "CONTRIBUTING.md")
    pages = [path.read_text() for path in (*at_the_root, *(ROOT / "docs").glob("*.md"))]
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
