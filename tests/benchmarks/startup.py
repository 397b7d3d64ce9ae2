"""What `import diffpoisson` takes, in processes of their own."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from tests.benchmarks.harness import Figure, cost, main


def imports(quick: bool) -> Iterator[Figure]:
    """Processor time of a process that imports the package, against one that imports torch.

    Files are in the system's cache, compiled: each has run once before.
    """
    names = {"ours": "diffpoisson", "import torch": "torch"}
    for name in names.values():
        _import_seconds(name)
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(1 if quick else 15):
        for name in sorted(names, reverse=bool(turn % 2)):
            seconds[name].append(_import_seconds(names[name]))
    arrays = {name: np.array(values) for name, values in seconds.items()}
    yield cost("cold start, import diffpoisson", arrays, "import torch", 1.25)


def _import_seconds(name: str) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", f"import {name}"], check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


MEASUREMENTS = {"imports": imports}

if __name__ == "__main__":
    main("startup", MEASUREMENTS)
