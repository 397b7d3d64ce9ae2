from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from njf_models.datasets.cache import Cache, default_root, fingerprint

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Options:
    size: int = 1
    name: str = "a"


def squares(n: int, log: Path) -> dict[str, np.ndarray]:
    """An entry, and a trace of every time one is built."""
    with log.open("a") as file:
        file.write(f"{n}\n")
    return {"squares": np.arange(n) ** 2, "n": np.array(n)}


# ------------------------------------------------------- keys


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


@pytest.mark.parametrize("value", [object(), {1, 2}, squares, np.array([None])])
def test_what_has_no_content_has_no_key(value: object) -> None:
    with pytest.raises(TypeError, match="cannot be hashed by its content"):
        fingerprint([value])


def test_keys_are_the_same_in_every_process() -> None:
    program = (
        "import numpy as np; from njf_models.datasets.cache import fingerprint;"
        "print(fingerprint({'b': 1, 'a': np.arange(3)}, 'x'))"
    )
    keys = {run(program, PYTHONHASHSEED=seed).stdout for seed in ("1", "2")}
    assert keys == {fingerprint({"a": np.arange(3), "b": 1}, "x") + "\n"}


# ------------------------------------------------------- entries


def test_what_is_stored_is_loaded(tmp_path: Path) -> None:
    cache = Cache("test", "1", tmp_path)
    entry = {
        "x": np.arange(6, dtype=np.float32).reshape(2, 3),
        "empty": np.zeros((0, 3), dtype=np.int64),
        "text": np.array("β"),
    }
    assert cache.load("key") is None
    cache.store("key", entry)
    loaded = cache.load("key")
    assert loaded is not None
    assert loaded.keys() == entry.keys()
    for name, array in entry.items():
        assert loaded[name].dtype == array.dtype
        np.testing.assert_array_equal(loaded[name], array)


def test_entries_are_built_once(tmp_path: Path) -> None:
    log = tmp_path / "log"
    tasks = [(n, log) for n in (3, 5, 3)]
    for _ in range(2):
        entries = Cache("test", "1", tmp_path).map(squares, tasks, n_jobs=1)
        assert [int(entry["n"]) for entry in entries] == [3, 5, 3]
        assert sorted(log.read_text().split()) == ["3", "5"]


def test_a_new_version_task_or_function_is_built_anew(tmp_path: Path) -> None:
    log = tmp_path / "log"
    Cache("test", "1", tmp_path).map(squares, [(3, log)], n_jobs=1)
    Cache("test", "2", tmp_path).map(squares, [(3, log)], n_jobs=1)
    Cache("other", "1", tmp_path).map(squares, [(3, log)], n_jobs=1)
    assert log.read_text().split() == ["3", "3", "3"]


def test_what_was_built_before_a_failure_is_kept(tmp_path: Path) -> None:
    log = tmp_path / "log"
    cache = Cache("test", "1", tmp_path)
    with pytest.raises(TypeError):
        cache.map(squares, [(3, log), ("not a number", log)], n_jobs=1)
    cache.map(squares, [(3, log)], n_jobs=1)
    assert log.read_text().split("\n").count("3") == 1


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped bit", "not a zip"])
def test_a_corrupt_entry_is_rebuilt_with_a_warning(tmp_path: Path, damage: str) -> None:
    log = tmp_path / "log"
    cache = Cache("test", "1", tmp_path)
    expected = cache.map(squares, [(50, log)], n_jobs=1)
    (path,) = cache.folder.glob("*.npz")
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 3] ^= 1
    path.write_bytes(
        {
            "empty": b"",
            "truncated": content[: len(content) // 2],
            "flipped bit": bytes(flipped),
            "not a zip": b"\x00" * len(content),
        }[damage]
    )
    with pytest.warns(UserWarning, match="is corrupt and will be rebuilt"):
        actual = cache.map(squares, [(50, log)], n_jobs=1)
    np.testing.assert_array_equal(actual[0]["squares"], expected[0]["squares"])
    assert log.read_text().split() == ["50", "50"]
    assert path.read_bytes() == content


def test_the_root_is_the_users_choice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DIFFPOISSON_CACHE", str(tmp_path / "mine"))
    assert Cache("test", "1").folder == tmp_path / "mine" / "test"
    monkeypatch.delenv("DIFFPOISSON_CACHE")
    assert default_root() == Path.home() / ".cache" / "diffpoisson"


def test_old_temporary_files_are_removed_and_new_ones_kept(tmp_path: Path) -> None:
    folder = Cache("test", "1", tmp_path).folder
    for name, age in ((".old.tmp", 2), (".new.tmp", 0)):
        (folder / name).touch()
        os.utime(folder / name, (time.time() - 86400 * age,) * 2)
    Cache("test", "1", tmp_path)
    assert [path.name for path in folder.iterdir()] == [".new.tmp"]


# ------------------------------------------------------- several processes

BUILDER = """
import os, sys, time
from pathlib import Path
import numpy as np
from njf_models.datasets.cache import Cache

def build(n):
    with open(sys.argv[2], "a") as log:
        log.write(f"{n}\\n")
    time.sleep(0.02)
    return {"x": np.full(20_000, n)}

entries = Cache("test", "1", Path(sys.argv[1])).map(build, [(n,) for n in range(40)], n_jobs=1)
print(sum(int(entry["x"].sum()) for entry in entries))
"""
EXPECTED = f"{20_000 * sum(range(40))}\n"


def run(program: str, *arguments: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        cwd=REPOSITORY,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )


def start(*arguments: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", BUILDER, *map(str, arguments)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )


def assert_sound(root: Path) -> None:
    """Every entry is complete, and no writer left anything else."""
    cache = Cache("test", "1", root)
    for path in cache.folder.iterdir():
        assert path.suffix == ".npz"
        assert cache.load(path.stem) is not None


def test_two_runs_at_once_share_a_cache(tmp_path: Path) -> None:
    processes = [start(tmp_path, tmp_path / f"log{k}") for k in range(2)]
    assert [process.communicate()[0] for process in processes] == [EXPECTED] * 2
    assert_sound(tmp_path)
    assert len(list((tmp_path / "test").iterdir())) == 40


def test_a_killed_run_is_resumed(tmp_path: Path) -> None:
    log = tmp_path / "log"
    process = start(tmp_path, log)
    while len(list(tmp_path.glob("test/*.npz"))) < 5:
        assert process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    finished = len(list(tmp_path.glob("test/*.npz")))
    assert 5 <= finished < 40
    started = len(log.read_text().split())
    assert run(BUILDER, tmp_path, log).stdout == EXPECTED
    # Nothing finished was built again, so at most the interrupted entry was built twice.
    assert len(log.read_text().split()) - started == 40 - finished


def test_a_run_killed_while_writing_leaves_no_entry(tmp_path: Path) -> None:
    program = """
import os, signal, sys
from pathlib import Path
import numpy as np
from njf_models.datasets import cache

def killed_halfway(file, **arrays):
    file.write(b"half an entry")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)

cache.np.savez = killed_halfway
cache.Cache("test", "1", Path(sys.argv[1])).store("key", {"x": np.zeros(3)})
"""
    with pytest.raises(subprocess.CalledProcessError):
        run(program, tmp_path)
    cache = Cache("test", "1", tmp_path)
    assert [path.suffix for path in cache.folder.iterdir()] == [".tmp"]
    assert cache.load("key") is None
    cache.store("key", {"x": np.ones(3)})
    assert cache.load("key") is not None
