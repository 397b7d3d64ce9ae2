"""Independent references: textbook formulas in dense NumPy and libigl, none of the package's code.

Geometry is evaluated in `np.longdouble` (80-bit on x86), so that on slivers an error is the
package's, not the reference's.
"""

from __future__ import annotations

import igl
import numpy as np
import torch
from torch import Tensor


def edge_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(m, 2, D) the edges from corner 0 to corners 1 and 2, in long double."""
    corners = vertices.astype(np.longdouble)[faces]
    return corners[:, 1:] - corners[:, :1]


def areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """½ √det of the Gram matrix of two edges."""
    return (np.sqrt(_gram(edge_vectors(vertices, faces))[1]) / 2).astype(np.float64)


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    thirds = np.repeat(areas(vertices, faces) / 3, 3)
    return np.bincount(faces.ravel(), weights=thirds, minlength=len(vertices))


def jacobians(vertices: np.ndarray, faces: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """(m, c, D) extrinsic Jacobians: J e = φ(v₁) - φ(v₀) on two edges, J n = 0.

    J = d G⁻¹ Eᵀ in the edge basis E, with G the 2 × 2 Gram matrix; no rotated edges, no frames.
    """
    E = edge_vectors(vertices, faces)
    gram, det = _gram(E)
    adjugate = np.stack(
        [
            np.stack([gram[:, 1, 1], -gram[:, 0, 1]], axis=1),
            np.stack([-gram[:, 1, 0], gram[:, 0, 0]], axis=1),
        ],
        axis=1,
    )
    values = phi.astype(np.longdouble)[faces]
    differences = values[:, 1:] - values[:, :1]  # (m, 2, c)
    J = np.einsum("tac,tab,tbd->tcd", differences, adjugate, E) / det[:, None, None]
    return J.astype(np.float64)


def _gram(E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    gram = np.einsum("tad,tbd->tab", E, E)
    return gram, gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2


def centred(vertices: np.ndarray, faces: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x minus its area-weighted mean on each connected component."""
    labels, weights = components(len(vertices), faces), vertex_areas(vertices, faces)[:, None]
    result = x.astype(np.float64).copy()
    for label in range(labels.max() + 1):
        here = labels == label
        result[here] -= (weights[here] * x[here]).sum(0) / weights[here].sum()
    return result


def components(n_vertices: int, faces: np.ndarray) -> np.ndarray:
    """Labels by plain propagation of the smallest index."""
    labels = np.arange(n_vertices)
    while True:
        lowest = labels[faces].min(axis=1)
        updated = labels.copy()
        np.minimum.at(updated, faces.ravel(), np.repeat(lowest, faces.shape[1]))
        if (updated == labels).all():
            return np.unique(labels, return_inverse=True)[1]
        labels = updated


def poisson(vertices: np.ndarray, faces: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(n, c) minimiser from libigl's gradient, its areas and dense least squares.

    Not by a pseudo-inverse of the normal equations: its cutoff can take the constants, whose
    eigenvalue is rounding, for part of the range.
    """
    G = igl.grad(vertices, faces).toarray()  # rows ordered by direction, then by face
    # libigl's areas are signed in the plane.
    areas = np.tile(np.abs(igl.doublearea(vertices, faces)) / 2, vertices.shape[1])
    stacked = np.concatenate(list(np.moveaxis(R, -1, 0)))
    root = np.sqrt(areas)[:, None]
    phi = np.linalg.lstsq(root * G, root * stacked, rcond=None)[0]
    return centred(vertices, faces, phi)


def dirichlet_energy(
    vertices: np.ndarray, faces: np.ndarray, R: np.ndarray, phi: np.ndarray
) -> float:
    """Σ |t| ‖∇φ - R‖², with R restricted to the tangent planes."""
    E = edge_vectors(vertices, faces).astype(np.float64)
    tangent = np.linalg.pinv(E) @ E  # (m, D, D) orthogonal projector onto each tangent plane
    residual = jacobians(vertices, faces, phi) - R @ tangent
    return float((areas(vertices, faces)[:, None, None] * residual**2).sum())


# ------------------------------------------------------- any cells, constraints, and derivatives


def barycentric_gradients(vertices: Tensor, cells: np.ndarray) -> Tensor:
    """(m, k, D) gradients of the hat functions of any cells, differentiable in the vertices.

    λ is the pseudo-inverse's way back from positions to barycentric coordinates: with the d × D
    matrix E of edges from corner 0, ∇λᵢ are the columns of E⁺ = Eᵀ(EEᵀ)⁻¹, and Σ ∇λᵢ = 0.
    """
    corners = vertices[cells]
    E = corners[:, 1:] - corners[:, :1]
    others = torch.linalg.inv(E @ E.mT) @ E
    return torch.cat([-others.sum(1, keepdim=True), others], dim=1)


def measures(vertices: Tensor, cells: np.ndarray) -> Tensor:
    """√det(EEᵀ) / d!, by hand: nested forward mode of torch.linalg.det is wrong in torch 2.13."""
    corners = vertices[cells]
    E = corners[:, 1:] - corners[:, :1]
    gram = E @ E.mT
    a, b, c = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    minor = a * c - b**2
    if cells.shape[1] == 3:
        return minor.sqrt() / 2
    d, e, f = gram[:, 2].unbind(1)
    return (f * minor - (a * e**2 - 2 * b * d * e + c * d**2)).sqrt() / 6


def vertex_measures(vertices: Tensor, cells: np.ndarray) -> Tensor:
    incidence = torch.zeros(len(vertices), len(cells), dtype=torch.float64)
    incidence[cells.T, np.arange(len(cells))] = 1 / cells.shape[1]
    return incidence @ measures(vertices, cells)


def gram_schmidt_frames(vertices: Tensor, faces: np.ndarray) -> Tensor:
    """(m, 3, 2) tangent bases of triangles in space: the first edge, and the rest of the second."""
    a, b, c = vertices[faces].unbind(1)
    x = (b - a) / (b - a).norm(dim=1, keepdim=True)
    y = (c - a) - ((c - a) * x).sum(1, keepdim=True) * x
    return torch.stack([x, y / y.norm(dim=1, keepdim=True)], dim=2)


def hat_gradient_matrix(vertices: Tensor, cells: np.ndarray) -> Tensor:
    """(m·D, n) dense ∇, row D·j + i for direction i on cell j."""
    g = barycentric_gradients(vertices, cells)
    m, k, D = g.shape
    G = torch.zeros(m, D, len(vertices), dtype=torch.float64)
    rows, columns = np.arange(m).repeat(k), cells.ravel()
    return G.index_put(
        (torch.tensor(rows)[:, None], torch.arange(D), torch.tensor(columns)[:, None]),
        g.reshape(m * k, D),
    ).reshape(m * D, -1)


def constrained_poisson(
    vertices: Tensor,
    cells: np.ndarray,
    R: Tensor,
    *,
    pins: tuple[np.ndarray, Tensor] | None = None,
    handles: tuple[np.ndarray, Tensor] | None = None,
    handle_weights: Tensor | float = 1.0,
    face_weights: Tensor | None = None,
    ignored: np.ndarray | None = None,
    gauge: str | Tensor = "mean",
    translations: Tensor | None = None,
) -> Tensor:
    """(n, c) solution of all constraints at once, as one dense saddle-point (KKT) system.

    min Σ w|t| ‖∇Φ - R‖² + Σ a ‖Φₕ - qₕ‖²  subject to  CΦ = q, where the rows of C are the pins and,
    for each component that nothing holds, what the gauge fixes. Nothing is eliminated. R acts on
    ambient vectors, (m, c, D); ignored marks the faces of weight zero. Differentiable in every
    tensor, to any order.
    """
    n, c = len(vertices), R.shape[1]
    empty = (np.zeros(0, dtype=np.int64), torch.zeros(0, c, dtype=torch.float64))
    (pinned, q_pins), (handled, q_handles) = pins or empty, handles or empty
    weights = torch.ones(len(cells), dtype=torch.float64) if face_weights is None else face_weights
    G = hat_gradient_matrix(vertices, cells)
    A = (measures(vertices, cells) * weights).repeat_interleave(vertices.shape[1])
    S = torch.eye(n, dtype=torch.float64)[handled]
    a = torch.as_tensor(handle_weights, dtype=torch.float64).expand(len(handled))
    K = G.T @ (A[:, None] * G) + S.T @ (a[:, None] * S)
    b = G.T @ (A[:, None] * R.mT.reshape(-1, c)) + S.T @ (a[:, None] * q_handles)

    labels = components(n, cells if ignored is None else cells[~ignored])
    held = set(labels[pinned]) | set(labels[handled])
    sizes = vertex_measures(vertices, cells)
    rows = [torch.eye(n, dtype=torch.float64)[pinned]]
    for label in [label for label in np.unique(labels) if label not in held]:
        here = torch.from_numpy(labels == label)
        if isinstance(gauge, str) and gauge == "vertex":
            row = torch.zeros(n, dtype=torch.float64)
            row[here.nonzero()[0]] = 1
        else:
            row = sizes * (here if isinstance(gauge, str) else here & gauge)
            row = row / row.sum()
        rows.append(row[None])
    C = torch.cat(rows)
    q = torch.zeros(len(C) - len(q_pins), c, dtype=torch.float64)
    q = torch.cat([q_pins, q if translations is None else translations])
    # Both blocks of order one, whatever the unit of length.
    unit = K.detach().diagonal().max()
    system = torch.cat(
        [
            torch.cat([K / unit, C.T], dim=1),
            torch.cat([C, torch.zeros(len(C), len(C), dtype=torch.float64)], dim=1),
        ]
    )
    # Not torch.linalg.solve, whose second derivatives by the matrix are wrong in torch 2.13.
    return (torch.linalg.inv(system) @ torch.cat([b / unit, q]))[:n]


def symmetric_dirichlet(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Area-weighted mean of Σ σᵢ² + σᵢ⁻², singular values by LAPACK."""
    sigma = np.linalg.svd(jacobians(vertices, faces, uv), compute_uv=False)[:, :2]
    weights = areas(vertices, faces)
    return (weights * (sigma**2 + sigma**-2.0).sum(1)).sum() / weights.sum()
