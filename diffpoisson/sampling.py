"""Points spread uniformly by area over a surface, and any vertex attribute read at them."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from diffpoisson.arguments import require_integer, require_tensor
from diffpoisson.mesh import Mesh, require_mesh


class SurfaceSamples(NamedTuple):
    """Points on a mesh.

    Attributes:
        faces: (s,) int64, the face each point lies on.
        barycentric: (s, 3) weights of the face's corners, positive, sum 1.
    """

    faces: Int[Tensor, "s"]
    barycentric: Float[Tensor, "s 3"]

    def interpolate(
        self, mesh: Mesh, values: Float[Tensor, "*batch n c"]
    ) -> Float[Tensor, "*batch s c"]:
        """Vertex values at the points, linear on each face; differentiable in `values`."""
        require_mesh("interpolate", mesh)
        require_tensor("interpolate", "values", values, mesh.device)
        if values.ndim < 2 or values.shape[-2] != mesh.n_vertices:
            raise ValueError(
                f"interpolate: expected values of shape (…, n={mesh.n_vertices}, c), "
                f"got {tuple(values.shape)}"
            )
        corners = values[..., mesh.faces[self.faces], :]  # (…, s, 3, c)
        return (self.barycentric.to(values.dtype)[..., None] * corners).sum(-2)


def sample_surface(
    mesh: Mesh, n_samples: int, *, generator: torch.Generator | None = None
) -> SurfaceSamples:
    """Draw points independently and uniformly by area.

    Args:
        mesh: the surface, on the CPU or a GPU.
        n_samples: number of points s.
        generator: source of randomness on the mesh's device; torch's global one if omitted.

    Raises:
        ValueError: n_samples is negative.
    """
    require_mesh("sample_surface", mesh)
    require_integer("sample_surface", "n_samples", n_samples, least=0)
    mesh._require_triangles("sample_surface: areas")
    # Inverting the cumulative area has no limit on the number of faces, unlike torch.multinomial.
    cumulative = mesh._double_measures.cumsum(0)

    def uniform() -> Tensor:
        return cumulative.new_empty(n_samples).uniform_(generator=generator)

    # Doubles below 1 are at most 1 - 2⁻⁵³: such parts of the total round to less than the total.
    heights = uniform() * cumulative[-1]
    faces = torch.searchsorted(cumulative, heights, right=True)
    # The square root makes a point's distance from corner 0 uniform in area (Osada et al. 2002, eq.
    # 1).
    root, t = uniform().sqrt(), uniform()
    barycentric = torch.stack([1 - root, root * (1 - t), root * t], dim=-1)
    return SurfaceSamples(faces, barycentric.to(mesh.dtype))
