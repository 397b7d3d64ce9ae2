"""The documentation site builds without a warning, on its own, and lists what others import."""

from __future__ import annotations

import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote

import pytest

import diffpoisson
import njf_models

ROOT = Path(__file__).parent.parent
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


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


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What GitHub makes of the headings: lower case, spaces to hyphens, no other punctuation."""
    headings = re.findall(r"^#+ +(.+?)\s*$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    """Within the repository: files and pictures that are there, headings that are on the page."""
    for link in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", prose(page))):
        if re.match(r"\w+:", link):
            continue
        path, _, heading = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_relative_to(ROOT), link
        assert target.exists(), link
        assert not heading or heading in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_files_that_are_named_exist(page):
    """Paths as code, and modules to run, in the prose and in commands."""
    text = page.read_text()
    folders = "docs|examples|tests|diffpoisson|njf_models"
    for path in re.findall(rf"`((?:{folders})/[\w/.-]+)`", text):
        assert (ROOT / path).exists(), path
    for script in re.findall(r"python ((?:docs|examples|tests)/\w+\.py)", text):
        assert (ROOT / script).is_file(), script
    for module in re.findall(r"python -m (tests[\w.]+\w)", text):
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file(), module


def test_every_picture_of_a_thing_has_its_notice():
    """Apart from plots and drawings, which show nothing of anybody's."""
    notices = (ROOT / "docs" / "notices.md").read_text()
    pictures = {path.name for path in (ROOT / "docs" / "images").iterdir()}
    drawn = {
        name
        for name in pictures
        if name.startswith(("architecture.", "performance_", "body_pose."))
    }
    assert {name for name in pictures if f"(images/{name})" in notices} == pictures - drawn


def test_addresses_are_well_formed():
    """Encrypted, and DOIs by their resolver. Whether they answer, `-b linkcheck` asks."""
    files = [*PAGES, ROOT / "CITATION.cff", ROOT / "pyproject.toml"]
    found = [a for f in files for a in re.findall(r"https?://[^\s)>\]\"'`;]+", f.read_text())]
    assert len(found) > 5
    for address in found:
        if re.match(r"http://(127\.0\.0\.1|\{)", address):  # our own windows
            continue
        assert re.fullmatch(r"https://[\w.-]+\.\w+(/[^\s]*)?", address), address
        if "doi" in address:
            assert re.fullmatch(r"https://doi\.org/10\.\d{4,}/[\w.()/-]*\w", address), address


@pytest.mark.slow
def test_links_of_the_site(site):
    """Each page and each place on it that another page leads to."""
    text = {page: page.read_text() for page in site.rglob("*.html")}
    ids = {page: set(re.findall(r'\bid="([^"]+)"', html)) for page, html in text.items()}
    count = 0
    for page, html in text.items():
        for link in re.findall(r'<a\b[^>]*?\bhref="([^"]+)"', html):
            if re.match(r"\w+:", link):
                continue
            path, _, place = unquote(unescape(link)).partition("#")
            target = (page.parent / path).resolve() if path else page
            assert target.is_file(), f"{page.name}: {link}"
            assert not place or target not in ids or place in ids[target], f"{page.name}: {link}"
            count += 1
    assert count > 1000


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
