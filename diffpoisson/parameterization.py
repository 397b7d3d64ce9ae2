"""Flattening a disk: Tutte's embedding, SLIM, and rigid alignment.

With `intrinsic.py` the only file that uses libigl.

Tutte: boundary on a circle, interior solving L uv = 0. With uniform weights the result is an
embedding (Tutte 1963; Floater 1997); cotangent weights distort less but can flip faces next to
obtuse angles.

SLIM (Rabinovich et al. 2017) descends from a flip-free map on the symmetric Dirichlet energy
Σ |tⱼ| (‖Jⱼ‖² + ‖Jⱼ⁻¹‖²) / Σ |tⱼ|, which is 4 at an isometry, and never flips a face.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from itertools import chain, islice
from typing import Any, NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Float
from scipy.sparse import csgraph
from torch import Tensor

from diffpoisson import topology
from diffpoisson.arguments import (
    require_integer,
    require_number,
    require_single_or_double,
    require_tensor,
)
from diffpoisson.certificate import count_flips, is_simple
from diffpoisson.distortion import flipped
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import gradient_operator, jacobians, laplacian
from diffpoisson.mesh import Mesh, MeshError, require_mesh
from diffpoisson.transforms import is_constant

_PULLS = (1.0, 2.0, 4.0, 8.0, 16.0)  # see `_embeddings`


class SlimResult(NamedTuple):
    """What `slim` returns.

    Attributes:
        uv: (n, 2) flip-free map in the mesh's own units, dtype and device.
        energies: mean symmetric Dirichlet energy of the initial map and after each iteration.
        converged: whether the last iteration's relative decrease was within the tolerance.
        scaffolded: whether a scaffold kept the map from overlapping itself.
    """

    uv: Tensor
    energies: list[float]
    converged: bool
    scaffolded: bool


def tutte(mesh: Mesh) -> Float[Tensor, "n 2"]:
    """A flip-free map of a disk onto a round disk of the same area.

    The cotangent-harmonic map where it has no flips, else the uniform one, which in exact
    arithmetic cannot have any. Where the surface is so deep that rounding flips what shrank at its
    bottom, weights that pull outward, twice, four times … as strongly with each edge of depth.

    Args:
        mesh: a topological disk in space.

    Returns:
        (n, 2) positions around the origin, in the mesh's units; boundary vertices lie on the circle
        at arc lengths proportional to the boundary's.

    Raises:
        MeshError: not a disk in space, or so distorted that rounding flips faces of the uniform
            map.

    References:
        Tutte, "How to draw a graph", 1963. Floater, "Parametrization and smooth approximation of
        surface triangulations", 1997.
    """
    require_disk("tutte", mesh)
    fewest = mesh.n_faces
    for uv in chain([harmonic_disk(mesh)], _embeddings(mesh)):
        n_flipped = int(flipped(jacobians(mesh, uv)).sum())
        if n_flipped == 0:
            return uv
        fewest = min(fewest, n_flipped)
    raise MeshError(
        f"tutte: rounding to {mesh.dtype} flips {fewest} of {mesh.n_faces} faces, which shrank too "
        "far; use float64, or cut the surface into flatter pieces"
    )


def harmonic_disk(mesh: Mesh) -> Float[Tensor, "n 2"]:
    """The harmonic map of a disk onto a round disk of the same area, see `tutte`; it may flip.

    Obtuse angles make cotangents negative, so that the cotangent Laplacian can fail to give an
    embedding, but it is positive definite on the interior whatever the angles.
    """
    return _extended_from_circle(mesh, laplacian(mesh))


def slim(
    mesh: Mesh,
    init: Float[Tensor, "n 2"],
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 500,
    injective: bool = False,
) -> SlimResult:
    """Minimise the symmetric Dirichlet energy of a flip-free map, by SLIM.

    Args:
        mesh: the surface, a topological disk in space.
        init: (n, 2) flip-free map, in the mesh's units: its scale counts, since isometries are
            sought.
        tolerance: stop when an iteration lowers the energy by less than this fraction of it.
        max_iterations: give up then, with `converged` False; also of the scaffold.
        injective: keep the boundary from meeting itself, too. Where SLIM ends with an overlap, go
            on from its last iterate that has none, with the outside of the map triangulated: a
            scaffold that must not flip either (Jiang et al. 2017).

    Raises:
        MeshError: not a disk in space; `init` flips faces or, if `injective`, its boundary meets
            itself, which the method cannot undo; or rounding to the mesh's dtype flips faces.

    References:
        Rabinovich, Poranne, Panozzo and Sorkine-Hornung, "Scalable locally injective mappings",
        2017. Jiang, Schaefer and Panozzo, "Simplicial complex augmentation framework for bijective
        maps", 2017.
    """
    require_disk("slim", mesh)
    require_number("slim", "tolerance", tolerance)
    require_integer("slim", "max_iterations", max_iterations, least=0)
    _require_init(mesh, init)
    boundary = mesh.boundary_loops[0].cpu().numpy()
    descent = _Descent(
        mean_energy=_mean_energy(mesh),
        admits=lambda points: not injective or is_simple(points[boundary]),
        tolerance=tolerance,
        points=init.cpu().double().numpy(),
    )
    _require_start(mesh, init, descent)
    converged = descent.follow(_slim_iterates(mesh, descent.points), max_iterations)
    if scaffolded := not descent.admitted:
        iterates = _scaffold_iterates(mesh, descent.points)
        converged = descent.follow(iterates, max_iterations, patience=3)
    return SlimResult(_rounded(mesh, descent.points), descent.energies, converged, scaffolded)


class _Descent:
    """The best admissible map so far, and the energies on the way there."""

    def __init__(
        self,
        mean_energy: Callable[[np.ndarray], float],
        admits: Callable[[np.ndarray], bool],
        tolerance: float,
        points: Float[np.ndarray, "n 2"],
    ) -> None:
        self.mean_energy, self.admits, self.tolerance = mean_energy, admits, tolerance
        self.points, self.energies = points, [mean_energy(points)]
        self.admitted = admits(points)  # whether the last iterate was

    def follow(
        self, iterates: Iterator[np.ndarray], max_iterations: int, patience: int = 1
    ) -> bool:
        """Follow iterates until their energy falls no more; whether it came to that."""
        trail = list(self.energies)
        for points in islice(iterates, max_iterations):
            trail.append(self.mean_energy(points))
            if not trail[-1] < math.inf:  # rounding, on nearly degenerate faces
                return False
            self.admitted = self.admits(points)
            if self.admitted and trail[-1] <= self.energies[-1]:
                self.points, self.energies = points, list(trail)
            if trail[-1 - patience :][0] - trail[-1] <= self.tolerance * trail[-1]:
                return True
        return False


def _slim_iterates(
    mesh: Mesh, points: Float[np.ndarray, "n 2"]
) -> Iterator[Float[np.ndarray, "n 2"]]:
    """The maps after one, two, … iterations of SLIM."""
    arguments, scale = _libigl_arguments(mesh, points)
    data = igl.slim_precompute(*arguments)
    while True:
        yield scale * np.ascontiguousarray(igl.slim_solve(data, 1))


def _scaffold_iterates(
    mesh: Mesh, points: Float[np.ndarray, "n 2"]
) -> Iterator[Float[np.ndarray, "n 2"]]:
    """The same with a scaffold."""
    # Only where it is needed: it links Shewchuk's Triangle, whose licence has conditions.
    from igl import triangle  # noqa: PLC0415

    arguments, scale = _libigl_arguments(mesh, points)
    data = triangle.SCAFData()
    triangle.scaf_precompute(*arguments, data)
    while True:
        yield scale * np.ascontiguousarray(triangle.scaf_solve(1, data))


def _libigl_arguments(mesh: Mesh, points: np.ndarray) -> tuple[tuple[Any, ...], float]:
    """What libigl's methods take, at a scale of area one, and the unit of that scale."""
    # Their proximal term (1e-4 I) is absolute: only at a fixed scale does it mean the same.
    scale = math.sqrt(float(mesh._double_measures.sum()))
    return (
        np.asfortranarray(mesh.vertices.cpu().double().numpy() / scale),
        np.asfortranarray(mesh.faces.cpu().numpy(), dtype=np.int32),
        np.asfortranarray(points / scale),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        np.zeros(0, dtype=np.int32),  # no soft constraints
        np.zeros((0, 2), order="F"),
        0.0,
    ), scale


def procrustes(
    source: Float[Tensor, "*batch n 2"],
    target: Float[Tensor, "*batch n 2"],
    weights: Float[Tensor, "n"],
    *,
    reflect: bool = False,
) -> Float[Tensor, "*batch n 2"]:
    """The source moved rigidly onto the target: argmin over R, t of Σ wᵢ ‖R sᵢ + t - qᵢ‖².

    Args:
        source: (…, n, 2) points to move.
        target: (…, n, 2) points to move them to.
        weights: (n,) non-negative, e.g. `mesh.vertex_areas`.
        reflect: allow a reflection where that fits better; otherwise only rotations.
    """
    for name, value in (("source", source), ("target", target), ("weights", weights)):
        require_tensor("procrustes", name, value, source.device if name != "source" else None)
    shapes = [tuple(value.shape) for value in (source, target, weights)]
    points = [shape[-2:] for shape in shapes[:2]]
    if weights.ndim != 1 or points != [(len(weights), 2)] * 2:
        raise ValueError(
            "procrustes: expected source and target of shape (…, n, 2) and weights (n,), got "
            f"{shapes[0]}, {shapes[1]} and {shapes[2]}"
        )
    if not (weights >= 0).all() or not 0 < weights.sum() < math.inf:
        raise ValueError("procrustes: weights must be finite and not negative, nor all zero")
    w = (weights / weights.sum())[:, None]
    target_mean = (w * target).sum(dim=-2, keepdim=True)
    source = source - (w * source).sum(dim=-2, keepdim=True)
    rotated, fit = _best_rotation(source, target - target_mean, w)
    if reflect:
        mirror = source.new_tensor([1, -1])
        mirrored, mirrored_fit = _best_rotation(source * mirror, target - target_mean, w)
        rotated = torch.where((mirrored_fit > fit)[..., None, None], mirrored, rotated)
    return rotated + target_mean


def _best_rotation(source: Tensor, target: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """The rotated source, and the inner product with the target that the rotation maximises."""
    x, y = source.unbind(-1)
    dot = (w * source * target).sum(dim=(-2, -1))
    cross = (w[:, 0] * (x * target[..., 1] - y * target[..., 0])).sum(dim=-1)
    angle = torch.atan2(cross, dot)[..., None]  # where both vanish every angle is a minimum
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1), torch.hypot(dot, cross)


def _circle(mesh: Mesh, boundary: Tensor) -> Float[Tensor, "b 2"]:
    """Boundary vertices on the circle that encloses the mesh's area, spaced by arc length."""
    loop = mesh.vertices.double()[boundary]
    lengths = torch.linalg.vector_norm(loop.roll(-1, dims=0) - loop, dim=1)
    arc = lengths.cumsum(0) - lengths  # from the first vertex to each
    angle = 2 * math.pi * arc / lengths.sum()
    radius = torch.sqrt(mesh.areas.double().sum() / math.pi)
    return radius * torch.stack([angle.cos(), angle.sin()], dim=1)


def _extended_from_circle(mesh: Mesh, L: sp.csr_matrix) -> Float[Tensor, "n 2"]:
    """u on the circle at the boundary, with (L u)ᵢ = 0 at every other vertex i."""
    boundary = mesh.boundary_loops[0]
    u = torch.zeros(mesh.n_vertices, 2, dtype=torch.float64)
    u[boundary.cpu()] = _circle(mesh, boundary).cpu()
    interior = np.setdiff1d(np.arange(mesh.n_vertices), boundary.cpu().numpy())
    if len(interior):
        rhs = torch.from_numpy(-(L @ u.numpy())[interior])
        u[interior] = CholeskyFactor(L[interior][:, interior]).multiply(rhs)
    return u.to(mesh.vertices)


def _embeddings(mesh: Mesh) -> Iterator[Float[Tensor, "n 2"]]:
    """Each interior vertex at a mean of its neighbours: an embedding, whatever the weights.

    (Floater 1997.) Those here are pull^-(dᵢ + dⱼ), d the number of edges to the boundary: to vertex
    i, a neighbour counts pull times as much as one that is an edge deeper, and the matrix stays
    symmetric. Uniform weights, of pull 1, come first.
    """
    half_edges = topology.half_edges(mesh.faces.cpu().numpy())
    i, j = np.concatenate([half_edges, half_edges[:, ::-1]]).T
    n = mesh.n_vertices
    graph = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(n, n))
    boundary = mesh.boundary_loops[0].cpu().numpy()
    depths = csgraph.dijkstra(graph, indices=boundary, unweighted=True, min_only=True)
    sums = depths[i] + depths[j]
    for pull in _PULLS:
        if sums.max() * math.log2(pull) < 1000:  # the exponents of double precision end at -1022
            # Only right at interior vertices, whose edges have two faces, one half-edge each way.
            weights = pull**-sums
            adjacency = sp.coo_matrix((weights, (i, j)), shape=(n, n))
            degrees = sp.diags(np.bincount(i, weights, minlength=n))
            yield _extended_from_circle(mesh, degrees - adjacency)


def _mean_energy(mesh: Mesh) -> Callable[[Float[np.ndarray, "n 2"]], float]:
    """Area-weighted mean symmetric Dirichlet energy of a map; infinite if any face is flipped.

    As `symmetric_dirichlet`, in NumPy, which costs SLIM a tenth of the time.
    """
    gradient = gradient_operator(mesh).matrix
    weights = (mesh._double_measures / mesh._double_measures.sum()).cpu().numpy()

    @np.errstate(over="ignore", invalid="ignore")  # far from any unit the energy is infinite
    def energy(points: np.ndarray) -> float:
        u, v = (gradient @ points).reshape(2, -1, 2)  # columns of the Jacobians
        det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        if not (det > 0).all():
            return math.inf
        return float(weights @ (((u * u).sum(1) + (v * v).sum(1)) * (1 + det**-2)))

    return energy


def _rounded(mesh: Mesh, points: Float[np.ndarray, "n 2"]) -> Float[Tensor, "n 2"]:
    """The map in the mesh's dtype, which must still be flip-free."""
    uv = torch.from_numpy(points).to(mesh.vertices)
    if n_flipped := count_flips(mesh, uv):
        raise MeshError(
            f"slim: rounding to {mesh.dtype} flips {n_flipped} of {mesh.n_faces} faces, which are "
            "nearly degenerate; use float64, or remesh them"
        )
    return uv


def _require_init(mesh: Mesh, init: Tensor) -> None:
    require_tensor("slim", "init", init, mesh.device)
    require_single_or_double("slim", "init", init)
    if not is_constant(init):
        raise ValueError("slim: init requires grad, but SLIM is not differentiable; detach it")
    if init.shape != (mesh.n_vertices, 2):
        raise ValueError(
            f"slim: expected init of shape (n={mesh.n_vertices}, 2), got {tuple(init.shape)}"
        )


def _require_start(mesh: Mesh, init: Tensor, descent: _Descent) -> None:
    if not descent.energies[0] < math.inf:
        count = int(flipped(jacobians(mesh, init)).sum())
        raise MeshError(
            f"slim: init flips {count} of {mesh.n_faces} faces, and SLIM keeps the signs it starts "
            "with; start from tutte(mesh)"
        )
    if not descent.admitted:
        raise MeshError(
            "slim: the boundary of init meets itself, so that nothing keeps the map injective; "
            "start from tutte(mesh)"
        )


def require_disk(operation: str, mesh: Mesh, remedy: str = "") -> None:
    """What every method that flattens one disk requires of it; the remedy ends the message."""
    require_mesh(operation, mesh)
    if mesh.cell_dim != 2:
        raise MeshError(f"{operation}: flattens surfaces, got tetrahedra")
    if mesh.dim != 3:
        raise MeshError(
            f"{operation}: flattens surfaces in space, got vertices with D = {mesh.dim}"
        )
    if not mesh.is_disk:
        raise MeshError(
            f"{operation}: needs a topological disk, but this mesh has {describe_topology(mesh)}"
            f"{remedy and f'; {remedy}'}"
        )


def describe_topology(mesh: Mesh) -> str:
    """What keeps a mesh from being a disk, and the remedy."""
    if mesh.n_components > 1:
        return f"{mesh.n_components} connected components; flatten each on its own"
    if not mesh.is_manifold:
        _, n_faces = topology.undirected_edges(mesh.faces.cpu().numpy())
        return (
            f"{int((n_faces > 2).sum())} edges with more than two faces, or pinched vertices or "
            "inconsistent orientation; repair these"
        )
    holes = len(mesh.boundary_loops)
    genus = (2 - holes - mesh.euler_characteristic) // 2
    return (
        f"Euler characteristic {mesh.euler_characteristic}, {holes} boundary loops and "
        f"genus {genus}; cut it to a disk, or fill the holes"
    )
