"""Named mistakes that maps of bodies can have: each is put in, and a test has to notice it."""

from __future__ import annotations

import igl
import pytest
import torch

from njf_models import basis_points, body_maps, chain, encoding, field, products, sampled
from tests.njf_models import test_basis_points as basis_tests
from tests.njf_models import test_chain as chain_tests
from tests.njf_models import test_networks as network_tests
from tests.njf_models import test_sampled as sampled_tests


def mirror_images_keep_their_sides(patch):
    """Basis points see the mirror image as they saw the shape, but for signs."""
    patch.setattr(basis_points, "_PAIR", 0)
    basis_tests.test_a_mirror_image_is_seen_as_said()


def closest_vertices(patch):
    """Ways lead to the closest vertex, not to the closest point of the surface."""
    closest = igl.point_mesh_squared_distance

    def at_vertices(points, vertices, faces):
        points_as_faces = torch.arange(len(vertices))[:, None].expand(-1, 3).numpy()
        return closest(points, vertices, points_as_faces)

    patch.setattr(basis_points.igl, "point_mesh_squared_distance", at_vertices)
    basis_tests.test_ways_lead_to_the_closest_points_of_a_box()


def sums_for_products(patch):
    """Rotations that follow each other are added."""
    patch.setattr(products, "_product", lambda A, B: A + B)
    network_tests.test_products_of_matrices_are_those_of_linear_algebra()


def products_the_other_way_round(patch):
    """The joint that is nearer to the hand turns first."""
    patch.setattr(products, "_product", lambda A, B: A + B + B @ A)
    network_tests.test_products_of_matrices_are_those_of_linear_algebra()


def waves_all_alike(patch):
    """Each octave is the first one."""
    patch.setattr(field, "_OCTAVE", 1)
    network_tests.test_a_part_field_sees_waves_and_multiplies_the_matrices_that_end_its_code()


def soft_shares(patch):
    """Shares of parts are those of all alike at the start, not of the nearest few."""
    patch.setattr(field, "_SHARPNESS", 1.0)
    network_tests.test_a_part_field_is_a_sum_of_matrices_weighted_by_face_and_source()


def chain_restarts(patch):
    """Each network of a chain multiplies the surface's frames, not the Jacobians until there."""
    solved = chain.NeuralJacobianField.solved
    patch.setattr(
        chain.NeuralJacobianField,
        "solved",
        lambda self, shape, P, base=None: solved(self, shape, P),
    )
    chain_tests.test_a_map_is_of_products_of_matrices_each_read_off_the_map_before()


def poses_are_not_mirrored(patch):
    """Mirrored bodies are told the poses of the bodies that they are images of."""
    patch.setattr(body_maps, "reflected", lambda poses: poses)
    sampled_tests.test_cells_are_faces_of_their_sources_and_have_the_jacobians_of_the_whole_maps(
        body_maps.Task(sources=3)
    )


def basis_is_not_mirrored(patch):
    """What basis points see stays, where all else is mirrored."""
    patch.setattr(sampled, "reflected_basis", lambda points: points)
    basis_tests.test_cells_are_seen_from_the_basis_mirrored_with_their_bodies(
        body_maps.Task(sources=2)
    )


def matrices_are_not_offsets(patch):
    """A code has rotations, not what they differ by from the identity."""
    patch.setattr(encoding.torch, "eye", lambda n, **options: torch.zeros(n, n, **options))
    network_tests.test_a_code_has_the_matrices_of_its_rotations_and_its_shapes_scaled()


FAULTS = [
    mirror_images_keep_their_sides,
    closest_vertices,
    sums_for_products,
    products_the_other_way_round,
    waves_all_alike,
    soft_shares,
    chain_restarts,
    poses_are_not_mirrored,
    basis_is_not_mirrored,
    matrices_are_not_offsets,
]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_is_noticed(fault):
    with pytest.MonkeyPatch.context() as patch, pytest.raises(AssertionError):
        fault(patch)
