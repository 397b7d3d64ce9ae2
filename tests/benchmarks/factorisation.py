"""From vertices and faces to a factor, and the eigenpairs that the factor gives."""

from __future__ import annotations

from collections.abc import Iterator
from unittest.mock import patch

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch

import diffpoisson as dp
from diffpoisson import testing
from diffpoisson.factor import CholeskyFactor
from tests.benchmarks import limits
from tests.benchmarks.figures import Figure, Limit, Spread, Target, cost, speed_up
from tests.benchmarks.harness import alternate, main
from tests.benchmarks.operators import bare_solver, factor_bytes

SUPERLU = {5: 1.0, 6: 2.5, 7: 4.0}  # by subdivisions of the icosahedron: least speed-up
PAIRS = 50


def factor(quick: bool) -> Iterator[Figure]:
    """`Mesh`, operators and factor from arrays, against the factor alone of the finished matrix.

    SuperLU orders as SciPy does by default: on these matrices its symmetric mode with minimum
    degree is slower, by far on the largest.
    """
    for subdivisions in (2,) if quick else SUPERLU:
        vertices, faces = testing.sphere(0, subdivisions)
        L = dp.laplacian(dp.Mesh(vertices, faces))[1:, 1:]
        csc = L.tocsc()
        contestants = {
            "ours": lambda V=vertices, F=faces: dp.PoissonSolver(dp.Mesh(V, F)),
            "SciPy SuperLU": lambda A=csc: scipy.sparse.linalg.splu(A),
            "cholespy on the finished matrix": lambda A=L: bare_solver(A),
        }
        seconds = alternate(contestants, turns=2 if quick else 7)
        what = f"factor and operators from (V, F), {len(vertices):,} vertices"
        yield speed_up(what, seconds, "SciPy SuperLU", SUPERLU.get(subdivisions))
        yield cost(what, seconds, "cholespy on the finished matrix", 1.3)


def eigenpairs(quick: bool) -> Iterator[Figure]:
    """The smallest Laplacian eigenpairs on a solver's factor, against SciPy's own shift-invert."""
    mesh = dp.Mesh(*testing.sphere(0, 3 if quick else 5))
    solver = dp.PoissonSolver(mesh)
    L, M = dp.laplacian(mesh), sp.diags(dp.lumped_mass(mesh).numpy()).tocsc()
    seconds = alternate(
        {
            "ours": lambda: dp.laplacian_eigenpairs(mesh, PAIRS, solver=solver),
            "scipy eigsh(sigma=0)": lambda: eigsh(L, M),
        },
        turns=2 if quick else 7,
    )
    ours, _ = dp.laplacian_eigenpairs(mesh, PAIRS, solver=solver)
    theirs = torch.from_numpy(eigsh(L, M))
    misfit = float(((ours - theirs).abs() / theirs[-1]).max())
    what = f"{PAIRS} Laplacian eigenpairs, {mesh.n_vertices:,} vertices"
    size, solves = factor_bytes(mesh), solves_of_eigenpairs(mesh)
    traffic = 2 * solves * size / limits.read_bandwidth(size)
    limit = Limit(f"{solves} solves, each reads the factor twice", traffic)
    peer = "scipy eigsh(sigma=0)"
    yield speed_up(what, seconds, peer, 3.0, limit=limit)
    yield Figure(
        f"{what}: largest difference of eigenvalues, over the largest",
        peer,
        Spread(misfit, misfit, misfit),
        unit="",
        target=Target("≤", 1e-8),
    )


def eigsh(L: sp.csr_matrix, M: sp.csc_matrix) -> np.ndarray:
    """What one writes without a factor at hand."""
    values, _ = scipy.sparse.linalg.eigsh(L, PAIRS, M=M, sigma=0)
    return np.sort(values)


def solves_of_eigenpairs(mesh: dp.Mesh) -> int:
    """How many solves ours makes."""
    solver, count = dp.PoissonSolver(mesh), 0
    multiply = CholeskyFactor.multiply

    def counted(self: CholeskyFactor, x: torch.Tensor) -> torch.Tensor:
        nonlocal count
        count += 1
        return multiply(self, x)

    with patch.object(CholeskyFactor, "multiply", counted):
        dp.laplacian_eigenpairs(mesh, PAIRS, solver=solver)
    return count


MEASUREMENTS = {"factor": factor, "eigenpairs": eigenpairs}

if __name__ == "__main__":
    main("factorisation", MEASUREMENTS)
