from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from hypothesis import given
from torch.utils.data import DataLoader

from njf_models.datasets import uv
from njf_models.datasets.patches import PatchOptions
from njf_models.datasets.sources import CSGParts, RawMesh
from njf_models.datasets.uv import UVPatch, UVPatchDataset, build_uv_patches, split_by_mesh
from tests import meshes, references

OPTIONS = PatchOptions(min_faces=100, max_faces=250)
SOURCES = list(CSGParts(2, n_faces=2000))
Built = tuple[list[UVPatch], Counter[str]]


def build(root: Path, **changes: object) -> Built:
    arguments = {"seed": 0, "options": OPTIONS, "n_energies": 20, "n_jobs": 1} | changes
    return build_uv_patches(SOURCES, 3, cache_root=root, **arguments)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def built(root: Path) -> Built:
    return build(root)


def assert_equal(a: Built, b: Built) -> None:
    assert a[1] == b[1]
    for p, q in zip(a[0], b[0], strict=True):
        assert (p.mesh_name, p.family, p.flatness, p.energy) == (
            *(q.mesh_name, q.family, q.flatness, q.energy),
        )
        for name in ("vertices", "faces", "uv", "wks"):
            assert torch.equal(getattr(p, name), getattr(q, name))


# ------------------------------------------------------- pairs


def test_every_draw_is_kept_or_counted(built: Built) -> None:
    patches, counts = built
    assert counts["kept"] == len(patches) == 6
    assert [patch.mesh_name for patch in patches] == 3 * [SOURCES[0].name] + 3 * [SOURCES[1].name]


def test_targets_are_flip_free_and_of_the_energy_they_say(built: Built) -> None:
    for patch in built[0]:
        vertices, faces, target = (x.numpy() for x in (patch.vertices, patch.faces, patch.uv))
        assert len(igl.flipped_triangles(target, faces)) == 0
        J = references.jacobians(vertices, faces, target)
        density = (J**2).sum((1, 2)) + (np.linalg.pinv(J) ** 2).sum((1, 2))
        areas = references.areas(vertices, faces)
        assert patch.energy == pytest.approx(np.average(density, weights=areas), rel=1e-9)
        assert 4 <= patch.energy < 5


def test_targets_are_rigidly_aligned_with_the_projection(built: Built) -> None:
    for patch in built[0]:
        vertices, faces, target = (x.numpy() for x in (patch.vertices, patch.faces, patch.uv))
        weights = references.vertex_areas(vertices, faces)
        aligned = vertices[:, :2]

        def misfit(angle: float, shift: float = 0.0, *, x=target, to=aligned, w=weights) -> float:
            rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            return (w[:, None] * (x @ rotation + shift - to) ** 2).sum()

        others = [misfit(angle) for angle in np.linspace(0.01, 2 * np.pi - 0.01, 50)]
        assert misfit(0) < min(others)
        assert misfit(0) < min(misfit(0, shift) for shift in (-1e-3, 1e-3))


def test_types_and_shapes(built: Built) -> None:
    for patch in built[0]:
        n = patch.mesh.n_vertices
        assert patch.vertices.shape == (n, 3)
        assert patch.uv.shape == (n, 2)
        assert patch.wks.shape == (n, 20)
        dtypes = [x.dtype for x in (patch.vertices, patch.uv, patch.wks, patch.faces)]
        assert dtypes == [torch.float64, torch.float64, torch.float32, torch.int64]
        assert patch.wks.isfinite().all()


# ------------------------------------------------------- cache


def test_a_second_run_computes_nothing(
    built: Built, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(uv, "flatten", None)
    assert_equal(build(root), built)


def test_processes_build_what_one_builds(built: Built, tmp_path: Path) -> None:
    assert_equal(build(tmp_path, n_jobs=2), built)


def test_the_seed_and_the_content_choose_the_patches(built: Built, tmp_path: Path) -> None:
    other, _ = build(tmp_path, seed=1)
    assert not any(
        p.vertices.shape == q.vertices.shape for p, q in zip(other, built[0], strict=True)
    )
    stretched = replace(SOURCES[0], name="stretched", vertices=SOURCES[0].vertices * [1, 1, 1.01])
    patches, _ = build_uv_patches([stretched], 1, options=OPTIONS, cache_root=tmp_path, n_jobs=1)
    assert patches[0].vertices.shape != built[0][0].vertices.shape


def test_a_mesh_without_patches_is_counted_not_fatal(tmp_path: Path) -> None:
    raw = RawMesh("small", *meshes.sphere(), "MIT", "test", "small")
    options = replace(OPTIONS, attempts=3)
    patches, counts = build_uv_patches([raw], 2, options=options, cache_root=tmp_path, n_jobs=1)
    assert patches == []
    assert counts == {"component too small": 6}


# ------------------------------------------------------- data set and split


def test_batches_are_lists_of_patches(built: Built) -> None:
    loader = DataLoader(UVPatchDataset(built[0]), batch_size=4, collate_fn=list)
    assert [len(batch) for batch in loader] == [4, 2]
    assert next(iter(loader))[0] is built[0][0]


def labelled(families: list[int]) -> list[UVPatch]:
    vertices, faces = map(torch.from_numpy, meshes.triangle())
    zeros = torch.zeros(3, 2, dtype=torch.float64)
    return [
        UVPatch(vertices, faces, zeros, zeros.float(), f"{family}/{i}", str(family), 1.0, 4.0)
        for i, family in enumerate(families)
    ]


@given(seed=meshes.seeds)
def test_no_family_is_on_two_sides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    patches = labelled(rng.integers(0, 40, 200).tolist())
    parts = split_by_mesh(patches, (0.6, 0.2, 0.2), seed)
    assert sorted(patch.mesh_name for part in parts for patch in part) == sorted(
        patch.mesh_name for patch in patches
    )
    families = [{patch.family for patch in part} for part in parts]
    assert sum(map(len, families)) == len(set.union(*families))
    shuffled = [patches[i] for i in rng.permutation(len(patches))]
    again = split_by_mesh(shuffled, (0.6, 0.2, 0.2), seed)
    assert [{patch.family for patch in part} for part in again] == families


def test_the_split_has_the_fractions_and_depends_on_the_seed() -> None:
    patches = labelled([k % 100 for k in range(1000)])
    splits = [split_by_mesh(patches, (0.8, 0.1, 0.1), seed) for seed in (0, 1)]
    assert [len(part) for part in splits[0]] == [800, 100, 100]
    assert splits[0][0] != splits[1][0]


@pytest.mark.parametrize("fractions", [(0.5, 0.4), (1.2, -0.2), (1.0, 0.0)])
def test_fractions_are_fractions(fractions: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="fractions must be positive and sum to 1"):
        split_by_mesh(labelled([1, 2, 3]), fractions)


def test_too_few_families_are_an_error() -> None:
    with pytest.raises(ValueError, match="2 families of meshes give parts of"):
        split_by_mesh(labelled([1, 2]), (0.8, 0.1, 0.1))
