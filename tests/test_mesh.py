"""`Mesh`: what it accepts and rejects, geometry against closed forms, topology against libigl."""

from __future__ import annotations

import copy
import pickle
import re

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson.mesh import describe_indices, require_cells
from tests import meshes, references
from tests.meshes import SPATIAL, TOPOLOGIES

V = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
F = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def placed(array: np.ndarray, where: object, value: object) -> np.ndarray:
    array = array.copy()
    array[where] = value
    return array


# ------------------------------------------------------- rejected input

REJECTED = {
    "vertices as a vector": (V.ravel(), F, "vertices must be (n, 2) or (n, 3), got (12,)"),
    "4-D vertices": (np.ones((4, 4)), F, "vertices must be (n, 2) or (n, 3), got (4, 4)"),
    "integer vertices": (V.astype(int), F, "must be float32 or float64, got torch.int64; convert"),
    "half precision": (V.astype(np.float16), F, "must be float32 or float64, got torch.float16"),
    "text": (np.array([["a", "b", "c"]]), F, "must be tensors or numeric arrays"),
    "geometry gradient": (
        torch.from_numpy(V).requires_grad_(),
        F,
        "vertices require grad, but a mesh is constant",
    ),
    "planar quadrilaterals": (
        V[:, :2],
        np.array([[0, 1, 2, 3]]),
        "tetrahedra, which need vertices (n, 3), got (4, 2)",
    ),
    "float faces": (V, F.astype(float), "faces must have an integer dtype, got torch.float64"),
    "boolean faces": (V, F > 1, "faces must have an integer dtype, got torch.bool"),
    "flat quadrilaterals": (
        V * [1, 1, 0],
        np.array([[0, 1, 2, 3]]),
        "1 face [0] of zero volume (faces of four vertices are tetrahedra; triangulate quads)",
    ),
    "pentagons": (V, np.array([[0, 1, 2, 3, 0]]), "faces must be (m, 3), or (m, 4) for tetrah"),
    "no faces": (V, F[:0], "no faces; an operator needs at least one cell"),
    "no vertices": (V[:0], F, "4 faces [0, 1, 2, 3] with a vertex index outside 0 … -1"),
    "index too large": (
        V,
        placed(F, (2, 1), 4),
        "1 face [2] with a vertex index outside 0 … 3; Mesh.cleaned(vertices, faces) drops them",
    ),
    "index beyond int32": (V, placed(F, (2, 1), 2**40), "1 face [2] with a vertex index outside"),
    "negative index": (V, placed(F, ([1, 3], 0), -1), "2 faces [1, 3] with a vertex index outside"),
    "repeated index": (V, placed(F, (1, 2), 0), "1 face [1] with a repeated vertex index"),
    "nan": (placed(V, (2, 1), np.nan), F, "1 vertex [2] with a coordinate that is not finite"),
    "inf": (placed(V, ([0, 3], 1), np.inf), F, "2 vertices [0, 3] with a coordinate that is not"),
    "unreferenced": (np.r_[V, V + 2], F, "4 vertices [4, 5, 6, 7] that no face uses"),
    "many culprits": (np.r_[V, V, V], F, "8 vertices [4, 5, 6, 7, 8, …] that no face uses"),
    "zero area": (placed(V, 3, [0.3, 0, 0]), F, "1 face [1] of zero area; Mesh.cleaned"),
    "coincident vertices": (placed(V, 3, V[0]), F, "2 faces [1, 3] of zero area"),
    "zero area up to rounding": (
        np.array([[0.1, 0.3, 0], [0.1 + 0.2, 0.9, 0], [0.1 + 0.7, 2.4, 0]]),
        np.array([[0, 1, 2]]),
        "1 face [0] of zero area",
    ),
    "areas overflow": (V * 1e80, F, "areas leave the range of torch.float64; rescale"),
    "areas overflow in single precision": (
        (V * 1e20).astype(np.float32),
        F,
        "areas leave the range of torch.float32; rescale",
    ),
    "areas underflow": (V * 1e-80, F, "areas leave the range of torch.float64; rescale"),
}


@pytest.mark.parametrize(("vertices", "faces", "message"), REJECTED.values(), ids=REJECTED)
def test_rejected(vertices, faces, message):
    with pytest.raises(dp.MeshError, match=re.escape(message)) as error:
        dp.Mesh(vertices, faces)
    assert str(error.value).startswith("Mesh: ")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a second device")
def test_two_devices_are_rejected():
    with pytest.raises(dp.MeshError, match="vertices are on cpu, faces on cuda"):
        dp.Mesh(torch.from_numpy(V), torch.from_numpy(F).cuda())


@pytest.mark.parametrize("dtype", [np.int32, np.int64, np.uint32, np.uint64, np.int8])
def test_any_integer_faces(dtype):
    assert torch.equal(dp.Mesh(V, F.astype(dtype)).faces, torch.from_numpy(F))


def test_any_numpy_layout():
    """Views that torch cannot share, as `faces[:, ::-1]`, are what callers have at hand."""
    frozen = V.copy()
    frozen.setflags(write=False)
    mesh = dp.Mesh(frozen, F[:, ::-1])
    assert np.array_equal(mesh.faces, F[:, ::-1])
    swapped = dp.Mesh(np.asfortranarray(V)[::-1], 3 - F)
    assert np.array_equal(swapped.vertices, V[::-1])


@given(meshes.meshes(max_log_aspect=6))
def test_valid_at_any_scale_and_aspect(mesh):
    vertices, faces = mesh
    built = dp.Mesh(vertices, faces)
    np.testing.assert_array_equal(built.vertices, vertices)
    np.testing.assert_array_equal(built.faces, faces)
    assert (built.areas > 0).all()


@pytest.mark.parametrize("height", [1e-6, 1e-10, 1e-14])
def test_thin_triangles_are_kept(height):
    """Only what float64 cannot tell from a segment has zero area."""
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, height, 0]])
    mesh = dp.Mesh(vertices, np.array([[0, 1, 2]]))
    assert mesh.areas.item() == pytest.approx(height / 2, rel=1e-14, abs=0)
    assert dp.Mesh.cleaned(vertices, mesh.faces.numpy()).mesh.n_faces == 1


# ------------------------------------------------------- cleaning


def dirty(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A disk with every defect at once, in random order."""
    rng = np.random.default_rng(seed)
    vertices, faces = meshes.disk(seed)
    n = len(vertices)
    vertices = np.r_[vertices, [[np.nan, 0, 0], [5, 5, 5], vertices[3], vertices[3]]]
    degenerate = [[0, 1, n], [4, 4, 5], [3, n + 2, 4], [3, n + 2, n + 3]]
    vertices, faces, _, _ = meshes.renumbered(rng, vertices, np.r_[faces, degenerate])
    faces = np.r_[faces, [[0, 1, n + 4], [-1, 1, 2]]]
    return vertices, rng.permutation(faces)


def usable(vertices: np.ndarray, face: np.ndarray) -> bool:
    """The definition, face by face."""
    if not all(0 <= i < len(vertices) for i in face):
        return False
    a, b, c = vertices[face]
    return bool(np.isfinite(vertices[face]).all() and np.linalg.norm(np.cross(b - a, c - a)) > 0)


@given(meshes.seeds)
def test_cleaned_against_brute_force(seed):
    vertices, faces = dirty(seed)
    cleaned = dp.Mesh.cleaned(vertices, faces)
    good = np.array([usable(vertices, face) for face in faces])
    used = np.isin(np.arange(len(vertices)), faces[good])

    assert np.array_equal(cleaned.face_map[good], np.arange(good.sum()))
    assert (cleaned.face_map[~good] == -1).all()
    assert np.array_equal(cleaned.vertex_map[used], np.arange(used.sum()))
    assert (cleaned.vertex_map[~used] == -1).all()
    assert np.array_equal(cleaned.mesh.vertices, vertices[used])
    assert np.array_equal(cleaned.mesh.faces, cleaned.vertex_map[faces[good]])


def test_cleaned_is_idempotent():
    mesh = dp.Mesh.cleaned(*dirty(0)).mesh
    again = dp.Mesh.cleaned(mesh.vertices, mesh.faces)
    assert torch.equal(again.mesh.vertices, mesh.vertices)
    assert torch.equal(again.mesh.faces, mesh.faces)
    assert torch.equal(again.vertex_map, torch.arange(mesh.n_vertices))
    assert torch.equal(again.face_map, torch.arange(mesh.n_faces))


@pytest.mark.parametrize("name", ["sphere", "torus", "annulus", "bowtie"])
def test_cleaned_merges_a_triangle_soup(name):
    vertices, faces = SPATIAL[name](0)
    soup = vertices[faces].reshape(-1, 3)
    cleaned = dp.Mesh.cleaned(soup, np.arange(len(soup)).reshape(-1, 3), merge_duplicates=True)
    assert cleaned.mesh.n_vertices == len(vertices)
    assert torch.equal(cleaned.face_map, torch.arange(len(faces)))
    np.testing.assert_array_equal(cleaned.mesh.vertices[cleaned.mesh.faces], vertices[faces])
    np.testing.assert_array_equal(cleaned.mesh.vertices[cleaned.vertex_map], soup)


def test_cleaned_keeps_duplicates_unless_asked():
    vertices = np.r_[V[:3], V[:3]]
    faces = np.arange(6).reshape(2, 3)
    assert dp.Mesh.cleaned(vertices, faces).mesh.n_vertices == 6
    merged = dp.Mesh.cleaned(vertices, faces, merge_duplicates=True)
    assert merged.vertex_map.tolist() == [0, 1, 2, 0, 1, 2]
    assert merged.mesh.n_faces == 2


def test_cleaned_raises_when_nothing_is_left():
    with pytest.raises(dp.MeshError, match="none of the 2 faces is usable"):
        dp.Mesh.cleaned(V, np.array([[0, 0, 1], [0, 1, 9]]))
    with pytest.raises(dp.MeshError, match="none of the 1 faces is usable"):
        dp.Mesh.cleaned(V[:0], np.array([[0, 1, 2]]))
    with pytest.raises(
        dp.MeshError, match=re.escape("faces must be (m, 3), or (m, 4) for tetrahedra, got (4, 2)")
    ):
        dp.Mesh.cleaned(V, F[:, :2])


# ------------------------------------------------------- geometry


@given(meshes.meshes(max_log_aspect=3))
def test_areas(mesh):
    vertices, faces = mesh
    aspect = 1e4  # roundings of positions, relative to the height of the flattest triangle
    actual = dp.Mesh(vertices, faces)
    np.testing.assert_allclose(actual.areas, references.areas(*mesh), rtol=1e-15 * aspect)
    np.testing.assert_allclose(
        actual.vertex_areas, references.vertex_areas(*mesh), rtol=1e-15 * aspect
    )


def test_areas_of_known_shapes():
    assert dp.Mesh(V, F).areas.tolist() == pytest.approx([0.5, 0.5, np.sqrt(3) / 2, 0.5], rel=1e-15)
    plane = dp.Mesh(V[:3, :2], np.array([[0, 2, 1]]))  # clockwise
    assert plane.areas.tolist() == [0.5]


def test_needle_areas_do_not_cancel():
    """A needle of width 1e-9 whose thin corner comes first: the long edges' product cancels."""
    vertices = np.array([[0.0, 0, 0], [1, 1, 0], [1, 1 + 1e-9, 0]])
    width = (1 + 1e-9) - 1  # as stored
    assert dp.Mesh(vertices, np.array([[0, 1, 2]])).areas.item() == pytest.approx(
        width / 2, rel=1e-14, abs=0
    )


@pytest.mark.parametrize("name", TOPOLOGIES)
def test_areas_against_libigl(name):
    vertices, faces = TOPOLOGIES[name](1)
    mesh = dp.Mesh(vertices, faces)
    padded = np.c_[vertices, np.zeros((len(vertices), 3 - vertices.shape[1]))]
    mass = igl.massmatrix(padded, faces, igl.MassMatrixType.MASSMATRIX_TYPE_BARYCENTRIC)
    np.testing.assert_allclose(mesh.areas, igl.doublearea(padded, faces) / 2, rtol=1e-13)
    np.testing.assert_allclose(mesh.vertex_areas, mass.diagonal(), rtol=1e-13)
    np.testing.assert_allclose(mesh.centroids, igl.barycenter(vertices, faces), rtol=0, atol=1e-14)


@given(meshes.meshes(SPATIAL, max_log_aspect=3))
def test_frames_are_orthonormal_tangent_and_oriented(mesh):
    vertices, faces = mesh
    built = dp.Mesh(vertices, faces)
    B, normals = built.frames.numpy(), built.normals.numpy()
    E = references.edge_vectors(vertices, faces).astype(np.float64)
    lengths = np.linalg.norm(E, axis=2)
    np.testing.assert_allclose(B.transpose(0, 2, 1) @ B - np.eye(2), 0, atol=1e-15 * 8)
    np.testing.assert_allclose(np.cross(B[:, :, 0], B[:, :, 1]), normals, rtol=0, atol=1e-14)
    # E · n is a rounding of the positions, amplified by the aspect of the triangle.
    np.testing.assert_allclose(np.einsum("tad,td->ta", E, normals) / lengths, 0, atol=1e-10)
    orientation = np.einsum("td,td->t", np.cross(E[:, 0], E[:, 1]), normals)
    assert (orientation > 0).all()
    np.testing.assert_allclose(B[:, :, 0] * lengths[:, :1], E[:, 0], atol=1e-14 * lengths.max())


def test_normals_against_libigl():
    vertices, faces = meshes.sphere()
    expected = igl.per_face_normals(vertices, faces, np.zeros(3))
    np.testing.assert_allclose(dp.Mesh(vertices, faces).normals, expected, rtol=0, atol=1e-14)


def test_planar_frames_are_the_identity_also_for_clockwise_faces():
    mesh = dp.Mesh(*meshes.clockwise_disk())
    assert torch.equal(mesh.frames, torch.eye(2, dtype=torch.float64).expand(mesh.n_faces, 2, 2))
    with pytest.raises(dp.MeshError, match="normals need a mesh in space: vertices have D = 2"):
        _ = mesh.normals


# ------------------------------------------------------- topology


@given(meshes.meshes())
def test_components(mesh):
    vertices, faces = mesh
    built = dp.Mesh(vertices, faces)
    labels = built.components.numpy()
    expected = references.components(len(vertices), faces)
    # equal as partitions: each pair of labels occurs for one component only
    pairs = np.unique(np.stack([labels, expected]), axis=1).shape[1]
    assert pairs == built.n_components == expected.max() + 1 == labels.max() + 1
    assert built.n_components == igl.vertex_components(faces).max() + 1


@given(meshes.meshes())
def test_euler_characteristic(mesh):
    assert dp.Mesh(*mesh).euler_characteristic == igl.euler_characteristic(mesh[1])


def as_cycles(loops) -> set[tuple[int, ...]]:
    """Directed cycles irrespective of where they start."""
    cycles = (np.asarray(loop) for loop in loops)
    return {tuple(np.roll(cycle, -cycle.argmin()).tolist()) for cycle in cycles}


ORIENTED = {k: SPATIAL[k] for k in ("triangle", "disk", "annulus", "sphere", "torus", "parts")}


@given(meshes.meshes(ORIENTED))
def test_boundary_loops_against_libigl(mesh):
    loops = dp.Mesh(*mesh).boundary_loops
    assert as_cycles(loops) == as_cycles(igl.boundary_loop_all(mesh[1]))
    assert [len(loop) for loop in loops] == sorted(map(len, loops), reverse=True)


def test_boundary_follows_the_faces():
    """A disk's boundary is counter-clockwise: its polygon has the area of the disk."""
    vertices, faces = meshes.planar_disk()
    (loop,) = dp.Mesh(vertices, faces).boundary_loops
    (x, y), (x1, y1) = vertices[loop].T, vertices[loop.roll(-1)].T
    assert (x * y1 - x1 * y).sum() / 2 == pytest.approx(1)


def with_fin() -> tuple[np.ndarray, np.ndarray]:
    """A closed tetrahedron and one more face at its edge (0, 1): that edge is no boundary."""
    return np.r_[V, [[2.0, -1, 0]]], np.r_[F, [[0, 1, 4]]]


def pinched() -> tuple[np.ndarray, np.ndarray]:
    """A sphere and a disk glued at two vertices: χ = 2 + 1 - 2 = 1, one boundary, but no disk."""
    (ball, ball_faces), (sheet, sheet_faces) = meshes.sphere(), meshes.disk()
    vertices, faces = meshes.union((ball, ball_faces), (sheet + np.array([1.5, 0, 0]), sheet_faces))
    n, interior = len(ball), [6, 18]
    for keep, drop in zip([0, 9], interior, strict=True):
        faces[faces == n + drop] = keep
    cleaned = dp.Mesh.cleaned(vertices, faces)
    return cleaned.mesh.vertices.numpy(), cleaned.mesh.faces.numpy()


@pytest.mark.parametrize("build", [meshes.bowtie, meshes.book, with_fin])
def test_boundary_that_is_no_cycle_raises(build):
    with pytest.raises(dp.MeshError, match="boundary_loops: the boundary"):
        _ = dp.Mesh(*build()).boundary_loops


def test_edge_of_four_faces_is_no_boundary():
    """Two closed tetrahedra that share an edge."""
    vertices = np.r_[V, [[2.0, -1, 0], [2.0, -1, 1]]]
    second = np.array([0, 1, 4, 5])[F]
    assert dp.Mesh(vertices, np.r_[F, second]).boundary_loops == []


def test_boundary_of_inconsistent_faces_raises():
    vertices, faces = meshes.disk()
    faces[0] = faces[0, ::-1]
    with pytest.raises(dp.MeshError, match="orient the faces consistently"):
        _ = dp.Mesh(vertices, faces).boundary_loops


#                 is_manifold, is_disk, Euler characteristic
SHAPES = {
    meshes.triangle: (True, True, 1),
    meshes.disk: (True, True, 1),
    meshes.planar_disk: (True, True, 1),
    meshes.clockwise_disk: (False, False, 1),
    meshes.annulus: (True, False, 0),
    meshes.sphere: (True, False, 2),
    meshes.torus: (True, False, 0),
    meshes.parts: (True, False, 4),
    meshes.moebius: (False, False, 0),
    meshes.book: (False, False, 1),
    meshes.bowtie: (False, False, 1),
    with_fin: (False, False, 2),
    pinched: (False, False, 1),
}


@pytest.mark.parametrize(
    ("build", "expected"), SHAPES.items(), ids=[build.__name__ for build in SHAPES]
)
def test_shape_table(build, expected):
    mesh = dp.Mesh(*build())
    assert (mesh.is_manifold, mesh.is_disk, mesh.euler_characteristic) == expected


def test_pinched_mesh_is_what_it_claims():
    """Everything but the vertex fans says disk."""
    mesh = dp.Mesh(*pinched())
    assert mesh.n_components == 1
    assert len(mesh.boundary_loops) == 1
    assert igl.is_edge_manifold(mesh.faces.numpy())[0]
    assert not igl.is_vertex_manifold(mesh.faces.numpy()).all()


def test_disk_and_torus_apart_are_no_disk():
    mesh = dp.Mesh(*meshes.union(meshes.disk(), meshes.torus()))
    assert mesh.euler_characteristic == 1
    assert mesh.is_manifold
    assert not mesh.is_disk


# ------------------------------------------------------- immutability and copies


@pytest.mark.parametrize("name", ["vertices", "faces", "areas", "colour"])
def test_attributes_cannot_be_set(name):
    with pytest.raises(AttributeError, match=f"immutable: build a new Mesh instead of .*{name}"):
        setattr(dp.Mesh(V, F), name, None)


@pytest.mark.parametrize("as_array", [np.array, torch.tensor])
def test_later_edits_of_the_callers_arrays_do_not_matter(as_array):
    vertices, faces = as_array(V), as_array(F)
    mesh = dp.Mesh(vertices, faces)
    vertices *= 2
    faces[0] = faces[1]
    np.testing.assert_array_equal(mesh.vertices, V)
    np.testing.assert_array_equal(mesh.faces, F)


@pytest.mark.parametrize(
    "clone", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))]
)
def test_copies(clone):
    union = dp.Mesh.concatenate([dp.Mesh(V, F), dp.Mesh(*meshes.disk())])
    _ = union.frames, union.components, dp.laplacian(union)
    twin = clone(union)
    assert torch.equal(twin.vertices, union.vertices)
    assert torch.equal(twin.faces, union.faces)
    assert torch.equal(twin.frames, union.frames)
    assert (twin.vertex_offsets, twin.face_offsets) == (union.vertex_offsets, union.face_offsets)
    assert abs(dp.laplacian(twin) - dp.laplacian(union)).max() == 0
    with pytest.raises(AttributeError):
        twin.vertices = union.vertices


def test_to_another_precision():
    mesh = dp.Mesh.concatenate([dp.Mesh(V, F), dp.Mesh(V + 2, F)])
    single = mesh.to(torch.float32)
    assert single.dtype == single.areas.dtype == single.frames.dtype == torch.float32
    assert single.vertex_areas.dtype == single.normals.dtype == torch.float32
    assert single.faces.dtype == torch.int64
    assert single.n_parts == 2
    assert torch.equal(single.vertices, mesh.vertices.float())
    assert mesh.to("cpu").dtype == torch.float64


def test_to_checks_what_it_made():
    """Far from the origin, vertices that differ in float64 are equal in float32."""
    with pytest.raises(dp.MeshError, match="must be float32 or float64"):
        dp.Mesh(V, F).to(torch.float16)
    with pytest.raises(dp.MeshError, match=re.escape("4 faces [0, 1, 2, 3] of zero area")):
        dp.Mesh(V + 1e9, F).to(torch.float32)


def test_repr():
    assert repr(dp.Mesh(V, F)) == (
        "Mesh(n_vertices=4, n_faces=4, dim=3, dtype=torch.float64, device=cpu)"
    )


# ------------------------------------------------------- disjoint unions


@given(st.lists(st.sampled_from(sorted(SPATIAL)), min_size=1, max_size=4))
def test_concatenate_and_split(names):
    arrays = [SPATIAL[name](seed) for seed, name in enumerate(names)]
    whole = dp.Mesh.concatenate([dp.Mesh(*a) for a in arrays])
    vertices, faces = meshes.union(*arrays)
    np.testing.assert_array_equal(whole.vertices, vertices)
    np.testing.assert_array_equal(whole.faces, faces)
    assert whole.n_parts == len(names)
    for (part_vertices, part_faces), x, c in zip(
        arrays,
        whole.split_vertices(whole.vertices),
        whole.split_faces(whole.centroids[None], dim=1),
        strict=True,
    ):
        np.testing.assert_array_equal(x, part_vertices)
        np.testing.assert_allclose(c[0], part_vertices[part_faces].mean(1), rtol=0, atol=1e-14)
    owners = np.repeat(np.arange(len(names)), [len(v) for v, _ in arrays])
    np.testing.assert_array_equal(whole.part_of_vertex, owners)
    np.testing.assert_array_equal(owners[faces[:, 0]], whole.part_of_face)


def test_concatenating_unions_keeps_the_parts():
    mesh = dp.Mesh(V, F)
    pair = dp.Mesh.concatenate([mesh, mesh])
    assert dp.Mesh.concatenate([pair, mesh]).vertex_offsets == (0, 4, 8, 12)


def test_concatenate_rejects_what_does_not_go_together():
    mesh = dp.Mesh(V, F)
    with pytest.raises(dp.MeshError, match="needs at least one mesh"):
        dp.Mesh.concatenate([])
    with pytest.raises(dp.MeshError, match="must agree in dimension, dtype and device"):
        dp.Mesh.concatenate([mesh, mesh.to(torch.float32)])
    with pytest.raises(dp.MeshError, match="must agree in dimension"):
        dp.Mesh.concatenate([mesh, dp.Mesh(*meshes.planar_disk())])


def test_boundary_that_touches_itself_is_named():
    mesh = dp.Mesh(*meshes.bowtie())
    with pytest.raises(dp.MeshError, match=r"passes 1 vertex \[0\] more than once"):
        _ = mesh.boundary_loops


@pytest.mark.parametrize("make", [meshes.disk, meshes.torus, meshes.parts])
def test_a_union_takes_over_what_its_parts_have_computed(make):
    used = [dp.Mesh(*make(seed)) for seed in (0, 1)]
    fresh = dp.Mesh.concatenate([dp.Mesh(*make(seed)) for seed in (0, 1)])
    names = ("measures", "frames", "vertex_measures")
    for mesh in used:
        for name in (*names, "_double_measures", "_double_frames", "_double_vertex_measures"):
            getattr(mesh, name)
    union = dp.Mesh.concatenate(used)
    for name in names:
        assert name in union.__dict__
        assert torch.equal(getattr(union, name), getattr(fresh, name))
    partly = dp.Mesh.concatenate([used[0], dp.Mesh(*make(1))])
    assert "measures" not in partly.__dict__
    assert torch.equal(partly.measures, fresh.measures)


@pytest.mark.parametrize("name", SPATIAL)
def test_vertex_normals_against_libigl(name):
    mesh = dp.Mesh(*TOPOLOGIES[name]())
    vertices, faces = mesh.vertices.numpy(), mesh.faces.numpy()
    normals = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA)
    np.testing.assert_allclose(mesh.vertex_normals, normals, rtol=0, atol=1e-12)


def test_vertex_normals_that_cancel_are_zero():
    """Two faces back to back, with coordinates that do not round."""
    mesh = dp.Mesh(V[:3], np.array([[0, 1, 2], [0, 2, 1]]))
    assert torch.equal(mesh.vertex_normals, torch.zeros(3, 3, dtype=torch.float64))


@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_arrays_are_copied(kind):
    """Later edits by the caller must not reach the mesh, nor one that was moved."""
    vertices, faces = (kind(x.tolist()) for x in meshes.disk())
    mesh = dp.Mesh(vertices, faces)
    moved = mesh.with_vertices(positions := mesh.vertices * 2)
    before = mesh.vertices.clone(), mesh.faces.clone(), moved.vertices.clone()
    vertices[:], faces[:], positions[:] = 0, 0, 0
    assert all(map(torch.equal, (mesh.vertices, mesh.faces, moved.vertices), before))
    assert (mesh.vertex_offsets, mesh.face_offsets) == ((0, len(vertices)), (0, len(faces)))


def test_moved_positions_without_area_are_refused():
    vertices, faces = torch.from_numpy(V), torch.from_numpy(F)
    require_cells("f", None, faces)
    require_cells("f", vertices.float(), faces)
    for value, culprits in ((V[0], [1, 3]), (np.nan, [1, 2, 3])):
        moved = torch.from_numpy(placed(V, 3, value))
        with pytest.raises(dp.MeshError, match=re.escape(f"{len(culprits)} faces {culprits}")):
            require_cells("f", moved, faces)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda m: m.to(3), TypeError, "Mesh.to: expected a dtype or a device, got int"),
        (lambda m: m.with_vertices(V), TypeError, "Mesh.with_vertices: vertices must be a torch"),
        (lambda m: dp.Mesh.concatenate([m, 3]), TypeError, "Mesh.concatenate: expected a list of"),
        (
            lambda m: dp.Mesh(torch.from_numpy(V), torch.from_numpy(F).to("meta")),
            dp.MeshError,
            "Mesh: vertices are on cpu, faces on meta",
        ),
        (
            lambda m: dp.Mesh(torch.from_numpy(V).to_sparse(), F),
            dp.MeshError,
            "Mesh: vertices must",
        ),
        (lambda m: m.to("meta"), dp.MeshError, "Mesh: vertices must be a dense tensor"),
        (
            lambda m: dp.Mesh.cleaned(torch.from_numpy(V).requires_grad_(), F),
            dp.MeshError,
            "Mesh: vertices require grad",
        ),
        (
            lambda m: torch.vmap(lambda v: dp.Mesh.cleaned(v, F))(torch.from_numpy(V)[None]),
            dp.MeshError,
            "Mesh: vertices require grad, but a mesh is constant",
        ),
        (
            lambda m: m.split_vertices(V),
            TypeError,
            "Mesh.split_vertices: values must be a dense torch tensor, got ndarray",
        ),
        (
            lambda m: m.split_faces(torch.ones(4).to_sparse()),
            TypeError,
            "Mesh.split_faces: values must be a dense torch tensor",
        ),
        (
            lambda m: m.split_faces(torch.ones(4), dim=0.0),
            TypeError,
            "Mesh.split_faces: dim must be an integer, got float",
        ),
        (
            lambda m: m.split_faces(torch.ones(5)),
            ValueError,
            "Mesh.split_faces: expected 4 values along dim 0, got (5,)",
        ),
        (
            lambda m: m.split_vertices(torch.ones(4), dim=1),
            ValueError,
            "Mesh.split_vertices: expected 4 values along dim 1, got (4,)",
        ),
    ],
)
def test_arguments_of_other_kinds(call, error, message):
    with pytest.raises(error, match="^" + re.escape(message)):
        call(dp.Mesh(V, F))


@pytest.mark.parametrize("dtype", [np.int32, np.uint8])
def test_narrow_indices(dtype):
    assert dp.Mesh(V, F.astype(dtype)).faces.dtype == torch.int64


@pytest.mark.parametrize(
    ("legs", "dtype", "beyond"),
    [
        ((2.0**-255, 2.0**-255), np.float64, 1 / 2),  # the square of the area is least
        ((2.0**-62, 2.0**-63), np.float32, 1 / 2),
        (((2 - 2.0**-23) * 2.0**64, 2.0**64), np.float32, 2),
    ],
)
def test_areas_up_to_the_end_of_the_range(legs, dtype, beyond):
    """The least and the largest normal number are areas still."""
    a, b = legs
    face = np.array([[0, 1, 2]])
    dp.Mesh(np.array([[0, 0], [a, 0], [0, b]], dtype=dtype), face)
    with pytest.raises(dp.MeshError, match=f"areas leave the range of torch.{dtype.__name__}"):
        dp.Mesh(np.array([[0, 0], [a, 0], [0, b * beyond]], dtype=dtype), face)


def test_five_culprits_are_all_there_are():
    assert describe_indices(np.arange(5), "face", "faces") == "5 faces [0, 1, 2, 3, 4]"
    assert describe_indices(np.arange(6), "face", "faces") == "6 faces [0, 1, 2, 3, 4, …]"


def test_geometry_is_in_double_precision_whatever_the_mesh_s():
    """The two products in this determinant, 2⁻²⁶, are one number in float32."""
    e = 2.0**-13
    vertices = torch.tensor([[0, 0], [1 + e, 1], [-1, e - 1]], dtype=torch.float32)
    face = torch.tensor([[0, 1, 2]])
    mesh = dp.Mesh(vertices, face)
    assert mesh.measures.item() == e**2 / 2
    assert dp.Mesh.cleaned(vertices, face).mesh.measures.item() == e**2 / 2
    require_cells("f", vertices, face)
