"""`njf data`: fill a store of UV patches from folders of meshes and generated parts."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from njf_models.commands import UsageError

if TYPE_CHECKING:
    from njf_models.datasets.sources import MeshFolder
    from njf_models.datasets.store import UVStore

_EXAMPLE = """\
examples:
  njf data runs/patches --meshes scans/ --patches 100
  njf data runs/patches --csg 500 --patches 100 --jobs 16

An interrupted command goes on where it stopped when it is repeated; with more meshes or patches
it adds to the store.
"""


def add_parser(subparsers: Any) -> argparse.ArgumentParser:
    """Register the command."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "data",
        help="make UV training patches",
        description=__doc__,
        epilog=_EXAMPLE,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("out", type=Path, help="folder of the store")
    add("--meshes", type=Path, nargs="+", default=[], metavar="FOLDER", help="obj, ply, off, stl")
    add("--licence", default="unknown", help="of the meshes in the folders, recorded with them")
    add("--csg", type=int, default=0, metavar="N", help="number of generated parts (0)")
    add("--bent", type=int, default=0, metavar="N", help="bent copies of each mesh (0)")
    add("--patches", type=int, default=100, metavar="N", help="patches per mesh (100)")
    add("--faces", type=int, nargs=2, default=(500, 2000), help="size of a patch (500 2000)")
    add(
        "--min-flatness",
        type=float,
        default=0.0,
        help="draw again below this |Σ nA| / ΣA (0: keep all, and filter when reading)",
    )
    add("--energies", type=int, default=50, help="size of the wave-kernel signature (50; 0: none)")
    add("--seed", type=int, default=0)
    add("--jobs", type=int, default=-1, help="workers (-1: one per core)")
    add("--backend", default="loky", help="joblib's: loky, sequential, dask, ray (loky)")
    add("--scheduler", metavar="ADDRESS", help="of the Dask cluster; a local one by default")
    return parser


def run(options: argparse.Namespace) -> int:
    """Build the store and print what it holds."""
    folders = _folders(options)
    try:
        with _cluster(options):
            store = _build(options, folders)
    finally:
        for path, reason in chain(*(folder.failures.items() for folder in folders)):
            print(f"njf data: skipped {path}: {reason}", file=sys.stderr)
    draws = ", ".join(f"{count} {reason}" for reason, count in store.counts.most_common())
    print(f"{len(store)} patches of {len(store.sources)} meshes in {options.out}")
    print(f"draws: {draws}")
    print(f"{store.bytes_per_patch / 1000:.1f} kB and {store.n_faces.mean():.0f} faces per patch")
    return 0


def _build(options: argparse.Namespace, folders: list[MeshFolder]) -> UVStore:
    from njf_models.datasets.build import (  # noqa: PLC0415  (seconds to import)
        StoreSettings,
        build_store,
    )
    from njf_models.datasets.patches import PatchOptions  # noqa: PLC0415
    from njf_models.datasets.sources import Bent, CSGParts  # noqa: PLC0415

    smallest, largest = options.faces
    limits = PatchOptions(smallest, largest, options.min_flatness)
    return build_store(
        options.out,
        Bent(chain(*folders, CSGParts(options.csg, options.seed)), options.bent, options.seed),
        options.patches,
        StoreSettings(limits, options.energies, options.seed),
        n_jobs=options.jobs,
        backend=options.backend,
    )


def _folders(options: argparse.Namespace) -> list[MeshFolder]:
    from njf_models.datasets.sources import MeshFolder  # noqa: PLC0415

    if not options.meshes and not options.csg:
        raise UsageError("no meshes: pass --meshes FOLDER or --csg N")
    return [MeshFolder(folder, options.licence) for folder in options.meshes]


@contextmanager
def _cluster(options: argparse.Namespace) -> Iterator[None]:
    """While it is open, joblib knows the cluster; one that was started here ends with it."""
    if options.backend == "dask":
        from distributed import Client  # noqa: PLC0415

        with Client(options.scheduler):  # type: ignore[no-untyped-call]
            yield
        return
    if options.backend == "ray":
        from ray.util.joblib import register_ray  # noqa: PLC0415

        register_ray()
    yield
