from __future__ import annotations

import math
from itertools import islice

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from igl import triangle

import diffpoisson as dp
from diffpoisson.parameterization import (
    _Descent,
    _embeddings,
    _rounded,
    _scaffold_iterates,
    _slim_iterates,
    procrustes,
    slim,
    tutte,
)
from tests import meshes, references


def spiky_disk(seed: int, amplitude: float, size: int = 6) -> meshes.Arrays:
    """Random heights: angles so obtuse that cotangent weights flip faces."""
    flat, faces = meshes.planar_disk(seed, size)
    heights = amplitude * np.random.default_rng(seed).standard_normal(len(flat))
    return np.c_[flat, heights], faces


def half_cylinder(size: int = 8) -> meshes.Arrays:
    """A developable surface of area π/2 × 3 (less the chords')."""
    flat, faces = meshes.planar_disk(1, size)
    angle = np.pi / 2 * flat[:, 0]
    return np.stack([np.sin(angle), 3 * flat[:, 1], np.cos(angle)], axis=1), faces


def symmetric_dirichlet(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray) -> float:
    """Mean of ‖J‖² + ‖J⁻¹‖² from J's pseudo-inverse, or inf if libigl calls a face flipped."""
    if len(igl.flipped_triangles(uv, faces)):
        return np.inf
    J = references.jacobians(vertices, faces, uv)
    density = (J**2).sum((1, 2)) + (np.linalg.pinv(J) ** 2).sum((1, 2))
    return float(np.average(density, weights=references.areas(vertices, faces)))


# ------------------------------------------------------- Tutte


@given(seed=meshes.seeds, amplitude=st.floats(0, 3), log_scale=st.floats(-3, 3))
def test_tutte_embeds_the_disk_in_a_circle_of_its_area(
    seed: int, amplitude: float, log_scale: float
) -> None:
    vertices, faces = spiky_disk(seed, amplitude)
    vertices *= 10.0**log_scale
    uv = tutte(dp.Mesh(vertices, faces)).numpy()
    # Positive faces inside a convex, simply traversed boundary cannot overlap.
    assert len(igl.flipped_triangles(uv, faces)) == 0
    loop = np.asarray(igl.boundary_loop(faces))
    radius = np.sqrt(references.areas(vertices, faces).sum() / np.pi)
    np.testing.assert_allclose(np.linalg.norm(uv[loop], axis=1), radius, rtol=1e-12)
    steps = np.diff(np.unwrap(np.arctan2(*uv[np.r_[loop, loop[0]]].T[::-1])))
    lengths = np.linalg.norm(np.diff(vertices[np.r_[loop, loop[0]]], axis=0), axis=1)
    np.testing.assert_allclose(steps, 2 * np.pi * lengths / lengths.sum(), atol=1e-12)


def test_tutte_is_libigls_harmonic_map_where_that_has_no_flips() -> None:
    vertices, faces = meshes.disk(3, 7)
    uv = tutte(dp.Mesh(vertices, faces)).numpy()
    loop = np.asarray(igl.boundary_loop(faces))
    expected = igl.harmonic(vertices, faces, loop, np.ascontiguousarray(uv[loop]), 1)
    np.testing.assert_allclose(uv, expected, atol=1e-12)


def test_tutte_is_the_uniform_map_where_the_harmonic_one_flips() -> None:
    vertices, faces = spiky_disk(0, 3.0)
    uv = tutte(dp.Mesh(vertices, faces)).numpy()
    loop = np.asarray(igl.boundary_loop(faces))
    harmonic = igl.harmonic(vertices, faces, loop, np.ascontiguousarray(uv[loop]), 1)
    assert len(igl.flipped_triangles(harmonic, faces)) > 0
    adjacency = igl.adjacency_matrix(faces).toarray().astype(bool)
    for vertex in np.setdiff1d(np.arange(len(uv)), loop):  # each is the mean of its neighbours
        np.testing.assert_allclose(uv[vertex], uv[adjacency[vertex]].mean(0), atol=1e-12)


def test_tutte_of_a_disk_without_interior_vertices() -> None:
    mesh = dp.Mesh(*meshes.triangle())
    assert not dp.flipped(dp.jacobians(mesh, tutte(mesh))).any()


def tube(around: int, along: int) -> meshes.Arrays:
    """A tube closed at one end; corners of uneven distances, so that its tip maps to no origin."""
    angle, height = np.meshgrid(2 * np.pi * (np.arange(around) / around) ** 1.5, np.arange(along))
    rings = np.stack([np.cos(angle), np.sin(angle), height], axis=-1).reshape(-1, 3)
    ring = np.arange(around)
    a = (around * np.arange(along - 1)[:, None] + ring).ravel()
    b = (around * np.arange(along - 1)[:, None] + np.roll(ring, -1)).ravel()
    last = around * (along - 1)
    fan = np.c_[last + ring, last + np.roll(ring, -1), np.full(around, len(rings))]
    faces = np.r_[np.c_[a, b, b + around], np.c_[a, b + around, a + around], fan]
    return np.r_[rings, [[0, 0, along]]], faces


@pytest.mark.parametrize(("dtype", "along"), [(np.float32, 30), (np.float64, 60)])
def test_tutte_of_a_deep_tube_pulls_outward(dtype: type, along: int) -> None:
    """Each ring shrinks by a factor, beyond what rounding leaves of uniform weights."""
    vertices, faces = tube(6, along)
    mesh = dp.Mesh(vertices.astype(dtype), faces)
    for uv, holds in ((next(_embeddings(mesh)), False), (tutte(mesh), True)):
        a, b, c = uv.double().numpy()[faces].swapaxes(0, 1)
        assert bool((np.linalg.det(np.stack([b - a, c - a], axis=1)) > 0).all()) is holds


def test_tutte_gives_up_where_nothing_is_left() -> None:
    """Three corners around, two hundred rings: no weights that double precision can hold help."""
    mesh = dp.Mesh(*tube(3, 200))
    assert len(list(_embeddings(mesh))) == 3
    with pytest.raises(dp.MeshError, match=r"rounding to torch.float64 flips \d+ of"):
        tutte(mesh)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (meshes.sphere(), "Euler characteristic 2, 0 boundary loops and genus 0"),
        (meshes.torus(), "Euler characteristic 0, 0 boundary loops and genus 1"),
        (meshes.annulus(), "Euler characteristic 0, 2 boundary loops and genus 0"),
        (meshes.parts(), "3 connected components"),
        (meshes.book(), "1 edges with more than two faces"),
        (meshes.bowtie(), "pinched vertices"),
        (meshes.moebius(), "inconsistent"),
        (meshes.planar_disk(), "D = 2"),
    ],
)
@pytest.mark.parametrize("operation", [tutte, lambda mesh: slim(mesh, mesh.vertices[:, :2])])
def test_what_is_not_a_disk_is_named(operation, arrays, message) -> None:
    with pytest.raises(dp.MeshError, match=message):
        operation(dp.Mesh(*arrays))


# ------------------------------------------------------- SLIM


@given(seed=meshes.seeds)
@settings(max_examples=5)
def test_slim_energies_are_the_symmetric_dirichlet_energy_and_fall(seed: int) -> None:
    vertices, faces = meshes.disk(seed, 6)
    mesh = dp.Mesh(vertices, faces)
    init = tutte(mesh)
    result = slim(mesh, init)
    assert result.converged
    np.testing.assert_allclose(
        [result.energies[0], result.energies[-1]],
        [symmetric_dirichlet(vertices, faces, uv.numpy()) for uv in (init, result.uv)],
        rtol=1e-9,
    )
    assert all(np.diff(result.energies) <= 1e-9)


def test_slim_ends_at_a_minimum() -> None:
    mesh = dp.Mesh(*meshes.disk(2, 6))
    result = slim(mesh, tutte(mesh), tolerance=1e-12)
    gradients = []
    for uv in (tutte(mesh).requires_grad_(), result.uv.requires_grad_()):
        (mesh.areas * dp.symmetric_dirichlet(dp.jacobians(mesh, uv))).sum().backward()
        gradients.append(uv.grad.norm())
    assert gradients[1] < 1e-4 * gradients[0]


def test_slim_unrolls_a_developable_surface_isometrically() -> None:
    vertices, faces = half_cylinder()
    mesh = dp.Mesh(vertices, faces)
    result = slim(mesh, tutte(mesh), tolerance=1e-9)
    assert result.energies[-1] == pytest.approx(4, abs=1e-6)
    uv = result.uv.numpy()
    edges = igl.edges(faces)
    lengths = [np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1) for x in (uv, vertices)]
    np.testing.assert_allclose(*lengths, rtol=2e-3)


@pytest.mark.parametrize("scaffold", [False, True])
def test_iterates_are_those_of_libigl(scaffold: bool) -> None:
    """One iteration each, with a scaffold or without, in the mesh's unit."""
    vertices, faces = meshes.disk(2, 6)
    vertices *= 7
    mesh = dp.Mesh(vertices, faces)
    start, unit = tutte(mesh).numpy(), np.sqrt(references.areas(vertices, faces).sum())
    arguments = (
        np.asfortranarray(vertices / unit),
        np.asfortranarray(faces, dtype=np.int32),
        np.asfortranarray(start / unit),
        igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
        np.zeros(0, dtype=np.int32),
        np.zeros((0, 2), order="F"),
        0.0,
    )
    if scaffold:
        data = triangle.SCAFData()
        triangle.scaf_precompute(*arguments, data)
        expected = [triangle.scaf_solve(1, data)[: len(vertices)].copy() for _ in range(3)]
    else:
        data = igl.slim_precompute(*arguments)
        expected = [igl.slim_solve(data, 1)[:, :2].copy() for _ in range(3)]
    iterates = (_scaffold_iterates if scaffold else _slim_iterates)(mesh, start)
    for uv, reference in zip(islice(iterates, 3), expected, strict=True):
        np.testing.assert_allclose(uv, unit * reference, atol=1e-6)


def test_slim_does_not_round_to_a_precision_that_flips_faces() -> None:
    """Far from the origin, single precision leaves no difference between two corners."""
    vertices, faces = meshes.disk(0, 6)
    mesh = dp.Mesh(vertices.astype(np.float32), faces)
    near = tutte(mesh).double().numpy()
    assert torch.equal(_rounded(mesh, near), tutte(mesh))
    with pytest.raises(dp.MeshError, match=r"rounding to torch.float32 flips \d+ of"):
        _rounded(mesh, near + 1e9)


@pytest.mark.parametrize("scale", [1e-4, 1e3])
def test_slim_commutes_with_scaling(scale: float) -> None:
    vertices, faces = meshes.disk(0, 6)
    unit, scaled = dp.Mesh(vertices, faces), dp.Mesh(scale * vertices, faces)
    expected, actual = slim(unit, tutte(unit)), slim(scaled, tutte(scaled))
    np.testing.assert_allclose(actual.energies, expected.energies, rtol=1e-9)
    torch.testing.assert_close(actual.uv, scale * expected.uv, rtol=1e-6, atol=1e-6 * scale)


def test_slim_keeps_single_precision() -> None:
    vertices, faces = meshes.disk(0, 6)
    mesh = dp.Mesh(vertices.astype(np.float32), faces)
    result = slim(mesh, tutte(mesh))
    assert result.uv.dtype == torch.float32
    assert not dp.flipped(dp.jacobians(mesh, result.uv)).any()


def test_slim_reports_that_it_ran_out_of_iterations() -> None:
    mesh = dp.Mesh(*meshes.disk(0, 6))
    result = slim(mesh, tutte(mesh), max_iterations=1)
    assert not result.converged
    assert len(result.energies) == 2


def test_slim_cannot_start_from_flips() -> None:
    mesh = dp.Mesh(*meshes.disk(0, 6))
    mirrored = tutte(mesh) * torch.tensor([1.0, -1])
    with pytest.raises(dp.MeshError, match=rf"init flips {mesh.n_faces} of {mesh.n_faces} faces"):
        slim(mesh, mirrored)


def test_slim_keeps_what_does_not_overlap_injective() -> None:
    mesh = dp.Mesh(*meshes.disk(2, 6))
    plain, kept = (slim(mesh, tutte(mesh), injective=flag) for flag in (False, True))
    assert torch.equal(plain.uv, kept.uv)
    assert not plain.scaffolded
    assert not kept.scaffolded


def test_slim_cannot_make_an_overlapping_map_injective() -> None:
    """A map that winds around the origin more than once, without a flip."""
    angle, radius = np.meshgrid(np.linspace(0, 8, 20), [0.5, 1.0], indexing="ij")
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    a = 2 * np.arange(19)
    faces = np.r_[np.c_[a, a + 1, a + 3], np.c_[a, a + 3, a + 2]]
    mesh = dp.Mesh(np.c_[flat, 0.05 * angle.ravel()], faces)
    winding = torch.from_numpy(flat)
    assert math.isfinite(slim(mesh, winding).energies[-1])
    with pytest.raises(dp.MeshError, match="boundary of init meets itself"):
        slim(mesh, winding, injective=True)


@pytest.mark.parametrize(
    ("energies", "tolerance", "patience", "followed", "converged"),
    [
        ([10, 8, 7.5, 1], 0.1, 1, 3, True),
        ([10, 8, 7.9, 7.8, 7.75, 1], 0.1, 3, 5, True),
        ([10, 10, 1], 0.0, 1, 2, True),
        ([10, 8], 0.1, 1, 2, False),
        ([10, 8, 9, 1], 0.1, 1, 2, True),
        ([10, 9.05, 9, 1], 0.1, 1, 3, True),
        ([10, 8, math.inf, 1], 0.1, 1, 2, False),
        ([10, 8, math.nan, 1], 0.1, 1, 2, False),
    ],
)
def test_descent_follows_energies_while_they_fall(
    energies, tolerance, patience, followed, converged
) -> None:
    """A map of one vertex at (its energy, its number)."""
    first, *iterates = (np.array([[energy, float(k)]]) for k, energy in enumerate(energies))
    descent = _Descent(lambda x: float(x[0, 0]), lambda x: True, tolerance, first)
    assert descent.follow(iter(iterates), 100, patience) is converged
    assert descent.energies == energies[:followed]
    assert descent.points[0, 1] == followed - 1


def test_descent_has_no_patience_unless_told_so_and_keeps_what_is_admitted() -> None:
    first, *iterates = (
        np.array([[energy, float(k)]]) for k, energy in enumerate([10.0, 8, 5, 4.9, 1])
    )
    descent = _Descent(lambda x: float(x[0, 0]), lambda x: bool(x[0, 0] > 6), 0.1, first)
    remaining = iter(iterates)
    assert descent.follow(remaining, 100)
    assert len(list(remaining)) == 1
    assert not descent.admitted
    assert descent.energies == [10, 8]
    assert descent.points[0, 1] == 1


# ------------------------------------------------------- Procrustes


def kabsch(source: np.ndarray, target: np.ndarray, w: np.ndarray, reflect: bool) -> np.ndarray:
    """The textbook solution by SVD."""
    means = [np.average(x, axis=0, weights=w) for x in (source, target)]
    U, _, Vt = np.linalg.svd((w[:, None] * (source - means[0])).T @ (target - means[1]))
    D = np.diag([1, 1 if reflect else np.linalg.det(U @ Vt)])
    return (source - means[0]) @ U @ D @ Vt + means[1]


@given(seed=meshes.seeds, reflect=st.booleans())
def test_procrustes_is_kabschs_solution(seed: int, reflect: bool) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.standard_normal((2, 12, 2)) + rng.standard_normal((2, 1, 2))
    weights = rng.uniform(0, 1, 12)
    actual = procrustes(*map(torch.from_numpy, (source, target, weights)), reflect=reflect)
    np.testing.assert_allclose(actual, kabsch(source, target, weights, reflect), atol=1e-10)


@given(seed=meshes.seeds)
def test_procrustes_undoes_a_rigid_motion_but_no_reflection(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = rng.standard_normal((12, 2))
    moved = target @ meshes.rotation(rng, target).T + rng.standard_normal(2)
    weights = torch.ones(12, dtype=torch.float64)
    target, moved = torch.from_numpy(target), torch.from_numpy(moved)
    torch.testing.assert_close(procrustes(moved, target, weights), target)
    mirrored = moved * torch.tensor([-1.0, 1])
    torch.testing.assert_close(procrustes(mirrored, target, weights, reflect=True), target)
    assert (procrustes(mirrored, target, weights) - target).norm() > 0.1


def test_procrustes_aligns_each_of_a_batch() -> None:
    source, target = torch.randn(2, 4, 9, 2, dtype=torch.float64)
    weights = torch.rand(9, dtype=torch.float64)
    batched = procrustes(source, target, weights)
    for k in range(4):
        torch.testing.assert_close(batched[k], procrustes(source[k], target[k], weights))


# ------------------------------------------------------- arguments

DISK = dp.Mesh(*meshes.disk(0, 4))
FLAT = tutte(DISK)


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"tolerance": "a"}, TypeError, "tolerance must be a number"),
        ({"tolerance": -1.0}, ValueError, "tolerance must be finite and not negative"),
        ({"max_iterations": 1.5}, TypeError, "max_iterations must be an integer"),
        ({"max_iterations": -1}, ValueError, "max_iterations must be at least 0"),
        ({"init": FLAT.numpy()}, TypeError, "init must be a torch tensor"),
        ({"init": FLAT.half()}, TypeError, "init must be float32 or float64"),
        ({"init": FLAT[1:]}, ValueError, r"expected init of shape \(n=16, 2\), got \(15, 2\)"),
        ({"init": FLAT.clone().requires_grad_()}, ValueError, "init requires grad"),
    ],
)
def test_slim_names_what_it_refuses(options, kind, message, unchecked) -> None:
    with pytest.raises(kind, match="^slim: " + message):
        slim(DISK, **{"init": FLAT} | options)


def test_slim_without_iterations_returns_its_start() -> None:
    result = slim(DISK, FLAT, max_iterations=0)
    torch.testing.assert_close(result.uv, FLAT, rtol=0, atol=0)
    assert len(result.energies) == 1
    assert not result.converged


@pytest.mark.parametrize("operation", [tutte, lambda mesh: slim(mesh, mesh.vertices[:, :2])])
def test_tetrahedra_and_pairs_of_disks_are_named(operation, unchecked) -> None:
    for arrays, message in (
        (meshes.box(), "flattens surfaces, got tetrahedra"),
        (meshes.union(meshes.disk(0, 3), meshes.disk(1, 3)), "2 connected components"),
    ):
        with pytest.raises(dp.MeshError, match=message):
            operation(dp.Mesh(*arrays))


POINTS, WEIGHTS = torch.eye(4)[:, :2], torch.ones(4)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (([[1.0, 0]], POINTS, WEIGHTS), TypeError, "source must be a torch tensor"),
        ((POINTS, POINTS.numpy(), WEIGHTS), TypeError, "target must be a torch tensor"),
        ((POINTS, POINTS, [1.0]), TypeError, "weights must be a torch tensor"),
        ((POINTS, POINTS.to("meta"), WEIGHTS), ValueError, "target is on meta"),
        ((POINTS, POINTS, WEIGHTS[1:]), ValueError, "expected source and target"),
        ((POINTS, POINTS, WEIGHTS[None]), ValueError, "expected source and target"),
        ((POINTS, POINTS[1:], WEIGHTS), ValueError, "expected source and target"),
        ((POINTS, POINTS, 0 * WEIGHTS), ValueError, "weights must be finite and not negative"),
        ((POINTS, POINTS, WEIGHTS / 0), ValueError, "weights must be finite and not negative"),
        (
            (POINTS, POINTS, torch.tensor([1.0, 1, 1, -1])),
            ValueError,
            "weights must be finite and not negative",
        ),
    ],
)
def test_procrustes_names_what_it_refuses(arguments, kind, message, unchecked) -> None:
    with pytest.raises(kind, match="^procrustes: " + message):
        procrustes(*arguments)


def test_procrustes_ignores_points_of_no_weight() -> None:
    rng = np.random.default_rng(0)
    source, target = (torch.from_numpy(rng.standard_normal((6, 2))) for _ in range(2))
    weights = torch.from_numpy(np.r_[0.15, 0.05, 0.25, 0.1, 0, 0])
    expected = procrustes(source[:4], target[:4], weights[:4], reflect=True)
    torch.testing.assert_close(procrustes(source, target, weights, reflect=True)[:4], expected)
