"""Digits that the Poisson solve loses on thin faces and at extreme scales.

    python -m tests.benchmarks.conditioning --json docs/results/conditioning.json

The oracle solves the same problem, on the same float64 positions, in 60 decimal digits with
mpmath, from Gram matrices of edges: none of the package's formulas. Errors are of the map, relative
to its largest entry, and of its gradient in the energy norm, relative to that of the field.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import torch
from tqdm import tqdm

import diffpoisson as dp
from tests import meshes

mpmath.mp.dps = 60
ASPECTS = [10.0**k for k in range(9)]
SCALES = [10.0**k for k in range(-6, 7, 2)]


# ------------------------------------------------------- meshes


def needles(aspect: float, size: int = 5) -> meshes.Arrays:
    """Thin faces with one short edge: a jittered grid, stretched."""
    vertices, faces = meshes.planar_disk(0, size)
    return _placed(vertices * [1, 1 / aspect]), faces


def caps(aspect: float, size: int = 5) -> meshes.Arrays:
    """Thin faces with one angle near 180°: rows of shifted vertices, squashed."""
    vertices, faces = meshes.planar_disk(0, size)
    shift = vertices[:, 1:] * (size - 1) / 2
    return _placed(np.c_[vertices[:, :1] + shift / (size - 1), vertices[:, 1:] / aspect]), faces


def one_sliver(aspect: float, size: int = 5) -> meshes.Arrays:
    """A good mesh with a thin pair of faces: one vertex pushed towards an opposite edge."""
    vertices, faces = meshes.disk(0, size)
    middle = (size * size) // 2
    face = faces[(faces == middle).any(1)][0]
    a, b = (v for v in face if v != middle)
    foot = (vertices[a] + vertices[b]) / 2
    vertices[middle] = foot + (vertices[middle] - foot) / aspect
    return vertices, faces


def _placed(flat: np.ndarray) -> np.ndarray:
    """Turned and moved in space, so that coordinates carry roundings."""
    Q = meshes.rotation(np.random.default_rng(1), np.zeros((1, 3)))
    return np.c_[flat, np.zeros(len(flat))] @ Q.T + [0.3, -0.2, 0.7]


SHAPES = {f.__name__: f for f in (needles, caps, one_sliver)}


# ------------------------------------------------------- oracle


class Exact:
    """∇ᵀA∇ and ∇ᵀA in 60 digits."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        n = len(vertices)
        self.faces, self.L = faces, mpmath.zeros(n, n)
        self.hats, self.areas = [], []
        for face in faces:
            v = [mpmath.matrix(vertices[i].tolist()) for i in face]
            E = [v[1] - v[0], v[2] - v[0]]
            G = mpmath.matrix(2, 2)
            for i in range(2):
                for j in range(2):
                    G[i, j] = (E[i].T * E[j])[0]
            inverse = G**-1
            h1 = inverse[0, 0] * E[0] + inverse[0, 1] * E[1]
            h2 = inverse[1, 0] * E[0] + inverse[1, 1] * E[1]
            hats, area = [-h1 - h2, h1, h2], mpmath.sqrt(mpmath.det(G)) / 2
            self.hats.append(hats)
            self.areas.append(area)
            for i in range(3):
                for j in range(3):
                    self.L[int(face[i]), int(face[j])] += area * (hats[i].T * hats[j])[0]

    def solve(self, R: np.ndarray) -> mpmath.matrix:
        """The minimiser for one row vector per face, at zero area-weighted mean."""
        n = self.L.rows
        b, weights = mpmath.zeros(n, 1), mpmath.zeros(n, 1)
        for face, hats, area, r in zip(self.faces, self.hats, self.areas, R, strict=True):
            for i in range(3):
                b[int(face[i])] += area * (hats[i].T * mpmath.matrix(r.tolist()))[0]
                weights[int(face[i])] += area
        x = mpmath.zeros(n, 1)
        inner = mpmath.lu_solve(self.L[1:, 1:], b[1:, 0])
        for i in range(1, n):
            x[i] = inner[i - 1]
        mean = (weights.T * x)[0] / mpmath.fsum(weights)
        return x - mean * mpmath.ones(n, 1)

    def energy(self, x: mpmath.matrix) -> Any:
        """√(xᵀ L x)."""
        return mpmath.sqrt(abs((x.T * self.L * x)[0]))

    def norm(self, R: np.ndarray) -> Any:
        return mpmath.sqrt(
            mpmath.fsum(a * (r @ r) for a, r in zip(self.areas, R.astype(object), strict=True))
        )


def errors(exact: Exact, R: np.ndarray, phi: torch.Tensor, reference: Any) -> dict[str, float]:
    """Of the map and of its gradient."""
    difference = mpmath.matrix(phi[:, 0].tolist()) - reference
    largest = max(abs(value) for value in reference)
    return {
        "map": float(max(abs(value) for value in difference) / largest),
        "gradient": float(exact.energy(difference) / exact.norm(R)),
    }


# ------------------------------------------------------- measurements


def measure(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    """A random field, with and without a step of refinement, and an affine map."""
    mesh, exact = dp.Mesh(vertices, faces), Exact(vertices, faces)
    record: dict[str, Any] = {}
    try:
        solver = dp.PoissonSolver(mesh)
    except dp.MeshError as error:
        return {"refused": str(error)}
    R = torch.from_numpy(np.random.default_rng(0).standard_normal((len(faces), 1, 3)))
    rows = R[:, 0].numpy()
    reference, phi = exact.solve(rows), solver(R)
    record["random"] = errors(exact, rows, phi, reference)
    refined = phi + solver(R - dp.jacobians(mesh, phi, extrinsic=True))
    record["random, refined"] = errors(exact, rows, refined, reference)
    M = torch.tensor([[0.3, -1.2, 0.8]], dtype=torch.float64)
    A = M.expand(len(faces), 1, 3)
    rows = A[:, 0].numpy()
    record["affine"] = errors(exact, rows, solver(A), exact.solve(rows))
    return record


def growth(series: dict[float, dict[str, Any]], key: str, norm: str) -> float:
    """Exponent p of error ∝ aspectᵖ, fitted where errors are above 1e-14 and below 1."""
    points = [
        (np.log10(x), np.log10(r[key][norm]))
        for x, r in series.items()
        if key in r and 1e-14 < r[key][norm] < 1
    ]
    return float(np.polyfit(*zip(*points, strict=True), 1)[0]) if len(points) > 2 else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    report: dict[str, Any] = {"aspect": {}, "scale": {}, "exponent": {}}
    for name, build in SHAPES.items():
        series = {a: measure(*build(a)) for a in tqdm(ASPECTS, desc=name)}
        report["aspect"][name] = {f"{a:.0e}": record for a, record in series.items()}
        report["exponent"][name] = {
            key: {norm: round(growth(series, key, norm), 2) for norm in ("map", "gradient")}
            for key in ("random", "random, refined", "affine")
        }
    vertices, faces = meshes.disk(0, 5)
    report["scale"] = {f"{s:.0e}": measure(s * vertices, faces) for s in tqdm(SCALES, desc="scale")}
    print(json.dumps(report["exponent"], indent=1))
    for name, series in [*report["aspect"].items(), ("scale", report["scale"])]:
        for x, record in series.items():
            cells = [
                f"{record[k][e]:.0e}" if k in record else "refused"
                for k in ("random", "random, refined", "affine")
                for e in ("map", "gradient")
            ]
            print(f"| {name} | {x} | " + " | ".join(cells) + " |")
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
