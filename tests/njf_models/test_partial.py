"""Partial surfaces are what is left of the whole ones."""

from __future__ import annotations

import igl
import numpy as np
import pytest
import torch

import diffpoisson as dp
from njf_models.datasets.partial import cut_pieces
from tests import meshes


def tube(n: int = 40) -> dp.Mesh:
    """A long bent strip of triangles, which any ball of radius 1 cuts in two."""
    t = torch.arange(n, dtype=torch.float64)
    rows = [torch.stack([t, torch.full_like(t, y), (t / 9).sin()], 1) for y in (0.0, 1.0)]
    i = torch.arange(n - 1)
    faces = [torch.stack(x, 1) for x in ((i, i + 1, n + i), (i + 1, n + i + 1, n + i))]
    return dp.Mesh(torch.cat(rows), torch.cat(faces))


@pytest.mark.parametrize("seed", range(5))
def test_what_is_left_is_outside_of_all_balls_and_connected(seed):
    mesh = dp.Mesh(*meshes.sphere(seed, subdivisions=3))
    generator = torch.Generator().manual_seed(seed)
    part, kept, chosen = cut_pieces(mesh, 2, (0.3, 0.5), generator)
    assert torch.equal(part.vertices, mesh.vertices[kept])
    assert part.n_components == 1
    faces = {tuple(sorted(face)) for face in mesh.faces.tolist()}
    left = [tuple(sorted(face)) for face in kept[part.faces].tolist()]
    assert set(left) < faces
    assert len(set(left)) == len(left)
    assert torch.equal(kept[part.faces], mesh.faces[chosen])
    # The same balls again.
    generator.manual_seed(seed)
    samples = dp.sample_surface(mesh, 2, generator=generator)
    centres = samples.interpolate(mesh, mesh.vertices)
    radii = 0.3 + 0.2 * torch.rand(2, dtype=torch.float64, generator=generator)
    distance = (part.centroids[:, None] - centres).norm(dim=-1)
    assert (distance > radii).all()
    gone = torch.tensor([tuple(sorted(f)) not in set(left) for f in mesh.faces.tolist()])
    inside = ((mesh.centroids[:, None] - centres).norm(dim=-1) <= radii).any(1)
    assert (inside <= gone).all()
    # Whatever else is gone was no neighbour of what is left.
    labels, areas = igl.facet_components(mesh.faces[~inside].numpy()), mesh.areas[~inside].numpy()
    sizes = np.bincount(labels[-1] if isinstance(labels, tuple) else labels, weights=areas)
    assert float(part.areas.sum()) == pytest.approx(sizes.max(), rel=1e-9)


def test_the_larger_part_is_kept():
    mesh = tube()
    for seed in range(8):
        part, kept, _ = cut_pieces(mesh, 1, (1.5, 1.5), torch.Generator().manual_seed(seed))
        assert part.n_components == 1
        assert float(part.areas.sum()) > 0.4 * float(mesh.areas.sum())
        assert len(kept) == part.n_vertices < mesh.n_vertices


def test_nothing_left_raises():
    with pytest.raises(ValueError, match="leave nothing of the mesh"):
        cut_pieces(tube(4), 1, (50.0, 50.0))
