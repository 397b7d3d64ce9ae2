"""What the examples of the gallery cost, each run as a reader would run it.

`python -m tests.benchmarks.gallery_times` runs those that take a minute or so at their defaults,
one thread each, and writes `docs/results/gallery.json`; names of examples run only these (any of
them) and leave the rest of the file.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

ROOT = Path(__file__).parents[2]
RESULT = ROOT / "docs" / "results" / "gallery.json"
SHORT = ("unroll", "texel_density", "deform", "fit_source")


def measure(name: str, *options: str) -> dict[str, object]:
    """Seconds of the processor and of the wall that an example took, with the start of Python."""
    with tempfile.TemporaryDirectory() as folder:
        script = str(ROOT / "examples" / f"{name}.py")
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        subprocess.run(
            [sys.executable, script, *options, "--out", folder],
            check=True,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
        )
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "cpu seconds": spent,
        "seconds": wall,
        "load average": os.getloadavg()[0],
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, 1 thread of {os.cpu_count()} processors",
    }


def main(names: list[str]) -> None:
    results = json.loads(RESULT.read_text()) if RESULT.exists() else {}
    for name in names or SHORT:
        results[name] = measure(name)
        print(name, f"{results[name]['cpu seconds']:.0f} s of processor time", flush=True)
        RESULT.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
