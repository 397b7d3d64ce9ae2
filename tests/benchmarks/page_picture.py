"""The picture of a report page in the docs: a bone from `dm_control`, mapped, seen in Chromium.

`python -m tests.benchmarks.page_picture` writes `docs/images/report.png`; `--start tutte` does
without the network. It needs the extras examples and browser, and a Chromium on the path.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import trimesh
from playwright.sync_api import sync_playwright

from njf_models.datasets.sources import DogBones

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "images" / "report.png"
BONE = "dog/Pelvis"
FLAGS = ("--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


def report(folder: Path, options: list[str]) -> Path:
    """The page of the bone, by the command line."""
    bone = next(bone for bone in DogBones(n_faces=1) if bone.name == BONE)
    source, page = folder / "pelvis.ply", folder / "page.html"
    trimesh.Trimesh(bone.vertices, bone.faces, process=False).export(source)
    command = [sys.executable, "-m", "njf_models.cli", "uv", str(source), "--report", str(page)]
    subprocess.run([*command, *options], check=True, cwd=ROOT)
    return page


def main() -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as name, sync_playwright() as playwright:
        page_file = report(Path(name), sys.argv[1:])
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1200, "height": 1185})
        page.goto(page_file.as_uri())
        page.wait_for_selector("body[data-map='0']")
        page.wait_for_timeout(1000)
        page.screenshot(path=PICTURE)
        browser.close()


if __name__ == "__main__":
    main()
