"""Flips out of planar maps: clamp singular values and solve again, or untangle by descent.

Clamping is cheap, each round one back-substitution with the solver's factor, and mends most maps
that are nearly right. What it leaves, untangling mends in almost all cases: L-BFGS on

    Σ |tⱼ| (‖Jⱼ‖² + det² Jⱼ + 1) / χ(det Jⱼ, ε)

with ε falling to zero with the depth of the flips (Garanzha, Kaporin, Kudryavtseva, Protais, Ray
and Sokolov, "Foldover-free maps in 50 lines of code", 2021). Neither is certain to succeed: count
the flips of what comes back.
"""

from __future__ import annotations

import math
import numbers

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import (
    require_instances,
    require_integer,
    require_single_or_double,
    require_tensor,
)
from diffpoisson.distortion import area_distortion, determinant, flipped, mips, similarity_parts
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh, require_mesh
from diffpoisson.poisson import PoissonSolver


def clamp_singular_values(
    J: Float[Tensor, "*batch 2 2"], smallest: float, largest: float
) -> Float[Tensor, "*batch 2 2"]:
    """The closest matrices whose signed singular values are in an interval of positive numbers.

    J is a similarity, of norm σ₁ + σ₂, plus an anti-similarity, of norm σ₁ - σ₂; clamping scales
    both.

    Raises:
        TypeError: J is no tensor of float32 or float64, or a limit no number.
        ValueError: J is not (…, 2, 2), or not 0 < smallest <= largest.
    """
    require_tensor("clamp_singular_values", "J", J)
    require_single_or_double("clamp_singular_values", "J", J)
    if J.shape[-2:] != (2, 2):
        shape = tuple(J.shape)
        raise ValueError(f"clamp_singular_values: expected J of shape (…, 2, 2), got {shape}")
    for name, limit in (("smallest", smallest), ("largest", largest)):
        if not isinstance(limit, numbers.Real):
            got = type(limit).__name__
            raise TypeError(f"clamp_singular_values: {name} must be a number, got {got}")
    if not 0 < smallest <= largest:
        raise ValueError(
            f"clamp_singular_values: need 0 < smallest <= largest, got {smallest}, {largest}"
        )
    similarity, anti_similarity = similarity_parts(J)
    total, difference = (torch.linalg.vector_norm(v, dim=-1) for v in (similarity, anti_similarity))
    first = ((total + difference) / 2).clamp(smallest, largest)
    second = ((total - difference) / 2).clamp(smallest, largest)
    # σ₁ + σ₂ = 0 leaves the rotation free: take none. σ₁ = σ₂ stay equal, so that there is nothing
    # to scale.
    upright = torch.tensor([1, 0]).to(J)
    p, q = (
        torch.where((total > 0)[..., None], similarity / total[..., None], upright)
        .mul((first + second)[..., None] / 2)
        .unbind(-1)
    )
    ratio = torch.where(difference > 0, (first - second) / difference, 0)
    r, s = (anti_similarity * ratio[..., None] / 2).unbind(-1)
    return torch.stack([p + r, s - q, q + s, p - r], dim=-1).unflatten(-1, (2, 2))


def clamp_flips(
    solver: PoissonSolver,
    uv: Float[Tensor, "n 2"],
    *,
    limits: tuple[float, float] = (0.25, 4.0),
    max_rounds: int = 40,
) -> tuple[Float[Tensor, "n 2"], int]:
    """Clamp the Jacobians of a map and fit a map to them, until nothing flips or rounds are over.

    Args:
        solver: of the mesh.
        uv: (n, 2) the map.
        limits: the allowed singular values.
        max_rounds: give up after so many solves.

    Returns:
        The map, and the number of solves.

    Raises:
        TypeError: arguments of other types.
        ValueError: uv is not (n, 2), or a negative number of rounds.
    """
    require_instances("clamp_flips", [solver], PoissonSolver)
    _require_map("clamp_flips", solver.mesh, uv)
    require_integer("clamp_flips", "max_rounds", max_rounds, 0)
    rounds = 0
    while rounds < max_rounds and flipped(J := jacobians(solver.mesh, uv)).any():
        uv = solver(clamp_singular_values(J, *limits))
        rounds += 1
    return uv, rounds


def untangle(
    mesh: Mesh, uv: Float[Tensor, "n 2"], *, max_rounds: int = 10, iterations: int = 60
) -> tuple[Float[Tensor, "n 2"], int]:
    """Descend on the regularised energy until nothing flips or rounds are over.

    Args:
        mesh: the surface, or a planar mesh.
        uv: (n, 2) the map, at about the scale of an isometry.
        max_rounds: give up after so many values of ε.
        iterations: of L-BFGS at each value of ε.

    Returns:
        The map, in the dtype of uv, and the number of rounds.

    Raises:
        TypeError: arguments of other types.
        ValueError: uv is not (n, 2), a negative number of rounds, or not one iteration.
    """
    require_mesh("untangle", mesh)
    _require_map("untangle", mesh, uv)
    require_integer("untangle", "max_rounds", max_rounds, 0)
    require_integer("untangle", "iterations", iterations, 1)
    x, rounds = uv.detach().double(), 0
    while rounds < max_rounds and (worst := _worst(mesh, x)) <= 0:
        x = _descend(mesh, x, _epsilon(worst), iterations)
        rounds += 1
    return x.to(uv.dtype), rounds


def _epsilon(worst: float) -> float:
    """As Garanzha et al., whose fraction of the deepest flip is 0.2; a floor for flat faces."""
    return math.hypot(1e-6, 0.04 * worst)


def _worst(mesh: Mesh, uv: Tensor) -> float:
    return float(determinant(jacobians(mesh, uv)).min())


def _energy(mesh: Mesh, uv: Tensor, epsilon: float) -> Float[Tensor, ""]:
    J = jacobians(mesh, uv)
    areas = mesh._double_measures / mesh._double_measures.sum()
    return (areas * (mips(J, epsilon) + area_distortion(J, epsilon))).sum()


def _descend(mesh: Mesh, uv: Tensor, epsilon: float, iterations: int) -> Float[Tensor, "n 2"]:
    """L-BFGS at one ε, until nothing flips."""
    # The unit of length to SciPy, whose tolerance of gradients is absolute.
    unit = mesh._double_measures.sum().sqrt()

    def map_of(x: np.ndarray) -> Tensor:
        return unit * torch.from_numpy(x).view_as(uv).to(unit.device)

    def value_and_gradient(x: np.ndarray) -> tuple[float, np.ndarray]:
        point = map_of(x).requires_grad_()
        energy = _energy(mesh, point, epsilon)
        (gradient,) = torch.autograd.grad(energy, point)
        return float(energy.detach()), (unit * gradient).flatten().cpu().numpy()

    def stop_if_valid(x: np.ndarray) -> None:
        if _worst(mesh, map_of(x)) > 0:
            raise StopIteration

    import scipy.optimize  # noqa: PLC0415  (a twentieth of the time to import the package)

    result = scipy.optimize.minimize(
        value_and_gradient,
        (uv / unit).flatten().cpu().numpy(),
        jac=True,
        method="L-BFGS-B",
        callback=stop_if_valid,
        options={"maxiter": iterations, "maxcor": 10},
    )
    return map_of(result.x)


def _require_map(operation: str, mesh: Mesh, uv: Tensor) -> None:
    require_tensor(operation, "uv", uv, mesh.device)
    require_single_or_double(operation, "uv", uv)
    if uv.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"{operation}: expected uv of shape (n={mesh.n_vertices}, 2), got {tuple(uv.shape)}"
        )
