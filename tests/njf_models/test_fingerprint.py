from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from njf_models.datasets.fingerprint import fingerprint


@dataclass(frozen=True)
class Options:
    size: int = 1
    name: str = "a"


def test_the_same_content_has_the_same_key() -> None:
    array = np.arange(12.0).reshape(3, 4)
    assert fingerprint(array) == fingerprint(np.asfortranarray(array))
    assert fingerprint(array[:, ::2]) == fingerprint(array[:, ::2].copy())
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint(Options()) == fingerprint(Options(1, "a"))


DISTINCT = [
    *(
        None,
        False,
        True,
        0,
        1,
        1.0,
        "1",
        b"1",
        "",
        (),
        [],
        {},
        (1,),
        ((1,),),
        (1, 1),
        "a",
        Path("a"),
    ),
    *(
        ("astr", "b"),
        ("a", "strb"),
        ("ab", "c"),
        ("a", "bc"),
        ("abc",),
        {"a": "b"},
        ("a", "b"),
        Options(),
        Options(2),
        [None],
    ),
    *(np.arange(4), np.arange(4.0), np.arange(4, dtype=np.int32), np.arange(4).reshape(2, 2)),
    *(np.zeros((0, 3)), np.zeros((3, 0)), [0, 1, 2, 3], np.array("a"), float("nan"), -0.0, 0.0),
]


def test_different_content_has_different_keys() -> None:
    keys = [fingerprint(value) for value in DISTINCT]
    assert len(set(keys)) == len(keys)


@given(st.binary(max_size=8), st.binary(max_size=8), st.binary(max_size=8), st.binary(max_size=8))
def test_keys_of_sequences_do_not_depend_on_concatenation(
    a: bytes, b: bytes, c: bytes, d: bytes
) -> None:
    assert (fingerprint(a, b) == fingerprint(c, d)) == ((a, b) == (c, d))


@pytest.mark.parametrize("value", [object(), {1, 2}, fingerprint, np.array([None])])
def test_what_has_no_content_has_no_key(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be hashed by its content"):
        fingerprint([value])


def test_keys_are_the_same_in_every_process() -> None:
    program = (
        "import numpy as np; from njf_models.datasets.fingerprint import fingerprint;"
        "print(fingerprint({'b': 1, 'a': np.arange(3)}, 'x'))"
    )
    keys = {
        subprocess.run(
            [sys.executable, "-c", program],
            cwd=Path(__file__).parents[2],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert keys == {fingerprint({"a": np.arange(3), "b": 1}, "x") + "\n"}
