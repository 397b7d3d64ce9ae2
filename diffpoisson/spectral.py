"""Laplacian eigenpairs on the Poisson solver's own factor, and the signatures built from them.

Shift-invert Lanczos needs the pseudo-inverse of L. On fields of mean zero, the pinned Cholesky
factor followed by the projection to mean zero *is* that pseudo-inverse, so no second factorisation
is made; the constants of each component, which it annihilates, are the eigenvectors of eigenvalue
zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import require_integer, to_tensor
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import laplacian
from diffpoisson.mesh import Mesh, MeshError, require_mesh
from diffpoisson.poisson import PoissonSolver

Mass = Literal["barycentric", "voronoi"]


def laplacian_eigenpairs(
    mesh: Mesh,
    n_eigenpairs: int,
    *,
    mass: Mass = "barycentric",
    solver: PoissonSolver | None = None,
    intrinsic_delaunay: bool = False,
) -> tuple[Float[Tensor, "k"], Float[Tensor, "n k"]]:
    """The smallest solutions of L φ = λ M φ, ascending, with φᵀMφ = I.

    Not differentiable. Eigenvectors are unique up to sign, and up to rotation where eigenvalues
    coincide.

    Args:
        mesh: the domain.
        n_eigenpairs: k, counting one zero eigenvalue per connected component.
        mass: lumped mass M: thirds of the areas, or mixed Voronoi areas (Meyer et al. 2003), in
            units².
        solver: a `PoissonSolver` of this mesh whose factor to use; made if omitted.
        intrinsic_delaunay: use that Laplacian, see `laplacian`; the mass stays that of the faces.

    Returns:
        eigenvalues (k,) in 1/units², eigenvectors (n, k) in 1/units (of tetrahedra, units^-3/2); in
        the dtype of the mesh.

    Raises:
        MeshError: the mesh has fewer than k vertices, or too thin faces.
        ValueError: the solver is another mesh's, or has pins, handles or face weights.
    """
    require_mesh("laplacian_eigenpairs", mesh)
    require_integer("laplacian_eigenpairs", "n_eigenpairs", n_eigenpairs)
    n, zeros = mesh.n_vertices, mesh.n_components
    if not 1 <= n_eigenpairs <= n:
        raise MeshError(
            f"laplacian_eigenpairs: a mesh of {n} vertices has {n} eigenpairs, not {n_eigenpairs}"
        )
    _check_solver(mesh, solver, intrinsic_delaunay)
    areas = _lumped_mass("laplacian_eigenpairs", mesh, mass).cpu().numpy()
    # Of total one, so that no scale is too large or small for ARPACK's tolerances.
    total = areas.sum()
    areas = areas / total
    wanted = n_eigenpairs - zeros
    if wanted <= 0:
        pairs = (np.zeros(0), np.zeros((n, 0)))
    elif 2 * wanted + 1 < n - zeros:
        inverse = _inverse(mesh, None if intrinsic_delaunay else solver or PoissonSolver(mesh))
        pairs = _lanczos(mesh, inverse, areas, wanted)
    else:  # Lanczos keeps 2k + 1 vectors; near n, the dense solver is exact and faster
        pairs = _dense(laplacian(mesh, intrinsic_delaunay=intrinsic_delaunay), areas, zeros)
    values = np.concatenate([np.zeros(zeros), pairs[0]])[:n_eigenpairs]
    vectors = np.concatenate([_constants(mesh, areas), pairs[1]], axis=1)[:, :n_eigenpairs]
    values, vectors = values / total, vectors / np.sqrt(total)
    return torch.from_numpy(values).to(mesh.vertices), torch.from_numpy(vectors).to(mesh.vertices)


def lumped_mass(mesh: Mesh, mass: Mass = "barycentric") -> Float[Tensor, "n"]:
    """Measure of each vertex's cell, positive, summing to that of the mesh, in units² or units³.

    Raises:
        ValueError: unknown kind of mass.
        MeshError: Voronoi areas of tetrahedra.
    """
    require_mesh("lumped_mass", mesh)
    return _lumped_mass("lumped_mass", mesh, mass).to(mesh.dtype)


def _lumped_mass(operation: str, mesh: Mesh, mass: Mass) -> Float[Tensor, "n"]:
    """The same in float64, whatever the mesh's dtype."""
    if str(mass) not in get_args(Mass):
        raise ValueError(f"{operation}: mass must be 'barycentric' or 'voronoi', got {mass!r}")
    if mass == "barycentric":
        return mesh._double_vertex_measures
    mesh._require_triangles(f"{operation}: Voronoi areas")
    shares = mesh._double_measures[:, None] * _voronoi_shares(mesh._corners)
    total = shares.new_zeros(mesh.n_vertices)
    return total.index_add(0, mesh.faces.flatten(), shares.flatten())


def wave_kernel_signature(
    mesh: Mesh,
    n_energies: int = 50,
    *,
    n_eigenpairs: int = 50,
    mass: Mass = "barycentric",
    scale_invariant: bool = True,
    solver: PoissonSolver | None = None,
    intrinsic_delaunay: bool = False,
) -> Float[Tensor, "n e"]:
    """Wave-kernel signature of each vertex (Aubry et al. 2011, eq. 4).

    WKS(x, e) = Σₖ φₖ(x)² wₖ(e) / Σₖ wₖ(e),  wₖ(e) = exp(-(e - log λₖ)² / 2σ²), over the non-zero
    eigenvalues λ₁ … λ_K; energies e are spread evenly from log λ₁ + 2δ to log λ_K - 2δ with
    δ = (log λ_K - log λ₁) / n_energies and σ = 7δ.

    Args:
        mesh: the surface. Invariant to isometries, also to those of its parts: in several
            components the spectrum is that of all together.
        n_energies: number of values per vertex.
        n_eigenpairs: size of the spectrum, counting one zero eigenvalue per connected component.
        mass: see `laplacian_eigenpairs`.
        scale_invariant: multiply by the total area, which makes the signature dimensionless with
            average one; otherwise in 1/units².
        solver: a `PoissonSolver` of this mesh whose factor to use; made if omitted.
        intrinsic_delaunay: use that Laplacian, see `laplacian`; the mass stays that of the faces.

    Raises:
        MeshError: too few vertices, or no two different non-zero eigenvalues, for this spectrum.
    """
    require_integer("wave_kernel_signature", "n_energies", n_energies, least=1)
    values, vectors = laplacian_eigenpairs(
        mesh, n_eigenpairs, mass=mass, solver=solver, intrinsic_delaunay=intrinsic_delaunay
    )
    log_values = values[mesh.n_components :].double().log()
    if len(log_values) < 2 or log_values[0] == log_values[-1]:
        raise MeshError(
            f"wave_kernel_signature: {n_eigenpairs} eigenpairs hold {len(log_values)} non-zero "
            f"ones on this mesh of {mesh.n_components} component(s); two different are needed"
        )
    delta = (log_values[-1] - log_values[0]) / n_energies
    energies = torch.linspace(0, 1, n_energies, dtype=torch.float64, device=mesh.device)
    energies = log_values[0] + 2 * delta + energies * (log_values[-1] - log_values[0] - 4 * delta)
    weights = torch.softmax(
        -((energies[None] - log_values[:, None]) ** 2) / (2 * (7 * delta) ** 2), dim=0
    )
    signature = vectors[:, mesh.n_components :].double() ** 2 @ weights
    if scale_invariant:
        signature = signature * mesh._double_measures.sum()
    return signature.to(mesh.dtype)


def heat_kernel_signature(
    mesh: Mesh,
    times: Float[Tensor, "t"],
    *,
    n_eigenpairs: int = 50,
    mass: Mass = "barycentric",
    solver: PoissonSolver | None = None,
    intrinsic_delaunay: bool = False,
) -> Float[Tensor, "n t"]:
    """Heat-kernel signature of each vertex (Sun et al. 2009): Σₖ exp(-λₖ t) φₖ(x)², in 1/units².

    Args:
        mesh: the surface.
        times: (t,) diffusion times, in units², not negative.
        n_eigenpairs: size of the truncated spectrum, counting the zero eigenvalues.
        mass: see `laplacian_eigenpairs`.
        solver: a `PoissonSolver` of this mesh whose factor to use; made if omitted.
        intrinsic_delaunay: use that Laplacian, see `laplacian`; the mass stays that of the faces.

    Raises:
        ValueError: negative times.
    """
    require_mesh("heat_kernel_signature", mesh)
    times = to_tensor("heat_kernel_signature", "times", times, mesh.device).to(mesh.dtype)
    if times.ndim != 1 or not ((times >= 0) & times.isfinite()).all():
        raise ValueError(
            "heat_kernel_signature: times must be (t,), finite and not negative, got shape "
            f"{tuple(times.shape)}"
        )
    values, vectors = laplacian_eigenpairs(
        mesh, n_eigenpairs, mass=mass, solver=solver, intrinsic_delaunay=intrinsic_delaunay
    )
    return vectors**2 @ torch.exp(-values[:, None] * times.to(values)[None])


# -------------------------------------------------------------------- eigenproblem


def _check_solver(mesh: Mesh, solver: PoissonSolver | None, intrinsic_delaunay: bool) -> None:
    """Raise unless a given solver's factor is that of the Laplacian in question."""
    if solver is None:
        return
    if solver.mesh is not mesh:
        raise ValueError("laplacian_eigenpairs: the solver belongs to another mesh; pass its own")
    if not solver.constraints.natural:
        raise ValueError(
            "laplacian_eigenpairs: the solver has pins, handles or face weights, so its matrix is "
            "not the Laplacian; pass one without"
        )
    if intrinsic_delaunay:
        raise ValueError(
            "laplacian_eigenpairs: the solver has the Laplacian of the mesh's own faces, not of "
            "its intrinsic Delaunay triangulation; leave it out"
        )


def _dense(L: sp.csr_matrix, areas: np.ndarray, zeros: int) -> tuple[np.ndarray, np.ndarray]:
    """All non-zero eigenpairs, ascending."""
    values, vectors = scipy.linalg.eigh(L.toarray(), np.diag(areas))
    if (values[zeros:] <= 0).any():
        raise MeshError(
            "laplacian_eigenpairs: rounding hides the smallest eigenvalues behind the largest, "
            "that of the thinnest faces; remesh these"
        )
    return values[zeros:], vectors[:, zeros:]


def _constants(mesh: Mesh, areas: np.ndarray) -> np.ndarray:
    """(n, components) M-orthonormal eigenvectors of eigenvalue zero: one constant per component."""
    labels = mesh.components.cpu().numpy()
    totals = np.bincount(labels, weights=areas)
    return np.eye(len(totals))[labels] / np.sqrt(totals)


def _inverse(mesh: Mesh, solver: PoissonSolver | None) -> Callable[[np.ndarray], np.ndarray]:
    """Solves with the solver's Laplacian, or the intrinsic Delaunay one, zero at some vertices."""
    if solver is not None:
        factor, free = solver._matrices.inverse, solver.constraints.free.cpu().numpy()
    else:
        _, anchors = np.unique(mesh.components.cpu().numpy(), return_index=True)
        free = np.setdiff1d(np.arange(mesh.n_vertices), anchors)
        L = laplacian(mesh, intrinsic_delaunay=True)
        factor = CholeskyFactor(L[free][:, free], mesh.device)

    def solve(b: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        x = np.zeros_like(b)
        column = torch.from_numpy(b[free])[:, None].to(mesh.device)
        x[free] = factor.multiply(column)[:, 0].cpu().numpy()
        return x

    return solve


def _lanczos(
    mesh: Mesh, inverse: Callable[[np.ndarray], np.ndarray], areas: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """The k smallest non-zero eigenpairs, ascending.

    By Lanczos on M½ L⁺ M½, whose largest eigenvalues are 1/λ, of eigenvectors M½ φ: a standard
    problem, without products by M between the solves.
    """
    root = np.sqrt(areas)
    null = root[:, None] * _constants(mesh, areas)  # M½ 1, orthonormal

    def pseudo_inverse(y: np.ndarray) -> np.ndarray:
        # Both projections together keep the operator symmetric: onto the range of L, where there is
        # a solution, and to mean zero, whichever vertices the factor leaves at zero.
        b = root * (y - null @ (null.T @ y))
        z = root * inverse(b)
        return z - null @ (null.T @ z)

    start = np.random.default_rng(0).standard_normal(len(root))  # ARPACK's own differs every time
    values, vectors = scipy.sparse.linalg.eigsh(
        scipy.sparse.linalg.LinearOperator((len(root),) * 2, pseudo_inverse, dtype=np.float64),
        k,
        which="LM",
        v0=start,
    )
    order = np.argsort(-values)
    return 1 / values[order], vectors[:, order] / root[:, None]


def _voronoi_shares(corners: Float[Tensor, "m 3 D"]) -> Float[Tensor, "m 3"]:
    """Share of each corner in its face's area: Voronoi, or ½ and ¼ where an angle is obtuse."""
    edges = corners.roll(1, dims=1) - corners.roll(-1, dims=1)  # edge i is opposite to corner i
    squared = (edges**2).sum(-1)
    others = squared.sum(1, keepdim=True) - 2 * squared  # 2 |eⱼ||eₖ| cos αᵢ
    sine_twice = squared * others  # ∝ sin 2αᵢ
    weights = sine_twice.roll(1, dims=1) + sine_twice.roll(-1, dims=1)
    shares = weights / weights.sum(1, keepdim=True)
    obtuse = others < 0
    mixed = torch.where(obtuse, 0.5, 0.25).to(shares)
    return torch.where(obtuse.any(1, keepdim=True), mixed, shares)
