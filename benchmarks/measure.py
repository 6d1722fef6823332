"""Alternating timings, their summary, and what they were taken on.

Rivals are timed in turn (A B A B ...), so that whatever else slows the machine slows them alike.
A figure is the median of the runs; `NAME_min` and `NAME_max` stand beside it where that matters.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from statistics import median

SEED = 1
RUNS = 5
PACKAGES = (
    "sliplab",
    "numpy",
    "scipy",
    "numba",
    "h5py",
    "hdf5plugin",
    "av",
    "opencv-contrib-python-headless",
    "torch",
    "sinabs",
    "prefect",
    "pypylon",
    "dv-processing",
    "bluesky",
    "pandas",
    "pyarrow",
    "snntorch",
    "spikingjelly",
    "norse",
    "tonic",
)

Figures = dict[str, float]
Seconds = list[float]


def alternate(runs: int, **rivals: Callable[[], object]) -> dict[str, Seconds]:
    """Seconds of each rival in each of `runs` rounds, after one round that does not count."""
    taken: dict[str, Seconds] = {name: [] for name in rivals}
    for number in range(runs + 1):
        for name, work in rivals.items():
            started = time.perf_counter()
            work()
            passed = time.perf_counter() - started
            if number:
                taken[name].append(passed)
    return taken


def spread(name: str, values: Seconds) -> Figures:
    """Median, lowest and highest value under `name`, `name_min` and `name_max`."""
    return {name: median(values), f"{name}_min": min(values), f"{name}_max": max(values)}


def rate(name: str, amount: float, seconds: Seconds) -> Figures:
    """`amount` a second of each run; see `spread`."""
    return spread(name, [amount / each for each in seconds])


def ratio(name: str, slow: Seconds, fast: Seconds) -> Figures:
    """Return the speed-up of `fast` over `slow` from the pairs of each round; see `spread`."""
    return spread(name, [a / b for a, b in zip(slow, fast, strict=True)])


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this thread, and those it starts, on one core (where the system can do that)."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def peak_mb() -> float:
    """The most memory this process has held, MB; NaN where the system does not tell.

    Not from getrusage, whose peak begins with that of the process that started this one.
    """
    peak = _from_file("/proc/self/status", "VmHWM")
    return float(peak.split()[0]) * 1024 / 1e6 if peak else float("nan")


def resident_mb(pid: int | None = None) -> float:
    """The memory that a process, by default this one, holds now, MB; NaN where nobody tells."""
    held = _from_file(f"/proc/{pid or 'self'}/status", "VmRSS")
    return float(held.split()[0]) * 1024 / 1e6 if held else float("nan")


def queued_s() -> float:
    """For how long this thread has waited for a processor so far, s; 0 where nobody tells."""
    try:
        with open("/proc/thread-self/schedstat", encoding="ascii") as file:
            return int(file.read().split()[1]) / 1e9
    except (OSError, IndexError):
        return 0.0


def versions() -> dict[str, str]:
    """Of Python and of the packages that matter."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def machine() -> dict[str, str | int | float]:
    """Processor, cores that may be used, memory and operating system."""
    try:
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    except OSError:
        system = platform.platform()
    memory = _from_file("/proc/meminfo", "MemTotal")
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    else:
        cores = os.cpu_count() or 0
    return {
        "cpu": _from_file("/proc/cpuinfo", "model name") or platform.processor() or "unknown",
        "cores": cores,
        "memory_gb": round(int(memory.split()[0]) * 1024 / 1e9, 1) if memory else 0.0,
        "os": system,
    }


def _from_file(path: str, key: str) -> str:
    """The value of the first line `key: value`; nothing where there is none."""
    try:
        with open(path, encoding="utf-8") as file:
            for line in file:
                name, _, value = line.partition(":")
                if name.strip() == key:
                    return value.strip()
    except OSError:
        pass
    return ""
