"""A valid map comes out whatever goes in: any topology, any start, any unit."""

from __future__ import annotations

import itertools
import time
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson import flattening
from tests import meshes
from tests.checks import assert_near
from tests.map_checks import winding_strip
from tests.test_parameterization import references, tube
from tests.test_repair import spoiled


def exact_flips(triangles: np.ndarray) -> int:
    """Triangles of no positive area, in rational arithmetic."""
    count = 0
    for triangle in triangles:
        (ax, ay), (bx, by), (cx, cy) = [[Fraction(float(x)) for x in p] for p in triangle]
        count += (bx - ax) * (cy - ay) <= (by - ay) * (cx - ax)
    return count


def covered(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """By how many open triangles each point is covered."""
    corners, p = triangles[None], points[:, None]
    inside = np.ones((len(points), len(triangles)), dtype=bool)
    for k in range(3):
        edge, arm = corners[:, :, k - 2] - corners[:, :, k], p - corners[:, :, k]
        inside &= edge[..., 0] * arm[..., 1] > edge[..., 1] * arm[..., 0]
    return inside.sum(axis=1)


def assert_valid(mesh: dp.Mesh, uvmap: dp.UVMap) -> None:
    """The surface is the mesh's, cut; the map neither flips nor overlaps; charts are apart."""
    surface = uvmap.mesh
    assert torch.equal(uvmap.vertex_map[surface.faces], mesh.faces)
    assert torch.equal(surface.vertices, mesh.vertices[uvmap.vertex_map])
    assert uvmap.uv.dtype == mesh.dtype
    triangles = uvmap.uv.double().numpy()[surface.faces.numpy()]
    assert uvmap.flipped == exact_flips(triangles) == 0
    assert uvmap.certified
    rng = np.random.default_rng(0)
    inside = rng.dirichlet(np.ones(3), (len(triangles), 3))
    points = np.einsum("mkc,mcx->mkx", inside, triangles).reshape(-1, 2)
    assert covered(triangles, points).max() == 1
    assert sorted(torch.cat([chart.faces for chart in uvmap.charts]).tolist()) == list(
        range(mesh.n_faces)
    )
    boxes = [
        (t.min(axis=(0, 1)), t.max(axis=(0, 1)))
        for t in (triangles[c.faces.numpy()] for c in uvmap.charts)
    ]
    for i, (low, high) in enumerate(boxes):
        assert all((high < other[0]).any() or (other[1] < low).any() for other in boxes[:i])
        assert (uvmap.chart_of_face[uvmap.charts[i].faces] == i).all()


# -------------------------------------------------------------------- one disk


@pytest.mark.parametrize("kind", ["none", "valid", "some flips", "noise", "mirrored", "collapsed"])
def test_every_start_ends_valid_and_as_good_as_slim(kind):
    mesh, solver, noisy = spoiled(3, 1.2)
    starts = {
        "none": None,
        "valid": mesh.vertices[:, :2].clone(),
        "some flips": noisy,
        "noise": torch.randn(mesh.n_vertices, 2, dtype=torch.float64),
        "mirrored": mesh.vertices[:, :2] * torch.tensor([1, -1]),
        "collapsed": torch.zeros(mesh.n_vertices, 2, dtype=torch.float64),
    }
    result = dp.parameterize(mesh, starts[kind], solver=solver)
    assert_valid(mesh, result)
    assert result.mesh is mesh
    best = dp.slim(mesh, dp.tutte(mesh)).energies[-1]
    assert result.energy <= 1.001 * best
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    assert_near(result.energy, references.symmetric_dirichlet(V, F, result.uv.numpy()), 1e-9)
    expected = {"none": "tutte", "valid": "init", "some flips": "init+clamp"}
    assert result.method.startswith(expected.get(kind, ""))
    assert set(result.milliseconds) >= {"slim", "certify"}


def small_starts() -> tuple[dp.Mesh, torch.Tensor, torch.Tensor]:
    """A disk of 16 vertices, its projection, and the same with one corner folded in."""
    mesh = dp.Mesh(*meshes.disk(0, 4))
    flat = mesh.vertices[:, :2].clone()
    folded = flat.clone()
    folded[3] = torch.tensor([0.25, 0.75])
    assert exact_flips(folded[mesh.faces].numpy()) == 1
    return mesh, flat, folded


def test_stages_run_where_flips_are_left(monkeypatch):
    mesh, flat, folded = small_starts()

    def method(start: torch.Tensor) -> str:
        return dp.parameterize(mesh, start, tolerance=1e-2).method

    mirrored = flat * torch.tensor([1, -1])
    assert [method(uv) for uv in (flat, folded, mirrored)] == ["init", "init+clamp", "tutte"]
    monkeypatch.setattr(flattening, "clamp_flips", lambda solver, uv: (uv, 0))
    assert method(folded) == "init+clamp+untangle"
    monkeypatch.setattr(flattening, "untangle", lambda mesh, uv: (uv, 0))
    assert method(folded) == "tutte"


def test_times_and_iterations(monkeypatch):
    """A clock that is two seconds ahead at each look; SLIM runs twice where Tutte takes over."""
    clock = itertools.count(5.0, 2.0)
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    mesh, _, folded = small_starts()
    uvmap = dp.parameterize(mesh, folded, tolerance=0.0, max_iterations=3)
    assert uvmap.slim_iterations == 3
    stages = dict.fromkeys(["init", "clamp", "slim", "certify", "pack"], 2000)
    assert uvmap.milliseconds == stages
    strip = winding_strip(1.2)
    uvmap = dp.parameterize(strip, strip.vertices[:, :2], max_iterations=1)
    stages = dict.fromkeys(["init", "tutte", "certify", "pack"], 2000)
    assert uvmap.milliseconds == stages | {"slim": 4000}


def test_one_chart_stays_where_slim_leaves_it():
    mesh, *_ = small_starts()
    assert torch.equal(dp.parameterize(mesh).uv, dp.slim(mesh, dp.tutte(mesh)).uv)


def test_single_precision_is_rounded_at_the_end():
    mesh, _, folded = small_starts()
    start = folded.float()
    expected = dp.parameterize(mesh, start.double()).uv
    assert torch.equal(dp.parameterize(mesh, start.requires_grad_()).uv, expected)
    single = dp.Mesh.concatenate([mesh, mesh]).to(torch.float32)
    double = single.to(torch.float64)
    assert torch.equal(dp.parameterize(single).uv, dp.parameterize(double).uv.float())


def test_solver_is_used_for_its_own_mesh_alone(monkeypatch):
    mesh, _, folded = small_starts()
    two = dp.Mesh.concatenate([mesh, mesh])
    uvmap = dp.parameterize(two, lambda chart: folded, solver=dp.PoissonSolver(two))
    assert_valid(two, uvmap)
    assert uvmap.method == "init+clamp"
    solver = dp.PoissonSolver(mesh)
    monkeypatch.setattr(flattening, "PoissonSolver", None)
    assert dp.parameterize(mesh, folded, solver=solver).method == "init+clamp"


def test_result_does_not_depend_on_unit():
    mesh, _, uv = spoiled(1, 1.2)
    large = dp.Mesh(1e5 * mesh.vertices, mesh.faces)
    a, b = dp.parameterize(mesh, uv), dp.parameterize(large, 1e5 * uv)
    assert b.energy == pytest.approx(a.energy, rel=1e-6)
    assert_near(b.uv / 1e5, a.uv, 1e-3)


@pytest.mark.parametrize(("along", "method"), [(10, "tutte"), (60, "tutte+untangle")])
def test_deep_tubes_do_not_shrink_to_a_point(along, method):
    """Of a map that shrinks them exponentially, SLIM makes nothing (its energy stays at 1e15)."""
    mesh = dp.Mesh(*tube(6, along))
    uvmap = dp.parameterize(mesh)
    assert_valid(mesh, uvmap)
    assert uvmap.method == method
    assert uvmap.energy < 3 * along  # each ring must be laid out around the others


def test_overlaps_are_kept_off_at_a_price():
    mesh = winding_strip(1.2)
    free = dp.parameterize(mesh, injective=False)
    assert free.flipped == 0
    assert not free.certified
    triangles = free.uv.numpy()[mesh.faces.numpy()]
    assert covered(triangles, triangles.mean(axis=1)).max() > 1
    apart = dp.parameterize(mesh)
    assert_valid(mesh, apart)
    assert apart.method == "tutte+scaffold"
    assert free.energy < apart.energy < 1.01 * free.energy
    # Also from a map that overlaps already: nothing but Tutte's embedding helps then.
    assert_valid(mesh, dp.parameterize(mesh, free.uv))


def test_a_strip_that_does_not_cover_itself_needs_no_scaffold():
    result = dp.parameterize(winding_strip(0.9))
    assert_valid(result.mesh, result)
    assert result.method == "tutte"


# -------------------------------------------------------------------- any surface


@settings(max_examples=15)
@given(arrays=meshes.meshes(meshes.SPATIAL), single=st.booleans())
def test_every_topology_cut(arrays, single):
    vertices, faces = arrays
    mesh = dp.Mesh(vertices.astype(np.float32) if single else vertices, faces)
    assert_valid(mesh, dp.parameterize(mesh, cut=True))


def test_components_are_mapped_each_on_its_own():
    parts = [meshes.disk(0, 6), meshes.triangle(1), meshes.disk(2, 4)]
    mesh = dp.Mesh(*meshes.union(*parts))
    uvmap = dp.parameterize(mesh)
    assert_valid(mesh, uvmap)
    assert uvmap.mesh is mesh
    alone = [dp.parameterize(dp.Mesh(*part)) for part in parts]
    assert [len(chart.faces) for chart in uvmap.charts] == [50, 1, 18]
    for chart, single in zip(uvmap.charts, alone, strict=True):
        assert chart.certificate.energy == pytest.approx(single.energy)
    areas = mesh.areas.numpy()
    for name in ("energy", "mean_distortion"):
        values = [getattr(single, name) for single in alone]
        weights = [areas[chart.faces].sum() for chart in uvmap.charts]
        assert getattr(uvmap, name) == pytest.approx(np.average(values, weights=weights))
    assert uvmap.max_distortion == pytest.approx(max(a.max_distortion for a in alone))
    assert uvmap.min_determinant == pytest.approx(min(a.min_determinant for a in alone))
    assert uvmap.slim_iterations == sum(a.slim_iterations for a in alone)
    assert uvmap.method == "tutte"
    assert uvmap.milliseconds["slim"] == pytest.approx(
        sum(chart.milliseconds["slim"] for chart in uvmap.charts)
    )
    assert "pack" in uvmap.milliseconds


def test_one_overlapping_pair_of_charts_is_not_certified():
    mesh = dp.Mesh(*meshes.union(meshes.disk(0), meshes.disk(1)))
    uvmap = dp.parameterize(mesh)
    moved = uvmap.uv - uvmap.uv.amin(0)
    moved[25:] -= moved[25:].amin(0)
    same_charts = dp.UVMap(mesh, moved, uvmap.vertex_map, uvmap.charts)
    assert all(chart.certificate.injective for chart in same_charts.charts)
    assert not same_charts.certified


def test_a_function_maps_each_chart():
    mesh = dp.Mesh(*meshes.union(meshes.disk(0), meshes.disk(1, 4)))
    seen = []

    def project(chart: dp.Mesh) -> torch.Tensor:
        seen.append(chart.n_vertices)
        return chart.vertices[:, :2]

    uvmap = dp.parameterize(mesh, project)
    assert_valid(mesh, uvmap)
    assert seen == [25, 16]
    assert uvmap.method == "init"


def test_a_map_of_one_disk_follows_its_cuts():
    """A tall cap that gets seams: their copies start where the vertex was."""
    flat, faces = meshes.planar_disk(0, 15)
    x, y = (2 * flat - 1).T
    mesh = dp.Mesh(np.c_[x, y, 4 * (1 - x**4) * (1 - y**4)], faces)
    uvmap = dp.parameterize(mesh, mesh.vertices[:, :2], cut=True)
    assert_valid(mesh, uvmap)
    assert uvmap.mesh.n_vertices > mesh.n_vertices
    assert uvmap.method.startswith("init")


# -------------------------------------------------------------------- what raises


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sphere", "component 0 of 1 has Euler characteristic 2, 0 boundary loops and genus 0"),
        ("torus", "Euler characteristic 0, 0 boundary loops and genus 1"),
        ("annulus", "Euler characteristic 0, 2 boundary loops and genus 0"),
        ("parts", "component 1 of 3 has Euler characteristic 2"),
        ("book", "component 0 of 1 has 1 edges with more than two faces"),
        ("bowtie", "pinched vertices"),
        ("moebius", "inconsistent orientation"),
    ],
)
def test_what_is_not_a_disk_is_named_with_the_remedy(name, message):
    with pytest.raises(dp.MeshError, match=rf"{message}.*cut=True"):
        dp.parameterize(dp.Mesh(*meshes.SPATIAL[name](0)))


def test_components_that_are_not_disks_are_named_up_to_three():
    vertices = np.r_[np.zeros((1, 3)), np.eye(3)]
    closed = vertices, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    for count, more in (
        (3, "2 of 3 has [^;]* genus 0;"),
        (4, "2 of 4 has .* and 1 more components;"),
    ):
        mesh = dp.Mesh(*meshes.union(*[closed] * count))
        with pytest.raises(dp.MeshError, match=more) as caught:
            dp.parameterize(mesh)
        assert str(caught.value).count(" has ") == 3
        assert ("more" in str(caught.value)) == (count == 4)


def test_what_cannot_be_mapped_raises(unchecked):
    with pytest.raises(TypeError, match=r"^parameterize: expected a diffpoisson\.Mesh"):
        dp.parameterize(None)
    for build, words in ((meshes.planar_disk, "D = 2"), (meshes.box, "tetrahedra")):
        with pytest.raises(dp.MeshError, match=f"^parameterize: maps surfaces .*{words}"):
            dp.parameterize(dp.Mesh(*build()))
    mesh = dp.Mesh(*meshes.disk())
    with pytest.raises(ValueError, match=r"expected init of shape \(n=25, 2\), got \(4, 2\)"):
        dp.parameterize(mesh, torch.zeros(4, 2))
    with pytest.raises(TypeError, match=r"^parameterize: init must be a torch tensor"):
        dp.parameterize(mesh, np.zeros((25, 2)))
    with pytest.raises(ValueError, match="not finite"):
        dp.parameterize(mesh, torch.full((25, 2), np.nan))
    several = dp.Mesh(*meshes.parts())
    with pytest.raises(ValueError, match="one disk"):
        dp.parameterize(several, several.vertices[:, :2], cut=True)


def test_what_rounding_flips_raises():
    """Beside a chart a hundred million times as large, float32 cannot tell corners apart."""
    small, large = meshes.disk(0), meshes.disk(1)
    vertices, faces = meshes.union((1e-4 * small[0], small[1]), (1e4 * large[0], large[1]))
    mesh = dp.Mesh(vertices.astype(np.float32), faces)
    with pytest.raises(dp.MeshError, match=r"rounding the map to torch.float32 .*float64"):
        dp.parameterize(mesh)
    assert_valid(mesh.to(torch.float64), dp.parameterize(mesh.to(torch.float64)))


def test_a_function_starts_the_charts_that_it_can():
    """It sees each chart's own mesh; where it returns None, Tutte's embedding is the start."""
    parts = [dp.Mesh(*meshes.disk(seed, size)) for seed, size in ((0, 5), (1, 6))]
    seen = []

    def start(mesh: dp.Mesh) -> torch.Tensor | None:
        seen.append(mesh.n_vertices)
        return dp.tutte(mesh) if mesh.n_vertices == parts[1].n_vertices else None

    uvmap = dp.parameterize(dp.Mesh.concatenate(parts), start, tolerance=1e-3)
    assert seen == [part.n_vertices for part in parts]
    assert [chart.method.split("+")[0] for chart in uvmap.charts] == ["tutte", "init"]
    assert uvmap.certified
