"""Mesh files: triangles and surface colour read from OBJ, PLY, OFF, STL and GLB; UVs written.

What a file lists is kept: its vertices, the order of its triangles, an OBJ's polygons. Geometry for
`diffpoisson` is made from it by `MeshFile.cleaned`, with maps back.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

import diffpoisson as dp
from njf_models.objfile import ObjFile, obj_text, parse_obj, plain_obj, whole_polygons
from njf_models.texture import Paint, bake

READABLE = (".glb", ".obj", ".off", ".ply", ".stl")
WRITABLE = (".glb", ".obj")

# What people rename by mistake, by its first bytes.
_STRANGERS = {
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"GIF8": "a GIF picture",
    b"PK\x03\x04": "a ZIP archive",
    b"%PDF": "a PDF document",
    b"<!DOCTYPE": "an HTML page",
    b"<html": "an HTML page",
    b"version https://git-lfs": "a Git LFS pointer, not the file itself",
    b"Kaydara FBX": "an FBX file",
    b"BLENDER": "a Blender file",
}


class MeshFileError(ValueError):
    """A file that holds no usable mesh; the message says why."""


@dataclass(frozen=True, eq=False)
class MeshFile:
    """A mesh file as it was read.

    Attributes:
        path: where.
        vertices: (n, 3) float64, as the file lists them; of formats that repeat vertices at every
            triangle or seam (STL, GLB), each position of one colour once.
        faces: (m, 3) int64, the file's triangles in order, polygons triangulated; also those
            without area.
        paint: pictures on the surface, if it has any.
        obj: the text, of an OBJ.
        colours: (n, 4) uint8 RGBA of the vertices, as the file has them, if it does.
        left: what else it has that no output will, in words.
    """

    path: Path
    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    paint: Paint | None = None
    obj: ObjFile | None = None
    colours: UInt8[np.ndarray, "n 4"] | None = None
    left: tuple[str, ...] = ()

    def cleaned(self) -> dp.CleanedMesh:
        """The mesh to work on: equal positions identified, faces without area dropped.

        Raises:
            MeshFileError: no face is left.
        """
        try:
            return dp.Mesh.cleaned(self.vertices, self.faces, merge_duplicates=True)
        except dp.MeshError as error:
            raise MeshFileError(
                f"none of its {len(self.faces):,} triangles has an area"
                if "usable" in str(error)
                else str(error)
            ) from error


# -------------------------------------------------------------------- reading


def read_mesh_file(path: Path) -> MeshFile:
    """Read an OBJ, PLY, OFF, STL or GLB file.

    A scene of several objects becomes one mesh, each object placed by its transforms.

    Raises:
        MeshFileError: missing, empty, no such format, or no triangles in it.
    """
    _require_readable(path)
    mesh = _read_obj(path) if path.suffix.lower() == ".obj" else _read_scene(path)
    if not len(mesh.faces):
        n = len(mesh.vertices)
        points = f", only {n:,} point{'s' if n > 1 else ''}" if n else ""
        raise MeshFileError(f"no triangles in it{points}")
    return mesh


def _require_readable(path: Path) -> None:
    if path.suffix.lower() not in READABLE:
        known = ", ".join(READABLE)
        raise MeshFileError(f"no mesh format that is read here ({known}): {path.suffix or 'none'}")
    if path.is_dir():
        raise MeshFileError("a folder, not a file")
    try:
        with path.open("rb") as file:
            head = file.read(32)
    except FileNotFoundError:
        raise MeshFileError("no such file") from None
    except OSError as error:
        raise MeshFileError(error.strerror or str(error)) from error
    if not head:
        raise MeshFileError("the file is empty")
    for magic, kind in _STRANGERS.items():
        if head.startswith(magic):
            raise MeshFileError(f"this is {kind}, not a mesh")


def _read_obj(path: Path) -> MeshFile:
    data = path.read_bytes()
    if b"\0" in data[:4096]:
        raise MeshFileError("binary data, not the text of an OBJ file")
    try:
        obj = parse_obj(data.decode("utf-8", errors="surrogateescape"))
    except ValueError as error:
        raise MeshFileError(str(error)) from error
    if not len(obj.vertices):
        raise MeshFileError("no triangles in it: no line starts with v or f")
    faces = obj.corners[obj.triangles, 0]
    opaque = None
    if obj.colours is not None:
        rgb = np.rint(255 * obj.colours).astype(np.uint8)
        opaque = np.pad(rgb, ((0, 0), (0, 1)), constant_values=255)
    return MeshFile(path, obj.vertices, faces, _obj_paint(path, obj), obj, opaque)


def _obj_paint(path: Path, obj: ObjFile) -> Paint | None:
    """The pictures and plain colours of an OBJ's materials, if any of them is a picture."""
    texcoord = obj.corners[obj.triangles, 1]
    if not len(obj.texcoords) or not obj.materials:
        return None
    materials = _materials(path.parent, obj.libraries)
    used = [materials.get(name, {}) for name in obj.materials]
    images = [_picture(material.get("image"), material.get("kd")) for material in used]
    if all(image.shape[:2] == (1, 1) for image in images):
        return None
    images.append(_picture(None, None))  # of faces before the first material: index -1
    index = obj.material_of_polygon[obj.polygon_of_triangle] % len(images)
    uv = np.where(texcoord[..., None] >= 0, obj.texcoords[texcoord], 0.0)
    return Paint(uv, index, tuple(images))


def _materials(folder: Path, libraries: list[str]) -> dict[str, dict[str, Any]]:
    """The materials of MTL files by name; a missing file has none."""
    from trimesh.exchange.obj import parse_mtl  # noqa: PLC0415  (slow to import)
    from trimesh.resolvers import FilePathResolver  # noqa: PLC0415

    materials: dict[str, dict[str, Any]] = {}
    for name in libraries:
        library = folder / name
        if library.is_file():
            materials |= parse_mtl(library.read_bytes(), FilePathResolver(str(library))) or {}
    return materials


def _read_scene(path: Path) -> MeshFile:
    import trimesh  # noqa: PLC0415  (slow to import)

    kind = path.suffix[1:].lower()
    try:
        scene = trimesh.load_scene(path, file_type=kind, process=False)
        parts = [_placed(scene, node) for node in scene.graph.nodes_geometry]
    except Exception as error:  # parsers raise anything on a malformed file
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise MeshFileError(f"not a readable {kind.upper()} file ({reason[:150]})") from error
    surfaces = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not surfaces:
        points = sum(len(part.vertices) for part in parts)
        return MeshFile(path, np.zeros((points, 3)), np.zeros((0, 3), dtype=np.int64))
    sizes = [len(part.vertices) for part in surfaces]
    starts = np.repeat(np.cumsum(sizes) - sizes, [len(part.faces) for part in surfaces])
    vertices = np.concatenate([part.vertices for part in surfaces]).astype(np.float64)
    faces = np.concatenate([part.faces for part in surfaces]).astype(np.int64) + starts[:, None]
    wrapped = kind == "glb" and _has_wrapped_colours(path.read_bytes())
    colours = None if wrapped else _scene_colours(surfaces)
    if kind in ("stl", "glb"):
        keys = vertices if colours is None else np.concatenate([vertices, colours], axis=1)
        first, faces = _each_row_once(keys, faces)
        vertices, colours = vertices[first], None if colours is None else colours[first]
    left = (_WRAPPED,) * wrapped + _not_carried(list(scene.geometry.values()))
    return MeshFile(path, vertices, faces, _scene_paint(surfaces), None, colours, left)


def _placed(scene: Any, node: str) -> Any:
    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    part = geometry.copy().apply_transform(transform)
    attributes = getattr(geometry.visual, "vertex_attributes", {})
    if "color" in attributes:  # which trimesh does not copy
        part.visual.vertex_attributes["color"] = attributes["color"]
    return part


def _each_row_once(rows: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first of each equal rows, in their order, and the faces by their places among these."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[inverse.ravel()][faces]


def _scene_colours(surfaces: list[Any]) -> UInt8[np.ndarray, "n 4"] | None:
    """The colours of the parts' vertices, white where a part has none; None if all have none."""
    colours = [_vertex_colours(part.visual) for part in surfaces]
    if all(given is None for given in colours):
        return None
    white = np.full((1, 4), 255, dtype=np.uint8)
    pairs = zip(colours, surfaces, strict=True)
    return np.concatenate(
        [white.repeat(len(part.vertices), 0) if c is None else c for c, part in pairs]
    )


def _vertex_colours(visual: Any) -> UInt8[np.ndarray, "n 4"] | None:
    """Of trimesh's visuals, which keep those beside a material as the file has them."""
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)
    given = getattr(visual, "vertex_attributes", {}).get("color")
    if given is None:
        return None
    colours = np.asarray(given, dtype=np.float64)
    if given.dtype.kind == "u":  # else in [0, 1] already
        colours /= np.iinfo(given.dtype).max
    colours = np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return np.pad(colours, ((0, 0), (0, 4 - colours.shape[1])), constant_values=255)


_WRAPPED = "vertex colours of 16 bits without a material"


def _has_wrapped_colours(glb: bytes) -> bool:
    """Whether trimesh, which has read the file, kept the wrong half of 16-bit colours.

    It does where there is no material.
    """
    tree = json.loads(glb[20 : 20 + int.from_bytes(glb[12:16], "little")])
    primitives = [p for mesh in tree.get("meshes", []) for p in mesh["primitives"]]
    bare = [p["attributes"].get("COLOR_0") for p in primitives if "material" not in p]
    unsigned_short = 5123
    return any(
        tree["accessors"][i]["componentType"] == unsigned_short for i in bare if i is not None
    )


# Of trimesh's materials, and what they are called.
_OTHER_PICTURES = {
    "normalTexture": "normal maps",
    "metallicRoughnessTexture": "pictures of metal and roughness",
    "occlusionTexture": "pictures of occlusion",
    "emissiveTexture": "pictures of emitted light",
}


def _not_carried(geometries: list[Any]) -> tuple[str, ...]:
    """What the objects of a scene have that is not read here, in words."""
    visuals = [getattr(geometry, "visual", None) for geometry in geometries]
    words = {"colours of faces": any(getattr(v, "kind", None) == "face" for v in visuals)}
    materials = [getattr(visual, "material", None) for visual in visuals]
    for name, word in _OTHER_PICTURES.items():
        words[word] = any(getattr(material, name, None) is not None for material in materials)
    words["vertex normals"] = any("vertex_normals" in g._cache for g in geometries)
    return tuple(word for word, present in words.items() if present)


def _scene_paint(surfaces: list[Any]) -> Paint | None:
    """The base colours of the parts, if any of them is a picture."""
    images, uvs, sizes = [], [], []
    for part in surfaces:
        uv = getattr(part.visual, "uv", None)
        images.append(_base_colour(getattr(part.visual, "material", None), uv is not None))
        uvs.append(
            (np.zeros((len(part.vertices), 2)) if uv is None else np.asarray(uv))[part.faces]
        )
        sizes.append(len(part.faces))
    if all(image.shape[:2] == (1, 1) for image in images):
        return None
    return Paint(np.concatenate(uvs), np.repeat(np.arange(len(sizes)), sizes), tuple(images))


def _base_colour(material: Any, has_uv: bool) -> np.ndarray:
    """The picture of a trimesh material, or its colour."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    return _picture(image if has_uv else None, None if factor is None else factor[:3] / 255)


def _picture(image: Any, colour: Any) -> np.ndarray:
    """An (h, w, 4) uint8 picture: an image, else one pixel of a colour in [0, 1], else white."""
    if image is not None:
        return np.array(image.convert("RGBA"))
    rgb = np.ones(3) if colour is None or np.ndim(colour) == 0 else np.asarray(colour)[:3]
    return np.append(np.rint(255 * rgb), 255).astype(np.uint8).reshape(1, 1, 4)


# -------------------------------------------------------------------- writing


@dataclass(frozen=True, eq=False)
class Layout:
    """UVs of a file's triangles, in the unit square.

    Attributes:
        uv: (t, 2) in [0, 1]², both axes by the same scale.
        corners: (m, 3) int64 index into `uv` of each corner of each of the file's triangles.
        scale: of a unit of the surface in the layout.
    """

    uv: Float[np.ndarray, "t 2"]
    corners: Int[np.ndarray, "m 3"]
    scale: float


def unit_square_layout(file: MeshFile, cleaned: dp.CleanedMesh, uvmap: dp.UVMap) -> Layout:
    """The map moved and scaled into the unit square, aspect kept, for all triangles of the file.

    A triangle without area has no map; its corners get one point, that of a corner of it elsewhere.
    """
    uv = uvmap.uv.double().cpu().numpy()
    low = uv.min(axis=0)
    scale = 1 / float((uv.max(axis=0) - low).max())
    kept = cleaned.face_map.numpy() >= 0
    corners = np.zeros((len(file.faces), 3), dtype=np.int64)
    corners[kept] = uvmap.mesh.faces.cpu().numpy()
    somewhere = np.zeros(cleaned.mesh.n_vertices, dtype=np.int64)
    somewhere[uvmap.vertex_map.cpu().numpy()] = np.arange(len(uv))
    vertex = _usable_corner(cleaned.vertex_map.numpy(), file.faces[~kept])
    corners[~kept] = np.where(vertex >= 0, somewhere[vertex], 0)[:, None]
    return Layout(np.clip((uv - low) * scale, 0.0, 1.0), corners, scale)


def _usable_corner(vertex_map: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """For each face, the cleaned mesh's index of one of its corners, -1 where none is in it."""
    in_range = (faces >= 0) & (faces < len(vertex_map))
    return np.where(in_range, vertex_map[np.where(in_range, faces, 0)], -1).max(axis=1, initial=-1)


def count_crossed_polygons(file: MeshFile, layout: Layout) -> int:
    """Polygons of an OBJ that seams cross, which are written as triangles."""
    return 0 if file.obj is None else int((~whole_polygons(file.obj, layout.corners)).sum())


def not_written(file: MeshFile, suffix: str) -> list[str]:
    """What a file has that is lost when it is written with this suffix, in words."""
    missing = list(file.left)
    if file.obj is not None and suffix != ".obj" and file.obj.has_normals:
        missing.append("vertex normals")
    if file.colours is not None and suffix == ".obj" and (file.colours[:, 3] < 255).any():
        missing.append("transparency of vertex colours")
    return missing


def write_mesh_file(
    path: Path, file: MeshFile, layout: Layout, *, checkerboard: bool = False
) -> list[Path]:
    """Write a file with UVs, whole or not at all: OBJ (geometry unsplit, UVs split) or GLB.

    Pictures on the surface are baked into one for the new UVs.

    Args:
        path: .obj or .glb; a picture of the same stem and, of an OBJ, an .mtl go beside it.
        file: what was read.
        layout: its UVs.
        checkerboard: draw a checkerboard where the file has no picture of its own.

    Returns:
        The files written, `path` first.

    Raises:
        MeshFileError: the place cannot be written to.
    """
    picture = _picture_for(file, layout, checkerboard)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".njf-") as folder:
            names = _WRITERS[path.suffix.lower()](Path(folder), path.stem, file, layout, picture)
            for name in names:
                (Path(folder) / name).replace(path.parent / name)
    except OSError as error:
        raise MeshFileError(f"{path}: {error.strerror or error}") from error
    return [path.parent / name for name in reversed(names)]


def _picture_for(file: MeshFile, layout: Layout, checkerboard: bool) -> np.ndarray | None:
    if file.paint is not None:
        return bake(file.paint, layout.uv, layout.corners)
    return checker_picture() if checkerboard else None


def checker_picture(squares: int = 32, pixels: int = 32) -> np.ndarray:
    """An (h, w, 4) uint8 checkerboard."""
    board = np.indices((squares, squares)).sum(axis=0) % 2
    light, dark = np.array([[250, 247, 240, 255], [41, 107, 171, 255]], dtype=np.uint8)
    return np.where(np.kron(board, np.ones((pixels, pixels)))[..., None] > 0, dark, light)


def _write_obj(
    folder: Path, stem: str, file: MeshFile, layout: Layout, picture: np.ndarray | None
) -> list[str]:
    names = []
    if picture is not None:
        _image(picture).save(folder / f"{stem}.png")
        names = [f"{stem}.png"]
    if materials := _mtl_text(stem, file, picture):
        (folder / f"{stem}.mtl").write_bytes(materials)
        names.append(f"{stem}.mtl")
    statements = {
        "library": f"{stem}.mtl" if materials else None,
        "material": None if picture is None else "surface",
    }
    if file.obj is not None:
        text = obj_text(file.obj, layout.uv, layout.corners, **statements)
    else:
        rgb = None if file.colours is None else file.colours[:, :3] / 255
        text = plain_obj(
            file.vertices, file.faces, layout.uv, layout.corners, colours=rgb, **statements
        )
    (folder / f"{stem}.obj").write_bytes(text.encode("utf-8", errors="surrogateescape"))
    return [*names, f"{stem}.obj"]


def _mtl_text(stem: str, file: MeshFile, picture: np.ndarray | None) -> bytes:
    """Of one material with a picture, or what the file's own libraries say; may be nothing."""
    if picture is not None:
        return f"newmtl surface\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd {stem}.png\n".encode()
    libraries = [] if file.obj is None else file.obj.libraries
    paths = [file.path.parent / name for name in libraries]
    return b"\n".join(path.read_bytes() for path in paths if path.is_file())


def _write_glb(
    folder: Path, stem: str, file: MeshFile, layout: Layout, picture: np.ndarray | None
) -> list[str]:
    import trimesh  # noqa: PLC0415  (slow to import)

    pairs = np.stack([file.faces, layout.corners], axis=-1).reshape(-1, 2)
    (vertex, texcoord), index = _distinct(pairs)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=None if picture is None else _image(picture),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = trimesh.visual.TextureVisuals(layout.uv[texcoord], material=material)
    if file.colours is not None:
        visual.vertex_attributes["color"] = file.colours[vertex]
    mesh = trimesh.Trimesh(
        file.vertices[vertex], index.reshape(-1, 3), visual=visual, process=False
    )
    mesh.export(folder / f"{stem}.glb")
    return [f"{stem}.glb"]


def _distinct(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct rows (as columns), and the index of each row among them."""
    rows, index = np.unique(pairs, axis=0, return_inverse=True)
    return rows.T, index.ravel()


def _image(picture: np.ndarray) -> Any:
    from PIL import Image  # noqa: PLC0415  (slow to import)

    opaque = (picture[..., 3] == 255).all()
    return Image.fromarray(picture[..., :3] if opaque else picture)


_WRITERS = {".obj": _write_obj, ".glb": _write_glb}


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place at the end, or leaves nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".njf-") as folder:
        yield Path(folder) / path.name
        (Path(folder) / path.name).replace(path)
