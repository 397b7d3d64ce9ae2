"""The Poisson layer: the map whose Jacobians are closest to given ones, Φ = L⁻¹ ∇ᵀA R.

    Φ = argmin Σⱼ wⱼ|tⱼ| ‖(∇Φ)ⱼ - Rⱼ‖² + Σₕ aₕ ‖Φₕ - qₕ‖²   subject to Φₚ = qₚ at pins

with face weights w (all one in the paper), soft handles h of strength a, and pins p. Its normal
equations are (L + W) Φ = ∇ᵀA R + W q, L = ∇ᵀA∇. Pinned rows are eliminated; a connected component
with neither pin nor handle is determined up to a translation, so one vertex of it, its anchor, is
eliminated too, and the gauge fixes the translation. What remains is positive definite, and
factorised once.

Derivatives by the geometry. Positions or face weights that require grad may be given again to a
solve. Value and factor stay the same, and the solve is differentiated as a function of L and the
right-hand side: each derivative is one more solve with the factor, exact to any order.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from diffpoisson import cells
from diffpoisson.arguments import require_instances, require_integer, require_tensor
from diffpoisson.constraints import Constraints, Gauge
from diffpoisson.factor import CholeskyFactor
from diffpoisson.gradient import (
    CellGeometry,
    SparseMatrix,
    as_intrinsic,
    columns_to_vertices,
    concatenate_operators,
    gradient_operator,
    matrices_to_columns,
    vertices_to_columns,
)
from diffpoisson.linear_map import BlockDiagonal, CellwiseInverse, LinearMap, Matrix, Product
from diffpoisson.mesh import Mesh, MeshError, require_mesh
from diffpoisson.placement import Placement
from diffpoisson.transforms import outside_transforms, require_equal


class _Matrices(NamedTuple):
    """What leads from a Jacobian field to a map.

    Attributes:
        inverse: L⁻¹ at the free vertices.
        divergence: ∇ᵀA at the free vertices.
        coupling: L between the free vertices and the pins.
        place: from values at the free vertices to a map, where the gauge wants it.
        fit: place · inverse · divergence, all there is to do without pins and handles.
    """

    inverse: Matrix
    divergence: Matrix
    coupling: Matrix
    place: Matrix
    fit: Matrix

    @classmethod
    def of(cls, inverse: Matrix, divergence: Matrix, coupling: Matrix, place: Matrix) -> _Matrices:
        return cls(inverse, divergence, coupling, place, Product([place, inverse, divergence]))

    @classmethod
    def concatenate(cls, parts: Sequence[_Matrices], d: int) -> _Matrices:
        """Those of a disjoint union; the rows of a field come in d planes."""
        inverses, divergences, couplings, places, fits = zip(*parts, strict=True)
        return cls(
            BlockDiagonal(inverses),
            BlockDiagonal(divergences, (1, d)),
            BlockDiagonal(couplings),
            BlockDiagonal(places),
            BlockDiagonal(fits, (1, d)),
        )


class PoissonSolver:
    """A mesh's Laplacian, factorised once, to turn Jacobian fields into maps differentiably.

    Args:
        mesh: the domain; any number of components.
        gauge: what fixes the translation of each component that holds no pin or handle: `"mean"`,
            its area-weighted mean is zero; `"vertex"`, its vertex of lowest index maps to zero; or
            a (n,) mask, the area-weighted mean of its masked vertices is zero.
        pins: (p,) indices of vertices whose images will be given, or a (n,) mask.
        handles: (h,) indices of vertices that will be attracted to given points, or a (n,) mask.
        handle_weights: strength of all or of each handle, against faces that count by their area;
            in the unit of the measures over the square of the unit of the map.
        face_weights: (m,) non-negative factor on the area of each face; zero leaves it out of the
            fit.

    Attributes:
        mesh: the domain.
        constraints: the validated constraints.

    Raises:
        ValueError: indices out of range, named twice, or both pinned and handles; every vertex
            pinned; weights that are negative, not finite, or that require grad; a vertex that only
            faces of weight zero touch; a gauge mask that misses a component.
        MeshError: faces so thin that rounding makes the Laplacian indefinite.
    """

    def __init__(
        self,
        mesh: Mesh,
        *,
        gauge: Gauge | Bool[Tensor, "n"] = "mean",
        pins: Int[Tensor, "p"] | Bool[Tensor, "n"] | None = None,
        handles: Int[Tensor, "h"] | Bool[Tensor, "n"] | None = None,
        handle_weights: Float[Tensor, "h"] | float = 1.0,
        face_weights: Float[Tensor, "m"] | None = None,
    ) -> None:
        require_mesh("PoissonSolver", mesh)
        with outside_transforms():
            constraints = Constraints.build(
                mesh,
                gauge=gauge,
                pins=pins,
                handles=handles,
                handle_weights=handle_weights,
                face_weights=face_weights,
            )
            free, pinned = (i.cpu().numpy() for i in (constraints.free, constraints.pins))
            divergence, L = _assemble(mesh, constraints)
            matrices = _Matrices.of(
                _factorised(L[free][:, free], mesh),
                SparseMatrix(divergence[free], mesh.device),
                SparseMatrix(L[free][:, pinned], mesh.device),
                Placement(constraints, constraints.mean_weights(mesh._double_vertex_measures)),
            )
            self._assign(mesh, constraints, matrices)
            self._require_digits()

    def _assign(self, mesh: Mesh, constraints: Constraints, matrices: _Matrices) -> None:
        """Take finished parts."""
        self.mesh, self.constraints, self._matrices = mesh, constraints, matrices
        self._inverse = LinearMap(matrices.inverse)
        self._divergence = LinearMap(matrices.divergence)
        self._coupling = LinearMap(matrices.coupling)
        self._place = LinearMap(matrices.place)
        self._fit = LinearMap(matrices.fit)
        free_index = torch.full((mesh.n_vertices,), -1, device=mesh.device)
        free_index[constraints.free] = torch.arange(len(constraints.free), device=mesh.device)
        self._handle_rows = free_index[constraints.handles]
        rows = torch.where(free_index < 0, len(constraints.free), free_index)
        self._moving_inverse = CellwiseInverse(matrices.inverse, rows[mesh.faces])
        # A copy: edited in place, even the mesh's own positions must not pass for the factor's.
        self._vertices = mesh.vertices.to(torch.float64, copy=True)
        # Made here, not at first use: torch.compile cannot trace what fills a cache.
        self._frames = mesh._double_frames

    @property
    def n_floating(self) -> int:
        """Number of components that hold neither pin nor handle."""
        return self.constraints.n_floating

    def _require_digits(self) -> None:
        """Raise where rounding leaves nothing of a solution.

        The mesh's own positions have the frames as Jacobians, so they must come back, up to the
        translation of what floats. At half their size the error leaves no digit, and refinements,
        which multiply it by itself, are about to diverge.
        """
        constraints, components = self.constraints, self.mesh.components
        X = _centred(self._vertices, components)  # a far origin costs digits, too
        pull = constraints.handle_weights[:, None] * X[constraints.handles]
        phi = self._fitted(
            self._frames,
            X[constraints.pins] if len(constraints.pins) else None,
            pull if len(constraints.handles) else None,
        )
        floats = constraints.floating < constraints.n_floating
        labels = torch.where(floats, constraints.floating, constraints.n_floating + components)
        error = torch.where(floats[:, None], _centred(phi - X, labels), phi - X)
        squares = torch.stack([error, _centred(X, labels)]).square().sum(-1)
        missed, size = squares.new_zeros(2, int(labels.max()) + 1).index_add(1, labels, squares)
        if not (missed <= size / 4).all():  # or NaN
            raise MeshError(_no_digits(self.mesh))

    def update(self, vertices: Float[Tensor, "n D"]) -> PoissonSolver:
        """The solver of the same faces and constraints at other positions, factorised anew.

        What depends on the faces alone is kept. (cholespy cannot keep the symbolic analysis.)

        Args:
            vertices: (n, D) new positions.
        """
        constraints = self.constraints
        return PoissonSolver(
            self.mesh.with_vertices(vertices),
            gauge="vertex" if constraints.gauge_mask is None else constraints.gauge_mask,
            pins=constraints.pins,
            handles=constraints.handles,
            handle_weights=constraints.handle_weights,
            face_weights=constraints.face_weights,
        )

    @classmethod
    def concatenate(cls, solvers: Sequence[PoissonSolver]) -> PoissonSolver:
        """The solver of the disjoint union of the meshes, reusing their factors.

        Pins, handles and floating components are those of the solvers in order.

        Raises:
            ValueError: some solvers have the gauge "vertex" and others do not.
            MeshError: the meshes differ in dimension, dtype or device.
        """
        require_instances("PoissonSolver.concatenate", solvers, PoissonSolver)
        mesh = Mesh.concatenate([solver.mesh for solver in solvers])
        concatenate_operators(mesh, [solver.mesh for solver in solvers])
        constraints = Constraints.concatenate([solver.constraints for solver in solvers])
        matrices = _Matrices.concatenate([solver._matrices for solver in solvers], mesh.cell_dim)
        union = object.__new__(cls)
        union._assign(mesh, constraints, matrices)
        return union

    def __call__(
        self,
        R: Float[Tensor, "*batch m c k"],
        *,
        pins: Float[Tensor, "*#batch p c"] | None = None,
        handles: Float[Tensor, "*#batch h c"] | None = None,
        translations: Float[Tensor, "*#batch q c"] | None = None,
        transforms: Float[Tensor, "*#batch m c c"] | None = None,
        vertices: Float[Tensor, "n D"] | None = None,
        face_weights: Float[Tensor, "m"] | None = None,
        refinements: int = 0,
    ) -> Float[Tensor, "*batch n c"]:
        """The map whose Jacobians are closest to R in the area-weighted least-squares sense.

        Args:
            R: (…, m, c, d) in the coordinates of `mesh.frames`, or (…, m, c, D) on ambient vectors;
                only their restriction to the tangent spaces matters. Solved in float64.
            pins: (…, p, c) images of the pinned vertices, in the order given to the solver.
            handles: (…, h, c) points that attract the handles, in the order given to the solver.
            translations: (…, n_floating, c) where the gauge puts each component that is not held,
                instead of zero.
            transforms: (…, m, c, c) matrices that multiply those of R from the left.
            vertices: (n, D) the mesh's own positions again, if derivatives by them are wanted.
            face_weights: (m,) the solver's own face weights again, if derivatives by them are
                wanted.
            refinements: solve this many times again, for what of R the gradient of the solution
                misses. Each doubles the digits that thin faces leave, at the price of a solve.

        Returns:
            (…, n, c) images of the vertices, in the dtype of R.

        Raises:
            ValueError: shapes that do not fit; images missing for pins or handles, or given
                without; `vertices` or `face_weights` that differ from those that were factorised.
            TypeError: what should be a tensor is none, or not of floating dtype.
        """
        require_tensor("PoissonSolver", "R", R, self.mesh.device)
        require_integer("PoissonSolver", "refinements", refinements, least=0)
        geometry = self._moving_geometry(vertices, face_weights)
        frames = self._frames if geometry is None else geometry.frames
        fields = self._transformed(
            as_intrinsic("PoissonSolver", self.mesh, R.double(), frames), transforms
        )
        batch, c = fields.shape[:-3], fields.shape[-2]
        q_pins = self._given("pins", pins, len(self.constraints.pins), batch, c)
        pull = self._given("handles", handles, len(self.constraints.handles), batch, c)
        if pull is not None:
            pull = self.constraints.handle_weights[:, None] * pull

        if geometry is None:
            phi = self._fitted(fields, q_pins, pull)
            for _ in range(refinements):
                phi = self._refined(phi, fields, pull)
        elif refinements:
            raise ValueError(
                "PoissonSolver: refinements know the mesh's own geometry only; leave them out "
                "where derivatives by vertices or face_weights are wanted"
            )
        else:
            phi = self._fitted_moving(geometry, face_weights, fields, q_pins, pull)
        if translations is not None:
            phi = phi + self._at_components(
                self._columns("translations", translations, self.n_floating, batch, c)
            )
        return columns_to_vertices(phi, fields.shape).to(R.dtype)

    def solve_laplacian(self, b: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
        """The solution of L x = b that is zero at pins and at each component's anchor.

        Args:
            b: (n, k) right-hand sides; over each floating component they must sum to zero, or no
                solution exists. The rows of anchors and pins are not read.
        """
        require_tensor("solve_laplacian", "b", b, self.mesh.device)
        if b.ndim != 2 or len(b) != self.mesh.n_vertices:
            raise ValueError(
                f"solve_laplacian: expected b of shape (n={self.mesh.n_vertices}, k), "
                f"got {tuple(b.shape)}"
            )
        return self._scattered(self._inverse(b[self.constraints.free].double())).to(b.dtype)

    # ---------------------------------------------------------------- steps of a solve

    def _transformed(
        self, fields: Float[Tensor, "*batch m c d"], transforms: Tensor | None
    ) -> Float[Tensor, "*batch m c d"]:
        """The matrices multiplied from the left."""
        if transforms is None:
            return fields
        m, c = fields.shape[-3:-1]
        _require_shape("transforms", transforms, fields.shape[:-3], (m, c, c), self.mesh.device)
        return transforms.double() @ fields

    def _fitted(
        self,
        fields: Float[Tensor, "*batch m c d"],
        q_pins: Float[Tensor, "p k"] | None,
        pull: Float[Tensor, "h k"] | None,
    ) -> Float[Tensor, "n k"]:
        """The solution, its floating components placed by the gauge."""
        columns = matrices_to_columns(fields)
        if q_pins is None and pull is None:
            return self._fit(columns)  # the steps below as one
        b = self._divergence(columns)
        if q_pins is not None:
            b = b - self._coupling(q_pins)
        if pull is not None:
            b = b.index_add(0, self._handle_rows, pull)
        phi = self._place(self._inverse(b))
        return phi if q_pins is None else phi.index_copy(0, self.constraints.pins, q_pins)

    def _given(
        self, name: str, values: Tensor | None, count: int, batch: torch.Size, c: int
    ) -> Float[Tensor, "count k"] | None:
        """Given images as columns; None if there are none to give."""
        if (values is None) != (count == 0):
            verb = "missing" if values is None else "given"
            raise ValueError(f"PoissonSolver: images {verb} for {count} {name}")
        return None if values is None else self._columns(name, values, count, batch, c)

    def _columns(
        self, name: str, values: Tensor, count: int, batch: torch.Size, c: int
    ) -> Float[Tensor, "count k"]:
        _require_shape(name, values, batch, (count, c), self.mesh.device)
        return vertices_to_columns(values.double().expand(*batch, count, c))

    def _refined(
        self,
        phi: Float[Tensor, "n k"],
        R: Float[Tensor, "*batch m c d"],
        pull: Float[Tensor, "h k"] | None,
    ) -> Float[Tensor, "n k"]:
        """Φ + L⁻¹ (∇ᵀA (R - ∇Φ) + W (q - Φ)), placed by the gauge as Φ is.

        The misfit of the gradient, unlike b - L Φ, is small where the solution is good: thin faces
        do not cancel its digits.
        """
        constraints = self.constraints
        misfit = matrices_to_columns(R) - gradient_operator(self.mesh).gradient(phi)
        b = self._divergence(misfit)
        if pull is not None:
            held = constraints.handle_weights[:, None] * phi[constraints.handles]
            b = b.index_add(0, self._handle_rows, pull - held)
        return phi + self._place(self._inverse(b))

    def _scattered(self, x: Float[Tensor, "f k"]) -> Float[Tensor, "n k"]:
        """Values at the free vertices; zero elsewhere."""
        return x.new_zeros(self.mesh.n_vertices, x.shape[1]).index_copy(0, self.constraints.free, x)

    def _at_components(self, values: Float[Tensor, "q k"]) -> Float[Tensor, "n k"]:
        """The value of each floating component at its vertices, and zero at what is held."""
        values = torch.cat([values, values.new_zeros(1, values.shape[1])])
        return values.index_select(0, self.constraints.floating)

    # ---------------------------------------------------------------- derivatives by the geometry

    def _moving_geometry(
        self, vertices: Tensor | None, face_weights: Tensor | None
    ) -> CellGeometry | None:
        """The geometry as a function of the given positions and weights; None if none is given."""
        if vertices is None and face_weights is None:
            return None
        own = (self._vertices, self.constraints.face_weights)
        given = (vertices, face_weights)
        for name, mine, yours in zip(("vertices", "face_weights"), own, given, strict=True):
            if yours is not None:
                require_tensor("PoissonSolver", name, yours, self.mesh.device)
                require_equal(
                    yours.double(),
                    mine,
                    f"PoissonSolver: {name} differ from those that were factorised; solve with "
                    "solver.update(vertices), or with a solver of these weights",
                )
        return CellGeometry.at(self.mesh, self.mesh.vertices if vertices is None else vertices)

    def _fitted_moving(
        self,
        geometry: CellGeometry,
        face_weights: Float[Tensor, "m"] | None,
        fields: Float[Tensor, "*batch m c d"],
        q_pins: Float[Tensor, "p k"] | None,
        pull: Float[Tensor, "h k"] | None,
    ) -> Float[Tensor, "n k"]:
        """As `_fitted`, and a function of the geometry and the face weights too."""
        constraints = self.constraints
        weights = constraints.face_weights if face_weights is None else face_weights.double()
        if q_pins is not None:  # the free vertices answer for what the pins alone leave of the fit
            held = q_pins.new_zeros(self.mesh.n_vertices, q_pins.shape[1])
            held = held.index_copy(0, constraints.pins, q_pins)
            fields = fields - geometry.gradient(columns_to_vertices(held, fields.shape))
        b = vertices_to_columns(geometry.divergence(fields, weights))
        if pull is not None:
            b = b.index_add(0, constraints.handles, pull)
        phi = self._scattered(
            self._moving_inverse(geometry.stiffness(weights), b[constraints.free])
        )
        if q_pins is not None:
            phi = phi.index_copy(0, constraints.pins, q_pins)
        means = constraints.mean_weights(geometry.vertex_measures())
        if means is None:
            return phi
        sums = phi.new_zeros(self.n_floating + 1, phi.shape[1])
        sums = sums.index_add(0, constraints.floating, means[:, None] * phi)
        # What is held stays where it is, and catches no NaN, times zero, from other components.
        return phi - self._at_components(sums[:-1])

    def __repr__(self) -> str:
        constraints = self.constraints
        return (
            f"PoissonSolver({self.mesh}, {len(constraints.pins)} pins, "
            f"{len(constraints.handles)} handles, {self.n_floating} floating components)"
        )


def solve_poisson(mesh: Mesh, R: Float[Tensor, "*batch m c k"], **options: Any) -> Tensor:
    """One-shot `PoissonSolver(mesh, …)(R, …)`; keep the solver to solve more than once.

    Args:
        mesh: the domain.
        R: (…, m, c, d) or (…, m, c, D) Jacobians.
        options: those of `PoissonSolver`; `pins` and `handles` are pairs (indices, images).
    """
    images = {}
    for name in ("pins", "handles"):
        if options.get(name) is not None:
            options[name], images[name] = options[name]
    return PoissonSolver(mesh, **options)(R, **images)


def _factorised(L: sp.csr_matrix, mesh: Mesh) -> CholeskyFactor:
    """The factor of what is positive definite but for rounding."""
    try:
        return CholeskyFactor(L, mesh.device)
    except ValueError as error:
        raise MeshError(f"{_no_digits(mesh)} ({error})") from error


def _centred(x: Float[Tensor, "n D"], labels: Int[Tensor, "n"]) -> Float[Tensor, "n D"]:
    """Each group of points moved to mean zero."""
    counts = torch.bincount(labels)
    sums = x.new_zeros(len(counts), x.shape[1]).index_add(0, labels, x)
    return x - (sums / counts[:, None])[labels]


def _no_digits(mesh: Mesh) -> str:
    thinness = cells.thinness(mesh._corners)
    worst = int(thinness.argmin())
    return (
        "PoissonSolver: in float64 the Laplacian of this mesh is not positive definite, or leaves "
        f"no digit of a solution; its thinnest face, {worst}, has a height of "
        f"{float(thinness[worst]):.0e} of its longest edge: remesh such faces, or bring weights "
        "closer together"
    )


def _require_shape(
    name: str, values: Tensor, batch: torch.Size, shape: tuple[int, ...], device: torch.device
) -> None:
    """Raise unless values are (*batch, *shape), or have batch dimensions that broadcast to it."""
    require_tensor("PoissonSolver", name, values, device)
    given = values.shape[: -len(shape)]
    broadcast = zip(reversed(given), reversed(batch), strict=False)
    if (
        values.shape[-len(shape) :] != shape
        or len(given) > len(batch)
        or any(size not in (1, full) for size, full in broadcast)
    ):
        expected = ", ".join(map(str, shape))
        raise ValueError(
            f"PoissonSolver: expected {name} of shape (…, {expected}), with … broadcasting to the "
            f"batch {tuple(batch)} of R, got {tuple(values.shape)}"
        )


def _assemble(mesh: Mesh, constraints: Constraints) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """∇ᵀA and L + W, float64, with the face weights in A."""
    operator = gradient_operator(mesh)
    divergence = operator.divergence_matrix
    weights = constraints.face_weights.cpu().numpy()
    if (weights != 1).any():
        divergence = (divergence @ sp.diags(np.tile(weights, mesh.cell_dim))).tocsr()
    L = (divergence @ operator.matrix).tocsr()
    if len(constraints.handles):
        strengths = np.zeros(mesh.n_vertices)
        strengths[constraints.handles.cpu().numpy()] = constraints.handle_weights.cpu().numpy()
        L = (L + sp.diags(strengths)).tocsr()
    return divergence, L
