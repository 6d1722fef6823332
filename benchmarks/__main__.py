"""`python -m benchmarks [NAME] [--json]`: one benchmark, or all of them into RESULTS.md."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib import import_module
from typing import Any

from benchmarks.kept import PAGE, Result, as_line, keep, table
from benchmarks.measure import SEED, Figures, machine, versions

NAMES = (
    "storage",
    "scene",
    "clocks",
    "clock_kinds",
    "align",
    "labels",
    "labels_truth",
    "network",
    "live",
    "tips",
    "promise",
    "orchestration",
    "page",
    "acquisition",
    "record",
    "scale",
    "exchange_memory",
    "fewer",
    "statements",
)
LIMIT_S = 900


def result(name: str, **sizes: Any) -> Result:
    """One benchmark's figures, and on what they were taken; `sizes` go to its `measure`."""
    measure = import_module(f"benchmarks.{name}").measure
    figures: Figures = measure(**sizes)
    return {
        "name": name,
        "figures": {key: _rounded(value) for key, value in figures.items()},
        "versions": versions(),
        "machine": machine(),
        "day": datetime.now(UTC).date().isoformat(),
        "seed": SEED,
    }


def run_all() -> int:
    """Every benchmark in a process of its own, so that none warms or burdens another."""
    failed = []
    for name in NAMES:
        started = time.monotonic()
        print(f"{name} ...", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "benchmarks", name, "--json"]
        try:
            done = subprocess.run(
                command, cwd=PAGE.parents[1], stdout=subprocess.PIPE, timeout=LIMIT_S, check=True
            )
            keep(json.loads(done.stdout), NAMES)
            state = "done"
        except (subprocess.SubprocessError, ValueError) as error:
            failed.append(name)
            state = f"failed: {error}"
        print(f"{name} {state} ({time.monotonic() - started:.0f} s)", file=sys.stderr, flush=True)
    print(f"wrote {PAGE}", file=sys.stderr)
    if failed:
        print(f"with the last figures of {', '.join(failed)}, which failed", file=sys.stderr)
    return bool(failed)


def main() -> int:
    """Exit code 0, or 1 where a benchmark of all failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="?", choices=NAMES, help="left out: all, into RESULTS.md")
    parser.add_argument("--json", action="store_true", help="one line of JSON on standard output")
    parser.add_argument("--keep", action="store_true", help="its figures go into RESULTS.md")
    parser.add_argument("--v2e", metavar="FOLDER", help="v2e's source, for `scene`")
    parser.add_argument(
        "--size", action="append", default=[], metavar="NAME=N", help="of NAME, as seconds=3600"
    )
    wanted = parser.parse_args()
    if wanted.v2e:
        from benchmarks.emulator import SOURCE

        os.environ[SOURCE] = wanted.v2e
    if wanted.name is None:
        if wanted.json:
            parser.error("--json goes with a NAME")
        return run_all()
    sizes = dict(size.split("=", 1) for size in wanted.size)
    found = result(wanted.name, **{name: int(value) for name, value in sizes.items()})
    if wanted.keep:
        keep(found, NAMES)
    if wanted.json:
        print(as_line(found))
    else:
        for name, value, extent in table(found["figures"]):
            print(f"{name:32} {value:>12}  {extent}")
    return 0


def _rounded(value: float) -> float | None:
    """Five digits; JSON has neither infinity nor NaN."""
    return float(f"{value:.5g}") if abs(value) < float("inf") else None


if __name__ == "__main__":
    sys.exit(main())
