"""The picture of `njf repose --view` in the docs: a body of the body model in a random pose.

`python -m tests.benchmarks.repose_picture` writes `docs/images/repose_view.png`. It needs the
extras bodies, view and browser, and a Chromium on the path.
"""

from __future__ import annotations

import shutil
import threading
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

import diffpoisson as dp
from njf_models.datasets.bodies import BodyModel
from njf_models.datasets.poses import sample_pose
from njf_models.pretrained import load_pretrained
from njf_models.repose_viewer import ReposeViewer
from tests.benchmarks.page_picture import FLAGS

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "repose_view.png"
SECONDS = 25  # software rendering is slow


def main() -> None:
    reference = BodyModel().reference
    mesh = dp.Mesh(reference.vertices, reference.faces)
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    window = ReposeViewer(load_pretrained("repose"), mesh, title="body.obj")
    with window, sync_playwright() as playwright:
        thread = threading.Thread(target=window.serve)
        thread.start()
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1200, "height": 800})
        page.goto(window.address)
        page.wait_for_timeout(1000 * SECONDS)
        window.show(sample_pose(np.random.default_rng(16)))
        for joint in ("left hip", "left knee"):
            page.get_by_text(joint).click()
        page.wait_for_timeout(1000 * SECONDS)
        page.mouse.click(288, 80)  # away with the warning of software rendering
        page.wait_for_timeout(2000)
        page.screenshot(path=PICTURE)
        browser.close()
        window.close()
        thread.join()


if __name__ == "__main__":
    main()
