"""The store of UV patches: a folder of shards, each complete, self-describing and checksummed.

A shard is one safetensors file of some hundred patches of one mesh: their arrays end to end, the
offsets at which each begins, and columns of what is known of each. Its header tells the source,
what was rejected and why, and a checksum. A store can be read at any time, also while it is built.
"""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from torch.utils.data import Dataset

from njf_models.datasets.fingerprint import fingerprint
from njf_models.datasets.sources import RawMesh
from njf_models.datasets.uv import FlatPatch, UVPatch

_SUFFIX = ".safetensors"
_COLUMNS = ("flatness", "energy", "iterations", "index")


class StoreError(Exception):
    """A store that is missing, damaged, or not the one asked for."""


@dataclass(frozen=True)
class PatchFilter:
    """Which patches of a store are read.

    Attributes:
        min_flatness: smallest |Σ nA| / ΣA; 0 keeps all.
        max_faces: largest patch; None keeps all.
        max_energy: largest mean symmetric Dirichlet energy of the target.
    """

    min_flatness: float = 0.0
    max_faces: int | None = None
    max_energy: float = math.inf


class UVStore(Sequence[UVPatch], Dataset[UVPatch]):
    """The patches of a store: a data set with random access, read from the disk one by one.

    Columns are in memory, in the order of the patches: `flatness`, `energy`, `iterations` of SLIM,
    `index_on_mesh` (number of the patch on its mesh), `n_faces`, `n_vertices`, and the lists
    `mesh_name` and `family`. A shard's checksum is verified when its first patch is read.

    Args:
        folder: of `build.build_store`.
        keep: filter of the patches.

    Attributes:
        counts: draws that were "kept" or rejected while the store was built, by reason.
        filtered: patches that are stored but not read, by reason.

    Raises:
        StoreError: the folder holds no shard, or a damaged one.
    """

    def __init__(self, folder: Path | str, keep: PatchFilter | None = None) -> None:
        self.folder = Path(folder)
        paths = sorted((self.folder / "shards").glob(f"*{_SUFFIX}"))
        if not paths:
            raise StoreError(
                f"UVStore: no shard in {self.folder}; build it with `njf data` or `build_store`"
            )
        self.shards = [_Shard.open(path) for path in paths]
        self.counts: Counter[str] = Counter()
        for shard in self.shards:
            self.counts.update(shard.record["counts"])
        lengths = [shard.n_patches for shard in self.shards]
        rows = np.concatenate([np.arange(length) for length in lengths])
        self._select(np.repeat(np.arange(len(lengths)), lengths), rows)
        self.filtered: Counter[str] = Counter()
        if keep is not None:
            self._filter(keep)

    def _select(self, shard: np.ndarray, row: np.ndarray) -> None:
        """Make these rows of these shards the patches of this data set."""
        self._shard, self._row = shard, row
        sources = [s.record["source"] for s in self.shards]
        self.mesh_name: list[str] = [sources[k]["name"] for k in shard]
        self.family: list[str] = [sources[k]["family"] for k in shard]
        starts = np.cumsum([0] + [s.n_patches for s in self.shards])
        at = starts[shard] + row
        column = {
            name: np.concatenate([s.columns[name] for s in self.shards])[at]
            for name in (*_COLUMNS, "n_faces", "n_vertices")
        }
        self.flatness, self.energy = column["flatness"], column["energy"]
        self.iterations, self.index_on_mesh = column["iterations"], column["index"]
        self.n_faces, self.n_vertices = column["n_faces"], column["n_vertices"]

    def _filter(self, keep: PatchFilter) -> None:
        largest = math.inf if keep.max_faces is None else keep.max_faces
        reasons = {
            "not flat enough": self.flatness < keep.min_flatness,
            "too many faces": self.n_faces > largest,
            "too much distortion": self.energy > keep.max_energy,
        }
        left = np.ones(len(self), dtype=bool)
        for reason, bad in reasons.items():
            if count := int((left & bad).sum()):
                self.filtered[reason] = count
            left &= ~bad
        self._select(self._shard[left], self._row[left])

    def subset(self, indices: Sequence[int] | np.ndarray) -> UVStore:
        """The data set of some of the patches."""
        view = object.__new__(UVStore)
        view.__dict__.update(self.__dict__)
        chosen = np.asarray(indices, dtype=np.int64)
        view._select(self._shard[chosen], self._row[chosen])
        return view

    def __len__(self) -> int:
        return len(self._row)

    @overload
    def __getitem__(self, index: int) -> UVPatch: ...
    @overload
    def __getitem__(self, index: slice) -> UVStore: ...
    def __getitem__(self, index: int | slice) -> UVPatch | UVStore:
        if isinstance(index, slice):
            return self.subset(np.arange(len(self))[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"UVStore: patch {index} of {len(self)}")
        return self.shards[self._shard[index]].read(int(self._row[index]))

    def __iter__(self) -> Iterator[UVPatch]:
        return (self[i] for i in range(len(self)))

    @property
    def bytes_per_patch(self) -> float:
        """Size of all shards over the number of all patches in them."""
        n_patches = sum(shard.n_patches for shard in self.shards)
        return sum(shard.path.stat().st_size for shard in self.shards) / max(1, n_patches)

    @property
    def sources(self) -> list[dict[str, Any]]:
        """Name, family, licence, origin and size of each source mesh, by name."""
        sources = {shard.record["source"]["name"]: shard.record["source"] for shard in self.shards}
        return [sources[name] for name in sorted(sources)]


def split_by_mesh(store: UVStore, fractions: Sequence[float], seed: int = 0) -> list[UVStore]:
    """Split so that no mesh, and no near-copy of one, is on two sides.

    Args:
        store: to be split.
        fractions: of the patches, one per part, summing to 1.
        seed: chooses among the splits.

    Raises:
        ValueError: fractions that do not sum to one, or too few families to fill each part.
    """
    return [store.subset(part) for part in split_families(store.family, fractions, seed)]


def split_families(
    families: Sequence[str], fractions: Sequence[float], seed: int = 0
) -> list[np.ndarray]:
    """Split indices so that equal families stay together.

    Families are ordered by a hash of their name and cut where the patches reach the fractions, so
    the same families always split the same way, in whatever order the patches come.

    Args:
        families: of each patch.
        fractions: of the patches, one per part, summing to 1.
        seed: chooses among the splits.

    Returns:
        Ascending indices of the patches, one array per part.

    Raises:
        ValueError: fractions that do not sum to one, or too few families to fill each part.
    """
    if not np.isclose(sum(fractions), 1) or min(fractions) <= 0:
        raise ValueError(f"split_by_mesh: fractions must be positive and sum to 1, got {fractions}")
    sizes = Counter(families)
    names = sorted(sizes, key=lambda family: fingerprint(seed, family))
    size = np.array([sizes[name] for name in names], dtype=np.float64)
    middle = (size.cumsum() - size / 2) / size.sum()
    part_of = dict(zip(names, np.searchsorted(np.cumsum(fractions)[:-1], middle), strict=True))
    part = np.array([part_of[family] for family in families])
    parts = [np.flatnonzero(part == k) for k in range(len(fractions))]
    if not all(map(len, parts)):
        raise ValueError(
            f"split_by_mesh: {len(names)} families of meshes give parts of "
            f"{[len(p) for p in parts]} patches; use more meshes, larger fractions or another seed"
        )
    return parts


# -------------------------------------------------------------------- shards


@dataclass
class _Shard:
    """One file of a store.

    Attributes:
        path: of the file.
        record: its header: source, key, counts of rejections, checksum.
        columns: what is known of each patch.
        offsets: where the vertices, and where the faces, of each patch begin and end.
        verified: whether the checksum has been compared with the content.
    """

    path: Path
    record: dict[str, Any]
    columns: dict[str, np.ndarray]
    offsets: tuple[np.ndarray, np.ndarray]
    verified: bool = False

    @classmethod
    def open(cls, path: Path) -> _Shard:
        """A shard by its header and columns; the rest stays on the disk."""
        with _opened(path) as file:
            record = json.loads(file.metadata()["record"])
            columns = {name: file.get_tensor(name) for name in _COLUMNS}
            vertices, faces = file.get_tensor("vertex_offsets"), file.get_tensor("face_offsets")
        columns |= {"n_vertices": np.diff(vertices), "n_faces": np.diff(faces)}
        return cls(path, record, columns, (vertices, faces))

    @property
    def n_patches(self) -> int:
        return len(self.columns["index"])

    def read(self, row: int) -> UVPatch:
        """One patch, of which only its own bytes are read."""
        if not self.verified:
            verify_shard(self.path)
            self.verified = True
        v, f = (slice(*offsets[row : row + 2].tolist()) for offsets in self.offsets)
        with _opened(self.path) as file:
            vertices, uv, wks = (file.get_slice(name)[v] for name in ("vertices", "uv", "wks"))
            faces = file.get_slice("faces")[f]
        return UVPatch(
            vertices=torch.from_numpy(vertices.astype(np.float64)),
            faces=torch.from_numpy(faces.astype(np.int64)),
            uv=torch.from_numpy(uv.astype(np.float64)),
            wks=torch.from_numpy(wks.astype(np.float32)),
            mesh_name=self.record["source"]["name"],
            family=self.record["source"]["family"],
            flatness=float(self.columns["flatness"][row]),
            energy=float(self.columns["energy"][row]),
            iterations=int(self.columns["iterations"][row]),
        )


def encode_shard(
    patches: Mapping[int, FlatPatch], source: Mapping[str, Any], key: str, counts: Counter[str]
) -> bytes:
    """The file of some patches of one mesh; the same arguments give the same bytes.

    Args:
        patches: by their number on the mesh, ascending.
        source: what the header tells of the mesh.
        key: fingerprint of everything the patches depend on.
        counts: draws "kept" or rejected, by reason.
    """
    arrays = _arrays(list(patches.values()))
    arrays["index"] = np.array(list(patches), dtype=np.int32)
    record: dict[str, Any] = {
        "source": dict(source),
        "key": key,
        "counts": dict(sorted(counts.items())),
    }
    record["checksum"] = fingerprint(record, arrays)
    # All in one entry, because safetensors writes several in no particular order.
    return save(arrays, metadata={"record": json.dumps(record)})


def verify_shard(path: Path) -> dict[str, Any]:
    """The record of a shard whose content has its checksum.

    Raises:
        StoreError: it has not.
    """
    with _opened(path) as file:
        record = json.loads(file.metadata()["record"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    checksum = record.pop("checksum")
    if checksum != fingerprint(record, arrays):
        raise StoreError(f"{path} is damaged: build the store again, which replaces it")
    return record


def shard_path(folder: Path, raw: RawMesh, start: int) -> Path:
    """Where the shard of a mesh goes whose first patch has number `start`."""
    readable = re.sub(r"[^A-Za-z0-9._-]+", "-", raw.name)[-60:].lstrip(".-")
    return folder / "shards" / f"{readable}-{fingerprint(raw.name)[:8]}-{start:07d}{_SUFFIX}"


def describe_source(raw: RawMesh) -> dict[str, Any]:
    """What a store tells of a source mesh."""
    return {
        "name": raw.name,
        "family": raw.family,
        "licence": raw.licence,
        "origin": raw.origin,
        "n_faces": len(raw.faces),
    }


def write_atomically(path: Path, content: bytes) -> None:
    """At any instant the file is absent, old, or new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())  # or a power cut could leave a name without data
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def settings_record(settings: Any) -> dict[str, Any]:
    """A dataclass of settings as JSON gives it back."""
    return json.loads(json.dumps(asdict(settings)))


def _opened(path: Path) -> Any:
    try:
        return safe_open(path, framework="numpy")
    except (SafetensorError, OSError) as error:
        raise StoreError(
            f"{path} cannot be read ({error}): build the store again, which replaces it"
        ) from error


def _arrays(patches: Sequence[FlatPatch]) -> dict[str, np.ndarray]:
    """The patches' arrays end to end, in the smallest types that hold them."""
    vertices = [flat.patch.mesh.vertices.numpy() for flat in patches]
    faces = [flat.patch.mesh.faces.numpy() for flat in patches]
    largest = max(map(len, vertices), default=0)
    small = np.uint16 if largest <= 1 + np.iinfo(np.uint16).max else np.uint32
    k = patches[0].wks.shape[1] if patches else 0
    return {
        "vertices": _stacked(vertices, (3,), np.float32),
        "faces": _stacked(faces, (3,), small),
        "uv": _stacked([flat.uv.numpy() for flat in patches], (2,), np.float32),
        "wks": _stacked([flat.wks.numpy() for flat in patches], (k,), np.float16),
        "vertex_offsets": np.cumsum([0, *map(len, vertices)], dtype=np.int64),
        "face_offsets": np.cumsum([0, *map(len, faces)], dtype=np.int64),
        "flatness": np.array([flat.patch.flatness for flat in patches], dtype=np.float64),
        "energy": np.array([flat.energy for flat in patches], dtype=np.float64),
        "iterations": np.array([flat.iterations for flat in patches], dtype=np.int32),
    }


def _stacked(parts: Sequence[np.ndarray], tail: tuple[int, ...], dtype: type) -> np.ndarray:
    empty: np.ndarray = np.zeros((0, *tail), dtype=dtype)
    return np.concatenate([empty, *(part.astype(dtype) for part in parts)])
