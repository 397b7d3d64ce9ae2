"""A picture of a `Window` in the docs, as a browser shows it; needs a Chromium on the path."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from njf_models.window import Window
from tests.benchmarks.page_picture import FLAGS

_SECONDS = 25  # software rendering is slow


@contextmanager
def photographed(window: Window, path: Path, height: int) -> Iterator[Page]:
    """The page of a window, which is photographed after what is done to either, then closed."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    thread = threading.Thread(target=window.serve)
    with window, sync_playwright() as playwright:
        thread.start()
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": 1200, "height": height})
        page.goto(window.address)
        page.wait_for_timeout(1000 * _SECONDS)
        yield page
        page.wait_for_timeout(1000 * _SECONDS)
        page.mouse.click(288, 80)  # away with the warning of software rendering
        page.wait_for_timeout(2000)
        page.screenshot(path=path)
        browser.close()
    thread.join()
