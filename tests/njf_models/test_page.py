"""The page of a UV map: its figures, that it needs nothing else, and how it behaves in Chromium."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

import diffpoisson as dp
from njf_models import page
from njf_models.comparison import MeasuredMap, compare
from tests import meshes

VOID = {"meta", "input", "br", "line", "polygon", "polyline"}


def bump(size: int = 24, height: float = 0.6) -> dp.Mesh:
    """A steep bump: far from developable, so that the maps differ."""
    vertices, faces = meshes.disk(0, size)
    radius = np.linalg.norm(vertices[:, :2] - 0.5, axis=1)
    vertices[:, 2] = height * np.exp(-12 * radius**2)
    return dp.Mesh(vertices, faces)


@pytest.fixture(scope="module")
def mapped() -> tuple[dp.Mesh, dp.UVMap, list[MeasuredMap]]:
    mesh = bump()
    uvmap = dp.parameterize(mesh)
    return mesh, uvmap, compare(uvmap, "ours", tolerance=1e-6)


@pytest.fixture(scope="module")
def text(mapped: tuple[dp.Mesh, dp.UVMap, list[MeasuredMap]]) -> str:
    return page.uv_page("bump <&> 'x'.obj", *mapped)


class Parsed(HTMLParser):
    """Tags that open and close, the rows of the table, and what attributes refer to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []
        self.rows: list[list[str]] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [f"{k}={v}" for k, v in attrs if k in ("src", "href", "action", "srcset")]
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.setdefault(self.open[-1] if self.open else "", []).append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def views(text: str) -> dict[str, Any]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def array(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


# ------------------------------------------------------- comparison


def test_lscm_is_that_of_libigl_and_of_equal_area(mapped):
    mesh, _, (_, _, lscm) = mapped
    J = dp.jacobians(mesh, lscm.uv)
    assert float(mesh.areas @ dp.determinant(J)) == pytest.approx(float(mesh.areas.sum()))
    # Conformal up to what two pins and a discrete surface allow: another pin pair, the same shape.
    boundary = mesh.boundary_loops[0].numpy()
    V, F = mesh.vertices.numpy(), mesh.faces.numpy()
    other = igl.lscm(V, F, boundary[[0, len(boundary) // 2]], np.array([[0.0, 0], [0, 7]]))[0]
    other = torch.from_numpy(other)
    other *= (mesh.areas.sum() / (mesh.areas @ dp.determinant(dp.jacobians(mesh, other)))).sqrt()
    aligned = dp.procrustes(other, lscm.uv, mesh.vertex_areas)
    torch.testing.assert_close(aligned, lscm.uv - mean(mesh, lscm.uv) + mean(mesh, aligned))


def mean(mesh: dp.Mesh, uv: torch.Tensor) -> torch.Tensor:
    return (mesh.vertex_areas[:, None] * uv).sum(0) / mesh.areas.sum()


def test_figures_of_a_known_map():
    """u → diag(2, 1/4) u: stretch 4, area 2, angle 8, energy 4 + 1/16 + 1/4 + 16."""
    vertices, faces = meshes.planar_disk()
    mesh = dp.Mesh(np.pad(vertices, ((0, 0), (0, 1))), faces)
    start = dp.parameterize(mesh)
    uv = torch.from_numpy(vertices) * torch.tensor([2.0, 0.25])
    whole = (dp.UVMap(mesh, uv, start.vertex_map, start.charts), torch.arange(mesh.n_faces))
    from njf_models.comparison import _Disk, measure

    figures = measure("known", whole[0], [_Disk.of(*whole)], uv, {})
    assert figures.energy == pytest.approx(20.3125)
    assert figures.mean_distortion == pytest.approx(4)
    assert figures.max_distortion == pytest.approx(4)
    assert figures.area_distortion == pytest.approx(2)
    assert figures.angle_distortion == pytest.approx(8)
    assert (figures.flipped, figures.overlapping, figures.certified) == (0, 0, True)
    mirrored = measure("mirrored", whole[0], [_Disk.of(*whole)], uv * torch.tensor([-1, 1]), {})
    assert mirrored.flipped == mesh.n_faces
    assert mirrored.area_distortion == mirrored.angle_distortion == mirrored.energy == np.inf
    assert not mirrored.certified


def hemispheres() -> tuple[dp.Mesh, dp.UVMap]:
    """A ball cut along its equator, by hand, its halves laid side by side."""
    vertices, faces = meshes.sphere(0, 3)
    mesh = dp.Mesh(vertices, faces)
    upper = mesh.centroids[:, 2] > mesh.centroids[:, 2].median()
    cut_faces, charts, pieces = torch.empty_like(mesh.faces), [], []
    n = 0
    for k, half in enumerate((upper, ~upper)):
        disk, index, _ = dp.Mesh.cleaned(mesh.vertices, mesh.faces[half])
        flat = dp.parameterize(disk)
        cut_faces[half] = disk.faces + n
        n += disk.n_vertices
        faces_of = half.nonzero()[:, 0]
        (chart,) = flat.charts
        charts.append(
            dp.Chart(faces_of, chart.certificate, chart.method, chart.slim_iterations,
                     chart.milliseconds)
        )  # fmt: skip
        uv = flat.uv - flat.uv.amin(0) + torch.tensor([10.0 * k, 0])
        pieces.append((disk.vertices, uv, (index >= 0).nonzero()[:, 0]))
    cut, uv, vertex_map = (torch.cat(parts) for parts in zip(*pieces, strict=True))
    return mesh, dp.UVMap(dp.Mesh(cut, cut_faces), uv, vertex_map, tuple(charts))


def test_charts_are_compared_one_by_one_and_stay_in_place():
    mesh, uvmap = hemispheres()
    ours, slim, lscm = compare(uvmap, "ours", tolerance=1e-8)
    assert ours.energy == pytest.approx(uvmap.energy, rel=1e-9)
    assert slim.energy == pytest.approx(ours.energy, rel=1e-3)  # from the same start
    areas = uvmap.mesh.areas
    for chart in uvmap.charts:
        of_chart = areas[chart.faces]
        J = dp.jacobians(uvmap.mesh, lscm.uv)[chart.faces]
        assert float(of_chart @ dp.determinant(J)) == pytest.approx(float(of_chart.sum()))
        for other in (slim, lscm):
            corners = uvmap.mesh.faces[chart.faces]
            there, here = (x.uv[corners].mean((0, 1)) for x in (other, ours))
            assert (there - here).norm() < 0.2 * float(of_chart.sum()) ** 0.5
    # The equator was cut once: its length by an independent count.
    edge_of = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    pairs = np.asarray(edge_of.face_adjacency)
    chart_of = uvmap.chart_of_face.numpy()
    crossed = edge_of.face_adjacency_edges[chart_of[pairs[:, 0]] != chart_of[pairs[:, 1]]]
    ends = mesh.vertices.numpy()[crossed]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
    assert page.seam_length(mesh, uvmap) == pytest.approx(length)
    text = page.uv_page("ball", mesh, uvmap, [ours, slim, lscm])
    assert f"2 charts, {length:.4g} of seams" in text


# ------------------------------------------------------- text


def test_the_page_is_whole_and_refers_to_nothing(text):
    parsed = Parsed(text)
    assert parsed.links == []
    assert "{{" not in text.replace("{{}}", "")
    # Addresses occur in three.js and its licence alone, as names of XML namespaces.
    assert "://" not in text.replace(page.three_js(), "")
    assert not re.search(r"@import|url\(", text.replace(page.three_js(), ""))
    assert parsed.texts["h1"] == ["bump <&> 'x'.obj"]
    assert "default-src 'none'" in text


def test_the_table_has_the_figures(text, mapped):
    mesh, uvmap, (ours, slim, lscm) = mapped
    rows = {row[0]: row[1:] for row in Parsed(text).rows}
    assert rows[""] == ["ours", "SLIM from Tutte", "LSCM"]
    assert float(rows["Energy"][0]) == pytest.approx(uvmap.energy, rel=1e-3)
    assert float(rows["Largest stretch"][0]) == pytest.approx(uvmap.max_distortion, rel=1e-3)
    assert float(rows["Mean stretch"][0]) == pytest.approx(uvmap.mean_distortion, rel=1e-3)
    # Independent: LSCM's distortion by numpy's singular values.
    J = np.asarray(dp.jacobians(mesh, lscm.uv))
    sigma = np.linalg.svd(J, compute_uv=False)
    stretch = np.maximum(sigma[:, 0], 1 / sigma[:, 1])
    weights = np.asarray(mesh.areas / mesh.areas.sum())
    assert lscm.flipped == 0
    assert float(rows["Mean stretch"][2]) == pytest.approx(weights @ stretch, rel=1e-3)
    angle = weights @ (sigma[:, 0] / sigma[:, 1])
    assert float(rows["Mean angle distortion"][2]) == pytest.approx(angle, rel=1e-3)
    assert rows["One-to-one"][:2] == ["certified", "certified"]
    assert rows["Flipped triangles"] == ["0", "0", "0"]
    assert slim.energy <= lscm.energy
    assert ours.energy == pytest.approx(slim.energy, rel=1e-6)


def test_flips_are_shown():
    """LSCM of a steep bump flips triangles on its own."""
    mesh = bump(height=1.2)
    uvmap = dp.parameterize(mesh)
    maps = compare(uvmap, "ours", tolerance=1e-6)
    uv = maps[2].uv.numpy()[mesh.faces.numpy()]
    signed = np.cross(*(np.pad(uv[:, k] - uv[:, 0], ((0, 0), (0, 1))) for k in (1, 2)))[:, 2]
    flips = np.flatnonzero(signed <= 0)
    assert len(flips) > 0
    text = page.uv_page("a", mesh, uvmap, maps)
    rows = {row[0]: row[1:] for row in Parsed(text).rows}
    assert rows["Flipped triangles"] == ["0", "0", str(len(flips))]
    assert rows["Energy"][2] == rows["Mean area distortion"][2] == "∞"
    assert rows["One-to-one"][2] == "no"
    assert "Flipped triangles (LSCM) are not in it." in " ".join(text.split())
    levels = array(views(text)["maps"][2]["colour"], "u1")
    np.testing.assert_array_equal(np.flatnonzero(levels == 255), flips)
    upright = np.isfinite(maps[2].distortion.numpy())
    shares = page._shares(maps[2].distortion.numpy(), mesh.areas.numpy(), np.linspace(0, 1, 9))
    assert shares.sum() == pytest.approx(float(mesh.areas[upright].sum() / mesh.areas.sum()))


def test_the_histogram_counts_all_area(mapped):
    mesh, _, maps = mapped
    areas = mesh.areas.numpy()
    edges = np.linspace(0, np.log(4), 49)
    for measured in maps:
        distortion = measured.distortion.numpy()
        shares = page._shares(distortion, areas, edges)
        assert shares.sum() == pytest.approx(1)
        beyond = areas[distortion >= 4].sum() / areas.sum()
        assert shares[-1] == pytest.approx(beyond)
        k = 7
        inside = (np.log(distortion) >= edges[k]) & (np.log(distortion) < edges[k + 1])
        assert shares[k] == pytest.approx(areas[inside].sum() / areas.sum())


def test_the_histogram_is_drawn_to_scale():
    """Half the area in the first bin, a quarter in the second, a quarter beyond the axis."""
    mesh = bump(5)
    assert mesh.n_faces == 32
    distortion = torch.ones(32)
    distortion[16:24], distortion[24:] = 1.6, 9.0
    known = MeasuredMap(
        "known", mesh.vertices[:, :2], distortion, *[1.0] * 5, 0, 0, certified=True, milliseconds={}
    )
    drawn = page.histogram([known], np.ones(32), limit=4.0, bins=4)
    (points,) = re.findall(r'<polyline class="outline" points="([^"]*)"', drawn)
    heights = [100 - float(pair.split(",")[1]) for pair in points.split()][::2]
    assert heights == pytest.approx([100, 50, 0, 0, 50])
    assert "known, 25% beyond 4" in drawn


def test_the_views_show_this_map(text, mapped):
    mesh, uvmap, maps = mapped
    data = views(text)
    faces = array(data["faces"], "<u4").reshape(-1, 3)
    np.testing.assert_array_equal(faces, mesh.faces)
    positions = array(data["positions"], "<f4").reshape(-1, 3)
    assert np.linalg.norm(positions, axis=1).max() == pytest.approx(1, abs=1e-6)
    unit = float(mesh.areas.sum()) ** 0.5
    for drawn, measured in zip(data["maps"], maps, strict=True):
        uv = array(drawn["uv"], "<f4").reshape(-1, 2)
        edges = uvmap.mesh.faces[:, :2]
        length = np.linalg.norm(np.diff(uv[edges], axis=1), axis=-1)[:, 0] * unit
        expected = (measured.uv[edges[:, 1]] - measured.uv[edges[:, 0]]).norm(dim=-1)
        np.testing.assert_allclose(length, expected, rtol=1e-4, atol=1e-6)
    assert len(array(data["seams"], "<u4")) == 2 * len(mesh.boundary_loops[0])


def test_a_large_mesh_is_simplified_and_says_so(mapped, monkeypatch):
    mesh, uvmap, maps = mapped
    monkeypatch.setattr(page, "FACES_SHOWN", 300)
    text = page.uv_page("a", mesh, uvmap, maps)
    faces = array(views(text)["faces"], "<u4").reshape(-1, 3)
    assert 100 < len(faces) <= 300
    assert f"simplified copy of {len(faces)} triangles" in text
    assert f"whole mesh of {mesh.n_faces:,}" in text
    assert faces.max() < len(array(views(text)["positions"], "<f4")) // 3
    assert f"{mesh.n_faces:,} triangles, area" in text


def test_another_viewer_in_trimesh_is_an_error(monkeypatch):
    monkeypatch.setattr(page.zipfile.ZipFile, "read", lambda *_: b"<script>something else</script>")
    with pytest.raises(RuntimeError, match="has no three"):
        page.three_js()


# ------------------------------------------------------- in Chromium

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
FLAGS = (
    *("--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync"),
)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    api = pytest.importorskip(
        "playwright.sync_api",
        reason="playwright is not installed: pip install diffpoisson[browser]",
    )
    if not CHROMIUM:
        pytest.skip("no Chromium on the path: the page is not looked at")
    with api.sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("profile"),
            executable_path=CHROMIUM,
            headless=True,
            args=list(FLAGS),
            viewport={"width": 1200, "height": 800},
            offline=True,
        )
        yield context
        context.close()


class Visit:
    """A page that was opened, and what it complained of or asked for."""

    def __init__(self, browser: Any, path: Path, **size: int) -> None:
        self.page = browser.new_page()
        if size:
            self.page.set_viewport_size(size)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._heard)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body[data-map='0']")
        self.settle()

    def _heard(self, message: Any) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def settle(self) -> None:
        """Wait for two frames: one that draws, one that shows."""
        self.page.evaluate(
            "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => "
            "requestAnimationFrame(done))))"
        )

    def click(self, selector: str) -> None:
        self.page.click(selector)
        self.settle()

    def picture(self, selector: str) -> np.ndarray:
        shot = self.page.locator(selector).screenshot()
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def differ(a: np.ndarray, b: np.ndarray) -> float:
    """Share of pixels that differ clearly."""
    return float((np.abs(a - b).max(axis=-1) > 30).mean())


@pytest.fixture(scope="module")
def saved(text: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(text, encoding="utf-8")
    return path


def test_in_chromium(browser, saved):
    visit = Visit(browser, saved)
    surface, layout = visit.picture("#surface"), visit.picture("#layout")
    for picture in (surface, layout):
        background = picture[3, 3]
        assert 0.1 < differ(picture, background) < 0.9
    light, dark = (surface > 170).all(-1).mean(), (surface[..., 2] - surface[..., 0] > 50).mean()
    assert min(light, dark) > 0.1  # both colours of the checkerboard

    visit.click("#tab-2")  # LSCM's layout has another shape
    assert visit.page.get_attribute("#tab-2", "aria-selected") == "true"
    assert visit.page.get_attribute("#tab-0", "aria-selected") == "false"
    assert differ(visit.picture("#layout"), layout) > 0.05
    assert differ(visit.picture("#surface"), surface) > 0.05
    visit.page.focus("#tab-2")
    visit.page.keyboard.press("ArrowRight")  # around to the first
    visit.settle()
    assert differ(visit.picture("#layout"), layout) < 0.01

    visit.click("[data-mode=distortion]")
    assert differ(visit.picture("#surface"), surface) > 0.05
    visit.click("[data-mode=checker]")
    assert differ(visit.picture("#surface"), surface) < 0.01

    box = visit.page.locator("#surface").bounding_box()
    visit.page.mouse.move(box["x"] + 200, box["y"] + 200)
    visit.page.mouse.down()
    visit.page.mouse.move(box["x"] + 300, box["y"] + 240, steps=4)
    visit.page.mouse.up()
    visit.settle()
    assert differ(visit.picture("#surface"), surface) > 0.05  # orbits
    visit.page.locator("#layout").hover()
    visit.page.mouse.wheel(0, -600)
    visit.settle()
    assert differ(visit.picture("#layout"), layout) > 0.05  # zooms
    visit.click("#reset")
    assert differ(visit.picture("#layout"), layout) < 0.01
    assert differ(visit.picture("#surface"), surface) < 0.02

    assert visit.errors == []
    assert visit.requests == [saved.as_uri()]


def test_on_a_phone(browser, saved):
    visit = Visit(browser, saved, width=390, height=844)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 390
    for selector in ("#surface", "#layout"):
        picture = visit.picture(selector)
        assert differ(picture, picture[3, 3]) > 0.1
    assert visit.errors == []
