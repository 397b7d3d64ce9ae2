"""Filling a store: patches of many meshes, flattened in parallel, resumable at any point.

A task makes one shard: some hundred patches of one mesh. Workers return the shard's bytes and only
the calling process writes, so that workers may be threads, processes, or machines of a Dask or Ray
cluster that share no file system with it. What a shard holds depends on its task alone.
"""

from __future__ import annotations

import json
import signal
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple

import joblib
import threadpoolctl
import torch
from tqdm import tqdm

from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.patches import PatchOptions, PatchSampler
from njf_models.datasets.sources import RawMesh
from njf_models.datasets.store import (
    StoreError,
    UVStore,
    describe_source,
    encode_shard,
    settings_record,
    shard_path,
    verify_shard,
    write_atomically,
)
from njf_models.datasets.uv import FlatPatch, draw

_FORMAT = 1  # change it with anything that changes the shards
_PACKAGES = ("diffpoisson", "libigl", "numpy", "scipy", "torch")


@dataclass(frozen=True)
class StoreSettings:
    """What the patches of a store have in common.

    Attributes:
        patches: sizes and filters.
        n_energies: length of the wave-kernel signature, 0 for none.
        seed: patch i of a mesh depends on the mesh's content, i and these settings only.
        format: of the shards.
    """

    patches: PatchOptions = field(default_factory=PatchOptions)
    n_energies: int = 50
    seed: int = 0
    format: int = _FORMAT


class _Task(NamedTuple):
    """Arguments of `build_shard`, and where its result goes."""

    path: Path
    raw: RawMesh
    indices: range
    key: str


def build_store(
    folder: Path | str,
    raw_meshes: Iterable[RawMesh],
    n_patches: int,
    settings: StoreSettings | None = None,
    *,
    patches_per_shard: int = 128,
    n_jobs: int = -1,
    backend: str = "loky",
    progress: bool = True,
) -> UVStore:
    """Add patches of meshes to a store, and return it.

    Shards that are there already are kept: an interrupted call goes on where it stopped when it is
    repeated, and a call with more meshes or patches adds to a store.

    Args:
        folder: of the store.
        raw_meshes: the sources, read one after the other while workers are busy.
        n_patches: how many to try to get from each mesh.
        settings: of all patches; must be those the store was begun with.
        patches_per_shard: how many are built by one task; must stay the same, too.
        n_jobs: workers, -1 for all.
        backend: of joblib: "loky" (processes), "threading", "sequential", "dask", "ray" or another
            that was registered. Start the cluster's client first.
        progress: show a progress bar.

    Raises:
        StoreError: the store was begun with other settings.
    """
    folder, settings = Path(folder), settings or StoreSettings()
    _begin(folder, settings)
    tasks = _tasks(folder, raw_meshes, n_patches, patches_per_shard, settings)
    bar = tqdm(desc="UV patches", unit="patch", disable=not progress)
    try:
        with joblib.parallel_config(backend=backend, n_jobs=n_jobs):
            _start_workers(backend)
            parallel = joblib.Parallel(return_as="generator_unordered")
            jobs = (joblib.delayed(_run)(task, settings) for task in _missing(tasks, bar))
            counts: Counter[str] = Counter()
            for path, content, new in parallel(jobs):
                write_atomically(path, content)
                counts.update(new)
                bar.update(new["kept"])
                bar.set_postfix(rejected=counts.total() - counts["kept"], refresh=False)
    finally:
        bar.close()
        _summarise(folder, settings)
    return UVStore(folder)


def _start_workers(backend: str) -> None:
    """Start processes that never see an interrupt, which a terminal sends to them too.

    The calling process gets it alone, and ends them. Blocked signals are inherited, also by the
    threads that start other processes later.
    """
    if backend != "loky" or not hasattr(signal, "pthread_sigmask"):  # as on Windows
        return
    resource_tracker.ensure_running()  # which unblocks the signal in Python 3.11
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        joblib.Parallel()([joblib.delayed(int)()])
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def build_shard(
    raw: RawMesh, indices: range, settings: StoreSettings, key: str
) -> tuple[bytes, Counter[str]]:
    """The shard of the patches of a mesh with these numbers, and the draws by reason.

    On one thread, whose sums always come in the same order, and which parallel tasks do not share.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpoolctl.threadpool_limits(1):
            patches, counts = _draw_all(raw, indices, settings)
    finally:
        torch.set_num_threads(n_threads)
    return encode_shard(patches, describe_source(raw), key, counts), counts


def _draw_all(
    raw: RawMesh, indices: range, settings: StoreSettings
) -> tuple[dict[int, FlatPatch], Counter[str]]:
    sampler = PatchSampler(raw.vertices, raw.faces, settings.patches)
    mesh_key = _mesh_key(raw)
    patches: dict[int, FlatPatch] = {}
    counts: Counter[str] = Counter()
    for index in indices:
        flat, new = draw(sampler, mesh_key, settings.seed, index, settings.n_energies)
        counts.update(new)
        if flat is not None:
            patches[index] = flat
    return patches, counts


def _run(task: _Task, settings: StoreSettings) -> tuple[Path, bytes, Counter[str]]:
    return task.path, *build_shard(task.raw, task.indices, settings, task.key)


def _tasks(
    folder: Path, raw_meshes: Iterable[RawMesh], n_patches: int, size: int, settings: StoreSettings
) -> Iterator[_Task]:
    for raw in raw_meshes:
        mesh_key = _mesh_key(raw)
        for start in range(0, n_patches, size):
            indices = range(start, min(start + size, n_patches))
            key = fingerprint(settings, mesh_key, describe_source(raw), indices.start, indices.stop)
            yield _Task(shard_path(folder, raw, start), raw, indices, key)


def _missing(tasks: Iterable[_Task], bar: Any) -> Iterator[_Task]:
    """The tasks whose shards are not there, are damaged, or of other content."""
    for task in tasks:
        try:
            record = verify_shard(task.path)
        except StoreError:
            yield task
            continue
        if record["key"] != task.key:
            yield task
        else:
            bar.update(record["counts"].get("kept", 0))


def _mesh_key(raw: RawMesh) -> str:
    return fingerprint(raw.vertices, raw.faces)


# -------------------------------------------------------------------- manifest


def _begin(folder: Path, settings: StoreSettings) -> None:
    """Write the manifest of a new store, or compare that of an old one.

    Raises:
        StoreError: the store was begun with other settings.
    """
    path, wanted = folder / "manifest.json", settings_record(settings)
    for temporary in (folder / "shards").glob(".*.tmp"):
        if time.time() - temporary.stat().st_mtime > 24 * 3600:  # of a run killed while writing
            temporary.unlink(missing_ok=True)
    if not path.exists():
        write_atomically(path, json.dumps({"settings": wanted}, indent=1).encode())
        return
    found = json.loads(path.read_text())["settings"]
    if found != wanted:
        raise StoreError(
            f"build_store: {folder} was begun with the settings {found}, not {wanted}; use these, "
            "or another folder"
        )


def _summarise(folder: Path, settings: StoreSettings) -> None:
    """Write what the store holds to its manifest."""
    try:
        store = UVStore(folder)
    except StoreError:  # interrupted before the first shard
        return
    manifest = {
        "settings": settings_record(settings),
        "versions": {name: version(name) for name in _PACKAGES},
        "n_patches": len(store),
        "bytes_per_patch": round(store.bytes_per_patch),
        "draws": dict(store.counts.most_common()),
        "sources": store.sources,
    }
    write_atomically(folder / "manifest.json", json.dumps(manifest, indent=1).encode())
