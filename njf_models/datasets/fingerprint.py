"""Hashes of values by content, which name what was made of them."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np


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
