"""The Laplacian of a surface's intrinsic Delaunay triangulation, through libigl.

Flipping edges within the surface, without moving vertices or the surface itself, until opposite
angles sum to at most π gives the triangulation of the same vertices whose Laplacian obeys a maximum
principle: cotangent weights of inner edges are not negative (Bobenko and Springborn 2007). Thin
faces with obtuse angles become better ones. It is another discretisation of the same surface's
Laplacian: fit for its spectrum and what is made of it, but not for the Poisson layer, whose
Jacobians belong to the original faces. Fitting those with another Laplacian would no longer
reproduce the map that they are the Jacobians of.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from diffpoisson.mesh import Mesh, MeshError


def intrinsic_delaunay_laplacian(mesh: Mesh) -> sp.csr_matrix:
    """∇ᵀA∇ on the intrinsic Delaunay triangulation of the same vertices, (n, n).

    Edges at the boundary, and edges with more than two faces, are not flipped.

    Raises:
        MeshError: tetrahedra; or faces so thin that lengths lose the triangle inequality to
            rounding.

    References:
        Fisher, Springborn, Schröder and Bobenko, "An algorithm for the construction of intrinsic
        Delaunay triangulations", 2007.
    """
    import igl  # noqa: PLC0415  (a heavy import that few need)

    if mesh.cell_dim != 2:
        raise MeshError("laplacian: intrinsic Delaunay triangulations need triangles")
    corners = mesh._corners.cpu().numpy()
    edges = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # opposite to each corner
    lengths = np.linalg.norm(edges, axis=2)
    lengths = lengths / lengths.max()  # cotangents do not depend on the scale
    try:
        lengths, faces, *_ = igl.intrinsic_delaunay_triangulation(lengths, mesh._numpy_faces)
        L = -igl.cotmatrix_intrinsic(lengths, faces).tocsr()
    except (MemoryError, RuntimeError) as error:
        raise _too_thin() from error
    if not np.isfinite(L.data).all():
        raise _too_thin()
    return L


def _too_thin() -> MeshError:
    return MeshError(
        "laplacian: rounding keeps libigl from an intrinsic Delaunay triangulation of faces as "
        "thin as these; remesh them"
    )
