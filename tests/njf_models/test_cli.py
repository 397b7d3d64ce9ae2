"""The command line as users meet it: output, exit codes, errors of one line."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh

import diffpoisson as dp
from njf_models.cli import main
from njf_models.commands import how_to_install, info, uv
from njf_models.meshfiles import read_mesh_file
from tests import meshes

ROOT = Path(__file__).parents[2]
PNG = b"\x89PNG\r\n\x1a\n" + bytes(64)


def save(path: Path, arrays: meshes.Arrays) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(*arrays, process=False).export(path)
    return path


@pytest.fixture
def disk(tmp_path: Path) -> Path:
    return save(tmp_path / "in" / "disk.obj", meshes.disk(0, 6))


def tutte(*arguments: object) -> int:
    return main(["uv", *map(str, arguments), "--start", "tutte"])


def usage_error(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The last line on stderr of a call that is refused with exit code 2."""
    try:
        code = main(list(map(str, arguments)))
    except SystemExit as exit_:  # argparse's own
        code = exit_.code  # type: ignore[assignment]
    assert code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    return printed.err.strip().split("\n")[-1]


# ------------------------------------------------------- help


def test_help_lists_the_commands(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["--help"])
    assert exit_.value.code == 0
    text = capsys.readouterr().out
    assert re.search(r"^ +uv +give meshes UVs$", text, re.MULTILINE)
    assert "exit codes: 0 all went well" in text


@pytest.mark.parametrize("command", ["uv", "info", "repose"])
def test_help_of_a_command_has_examples_that_parse(command, capsys):
    from njf_models.cli import parser

    with pytest.raises(SystemExit):
        main([command, "--help"])
    examples = re.findall(r"^  njf (.*?)(?:   .*)?$", capsys.readouterr().out, re.MULTILINE)
    assert len(examples) >= 3
    for example in examples:
        assert parser().parse_args(example.split()).command == command


@pytest.mark.parametrize(
    ("command", "page", "count"),
    [("uv", "cli.md", 6), ("repose", "cli.md", 9), ("data", "data.md", 3)],
)
def test_the_page_of_the_docs_agrees_with_the_parser(command, page, count):
    """Its examples parse, and it knows every option."""
    from njf_models.cli import parser

    text = (ROOT / "docs" / page).read_text()
    examples = re.findall(r"^\$ njf (.*)$", text, re.MULTILINE)
    assert len(examples) >= count
    for example in examples:
        assert parser().parse_args(example.split()).command == example.split()[0]
    commands = parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    options = {o for action in commands[command]._actions for o in action.option_strings}  # type: ignore[index]
    for option in options - {"-h", "--help", "--debug"}:
        assert f"`{option}" in text


def test_help_does_not_wait_for_torch():
    program = (
        "import sys; from njf_models.cli import parser; parser().format_help();"
        "print([m for m in ('torch', 'trimesh', 'igl', 'numpy') if m in sys.modules])"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert run.stdout == "[]\n"


def test_version(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert re.fullmatch(r"njf \d+\.\d+\.\d+\n", capsys.readouterr().out)


# ------------------------------------------------------- usage


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND"),
        (["unwrap"], "invalid choice: 'unwrap'"),
        (["uv"], "the following arguments are required: INPUT"),
        (["uv", "a.obj", "b.fbx"], "njf uv: b.fbx: only .glb and .obj files are written"),
        (["uv", "a.obj", "a.obj"], "a.obj is both input and output"),
        (["uv", "a.obj", "."], "a.obj is both input and output"),
        (["uv", "a.obj", "b.ply", "."], "a.obj is both input and output"),
        (["uv", "a.obj", "out"], "out: only .glb and .obj files are written"),
        (["uv", "a.obj", "b.obj", "--report", "."], ". is a folder, but the input is a file"),
        (["uv", "a.obj", "b.obj", "c.obj"], "c.obj is a file, but there are several inputs"),
        (["uv", "a.obj", "b.obj", "LICENSE"], "LICENSE is a file, but there are several inputs"),
        (["uv", "a.obj", "b.obj", "o", "--report", "p.html"], "p.html is a file, but there are"),
        (["uv", "a.obj", "docs", "out"], "docs is a folder, but there are several inputs"),
        (["uv", ".", "pyproject.toml"], "pyproject.toml is a file, but the input is a folder"),
        (["uv", ".", "."], "input and output are the same folder"),
        (["uv", "a.obj", "--tolerance", "0"], "0 is not a positive number"),
        (["uv", "a.obj", "--tolerance", "nan"], "nan is not a positive number"),
        (["uv", "a.obj", "--tolerance", "x"], "x is not a positive number"),
        (["uv", ".", "out", "--jobs", "0"], "0 is not a positive whole number"),
    ],
)
def test_wrong_usage(arguments, message, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert message in usage_error(capsys, *arguments)


def test_debug_shows_where(tmp_path, monkeypatch):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("inside")

    monkeypatch.setattr(uv, "_convert", broken)
    with pytest.raises(ZeroDivisionError, match="inside"):
        tutte(tmp_path / "a.obj", "--debug")


def test_a_fault_of_ours_is_one_line_too(tmp_path, monkeypatch, capsys):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("inside\nof it")

    monkeypatch.setattr(uv, "_convert", broken)
    assert tutte(tmp_path / "a.obj") == 1
    assert (
        capsys.readouterr().err == f"njf uv: {tmp_path}/a.obj: inside of it (ZeroDivisionError)\n"
    )


# ------------------------------------------------------- one file


def test_a_missing_extra_is_named(disk, monkeypatch, capsys):
    def broken(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'trimesh'", name="trimesh")

    monkeypatch.setattr(info, "mesh_facts", broken)
    monkeypatch.setattr(uv, "_convert", broken)
    remedy = "trimesh is not installed: pip install 'diffpoisson[uv]'\n"
    assert main(["info", str(disk)]) == main(["uv", str(disk)]) == 1
    assert capsys.readouterr().err == f"njf info: {remedy}njf uv: {disk}: {remedy}"


@pytest.mark.parametrize("extra", ["uv", "view", "train"])
def test_extras_are_as_the_package_declares_them(extra):
    """Each of its packages is looked for in it; one of nobody's is asked for by its name."""
    text = (ROOT / "pyproject.toml").read_text()
    declared = tomllib.loads(text)["project"]["optional-dependencies"][extra]
    names = {re.split(r"[^\w-]", line)[0].replace("pillow", "PIL") for line in declared}
    for name in names - {"diffpoisson"}:
        remedy = how_to_install(ModuleNotFoundError(name=f"{name}.part"))
        assert remedy == f"{name} is not installed: pip install 'diffpoisson[{extra}]'"
    assert how_to_install(ModuleNotFoundError(name="ray")).endswith(": pip install ray")


def test_a_reader_who_leaves_is_no_error(disk):
    """As `njf info FILE | head -0` does."""
    command = [sys.executable, "-m", "njf_models.cli", "info", str(disk)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    process.stdout.close()
    assert (process.stderr.read(), process.wait(timeout=120)) == ("", 1)
    process.stderr.close()


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_one_file(disk, tmp_path, capsys, suffix):
    output = tmp_path / "new" / f"out{suffix}"
    assert tutte(disk, output) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert re.fullmatch(
        r"disk\.obj +50 triangles +1 chart +distortion 1\.\d+ mean, \d\.\d+ max +0 flipped +"
        r"certified +\d+\.\d s\n",
        printed.out,
    )
    mesh = trimesh.load_mesh(output, process=False)
    file = read_mesh_file(disk)
    assert len(mesh.faces) == len(file.faces)
    # The same energy from the file alone, up to the scale that fills the square.
    flat = np.asarray(mesh.visual.uv) / np.ptp(mesh.visual.uv, axis=0).max()
    surface = dp.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    expected = dp.parameterize(surface)
    scale = float(np.ptp(expected.uv.numpy(), axis=0).max())
    J = dp.jacobians(surface, torch_double(flat * scale))
    energy = float(surface.areas @ dp.symmetric_dirichlet(J) / surface.areas.sum())
    assert energy == pytest.approx(expected.energy, rel=1e-4)


def torch_double(values: np.ndarray) -> dp.mesh.Tensor:
    import torch

    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))


def test_a_closed_mesh_is_cut_in_its_uvs_only(tmp_path, capsys):
    """Two components: vertices and quads of the OBJ as they were, more UVs than vertices."""
    ball, disk = meshes.sphere(), meshes.disk(0, 5)
    both = meshes.union(ball, disk)
    lines = ["v {} {} {}".format(*v) for v in both[0].tolist()]
    lines += ["f {} {} {}".format(*(f + 1)) for f in both[1]]
    source, output = tmp_path / "two.obj", tmp_path / "out.obj"
    source.write_text("\n".join(lines))
    assert tutte(source, output) == 0
    assert re.search(r"[2-9] charts .* 0 flipped  certified", capsys.readouterr().out)
    written = output.read_text().split("\n")
    assert [line for line in written if line.startswith("v ")] == lines[: len(both[0])]
    corners = [line.split()[1:] for line in written if line.startswith("f ")]
    vertex, texcoord = np.array([[word.split("/") for word in f] for f in corners], dtype=int).T
    np.testing.assert_array_equal(vertex.T, both[1] + 1)
    pairs = np.unique(np.stack([vertex.ravel(), texcoord.ravel()]), axis=1)
    count = np.bincount(pairs[0])[1:]
    assert (count[: len(ball[0])] > 1).any()  # seams
    assert len({*pairs[1]}) == len(pairs[1])  # no UV is shared between vertices


def test_quads_that_seams_cross_are_counted(tmp_path, capsys):
    box = (
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
        "f 1 4 3 2\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
    )
    (tmp_path / "box.obj").write_text(box)
    assert tutte(tmp_path / "box.obj", tmp_path / "out.obj") == 0
    faces = [x for x in (tmp_path / "out.obj").read_text().split("\n") if x.startswith("f ")]
    crossed = sum(len(face.split()) == 4 for face in faces) // 2
    assert crossed + sum(len(face.split()) == 5 for face in faces) == 6
    note = f"{crossed} polygons that seams cross were written as triangles"
    assert (note in capsys.readouterr().out) == (crossed > 0)


def test_json_to_stdout_is_all_there_is(disk, capsys):
    assert tutte(disk, "--json", "-") == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["failed"] == 0
    (record,) = result["files"]
    expected = dp.parameterize(dp.Mesh(*meshes.disk(0, 6)))
    assert record["status"] == "ok"
    assert (record["vertices"], record["triangles"], record["charts"]) == (36, 50, 1)
    assert record["energy"] == pytest.approx(expected.energy, rel=1e-5)
    assert record["certified"] is True
    assert record["flipped"] == 0
    assert set(record["milliseconds"]) >= {"tutte", "slim"}
    assert "output" not in record
    assert "disk.obj" in printed.err  # the line for people goes elsewhere


def test_json_to_a_file(disk, tmp_path):
    assert tutte(disk, tmp_path / "out.obj", "--json", tmp_path / "facts.json") == 0
    (record,) = json.loads((tmp_path / "facts.json").read_text())["files"]
    assert record["files"] == ["out.obj"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["facts.json", "in", "out.obj"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.obj", None, "no such file"),
        ("empty.obj", b"", "the file is empty"),
        ("picture.obj", PNG, "this is a PNG picture, not a mesh"),
        ("points.obj", b"v 0 0 0\n", "no triangles in it, only 1 point"),
    ],
)
def test_a_bad_file_is_one_line(tmp_path, capsys, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert tutte(tmp_path / name, tmp_path / "out.obj") == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == f"njf uv: {tmp_path / name}: {message}\n"
    assert not (tmp_path / "out.obj").exists()


def test_no_cut_says_what_the_mesh_is(tmp_path, capsys):
    path = save(tmp_path / "ball.ply", meshes.sphere())
    assert tutte(path, "--no-cut") == 1
    assert "0 boundary loops and genus 0" in capsys.readouterr().err


def test_a_place_that_cannot_be_written(disk, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert tutte(disk, tmp_path / "file" / "out.obj") == 1
    error = capsys.readouterr().err
    assert error.startswith(f"njf uv: {disk}: ")
    assert error.count("\n") == 1


def test_a_place_for_json_that_cannot_be_written(disk, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for command in ("uv", "info"):
        start = ["--start", "tutte"] if command == "uv" else []
        assert main([command, str(disk), "--json", str(tmp_path / "file" / "a.json"), *start]) == 1
        (line,) = capsys.readouterr().err.strip().split("\n")
        assert line.startswith(f"njf {command}: {tmp_path}/file/a.json: ")


def test_the_network_is_the_default(disk, monkeypatch, capsys):
    import njf_models

    calls = []

    def parameterize(mesh: dp.Mesh, **options: object) -> dp.UVMap:
        calls.append(options)
        return dp.parameterize(mesh)

    monkeypatch.setattr(njf_models, "parameterize", parameterize, raising=False)
    assert main(["uv", str(disk)]) == 0
    assert main(["uv", str(disk), "--no-cut", "--tolerance", "1e-3"]) == 0
    uv = {"model": "uv"}
    expected = [{"cut": True, "tolerance": 1e-6}, {"cut": False, "tolerance": 1e-3}]
    assert calls == [uv | options for options in expected]


# ------------------------------------------------------- folders


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two good files and three bad ones, in a folder and one below it."""
    root = tmp_path / "in"
    save(root / "a.obj", meshes.disk(0, 5))
    save(root / "deep" / "b.stl", meshes.disk(1, 5))
    (root / "empty.ply").write_bytes(b"")
    (root / "picture.obj").write_bytes(PNG)
    (root / "readme.txt").write_text("no mesh")
    save(root / "a.off", meshes.disk(2, 5))
    return root


def test_a_folder_survives_bad_files(folder, tmp_path, capsys):
    out = tmp_path / "out"
    code = tutte(folder, out, "--recursive", "--jobs", "2", "--json", tmp_path / "all.json")
    printed = capsys.readouterr()
    assert code == 1
    lines = printed.out.strip().split("\n")
    assert lines[-1] == "5 files: 2 mapped, 3 failed"
    names = [line.split()[0] for line in lines[:-1]]
    assert names == ["a.obj", "a.off", "deep/b.stl", "empty.ply", "picture.obj"]
    assert sorted(p.relative_to(out).as_posix() for p in out.rglob("*.*")) == [
        "a.obj",
        "deep/b.obj",
    ]
    errors = [line for line in printed.err.split("\n") if line.startswith("njf uv: ")]
    assert len(errors) == 3
    assert "Traceback" not in printed.err
    result = json.loads((tmp_path / "all.json").read_text())
    failed = {Path(r["input"]).name: r["error"] for r in result["files"] if r["status"] != "ok"}
    assert set(failed) == {"a.off", "empty.ply", "picture.obj"}
    assert result["failed"] == 3
    assert f"is what {folder}/a.obj becomes" in failed["a.off"]


def test_a_folder_without_meshes(tmp_path, capsys):
    assert tutte(tmp_path, tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert re.fullmatch(r"njf uv: no .* file in .*; --recursive looks into subfolders\n", error)


def test_own_output_is_not_input(folder):
    options = ["--recursive", "--start", "tutte"]
    from njf_models.cli import parser

    parsed = parser().parse_args(["uv", str(folder), str(folder / "deep"), *options])
    tasks = uv._tasks_of_batch(parsed, [folder], folder / "deep")
    assert {task.input.name for task in tasks} == {*("a.obj", "a.off", "empty.ply", "picture.obj")}


def test_pages_of_equal_names_are_not_overwritten(tmp_path, capsys):
    for name in ("a.obj", "a.off"):
        save(tmp_path / "in" / name, meshes.disk(0, 5))
    assert tutte(tmp_path / "in", "--report", tmp_path / "pages") == 1
    assert "a.html is what" in capsys.readouterr().err


# ------------------------------------------------------- several files


def test_several_files_into_a_folder(tmp_path, capsys, monkeypatch):
    """What a shell makes of `njf uv *.obj more/c.ply out`: one bad file, two of one name."""
    monkeypatch.chdir(tmp_path)
    save(Path("a.obj"), meshes.disk(0, 5))
    Path("b.obj").write_bytes(PNG)
    save(Path("more/c.ply"), meshes.disk(1, 5))
    save(Path("more/a.off"), meshes.disk(2, 5))
    names = ["a.obj", "b.obj", "more/c.ply", "more/a.off"]
    options = ["--report", "pages", "--json", "all.json", "--format", "glb"]
    assert tutte(*names, "out", *options) == 1
    printed = capsys.readouterr()
    lines = printed.out.strip().split("\n")
    assert [line.split()[0] for line in lines[:-1]] == names
    assert lines[-1] == "4 files: 2 mapped, 2 failed"
    assert sorted(path.name for path in Path("out").iterdir()) == ["a.glb", "c.glb"]
    assert sorted(path.name for path in Path("pages").iterdir()) == ["a.html", "c.html"]
    result = json.loads(Path("all.json").read_text())
    errors = {r["input"]: r["error"] for r in result["files"] if r["status"] != "ok"}
    assert errors == {
        "b.obj": "this is a PNG picture, not a mesh",
        "more/a.off": "out/a.glb is what a.obj becomes: rename one of them",
    }


@pytest.mark.parametrize(("typed", "exists"), [("out/", False), ("out", True), ("out/", True)])
def test_one_file_into_a_folder(disk, tmp_path, monkeypatch, typed, exists):
    """`njf uv *.obj out/` where there is only one; a name alone is no folder yet."""
    monkeypatch.chdir(tmp_path)
    if exists:
        Path("out").mkdir()
    assert tutte(disk, typed) == 0
    assert [path.name for path in Path("out").iterdir()] == ["disk.obj"]


class Bomb(type(Path())):  # type: ignore[misc]
    """Ends the process that unpickles it, as a crash in native code would."""

    def __reduce__(self) -> tuple:
        return os._exit, (7,)


def test_a_crash_is_one_file_s_failure(disk):
    good = uv.Task(disk, None, None, "tutte", "uv", False, 1e-6, False, 1, False)
    bad = uv.Task(Bomb("bomb.obj"), None, None, "tutte", "uv", False, 1e-6, False, 1, False)
    with uv._Workers(1) as workers:
        records = [workers.submit(task).result() for task in (bad, good)]
    assert records[0]["error"] == "the process ended without a result (exit code 7)"
    assert records[1]["status"] == "ok"


def test_an_interrupt_leaves_whole_files_only(tmp_path):
    """Many files, interrupted after the first is there."""
    for i in range(40):
        save(tmp_path / "in" / f"{i:02}.obj", meshes.disk(i, 12))
    # A shell lets its background jobs ignore interrupts, and so would all their children.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from njf_models.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", program, "uv", "in", "out", "--start", "tutte", "--no-cut"]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 300
    while not list((tmp_path / "out").glob("*.obj")) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    assert error.strip().split("\n")[-1] == "njf uv: interrupted"
    assert "Traceback" not in error
    written = list((tmp_path / "out").iterdir())
    assert 0 < len(written) < 40
    for path in written:
        assert len(read_mesh_file(path).faces) == 242


# ------------------------------------------------------- info


def test_info_of_a_torus(tmp_path, capsys):
    path = save(tmp_path / "ring.off", meshes.torus())
    mesh = dp.Mesh(*meshes.torus())
    assert main(["info", str(path), "--json", "-"]) == 0
    facts = json.loads(capsys.readouterr().out)[str(path)]
    assert facts["topology"] == "closed surface of genus 1"
    assert facts["triangles with an area"] == mesh.n_faces
    assert facts["area"] == pytest.approx(float(mesh.areas.sum()), rel=1e-6)
    corners = mesh.vertices[mesh.faces].numpy()
    smallest = trimesh.triangles.angles(corners).min(axis=1)
    assert facts["smallest angle, degrees"] == pytest.approx(np.degrees(smallest.min()), rel=1e-5)
    assert facts["face with the smallest angle"] == int(smallest.argmin())


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (meshes.disk(0, 5), "a disk"),
        (meshes.sphere(), "closed surface of genus 0"),
        (meshes.annulus(), "surface with 2 boundary loops of genus 0"),
        (meshes.book(), "not a manifold"),
        (meshes.union(meshes.sphere(), meshes.disk(0, 4)), "2 components"),
    ],
    ids=["disk", "sphere", "annulus", "book", "two"],
)
def test_info_names_the_topology(tmp_path, capsys, arrays, words):
    path = save(tmp_path / "a.ply", arrays)
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert re.search(rf"topology +{words}", text)


def test_info_of_nothing(tmp_path, capsys):
    good = save(tmp_path / "a.ply", meshes.disk(0, 4))
    assert main(["info", str(tmp_path / "b.obj"), str(good), "nothing"]) == 1
    printed = capsys.readouterr()
    assert str(good) in printed.out
    lines = printed.err.strip().split("\n")
    assert lines[0] == f"njf info: {tmp_path / 'b.obj'}: no such file"
    assert lines[1].startswith("njf info: nothing: no such file")
