"""`njf uv` as an artist uses it: meshes of many kinds, some of them none, through the shell.

`python -m tests.benchmarks.cli_trial` makes its inputs, runs the command on each, checks what was
written with trimesh and numpy alone, and writes `docs/results/cli_trial.json`. `--start tutte` does
without the network.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from diffpoisson import testing

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "cli_trial.json"


def save(path: Path, arrays: testing.Arrays, **options: object) -> None:
    trimesh.Trimesh(*arrays, process=False).export(path, **options)


def scaled(arrays: testing.Arrays, factor: float) -> testing.Arrays:
    return arrays[0] * factor, arrays[1]


def hollow_cylinder(path: Path) -> None:
    """Sides of quads, lids of 24 corners, with groups and normals, as modelling programs write."""
    n = 24
    angle = 2 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    lines = ["# sides of quads, lids of many corners", "o cylinder"]
    lines += [f"v {x} {2 * k} {y}" for k in range(4) for x, y in ring.tolist()]
    lines += [f"vn {x} 0 {y}" for x, y in ring.tolist()] + ["vn 0 -1 0", "vn 0 1 0", "g side"]
    for k in range(3):
        for i in range(n):
            j = (i + 1) % n
            corners = ((k, i), (k + 1, i), (k + 1, j), (k, j))
            lines.append("f " + " ".join(f"{a * n + b + 1}//{b + 1}" for a, b in corners))
    lines += ["g lids", "f " + " ".join(f"{i + 1}//{n + 1}" for i in range(n))]
    lines.append("f " + " ".join(f"{3 * n + i + 1}//{n + 2}" for i in reversed(range(n))))
    path.write_text("\n".join(lines) + "\n")


def textured_box(path: Path) -> None:
    rows, columns = np.mgrid[0:256, 0:256].astype(np.uint8)
    picture = np.stack([columns, rows, 255 - rows], axis=-1)
    Image.fromarray(picture).save(path.with_suffix(".png"))
    path.with_suffix(".mtl").write_text(f"newmtl skin\nmap_Kd {path.stem}.png\n")
    corners = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 2) for z in (0, 3)]
    quads = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
    faces = ["f " + " ".join(f"{v}/{k + 1}" for k, v in enumerate(quad.split())) for quad in quads]
    coordinates = ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl skin"]
    path.write_text("\n".join([f"mtllib {path.stem}.mtl", *corners, *coordinates, *faces, ""]))


def scene_of_two(path: Path) -> None:
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(subdivisions=3)
    scene.add_geometry(ball, transform=np.diag([1, 2, 1, 1.0]))
    scene.add_geometry(
        trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([3, 0, 0])
    )
    scene.export(path)


def with_flaws(path: Path) -> None:
    """Faces without area, one with a corner twice, vertices that nothing uses, one not finite."""
    vertices, faces = testing.disk(0, 12)
    lines = ["v {} {} {}".format(*v) for v in vertices.tolist()]
    lines += ["v nan 0 0", "v 5 5 5", "v 5 5 5", "v 5 5 5"]
    lines += ["f {} {} {}".format(*(f + 1)) for f in faces]
    lines += ["f 1 1 2", "f 146 147 148"]
    path.write_text("\n".join(lines) + "\n")


def picture(path: Path) -> None:
    Image.fromarray(np.zeros((8, 8, 3), dtype=np.uint8)).save(path, format="png")


# File name: what it is, and how it is made.
INPUTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "bump.obj": ("open surface", lambda p: save(p, testing.disk(0, 30))),
    "ball.ply": ("closed, genus 0", lambda p: save(p, testing.sphere(0, 4))),
    "ring.off": ("closed, genus 1", lambda p: save(p, testing.torus())),
    "tube.obj": ("two boundaries", lambda p: save(p, testing.annulus())),
    "two.obj": (
        "two components",
        lambda p: save(p, testing.union(testing.sphere(1, 3), testing.disk(2, 12))),
    ),
    "book.ply": ("three faces at an edge", lambda p: save(p, testing.book())),
    "bowtie.ply": ("fans that share a vertex", lambda p: save(p, testing.bowtie())),
    "moebius.obj": ("one-sided", lambda p: save(p, testing.moebius())),
    "cylinder.obj": ("quads and 24-gons", hollow_cylinder),
    "skin.obj": ("quads with a picture", textured_box),
    "scene.glb": ("two objects, placed by transforms", scene_of_two),
    "ascii.stl": (
        "triangle soup as text",
        lambda p: save(p, testing.sphere(3, 3), file_type="stl_ascii"),
    ),
    "huge.ply": ("ten million units wide", lambda p: save(p, scaled(testing.sphere(0, 3), 1e7))),
    "tiny.ply": (
        "a millionth of a unit wide",
        lambda p: save(p, scaled(testing.sphere(0, 3), 1e-6)),
    ),
    "flaws.obj": ("faces without area, stray vertices, NaN", with_flaws),
    "empty.obj": ("an empty file", lambda p: p.write_bytes(b"")),
    "picture.obj": ("a picture, renamed", picture),
    "cloud.ply": (
        "points without faces",
        lambda p: trimesh.PointCloud(testing.sphere(0, 2)[0]).export(p),
    ),
    "missing.obj": ("no file", lambda p: None),
}


def njf(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "njf_models.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def checked(source: Path, written: Path) -> dict[str, object]:
    """Facts of the written file by trimesh and numpy: nothing of this package judges itself."""
    before = trimesh.load_scene(source, process=False).to_mesh()
    after = trimesh.load_mesh(written, process=False)
    uv = np.asarray(after.visual.uv)[after.faces]
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    solid = after.area_faces > 0
    return {
        "triangles in the file": len(after.faces),
        "same triangles": len(after.faces) == len(before.faces),
        "area kept": bool(np.isclose(after.area, before.area, rtol=1e-5)),
        "uv inside the unit square": bool(uv.min() >= 0 and uv.max() <= 1),
        # In the single or printed precision of the file.
        "not upright": int((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] <= 0)[solid].sum()),
    }


def trial(folder: Path, name: str, options: list[str]) -> dict[str, object]:
    """One input, to OBJ."""
    kind, make = INPUTS[name]
    source, target = folder / "in" / name, folder / "out" / f"{Path(name).stem}.obj"
    make(source)
    run = njf("uv", source, target, "--json", folder / "facts.json", *options)
    (record,) = json.loads((folder / "facts.json").read_text())["files"]
    kept = ("charts", "flipped", "certified", "mean_distortion", "max_distortion", "seconds")
    row: dict[str, object] = {"file": name, "kind": kind, "exit code": run.returncode}
    row["stderr"] = run.stderr.replace(f"{folder}/in/", "").strip()
    row |= {key: record[key] for key in kept if key in record}
    return row | (checked(source, target) if target.exists() else {})


def main() -> None:
    options = sys.argv[1:]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "in").mkdir()
        rows = []
        for file in INPUTS:
            rows.append(trial(folder, file, options))
            print(json.dumps(rows[-1], ensure_ascii=False), flush=True)
        batch = njf(
            "uv", folder / "in", folder / "batch", "--format", "glb", "--jobs", "2", *options
        )
        summary = batch.stdout.strip().split("\n")[-1]
        result = {
            "options": options,
            "files": rows,
            "batch": {"exit code": batch.returncode, "summary": summary},
        }
    print(summary)
    RESULT.write_text(json.dumps(result, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    main()
