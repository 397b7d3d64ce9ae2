"""Memory that build-solve-drop cycles of a solver lose, ours against bare cholespy.

    python -m tests.benchmarks.leaks --cycles 10000 --json docs/results/leaks.json

Each variant runs in a process of its own: resident memory after 100, 1,000 and 10,000 cycles, each
time after garbage collection and after glibc has given back what is free.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cholespy
import numpy as np
import torch
from tqdm import tqdm

import diffpoisson as dp
from tests import meshes

MARKS = (100, 1000, 10_000)
COLUMNS = 128


def resident() -> int:
    """Resident bytes, once garbage is collected and free memory given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _mesh(size: int = 6) -> dp.Mesh:
    return dp.Mesh(*meshes.disk(0, size))


def ours(mesh: dp.Mesh) -> Callable[[], None]:
    """A new solver of the mesh, used forwards and backwards."""
    R = torch.ones(mesh.n_faces, COLUMNS, 2, dtype=torch.float64, requires_grad=True)

    def cycle() -> None:
        dp.PoissonSolver(mesh)(R).sum().backward()
        R.grad = None

    return cycle


def ours_with_mesh(mesh: dp.Mesh) -> Callable[[], None]:
    """The mesh and its operators too are made anew."""
    vertices, faces = mesh.vertices, mesh.faces

    def cycle() -> None:
        ours(dp.Mesh(vertices, faces))()

    return cycle


def bare(mesh: dp.Mesh) -> Callable[[], None]:
    """cholespy alone, on the same matrix and right-hand sides."""
    L = dp.laplacian(mesh)[1:, 1:].tocoo()
    arrays = [torch.from_numpy(a) for a in (L.row.astype(np.int32), L.col.astype(np.int32), L.data)]
    b = torch.ones(L.shape[0], COLUMNS, dtype=torch.float64)
    x = torch.empty_like(b)

    def cycle() -> None:
        solver = cholespy.CholeskySolverD(L.shape[0], *arrays, cholespy.MatrixType.COO)
        solver.solve(b, x)

    return cycle


def failed(mesh: dp.Mesh) -> Callable[[], None]:
    """A matrix that is not positive definite: cholespy fails, and loses its factor."""
    L = dp.laplacian(mesh)[1:, 1:]

    def cycle() -> None:
        try:
            dp.factor.CholeskyFactor(-L)
        except ValueError:
            return

    return cycle


VARIANTS = {f.__name__: f for f in (ours, ours_with_mesh, bare, failed)}


def measure(variant: str, cycles: int) -> dict[str, float]:
    """Growth in MB from the tenth cycle to each mark, and bytes per cycle over all."""
    torch.set_num_threads(1)
    cycle = VARIANTS[variant](_mesh())
    for _ in range(10):
        cycle()
    start, growth = resident(), {}
    for i in tqdm(range(1, cycles + 1), desc=variant, disable=not sys.stderr.isatty()):
        cycle()
        if i in MARKS or i == cycles:
            growth[str(i)] = round((resident() - start) / 1e6, 2)
    return growth | {"bytes_per_cycle": round((resident() - start) / cycles)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--variant", choices=VARIANTS)
    arguments = parser.parse_args()
    if arguments.variant:
        print(json.dumps(measure(arguments.variant, arguments.cycles)))
        return
    report: dict[str, object] = {"n_vertices": _mesh().n_vertices, "columns": COLUMNS, "unit": "MB"}
    for variant in VARIANTS:
        command = [sys.executable, "-m", "tests.benchmarks.leaks", "--variant", variant]
        command += ["--cycles", str(min(arguments.cycles, 1000 if variant == "failed" else 10**9))]
        run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        report[variant] = json.loads(run.stdout.splitlines()[-1])
        print(variant, report[variant])
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
