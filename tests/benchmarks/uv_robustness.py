"""Whether `parameterize(mesh, cut=True)` maps every mesh of a folder, and how well.

`python -m tests.benchmarks.uv_robustness FOLDER` appends a record per mesh, the smallest files
first, to `docs/results/uv_robustness.json` and goes on where it stopped. Each mesh has a process of
its own, so that a crash or a hang is a record too.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

import diffpoisson as dp
from njf_models.datasets.sources import read_mesh

TOLERANCE = 1e-4  # enough to tell what breaks; the default takes SLIM several times as long
RESULT = Path(__file__).parents[2] / "docs" / "results" / "uv_robustness.json"


def examine(path: Path) -> dict[str, Any]:
    """Map one mesh."""
    torch.set_num_threads(1)
    mesh = dp.Mesh(*read_mesh(path))
    start = time.perf_counter()
    uvmap = dp.parameterize(mesh, cut=True, tolerance=TOLERANCE)
    return {
        "faces": mesh.n_faces,
        "components": mesh.n_components,
        "charts": len(uvmap.charts),
        "seam_vertices": uvmap.mesh.n_vertices - mesh.n_vertices,
        "flipped": uvmap.flipped,
        "certified": uvmap.certified,
        "energy": uvmap.energy,
        "worst_chart_energy": max(chart.certificate.energy for chart in uvmap.charts),
        "max_distortion": uvmap.max_distortion,
        "scaffolded": sum("scaffold" in chart.method for chart in uvmap.charts),
        "slim_iterations": uvmap.slim_iterations,
        "seconds": time.perf_counter() - start,
        "milliseconds": uvmap.milliseconds,
    }


def in_own_process(path: Path, seconds: float) -> dict[str, Any]:
    """The record of one mesh, or how it failed."""
    command = [sys.executable, "-m", "tests.benchmarks.uv_robustness", "--one", str(path)]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return {"error": f"no end after {seconds} s"}
    if run.returncode == 0:
        return json.loads(run.stdout)
    last = run.stderr.strip().splitlines()[-1:] or ["silent"]
    return {"error": f"exit {run.returncode}: {last[0]}"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--one", action="store_true", help="print the record of this one file")
    parser.add_argument("--max-faces", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=600, help="limit for one mesh")
    parser.add_argument("--out", type=Path, default=RESULT)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(examine(args.folder)))
        return
    records = json.loads(args.out.read_text()) if args.out.exists() else {}
    for path in sorted(args.folder.glob("*.*"), key=lambda path: path.stat().st_size):
        if path.suffix not in (".ply", ".obj", ".stl", ".off") or path.stem in records:
            continue
        n_faces = len(read_mesh(path)[1])
        if n_faces <= args.max_faces:
            records[path.stem] = in_own_process(path, args.seconds)
            print(path.stem, n_faces, records[path.stem], flush=True)
            args.out.write_text(json.dumps(records, indent=1) + "\n")


if __name__ == "__main__":
    main()
