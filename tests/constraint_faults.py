"""Named mistakes in constraints, unions, updates, derivatives by the geometry, and volumes.

Like `faults.py`, for the checks of `constraint_checks.py`.
"""

from __future__ import annotations

import dataclasses

import scipy.sparse as sp
import torch

from diffpoisson import (
    cells,
    constraints,
    distortion,
    factor,
    gradient,
    linear_map,
    placement,
    poisson,
)
from tests.faults import Fault, change_system, registrar, wrap, wrap_method

FAULTS: dict[str, Fault] = {}
fault = registrar(FAULTS)

Solver = poisson.PoissonSolver


def change_parts(patch, change):
    """Change the coupling to the pins after the factorisation."""

    def assign(original, self, mesh, given, matrices):
        coupling = gradient.SparseMatrix(change(matrices.coupling.scipy), mesh.device)
        original(self, mesh, given, matrices._replace(coupling=coupling))

    wrap_method(patch, Solver, "_assign", assign)


def change_union(patch, change):
    """Replace fields of the constraints of a union by change(union, parts)."""
    original = constraints.Constraints.concatenate.__func__

    def concatenate(cls, parts):
        union = original(cls, parts)
        return dataclasses.replace(union, **change(union, parts))

    patch.setattr(constraints.Constraints, "concatenate", classmethod(concatenate))


def change_geometry(patch, change):
    """Replace fields of the geometry at given positions by change(mesh, geometry)."""
    original = gradient.CellGeometry.at.__func__

    def at(cls, mesh, vertices):
        geometry = original(cls, mesh, vertices)
        return geometry._replace(**change(mesh, geometry))

    patch.setattr(gradient.CellGeometry, "at", classmethod(at))


def change_images(patch, name, change):
    """Change the columns of given images."""

    def columns(original, self, given, values, *rest):
        result = original(self, given, values, *rest)
        return change(result) if given == name else result

    wrap_method(patch, Solver, "_columns", columns)


# ------------------------------------------------------- pins and handles


@fault("pins")
def pins_do_not_pull(patch):
    """Pinned values are written into the solution, but the free vertices do not feel them."""
    change_parts(patch, lambda coupling: 0 * coupling)


@fault("pins")
def pins_push(patch):
    """The pinned columns of the Laplacian are moved to the right-hand side without a sign."""
    change_parts(patch, lambda coupling: -coupling)


@fault("pins")
def sorted_pins(patch):
    """Images of pins and handles are read in the order of the vertices, not in the given one."""
    wrap(patch, constraints, "_vertex_indices", lambda f, *args: f(*args).sort().values)


@fault("weak_handles_only_translate")
def gauge_moves_what_is_held(patch):
    """The mean is subtracted from held components too."""

    def place(original, self, x):
        phi = original(self, x)
        if len(self.constraints.pins) or not len(self.constraints.handles):
            return phi
        return phi - phi.mean(0)

    wrap_method(patch, placement.Placement, "multiply", place)


@fault("handles")
def handle_weights_squared(patch):
    """A handle's energy is (a ‖Φ - q‖)², not a ‖Φ - q‖²."""
    wrap(patch, constraints, "_strengths", lambda f, *args: f(*args) ** 2)


@fault("handles_tend_to_pins")
def handle_weights_on_one_side(patch):
    """Weights of handles enter the right-hand side, but the matrix as ones."""

    def assemble(original, mesh, given):
        handles = given.handles
        ones = torch.ones(len(handles), dtype=torch.float64)
        return original(mesh, dataclasses.replace(given, handle_weights=ones))

    wrap(patch, poisson, "_assemble", assemble)


@fault("handles")
def handles_by_vertex_index(patch):
    """Handles address the free vertices by their number among all vertices."""

    def assign(original, self, mesh, given, *rest):
        original(self, mesh, given, *rest)
        self._handle_rows = given.handles.clamp(max=len(given.free) - 1)

    wrap_method(patch, Solver, "_assign", assign)


@fault("gradients_of_images")
def detached_images(patch):
    """Images of pins are taken as constants."""
    change_images(patch, "pins", lambda q: q.detach())


@fault("batches_of_images")
def images_of_the_first_in_the_batch(patch):
    """Every element of a batch gets the handles of the first."""
    change_images(patch, "handles", lambda q: q[:, :3].repeat(1, q.shape[1] // 3))


@fault("callers_tensors_are_copied")
def shared_weights(patch):
    """The solver keeps the caller's weights, and sees later edits of them."""
    wrap(patch, constraints, "_constant", lambda f, name, values, mesh: torch.as_tensor(values))


# ------------------------------------------------------- face weights and transforms


@fault("face_weights")
def face_weights_in_the_gauge(patch):
    """The gauge's mean is weighted by the faces' weights too."""

    def assign(original, self, mesh, given, matrices):
        shares = mesh._double_measures * given.face_weights
        sizes = mesh.sum_at_vertices(shares[:, None])[:, 0]
        place = placement.Placement(given, given.mean_weights(sizes))
        original(self, mesh, given, type(matrices).of(*matrices[:3], place))

    wrap_method(patch, Solver, "_assign", assign)


@fault("face_weights")
def face_weights_on_one_side(patch):
    """Face weights enter the Laplacian, but not the right-hand side."""

    def change(mesh, divergence, L):
        return gradient.gradient_operator(mesh).divergence_matrix, L

    change_system(patch, change)


@fault("ignored_faces")
def ignored_faces_connect(patch):
    """Faces of weight zero still join components, and a shift lets the factorisation pass."""
    wrap(patch, constraints, "_labels", lambda f, mesh, *rest: mesh.components)
    wrap(
        patch,
        poisson,
        "CholeskyFactor",
        lambda f, L, device: f(L + 1e-10 * sp.eye(L.shape[0], format="csr"), device),
    )


@fault("transforms")
def transforms_transposed(patch):
    """The transforms' transposes are applied."""

    def call(original, self, R, **given):
        if given.get("transforms") is not None:
            given["transforms"] = given["transforms"].mT
        return original(self, R, **given)

    wrap_method(patch, Solver, "__call__", call)


# ------------------------------------------------------- gauge


@fault("masked_gauge")
def ignored_mask(patch):
    """The gauge takes the mean of all vertices, whatever the mask."""
    wrap(patch, constraints, "_gauge_mask", lambda f, mesh, gauge, *rest: f(mesh, "mean", *rest))


@fault("translations")
def translations_in_reverse(patch):
    """The last component gets the first translation."""
    change_images(patch, "translations", lambda q: q.flip(0))


@fault("translations")
def translations_by_mean_only(patch):
    """Translations are forgotten under the gauge that fixes a vertex."""

    def place(original, self, values):
        return original(self, 0 * values if self.constraints.gauge_mask is None else values)

    wrap_method(patch, Solver, "_at_components", place)


# ------------------------------------------------------- unions, updates, wide batches


@fault("constrained_union")
def pins_of_a_union_not_moved(patch):
    """Pins keep the vertex numbers of their own parts."""
    change_union(patch, lambda union, parts: {"pins": torch.cat([p.pins for p in parts])})


@fault("constrained_union")
def one_handle_weight_in_a_union(patch):
    """All handles of a union are as strong as its first."""
    change_union(
        patch,
        lambda union, parts: {
            "handle_weights": torch.ones_like(union.handle_weights) * union.handle_weights[:1]
        },
    )


@fault("constrained_union")
def floating_components_reversed_in_a_union(patch):
    """Floating components are numbered from the last part on."""

    def change(union, parts):
        floats = union.floating < union.n_floating
        return {
            "floating": torch.where(floats, union.n_floating - 1 - union.floating, union.floating)
        }

    change_union(patch, change)


@fault("update")
def factor_survives_an_update(patch):
    """Moved vertices meet the old factor."""

    def update(original, self, vertices):
        moved = original(self, vertices)
        matrices = moved._matrices
        old = type(matrices).of(self._matrices.inverse, *matrices[1:4])
        moved._assign(moved.mesh, moved.constraints, old)
        return moved

    wrap_method(patch, Solver, "update", update)


@fault("update")
def weights_lost_in_an_update(patch):
    """An updated solver keeps pins and handles but not their weights."""

    def update(_, self, vertices):
        given = self.constraints
        return Solver(
            self.mesh.with_vertices(vertices),
            gauge=given.gauge_mask,
            pins=given.pins,
            handles=given.handles,
        )

    wrap_method(patch, Solver, "update", update)


@fault("chunks")
def only_the_first_chunk(patch):
    """Columns beyond the limit of one call are not solved."""

    def multiply(original, self, x):
        result = original(self, x)
        result[:, factor._COLUMNS["cpu"] :] = 0
        return result

    wrap_method(patch, factor.CholeskyFactor, "multiply", multiply)


# ------------------------------------------------------- derivatives by the geometry


@fault("geometry_gradient")
def constant_matrix(patch):
    """Only the right-hand side moves with the vertices, not the Laplacian."""

    def inverse(original, self, K, b):
        return original(self, K.new_zeros(K.shape), b)

    wrap_method(patch, linear_map.CellwiseInverse, "__call__", inverse)


@fault("geometry_gradient")
def negative_matrix_derivative(patch):
    """The Laplacian's derivative is added where it should be subtracted, in both modes."""
    backward, jvp = linear_map._Solve.backward, linear_map._Solve.jvp

    def opposite(ctx, grad):
        *nothing, K_bar, b_bar = backward(ctx, grad)
        return (*nothing, -K_bar, b_bar)

    patch.setattr(linear_map._Solve, "backward", staticmethod(opposite))
    patch.setattr(
        linear_map._Solve, "jvp", staticmethod(lambda ctx, a, c, K, b: jvp(ctx, a, c, -K, b))
    )


@fault("geometry_derivatives_of_higher_order")
def constant_geometry_tangent(patch):
    """Forward mode by the geometry is right once, but its result is not differentiable again."""
    original, fine = linear_map._Solve.jvp, 2.0**44
    rounded = staticmethod(lambda *args: torch.round(fine * original(*args)) / fine)
    patch.setattr(linear_map._Solve, "jvp", rounded)


@fault("geometry_double_backward")
def constant_geometry_gradient(patch):
    """The gradient by the Laplacian is right once, but not differentiable again."""
    original = linear_map._Solve.backward

    def backward(ctx, grad):
        *nothing, K_bar, b_bar = original(ctx, grad)
        return (*nothing, K_bar.detach(), b_bar)

    patch.setattr(linear_map._Solve, "backward", staticmethod(backward))


@fault("geometry_gradient")
def constant_gradients(patch):
    """The hat functions' gradients do not move with the vertices."""

    def change(mesh, geometry):
        return {"hats": cells.hat_gradients(mesh._corners, mesh._double_frames)}

    change_geometry(patch, change)


@fault("moving_frames")
def constant_frames(patch):
    """Frames do not turn with the faces."""
    change_geometry(patch, lambda mesh, geometry: {"frames": mesh._double_frames})


@fault("geometry_gradient_by_refactorising")
def constant_measures(patch):
    """Areas and volumes do not move with the vertices."""
    change_geometry(patch, lambda mesh, geometry: {"measures": mesh._double_measures})


@fault("geometry_gradient")
def constant_gauge(patch):
    """The gauge's mean is that of the constant mesh."""
    wrap_method(
        patch,
        gradient.CellGeometry,
        "vertex_measures",
        lambda f, self: self.mesh._double_vertex_measures,
    )


def change_moving_fit(patch, change):
    """Change (geometry, weights, R, images of pins, pull of handles)."""

    def fitted(original, self, *args):
        return original(self, *change(self, *args))

    wrap_method(patch, Solver, "_fitted_moving", fitted)


@fault("geometry_changes_no_value")
def handles_do_not_pull_a_moving_mesh(patch):
    """The right-hand side for a moving geometry has no handles."""
    change_moving_fit(patch, lambda self, *args: (*args[:-1], None))


@fault("geometry_changes_no_value")
def pins_do_not_pull_a_moving_mesh(patch):
    """The right-hand side for a moving geometry has no pins."""
    change_moving_fit(patch, lambda self, *args: (*args[:3], None, args[4]))


@fault("geometry_gradient")
def constant_face_weights(patch):
    """Face weights are taken as constants in the fit by a moving geometry."""

    def change(self, geometry, weights, *rest):
        return geometry, self.constraints.face_weights, *rest

    change_moving_fit(patch, change)


# ------------------------------------------------------- tetrahedra and their distortion


@fault("inverted_tetrahedra")
def unsigned_volumes(patch):
    """Gradients on inverted tetrahedra have the wrong sign."""

    def hats(original, corners, *rest):
        values = original(corners, *rest)
        if corners.shape[1] == 3:
            return values
        return values * cells.determinants(corners).sign()[:, None, None]

    wrap(patch, cells, "hat_gradients", hats)


@fault("tetrahedra_against_barycentric_inverse")
def parallelepipeds(patch):
    """Volumes are those of parallelepipeds: their scale cancels in the layer."""
    patch.setitem(cells._FACTORIAL, 3, 1.0)


@fault("tetrahedra_against_sparse_lu")
def swapped_facets(patch):
    """The gradients of two corners of every tetrahedron are exchanged."""

    def hats(original, corners, *rest):
        values = original(corners, *rest)
        return values[..., [1, 0, 2, 3]] if corners.shape[1] == 4 else values

    wrap(patch, cells, "hat_gradients", hats)


@fault("distortion_of_volumes")
def unsigned_singular_values(patch):
    """Flipped tetrahedra look unflipped."""
    wrap(patch, distortion, "determinant", lambda f, J: f(J).abs())


@fault("distortion_of_volumes")
def planar_cofactors(patch):
    """‖cof J‖ = ‖J‖, which holds for surfaces only."""

    wrap(patch, distortion, "_squared_inverse", lambda f, J, chi, norm: norm / chi / chi)
