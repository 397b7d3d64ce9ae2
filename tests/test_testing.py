"""What `diffpoisson.testing` offers: its meshes are what they claim, its assertions can fail."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings

import diffpoisson as dp
from diffpoisson import testing


@pytest.mark.parametrize("name", testing.TOPOLOGIES)
def test_builders_make_valid_generic_meshes(name):
    vertices, faces = testing.TOPOLOGIES[name](0)
    mesh = dp.Mesh(vertices, faces)
    assert (mesh.dim, mesh.cell_dim) == (
        2 if name in testing.PLANAR else 3,
        3 if name in testing.TETRAHEDRAL else 2,
    )
    assert not np.array_equal(testing.TOPOLOGIES[name](1)[0], vertices)  # the seed matters
    assert np.array_equal(testing.TOPOLOGIES[name](0)[0], vertices)
    assert len(mesh.measures.unique()) > 0.4 * mesh.n_faces  # few faces are alike


@pytest.mark.parametrize(
    ("name", "euler", "manifold", "components"),
    [
        ("disk", 1, True, 1),
        ("annulus", 0, True, 1),
        ("sphere", 2, True, 1),
        ("torus", 0, True, 1),
        ("moebius", 0, False, 1),
        ("book", 1, False, 1),
        ("bowtie", 1, False, 1),
        ("parts", 4, True, 3),
    ],
)
def test_topologies(name, euler, manifold, components):
    mesh = dp.Mesh(*testing.SPATIAL[name](0))
    found = (mesh.euler_characteristic, mesh.is_manifold, mesh.n_components)
    assert found == (euler, manifold, components)


@pytest.mark.parametrize("name", testing.TETRAHEDRAL)
def test_tetrahedra_are_oriented_as_they_claim(name):
    vertices, cells = testing.TETRAHEDRAL[name](0)
    volumes = np.linalg.det(vertices[cells[:, 1:]] - vertices[cells[:, :1]])
    if name == "inverted_box":
        assert (volumes[::2] < 0).all()
        volumes[::2] *= -1
    assert (volumes > 0).all()
    if "box" in name or name == "delaunay":
        assert volumes.sum() / 6 == pytest.approx(1, rel=1e-2)  # they fill the cube


def test_sphere_is_convex_and_outward():
    vertices, faces = testing.sphere(subdivisions=2)
    mesh = dp.Mesh(vertices, faces)
    assert (mesh.n_vertices, mesh.n_faces) == (162, 320)
    assert ((mesh.normals * mesh.centroids).sum(1) > 0).all()


@given(testing.meshes(testing.TOPOLOGIES, max_log_scale=1))
def test_strategy_of_meshes(mesh):
    assert isinstance(mesh, dp.Mesh)
    size = np.ptp(mesh.vertices.numpy(), axis=0).max()
    assert 0.01 < size < 200


# ------------------------------------------------------- assertions that hold


@settings(max_examples=10)
@given(testing.meshes(testing.SPATIAL, max_log_scale=2))
def test_right_functions_pass(mesh):
    phi = mesh.vertices.square()
    testing.assert_frame_invariant(lambda mesh: mesh.areas, mesh)
    testing.assert_frame_invariant(
        lambda mesh: dp.singular_values(dp.jacobians(mesh, phi)).prod(1), mesh, rtol=1e-7
    )
    testing.assert_frame_invariant(
        lambda mesh: dp.jacobians(mesh, phi), mesh, intrinsic_output=True
    )
    testing.assert_equivariant(lambda mesh: mesh.areas, mesh, per="face", degree=2)
    testing.assert_equivariant(lambda mesh: mesh.areas.sum(), mesh, degree=2)
    testing.assert_equivariant(lambda mesh: mesh.normals, mesh, per="face", rotates=True)
    testing.assert_equivariant(
        lambda mesh: mesh.vertices,
        mesh,
        per="vertex",
        rotates=True,
        translates=True,
        degree=1,
        under=("rotation", "translation", "scale", "permutation"),
    )
    testing.assert_equivariant(
        lambda mesh: mesh.vertex_areas[None], mesh, per="vertex", dim=1, degree=2
    )


# ------------------------------------------------------- assertions that fail


def mesh() -> dp.Mesh:
    return dp.Mesh(*testing.disk())


DEPENDS_ON_FRAMES = {
    "frames": (lambda mesh: mesh.frames, False),
    "intrinsic Jacobians": (lambda mesh: dp.jacobians(mesh, mesh.vertices), False),
    "areas as Jacobians": (lambda mesh: mesh.areas[:, None, None] * torch.ones(3, 2), True),
    "a column": (lambda mesh: dp.jacobians(mesh, mesh.vertices**2)[:, :, 0].norm(dim=1), False),
    "first corners": (lambda mesh: mesh.faces[:, 0].double(), False),
    "nan": (lambda mesh: mesh.areas * torch.nan, False),
}


@pytest.mark.parametrize("name", DEPENDS_ON_FRAMES)
def test_frame_dependence_is_noticed(name):
    function, intrinsic_output = DEPENDS_ON_FRAMES[name]
    with pytest.raises(AssertionError, match="depends on the choice of frames: error"):
        testing.assert_frame_invariant(function, mesh(), intrinsic_output=intrinsic_output)


def test_misread_fields_are_noticed():
    R = torch.ones(32, 1, 2, dtype=torch.float64)
    testing.assert_frame_invariant(dp.divergence, mesh(), R)
    with pytest.raises(AssertionError, match="choice of frames"):
        testing.assert_frame_invariant(lambda mesh, R: R[:, 0, 0], mesh(), R)


FOLLOWS_NOT = {
    "extents": ("rotation", lambda mesh: mesh.vertices.std(0), {"degree": 1}),
    "a normal": ("rotation", lambda mesh: mesh.normals[0], {}),
    "distances to zero": (
        "translation",
        lambda mesh: mesh.vertices.norm(dim=1),
        {"per": "vertex", "degree": 1},
    ),
    "centroids": ("translation", lambda mesh: mesh.centroids, {"per": "face", "rotates": True}),
    "areas": ("scale", lambda mesh: mesh.areas, {"per": "face", "degree": 1}),
    "total area": ("scale", lambda mesh: mesh.areas.sum(), {}),
    "areas and one": ("scale", lambda mesh: mesh.areas + 1, {"per": "face", "degree": 2}),
    "vertex areas": ("permutation", lambda mesh: mesh.vertex_areas, {"degree": 2}),
    "first area": ("permutation", lambda mesh: mesh.areas[0], {"degree": 2}),
    "indices": ("permutation", lambda mesh: mesh.faces[:, 0].double(), {"per": "face"}),
}


@pytest.mark.parametrize("name", FOLLOWS_NOT)
def test_wrong_behaviour_is_noticed_and_named(name):
    transformation, function, options = FOLLOWS_NOT[name]
    with pytest.raises(AssertionError, match=f"does not follow a {transformation}: error"):
        testing.assert_equivariant(function, mesh(), under=(transformation,), **options)


def test_each_transformation_alone():
    """The same function passes those that it follows."""
    testing.assert_equivariant(
        lambda mesh: mesh.vertices.std(0), mesh(), under=("translation", "permutation")
    )


def test_another_shape_is_noticed():
    sizes = iter([3, 4])
    with pytest.raises(AssertionError, match=r"shape \(4,\) instead of \(3,\)"):
        testing.assert_equivariant(lambda _: torch.zeros(next(sizes)), mesh(), under=["scale"])


@pytest.mark.parametrize("name", ["planar_disk", "box"])
def test_frames_without_choice(name, unchecked):
    with pytest.raises(ValueError, match="needs triangles in space"):
        testing.assert_frame_invariant(
            lambda mesh: mesh.measures, dp.Mesh(*testing.TOPOLOGIES[name](0))
        )
