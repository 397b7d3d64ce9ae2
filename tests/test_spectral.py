"""Eigenpairs against dense and libigl references; signatures against their formulas in NumPy."""

from __future__ import annotations

import re
from functools import cache

import igl
import numpy as np
import pytest
import scipy.linalg
import torch
import trimesh

import diffpoisson as dp
from diffpoisson import spectral
from tests import meshes, references
from tests.benchmarks.conditioning import caps, needles
from tests.checks import SOLVE, assert_near

LANCZOS = 8  # eigenpairs that every mesh here is large enough to get from Lanczos


@cache
def large(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Meshes of about a hundred vertices."""
    builders = {
        "disk": lambda: meshes.disk(size=11),
        "sphere": lambda: meshes.sphere(subdivisions=2),
        "torus": lambda: meshes.torus(around=14, across=9),
        "moebius": lambda: meshes.moebius(around=40),
        "planar_disk": lambda: meshes.planar_disk(size=11),
        "parts": lambda: meshes.union(meshes.disk(size=9), meshes.sphere(), meshes.torus()),
        "twins": lambda: meshes.union(meshes.sphere(), meshes.sphere()),
    }
    return builders[name]()


NAMES = ("disk", "sphere", "torus", "moebius", "planar_disk", "parts", "twins")
shapes = pytest.mark.parametrize("name", NAMES)
masses = pytest.mark.parametrize("mass", ["barycentric", "voronoi"])
IGL_MASS = {
    "barycentric": igl.MassMatrixType.MASSMATRIX_TYPE_BARYCENTRIC,
    "voronoi": igl.MassMatrixType.MASSMATRIX_TYPE_VORONOI,
}


@cache
def large_reference(name: str, mass: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return reference(*large(name), mass)


def reference(vertices, faces, mass="barycentric") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """All eigenvalues and eigenvectors of libigl's matrices by LAPACK, and the masses."""
    padded = np.c_[vertices, np.zeros((len(vertices), 3 - vertices.shape[1]))]
    M = igl.massmatrix(padded, faces, IGL_MASS[mass]).diagonal()
    values, vectors = scipy.linalg.eigh(-igl.cotmatrix(vertices, faces).toarray(), np.diag(M))
    return values, vectors, M


# ------------------------------------------------------- eigenpairs


@shapes
@masses
@pytest.mark.parametrize("k", [LANCZOS, 80])
def test_eigenvalues_against_libigl_and_lapack(name, mass, k):
    """By Lanczos and by the dense route, with repeated eigenvalues and several components."""
    vertices, faces = large(name)
    mesh = dp.Mesh(vertices, faces)
    values, _ = dp.laplacian_eigenpairs(mesh, k, mass=mass)
    expected = large_reference(name, mass)[0][:k]
    zeros = mesh.n_components
    assert (values[:zeros] == 0).all()
    np.testing.assert_allclose(values[zeros:], expected[zeros:], rtol=SOLVE)


@shapes
@masses
@pytest.mark.parametrize("k", [1, LANCZOS, 80])
def test_eigenvectors_solve_the_problem(name, mass, k):
    """Orthonormal in the mass, and with small residuals."""
    vertices, faces = large(name)
    values, vectors = (
        x.numpy() for x in dp.laplacian_eigenpairs(dp.Mesh(vertices, faces), k, mass=mass)
    )
    M = large_reference(name, mass)[2]
    np.testing.assert_allclose(vectors.T @ (M[:, None] * vectors), np.eye(k), rtol=0, atol=1e-10)
    L = -igl.cotmatrix(vertices, faces)
    residual = L @ vectors - M[:, None] * vectors * values
    assert np.abs(residual).max() <= 1e-10 * np.abs(L).max() * np.abs(vectors).max()


@pytest.mark.parametrize("name", ["triangle", "book", "bowtie", "annulus", "parts"])
def test_all_eigenpairs_of_small_meshes(name):
    vertices, faces = meshes.SPATIAL[name](0)
    mesh, n = dp.Mesh(vertices, faces), len(vertices)
    values, vectors = (x.numpy() for x in dp.laplacian_eigenpairs(mesh, n))
    expected, _, M = reference(vertices, faces)
    assert_near(values, expected, SOLVE)
    np.testing.assert_allclose(vectors.T @ (M[:, None] * vectors), np.eye(n), rtol=0, atol=1e-10)


def test_fewer_eigenpairs_are_the_first_ones():
    """Of every number: none but constants, by Lanczos, by the dense route."""
    mesh = dp.Mesh(*meshes.union(meshes.disk(0, 3), meshes.disk(1, 4)))
    expected, _ = dp.laplacian_eigenpairs(mesh, mesh.n_vertices)
    for k in range(1, mesh.n_vertices):
        values, vectors = dp.laplacian_eigenpairs(mesh, k)
        assert vectors.shape == (mesh.n_vertices, k)
        assert_near(values, expected[:k], SOLVE)


def test_spectrum_of_a_ribbon():
    """Long for its area, so that its first eigenvalues are small."""
    vertices, faces = meshes.planar_disk(size=6)
    vertices = vertices * [40, 1]
    values, _ = dp.laplacian_eigenpairs(dp.Mesh(vertices, faces), 36)
    expected = reference(vertices, faces)[0]
    assert expected[1] * 40 < 1  # area 40
    np.testing.assert_allclose(values[1:], expected[1:], rtol=SOLVE)


def test_fewer_eigenpairs_than_components():
    mesh = dp.Mesh(*meshes.parts())
    values, vectors = dp.laplacian_eigenpairs(mesh, 2)
    assert values.tolist() == [0, 0]
    assert vectors.shape == (mesh.n_vertices, 2)


def test_spectrum_of_the_sphere():
    """l(l + 1), 2l + 1 times, with an error of order h²."""
    errors = []
    for subdivisions in (2, 3):
        ball = trimesh.creation.icosphere(subdivisions=subdivisions)
        values, _ = dp.laplacian_eigenpairs(dp.Mesh(np.array(ball.vertices), ball.faces), 16)
        expected = np.repeat([0, 2, 6, 12], [1, 3, 5, 7])
        errors.append(np.abs(values.numpy() - expected)[1:].max() / 12)
    assert errors[1] < 0.02
    assert 3 < errors[0] / errors[1] < 5


def test_spectrum_of_the_square():
    """π²(i² + j²), natural boundary conditions."""
    values, _ = dp.laplacian_eigenpairs(dp.Mesh(*meshes.planar_disk(size=33)), 6)
    np.testing.assert_allclose(values / np.pi**2, [0, 1, 1, 2, 4, 4], rtol=5e-3, atol=1e-12)


@shapes
def test_supplied_solver(name):
    """Of either gauge: only its factor is used."""
    mesh = dp.Mesh(*large(name))
    expected = dp.laplacian_eigenpairs(mesh, LANCZOS)
    for gauge in ("mean", "vertex"):
        solver = dp.PoissonSolver(mesh, gauge=gauge)
        values, vectors = dp.laplacian_eigenpairs(mesh, LANCZOS, solver=solver)
        assert torch.equal(values, expected[0])
        assert torch.equal(vectors, expected[1])


def test_concatenated_solver():
    solvers = [dp.PoissonSolver(dp.Mesh(*large(name))) for name in ("disk", "torus")]
    union = dp.PoissonSolver.concatenate(solvers)
    values, _ = dp.laplacian_eigenpairs(union.mesh, LANCZOS, solver=union)
    each = [dp.laplacian_eigenpairs(s.mesh, LANCZOS)[0] for s in solvers]
    assert_near(values, torch.cat(each).sort().values[:LANCZOS], SOLVE)


def test_single_precision_mesh():
    vertices, faces = large("torus")
    rounded = vertices.astype(np.float32)
    values, vectors = dp.laplacian_eigenpairs(dp.Mesh(rounded, faces), LANCZOS)
    assert values.dtype == vectors.dtype == torch.float32
    expected, _ = dp.laplacian_eigenpairs(dp.Mesh(rounded.astype(float), faces), LANCZOS)
    assert_near(values, expected, 1e-6)


# ------------------------------------------------------- mass


@shapes
@masses
def test_mass_against_libigl(name, mass):
    vertices, faces = large(name)
    actual = dp.lumped_mass(dp.Mesh(vertices, faces), mass)
    assert_near(actual, large_reference(name, mass)[2], 1e-13)
    assert actual.sum().item() == pytest.approx(references.areas(vertices, faces).sum(), rel=1e-13)


@masses
def test_mass_of_obtuse_triangles(mass):
    vertices, faces = meshes.disk(3)
    vertices = vertices * [3.0, 1, 1]
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    angles = np.einsum("tid,tid->ti", edges, -np.roll(edges, -1, axis=1))
    assert (angles < 0).any()
    actual = dp.lumped_mass(dp.Mesh(vertices, faces), mass)
    assert_near(actual, reference(vertices, faces, mass)[2], 1e-13)


# ------------------------------------------------------- signatures


def reference_wks(values, vectors, n_energies) -> np.ndarray:
    """Aubry et al. 2011, written out over the non-zero eigenpairs."""
    log = np.log(values)
    delta = (log[-1] - log[0]) / n_energies
    energies = np.linspace(log[0] + 2 * delta, log[-1] - 2 * delta, n_energies)
    result = np.zeros((len(vectors), n_energies))
    for column, e in enumerate(energies):
        weights = [np.exp(-((e - x) ** 2) / (2 * (7 * delta) ** 2)) for x in log]
        total = sum(w * vectors[:, i] ** 2 for i, w in enumerate(weights))
        result[:, column] = total / sum(weights)
    return result


# Eigenvectors are unique up to sign where eigenvalues differ, as on these irregular meshes.
IRREGULAR = ("disk", "sphere", "torus", "moebius", "planar_disk", "parts")


@pytest.mark.parametrize("name", IRREGULAR)
@masses
def test_wave_kernel_signature_against_its_formula(name, mass):
    vertices, faces = large(name)
    mesh, k = dp.Mesh(vertices, faces), 20
    values, vectors, M = large_reference(name, mass)
    zeros = mesh.n_components
    expected = reference_wks(values[zeros:k], vectors[:, zeros:k], 30)
    actual = dp.wave_kernel_signature(mesh, 30, n_eigenpairs=k, mass=mass, scale_invariant=False)
    assert_near(actual, expected, 1e-7)
    dimensionless = dp.wave_kernel_signature(mesh, 30, n_eigenpairs=k, mass=mass)
    assert_near(dimensionless, expected * M.sum(), 1e-7)


@masses
def test_single_precision_is_left_at_the_end(mass):
    """Masses and signatures are those of float64, rounded once."""
    vertices, faces = large("disk")
    mesh = dp.Mesh(vertices.astype(np.float32), faces)
    double = mesh.to(torch.float64)
    assert torch.equal(dp.lumped_mass(mesh, mass), dp.lumped_mass(double, mass).float())
    values, vectors = (x.double().numpy() for x in dp.laplacian_eigenpairs(mesh, 20, mass=mass))
    expected = double.areas.sum().item() * reference_wks(values[1:], vectors[:, 1:], 30)
    actual = dp.wave_kernel_signature(mesh, 30, n_eigenpairs=20, mass=mass)
    assert actual.dtype == torch.float32
    assert np.abs(actual.double().numpy() / expected - 1).max() <= 1.001 * 2**-24


def test_wave_kernel_signature_defaults():
    """The paper's 50 energies from 50 eigenpairs; the area-weighted mean over the mesh is one."""
    mesh = dp.Mesh(*large("sphere"))
    signature = dp.wave_kernel_signature(mesh)
    assert torch.equal(signature, dp.wave_kernel_signature(mesh, 50, n_eigenpairs=50))
    means = mesh.vertex_areas @ signature / mesh.areas.sum()
    np.testing.assert_allclose(means, np.ones(50), rtol=1e-9)


@pytest.mark.parametrize("k", [20, 100])
def test_wave_kernel_signature_invariance(k):
    """Rigid motion, scale and renumbering; by Lanczos and by the dense route."""
    vertices, faces = large("torus")
    rng = np.random.default_rng(0)
    new_vertices, new_faces, p, _ = meshes.renumbered(rng, vertices, faces)
    moved = 1e3 * (new_vertices + rng.standard_normal(3)) @ meshes.rotation(rng, vertices).T
    expected, actual = (
        dp.wave_kernel_signature(dp.Mesh(*mesh), n_eigenpairs=k)
        for mesh in ((vertices, faces), (moved, new_faces))
    )
    assert_near(actual, expected[p], 1e-7)
    lengths, times = (
        dp.wave_kernel_signature(dp.Mesh(*mesh), n_eigenpairs=k, scale_invariant=False)
        for mesh in ((vertices, faces), (moved, new_faces))
    )
    assert_near(times * 1e6, lengths[p], 1e-7)


@pytest.mark.parametrize("name", IRREGULAR)
def test_heat_kernel_signature_against_its_formula(name):
    vertices, faces = large(name)
    values, vectors, _ = large_reference(name, "barycentric")
    times = torch.tensor([1e-3, 0.1, 1.0], dtype=torch.float64)
    expected = sum(
        vectors[:, [i]] ** 2 * np.exp(-values[i] * times.numpy()[None]) for i in range(20)
    )
    actual = dp.heat_kernel_signature(dp.Mesh(vertices, faces), times, n_eigenpairs=20)
    assert_near(actual, expected, 1e-7)


def test_heat_at_time_zero():
    mesh = dp.Mesh(*large("disk"))
    now = dp.heat_kernel_signature(mesh, torch.zeros(1).double(), n_eigenpairs=LANCZOS)
    _, vectors = dp.laplacian_eigenpairs(mesh, LANCZOS)
    assert_near(now, (vectors**2).sum(dim=1, keepdim=True), 1e-12)


def test_heat_settles_to_one_over_the_area():
    mesh = dp.Mesh(*large("parts"))
    late = dp.heat_kernel_signature(mesh, torch.tensor([1e9], dtype=torch.float64))[:, 0]
    labels = references.components(mesh.n_vertices, mesh.faces.numpy())
    areas = np.bincount(labels, references.vertex_areas(*large("parts")))
    assert_near(late, 1 / areas[labels], 1e-12)


# ------------------------------------------------------- errors


@pytest.mark.parametrize("k", [0, -1, 26])
def test_too_many_or_too_few_eigenpairs_raise(k):
    message = f"laplacian_eigenpairs: a mesh of 25 vertices has 25 eigenpairs, not {k}"
    with pytest.raises(dp.MeshError, match=message):
        dp.laplacian_eigenpairs(dp.Mesh(*meshes.disk()), k)


def test_unknown_mass_raises(unchecked):
    with pytest.raises(ValueError, match="mass must be 'barycentric' or 'voronoi', got 'full'"):
        dp.lumped_mass(dp.Mesh(*meshes.disk()), "full")


def test_number_of_energies(unchecked):
    mesh = dp.Mesh(*meshes.disk())
    assert dp.wave_kernel_signature(mesh, 1, n_eigenpairs=5).shape == (25, 1)
    for count, kind in ((0, ValueError), (2.5, TypeError)):
        with pytest.raises(kind, match=r"^wave_kernel_signature: n_energies must be"):
            dp.wave_kernel_signature(mesh, count, n_eigenpairs=5)


def test_too_small_spectrum_raises():
    message = "2 eigenpairs hold 0 non-zero ones on this mesh of 3 component(s)"
    with pytest.raises(dp.MeshError, match=re.escape(message)):
        dp.wave_kernel_signature(dp.Mesh(*meshes.parts()), n_eigenpairs=2)


def test_solver_of_another_mesh_raises():
    mesh, other = (dp.Mesh(*meshes.disk(seed)) for seed in (0, 1))
    for function in (
        lambda solver: dp.laplacian_eigenpairs(mesh, 5, solver=solver),
        lambda solver: dp.wave_kernel_signature(mesh, n_eigenpairs=5, solver=solver),
        lambda solver: dp.heat_kernel_signature(
            mesh, torch.ones(1, dtype=torch.float64), n_eigenpairs=5, solver=solver
        ),
    ):
        with pytest.raises(ValueError, match="solver belongs to another mesh"):
            function(dp.PoissonSolver(other))


def test_reproducible():
    """Lanczos starts from a fixed vector."""
    mesh = dp.Mesh(*large("disk"))
    first, again = (dp.laplacian_eigenpairs(mesh, LANCZOS)[1] for _ in range(2))
    assert torch.equal(first, again)


@pytest.mark.parametrize("times", [[-1.0], [torch.inf], [torch.nan], [[1.0]]])
def test_times_that_are_none_raise(times, unchecked):
    with pytest.raises(ValueError, match=r"heat_kernel_signature: times must be \(t,\), finite"):
        dp.heat_kernel_signature(dp.Mesh(*meshes.disk()), torch.tensor(times), n_eigenpairs=3)


def test_eigenvalues_that_rounding_hides_raise():
    """One that comes out negative would be a NaN in the logarithm of a signature."""
    messages = []
    for shape in (needles, caps):
        for aspect in (1e8, 1e9, 1e10, 1e11):
            try:
                values, _ = dp.laplacian_eigenpairs(dp.Mesh(*shape(aspect)), 16)
            except dp.MeshError as error:
                messages.append(str(error))
            else:
                assert (values[1:] > 0).all()
    assert messages
    assert all("rounding hides the smallest eigenvalues" in message for message in messages)


def test_eigenvalues_of_a_flattened_mesh():
    """A thin mesh whose faces are not: nothing is hidden."""
    vertices, faces = meshes.disk(0, 4)
    mesh = dp.Mesh(vertices * [1, 1e-11, 1], faces)
    L = -igl.cotmatrix(mesh.vertices.numpy(), faces).toarray()
    expected = scipy.linalg.eigh(L, np.diag(mesh.vertex_areas.numpy()), eigvals_only=True)
    values, _ = dp.laplacian_eigenpairs(mesh, 16)
    np.testing.assert_allclose(values, expected, rtol=1e-9, atol=1e-9 * expected[-1])


def test_two_eigenvalues_are_enough_for_a_signature():
    signature = dp.wave_kernel_signature(dp.Mesh(*meshes.disk()), n_eigenpairs=3)
    assert signature.isfinite().all()


def test_no_more_pairs_than_components_are_the_constants_at_no_cost(monkeypatch):
    """Neither a factor nor a dense matrix is made for eigenvalue zero."""
    mesh = dp.Mesh(*meshes.parts())
    monkeypatch.setattr(spectral, "laplacian", None)
    monkeypatch.setattr(spectral, "PoissonSolver", None)
    values, vectors = dp.laplacian_eigenpairs(mesh, 2)
    assert values.tolist() == [0, 0]
    gram = vectors.T @ (mesh.vertex_areas[:, None] * vectors)
    assert (gram - torch.eye(2, dtype=gram.dtype)).abs().max() < 1e-12
    for label in range(mesh.n_components):
        assert (vectors[mesh.components == label].std(dim=0) < 1e-12).all()
