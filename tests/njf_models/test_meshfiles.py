"""Mesh files: what is read, what is written, and that nothing else of a file changes."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import diffpoisson as dp
from njf_models import meshfiles
from njf_models.meshfiles import Layout, MeshFile, MeshFileError, read_mesh_file, write_mesh_file
from njf_models.polygons import triangulated
from njf_models.texture import Paint, bake
from tests import meshes

CUBE = """# a cube of quads
mtllib cube.mtl
o cube
v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
v 9 9 9
vn 0 0 1
g sides
usemtl first
s 1
f 1//1 4//1 3//1 2//1
f -5 -4 -3 -2   # the top, counted back
g rest
f 1 2 6 5
f 2 3 7 6
l 1 2
f 3 4 8 7
f 4 1 5 8
"""


def random_layout(file: MeshFile, seed: int = 0) -> Layout:
    """Every corner with UVs of its own: a seam at every edge."""
    uv = np.random.default_rng(seed).uniform(size=(3 * len(file.faces), 2))
    return Layout(uv, np.arange(3 * len(file.faces)).reshape(-1, 3), 1.0)


def smooth_layout(file: MeshFile) -> Layout:
    """One UV per vertex: no seams."""
    uv = np.random.default_rng(0).uniform(size=(len(file.vertices), 2))
    return Layout(uv, file.faces, 1.0)


def corners_of(path: Path) -> np.ndarray:
    """Sorted rows of position and UV of all corners of all triangles, by trimesh."""
    mesh = trimesh.load_mesh(path, process=False)
    rows = np.concatenate([mesh.vertices, mesh.visual.uv], axis=1)[mesh.faces]
    return np.array(sorted(rows.reshape(-1, 15).tolist()))


def expected_corners(file: MeshFile, layout: Layout) -> np.ndarray:
    rows = np.concatenate([file.vertices[file.faces], layout.uv[layout.corners]], axis=2)
    return np.array(sorted(rows.reshape(-1, 15).tolist()))


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


# ------------------------------------------------------- polygons


def areas(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    return np.cross(b - a, c - a)[:, 2] / 2


def test_a_fan_starts_where_it_folds_nothing():
    concave = [[0, 0], [4, 0], [1, 1], [0, 4]]  # the only diagonal inside is from the third corner
    with_flat_corner = [[0, 0], [1, 0], [2, 0], [2, 1], [0, 1]]
    polygons = [concave, with_flat_corner, [[0, 0], [1, 0], [0, 1]]]
    positions = np.array([[*p, 0.0] for polygon in polygons for p in polygon])
    triangles, owner = triangulated(positions, np.array([4, 5, 3]))
    assert owner.tolist() == [0, 0, 1, 1, 1, 2]
    assert (areas(positions, triangles) > 0).all()
    np.testing.assert_allclose(np.bincount(owner, areas(positions, triangles)), [4, 2, 0.5])


def test_polygons_without_three_corners_give_no_triangle():
    triangles, owner = triangulated(np.zeros((6, 3)), np.array([2, 1, 3]))
    assert triangles.tolist() == [[3, 4, 5]]
    assert owner.tolist() == [2]


def test_a_polygon_of_many_corners_is_covered_once():
    angle = np.linspace(0, 2 * np.pi, 1000, endpoint=False)
    positions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    triangles, _ = triangulated(positions, np.array([1000]))
    assert areas(positions, triangles).sum() == pytest.approx(np.pi, rel=1e-4)
    assert (areas(positions, triangles) > 0).all()


# ------------------------------------------------------- reading


def test_an_obj_keeps_its_vertices_and_polygons(tmp_path):
    file = read_mesh_file(write(tmp_path, "cube.obj", CUBE))
    assert file.vertices.shape == (9, 3)
    assert file.faces.shape == (12, 3)
    mesh = file.cleaned().mesh
    assert (mesh.n_vertices, mesh.euler_characteristic, mesh.boundary_loops) == (8, 2, [])
    # Outward: the divergence theorem gives the volume.
    corners = mesh.vertices[mesh.faces]
    assert float(corners.det().sum()) / 6 == pytest.approx(1)


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".stl", ".glb"])
def test_formats_agree(tmp_path, suffix):
    vertices, faces = meshes.sphere()
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / f"a{suffix}")
    file = read_mesh_file(tmp_path / f"a{suffix}")
    rtol = 1e-6 if suffix in (".stl", ".glb") else 1e-7  # single precision, or printed digits
    assert len(file.vertices) == len(vertices)
    np.testing.assert_allclose(file.vertices[file.faces], vertices[faces], rtol=rtol, atol=1e-7)
    if suffix in (".obj", ".off", ".ply"):
        np.testing.assert_array_equal(file.faces, faces)


def test_objects_of_a_scene_stand_where_they_stood(tmp_path):
    box = trimesh.creation.box()
    scene = trimesh.Scene()
    scene.add_geometry(box, transform=trimesh.transformations.translation_matrix([5, 0, 0]))
    mirrored = np.diag([-2.0, 1, 1, 1])
    scene.add_geometry(box, transform=mirrored)
    scene.add_geometry(trimesh.PointCloud(np.zeros((4, 3))))
    scene.export(tmp_path / "scene.glb")
    mesh = read_mesh_file(tmp_path / "scene.glb").cleaned().mesh
    assert (mesh.n_vertices, mesh.n_faces, mesh.n_components) == (16, 24, 2)
    assert mesh.vertices.amin(0).tolist() == [-1, -0.5, -0.5]
    assert mesh.vertices.amax(0).tolist() == [5.5, 0.5, 0.5]
    # Both outward, also the mirrored one.
    assert float(mesh.vertices[mesh.faces].det().sum()) / 6 == pytest.approx(3)


PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(64))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.obj", None, "no such file"),
        ("empty.obj", b"", "the file is empty"),
        ("picture.obj", PNG, "this is a PNG picture, not a mesh"),
        ("picture.stl", PNG, "this is a PNG picture, not a mesh"),
        ("picture.glb", PNG, "this is a PNG picture, not a mesh"),
        ("lfs.ply", b"version https://git-lfs.github.com/spec/v1\n", "Git LFS pointer"),
        ("words.obj", b"To whom it may concern,\nno mesh here.\n", "no line starts with v or f"),
        ("binary.obj", bytes(range(200)), "binary data"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\n", "no triangles in it, only 2 points"),
        ("lines.obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n", "no triangles in it"),
        ("range.obj", b"v 0 0 0\nf 1 2 3\n", "a face uses vertex 3, but there are 1"),
        ("back.obj", b"v 0 0 0\nf -1 -2 -3\n", r"line 2, 'f -1 -2 -3': '-2' counts back beyond"),
        ("zero.obj", b"v 0 0 0\nf 0 1 1\n", "vertices are counted from 1"),
        ("number.obj", b"v 0 0 x\n", r"line 1, 'v 0 0 x': could not convert"),
        ("short.obj", b"v 0 0\n", r"line 1, 'v 0 0'"),
        ("garbage.stl", b"\x07" * 200, "no triangles in it"),
        ("garbage.ply", b"ply\nformat ascii 1.0\nelement", "not a readable PLY file"),
        ("garbage.off", b"OFF\n1 2\n", "not a readable OFF file"),
        ("garbage.glb", b"glTF\x02\0\0\0", "not a readable GLB file"),
        ("mesh.fbx", b"Kaydara", r"no mesh format that is read here \(.*\.obj.*\): \.fbx"),
        ("folder.obj", "folder", "a folder, not a file"),
    ],
)
def test_errors_say_what_the_file_is(tmp_path, name, content, message):
    path = tmp_path / name
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshFileError, match=message) as raised:
        read_mesh_file(path)
    assert "\n" not in str(raised.value)


def test_point_clouds_are_counted(tmp_path):
    trimesh.PointCloud(np.random.default_rng(0).uniform(size=(1234, 3))).export(tmp_path / "a.ply")
    with pytest.raises(MeshFileError, match="no triangles in it, only 1,234 points"):
        read_mesh_file(tmp_path / "a.ply")


def test_a_mesh_without_area_is_no_mesh(tmp_path):
    path = write(tmp_path, "flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(MeshFileError, match="none of its 1 triangles has an area"):
        read_mesh_file(path).cleaned()


# ------------------------------------------------------- writing


@pytest.mark.parametrize("layout", [random_layout, smooth_layout])
@pytest.mark.parametrize("source", ["cube.obj", "sphere.ply", "sphere.stl"])
@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_another_reader_finds_the_uvs(tmp_path, source, suffix, layout):
    if source == "cube.obj":
        write(tmp_path, source, CUBE)
    else:
        trimesh.Trimesh(*meshes.sphere(), process=False).export(tmp_path / source)
    file = read_mesh_file(tmp_path / source)
    uvs = layout(file)
    path = tmp_path / "out" / f"mesh{suffix}"
    assert write_mesh_file(path, file, uvs) == [path]
    actual, expected = corners_of(path), expected_corners(file, uvs)
    if (source, layout) == ("cube.obj", smooth_layout):  # quads, which trimesh halves its own way
        actual, expected = (
            np.unique(x.reshape(-1, 5).round(6), axis=0) for x in (actual, expected)
        )
    np.testing.assert_allclose(actual, expected, atol=1e-6)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_own_reader_finds_what_was_written_exactly(tmp_path):
    file = read_mesh_file(write(tmp_path, "cube.obj", CUBE))
    layout = random_layout(file)
    write_mesh_file(tmp_path / "out.obj", file, layout)
    again = read_mesh_file(tmp_path / "out.obj")
    np.testing.assert_array_equal(again.vertices, file.vertices)
    np.testing.assert_array_equal(again.faces, file.faces)
    assert again.obj is not None
    uv = again.obj.texcoords[again.obj.corners[again.obj.triangles, 1]]
    np.testing.assert_allclose(uv, layout.uv[layout.corners], atol=1e-9)


def test_only_the_uvs_of_an_obj_change(tmp_path):
    """Quads stay quads where no seam crosses them; normals, groups and comments stay."""
    file = read_mesh_file(write(tmp_path, "cube.obj", CUBE))
    write_mesh_file(tmp_path / "out.obj", file, smooth_layout(file))
    lines = (tmp_path / "out.obj").read_text().split("\n")
    changed = ("f ", "vt ", "mtllib")
    kept = [line for line in lines if not line.startswith(changed)]
    assert kept == [line for line in CUBE.split("\n") if not line.startswith(changed)]
    faces = [line for line in lines if line.startswith("f ")]
    assert faces[0] == "f 1/1/1 4/4/1 3/3/1 2/2/1"
    assert faces[1] == "f -5/5 -4/6 -3/7 -2/8"
    assert len(faces) == 6
    assert sum(line.startswith("vt ") for line in lines) == 9


def test_a_polygon_is_cut_where_a_seam_crosses_it(tmp_path):
    file = read_mesh_file(write(tmp_path, "cube.obj", CUBE))
    layout = smooth_layout(file)
    corners = layout.corners.copy()
    corners[2] += len(layout.uv)  # a triangle of the second quad, all its own
    layout = Layout(np.concatenate([layout.uv, layout.uv]), corners, 1.0)
    write_mesh_file(tmp_path / "out.obj", file, layout)
    faces = [x for x in (tmp_path / "out.obj").read_text().split("\n") if x.startswith("f ")]
    assert [len(face.split()) - 1 for face in faces] == [4, 3, 3, 4, 4, 4, 4]
    np.testing.assert_array_equal(read_mesh_file(tmp_path / "out.obj").faces, file.faces)


def disk_file(tmp_path: Path, text: str = "") -> tuple[MeshFile, dp.CleanedMesh, dp.UVMap]:
    vertices, faces = meshes.disk(0, 5)
    lines = ["v {} {} {}".format(*v) for v in vertices.tolist()]
    lines += ["f {} {} {}".format(*(f + 1)) for f in faces]
    file = read_mesh_file(write(tmp_path, "disk.obj", "\n".join([*lines, text])))
    cleaned = file.cleaned()
    return file, cleaned, dp.parameterize(cleaned.mesh)


def test_uvs_fill_the_unit_square_and_keep_their_aspect(tmp_path):
    file, cleaned, uvmap = disk_file(tmp_path)
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    assert layout.uv.min() == 0
    assert layout.uv.max() == 1
    uv = uvmap.uv.numpy()
    np.testing.assert_allclose(layout.uv - layout.uv[0], (uv - uv[0]) * layout.scale, atol=1e-12)


def test_triangles_without_area_keep_their_place(tmp_path):
    """Also one at a position that only it uses, and one with a corner listed twice."""
    more = "v 7 7 7\nv 7 7 7\nv 7 7 7\nf 1 1 2\nf 26 27 28\nf 1 2 1\n"
    file, cleaned, uvmap = disk_file(tmp_path, more)
    assert cleaned.mesh.n_faces == len(file.faces) - 3
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    assert (layout.corners[-3:] == layout.corners[-3:, :1]).all()
    at = layout.uv[layout.corners[-3:, 0]]
    on_corner = {tuple(p) for p in layout.uv[layout.corners[:-3]][(file.faces[:-3] <= 1)].tolist()}
    assert tuple(at[0]) in on_corner
    assert tuple(at[2]) in on_corner
    write_mesh_file(tmp_path / "out.obj", file, layout)
    np.testing.assert_array_equal(read_mesh_file(tmp_path / "out.obj").faces, file.faces)


def test_a_write_that_fails_leaves_nothing(tmp_path, monkeypatch):
    file, cleaned, uvmap = disk_file(tmp_path)
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    target = write(tmp_path, "out.obj", "precious")

    def interrupted(folder: Path, stem: str, *_: object) -> list[str]:
        (folder / f"{stem}.obj").write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setitem(meshfiles._WRITERS, ".obj", interrupted)
    before = sorted(tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt):
        write_mesh_file(target, file, layout)
    assert sorted(tmp_path.iterdir()) == before
    assert target.read_text() == "precious"


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    file, cleaned, uvmap = disk_file(tmp_path)
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    write(tmp_path, "folder", "a file")
    with pytest.raises(MeshFileError, match=r"folder/out\.obj: "):
        write_mesh_file(tmp_path / "folder" / "out.obj", file, layout)


# ------------------------------------------------------- pictures


def gradient(height: int, width: int) -> np.ndarray:
    """Red grows to the right, green downwards."""
    rows, columns = np.mgrid[0:height, 0:width]
    image = np.zeros((height, width, 4), dtype=np.uint8)
    image[..., 0], image[..., 1] = 255 * columns / (width - 1), 255 * rows / (height - 1)
    image[..., 3] = 255
    return image


def test_baking_shows_the_same_on_the_surface():
    """Two triangles with pictures of their own, swapped and turned in the new layout."""
    old = np.array([[[0.1, 0.1], [0.9, 0.1], [0.5, 0.8]], [[0.2, 0.3], [0.7, 0.2], [0.6, 0.9]]])
    blue = np.array([[[0, 0, 200, 255]]], dtype=np.uint8)
    paint = Paint(old, np.array([0, 1]), (gradient(300, 400), blue))
    uv = np.array([[0.9, 0.1], [0.9, 0.9], [0.6, 0.5], [0.1, 0.1], [0.5, 0.1], [0.1, 0.7]])
    corners = np.array([[0, 1, 2], [3, 4, 5]])
    baked = bake(paint, uv, corners)
    assert baked.shape == (400, 400, 4)
    weights = np.array([[0.4, 0.3, 0.3], [0.1, 0.8, 0.1], [0.2, 0.1, 0.7]])
    for new, expected in ((weights @ uv[:3], weights @ old[0]),):
        row, column = ((1 - new[:, 1]) * 400).astype(int), (new[:, 0] * 400).astype(int)
        seen = baked[row, column]
        np.testing.assert_allclose(seen[:, 0], 255 * expected[:, 0], atol=3)
        np.testing.assert_allclose(seen[:, 1], 255 * (1 - expected[:, 1]), atol=3)
    new = weights @ uv[3:]
    inside = baked[((1 - new[:, 1]) * 400).astype(int), (new[:, 0] * 400).astype(int)]
    assert (inside == [0, 0, 200, 255]).all()
    assert (baked[-5, 5] == [0, 0, 200, 255]).all()  # beyond the layout, the nearest colour


TEXTURED = """mtllib materials/two.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl picture
f 1/1 2/2 3/3
usemtl plain
f 1/1 3/3 4/4
"""


@pytest.fixture
def textured(tmp_path: Path) -> Path:
    (tmp_path / "materials").mkdir()
    mtl = "newmtl picture\nmap_Kd ramp.png\nnewmtl plain\nKd 0 0 1\n"
    write(tmp_path / "materials", "two.mtl", mtl)
    Image.fromarray(gradient(64, 64)).save(tmp_path / "materials" / "ramp.png")
    return write(tmp_path, "square.obj", TEXTURED)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_pictures_and_colours_are_kept(tmp_path, textured, suffix):
    file = read_mesh_file(textured)
    uv = np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])  # a quarter turn
    written = write_mesh_file(tmp_path / f"out{suffix}", file, Layout(uv, file.faces, 1.0))
    names = [path.name for path in written]
    assert names == (["out.obj", "out.mtl", "out.png"] if suffix == ".obj" else ["out.glb"])
    mesh = trimesh.load_mesh(written[0], process=False)
    material = mesh.visual.material
    image = np.asarray(getattr(material, "image", None) or material.baseColorTexture)
    centre = mesh.visual.uv[mesh.faces].mean(axis=1)
    position = mesh.vertices[mesh.faces].mean(axis=1)
    for (u, v), (x, y, _) in zip(centre, position, strict=True):
        colour = image[int((1 - v) * len(image)), int(u * len(image))][:3]
        wanted = [255 * x, 255 * (1 - y), 0] if x > y else [0, 0, 255]
        np.testing.assert_allclose(colour, wanted, atol=4)


def test_a_glb_picture_is_read(tmp_path):
    square = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        [[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(
            [[0, 0], [1, 0], [1, 1], [0, 1]],
            material=trimesh.visual.material.PBRMaterial(
                baseColorTexture=Image.fromarray(gradient(16, 16))
            ),
        ),
        process=False,
    )
    square.export(tmp_path / "a.glb")
    paint = read_mesh_file(tmp_path / "a.glb").paint
    assert paint is not None
    np.testing.assert_array_equal(paint.images[0], gradient(16, 16))
    np.testing.assert_allclose(paint.uv[0], [[0, 0], [1, 0], [1, 1]], atol=1e-6)


def test_plain_materials_stay(tmp_path):
    """Without a picture there is nothing to bake: names and colours are kept as they are."""
    (tmp_path / "in").mkdir()
    write(tmp_path / "in", "cube.mtl", "newmtl first\nKd 1 0 0\n")
    file = read_mesh_file(write(tmp_path / "in", "cube.obj", CUBE))
    written = write_mesh_file(tmp_path / "out.obj", file, smooth_layout(file))
    assert [path.name for path in written] == ["out.obj", "out.mtl"]
    text = written[0].read_text()
    assert [x for x in text.split("\n") if "mtl" in x] == ["mtllib out.mtl", "usemtl first"]
    assert trimesh.load_mesh(written[0]).visual.material.diffuse.tolist() == [255, 0, 0, 255]


def test_a_missing_picture_is_no_picture(tmp_path):
    file = read_mesh_file(write(tmp_path, "a.obj", TEXTURED))
    assert file.paint is None


def test_a_checkerboard_where_there_is_no_picture(tmp_path):
    file, cleaned, uvmap = disk_file(tmp_path)
    layout = meshfiles.unit_square_layout(file, cleaned, uvmap)
    write_mesh_file(tmp_path / "out.obj", file, layout, checkerboard=True)
    image = np.asarray(trimesh.load_mesh(tmp_path / "out.obj").visual.material.image)
    assert len(np.unique(image.reshape(-1, image.shape[-1]), axis=0)) == 2


# ------------------------------------------------------- colours of vertices


def coloured_sphere(path: Path, opaque: bool = True) -> np.ndarray:
    """Write a sphere of random colours; positions and colours of its vertices."""
    vertices, faces = meshes.sphere()
    colours = np.random.default_rng(0).integers(0, 256, (len(vertices), 4)).astype(np.uint8)
    if opaque:
        colours[:, 3] = 255
    trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False).export(path)
    return np.concatenate([vertices, colours], axis=1)


def coloured_corners(path: Path) -> np.ndarray:
    """Sorted rows of position and colour of all corners, by trimesh or from the text."""
    if path.suffix == ".glb":
        (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
        rows = np.concatenate([mesh.vertices, mesh.visual.vertex_attributes["color"]], axis=1)
        corners = rows[mesh.faces]
    else:
        lines = [line.split() for line in path.read_text().split("\n")]
        rows = np.array([line[1:] for line in lines if line[:1] == ["v"]], dtype=np.float64)
        rows[:, 3:] *= 255
        index = [[int(word.split("/")[0]) for word in x[1:]] for x in lines if x[:1] == ["f"]]
        corners = rows[np.array(index) - 1]
    return np.array(sorted(corners.round(3).reshape(len(corners), -1).tolist()))


@pytest.mark.parametrize("source", [".ply", ".obj", ".glb"])
@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_colours_of_vertices_are_carried_through_the_cut(tmp_path, source, suffix):
    rows = coloured_sphere(tmp_path / f"in{source}")
    file = read_mesh_file(tmp_path / f"in{source}")
    cleaned = file.cleaned()
    layout = meshfiles.unit_square_layout(file, cleaned, dp.parameterize(cleaned.mesh, cut=True))
    write_mesh_file(tmp_path / f"out{suffix}", file, layout)
    assert len(layout.uv) > len(rows)  # there are seams
    columns = rows if suffix == ".glb" else rows[:, :6]
    corners = columns[meshes.sphere()[1]].round(3)
    expected = np.array(sorted(corners.reshape(len(corners), -1).tolist()))
    np.testing.assert_allclose(coloured_corners(tmp_path / f"out{suffix}"), expected, atol=2e-3)
    assert meshfiles.not_written(file, suffix) == []


def test_colours_that_meet_at_a_position_stay_apart(tmp_path):
    """A GLB lists a vertex per colour; the geometry is joined all the same."""
    vertices, faces = meshes.sphere()
    soup = trimesh.Trimesh(vertices[faces].reshape(-1, 3), process=False)
    soup.faces = np.arange(3 * len(faces)).reshape(-1, 3)
    colours = np.repeat(np.random.default_rng(0).integers(0, 256, (len(faces), 3)), 3, axis=0)
    soup.visual.vertex_colors = colours.astype(np.uint8)
    soup.export(tmp_path / "a.glb")
    file = read_mesh_file(tmp_path / "a.glb")
    assert file.colours is not None
    np.testing.assert_array_equal(file.colours[file.faces].reshape(-1, 4)[:, :3], colours)
    assert file.cleaned().mesh.n_vertices == len(vertices)


def test_objects_without_colours_are_white_among_others(tmp_path):
    scene = trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosahedron()])
    next(iter(scene.geometry.values())).visual.vertex_colors = [10, 20, 30, 255]
    scene.export(tmp_path / "a.glb")
    colours = read_mesh_file(tmp_path / "a.glb").colours
    assert colours is not None
    assert sorted(map(tuple, np.unique(colours, axis=0).tolist())) == [
        (10, 20, 30, 255),
        (255, 255, 255, 255),
    ]


def triangle_glb(colours: np.ndarray, component: int, material: bool) -> bytes:
    """A triangle, by the letter of the glTF specification."""
    points = np.eye(3, dtype=np.float32).tobytes()
    size = len(points) + colours.nbytes
    primitive: dict = {"attributes": {"POSITION": 0, "COLOR_0": 1}}
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": size}],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(points)},
            {"buffer": 0, "byteOffset": len(points), "byteLength": colours.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": component, "count": 3, "type": "VEC4"}
            | ({} if component == 5126 else {"normalized": True}),
        ],
    }
    if material:
        tree["materials"] = [{}]
        primitive["material"] = 0
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + size, len(text), 0x4E4F534A)
    return head + text + struct.pack("<II", size, 0x004E4942) + points + colours.tobytes()


@pytest.mark.parametrize("material", [True, False])
@pytest.mark.parametrize(("component", "dtype"), [(5121, "u1"), (5123, "<u2"), (5126, "<f4")])
def test_colours_of_all_types(tmp_path, component, dtype, material):
    wanted = np.array([[255, 0, 51, 255], [0, 102, 255, 255], [1, 2, 3, 204]])
    largest = {"u1": 255, "<u2": 65535, "<f4": 1.0}[dtype]
    stored = (wanted / 255 * largest).astype(dtype)
    (tmp_path / "a.glb").write_bytes(triangle_glb(stored, component, material))
    file = read_mesh_file(tmp_path / "a.glb")
    if dtype == "<u2" and not material:
        assert file.colours is None
        assert "vertex colours of 16 bits" in meshfiles.not_written(file, ".glb")[0]
    else:
        np.testing.assert_array_equal(file.colours, wanted)
        assert meshfiles.not_written(file, ".obj") == ["transparency of vertex colours"]
        assert meshfiles.not_written(file, ".glb") == []


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ("1 0.2 0", [255, 51, 0, 255]),
        ("255 51 0", [255, 51, 0, 255]),
        ("0 0 -1", None),  # normals, as some programs write them
        ("1 0 nan", None),
        ("1", None),  # a weight
    ],
)
def test_colours_of_an_obj(tmp_path, numbers, expected):
    text = f"v 0 0 0 {numbers}\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    colours = read_mesh_file(write(tmp_path, "a.obj", text)).colours
    if expected is None:
        assert colours is None
    else:
        np.testing.assert_array_equal(colours, [expected, [255] * 4, [255] * 4])


def test_what_is_lost_is_named(tmp_path):
    rows = meshes.sphere()
    faces = trimesh.Trimesh(*rows, face_colors=[200, 0, 0, 255], process=False)
    faces.export(tmp_path / "faces.ply")
    assert meshfiles.not_written(read_mesh_file(tmp_path / "faces.ply"), ".obj") == [
        "colours of faces"
    ]
    smooth = trimesh.Trimesh(*rows, process=False)
    assert len(smooth.vertex_normals)  # made at their first use
    smooth.visual = trimesh.visual.TextureVisuals(
        np.zeros((len(rows[0]), 2)),
        trimesh.visual.material.PBRMaterial(normalTexture=Image.fromarray(gradient(4, 4))),
    )
    smooth.export(tmp_path / "smooth.glb")
    assert meshfiles.not_written(read_mesh_file(tmp_path / "smooth.glb"), ".glb") == [
        "normal maps",
        "vertex normals",
    ]
    cube = read_mesh_file(write(tmp_path, "cube.obj", CUBE))
    assert meshfiles.not_written(cube, ".obj") == []
    assert meshfiles.not_written(cube, ".glb") == ["vertex normals"]
