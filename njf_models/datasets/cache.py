"""The on-disk cache all datasets share: content-addressed, atomic, filled in parallel.

An entry is a dictionary of arrays, stored as one `.npz` file named by the hash of everything that
determines it. Writers never see each other: each writes a temporary file and renames it, so a file
under an entry's name is complete, and two runs that build the same entry write the same bytes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import tempfile
import time
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from tqdm import tqdm

Entry = dict[str, np.ndarray]

# What numpy and zipfile raise on a file that was truncated, overwritten, or had a bit flipped
# (the zip container checks a CRC per array).
_CORRUPT = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError, NotImplementedError)


def default_root() -> Path:
    """`$DIFFPOISSON_CACHE`, or `~/.cache/diffpoisson` where that is unset."""
    root = os.environ.get("DIFFPOISSON_CACHE")
    return Path(root).expanduser() if root else Path.home() / ".cache" / "diffpoisson"


def fingerprint(*values: object) -> str:
    """SHA-256 of nested values, equal exactly where type, shape and content are.

    Args:
        values: None, booleans, numbers, strings, bytes, paths, arrays, dataclasses, and sequences
            or mappings of these; the order of a mapping does not matter.

    Returns:
        64 hexadecimal digits.

    Raises:
        TypeError: a value of another type, whose content could not be told from its identity.
    """
    digest = hashlib.sha256()
    for token in _tokens(values):
        # Lengths make the concatenation injective: ("ab", "c") is not ("a", "bc").
        digest.update(len(token).to_bytes(8, "little"))
        digest.update(token)
    return digest.hexdigest()


def _tokens(value: object) -> Iterable[bytes]:
    yield type(value).__name__.encode()
    if isinstance(value, bytes):
        yield value
    elif value is None or isinstance(value, bool | int | float | complex | str | Path):
        yield str(value).encode() if isinstance(value, str | Path) else repr(value).encode()
    elif isinstance(value, np.ndarray | np.generic) and not value.dtype.hasobject:
        array = np.asarray(value)
        yield f"{array.dtype.str}{array.shape}".encode()
        yield np.ascontiguousarray(array).tobytes()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield field.name.encode()
            yield from _tokens(getattr(value, field.name))
    elif isinstance(value, Mapping):
        yield str(len(value)).encode()
        for key in sorted(value, key=repr):
            yield from _tokens(key)
            yield from _tokens(value[key])
    elif isinstance(value, Sequence):
        yield str(len(value)).encode()
        for item in value:
            yield from _tokens(item)
    else:
        raise TypeError(
            f"fingerprint: a {type(value).__qualname__} cannot be hashed by its content; "
            "pass arrays, numbers, strings, dataclasses, or sequences and mappings of these"
        )


class Cache:
    """A folder of entries that are rebuilt only when their inputs change.

    Args:
        name: the dataset; its entries share the folder `root / name`.
        version: part of every key; change it whenever the code that builds entries changes.
        root: the folder of all caches; by default `default_root()`.
    """

    def __init__(self, name: str, version: str, root: Path | None = None) -> None:
        self.version = version
        self.folder = (root or default_root()) / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self._remove_abandoned()

    def path(self, key: str) -> Path:
        """Where the entry of a key is, or would be."""
        return self.folder / f"{key}.npz"

    def load(self, key: str) -> Entry | None:
        """The entry, or None where there is none; a corrupt file counts as none, with a warning."""
        try:
            # Given a path instead, numpy leaves a truncated file open.
            with self.path(key).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except FileNotFoundError:
            return None
        except _CORRUPT as error:
            warnings.warn(
                f"cache entry {self.path(key)} is corrupt and will be rebuilt ({error})",
                stacklevel=2,
            )
            return None

    def store(self, key: str, entry: Entry) -> None:
        """Write an entry atomically: at any instant the file is absent, old, or new."""
        descriptor, temporary = tempfile.mkstemp(dir=self.folder, prefix=f".{key}.", suffix=".tmp")
        try:
            with os.fdopen(descriptor, "wb") as file:
                np.savez(file, allow_pickle=False, **entry)
                file.flush()
                os.fsync(file.fileno())  # or a power cut could leave a name without data
            Path(temporary).replace(self.path(key))
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    def map(
        self,
        build: Callable[..., Entry],
        tasks: Sequence[tuple[Any, ...]],
        *,
        n_jobs: int = -1,
        description: str = "",
    ) -> list[Entry]:
        """`[build(*task) for task in tasks]`, in parallel, computing only what is not on disk yet.

        Interrupted runs resume: each entry is stored as soon as it is built. What is returned was
        read back from the disk, so that a first and a later run see the same arrays.

        Args:
            build: a module-level function (processes import it by name).
            tasks: the arguments of each entry; with the function's name and `version` they are its
                key.
            n_jobs: number of processes, -1 for one per core.
            description: label of the progress bar.
        """
        name = f"{build.__module__}.{build.__qualname__}"
        keys = [fingerprint(name, self.version, task) for task in tasks]
        entries = {key: entry for key in keys if (entry := self.load(key)) is not None}
        missing = {key: task for key, task in zip(keys, tasks, strict=True) if key not in entries}
        jobs = (joblib.delayed(self._build)(key, build, task) for key, task in missing.items())
        built = joblib.Parallel(n_jobs=n_jobs, return_as="generator_unordered")(jobs)
        done, total = len(entries), len(entries) + len(missing)
        for key in tqdm(built, desc=description, total=total, initial=done, disable=not missing):
            entries[key] = self._read_back(key)
        return [entries[key] for key in keys]

    def _build(self, key: str, build: Callable[..., Entry], task: tuple[Any, ...]) -> str:
        self.store(key, build(*task))
        return key

    def _read_back(self, key: str) -> Entry:
        entry = self.load(key)
        if entry is None:
            raise RuntimeError(f"cache entry {self.path(key)} vanished just after it was written")
        return entry

    def _remove_abandoned(self) -> None:
        """Delete temporary files of runs that were killed while writing, more than a day ago."""
        for temporary in self.folder.glob(".*.tmp"):
            with contextlib.suppress(FileNotFoundError):  # another run may be cleaning up as well
                if time.time() - temporary.stat().st_mtime > 24 * 3600:
                    temporary.unlink()
