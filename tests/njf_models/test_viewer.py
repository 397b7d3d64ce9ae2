"""The window of `njf view`: what reaches its scene, and what Chromium shows of it."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

import diffpoisson as dp
from njf_models.cli import main
from tests import meshes
from tests.checks import assert_near
from tests.njf_models.test_page import CHROMIUM, FLAGS

viewer = pytest.importorskip("njf_models.viewer", reason="pip install diffpoisson[view]")
UPRIGHT = np.array([1.0, 0, 0, 0])
TOP = 100  # where the pictures of the page begin, below what it says of software rendering


@pytest.fixture
def window() -> Iterator[Any]:
    with viewer.Viewer(dp.Mesh(*meshes.sphere(subdivisions=3)), "sphere", port=8200) as window:
        yield window


def soon(what: Callable[[], bool], seconds: float = 60) -> bool:
    """Whether something comes true."""
    deadline = time.monotonic() + seconds
    while not (done := what()) and time.monotonic() < deadline:
        time.sleep(0.1)
    return done


def test_the_surface_follows_a_handle(window):
    name = window.add_handle(0)
    assert window.add_handle(0) is None  # taken
    place = window.pose.handles[name].centre.numpy() + np.array([1.0, 0, 0])
    window.move_handle(name, place, UPRIGHT)
    for _ in range(3):
        window.follow()
    assert_near(window._surface.vertices[0], place, 1e-6)
    moved = window.pose.mesh.vertices.numpy() + np.array([1.0, 0, 0])
    assert_near(window._surface.vertices, moved, 1e-6)
    window._reset()
    window.follow()
    assert_near(window._surface.vertices, window.pose.mesh.vertices, 1e-6)
    assert window._gizmos == {}


def test_serving_ends_when_it_is_closed(window, capsys):
    thread = threading.Thread(target=window.serve)
    thread.start()
    name = window.add_handle(3)
    window.move_handle(name, np.array([0.0, 0, 4]), UPRIGHT)
    assert soon(lambda: abs(float(window._surface.vertices[3, 2]) - 4) < 1e-3)
    window.close()
    thread.join(timeout=10)
    assert not thread.is_alive()
    assert capsys.readouterr().out == ""


def test_command_without_a_mesh(tmp_path, capsys):
    (tmp_path / "empty.obj").write_text("")
    assert main(["view", str(tmp_path / "empty.obj")]) == 1
    assert "the file is empty" in capsys.readouterr().err
    assert main(["view", str(tmp_path / "none.obj")]) == 1
    assert "no such file" in capsys.readouterr().err


def test_command_serves_until_interrupted(tmp_path, capsys, monkeypatch):
    path = tmp_path / "ball.ply"
    trimesh.Trimesh(*meshes.sphere(), process=False).export(path)

    def interrupted(self: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer.Viewer, "serve", interrupted)
    assert main(["view", str(path), "--port", "8210"]) == 130
    out = capsys.readouterr()
    assert "ball.ply at http://127.0.0.1:" in out.out
    assert out.err == "njf view: interrupted\n"


# ------------------------------------------------------- in Chromium


@pytest.fixture
def page(window: Any) -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="pip install diffpoisson[browser]")
    if not CHROMIUM:
        pytest.skip("no Chromium on the path")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 800, "height": 500})
        page.errors = []
        page.on("pageerror", lambda error: page.errors.append(str(error)))
        page.goto(window.address)
        yield page
        browser.close()


def picture(page: Any) -> np.ndarray:
    """What is left of the panel."""
    shot = page.screenshot(clip={"x": 0, "y": TOP, "width": 450, "height": 400})
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def share(image: np.ndarray, colour: str) -> float:
    """Of pixels of the surface's grey-blue, or of the checkerboard's dark blue."""
    r, _, b = np.moveaxis(image, -1, 0)
    return float(({"surface": (b - r > 10) & (b < 250), "checker": b - r > 60}[colour]).mean())


def test_in_chromium(window, page):
    """The surface shows, follows a click and a move, and its UV map shows."""
    thread = threading.Thread(target=window.serve)
    thread.start()
    assert soon(lambda: share(picture(page), "surface") > 0.1)
    y, x = np.argwhere(picture(page)[..., 2] - picture(page)[..., 0] > 10).mean(0)
    y += TOP

    def clicked() -> bool:  # software rendering takes its time to notice the mouse
        page.mouse.move(x + 3, y)
        time.sleep(1)
        page.mouse.move(x, y)
        time.sleep(1)
        page.mouse.click(x, y, delay=300)
        return soon(lambda: bool(window.pose.handles), 3)

    assert soon(clicked)
    (name,) = window.pose.handles
    before = picture(page)
    higher = window.pose.handles[name].centre.numpy() + np.array([0.0, 1, 0])
    window.move_handle(name, higher, UPRIGHT)
    assert soon(lambda: float((np.abs(picture(page) - before).max(-1) > 30).mean()) > 0.05)
    assert share(picture(page), "checker") < 0.02
    page.get_by_label("UV map").check()
    assert soon(lambda: share(picture(page), "checker") > 0.03)
    assert page.errors == []
    window.close()
    thread.join(timeout=10)
