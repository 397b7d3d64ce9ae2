"""What fixes the solution of a Poisson problem: pins, handles, face weights, and a gauge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NoReturn

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from diffpoisson import topology
from diffpoisson.arguments import to_tensor
from diffpoisson.mesh import Mesh, describe_indices
from diffpoisson.transforms import is_constant

Gauge = Literal["mean", "vertex"]


@dataclass(frozen=True)
class Constraints:
    """A validated set of constraints on maps of one mesh.

    Components are those of the faces of positive weight. A component that holds a pin or a handle
    is held; each other one floats, and is placed by the gauge.

    Attributes:
        pins: (p,) vertices whose images are given.
        handles: (h,) vertices whose images are attracted to given points.
        handle_weights: (h,) float64 strength of each handle.
        face_weights: (m,) float64 factor on the measure of each face.
        free: (f,) vertices to solve for: neither pinned nor the anchor of a floating component.
        floating: (n,) for each vertex, the index of its floating component, or n_floating if held.
        n_floating: number of floating components.
        gauge_mask: (n,) bool, the vertices whose mean the gauge sets to zero; None if it leaves the
            anchors at zero.
    """

    pins: Int[Tensor, "p"]
    handles: Int[Tensor, "h"]
    handle_weights: Float[Tensor, "h"]
    face_weights: Float[Tensor, "m"]
    free: Int[Tensor, "f"]
    floating: Int[Tensor, "n"]
    n_floating: int
    gauge_mask: Bool[Tensor, "n"] | None

    @classmethod
    def build(
        cls,
        mesh: Mesh,
        *,
        gauge: Gauge | Bool[Tensor, "n"],
        pins: Int[Tensor, "p"] | Bool[Tensor, "n"] | None,
        handles: Int[Tensor, "h"] | Bool[Tensor, "n"] | None,
        handle_weights: Float[Tensor, "h"] | float,
        face_weights: Float[Tensor, "m"] | None,
    ) -> Constraints:
        """Validate; see `PoissonSolver` for the arguments and what is raised."""
        pinned = _vertex_indices(mesh, "pins", pins)
        handled = _vertex_indices(mesh, "handles", handles)
        if (both := torch.isin(handled, pinned)).any():
            _fail(
                f"{describe_indices(handled[both], 'vertex', 'vertices')} both pinned and handles"
            )
        if len(pinned) == mesh.n_vertices:
            _fail("every vertex is pinned, so that there is nothing to solve for; release some")
        strengths = _strengths(mesh, handled, handle_weights)
        weights = _face_weights(mesh, face_weights)
        labels = _labels(mesh, weights, pinned)

        held = torch.zeros(int(labels.max()) + 1, dtype=torch.bool, device=mesh.device)
        held[labels[torch.cat([pinned, handled])]] = True
        floats = ~held[labels]
        floating = torch.where(floats, (~held).cumsum(0)[labels] - 1, (~held).sum())
        n_floating = int((~held).sum())
        anchors = _first_of_each(floating, n_floating)
        solved = torch.ones(mesh.n_vertices, dtype=torch.bool, device=mesh.device)
        solved[pinned] = False
        solved[anchors] = False
        mask = _gauge_mask(mesh, gauge, floating, n_floating)
        free = solved.nonzero()[:, 0]
        return cls(pinned, handled, strengths, weights, free, floating, n_floating, mask)

    @property
    def natural(self) -> bool:
        """Whether the matrix is the mesh's Laplacian: no pins, handles or face weights."""
        held = len(self.pins) + len(self.handles) > 0
        return not held and bool((self.face_weights == 1).all())

    @classmethod
    def concatenate(cls, parts: Sequence[Constraints]) -> Constraints:
        """The constraints of the disjoint union of the meshes."""
        if len({part.gauge_mask is None for part in parts}) > 1:
            raise ValueError(
                "PoissonSolver.concatenate: either all solvers have the gauge 'vertex' or none"
            )
        starts = np.cumsum([0] + [len(part.floating) for part in parts]).tolist()
        floats = np.cumsum([0] + [part.n_floating for part in parts]).tolist()
        total = floats[-1]

        def moved(name: str) -> Tensor:
            pairs = zip(parts, starts, strict=False)
            return torch.cat([getattr(part, name) + start for part, start in pairs])

        def joined(name: str) -> Tensor:
            return torch.cat([getattr(part, name) for part in parts])

        floating = torch.cat(
            [
                torch.where(part.floating < part.n_floating, part.floating + first, total)
                for part, first in zip(parts, floats, strict=False)
            ]
        )
        return cls(
            moved("pins"),
            moved("handles"),
            joined("handle_weights"),
            joined("face_weights"),
            moved("free"),
            floating,
            total,
            None if parts[0].gauge_mask is None else joined("gauge_mask"),
        )

    def mean_weights(self, sizes: Float[Tensor, "n"]) -> Float[Tensor, "n"] | None:
        """Weights of the mean that the gauge sets to zero, given the vertices' sizes.

        They sum to one over each floating component and are zero elsewhere; None for no mean.
        """
        if self.gauge_mask is None:
            return None
        sizes = sizes * self.gauge_mask
        totals = sizes.new_zeros(self.n_floating + 1).index_add(0, self.floating, sizes)
        shares = torch.cat([totals[:-1].reciprocal(), totals.new_zeros(1)])
        return sizes * shares[self.floating]


def _fail(message: str) -> NoReturn:
    raise ValueError(f"PoissonSolver: {message}")


def _vertex_indices(mesh: Mesh, name: str, indices: Tensor | None) -> Int[Tensor, "k"]:
    """Distinct vertex indices on the mesh's device, from indices or a mask over the vertices."""
    if indices is None:
        return torch.zeros(0, dtype=torch.int64, device=mesh.device)
    indices = to_tensor("PoissonSolver", name, indices, mesh.device)
    if indices.dtype == torch.bool and indices.shape == (mesh.n_vertices,):
        return indices.nonzero()[:, 0]
    if indices.ndim != 1 or indices.dtype not in (torch.int32, torch.int64):
        _fail(
            f"{name} must be (k,) int64 vertex indices or a (n={mesh.n_vertices},) mask, got "
            f"{tuple(indices.shape)} {indices.dtype}"
        )
    outside = (indices < 0) | (indices >= mesh.n_vertices)
    if outside.any():
        _fail(
            f"{name} {describe_indices(outside.nonzero()[:, 0], 'entry', 'entries')} outside "
            f"0 … {mesh.n_vertices - 1}"
        )
    values, counts = indices.unique(return_counts=True)
    if (counts > 1).any():
        _fail(f"{name} name {describe_indices(values[counts > 1], 'vertex', 'vertices')} twice")
    return indices.long().clone()  # later edits by the caller must not reach the factor


def _strengths(mesh: Mesh, handles: Tensor, weights: Tensor | float) -> Float[Tensor, "h"]:
    strengths = _constant("handle_weights", weights, mesh)
    if strengths.shape not in ((), handles.shape):
        _fail(
            f"handle_weights must be a number or of shape ({len(handles)},), got "
            f"{tuple(strengths.shape)}"
        )
    strengths = strengths.expand(handles.shape)
    if not ((strengths > 0) & strengths.isfinite()).all():
        _fail("handle_weights must be positive and finite; leave out handles without weight")
    return strengths


def _constant(name: str, values: Tensor | float, mesh: Mesh) -> Tensor:
    """A float64 copy, of what has no derivative."""
    if isinstance(values, Tensor) and not is_constant(values):
        _fail(
            f"{name} require grad, but a factor is constant, so their gradient would silently be "
            f"wrong; pass {name}.detach() here, and face_weights=... to the solver's call if "
            "derivatives by them are wanted"
        )
    values = to_tensor("PoissonSolver", name, values, mesh.device)
    return values.double().clone()


def _face_weights(mesh: Mesh, weights: Tensor | None) -> Float[Tensor, "m"]:
    if weights is None:
        return torch.ones(mesh.n_faces, dtype=torch.float64, device=mesh.device)
    weights = _constant("face_weights", weights, mesh)
    if weights.shape != (mesh.n_faces,):
        _fail(f"face_weights must be of shape (m={mesh.n_faces},), got {tuple(weights.shape)}")
    bad = ~((weights >= 0) & weights.isfinite())
    if bad.any():
        _fail(
            f"face_weights of {describe_indices(bad.nonzero()[:, 0], 'face', 'faces')} negative or "
            "not finite"
        )
    return weights


def _labels(mesh: Mesh, weights: Tensor, pins: Tensor) -> Int[Tensor, "n"]:
    """Component of each vertex under the faces that count; each other vertex must be pinned."""
    counts = weights > 0
    if counts.all():
        return mesh.components
    covered = torch.zeros(mesh.n_vertices, dtype=torch.bool, device=mesh.device)
    covered[mesh.faces[counts]] = True
    covered[pins] = True
    if not covered.all():
        loose = describe_indices((~covered).nonzero()[:, 0], "vertex", "vertices")
        _fail(f"{loose} only in faces of weight zero, so undetermined; pin them, or use a weight")
    faces = mesh.faces[counts].cpu().numpy()
    labels = topology.component_labels(faces, mesh.n_vertices)
    return torch.from_numpy(labels).to(mesh.device)


def _gauge_mask(
    mesh: Mesh, gauge: Gauge | Tensor, floating: Tensor, n_floating: int
) -> Bool[Tensor, "n"] | None:
    if not isinstance(gauge, str):
        gauge = to_tensor("PoissonSolver", "a gauge mask", gauge, mesh.device)
        if gauge.shape != (mesh.n_vertices,) or gauge.dtype != torch.bool:
            _fail(
                f"a gauge mask must be (n={mesh.n_vertices},) bool, got {tuple(gauge.shape)} "
                f"{gauge.dtype}"
            )
        present = torch.zeros(n_floating + 1, dtype=torch.bool, device=mesh.device)
        present[floating[gauge]] = True
        if not present[:-1].all():
            empty = (~present[:-1]).nonzero()[:, 0]
            culprits = describe_indices(empty, "component", "components")
            _fail(f"the gauge mask has no vertex in floating {culprits}; add one, or pin it")
        return gauge.clone()
    if gauge not in ("mean", "vertex"):
        _fail(f"gauge must be 'mean', 'vertex' or a mask over the vertices, got {gauge!r}")
    everywhere = torch.ones(mesh.n_vertices, dtype=torch.bool, device=mesh.device)
    return everywhere if gauge == "mean" else None


def _first_of_each(labels: Tensor, count: int) -> Int[Tensor, "count"]:
    """Lowest index that carries each of the labels 0 … count - 1."""
    _, first = np.unique(labels.cpu().numpy(), return_index=True)
    return torch.from_numpy(first[:count]).to(labels.device)
