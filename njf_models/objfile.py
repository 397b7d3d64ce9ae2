"""Wavefront OBJ as text: its polygons read, and the same text written with other UVs.

Loaders of other formats hand out triangles; what an artist gets back must still have the file's own
vertices, polygons, normals, groups and comments. So writing replaces the UVs in the text that was
read, and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from njf_models.polygons import triangulated


@dataclass(frozen=True, eq=False)
class ObjFile:
    """An OBJ file's text and the geometry in it.

    Attributes:
        lines: the statements and comments, continued lines joined.
        vertices: (n, 3) float64, in the file's order.
        colours: (n, 3) float64 in [0, 1] where lines of vertices go on with colours; white where
            others do not; None where none does, or where the numbers are none.
        texcoords: (t, 2) float64.
        corners: (c, 2) int64, vertex and texcoord of the corners of all polygons, -1 for none.
        sizes: (p,) corners of each polygon.
        line_of_polygon: (p,) index into `lines`.
        material_of_polygon: (p,) index into `materials`, -1 before the first `usemtl`.
        materials: names, in order of appearance.
        libraries: MTL files that it names.
        triangles: (m, 3) int64 indices into `corners`; those of a polygon follow each other.
        polygon_of_triangle: (m,) int64.
    """

    lines: list[str]
    vertices: Float[np.ndarray, "n 3"]
    colours: Float[np.ndarray, "n 3"] | None
    texcoords: Float[np.ndarray, "t 2"]
    corners: Int[np.ndarray, "c 2"]
    sizes: Int[np.ndarray, "p"]
    line_of_polygon: Int[np.ndarray, "p"]
    material_of_polygon: Int[np.ndarray, "p"]
    materials: list[str]
    libraries: list[str]
    triangles: Int[np.ndarray, "m 3"]
    polygon_of_triangle: Int[np.ndarray, "m"]

    @property
    def has_normals(self) -> bool:
        """Whether it lists vertex normals."""
        return any(line.startswith(("vn ", "vn\t")) for line in self.lines)


def parse_obj(text: str) -> ObjFile:
    """Read vertices, texture coordinates and polygons.

    Raises:
        ValueError: a statement that cannot be understood, with its line; an index out of range.
    """
    lines = text.replace("\r\n", "\n").replace("\\\n", " ").split("\n")
    vertices: list[list[float]] = []
    colours: dict[int, list[float]] = {}
    texcoords: list[list[float]] = []
    corners: list[tuple[int, int]] = []
    sizes, line_of_polygon, material_of_polygon = [], [], []
    materials: list[str] = []
    libraries: list[str] = []
    material = -1
    for number, line in enumerate(lines):
        keyword, *values = line.split("#", 1)[0].split() or [""]
        try:
            if keyword == "v":
                x, y, z = map(float, values[:3])
                if len(values) == 6:
                    colours[len(vertices)] = [float(c) for c in values[3:]]
                vertices.append([x, y, z])
            elif keyword == "vt":
                texcoords.append([float(x) for x in (*values, "0")[:2]])
            elif keyword == "f":
                counts = (len(vertices), len(texcoords))
                corners.extend(_corner(value, counts) for value in values)
                sizes.append(len(values))
                line_of_polygon.append(number)
                material_of_polygon.append(material)
            elif keyword == "usemtl":
                name = line.split(maxsplit=1)[1].strip() if values else ""
                if name not in materials:
                    materials.append(name)
                material = materials.index(name)
            elif keyword == "mtllib":
                libraries.append(line.split(maxsplit=1)[1].strip())
        except ValueError as error:
            raise ValueError(f"line {number + 1}, {line[:60]!r}: {error}") from error
    positions = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    corner_array = np.array(corners, dtype=np.int64).reshape(-1, 2)
    _require_range(corner_array, len(positions), len(texcoords))
    triangles, polygon_of_triangle = triangulated(
        positions[corner_array[:, 0]], np.array(sizes, dtype=np.int64)
    )
    return ObjFile(
        lines,
        positions,
        _colours(colours, len(positions)),
        np.array(texcoords, dtype=np.float64).reshape(-1, 2),
        corner_array,
        np.array(sizes, dtype=np.int64),
        np.array(line_of_polygon, dtype=np.int64),
        np.array(material_of_polygon, dtype=np.int64),
        materials,
        libraries,
        triangles,
        polygon_of_triangle,
    )


def _colours(of_vertex: dict[int, list[float]], n: int) -> Float[np.ndarray, "n 3"] | None:
    """Colours of some of the vertices, which some programs write up to 255, in [0, 1]."""
    given = np.array(list(of_vertex.values()), dtype=np.float64).reshape(-1, 3)
    if not len(given) or not ((given >= 0) & (given <= 255)).all():  # others write normals there
        return None
    colours = np.ones((n, 3))
    colours[list(of_vertex)] = given / 255 if given.max() > 1 else given
    return colours


def obj_text(
    obj: ObjFile,
    texcoords: Float[np.ndarray, "t 2"],
    triangle_texcoords: Int[np.ndarray, "m 3"],
    *,
    library: str | None = None,
    material: str | None = None,
) -> str:
    """The same text with other texture coordinates.

    A polygon that a seam crosses is written as its triangles.

    Args:
        obj: the file as it was read.
        texcoords: (t, 2) new coordinates.
        triangle_texcoords: (m, 3) index of each corner of `obj.triangles`.
        library: name of the MTL file to use instead of its own.
        material: one for all polygons instead of their own.
    """
    new_corner = _texcoord_of_corner(obj, triangle_texcoords)
    whole = whole_polygons(obj, triangle_texcoords)
    start = np.concatenate([[0], np.cumsum(obj.sizes)])
    first_triangle = np.searchsorted(obj.polygon_of_triangle, np.arange(len(obj.sizes) + 1))
    polygon_at = dict(zip(obj.line_of_polygon.tolist(), range(len(obj.sizes)), strict=True))
    head = [f"vt {u:.9g} {v:.9g}" for u, v in texcoords.tolist()]
    head += _statement("usemtl", material)
    replaced = ("vt", "mtllib") if material is None else ("vt", "mtllib", "usemtl")

    def face(words: list[str], corners: Iterator[int], indices: Iterator[int]) -> str:
        parts = (words[corner].split("/") for corner in corners)
        tokens = (
            f"{p[0]}/{t + 1}" + (f"/{p[2]}" if p[2:] not in ([], [""]) else "")
            for p, t in zip(parts, indices, strict=True)
        )
        return " ".join(["f", *tokens])

    written = _statement("mtllib", library)
    for number, line in enumerate(obj.lines):
        i = polygon_at.get(number)
        if i is None:
            if (line.split(maxsplit=1) or [""])[0] not in replaced:
                written.append(line)
            continue
        written.extend(head)
        head = []
        words = line.split("#", 1)[0].split()[1:]
        if whole[i]:
            own = new_corner[start[i] : start[i + 1]].tolist()
            written.append(face(words, iter(range(len(words))), iter(own)))
        else:
            for k in range(first_triangle[i], first_triangle[i + 1]):
                local = (obj.triangles[k] - start[i]).tolist()
                written.append(face(words, iter(local), iter(triangle_texcoords[k].tolist())))
    return "\n".join(written)


def plain_obj(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    texcoords: Float[np.ndarray, "t 2"],
    triangle_texcoords: Int[np.ndarray, "m 3"],
    *,
    colours: Float[np.ndarray, "n 3"] | None = None,
    library: str | None = None,
    material: str | None = None,
) -> str:
    """An OBJ of triangles: vertices once, texture coordinates once per side of a seam.

    Colours in [0, 1] follow the positions, as many programs read them.
    """
    head = _statement("mtllib", library)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    if colours is not None:
        pairs = zip(lines, colours.tolist(), strict=True)
        lines = [f"{line} {r:.6g} {g:.6g} {b:.6g}" for line, (r, g, b) in pairs]
    head += lines
    head += [f"vt {u:.9g} {v:.9g}" for u, v in texcoords.tolist()]
    head += _statement("usemtl", material)
    corners = np.stack([faces, triangle_texcoords], axis=-1).reshape(-1, 6) + 1
    body = ["f {}/{} {}/{} {}/{}".format(*row) for row in corners.tolist()]
    return "\n".join([*head, *body, ""])


def _statement(keyword: str, name: str | None) -> list[str]:
    return [] if name is None else [f"{keyword} {name}"]


_CORNER = re.compile(r"(-?\d+)(?:/(-?\d+)?(?:/(-?\d+)?)?)?")


def _corner(word: str, counts: tuple[int, int]) -> tuple[int, int]:
    """Zero-based vertex and texcoord of "v", "v/vt", "v//vn" or "v/vt/vn"; -1 for no texcoord."""
    match = _CORNER.fullmatch(word)
    if match is None:
        raise ValueError(f"{word!r} is no corner of a face")
    v, vt = (int(value) if value else 0 for value in match.group(1, 2))
    if v == 0:
        raise ValueError("vertices are counted from 1")
    if v < -counts[0] or vt < -counts[1]:
        raise ValueError(f"{word!r} counts back beyond the first")
    return v - 1 if v > 0 else counts[0] + v, vt - 1 if vt >= 0 else counts[1] + vt


def _require_range(corners: np.ndarray, n_vertices: int, n_texcoords: int) -> None:
    kinds = (("vertex", n_vertices), ("texture coordinate", n_texcoords))
    for column, (noun, count) in enumerate(kinds):
        if len(corners) and (largest := int(corners[:, column].max())) >= count:
            raise ValueError(f"a face uses {noun} {largest + 1}, but there are {count}")


def whole_polygons(
    obj: ObjFile, triangle_texcoords: Int[np.ndarray, "m 3"]
) -> Bool[np.ndarray, "p"]:
    """Whether no seam crosses a polygon: its triangles agree on its corners' coordinates."""
    new = _texcoord_of_corner(obj, triangle_texcoords)
    differs = (new[obj.triangles] != triangle_texcoords).any(axis=1)
    whole = np.ones(len(obj.sizes), dtype=bool)
    whole[obj.polygon_of_triangle[differs]] = False
    return whole


def _texcoord_of_corner(obj: ObjFile, triangle_texcoords: np.ndarray) -> Int[np.ndarray, "c"]:
    """New index of each corner, by one of the triangles it is in."""
    new = np.full(len(obj.corners), -1)
    new[obj.triangles] = triangle_texcoords
    return new
