"""The figures of speed: their scripts run, at the smallest size, and their arithmetic is right.

Nothing depends on how fast anything is.
"""

from __future__ import annotations

import sys
from importlib import import_module

import numpy as np
import pytest
import torch

from diffpoisson import testing
from tests import coverage_table
from tests.benchmarks import figures, gallery_times, harness, limits, maps, report
from tests.benchmarks.figures import Spread

THEMES = (
    "operators",
    "factorisation",
    "distortion",
    "network",
    "uv_training",
    "startup",
    "scaling",
    "maps",
)
MEASUREMENTS = [
    (theme, name)
    for theme in THEMES
    for name in import_module(f"tests.benchmarks.{theme}").MEASUREMENTS
]
linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc and glibc's counts")


@linux
@pytest.mark.parametrize(("theme", "name"), MEASUREMENTS, ids=map(".".join, MEASUREMENTS))
def test_a_measurement_and_its_page(theme, name, tmp_path, monkeypatch):
    """Each runs, and what it writes can be read, tabulated, drawn and compared with itself."""
    for limit in ("bandwidth", "read_bandwidth", "peak_flops"):  # seconds each, tested below
        monkeypatch.setattr(limits, limit, lambda *_: 1e10)
    measured = list(import_module(f"tests.benchmarks.{theme}").MEASUREMENTS[name](True))
    path = tmp_path / "figures.json"
    about = {"processor": "any", "bandwidth, GB/s": 1.0, "load": [0.5, 1.5]}
    figures.record(path, f"{theme}.{name}", measured, about)
    for read, figure in zip(figures.read(path)[f"{theme}.{name}"], measured, strict=True):
        assert (read.what, read.against, read.unit) == (figure.what, figure.against, figure.unit)
        assert (read.value, read.target, read.limit) == (figure.value, figure.target, figure.limit)
        assert read.seconds == figure.seconds
    assert len(report.figures_table(path).splitlines()) == 2 + len(measured) > 2
    assert "any; load average 0.5 to 1.5" in report.machines_table(path)
    assert report.limits_table(path).endswith("| bandwidth, GB/s | 1 |")
    for picture in report.plot(path, tmp_path):
        assert picture.stat().st_size > 5_000
    assert report.worse(path, path) == []
    for figure in measured:
        assert np.isfinite(figure.value).all()
        assert figure.value.low <= figure.value.median <= figure.value.high


def test_turns_alternate_and_short_work_is_repeated():
    calls = []
    seconds = harness.alternate(
        {"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, turns=4, at_least=0.0
    )
    assert calls[-8:] == list("abbaabba")
    assert {name: len(times) for name, times in seconds.items()} == {"a": 4, "b": 4}
    calls.clear()
    harness.alternate({"a": lambda: calls.append("a")}, turns=1, at_least=1e-3)
    assert len(calls) > 10


def test_ratios_are_the_right_way_up():
    """Three times as fast is a speed-up of 3, and costs a third."""
    seconds = {"ours": np.array([1.0, 2.0, 1.0]), "peer": np.array([3.0, 6.0, 3.0])}
    assert figures.speed_up("", seconds, "peer", 2.0).value == Spread(3, 3, 3)
    assert figures.cost("", seconds, "peer", 2.0).value == pytest.approx(Spread(*3 * [1 / 3]))


def test_an_exponent_is_that_of_the_power_law():
    sizes = np.array([10, 30, 100, 1000])
    figure = figures.exponent("", sizes, 2e-3 * sizes**1.3, 1.5)
    assert figure.value == pytest.approx(Spread(1.3, 1.3, 1.3))
    noisy = figures.exponent("", sizes, sizes**1.3 * [1, 1.2, 0.9, 1.1], 1.5).value
    assert noisy.low < 1.3 < noisy.high
    with pytest.raises(ValueError, match="four sizes"):
        figures.exponent("", sizes[:3], sizes[:3], 1.5)


@pytest.mark.parametrize("sense", ["≤", "≥"])
def test_only_what_got_worse_beyond_its_spread_is_named(sense, tmp_path):
    def written(name, *value):
        target = figures.Target(sense, 2.0)
        figure = figures.Figure("a", "b", Spread(*value), target=target)
        figures.record(tmp_path / name, "theme.name", [figure], {})
        return tmp_path / name

    old = written("old.json", 1.9, 2.0, 2.1)
    higher, lower = written("higher.json", 2.2, 2.3, 2.4), written("lower.json", 1.5, 1.6, 1.7)
    near = written("near.json", 2.05, 2.2, 2.3)
    bad, good = (higher, lower) if sense == "≤" else (lower, higher)
    assert len(report.worse(bad, old)) == 1
    assert report.worse(good, old) == []
    assert report.worse(near, old) == []


@linux
def test_memory_is_counted():
    size = 50_000_000
    made, grown = limits.growth_of_heap(lambda: bytearray(size))
    assert len(made) == size
    assert size <= grown < 1.01 * size + 1e5
    peak = limits.peak_memory(lambda: torch.ones(size // 8, dtype=torch.float64))
    assert 0.98 * size < peak < 1.5 * size  # the kernel counts pages in batches


def test_limits_are_rates_of_this_planet():
    """From a million times too slow, as when another process has the core, to a thousand too fast.

    In gigabytes, they would not be.
    """
    for rate in (
        limits.bandwidth(1 << 16),
        limits.read_bandwidth(1 << 16),
        limits.peak_flops(torch.float32, 128),
    ):
        assert 1e4 < rate < 1e13


def test_energies_of_maps_know_scales_mirrors_charts_and_flips():
    flat, F = testing.planar_disk(0, 5)
    V = np.c_[flat, np.zeros(len(flat))]
    corners = 3 * flat[F] * [1, -1]
    assert maps.energy(V, F, corners) == pytest.approx(4)
    moved = np.where(np.arange(len(F))[:, None, None] < 7, corners * [-1, 1] + 100, corners)
    assert maps.energy(V, F, moved) == pytest.approx(4)  # another chart, not mirrored
    assert len(set(maps.chart_of_face(F, corners))) == 1
    assert len(set(maps.chart_of_face(F, moved))) >= 2
    stretched = flat[F] * [2, 1]
    assert maps.energy(V, F, stretched) == pytest.approx(2 * np.sqrt(5 * 1.25))
    flat[12] += [2.0, 0]  # an inner vertex far outside of its star
    assert maps.energy(V, F, flat[F]) is None


def test_coverage_is_counted_over_files():
    """A package that is run in half, one in full: shares of sums, not means of shares."""

    def file(*counts: int) -> dict:
        return {"summary": dict(zip(coverage_table.COUNTS, counts, strict=True))}

    half = file(100, 50, 20, 10) | {"missing_lines": list(range(50))}
    full = file(300, 0, 20, 0) | {"missing_lines": []}
    measured = {
        "meta": {"version": "7", "branch_coverage": True},
        "files": {"diffpoisson/a.py": half, "njf_models/b.py": full},
    }
    rows = coverage_table.table(coverage_table.boiled_down(measured)).split("\n")[2:]
    assert rows[0] == "| `diffpoisson` | 100 | 50.0 | 20 | 50.0 | 50.0 |"
    assert rows[1] == "| `njf_models` | 300 | 100.0 | 20 | 100.0 | 100.0 |"
    assert rows[2] == "| both | 400 | 87.5 | 40 | 75.0 | 86.4 |"


@pytest.mark.slow
def test_an_example_is_timed():
    result = gallery_times.measure("fit_source", "--edge", "0.6", "--steps", "1")
    assert 0.5 < result["cpu seconds"] < 1.2 * result["seconds"] + 1
