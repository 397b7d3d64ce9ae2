"""Independent references: textbook formulas in dense NumPy and libigl, none of the package's code.

Geometry is evaluated in `np.longdouble` (80-bit on x86), so that on slivers an error is the
package's, not the reference's.
"""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp


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
        np.minimum.at(updated, faces.ravel(), np.repeat(lowest, 3))
        if (updated == labels).all():
            return np.unique(labels, return_inverse=True)[1]
        labels = updated


def poisson(vertices: np.ndarray, faces: np.ndarray, R: np.ndarray) -> np.ndarray:
    """(n, c) minimiser from libigl's gradient, its areas and a dense pseudo-inverse."""
    G = igl.grad(vertices, faces).toarray()  # rows ordered by direction, then by face
    # libigl's areas are signed in the plane.
    A = sp.diags(np.tile(np.abs(igl.doublearea(vertices, faces)) / 2, vertices.shape[1]))
    stacked = np.concatenate(list(np.moveaxis(R, -1, 0)))
    phi = np.linalg.pinv(G.T @ A @ G, hermitian=True) @ (G.T @ (A @ stacked))
    return centred(vertices, faces, phi)


def dirichlet_energy(
    vertices: np.ndarray, faces: np.ndarray, R: np.ndarray, phi: np.ndarray
) -> float:
    """Σ |t| ‖∇φ - R‖², with R restricted to the tangent planes."""
    E = edge_vectors(vertices, faces).astype(np.float64)
    tangent = np.linalg.pinv(E) @ E  # (m, D, D) orthogonal projector onto each tangent plane
    residual = jacobians(vertices, faces, phi) - R @ tangent
    return float((areas(vertices, faces)[:, None, None] * residual**2).sum())
