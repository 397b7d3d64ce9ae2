from __future__ import annotations

import igl
import numpy as np
import pytest
import torch

from njf_models.datasets import uv
from njf_models.datasets.patches import PatchOptions, PatchSampler
from njf_models.datasets.sources import CSGParts
from njf_models.datasets.uv import FlatPatch, draw
from tests import meshes, references

OPTIONS = PatchOptions(min_faces=100, max_faces=250)


@pytest.fixture(scope="module")
def sampler() -> PatchSampler:
    part = next(iter(CSGParts(1, n_faces=2000)))
    return PatchSampler(part.vertices, part.faces, OPTIONS)


@pytest.fixture(scope="module")
def flat(sampler: PatchSampler) -> list[FlatPatch]:
    patches = [draw(sampler, "part", 0, index, 20)[0] for index in range(4)]
    assert None not in patches
    return patches


def arrays(flat: FlatPatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    mesh = flat.patch.mesh
    return mesh.vertices.numpy(), mesh.faces.numpy(), flat.uv.double().numpy()


def test_targets_are_flip_free_and_of_the_energy_they_say(flat: list[FlatPatch]) -> None:
    for patch in flat:
        vertices, faces, target = arrays(patch)
        assert len(igl.flipped_triangles(target, faces)) == 0
        J = references.jacobians(vertices, faces, target)
        density = (J**2).sum((1, 2)) + (np.linalg.pinv(J) ** 2).sum((1, 2))
        areas = references.areas(vertices, faces)
        assert patch.energy == pytest.approx(np.average(density, weights=areas), rel=1e-9)
        assert 4 <= patch.energy < 5
        assert patch.iterations > 1


def test_targets_are_rigidly_aligned_with_the_projection(flat: list[FlatPatch]) -> None:
    for patch in flat:
        vertices, faces, target = arrays(patch)
        weights = references.vertex_areas(vertices, faces)
        aligned = vertices[:, :2]

        def misfit(angle: float, shift: float = 0.0, *, x=target, to=aligned, w=weights) -> float:
            rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            return (w[:, None] * (x @ rotation + shift - to) ** 2).sum()

        others = [misfit(angle) for angle in np.linspace(0.01, 2 * np.pi - 0.01, 50)]
        assert misfit(0) < min(others)
        assert misfit(0) < min(misfit(0, shift) for shift in (-1e-3, 1e-3))


def test_all_is_rounded_as_it_will_be_stored(flat: list[FlatPatch]) -> None:
    for patch in flat:
        vertices = patch.patch.mesh.vertices
        assert torch.equal(vertices, vertices.float().double())
        assert [patch.uv.dtype, patch.wks.dtype] == [torch.float32, torch.float16]
        assert patch.wks.shape == (len(vertices), 20)


def test_a_draw_depends_on_mesh_seed_and_index_only(
    sampler: PatchSampler, flat: list[FlatPatch]
) -> None:
    again, _ = draw(sampler, "part", 0, 2, 0)
    assert torch.equal(again.uv, flat[2].uv)
    for other in (("part", 1, 2), ("part", 0, 1), ("other", 0, 2)):
        patch, _ = draw(sampler, *other, 0)
        assert patch.uv.shape != again.uv.shape


def test_every_attempt_is_counted() -> None:
    sampler = PatchSampler(*meshes.sphere(), PatchOptions(100, 200, attempts=3))
    assert draw(sampler, "ball", 0, 0, 0) == (None, {"component too small": 3})


def test_a_target_that_rounding_flips_is_rejected(
    sampler: PatchSampler, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Far from the origin, float32 cannot hold a map."""
    align = uv.procrustes
    monkeypatch.setattr(uv, "procrustes", lambda *args: align(*args) + 3e6)
    flat, counts = draw(sampler, "part", 0, 0, 0)
    assert flat is None
    assert counts["rounding"] >= 5
