"""As-rigid-as-possible maps: local and global steps in turn, on the solver's one factor.

    min over Φ and rotations Qⱼ of  Σⱼ wⱼ|tⱼ| ‖(∇Φ)ⱼ - Qⱼ‖² + Σₕ aₕ ‖Φₕ - qₕ‖²,  Φₚ = qₚ at pins

The local step finds the rotations for the map, one cell at a time; the global step finds the map
for the rotations, a Poisson solve. Neither raises the energy. One rotation per cell is the element
form of Chao et al. 2010: for surfaces it measures stretch and shear but no bending.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from diffpoisson.arguments import (
    require_instances,
    require_integer,
    require_number,
    require_single_or_double,
    require_tensor,
)
from diffpoisson.distortion import arap, closest_rotation
from diffpoisson.gradient import jacobians
from diffpoisson.mesh import Mesh
from diffpoisson.poisson import PoissonSolver


class RigidMap(NamedTuple):
    """What `as_rigid_as_possible` returns.

    Attributes:
        vertices: (…, n, c) the map of the last step, in the dtype of what was given.
        energies: (…, steps) its energy after each step, which never grows but for rounding; in the
            unit of the measures, plus that of the handles.
        moves: (steps - 1,) largest distance by which each further step moved a vertex of any map,
            as a share of the diagonal of the bounding box of the mesh; without gradients.
    """

    vertices: Float[Tensor, "*batch n c"]
    energies: Float[Tensor, "*batch steps"]
    moves: Float[Tensor, "moves"]


def as_rigid_as_possible(
    solver: PoissonSolver,
    *,
    pins: Float[Tensor, "*#batch p c"] | None = None,
    handles: Float[Tensor, "*#batch h c"] | None = None,
    start: Float[Tensor, "*#batch n c"] | None = None,
    tolerance: float | None = 1e-4,
    max_steps: int = 1000,
) -> RigidMap:
    """The map of the smallest ARAP energy near a start, where pins and handles want it.

    The gradient by pins, handles and the start is that of the last iterate: it goes back through
    every step, each of them one more solve with the factor. It is that of the minimiser, which does
    not depend on the start, only as far as the steps have converged. To save memory, minimise
    without a gradient, and give the detached map as the start of some more steps.

    Convergence is linear, and slow where long parts twist: a few percent a step, so that what is
    left to go may be a hundred times the last move.

    Args:
        solver: of planar triangles, surfaces or tetrahedra, with pins or handles.
        pins: (…, p, c) images of the solver's pins, which are met exactly.
        handles: (…, h, c) points that attract the solver's handles.
        start: (…, n, c) the map whose rotations are the first; the mesh's own positions by default.
            Only its Jacobians matter.
        tolerance: stop when a step moves no vertex by more, as a share of the diagonal of the
            mesh's bounding box. None takes `max_steps` steps whatever they do, which is what
            `vmap` and `torch.compile` need.
        max_steps: the most steps to take, one at least.

    Returns:
        The map and how it converged.

    Raises:
        RuntimeError: not converged to the tolerance after `max_steps` steps.
        ValueError: images that do not fit the solver; maps to the line, or from tetrahedra to the
            plane, which have no rotations; or the mesh's positions are no map to where the pins or
            handles are, so that a start must be given.
        TypeError: what should be a tensor is none, or not float32 or float64.
    """
    require_instances("as_rigid_as_possible", [solver], PoissonSolver)
    require_integer("as_rigid_as_possible", "max_steps", max_steps, least=1)
    if tolerance is not None:
        require_number("as_rigid_as_possible", "tolerance", tolerance)
    mesh = solver.mesh
    given = [x for x in (pins, handles, start) if x is not None]
    for x in given:
        require_tensor("as_rigid_as_possible", "pins, handles and start", x, mesh.device)
        require_single_or_double("as_rigid_as_possible", "pins, handles and start", x)
        if x.ndim < 2:
            raise ValueError(
                "as_rigid_as_possible: expected pins, handles and start of shapes (…, p, c), "
                f"(…, h, c) and (…, n, c), got {tuple(x.shape)}"
            )
    dtype = given[0].dtype if given else mesh.dtype
    pins, handles, start = (None if x is None else x.double() for x in (pins, handles, start))
    phi = _start(mesh, given, start)
    size = _diagonal(mesh)
    batch = torch.broadcast_shapes(*(x.shape[:-2] for x in (*given, phi)))
    energies: list[Tensor] = []
    moves: list[Tensor] = []
    for step in range(max_steps):
        rotations = closest_rotation(jacobians(mesh, phi))
        rotations = rotations.expand(*batch, *rotations.shape[-3:])
        previous, phi = phi, solver(rotations, pins=pins, handles=handles)
        energies.append(_energy(solver, phi, handles))
        if step > 0:  # the start need not meet the pins
            moves.append(_largest_move(previous, phi) / size)
        if tolerance is not None and moves and bool(moves[-1] <= tolerance):
            break
    else:
        if tolerance is not None:
            _give_up(moves, tolerance, max_steps)
    return RigidMap(
        phi.to(dtype),
        torch.stack(energies, dim=-1).to(dtype),
        (torch.stack(moves) if moves else phi.new_zeros(0)).to(dtype),
    )


def _start(mesh: Mesh, given: list[Tensor], start: Tensor | None) -> Float[Tensor, "*batch n c"]:
    """The map whose rotations are the first, float64."""
    c = given[0].shape[-1] if given else mesh.dim
    if (c, mesh.cell_dim) not in ((2, 2), (3, 2), (3, 3)):
        raise ValueError(
            f"as_rigid_as_possible: no rotations lead from {mesh.cell_dim}-dimensional cells to "
            f"{c} dimensions; map triangles to the plane or to space, and tetrahedra to space"
        )
    if start is not None:
        if start.shape[-2:] != (mesh.n_vertices, c):
            raise ValueError(
                f"as_rigid_as_possible: expected start of shape (…, n={mesh.n_vertices}, c={c}), "
                f"got {tuple(start.shape)}"
            )
        return start
    if c != mesh.dim:
        raise ValueError(
            f"as_rigid_as_possible: the mesh is in {mesh.dim} dimensions and its map in {c}, so "
            "that its positions can't be the start; give one, such as tutte(mesh)"
        )
    return mesh.vertices.double()


def _largest_move(
    before: Float[Tensor, "*batch n c"], after: Float[Tensor, "*#batch n c"]
) -> Float[Tensor, ""]:
    """Of any vertex of any map, without a gradient; zero if there are no maps."""
    moves = torch.linalg.vector_norm((after - before).detach(), dim=-1)
    return moves.amax() if moves.numel() else moves.new_zeros(())


def _diagonal(mesh: Mesh) -> Float[Tensor, ""]:
    """Of the bounding box."""
    return torch.linalg.vector_norm(mesh.vertices.amax(0) - mesh.vertices.amin(0))


def _give_up(moves: list[Tensor], tolerance: float, max_steps: int) -> None:
    last = f": the last one moved a vertex by {float(moves[-1]):.1e} of the size" if moves else ""
    raise RuntimeError(
        f"as_rigid_as_possible: not converged to {tolerance:.1e} after {max_steps} steps{last}; "
        "allow more of them or a larger tolerance, or take a fixed number with tolerance=None"
    )


def _energy(
    solver: PoissonSolver, phi: Float[Tensor, "*batch n c"], handles: Tensor | None
) -> Float[Tensor, "*batch"]:
    """That of a map with its own closest rotations."""
    mesh, constraints = solver.mesh, solver.constraints
    weights = constraints.face_weights * mesh._double_measures
    energy = (weights * arap(jacobians(mesh, phi))).sum(-1)
    if handles is None:
        return energy
    missed = (phi[..., constraints.handles, :] - handles).square().sum(-1)
    return energy + (constraints.handle_weights * missed).sum(-1)
