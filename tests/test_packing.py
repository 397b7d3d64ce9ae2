"""Packed charts: apart, only moved, in little space."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diffpoisson.packing import _on_shelves, pack
from tests import meshes


def drawn_charts(seed: int, count: int, spread: float) -> list[np.ndarray]:
    """Ellipses full of points, of sizes up to 10^±spread, turned and moved at random."""
    rng = np.random.default_rng(seed)
    charts = []
    for _ in range(count):
        points = rng.standard_normal((rng.integers(3, 30), 2)) * [1, rng.uniform(0.01, 1)]
        points = points @ meshes.rotation(rng, points).T + 5 * rng.standard_normal(2)
        charts.append(points * 10 ** rng.uniform(-spread, spread))
    return charts


@given(seed=meshes.seeds, count=st.integers(2, 40), spread=st.floats(0, 3))
def test_boxes_are_apart_and_charts_only_moved(seed, count, spread):
    charts = drawn_charts(seed, count, spread)
    packed = pack(charts)
    boxes = [(p.min(axis=0), p.max(axis=0)) for p in packed]
    for i, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:i]:
            assert (high < other_low).any() or (other_high < low).any()
    for before, after in zip(charts, packed, strict=True):
        # A rotation: edges as complex numbers all turn by the same unit factor.
        e, f = ((np.diff(p, axis=0) @ [1, 1j]) for p in (before, after))
        turn = f[0] / e[0]
        assert abs(turn) == pytest.approx(1)
        np.testing.assert_allclose(f, turn * e, atol=1e-9 * np.abs(before).max())
    assert np.min([low for low, _ in boxes], axis=0) == pytest.approx([0, 0], abs=1e-12)


@given(seed=meshes.seeds)
def test_each_box_is_the_least(seed):
    charts = drawn_charts(seed, 2, 0)
    for before, after in zip(charts, pack(charts), strict=True):
        angle = np.linspace(0, np.pi / 2, 1000)
        turned = np.exp(1j * angle)[:, None] * (before @ [1, 1j])
        least = (np.ptp(turned.real, axis=1) * np.ptp(turned.imag, axis=1)).min()
        width, height = np.ptp(after, axis=0)
        assert width * height <= least * (1 + 1e-9)
        assert height <= width * (1 + 1e-12)


@pytest.mark.parametrize("count", [5, 50, 500])
def test_the_square_around_them_is_mostly_full(count):
    packed = pack(drawn_charts(0, count, 0))
    boxes = sum(np.ptp(p, axis=0).prod() for p in packed)
    side = max(p.max() for p in packed)
    assert boxes > 0.5 * side**2


def test_the_tightest_of_the_shelf_widths_is_taken():
    """Two boxes of 4 × 2 on each other and a small one beside or above them."""
    sizes = np.array([[4.0, 2], [2, 1], [4, 2]])
    assert (_on_shelves(sizes) + sizes).max() == 5


@pytest.mark.parametrize("scale", [1e-6, 1, 1e6])
def test_the_gap_is_in_proportion(scale):
    square = scale * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    first, second = pack([square, square])
    gap = (second.min(axis=0) - first.max(axis=0)).max()
    assert gap == pytest.approx(0.01 * np.sqrt(2) * scale)


def test_slivers():
    sliver = np.array([[0, 0], [1, 1], [2, 2 + 1e-15]])
    first, second = pack([sliver, sliver])
    assert np.isfinite(first).all()
    assert first.max(axis=0)[1] < second.min(axis=0)[1]
