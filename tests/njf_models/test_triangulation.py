"""Other triangulations follow the surface that they are embedded in, wherever it goes."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch
from torch.testing import assert_close

import diffpoisson as dp
from njf_models.datasets.triangulation import Triangulation
from tests import meshes


@pytest.fixture(scope="module")
def reference():
    return dp.Mesh(*meshes.sphere(0, subdivisions=3))


def bent(x: torch.Tensor) -> torch.Tensor:
    """Not linear, so that only points of the same face can agree."""
    return torch.stack([x[:, 0] + x[:, 1] ** 2, x[:, 1] * x[:, 2].exp(), x[:, 2].sin()], dim=1)


def test_the_original_gives_the_vertices_back_to_the_last_bit(reference):
    values = bent(reference.vertices)
    same = Triangulation.original(reference)
    assert (same.deformed(values) == values).all()
    assert same.faces is reference.faces


def test_a_decimated_surface_stays_on_the_moving_reference(reference):
    coarse = Triangulation.decimated(reference, 200)
    assert coarse.faces.shape == (200, 3)
    at_rest = dp.Mesh(coarse.deformed(reference.vertices), coarse.faces)  # valid
    assert abs(float(at_rest.areas.sum() / reference.areas.sum()) - 1) < 0.1
    moved = bent(reference.vertices)
    squared = igl.point_mesh_squared_distance(
        coarse.deformed(moved).numpy(), moved.numpy(), reference.faces.numpy()
    )[0]
    assert np.sqrt(squared.max()) < 1e-12


def test_embedded_vertices_are_the_closest_points_and_move_with_their_face(reference):
    samples = dp.sample_surface(reference, 40, generator=torch.Generator().manual_seed(0))
    points = samples.interpolate(reference, reference.vertices)
    lifted = points + 1e-4 * reference.normals[samples.faces]
    at = Triangulation.embedded(reference, lifted, torch.arange(39).reshape(13, 3))
    assert_close(at.deformed(reference.vertices), points, rtol=0, atol=1e-9)
    moved = bent(reference.vertices)
    assert_close(at.deformed(moved), samples.interpolate(reference, moved), rtol=0, atol=1e-6)


def test_weights_are_barycentric_also_on_edges_and_corners(reference):
    corners = reference.vertices[:50]
    middles = reference.vertices[reference.faces[:50, :2]].mean(1)
    at = Triangulation.embedded(reference, torch.cat([corners, middles]), reference.faces[:1])
    weights = at.points.barycentric
    assert (weights >= 0).all()
    assert_close(weights.sum(1), torch.ones(100, dtype=torch.float64), rtol=0, atol=1e-15)
    assert_close(at.deformed(reference.vertices)[:50], corners, rtol=0, atol=1e-14)


def test_grading_makes_faces_small_at_the_top(reference):
    graded = Triangulation.decimated(reference, 300, grading=2.0)
    mesh = dp.Mesh(graded.deformed(reference.vertices), graded.faces)
    z = reference.vertices[:, 2]
    height = (mesh.centroids[:, 2] - z.min()) / (z.max() - z.min())
    top, bottom = mesh.areas[height > 0.8].mean(), mesh.areas[height < 0.2].mean()
    assert 2 * 0.6 < float((bottom / top).log()) < 2 * 2.0  # areas go with squares of lengths
    moved = bent(reference.vertices)
    squared = igl.point_mesh_squared_distance(
        graded.deformed(moved).numpy(), moved.numpy(), reference.faces.numpy()
    )[0]
    assert np.sqrt(squared.max()) < 1e-12


def test_subdivision_quadruples_faces_and_brings_them_closer(reference):
    """Of a ball, whose volume the chords of a coarse mesh miss by four times as much."""
    x = reference.vertices
    ball = dp.Mesh(x / torch.linalg.vector_norm(x, dim=1, keepdim=True), reference.faces)

    def volume(triangulation):
        a, b, c = triangulation.deformed(ball.vertices)[triangulation.faces].unbind(1)
        return float((torch.linalg.cross(a, b) * c).sum() / 6)

    coarse = Triangulation.decimated(ball, 80)
    fine = coarse.subdivided()
    assert fine.faces.shape == (320, 3)
    whole = volume(Triangulation.original(ball))
    assert 0 < whole - volume(fine) < 0.4 * (whole - volume(coarse))


def test_too_few_faces_raise(reference):
    with pytest.raises(ValueError, match=r"decimated: \d+ faces are left, not 1; ask for more"):
        Triangulation.decimated(reference, 1)
