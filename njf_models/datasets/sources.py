"""Where meshes come from: bone scans, procedural CSG parts, a folder, Thingi10K, bent copies.

Every source is an iterable of `RawMesh`, read lazily; those that read files collect what they
could not read in `failures` instead of stopping.
"""

from __future__ import annotations

import csv
import importlib.util
import math
import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from diffpoisson.mesh import Mesh
from njf_models.datasets.fingerprint import fingerprint
from njf_models.meshfiles import read_mesh_file

_MESH_SUFFIXES = {".obj", ".off", ".ply", ".stl"}


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A mesh as its source has it, cleaned combinatorially but never moved.

    Attributes:
        name: unique among all sources.
        vertices: (n, 3) float64, in the source's own units.
        faces: (m, 3) int64.
        licence: SPDX identifier or the source's own words.
        origin: the file or generator it came from.
        family: what near-copies have in common (left and right, one template deformed, one upload);
            train and test sets are split by family.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    licence: str
    origin: str
    family: str

    def __post_init__(self) -> None:
        for field, dtype in (("vertices", np.float64), ("faces", np.int64)):
            array = getattr(self, field)
            if array.dtype != dtype or array.ndim != 2 or array.shape[1] != 3:
                raise ValueError(
                    f"RawMesh {self.name!r}: {field} must be (·, 3) {np.dtype(dtype)}, "
                    f"got {array.shape} {array.dtype}"
                )


class DogBones:
    """The dog's skeleton in the `dm_control` wheel (Apache-2.0), from scans.

    Coarse bones are refined by Loop subdivision, so that patches of equal size are details of equal
    difficulty. Right-hand bones mirror left-hand ones, so only the left are used. Vertebrae of one
    region are one family. The files are found without importing the simulator.

    Args:
        min_faces: bones with fewer faces are skipped: subdividing adds no detail.
        n_faces: bones are subdivided until they have at least as many.

    Raises:
        ModuleNotFoundError: dm_control is not installed.
    """

    def __init__(self, min_faces: int = 1100, n_faces: int = 6000) -> None:
        package = importlib.util.find_spec("dm_control")
        if package is None or not package.submodule_search_locations:
            raise ModuleNotFoundError(
                "DogBones reads the meshes in the dm_control wheel: pip install dm_control"
            )
        self.min_faces, self.n_faces = min_faces, n_faces
        self.folder = Path(package.submodule_search_locations[0]) / "suite" / "dog_assets"
        self.failures: dict[str, str] = {}

    def __iter__(self) -> Iterator[RawMesh]:
        for path in sorted(self.folder.glob("BONE*.stl")):
            bone = path.stem.removeprefix("BONE")
            # Binary STL is a header of 84 bytes, then 50 bytes per face.
            n_faces = (path.stat().st_size - 84) // 50
            if n_faces < self.min_faces or re.search(r"_R(?=_|\.|$)", bone):
                continue
            if (mesh := _read_or_report(path, self.failures)) is not None:
                mesh = _refined(*mesh, self.n_faces)
                family = f"dog/{re.sub(r'(_L)?(_[0-9]+)?$', '', bone)}"
                origin = f"dm_control/suite/dog_assets/{path.name}"
                yield RawMesh(f"dog/{bone}", *mesh, "Apache-2.0", origin, family)


class CSGParts:
    """Random solids: unions and differences of boxes, cylinders, cones and balls, evenly remeshed.

    manifold3d guarantees a manifold. Its long thin triangles are split to a fine edge length and
    shortest edges are then collapsed, which leaves nearly equilateral faces and edges rounded at
    their scale.

    Args:
        n: number of parts.
        seed: part i depends on (seed, i) only.
        n_faces: faces of each part after remeshing.
    """

    def __init__(self, n: int, seed: int = 0, n_faces: int = 6000) -> None:
        self.n, self.seed, self.n_faces = n, seed, n_faces

    def __iter__(self) -> Iterator[RawMesh]:
        for i in range(self.n):
            vertices, faces = _csg_part(np.random.default_rng([self.seed, i]), self.n_faces)
            name = f"csg/{self.seed}/{i:04d}"
            origin = f"CSGParts(seed={self.seed}, n_faces={self.n_faces})[{i}]"
            yield RawMesh(name, vertices, faces, "CC0-1.0", origin, family=name)


class MeshFolder:
    """All .obj, .off, .ply and .stl files below a folder.

    A file that cannot be read is skipped with a warning and listed in `failures`. Names that differ
    only by a number, a side, a version or a resolution are one family.

    Args:
        folder: searched recursively. A table `manifest.tsv` in it, if there is one, tells where
            meshes are from: columns `name` (a file's, without its suffix), `licence`, `source`.
        licence: recorded with every other mesh.

    Raises:
        FileNotFoundError: the folder does not exist or holds no mesh file.
    """

    def __init__(self, folder: Path | str, licence: str = "unknown") -> None:
        self.folder, self.licence = Path(folder), licence
        self.paths = sorted(p for p in self.folder.rglob("*") if p.suffix.lower() in _MESH_SUFFIXES)
        if not self.paths:
            raise FileNotFoundError(
                f"MeshFolder: no {', '.join(sorted(_MESH_SUFFIXES))} file below {self.folder}"
            )
        self.failures: dict[str, str] = {}

    def __iter__(self) -> Iterator[RawMesh]:
        manifest = _manifest(self.folder / "manifest.tsv")
        for path in self.paths:
            if (mesh := _read_or_report(path, self.failures)) is not None:
                inside = path.relative_to(self.folder)
                known = manifest.get(path.stem, {})
                licence = known.get("licence", self.licence)
                origin = f"{known['source']}: {path.name}" if "source" in known else path.name
                family = f"folder/{inside.with_name(_family(path.stem)).as_posix()}"
                yield RawMesh(f"folder/{inside.as_posix()}", *mesh, licence, origin, family)


# Endings of names that near-copies differ by: numbers, sides, versions, resolutions.
_VARIANT = re.compile(
    r"([-_ ]?v?\d+|[-_ ](l|r|left|right|side|low|high|hr|low-?res|resolution|copy))$", re.IGNORECASE
)


def _family(stem: str) -> str:
    """A file's name without such endings."""
    while (shorter := _VARIANT.sub("", stem)) and shorter != stem:
        stem = shorter
    return stem


def _manifest(table: Path) -> dict[str, dict[str, str]]:
    """Rows of a tab-separated table by their column `name`; none if there is no table."""
    if not table.exists():
        return {}
    with table.open(newline="", encoding="utf-8") as file:
        return {row["name"]: row for row in csv.DictReader(file, delimiter="\t")}


class Thingi10K:
    """Thingi10K (Zhou and Jacobson 2016) through its PyPI package, which downloads it on first use.

    Only single-component oriented manifolds are asked for. Files of one upload ("thing") are a
    family.

    Args:
        max_faces: larger meshes are not loaded.
        variant: "npz" (the original surfaces) or "tetwild" (remeshed by TetWild).
        download_folder: where the package keeps its download; by default its own cache.

    Raises:
        ModuleNotFoundError: thingi10k is not installed.
    """

    def __init__(
        self,
        max_faces: int = 50_000,
        variant: Literal["npz", "tetwild"] = "npz",
        download_folder: Path | None = None,
    ) -> None:
        if importlib.util.find_spec("thingi10k") is None:
            raise ModuleNotFoundError("Thingi10K needs its package: pip install thingi10k")
        self.max_faces, self.variant, self.download_folder = max_faces, variant, download_folder
        self.failures: dict[str, str] = {}

    def __iter__(self) -> Iterator[RawMesh]:
        import thingi10k  # noqa: PLC0415  (seconds to import, and only here)

        cache_dir = str(self.download_folder) if self.download_folder else None
        thingi10k.init(variant=self.variant, cache_dir=cache_dir)
        entries = thingi10k.dataset(
            num_facets=(None, self.max_faces), num_components=1, manifold=True, oriented=True
        )
        for entry in entries:
            name = f"thingi10k/{entry['file_id']}"
            try:
                mesh = _cleaned(*thingi10k.load_file(entry["file_path"]))
            except (OSError, ValueError) as error:
                _report(name, error, self.failures)
                continue
            origin = f"https://www.thingiverse.com/thing:{entry['thing_id']} by {entry['author']}"
            family = f"thingi10k/thing/{entry['thing_id']}"
            yield RawMesh(name, *mesh, entry["license"], origin, family)


class Bent:
    """Each mesh of a source, then copies of it under smooth random maps of space.

    A map is x ↦ D x + Σₖ aₖ sin(ωₖ · x + φₖ) in coordinates where the mesh has unit radius. The
    diagonal D stretches each axis by between 2/3 and 3/2, and ‖aₖ‖ ‖ωₖ‖ = 1/5 for each of four
    waves, whose directions are random: space folds only where all align, and seldom then.
    Connectivity stays; a copy belongs to the family of its original.

    Args:
        source: any meshes.
        copies: of each.
        seed: copy i of a mesh depends on (seed, i) and the name of the mesh only.
    """

    def __init__(self, source: Iterable[RawMesh], copies: int, seed: int = 0) -> None:
        self.source, self.copies, self.seed = source, copies, seed

    def __iter__(self) -> Iterator[RawMesh]:
        for raw in self.source:
            yield raw
            for i in range(self.copies):
                rng = np.random.default_rng([self.seed, i, int(fingerprint(raw.name), 16)])
                yield replace(
                    raw,
                    name=f"{raw.name}~{self.seed}.{i}",
                    vertices=_bent(raw.vertices, rng),
                    origin=f"{raw.origin}, bent (seed {self.seed}, copy {i})",
                )


def _bent(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A smooth random map of space, see `Bent`."""
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = np.linalg.norm(vertices - middle, axis=1).max()
    x = (vertices - middle) / radius
    stretched = x * 1.5 ** rng.uniform(-1, 1, 3)
    directions = _unit(rng.normal(size=(4, 3)))
    frequencies = rng.uniform(1.0, 6.0, 4)
    phases = np.sin(x @ (frequencies[:, None] * directions).T + rng.uniform(0, 2 * np.pi, 4))
    return middle + radius * (
        stretched + phases @ (_unit(rng.normal(size=(4, 3))) / 5 / frequencies[:, None])
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


# -------------------------------------------------------------------- files


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The triangles of one mesh file, with vertices at equal positions identified.

    Files repeat vertices at every triangle (STL) or texture seam (OBJ); nothing is moved or filled.

    Returns:
        vertices (n, 3) float64 and faces (m, 3) int64.

    Raises:
        ValueError: the file holds no usable triangle.
    """
    mesh = read_mesh_file(path).cleaned().mesh
    return mesh.vertices.numpy(), mesh.faces.numpy()


def _refined(
    vertices: np.ndarray, faces: np.ndarray, n_faces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Loop-subdivided until there are at least `n_faces` faces."""
    import igl  # noqa: PLC0415  (only needed for coarse meshes)

    levels = max(0, math.ceil(math.log(n_faces / len(faces), 4)))
    return igl.loop(vertices, faces, levels) if levels else (vertices, faces)


def _cleaned(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Copies, because loaders hand out read-only views, which torch refuses to wrap silently.
    vertices, faces = np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int64)
    mesh = Mesh.cleaned(vertices, faces, merge_duplicates=True).mesh
    return mesh.vertices.numpy(), mesh.faces.numpy()


def _read_or_report(path: Path, failures: dict[str, str]) -> tuple[np.ndarray, np.ndarray] | None:
    try:
        return read_mesh(path)
    except Exception as error:  # parsers raise anything on a malformed file; the others still count
        _report(str(path), error, failures)
        return None


def _report(name: str, error: Exception, failures: dict[str, str]) -> None:
    failures[name] = f"{type(error).__name__}: {error}"
    warnings.warn(f"skipped {name}: {failures[name]}", stacklevel=3)


# -------------------------------------------------------------------- constructive solid geometry


def _csg_part(rng: np.random.Generator, n_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """One random solid as an evenly triangulated closed surface with about `n_faces` faces."""
    import igl  # noqa: PLC0415  (only needed where parts are generated)

    solid = _primitive(rng)
    for _ in range(rng.integers(2, 6)):
        other = _primitive(rng).translate(rng.uniform(-0.7, 0.7, 3))
        solid = solid + other if rng.random() < 0.6 else solid - other
    solid = max(solid.decompose(), key=lambda piece: piece.volume())

    # The edge of n equilateral triangles of the solid's area, halved: over four times the faces.
    edge = np.sqrt(4 / np.sqrt(3) * solid.surface_area() / n_faces) / 2
    fine = solid.refine_to_length(edge).to_mesh64()
    fine_vertices = np.asfortranarray(fine.vert_properties[:, :3])
    fine_faces = np.asfortranarray(fine.tri_verts, dtype=np.int32)
    vertices, faces, *_ = igl.decimate(fine_vertices, fine_faces, n_faces)
    return _cleaned(vertices, faces)


def _primitive(rng: np.random.Generator) -> Any:
    from manifold3d import Manifold  # noqa: PLC0415  (only needed where parts are generated)

    size = rng.uniform(0.4, 1.0, 3)
    kind = rng.integers(4)
    if kind == 0:
        solid = Manifold.cube(1.5 * size, True)
    elif kind == 1:
        solid = Manifold.cylinder(2.2 * size[0], 0.6 * size[1], 0.6 * size[1], 48, True)
    elif kind == 2:
        solid = Manifold.cylinder(2.2 * size[0], 0.6 * size[1], 0.4 * size[2], 48, True)
    else:
        solid = Manifold.sphere(0.8 * size[0], 48)
    return solid.rotate(rng.uniform(0, 360, 3))
