"""The mesh on which every operator of this package is defined, validated once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, NoReturn

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from diffpoisson import cells, topology
from diffpoisson.arguments import as_tensor, require_instances, require_integer, require_tensor
from diffpoisson.transforms import constant_property, is_constant, outside_transforms

ArrayLike = Tensor | np.ndarray


class MeshError(ValueError):
    """The arrays do not describe a usable mesh; the message names the culprits and the remedy."""


class CleanedMesh(NamedTuple):
    """What `Mesh.cleaned` returns.

    Attributes:
        mesh: the valid mesh.
        vertex_map: (n_before,) int64, the new index of each old vertex, -1 where it was dropped.
        face_map: (m_before,) int64, the new index of each old face, -1 where it was dropped.
    """

    mesh: Mesh
    vertex_map: Tensor
    face_map: Tensor


# Cached properties of a mesh that do not depend on its vertices.
_OF_FACES = (
    "components",
    "euler_characteristic",
    "is_manifold",
    "boundary_loops",
    "is_disk",
    "part_of_vertex",
    "part_of_face",
)


# Cached properties that a union takes from its parts, one after the other.
_OF_PARTS = (
    "_determinants",
    "_double_measures",
    "_double_frames",
    "_double_vertex_measures",
    "measures",
    "frames",
    "vertex_measures",
)


class Mesh:
    """An immutable mesh: triangles in the plane (D = 2) or in space (D = 3), or tetrahedra.

    Open, closed, disconnected, non-orientable and non-manifold meshes are all fine; what is not is
    listed under *Raises*. Lengths are in the mesh's own units. Geometry is computed in float64 and
    handed out in the dtype of `vertices`. Where this package says face, a tetrahedral mesh has its
    tetrahedra.

    Args:
        vertices: (n, D) float32 or float64 positions.
        faces: (m, 3) integer vertex indices, counter-clockwise seen from the side the normal points
            to; or (m, 4) for tetrahedra, positively oriented like (0, x, y, z).

    Raises:
        MeshError: wrong shape or dtype, no faces, an index out of range or repeated within a face,
            a vertex that is not finite, that requires grad, or that no face uses, or a face of zero
            area or volume. The message gives counts, the first indices, and the remedy.
    """

    vertices: Tensor
    faces: Tensor
    vertex_offsets: tuple[int, ...]
    face_offsets: tuple[int, ...]

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        _require_constant(vertices)
        with outside_transforms():
            vertices, faces = _as_tensors(vertices, faces)
            _validate(vertices, faces)
            # Copies: editing the caller's arrays afterwards must not invalidate a cached factor.
            self._assign(vertices.clone(), faces.clone(), (0, len(vertices)), (0, len(faces)))
            self._check_cells()

    def _assign(
        self,
        vertices: Tensor,
        faces: Tensor,
        vertex_offsets: tuple[int, ...],
        face_offsets: tuple[int, ...],
    ) -> None:
        self.__dict__.update(
            vertices=vertices,
            faces=faces,
            vertex_offsets=vertex_offsets,
            face_offsets=face_offsets,
        )

    def _check_cells(self) -> None:
        """Raise for cells without measure, or one out of range.

        Measures must be normal numbers in the mesh's dtype, and their squares in float64: norms of
        area vectors pass through the squares.
        """
        _reject(cells.degenerate(self._corners, self._determinants), _flat(self.faces))
        for quantity in (self._double_measures.square(), self._double_measures.to(self.dtype)):
            range_ = torch.finfo(quantity.dtype)
            if not ((quantity >= range_.tiny) & (quantity <= range_.max)).all():
                raise MeshError(
                    f"Mesh: {_measure(self.faces)}s leave the range of {self.dtype}; rescale the "
                    "vertices"
                )

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"Mesh is immutable: build a new Mesh instead of setting {name!r}")

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in Mesh.__annotations__}

    def __repr__(self) -> str:
        return (
            f"Mesh(n_vertices={self.n_vertices}, n_faces={self.n_faces}, dim={self.dim}, "
            f"dtype={self.dtype}, device={self.device})"
        )

    # ---------------------------------------------------------------- sizes

    @property
    def n_vertices(self) -> int:
        """Number of vertices, n."""
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        """Number of faces, m."""
        return len(self.faces)

    @property
    def dim(self) -> int:
        """Dimension D of the ambient space."""
        return self.vertices.shape[1]

    @property
    def cell_dim(self) -> int:
        """Dimension d of a cell: 2 for triangles, 3 for tetrahedra."""
        return self.faces.shape[1] - 1

    @property
    def dtype(self) -> torch.dtype:
        """Floating dtype of the vertices and of every derived quantity."""
        return self.vertices.dtype

    @property
    def device(self) -> torch.device:
        """Device of the vertices and of every derived quantity."""
        return self.vertices.device

    def with_vertices(self, vertices: Tensor) -> Mesh:
        """The same faces at other positions; what depends on the faces alone is kept.

        Raises:
            MeshError: as for a new mesh, or another shape, dtype or device than before.
        """
        require_tensor("Mesh.with_vertices", "vertices", vertices)
        before = (self.vertices.shape, self.dtype, self.device)
        if (vertices.shape, vertices.dtype, vertices.device) != before:
            raise MeshError(
                f"Mesh.with_vertices: expected {tuple(self.vertices.shape)} {self.dtype} on "
                f"{self.device}, got {tuple(vertices.shape)} {vertices.dtype} on {vertices.device}"
            )
        _require_constant(vertices)
        _validate(vertices, self.faces)
        moved = object.__new__(Mesh)
        moved._assign(vertices.clone(), self.faces, self.vertex_offsets, self.face_offsets)
        moved._check_cells()
        kept = {name: self.__dict__[name] for name in _OF_FACES if name in self.__dict__}
        moved.__dict__.update(kept)
        return moved

    def to(self, target: torch.dtype | torch.device | str) -> Mesh:
        """The same mesh in another floating dtype or on another device."""
        if not isinstance(target, torch.dtype):
            target = _as_device(target)
        moved = object.__new__(Mesh)
        faces = self.faces if isinstance(target, torch.dtype) else self.faces.to(target)
        vertices = self.vertices.to(target)
        _validate(vertices, faces)
        moved._assign(vertices, faces, self.vertex_offsets, self.face_offsets)
        moved._check_cells()  # a narrower dtype can collapse faces
        return moved

    # ---------------------------------------------------------------- geometry

    @constant_property
    def _corners(self) -> Float[Tensor, "m k D"]:
        """Float64 positions of the corners of each cell."""
        return self.vertices.double()[self.faces]

    @constant_property
    def _determinants(self) -> Float[Tensor, "m *D"]:
        """Float64 measures times d!, signed, or as normal vectors (see `cells.determinants`)."""
        return cells.determinants(self._corners)

    @constant_property
    def _double_measures(self) -> Float[Tensor, "m"]:
        """Float64 measures, for operators assembled in double whatever the mesh's dtype."""
        return cells.measures(self._corners, self._determinants)

    @constant_property
    def _double_frames(self) -> Float[Tensor, "m D d"]:
        """Float64 frames (see `frames`)."""
        return cells.frames(self._corners, self._determinants)

    @constant_property
    def measures(self) -> Float[Tensor, "m"]:
        """Area of each triangle in units², or volume of each tetrahedron in units³; positive."""
        return self._double_measures.to(self.dtype)

    @property
    def areas(self) -> Float[Tensor, "m"]:
        """Area |tⱼ| of each face, in units²; positive also for clockwise faces of a planar mesh."""
        self._require_triangles("areas")
        return self.measures

    @property
    def volumes(self) -> Float[Tensor, "m"]:
        """Volume of each tetrahedron, in units³; positive also for inverted ones."""
        if self.cell_dim != 3:
            raise MeshError("volumes need tetrahedra: faces are (m, 3), not (m, 4)")
        return self.measures

    @constant_property
    def normals(self) -> Float[Tensor, "m 3"]:
        """Unit normal of each triangle; only in space."""
        vectors = self._area_vectors("normals")
        return (vectors / torch.linalg.vector_norm(vectors, dim=1, keepdim=True)).to(self.dtype)

    @constant_property
    def frames(self) -> Float[Tensor, "m D d"]:
        """Orthonormal, oriented basis B of each tangent plane as columns: B₁ × B₂ = normal.

        The first column points along the face's first edge. In the plane and for tetrahedra, the
        identity. Nothing computed by this package depends on this choice (paper, appendix).
        """
        return self._double_frames.to(self.dtype)

    @constant_property
    def centroids(self) -> Float[Tensor, "m D"]:
        """Barycentre of each cell."""
        return self.vertices[self.faces].mean(dim=1)

    @constant_property
    def _double_vertex_measures(self) -> Float[Tensor, "n"]:
        """Float64 vertex measures (see `vertex_measures`)."""
        return self.sum_at_vertices(self._double_measures[:, None] / self.faces.shape[1])[:, 0]

    @constant_property
    def vertex_measures(self) -> Float[Tensor, "n"]:
        """Lumped mass: an equal share of the measure of each cell around a vertex."""
        return self._double_vertex_measures.to(self.dtype)

    @property
    def vertex_areas(self) -> Float[Tensor, "n"]:
        """Lumped mass |Vⱼ|: a third of the area around each vertex, in units²."""
        self._require_triangles("vertex_areas")
        return self.vertex_measures

    @constant_property
    def vertex_normals(self) -> Float[Tensor, "n 3"]:
        """Unit vertex normals, the faces' weighted by area; zero where those cancel."""
        total = self.sum_at_vertices(self._area_vectors("vertex_normals"))
        lengths = torch.linalg.vector_norm(total, dim=1, keepdim=True)
        return torch.where(lengths > 0, total / lengths, 0).to(self.dtype)

    def sum_at_vertices(self, values: Float[Tensor, "m c"]) -> Float[Tensor, "n c"]:
        """Sum of cell values over the cells around each vertex; differentiable."""
        k = self.faces.shape[1]
        total = values.new_zeros(self.n_vertices, values.shape[1])
        return total.index_add(0, self.faces.flatten(), values.repeat_interleave(k, dim=0))

    def _area_vectors(self, name: str) -> Float[Tensor, "m 3"]:
        """Twice the area times the unit normal of each triangle in space, float64."""
        self._require_triangles(name)
        if self.dim != 3:
            raise MeshError(f"{name} need a mesh in space: vertices have D = {self.dim}, not 3")
        return self._determinants

    def _require_triangles(self, name: str) -> None:
        if self.cell_dim != 2:
            raise MeshError(f"{name} need triangles: faces are (m, 4), tetrahedra")

    # ---------------------------------------------------------------- topology

    @constant_property
    def components(self) -> Int[Tensor, "n"]:
        """Label in 0 … n_components - 1 of the connected component of each vertex."""
        labels = topology.component_labels(self._numpy_faces, self.n_vertices)
        return torch.from_numpy(labels).to(self.device)

    @property
    def n_components(self) -> int:
        """Number of connected components; cells that share a vertex are connected."""
        return int(self.components.max()) + 1

    @constant_property
    def euler_characteristic(self) -> int:
        """V - E + F of a triangle mesh."""
        self._require_triangles("euler_characteristic")
        n_edges = len(topology.undirected_edges(self._numpy_faces)[0])
        return self.n_vertices - n_edges + self.n_faces

    @constant_property
    def is_manifold(self) -> bool:
        """Whether edges have at most two, consistently oriented faces and vertices one fan."""
        self._require_triangles("is_manifold")
        return topology.is_manifold(self._numpy_faces, self.n_vertices)

    @constant_property
    def boundary_loops(self) -> list[Tensor]:
        """Each boundary as its cycle of vertices, along the faces' edges, longest first.

        Raises:
            MeshError: the boundary touches itself or ends at a non-manifold edge, or faces are
                inconsistently oriented.
        """
        self._require_triangles("boundary_loops")
        tails, heads = topology.boundary_half_edges(self._numpy_faces).T
        for ends in (tails, heads):
            if len(np.unique(ends)) < len(ends):
                vertex = np.flatnonzero(np.bincount(ends) > 1)
                raise MeshError(
                    "boundary_loops: the boundary passes "
                    f"{describe_indices(vertex, 'vertex', 'vertices')} more than once; split such "
                    "vertices, and orient the faces consistently"
                )
        if (open_ends := np.setxor1d(tails, heads)).size:
            raise MeshError(
                "boundary_loops: the boundary ends at "
                f"{describe_indices(open_ends, 'vertex', 'vertices')}, "
                "on an edge of three or more faces; split such edges"
            )
        return [torch.from_numpy(loop).to(self.device) for loop in topology.cycles(tails, heads)]

    @constant_property
    def is_disk(self) -> bool:
        """Whether the mesh is a disk: connected, manifold, χ = 1 (hence one boundary)."""
        return self.n_components == 1 and self.is_manifold and self.euler_characteristic == 1

    @property
    def _numpy_faces(self) -> np.ndarray:
        return self.faces.cpu().numpy()

    # ---------------------------------------------------------------- batches

    @classmethod
    def concatenate(cls, meshes: Sequence[Mesh]) -> Mesh:
        """The disjoint union of meshes of one dimension, dtype and device: a heterogeneous batch.

        Parts keep their order: `split_vertices` and `split_faces` take per-vertex and per-face
        values of the union apart again.
        """
        require_instances("Mesh.concatenate", meshes, Mesh)
        if not meshes:
            raise MeshError("Mesh.concatenate: needs at least one mesh")
        kinds = sorted({f"D={m.dim} d={m.cell_dim} {m.dtype} {m.device}" for m in meshes})
        if len(kinds) > 1:
            raise MeshError(
                f"Mesh.concatenate: meshes must agree in dimension, dtype and device, got {kinds}"
            )
        union = object.__new__(cls)
        starts = np.cumsum([0] + [mesh.n_vertices for mesh in meshes]).tolist()
        union._assign(
            torch.cat([mesh.vertices for mesh in meshes]),
            torch.cat([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
            _concatenate_offsets([mesh.vertex_offsets for mesh in meshes]),
            _concatenate_offsets([mesh.face_offsets for mesh in meshes]),
        )
        for name in _OF_PARTS:
            if all(name in mesh.__dict__ for mesh in meshes):
                with outside_transforms():
                    union.__dict__[name] = torch.cat([mesh.__dict__[name] for mesh in meshes])
        return union

    @property
    def n_parts(self) -> int:
        """Number of meshes that were concatenated; 1 for a mesh built from arrays."""
        return len(self.face_offsets) - 1

    @constant_property
    def part_of_vertex(self) -> Int[Tensor, "n"]:
        """The part each vertex belongs to."""
        return _owners(self.vertex_offsets, self.device)

    @constant_property
    def part_of_face(self) -> Int[Tensor, "m"]:
        """The part each face belongs to."""
        return _owners(self.face_offsets, self.device)

    def split_vertices(self, values: Tensor, dim: int = 0) -> tuple[Tensor, ...]:
        """Per-vertex values of a concatenated mesh, cut along `dim` into one tensor per part."""
        return _split("Mesh.split_vertices", values, self.vertex_offsets, dim)

    def split_faces(self, values: Tensor, dim: int = 0) -> tuple[Tensor, ...]:
        """Per-face values of a concatenated mesh, cut along `dim` into one tensor per part."""
        return _split("Mesh.split_faces", values, self.face_offsets, dim)

    # ---------------------------------------------------------------- repair

    @staticmethod
    def cleaned(
        vertices: ArrayLike, faces: ArrayLike, *, merge_duplicates: bool = False
    ) -> CleanedMesh:
        """Drop what `Mesh` would reject, and say where everything went.

        Faces with an index out of range or repeated, a vertex that is not finite, or zero area are
        dropped, then vertices that no face uses. Positions are never moved.

        Args:
            vertices: (n, D) float32 or float64 positions.
            faces: (m, 3) integer vertex indices.
            merge_duplicates: first identify vertices with exactly equal coordinates, as the
                triangle soups of STL files need.

        Raises:
            MeshError: wrong shape or dtype, or no face is left.
        """
        _require_constant(vertices)
        vertices, faces = _as_tensors(vertices, faces)
        _check_arrays(vertices, faces)
        merged = torch.arange(len(vertices), device=vertices.device)
        if merge_duplicates and len(vertices):
            merged = _first_of_equals(vertices)
        in_range = ((faces >= 0) & (faces < len(vertices))).all(dim=1)
        new_faces = merged[faces * in_range[:, None]] if len(vertices) else faces
        keep = in_range & ~_repeated(new_faces)
        keep[keep.clone()] &= vertices.isfinite().all(dim=1)[new_faces[keep]].all(dim=1)
        keep[keep.clone()] &= ~cells.degenerate(vertices.double()[new_faces[keep]])
        if not keep.any():
            raise MeshError(f"Mesh.cleaned: none of the {len(faces)} faces is usable")

        used = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
        used[new_faces[keep]] = True
        new_index = _new_indices(used)
        mesh = Mesh(vertices[used], new_index[new_faces[keep]])
        return CleanedMesh(mesh, new_index[merged], _new_indices(keep))


# -------------------------------------------------------------------- validation


def require_mesh(operation: str, mesh: object) -> None:
    """Raise TypeError for anything but a `Mesh`, such as another library's."""
    if not isinstance(mesh, Mesh):
        raise TypeError(
            f"{operation}: expected a diffpoisson.Mesh, got {type(mesh).__name__}; build one with "
            "Mesh(vertices, faces)"
        )


def require_cells(operation: str, vertices: Tensor | None, faces: Tensor) -> None:
    """Raise MeshError where positions, if known, leave cells without area or volume."""
    if vertices is None:
        return
    corners = vertices.double()[faces]
    flat = cells.degenerate(corners) | ~corners.flatten(1).isfinite().all(dim=1)
    if flat.any():
        culprits = describe_indices(flat.nonzero()[:, 0], "face", "faces")
        raise MeshError(
            f"{operation}: at the given vertices, {culprits} not finite or of zero "
            f"{_measure(faces)}"
        )


def _as_tensors(vertices: ArrayLike, faces: ArrayLike) -> tuple[Tensor, Tensor]:
    try:
        vertices, faces = as_tensor(vertices), as_tensor(faces)
    except (TypeError, ValueError, RuntimeError) as error:
        raise MeshError(
            f"Mesh: vertices and faces must be tensors or numeric arrays: {error}"
        ) from error
    if vertices.device != faces.device:
        raise MeshError(
            f"Mesh: vertices are on {vertices.device}, faces on {faces.device}; move one"
        )
    return vertices, faces.long() if _is_integer(faces) else faces


def _as_device(target: object) -> torch.device:
    if not isinstance(target, (str, torch.device)):
        raise TypeError(f"Mesh.to: expected a dtype or a device, got {type(target).__name__}")
    try:
        return torch.device(target)
    except RuntimeError as error:
        raise ValueError(f"Mesh.to: {target!r} is no device: {error}") from error


def _is_integer(values: Tensor) -> bool:
    return not (values.is_floating_point() or values.is_complex() or values.dtype == torch.bool)


def _require_constant(vertices: ArrayLike) -> None:
    if isinstance(vertices, Tensor) and not is_constant(vertices):
        raise MeshError(
            "Mesh: vertices require grad, but a mesh is constant, so their gradient would silently "
            "be zero; pass vertices.detach() here, and vertices=... to jacobians, divergence or "
            "the solver"
        )


def _check_arrays(vertices: Tensor, faces: Tensor) -> None:
    """Shapes and dtypes: what even `Mesh.cleaned` cannot repair."""
    for name, values in (("vertices", vertices), ("faces", faces)):
        if values.layout != torch.strided or values.is_meta:
            raise MeshError(
                f"Mesh: {name} must be a dense tensor with values, got {values.layout} on "
                f"{values.device}"
            )
    if vertices.ndim != 2 or vertices.shape[1] not in (2, 3):
        raise MeshError(f"Mesh: vertices must be (n, 2) or (n, 3), got {tuple(vertices.shape)}")
    if vertices.dtype not in (torch.float32, torch.float64):
        raise MeshError(
            f"Mesh: vertices must be float32 or float64, got {vertices.dtype}; convert them"
        )
    if faces.ndim != 2 or faces.shape[1] not in (3, 4):
        raise MeshError(
            f"Mesh: faces must be (m, 3), or (m, 4) for tetrahedra, got {tuple(faces.shape)}; "
            "triangulate polygons first"
        )
    if faces.shape[1] == 4 and vertices.shape[1] != 3:
        raise MeshError(
            "Mesh: faces of four vertices are tetrahedra, which need vertices (n, 3), got "
            f"{tuple(vertices.shape)}; triangulate quads first"
        )
    if not _is_integer(faces):
        raise MeshError(f"Mesh: faces must have an integer dtype, got {faces.dtype}")


def _validate(vertices: Tensor, faces: Tensor) -> None:
    _check_arrays(vertices, faces)
    if len(faces) == 0:
        raise MeshError("Mesh: no faces; an operator needs at least one cell")
    n = len(vertices)
    _reject(((faces < 0) | (faces >= n)).any(dim=1), f"with a vertex index outside 0 … {n - 1}")
    _reject(_repeated(faces), "with a repeated vertex index")
    finite = vertices.isfinite().all(dim=1)
    _reject(~finite, "with a coordinate that is not finite", ("vertex", "vertices"))
    used = torch.zeros(n, dtype=torch.bool, device=vertices.device)
    used[faces] = True
    _reject(~used, "that no face uses", ("vertex", "vertices"))


def _measure(faces: Tensor) -> str:
    return "area" if faces.shape[1] == 3 else "volume"


def _flat(faces: Tensor) -> str:
    quads = " (faces of four vertices are tetrahedra; triangulate quads)"
    return f"of zero {_measure(faces)}" + (quads if faces.shape[1] == 4 else "")


def _reject(bad: Bool[Tensor, "k"], what: str, noun: tuple[str, str] = ("face", "faces")) -> None:
    if bad.any():
        culprits = describe_indices(bad.nonzero()[:, 0], *noun)
        raise MeshError(f"Mesh: {culprits} {what}; Mesh.cleaned(vertices, faces) drops them")


def describe_indices(
    indices: np.ndarray | Tensor, singular: str, plural: str, show: int = 5
) -> str:
    """'3 faces [7, 8, 12]', shortened after the first few indices."""
    listed = ", ".join(map(str, indices[:show].tolist())) + (", …" if len(indices) > show else "")
    return f"{len(indices)} {singular if len(indices) == 1 else plural} [{listed}]"


def _repeated(faces: Int[Tensor, "m k"]) -> Bool[Tensor, "m"]:
    return (faces.sort(dim=1).values.diff(dim=1) == 0).any(dim=1)


# -------------------------------------------------------------------- indices


def _split(
    operation: str, values: object, offsets: tuple[int, ...], dim: int
) -> tuple[Tensor, ...]:
    if not isinstance(values, Tensor) or values.layout != torch.strided:
        raise TypeError(
            f"{operation}: values must be a dense torch tensor, got {type(values).__name__}"
        )
    require_integer(operation, "dim", dim)
    if not -values.ndim <= dim < values.ndim or values.shape[dim] != offsets[-1]:
        raise ValueError(
            f"{operation}: expected {offsets[-1]} values along dim {dim}, got {tuple(values.shape)}"
        )
    return values.split(np.diff(offsets).tolist(), dim)


def _concatenate_offsets(parts: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    sizes = np.concatenate([np.diff(offsets) for offsets in parts])
    return tuple(np.concatenate([[0], np.cumsum(sizes)]).tolist())


def _owners(offsets: tuple[int, ...], device: torch.device) -> Tensor:
    sizes = torch.tensor(offsets, device=device).diff()
    return torch.arange(len(sizes), device=device).repeat_interleave(sizes)


def _first_of_equals(vertices: Tensor) -> Int[Tensor, "n"]:
    """For each vertex, the lowest index of a vertex with the same coordinates."""
    _, group = torch.unique(vertices, dim=0, return_inverse=True)
    index = torch.arange(len(vertices), device=vertices.device)
    first = torch.full((len(vertices),), len(vertices), device=vertices.device)
    return first.scatter_reduce(0, group, index, "amin")[group]


def _new_indices(keep: Bool[Tensor, "k"]) -> Int[Tensor, "k"]:
    """Position of each kept entry among the kept, -1 elsewhere."""
    return torch.where(keep, keep.cumsum(0) - 1, -1)
