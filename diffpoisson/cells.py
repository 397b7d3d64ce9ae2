"""Closed-form geometry of single cells: triangles in the plane or in space, tetrahedra.

Pure functions of the corners' positions (m, k, D), differentiable any number of times; d = k - 1 is
the dimension of the cell. Everything is computed in float64.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Corners = Float[Tensor, "m k D"]
Determinants = Float[Tensor, "m *D"]

# The computed determinant of d edges of lengths |e| carries an absolute rounding error below c u
# Π|e|, u the unit roundoff of float64: c = 8 for a cross product (two differences, two products and
# one subtraction in each component), c = 16 for a triple product (one more product and sum, twice).
# A cell whose determinant is smaller cannot be told from a flat one in float64.
_DETERMINANT_ROUNDOFF = {2: 8 * 2.0**-53, 3: 16 * 2.0**-53}
_FACTORIAL = {2: 2.0, 3: 6.0}


def measures(corners: Corners, determinant: Determinants | None = None) -> Float[Tensor, "m"]:
    """Area of each triangle or volume of each tetrahedron, whatever its orientation.

    Args:
        corners: the cells.
        determinant: `determinants(corners)`, where they are known already.
    """
    return _size(_or_new(determinant, corners)) / _FACTORIAL[corners.shape[1] - 1]


def determinants(corners: Corners) -> Determinants:
    """d! times the signed measure of each cell, (m,); as a normal vector, (m, 3), in space.

    Taken at the corner with the shortest edges: all corners agree, but there a sliver loses the
    fewest digits to cancellation.
    """
    return _determinant(_edges_at_best_corner(corners))


def degenerate(corners: Corners, determinant: Determinants | None = None) -> Bool[Tensor, "m"]:
    """Cells whose measure is indistinguishable from zero in float64, at any scale."""
    bound = _DETERMINANT_ROUNDOFF[corners.shape[1] - 1] * _products_at_corners(corners).amin(1)
    return _size(_or_new(determinant, corners)) <= bound


def thinness(corners: Corners) -> Float[Tensor, "m"]:
    """Least height of each cell over its longest edge: √3/2 for an equilateral triangle."""
    d = corners.shape[1] - 1
    edges = _norm(corners[:, None] - corners[:, :, None]).flatten(1)
    facets = edges if d == 2 else _norm(_facet_normals(corners)) / 2
    heights = d * measures(corners) / facets.amax(dim=1)
    return heights / edges.amax(dim=1)


def frames(corners: Corners, determinant: Determinants | None = None) -> Float[Tensor, "m D d"]:
    """Orthonormal basis of each cell's tangent space, as columns.

    Of a triangle in space: along its first edge and across it, B₁ × B₂ = normal. Else the identity.
    """
    m, k, D = corners.shape
    if k - 1 == D:
        return torch.eye(D, dtype=corners.dtype, device=corners.device).expand(m, D, D)
    first = corners[:, 1] - corners[:, 0]
    x = first / _norm(first)[:, None]
    normal = _or_new(determinant, corners)
    normal = normal / _norm(normal)[:, None]
    return torch.stack([x, torch.linalg.cross(normal, x)], dim=2)


def hat_gradients(
    corners: Corners, frames: Float[Tensor, "m D d"], determinant: Determinants | None = None
) -> Float[Tensor, "m d k"]:
    """Gradient ∇λᵢ of each corner's hat function, in coordinates of the frames.

    ∇λᵢ is the inward normal of the facet opposite to corner i, of the length of that facet over d!
    times the cell's measure: 1 / height.
    """
    determinant = _or_new(determinant, corners)
    if corners.shape[1] == 4:
        return _facet_normals(corners).mT / determinant[:, None, None]
    if determinant.ndim == 2:
        determinant = _norm(determinant)  # frames are oriented like the face
    opposite = corners.roll(1, dims=1) - corners.roll(-1, dims=1)  # e₀ = v₂ - v₁, …
    x, y = (opposite @ frames).unbind(2)
    return torch.stack([-y, x], dim=1) / determinant[:, None, None]  # e rotated by 90°


def _edges_at_best_corner(corners: Corners) -> Float[Tensor, "m d D"]:
    """The d edges that leave the corner where the product of their lengths is least, in order."""
    best = _products_at_corners(corners.detach()).argmin(dim=1)
    if corners.shape[1] == 3:  # at a third of the cost: two corners share each edge
        edges = corners.roll(-1, dims=1) - corners  # from corner i to the next
        best = best[:, None, None]
        pair = torch.cat([best, (best + 2) % 3], dim=1).expand(-1, -1, corners.shape[2])
        onward, back = edges.gather(1, pair).unbind(1)
        return torch.stack([onward, -back], dim=1)
    return _edges_of_tetrahedra(corners)[torch.arange(len(best), device=best.device), best]


def _products_at_corners(corners: Corners) -> Float[Tensor, "m k"]:
    """The product of the lengths of the d edges at each corner."""
    if corners.shape[1] == 4:
        return _norm(_edges_of_tetrahedra(corners)).prod(dim=2)
    a, b, c = corners.unbind(1)
    x, y, z = _norm(b - a), _norm(c - b), _norm(a - c)
    return torch.stack([x * z, y * x, z * y], dim=1)


def _edges_of_tetrahedra(corners: Float[Tensor, "m 4 3"]) -> Float[Tensor, "m 4 3 3"]:
    """From each corner to the others, in an order that keeps the orientation."""
    edges = corners[:, None, :, :] - corners[:, :, None, :]  # from corner i to corner j
    others = torch.tensor(_OTHERS, device=corners.device)
    return edges[:, torch.arange(4, device=corners.device)[:, None], others]


_OTHERS = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


def _or_new(determinant: Determinants | None, corners: Corners) -> Determinants:
    return determinants(corners) if determinant is None else determinant


def _size(determinant: Determinants) -> Float[Tensor, "m"]:
    return determinant.abs() if determinant.ndim == 1 else _norm(determinant)


def _determinant(edges: Float[Tensor, "m d D"]) -> Determinants:
    a, b = edges[:, 0], edges[:, 1]
    if edges.shape[1] == 3:
        return (torch.linalg.cross(a, b) * edges[:, 2]).sum(-1)
    if edges.shape[2] == 3:
        return torch.linalg.cross(a, b)
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _facet_normals(corners: Float[Tensor, "m 4 3"]) -> Float[Tensor, "m 4 3"]:
    """Twice the area vector of the facet opposite to each corner, inward if positively oriented."""
    others = torch.tensor(_OTHERS, device=corners.device)
    a, b, c = corners[:, others].unbind(2)
    return -torch.linalg.cross(b - a, c - a)


def _norm(vectors: Tensor) -> Tensor:
    # Not torch.linalg.vector_norm: reverse over twice-nested forward mode raises in torch 2.13. Not
    # sum(-1) either, which takes five times as long for rows of two or three numbers.
    x, *others = vectors.square().unbind(-1)
    for y in others:
        x = x + y
    return x.sqrt()
