"""Named mistakes in closest rotations, as-rigid-as-possible maps, embeddings and flattening.

Like `faults.py`, for the checks of `map_checks.py`.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import torch

from diffpoisson import distortion, flattening, parameterization, rigid, rotations
from tests.faults import Fault, registrar, wrap

FAULTS: dict[str, Fault] = {}
fault = registrar(FAULTS)


# ------------------------------------------------------- closest rotations


@fault("rotations_against_scipy")
def reflection_for_rotation(patch):
    """Of a flipped cell the closest orthogonal matrix is taken, which is a reflection."""

    def orthogonal(J):
        U, _, Vt = torch.linalg.svd(J)
        return U @ Vt

    patch.setattr(rotations, "_by_singular_vectors", orthogonal)


@fault("rotations_against_scipy")
def largest_axis_turned_back(patch):
    """Of a flipped cell the largest singular value changes its sign, not the smallest."""

    def other(J):
        U, _, Vt = torch.linalg.svd(J)
        sign = torch.linalg.det(U @ Vt)[..., None, None]
        return torch.cat([sign * U[..., :1], U[..., 1:]], dim=-1) @ Vt

    patch.setattr(rotations, "_by_singular_vectors", other)


@fault("turning_at_a_rotation")
def singular_vectors_differentiated(patch):
    """Derivatives go through singular vectors, which have none where singular values meet."""

    def through(J):
        U, _, Vt = torch.linalg.svd(J)
        sign = torch.linalg.det(U @ Vt).detach()[..., None, None]
        return torch.cat([U[..., :2], sign * U[..., 2:]], dim=-1) @ Vt

    patch.setattr(distortion, "nearest_rotation", through)


@fault("turning_by_sylvester")
def constant_rotation(patch):
    """Newton's steps are left out: the rotation is a constant to all derivatives."""
    patch.setattr(rotations, "_STEPS", 0)


@fault("third_derivatives_of_rotations")
def one_newton_step(patch):
    """The second of Newton's steps is left out: first derivatives are right, others are not."""
    patch.setattr(rotations, "_STEPS", 1)


@fault("turning_by_sylvester")
def cayley_sign(patch):
    """The correction turns the wrong way."""
    wrap(patch, rotations, "_cayley", lambda f, omega: f(-omega))


@fault("turning_by_sylvester")
def cayley_half_angle(patch):
    """The correction turns by half the angle."""
    wrap(patch, rotations, "_cayley", lambda f, omega: f(omega / 2))


@fault("rotations_almost_not_unique")
def correction_to_second_order(patch):
    """The exponential of the correction is cut off, and no rotation where that is not small."""

    def cut_off(omega):
        x, y, z = omega.unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
        return torch.eye(3).to(omega) + cross + cross @ cross / 2

    patch.setattr(rotations, "_cayley", cut_off)


@fault("no_turning_where_several_are_closest")
def unique_below_rounding(patch):
    """What rounding leaves of a singular matrix is divided by."""
    blind = SimpleNamespace(**vars(torch) | {"finfo": lambda _: SimpleNamespace(eps=1e-18)})
    patch.setattr(rotations, "torch", blind)


# ------------------------------------------------------- as rigid as possible


@fault("rigid_maps_are_minima")
def rotations_of_transposes(patch):
    """The local step turns every cell the other way round."""
    wrap(patch, rigid, "closest_rotation", lambda f, J: f(J).mT)


@fault("gradient_of_a_rigid_map")
def constant_local_step(patch):
    """The rotations are constants to the gradient of an iterate."""
    wrap(patch, rigid, "closest_rotation", lambda f, J: f(J.detach()))


@fault("energies_of_rigid_maps")
def energy_of_the_last_map(patch):
    """Energies are those of the maps before each step."""
    last = []

    def late(original, solver, phi, handles):
        last.append(original(solver, phi, handles))
        return last[-2] if len(last) > 1 else last[-1]

    wrap(patch, rigid, "_energy", late)


@fault("energies_of_rigid_maps")
def energy_without_handles(patch):
    """What the handles miss is not in the energy."""
    wrap(patch, rigid, "_energy", lambda f, solver, phi, handles: f(solver, phi, None))


def with_constraints(solver, **fields):
    """A solver with other weights, for what reads these alone."""
    other = object.__new__(type(solver))
    other.mesh, other.constraints = solver.mesh, dataclasses.replace(solver.constraints, **fields)
    return other


@fault("energies_of_rigid_maps")
def energy_without_handle_weights(patch):
    """All handles count alike in the energy, as they do not in the solve."""

    def alike(original, solver, phi, handles):
        ones = torch.ones_like(solver.constraints.handle_weights)
        return original(with_constraints(solver, handle_weights=ones), phi, handles)

    wrap(patch, rigid, "_energy", alike)


@fault("energies_of_rigid_maps")
def energy_without_face_weights(patch):
    """All cells count by their measure alone in the energy, as they do not in the solve."""

    def alike(original, solver, phi, handles):
        ones = torch.ones_like(solver.constraints.face_weights)
        return original(with_constraints(solver, face_weights=ones), phi, handles)

    wrap(patch, rigid, "_energy", alike)


@fault("moves_of_rigid_maps")
def moves_by_the_farthest_vertex(patch):
    """The stop rule compares with the distance from the origin, not with the size."""
    wrap(
        patch,
        rigid,
        "_diagonal",
        lambda f, mesh: torch.linalg.vector_norm(mesh.vertices, dim=1).max(),
    )


@fault("moves_of_rigid_maps")
def moves_in_units_of_the_mesh(patch):
    """The stop rule does not compare with a size at all."""
    wrap(patch, rigid, "_diagonal", lambda f, mesh: torch.ones_like(f(mesh)))


# ------------------------------------------------------- embeddings and flattening


@fault("embeddings_are_weighted_means")
def pull_inward(patch):
    """Deeper neighbours count more, not less, so that what is deep shrinks faster."""
    patch.setattr(parameterization, "_PULLS", tuple(1 / p for p in parameterization._PULLS))


@fault("embeddings_are_weighted_means")
def depth_from_one_vertex(patch):
    """Depth counts from the first boundary vertex, not from the nearest."""
    original = parameterization.csgraph.dijkstra

    def from_one(graph, indices, **options):
        return original(graph, indices=indices[:1], **options)

    others = SimpleNamespace(dijkstra=from_one)
    patch.setattr(parameterization, "csgraph", others)


@fault("starts_that_round_to_a_flip")
def flips_as_computed_alone(patch):
    """A flip is one of the computed Jacobians, whatever the triangle's exact orientation."""
    patch.setattr(flattening, "count_flips", lambda mesh, uv: 0)


@fault("starts_that_round_to_a_flip")
def exact_flips_alone(patch):
    """A flip is one of a triangle, even where its Jacobian, which SLIM sees, rounds to one."""
    wrap(patch, flattening, "flipped", lambda f, J: torch.zeros_like(f(J)))


@fault("what_is_not_untangled_is_not_polished")
def flips_forgiven_once_untangled(patch):
    """Whatever comes out of untangling is polished."""
    original = flattening._Stages.flips.fget

    def flips(stages):
        return "untangle" not in stages.passed and original(stages)

    patch.setattr(flattening._Stages, "flips", property(flips))


@fault("what_is_not_untangled_is_not_polished")
def overlaps_forgiven(patch):
    """A map is taken for simple that overlaps itself."""
    patch.setattr(flattening._Stages, "simple", property(lambda stages: True))
