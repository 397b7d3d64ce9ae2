"""Cages around closed surfaces, and mean-value coordinates in them (Ju, Schaefer, Warren 2005)."""

from __future__ import annotations

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

import diffpoisson as dp

_CHUNK = 256  # points at a time, whose arrays of some hundred faces stay in the cache


def build_cage(mesh: dp.Mesh, n_faces: int = 400, offset: float = 0.03) -> dp.Mesh:
    """A coarse closed surface around a mesh: its offset surface, decimated.

    Parts of the surface that are closer to each other than twice the offset end up in one part of
    the cage.

    Args:
        mesh: a closed surface.
        n_faces: of the cage. With too few, the cage cuts into the surface.
        offset: distance of the offset surface, as a share of the longest side of the bounding box.

    Raises:
        ValueError: the mesh is not closed.
    """
    if len(mesh.boundary_loops):
        raise ValueError("build_cage: the mesh has a boundary, so that nothing is inside of it")
    V, F = mesh.vertices.double().numpy(), mesh.faces.numpy()
    low, high = V.min(axis=0), V.max(axis=0)
    distance = offset * float((high - low).max())
    # Cells not longer than the offset, so that the grid sees both sides of it.
    axes = [
        np.arange(a - 2 * distance, b + 3 * distance, 0.6 * distance)
        for a, b in zip(low, high, strict=True)
    ]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")  # libigl wants x to vary fastest
    grid = np.ascontiguousarray(np.stack([x, y, z], axis=-1).reshape(-1, 3))
    signed = igl.signed_distance(grid, V, F)[0]
    surface = igl.marching_cubes(signed, grid, *(len(axis) for axis in axes), distance)
    fine, fine_faces = np.asfortranarray(surface[0]), np.asfortranarray(surface[1], dtype=np.int32)
    vertices, faces, _, _ = igl.qslim(fine, fine_faces, n_faces)
    return dp.Mesh(*(torch.from_numpy(array.copy()) for array in (vertices, faces)))


def mean_value_coordinates(
    points: Float[Tensor, "p 3"], vertices: Float[Tensor, "k 3"], faces: Int[Tensor, "m 3"]
) -> Float[Tensor, "p k"]:
    """Weights W with W @ vertices = points, smooth in the points, that carry a cage's motion over.

    The coordinates of a point are those of the mean of the cage over all directions as seen from
    it: a face adds to its corner i the weight (nᵢ · m) / (nᵢ · uᵢ dᵢ), where uᵢ is the direction
    to the corner, dᵢ its distance, nᵢ the unit normal of the plane through the point and the
    opposite edge, and m = Σ θᵢ nᵢ / 2 the integral of the direction over the spherical triangle, of
    edges θᵢ.

    Args:
        points: none on the cage.
        vertices: of a closed cage.
        faces: its triangles.

    Returns:
        (p, k) float64, rows summing to one.
    """
    points, vertices = points.double(), vertices.double()
    return torch.cat([_coordinates(piece, vertices, faces) for piece in points.split(_CHUNK)])


def _coordinates(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
    to_vertex = vertices - points[:, None]
    distance = torch.linalg.vector_norm(to_vertex, dim=-1)
    u = (to_vertex / distance[..., None])[:, faces]  # (p, m, 3 corners, 3)
    following, preceding = u.roll(-1, dims=2), u.roll(-2, dims=2)  # the edge opposite of a corner
    cross = torch.linalg.cross(following, preceding)
    sine = torch.linalg.vector_norm(cross, dim=-1)
    theta = torch.atan2(sine, (following * preceding).sum(-1))
    normal = cross / sine[..., None]
    m = (theta[..., None] * normal).sum(2, keepdim=True) / 2
    weight = (normal * m).sum(-1) / (normal * u).sum(-1)
    # Seen edge-on, a face has a solid angle as small as det u, and no weight in the limit, of which
    # rounding leaves 0 / 0. What is dropped is at most as large as what rounding makes of the rest.
    det = (u * cross).sum(-1).abs()
    weight = weight.where(det > torch.finfo(det.dtype).eps ** 0.5, 0.0)
    weight = weight / distance[:, faces]
    total = torch.zeros_like(distance)
    total.index_add_(1, faces.flatten(), weight.flatten(1))
    return total / total.sum(dim=1, keepdim=True)
