from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from torch.utils.data import DataLoader

from njf_models.cli import main
from njf_models.datasets import build as build_module
from njf_models.datasets.build import StoreSettings, build_store
from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.patches import PatchOptions, PatchSampler
from njf_models.datasets.sources import CSGParts, RawMesh
from njf_models.datasets.store import (
    PatchFilter,
    StoreError,
    UVStore,
    split_by_mesh,
    split_families,
)
from njf_models.datasets.uv import draw
from tests import meshes

SETTINGS = StoreSettings(PatchOptions(min_faces=100, max_faces=250), n_energies=20)
SOURCES = list(CSGParts(3, n_faces=2000))


def build(folder: Path, sources: list[RawMesh] = SOURCES, n: int = 5, **changes) -> UVStore:
    arguments = {"n_jobs": 1, "backend": "sequential", "patches_per_shard": 2, "progress": False}
    return build_store(folder, sources, n, SETTINGS, **(arguments | changes))


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> UVStore:
    return build(tmp_path_factory.mktemp("store"))


# ------------------------------------------------------- reading


def test_what_is_read_is_what_was_drawn(store: UVStore) -> None:
    assert len(store) == 15
    for i, patch in enumerate(store):
        raw = next(raw for raw in SOURCES if raw.name == patch.mesh_name)
        sampler = PatchSampler(raw.vertices, raw.faces, SETTINGS.patches)
        key = fingerprint(raw.vertices, raw.faces)
        flat, _ = draw(sampler, key, 0, int(store.index_on_mesh[i]), 20)
        assert torch.equal(patch.mesh.vertices, flat.patch.mesh.vertices)
        assert torch.equal(patch.mesh.faces, flat.patch.mesh.faces)
        assert torch.equal(patch.uv.float(), flat.uv)
        assert torch.equal(patch.wks, flat.wks.float())
        known = (patch.flatness, patch.energy, patch.iterations, patch.family)
        assert known == (flat.patch.flatness, flat.energy, flat.iterations, raw.family)


def test_types(store: UVStore) -> None:
    patch = store[-1]
    dtypes = [x.dtype for x in (patch.vertices, patch.uv, patch.wks, patch.faces)]
    assert dtypes == [torch.float64, torch.float64, torch.float32, torch.int64]


def test_columns_agree_with_the_patches(store: UVStore) -> None:
    for i, patch in enumerate(store):
        assert store.mesh_name[i] == patch.mesh_name
        assert store.family[i] == patch.family
        assert store.flatness[i] == patch.flatness
        assert store.energy[i] == patch.energy
        assert store.iterations[i] == patch.iterations
        assert store.n_faces[i] == patch.mesh.n_faces
        assert store.n_vertices[i] == patch.mesh.n_vertices


def test_a_store_is_a_sequence(store: UVStore) -> None:
    assert store[-1].energy == store[14].energy
    assert [patch.energy for patch in store[3:9:2]] == store.energy[3:9:2].tolist()
    for index in (15, -16):
        with pytest.raises(IndexError, match="of 15"):
            store[index]


def test_loader_processes_read_the_same(store: UVStore) -> None:
    loader = DataLoader(store, batch_size=4, collate_fn=list, num_workers=1)
    batches = list(loader)
    assert [len(batch) for batch in batches] == [4, 4, 4, 3]
    assert [patch.energy for batch in batches for patch in batch] == store.energy.tolist()


def test_filters_are_applied_and_counted(store: UVStore) -> None:
    flat, large, energy = np.median(store.flatness), np.median(store.n_faces), 4.2
    keep = PatchFilter(flat, int(large), energy)
    kept = UVStore(store.folder, keep)
    good = (store.flatness >= flat) & (store.n_faces <= large) & (store.energy <= energy)
    assert [patch.energy for patch in kept] == store.energy[good].tolist()
    assert len(kept) + kept.filtered.total() == len(store)
    assert kept.counts == store.counts
    assert set(kept.filtered) <= {"not flat enough", "too many faces", "too much distortion"}


def test_split_by_mesh(store: UVStore) -> None:
    parts = split_by_mesh(store, (0.34, 0.33, 0.33))
    assert [len(part) for part in parts] == [5, 5, 5]
    assert sorted({name for part in parts for name in part.mesh_name}) == [r.name for r in SOURCES]
    for part in parts:
        assert len({patch.mesh_name for patch in part}) == 1


# ------------------------------------------------------- damage


def damaged(change: Callable[[bytes], bytes], store: UVStore, folder: Path) -> Path:
    for name, data in content(store.folder).items():
        path = folder / ("shards" if name.endswith(".safetensors") else "") / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    victim = sorted((folder / "shards").iterdir())[1]
    victim.write_bytes(change(victim.read_bytes()))
    return victim


def flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


CHANGES = {
    "truncated": lambda data: data[:-10],
    "empty": lambda data: b"",
    "flipped content": lambda data: flipped(data, len(data) - 3000),
    "flipped header": lambda data: data.replace(b"CC0-1.0", b"CC1-1.0"),
}


@pytest.mark.parametrize("damage", CHANGES)
def test_damage_is_noticed_and_mended(damage: str, store: UVStore, tmp_path: Path) -> None:
    victim = damaged(CHANGES[damage], store, tmp_path)
    with pytest.raises(StoreError, match=victim.name):
        list(UVStore(tmp_path))
    build(tmp_path)
    assert content(tmp_path) == content(store.folder)


def test_no_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no shard in"):
        UVStore(tmp_path)


# ------------------------------------------------------- building


def test_the_manifest_tells_all(store: UVStore) -> None:
    manifest = json.loads((store.folder / "manifest.json").read_text())
    assert manifest["n_patches"] == manifest["draws"]["kept"] == 15
    assert manifest["settings"]["patches"]["max_faces"] == 250
    assert [source["name"] for source in manifest["sources"]] == [raw.name for raw in SOURCES]
    assert {source["licence"] for source in manifest["sources"]} == {"CC0-1.0"}
    size = sum(path.stat().st_size for path in (store.folder / "shards").iterdir())
    assert manifest["bytes_per_patch"] == round(size / 15)


def test_a_second_run_computes_nothing(store: UVStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "build_shard", None)
    before = content(store.folder)
    assert len(build(store.folder)) == 15
    assert content(store.folder) == before


def test_workers_order_and_shards_do_not_matter(store: UVStore, tmp_path: Path) -> None:
    build(tmp_path, SOURCES[::-1], backend="loky", n_jobs=2)
    assert content(tmp_path) == content(store.folder)


@pytest.mark.parametrize(
    "processes", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["threads", "processes"]
)
def test_a_dask_cluster_builds_the_same(store: UVStore, tmp_path: Path, processes: bool) -> None:
    distributed = pytest.importorskip("distributed")
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with (
        distributed.LocalCluster(processes=processes, **options) as cluster,
        distributed.Client(cluster),
    ):
        build(tmp_path, backend="dask", n_jobs=-1)
    assert content(tmp_path) == content(store.folder)


def test_a_store_grows(store: UVStore, tmp_path: Path) -> None:
    build(tmp_path, SOURCES[1:], 3)
    assert len(UVStore(tmp_path)) == 6
    build(tmp_path, SOURCES, 5)
    assert content(tmp_path) == content(store.folder)


def test_other_settings_are_refused(store: UVStore) -> None:
    with pytest.raises(StoreError, match="was begun with the settings"):
        build_store(store.folder, SOURCES, 5, replace(SETTINGS, seed=1))


def test_a_mesh_without_patches_is_counted(store: UVStore, tmp_path: Path) -> None:
    ball = RawMesh("ball", *meshes.sphere(), "MIT", "test", "ball")
    empty = build(tmp_path, [ball], 2)
    assert len(empty) == 0
    assert empty.counts == {"component too small": 20}
    assert build(tmp_path, [ball, SOURCES[0]], 2).counts["kept"] == 2


def test_a_changed_mesh_replaces_its_patches(tmp_path: Path) -> None:
    build(tmp_path, SOURCES[:1], 2)
    stretched = replace(SOURCES[0], vertices=SOURCES[0].vertices * [1, 1, 1.01])
    changed = build(tmp_path, [stretched], 2)
    assert len(changed) == 2
    assert content(tmp_path) == content(build(tmp_path / "other", [stretched], 2).folder)


PROGRAM = """
import sys
from tests.njf_models.test_store import *
build(Path(sys.argv[1]))
"""


def test_a_killed_run_is_resumed(store: UVStore, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], cwd=Path(__file__).parents[2]
    )
    while len(list(tmp_path.glob("shards/*.safetensors"))) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    finished = len(list(tmp_path.glob("shards/*.safetensors")))
    assert 2 <= finished < 9
    assert 0 < len(UVStore(tmp_path)) < 15  # what is there can be read
    build(tmp_path)
    for path in tmp_path.glob("shards/.*.tmp"):  # where it was killed while writing
        path.unlink()
    assert content(tmp_path) == content(store.folder)


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
from njf_models.cli import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["workers start", "shards are there"])
def test_an_interrupt_from_the_terminal_is_resumed(tmp_path: Path, moment: str) -> None:
    """Ctrl-C reaches the workers too: they must not print, and nothing half may stay."""
    small = ["--csg", "6", "--patches", "4", "--faces", "100", "250", "--energies", "0"]
    command = ["data", str(tmp_path / "store"), *small]
    process = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, *command, "--jobs", "2"],
        cwd=Path(__file__).parents[2],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    shards = tmp_path / "store" / "shards"
    while not (workers(process.pid) if moment == "workers start" else list(shards.glob("*.safe*"))):
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    error = process.communicate(timeout=120)[1]
    assert process.returncode == 130
    assert "Traceback" not in error
    # Loky's tracker of resources, a process of its own, may warn of what is gone, after all else.
    assert "njf data: interrupted" in error.splitlines()
    assert not list(shards.glob(".*.tmp"))
    for folder in ("store", "whole"):
        resumed = ["data", str(tmp_path / folder), *small, "--backend", "sequential"]
        assert main(resumed) == 0
    assert content(tmp_path / "store") == content(tmp_path / "whole")


def workers(leader: int) -> list[Path]:
    """Processes of loky in a session whose Python already catches SIGINT, still importing."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            session = int((path / "stat").read_text().rsplit(")", 1)[1].split()[3])
            caught = int(re.search(r"SigCgt:\s*(\w+)", (path / "status").read_text())[1], 16)
            loky = b"popen_loky" in (path / "cmdline").read_bytes()
            if session == leader and loky and caught & 1 << (signal.SIGINT - 1):
                found.append(path)
        except OSError:  # it has ended meanwhile
            continue
    return found


# ------------------------------------------------------- splits


@given(seed=meshes.seeds)
def test_no_family_is_on_two_sides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    families = [str(k) for k in rng.integers(0, 40, 200)]
    parts = split_families(families, (0.6, 0.2, 0.2), seed)
    assert sorted(np.concatenate(parts)) == list(range(200))
    sides = [{families[i] for i in part} for part in parts]
    assert sum(map(len, sides)) == len(set.union(*sides))
    order = rng.permutation(200)
    shuffled = [families[i] for i in order]
    again = split_families(shuffled, (0.6, 0.2, 0.2), seed)
    assert [{shuffled[i] for i in part} for part in again] == sides


def test_the_split_has_the_fractions_and_depends_on_the_seed() -> None:
    families = [str(k % 100) for k in range(1000)]
    splits = [split_families(families, (0.8, 0.1, 0.1), seed) for seed in (0, 1)]
    assert [len(part) for part in splits[0]] == [800, 100, 100]
    assert splits[0][0].tolist() != splits[1][0].tolist()


@pytest.mark.parametrize("fractions", [(0.5, 0.4), (1.2, -0.2), (1.0, 0.0)])
def test_fractions_are_fractions(fractions: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="fractions must be positive and sum to 1"):
        split_families(["1", "2", "3"], fractions)


def test_too_few_families_are_an_error() -> None:
    with pytest.raises(ValueError, match="2 families of meshes give parts of"):
        split_families(["1", "2"], (0.8, 0.1, 0.1))
