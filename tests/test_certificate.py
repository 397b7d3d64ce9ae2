"""Certificates against exact arithmetic, brute force, and maps that are known to overlap."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import diffpoisson as dp
from diffpoisson.certificate import (
    _segments_meet,
    boxes_apart,
    certify,
    count_flips,
    is_simple,
    orientations,
)
from tests import meshes

MESH = dp.Mesh(*meshes.planar_disk(0, 4))


def exact_orientation(triangle) -> int:
    (ax, ay), (bx, by), (cx, cy) = [[Fraction(float(x)) for x in p] for p in triangle]
    area = ax * (by - cy) + bx * (cy - ay) + cx * (ay - by)
    return (area > 0) - (area < 0)


@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_orientations_are_exact_next_to_collinear(seed, scale):
    """Points on a line through far corners, moved by a few units in the last place."""
    rng = np.random.default_rng(seed)
    a, b = rng.standard_normal((2, 30, 2)) * scale
    c = a + rng.uniform(-1, 2, (30, 1)) * (b - a)
    for _ in range(rng.integers(3)):
        c = np.nextafter(c, rng.choice([-np.inf, np.inf], c.shape))
    triangles = np.stack([a, b, c], axis=1)
    assert orientations(triangles).tolist() == [exact_orientation(t) for t in triangles]


def test_exactly_collinear_and_coincident_corners_are_zero():
    triangles = np.array(
        [[[0, 0], [1, 1], [3, 3]], [[0.1, 0.1], [0.1, 0.1], [5, 7]], [[0, 0], [1, 0], [0, 1]]]
    )
    assert orientations(triangles).tolist() == [0, 0, 1]


def test_orientation_where_rounding_errs_by_more_than_half_of_its_bound():
    """The computed area is negative, and 1.7u times the sum of its products' magnitudes."""
    triangle = [
        [1.2906523754482964, 1.6573907708612263],
        [21.956381316952438, 29.204664352507585],
        [4.479496218014516, 5.908097532232617],
    ]
    (ax, ay), (bx, by), (cx, cy) = triangle
    assert (ax - cx) * (by - cy) < (ay - cy) * (bx - cx)
    assert exact_orientation(triangle) == 1
    assert orientations(np.array([triangle])) == [1]


def brute_force_simple(polygon: np.ndarray) -> bool:
    """Every pair of edges, in rationals."""
    points = [tuple(Fraction(float(x)) for x in p) for p in polygon]
    n = len(points)

    def side(p, q, r):
        value = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])
        return (value > 0) - (value < 0)

    def on(p, q, r):
        inside = all(min(p[k], q[k]) <= r[k] <= max(p[k], q[k]) for k in (0, 1))
        return side(p, q, r) == 0 and inside

    for i in range(n):
        a, b = points[i], points[(i + 1) % n]
        if a == b:
            return False
        for j in range(i + 1, n):
            c, d = points[j], points[(j + 1) % n]
            if j == i + 1 or (i == 0 and j == n - 1):
                far, near = (d, a) if j == i + 1 else (c, b)
                if on(a, b, far) or on(c, d, near):
                    return False
                continue
            proper = side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0
            touching = on(a, b, c) or on(a, b, d) or on(c, d, a) or on(c, d, b)
            if proper or touching:
                return False
    return True


@given(seed=st.integers(0, 10**6), n=st.integers(3, 9), grid=st.booleans())
def test_simplicity_against_brute_force(seed, n, grid):
    """Random polygons, also on a coarse grid where edges touch and overlap."""
    rng = np.random.default_rng(seed)
    polygon = rng.integers(0, 5, (n, 2)).astype(float) if grid else rng.standard_normal((n, 2))
    assert is_simple(polygon) == brute_force_simple(polygon)
    assert is_simple(polygon, at_once=2) == is_simple(polygon)


def test_simplicity_of_all_small_triangles():
    """Neighbouring edges that fold back, of length zero, or both."""
    points = np.argwhere(np.ones((3, 2))).astype(float)
    for triangle in itertools.product(points, repeat=3):
        assert is_simple(np.array(triangle)) == brute_force_simple(np.array(triangle))


def test_all_pairs_of_small_segments():
    """They meet where they cross, or where an end of one is on the other."""
    points = np.argwhere(np.ones((3, 3)))
    a, b, c, d = points[np.array(list(itertools.product(range(9), repeat=4)))].swapaxes(0, 1)

    def side(p, q, r):
        return np.sign((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])

    def on(p, q, r):
        between = (np.minimum(p, q) <= r) & (r <= np.maximum(p, q))
        return between.all(axis=1) & (side(p, q, r) == 0)

    crossing = (side(a, b, c) * side(a, b, d) == -1) & (side(c, d, a) * side(c, d, b) == -1)
    meet = crossing | on(a, b, c) | on(a, b, d) | on(c, d, a) | on(c, d, b)
    boxes_meet = (np.minimum(a, b) <= np.maximum(c, d)) & (np.minimum(c, d) <= np.maximum(a, b))
    asked = boxes_meet.all(axis=1)
    assert asked[meet].all()
    actual = _segments_meet(*(x[asked].astype(float) for x in (a, b, c, d)))
    assert actual.tolist() == meet[asked].tolist()


def test_regular_polygons_are_simple_and_stars_are_not():
    angle = 2 * np.pi * np.arange(1001) / 1001
    assert is_simple(np.stack([np.cos(angle), np.sin(angle)], axis=1))
    assert not is_simple(np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=1))


def test_a_spike_that_folds_back_is_not_simple():
    assert not is_simple(np.array([[0.0, 0], [2, 0], [1, 0], [1, 1]]))
    assert not is_simple(np.array([[0.0, 0], [1, 0], [1, 1], [1, 0]]))


def test_certificate_of_isometry_flip_and_spiral():
    mesh = dp.Mesh(*meshes.planar_disk())
    identity = certify(mesh, mesh.vertices)
    assert identity.injective
    assert identity.energy == pytest.approx(4)
    assert identity.max_distortion == pytest.approx(1)
    assert identity.mean_distortion == pytest.approx(1)
    assert identity.min_determinant == pytest.approx(1)

    mirrored = certify(mesh, mesh.vertices * torch.tensor([-1.0, 1]).double())
    assert mirrored.n_flipped == mesh.n_faces
    assert mirrored.simple_boundary
    assert not mirrored.injective
    assert mirrored.energy == np.inf

    # A long strip wound more than once around an annulus: no flips, yet it covers itself.
    x, y = np.meshgrid(np.linspace(0, 1, 41), [0, 0.1], indexing="ij")
    a = 2 * np.arange(40)
    lower, upper = (a, a + 2, a + 1), (a + 1, a + 2, a + 3)
    faces = np.concatenate([np.stack(lower, axis=1), np.stack(upper, axis=1)])
    strip = dp.Mesh(np.stack([x.ravel(), y.ravel()], axis=1), faces)
    angle, radius = 3 * np.pi * x.ravel(), 1 - y.ravel()
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    wound = certify(strip, torch.from_numpy(spiral))
    assert wound.n_flipped == 0
    assert not wound.simple_boundary
    assert not wound.injective


def test_distortion_of_a_stretch_on_one_side():
    """Half of the square's area twice as wide: σ = (2, 1) there, (1, 1) elsewhere."""
    corners = np.array([[0.0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    stretched = corners * 1.0
    stretched[corners[:, 0] == 2, 0] = 3
    certificate = certify(dp.Mesh(corners, faces), torch.from_numpy(stretched))
    assert certificate.mean_distortion == pytest.approx(1.5)
    assert certificate.max_distortion == pytest.approx(2)
    assert certificate.energy == pytest.approx(((1 + 1 + 1 + 1) + (4 + 1 + 1 / 4 + 1)) / 2)


def test_single_precision_is_certified_like_its_copy_in_double():
    """Where float32's own arithmetic has wrong signs: corners next to lines through two others."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 500, 2)).astype(np.float32)
    c = a + rng.uniform(-0.5, 1.5, (500, 1)).astype(np.float32) * (b - a)
    triangles = np.stack([a, b, c], axis=1)
    mesh = dp.Mesh(rng.standard_normal((1500, 3)), np.arange(1500).reshape(-1, 3))
    flips = count_flips(mesh, torch.from_numpy(triangles).flatten(0, 1))
    assert flips == sum(exact_orientation(t) <= 0 for t in triangles)

    square = dp.Mesh(*meshes.planar_disk(0, 2))
    loop = square.boundary_loops[0]
    for polygon in (  # the third corner is next to the first edge, on one side or the other
        [[1.4285715, 8.857142], [8.571428, 1.5714285], [2.8154173, 7.4425597], [7.714286, 13]],
        [
            [6.142857, 0.42857143],
            [8.142858, 5.714286],
            [7.4269304, 3.8221931],
            [13.142858, 12.142858],
        ],
    ):
        uv = torch.empty(4, 2)
        uv[loop] = torch.tensor(polygon)
        assert certify(square, uv) == certify(square, uv.double())


def test_single_precision_is_certified_as_it_stands():
    """Corners that float32 puts on one line are flat, though their originals were not."""
    mesh = dp.Mesh(np.array([[0.0, 0], [1, 0], [0.5, 1]]), np.array([[0, 1, 2]]))
    uv = torch.tensor([[0, 1], [1, 1], [0.5, 1 + 1e-9]], dtype=torch.float64)
    assert count_flips(mesh, uv) == certify(mesh, uv).n_flipped == 0
    assert count_flips(mesh, uv.float()) == certify(mesh, uv.float()).n_flipped == 1


@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), grid=st.booleans())
def test_boxes_against_all_pairs(seed, n, grid):
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 40, (n, 2)).astype(float) if grid else rng.uniform(0, 40, (n, 2))
    high = low + (rng.integers(0, 3, (n, 2)) if grid else rng.uniform(0, 2, (n, 2)))
    apart = all(
        (high[i] < low[j]).any() or (high[j] < low[i]).any() for i in range(n) for j in range(i)
    )
    assert boxes_apart(low, high) == apart


def test_all_pairs_of_small_boxes():
    corners = list(np.argwhere(np.ones((3, 3))).astype(float))
    boxes = [(p, q) for p, q in itertools.product(corners, repeat=2) if (p <= q).all()]
    for (low, high), (other_low, other_high) in itertools.product(boxes, repeat=2):
        apart = (high < other_low).any() or (other_high < low).any()
        assert boxes_apart(np.stack([low, other_low]), np.stack([high, other_high])) == apart


@pytest.mark.parametrize("scale", [1e-170, 1, 1e170])
def test_certificates_at_any_scale(scale):
    """Where products of coordinates underflow or overflow, signs are exact all the same."""
    mesh = dp.Mesh(*meshes.planar_disk(0, 4))
    uv = mesh.vertices * scale
    assert orientations(uv[mesh.faces].numpy()).tolist() == [1] * mesh.n_faces
    assert orientations(uv[mesh.faces].flip(1).numpy()).tolist() == [-1] * mesh.n_faces
    square = np.array([[0, 0], [1, 0], [2, 0], [2, 2], [0, 2.0]]) * scale
    assert is_simple(square)
    square[2] = scale * np.array([0.5, 0])  # folds back onto the edge before it
    assert not is_simple(square)


def test_maps_that_are_not_finite_get_no_certificate():
    mesh = dp.Mesh(*meshes.planar_disk(0, 4))
    uv = mesh.vertices.clone()
    uv[3, 1] = torch.nan
    with pytest.raises(ValueError, match=r"^certify: uv has entries that are not finite"):
        dp.certify(mesh, uv)
    assert (orientations(uv[mesh.faces].numpy()) == 0).tolist() == (mesh.faces == 3).any(1).tolist()


def test_certificates_need_no_graph():
    mesh = dp.Mesh(*meshes.planar_disk(0, 4))
    assert dp.certify(mesh, mesh.vertices.clone().requires_grad_()).injective


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ((None, MESH.vertices), TypeError, "expected a diffpoisson.Mesh"),
        ((MESH, MESH.vertices.numpy()), TypeError, "uv must be a torch tensor"),
        ((MESH, MESH.vertices.half()), TypeError, "uv must be float32 or float64"),
        ((MESH, MESH.vertices[1:]), ValueError, r"expected uv of shape \(n=16, 2\), got \(15, 2\)"),
    ],
)
def test_certificates_name_what_they_refuse(arguments, kind, message, unchecked):
    with pytest.raises(kind, match="^certify: " + message):
        certify(*arguments)
