"""What is uploaded: a wheel made from the sdist has all it needs, and works when unpacked."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def run(*arguments: str, folder: Path, path: Path | None = None) -> str:
    """What Python prints; its own files come first from `path`."""
    environment = os.environ | {"PYTHONPATH": str(path or "")}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The contents of the wheel, as pip would unpack it."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("distribution")
    run("-m", "hatchling", "build", "-t", "sdist", "-d", str(folder), folder=ROOT)
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    source = next(path for path in folder.iterdir() if path.is_dir())
    run("-m", "hatchling", "build", "-t", "wheel", "-d", str(folder), folder=source)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_everything_is_packed(site):
    """Each file of the two packages, and no other but the wheel's own."""
    packed = {p.relative_to(site) for p in site.rglob("*") if p.is_file()}
    tracked = {
        path.relative_to(ROOT)
        for package in ("diffpoisson", "njf_models")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert {p for p in packed if not p.parts[0].endswith(".dist-info")} == tracked
    assert {"METADATA", "entry_points.txt", "LICENSE"} <= {path.name for path in packed}


@pytest.mark.slow
def test_what_is_packed_works(site, tmp_path):
    """From another folder: the self-check, the weights, and the page's templates."""
    code = (
        "import diffpoisson, njf_models; print(diffpoisson.__file__, njf_models.__file__);"
        "njf_models.load_pretrained('uv')"
    )
    assert run("-c", code, folder=tmp_path, path=site).split() == [
        str(site / package / "__init__.py") for package in ("diffpoisson", "njf_models")
    ]
    assert "FAILED" not in run("-m", "diffpoisson", folder=tmp_path, path=site)
    assert "usage: njf" in run("-m", "njf_models.cli", "--help", folder=tmp_path, path=site)


def test_metadata(site):
    """What the index shows and pip reads."""
    metadata = Parser().parsestr(next(site.glob("*.dist-info/METADATA")).read_text())
    version = metadata["Version"]
    assert f"version: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert metadata["License-Expression"] == "MIT"
    assert metadata.get_payload() == (ROOT / "README.md").read_text()
    extras = set(metadata.get_all("Provides-Extra"))
    pins = (ROOT / "constraints.txt").read_text().replace("_", "-")
    for line in metadata.get_all("Requires-Dist"):
        name = re.split(r"[^\w-]", line)[0]
        assert name == metadata["Name"] or f"\n{name}==" in pins, f"{name} is not pinned"
    assert {"docs", "examples", "test", "train", "uv"} <= extras


def test_citation():
    """What the schema 1.2.0 of citation files requires, and DOIs without their resolver."""
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["cff-version"] == "1.2.0"
    for work in (citation, *citation["references"]):
        assert {"title", "type", "authors"} <= set(work)
        for author in work["authors"]:
            assert set(author) in ({"name"}, {"family-names", "given-names"})
        assert re.fullmatch(r"10\.\d{4,}/\S+", work.get("doi", "10.1145/0"))
    assert citation["message"]
    assert citation["type"] in ("software", "dataset")
