"""The documentation site builds without a warning, on its own, and lists what others import."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import diffpoisson
import njf_models

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    for module in ("sphinx", "furo", "latex2mathml", "myst_parser"):
        pytest.importorskip(module, reason="the site needs the extra [docs]")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", f"{folder}/trees"]
    run = subprocess.run(
        [*command, str(ROOT / "docs"), str(folder / "html")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return folder / "html"


def pages(site: Path) -> list[Path]:
    return [page for page in site.rglob("*.html") if page.name not in ("genindex.html",)]


@pytest.mark.slow
def test_every_page_is_reached(site):
    """In the navigation, which stands on each page."""
    navigation = (site / "index.html").read_text()
    for page in (ROOT / "docs").rglob("*.md"):
        target = page.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert (site / target).is_file()
        assert target == "index.html" or f'class="reference internal" href="{target}"' in navigation


@pytest.mark.slow
@pytest.mark.parametrize("package", [diffpoisson, njf_models], ids=lambda package: package.__name__)
def test_reference_is_complete(site, package):
    """Each public name has its place in the reference, with a signature."""
    reference = "".join(page.read_text() for page in (site / "api").glob("*.html"))
    anchors = set(re.findall(r'<dt class="sig[^"]*" id="([\w.]+)"', reference))
    assert {f"{package.__name__}.{name}" for name in package.__all__} <= anchors


@pytest.mark.slow
def test_nothing_is_fetched_from_elsewhere(site):
    """Fonts, scripts and formulas come with the site."""
    for page in pages(site):
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*src="([^"]+)"', page.read_text())
        loaded += re.findall(r'<link[^>]*rel="stylesheet"[^>]*href="([^"]+)"', page.read_text())
        assert loaded
        for address in loaded:
            assert "//" not in address
            assert (page.parent / address.split("?")[0]).is_file()


@pytest.mark.slow
def test_formulas_are_formulas(site):
    """MathML, without a command that the converter did not know and left as it was."""
    formulas = re.findall(r"<math.*?</math>", (site / "mathematics.html").read_text(), re.DOTALL)
    assert len(formulas) > 20
    assert not any("\\" in formula.replace("\\,", "") for formula in formulas)
