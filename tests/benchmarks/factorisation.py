"""From vertices and faces to a factor, and the eigenpairs that the factor gives."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
import torch

import diffpoisson as dp
from diffpoisson import testing
from tests.benchmarks import limits
from tests.benchmarks.harness import Figure, Limit, Spread, Target, alternate, cost, main, speed_up
from tests.benchmarks.operators import bare_solver, factor_bytes

SUPERLU = {5: 1.0, 6: 2.5, 7: 4.0}  # by subdivisions of the icosahedron: least speed-up
PAIRS = 50


def factor(quick: bool) -> Iterator[Figure]:
    """`Mesh`, operators and factor from arrays, against the factor alone of the finished matrix.

    Of SuperLU's two ways, whichever is faster: for a general matrix, SciPy's default, or for a
    symmetric one that needs no pivots, ordered by minimum degree.
    """
    for subdivisions in (2,) if quick else SUPERLU:
        vertices, faces = testing.sphere(0, subdivisions)
        L = dp.laplacian(dp.Mesh(vertices, faces))[1:, 1:]
        seconds = dict(alternate(_factorisations(vertices, faces, L), turns=7))
        ways = [name for name in seconds if "SuperLU" in name]
        best = min(ways, key=lambda name: float(np.median(seconds[name])))
        seconds["SciPy SuperLU"] = seconds[best]
        what = f"factor and operators from (V, F), {len(vertices):,} vertices"
        fastest = {"SuperLU's faster way": best}
        least = SUPERLU.get(subdivisions)
        yield speed_up(what, seconds, "SciPy SuperLU", least, details=fastest)
        yield cost(what, seconds, "cholespy on the finished matrix", 1.3)


def _factorisations(
    vertices: np.ndarray, faces: np.ndarray, L: sp.csr_matrix
) -> dict[str, Callable[[], object]]:
    csc = L.tocsc()
    symmetric = {
        "permc_spec": "MMD_AT_PLUS_A",
        "diag_pivot_thresh": 0.0,
        "options": {"SymmetricMode": True},
    }
    return {
        "ours": lambda: dp.PoissonSolver(dp.Mesh(vertices, faces)),
        "SuperLU, default": lambda: scipy.sparse.linalg.splu(csc),
        "SuperLU, symmetric": lambda: scipy.sparse.linalg.splu(csc, **symmetric),
        "cholespy on the finished matrix": lambda: bare_solver(L),
    }


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
        turns=7,
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
        "their eigenvalues, largest difference over the largest eigenvalue",
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
    solver = dp.PoissonSolver(mesh)
    solve, count = solver.solve_laplacian, 0

    def counted(b: torch.Tensor) -> torch.Tensor:
        nonlocal count
        count += 1
        return solve(b)

    solver.solve_laplacian = counted
    dp.laplacian_eigenpairs(mesh, PAIRS, solver=solver)
    return count


MEASUREMENTS = {"factor": factor, "eigenpairs": eigenpairs}

if __name__ == "__main__":
    main("factorisation", MEASUREMENTS)
