"""What one thread of this machine can do at best, and what memory something takes.

Bandwidths and operations per second are the best of several tries: a limit is what is possible, and
other processes only take from it.
"""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch

OUT_OF_CACHE = 1 << 30  # bytes, several times any last-level cache


def _best_seconds(work: Callable[[], object], tries: int = 7, at_least: float = 0.01) -> float:
    work()
    start = time.process_time()
    work()
    repeats = max(1, round(at_least / max(time.process_time() - start, 1e-7)))
    best = float("inf")
    for _ in range(tries):
        start = time.process_time()
        for _ in range(repeats):
            work()
        best = min(best, (time.process_time() - start) / repeats)
    return best


@cache
def bandwidth(working_set: int = OUT_OF_CACHE) -> float:
    """Bytes per second of a triad a = b + 2 c whose three arrays take this many bytes together.

    Of small working sets it is that of the caches. (What a store reads first is not counted, as in
    the STREAM benchmark.)
    """
    n = max(working_set // 24, 1)
    a, b, c = torch.zeros(3, n, dtype=torch.float64).unbind()
    return 24 * n / _best_seconds(lambda: torch.add(b, c, alpha=2, out=a))


@cache
def read_bandwidth(working_set: int = OUT_OF_CACHE) -> float:
    """Bytes per second of a dot product whose two arrays take this many bytes together."""
    n = max(working_set // 16, 1)
    a, b = torch.ones(2, n, dtype=torch.float64).unbind()
    return 16 * n / _best_seconds(lambda: torch.dot(a, b))


@cache
def peak_flops(dtype: torch.dtype, n: int = 1536) -> float:
    """Operations per second of a large matrix product, multiplications and additions."""
    a, b = torch.ones(2, n, n, dtype=dtype).unbind()
    return 2 * n**3 / _best_seconds(lambda: a @ b, tries=5)


class _Mallinfo(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keep".split()
    ]


def heap_bytes() -> int:
    """Bytes that malloc has handed out and that were not freed, by glibc's own count.

    Raises:
        AttributeError: the C library is not glibc 2.33 or newer.
    """
    mallinfo = ctypes.CDLL(None).mallinfo2
    mallinfo.restype = _Mallinfo
    info = mallinfo()
    return int(info.uordblks + info.hblkhd)


def growth_of_heap(make: Callable[[], object]) -> tuple[object, int]:
    """What a function makes, and the heap memory that it keeps."""
    gc.collect()
    before = heap_bytes()
    made = make()
    gc.collect()
    return made, heap_bytes() - before


def peak_memory(work: Callable[[], object]) -> int:
    """Bytes by which resident memory rises at most while some work runs; on Linux.

    Memory that malloc kept from earlier work is given back before, or the work would reuse it.
    """
    work()  # one-time buffers of libraries are none of its own
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = _status("VmRSS")
    work()
    return _status("VmHWM") - before


def _status(name: str) -> int:
    """A line of this process's status in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    raise ValueError(f"no {name} in /proc/self/status")
