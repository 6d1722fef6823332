"""`python -m benchmarks [NAME] [--json]`: one benchmark, or all of them into RESULTS.md."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.measure import RUNS, SEED, Figures, machine, versions

NAMES = (
    "storage", "scene", "clocks", "labels", "labels_truth", "network", "live", "orchestration",
    "acquisition", "scale",
)  # fmt: skip
RESULTS = Path(__file__).with_name("RESULTS.md")
LIMIT_S = 900
Result = dict[str, Any]


def result(name: str, **sizes: Any) -> Result:
    """One benchmark's figures, and on what they were taken; `sizes` go to its `measure`."""
    measure = import_module(f"benchmarks.{name}").measure
    figures: Figures = measure(**sizes)
    return {
        "name": name,
        "figures": {key: _rounded(value) for key, value in figures.items()},
        "versions": versions(),
        "machine": machine(),
        "seed": SEED,
    }


def table(figures: dict[str, float | None]) -> list[tuple[str, str, str]]:
    """Figure, median and range as text, one row each."""
    rows = []
    for name, value in figures.items():
        if name.endswith(("_min", "_max")):
            continue
        low, high = figures.get(f"{name}_min"), figures.get(f"{name}_max")
        rows.append((name, _text(value), "" if low is None else f"{_text(low)} to {_text(high)}"))
    return rows


def markdown(results: list[Result], day: str) -> str:
    """All results as a page."""
    if not results:
        return "# Benchmarks\n\nNone ran to its end.\n"
    where, used = results[0]["machine"], results[0]["versions"]
    lines = [
        "# Benchmarks",
        "",
        f"Written by `python -m benchmarks` on {day}; do not edit. Figures are medians of {RUNS} "
        "rounds, in each of",
        "which all rivals ran in turn, with the lowest and the highest beside them; those of "
        "`clocks` are over 1,000 trains.",
        "What each figure means stands at the top of `benchmarks/NAME.py`. All data are simulated.",
        "",
        f"**Machine**: {where['cpu']}, {where['cores']} cores, {where['memory_gb']} GB, "
        f"{where['os']}.",
        "",
        "**Versions**: " + ", ".join(f"{name} {number}" for name, number in used.items()) + ".",
    ]
    for each in results:
        lines += [
            "",
            f"## {each['name']}",
            "",
            "| figure | median | range |",
            "| --- | ---: | --- |",
        ]
        lines += [f"| {' | '.join(row)} |" for row in table(each["figures"])]
    return "\n".join(lines) + "\n"


def run_all() -> int:
    """Every benchmark in a process of its own, so that none warms or burdens another."""
    results, failed = [], []
    for name in NAMES:
        started = time.monotonic()
        print(f"{name} ...", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "benchmarks", name, "--json"]
        try:
            done = subprocess.run(
                command, cwd=RESULTS.parents[1], stdout=subprocess.PIPE, timeout=LIMIT_S, check=True
            )
            results.append(json.loads(done.stdout))
            state = "done"
        except (subprocess.SubprocessError, ValueError) as error:
            failed.append(name)
            state = f"failed: {error}"
        print(f"{name} {state} ({time.monotonic() - started:.0f} s)", file=sys.stderr, flush=True)
    if failed:
        print(f"{RESULTS.name} is as it was: {', '.join(failed)} failed", file=sys.stderr)
        return 1
    RESULTS.write_text(markdown(results, datetime.now(UTC).date().isoformat()))
    print(f"wrote {RESULTS}", file=sys.stderr)
    return 0


def main() -> int:
    """Exit code 0, or 1 where a benchmark of all failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="?", choices=NAMES, help="left out: all, into RESULTS.md")
    parser.add_argument("--json", action="store_true", help="one line of JSON on standard output")
    wanted = parser.parse_args()
    if wanted.name is None:
        if wanted.json:
            parser.error("--json goes with a NAME")
        return run_all()
    found = result(wanted.name)
    if wanted.json:
        print(json.dumps(found, allow_nan=False))
    else:
        for name, value, extent in table(found["figures"]):
            print(f"{name:32} {value:>12}  {extent}")
    return 0


def _rounded(value: float) -> float | None:
    """Five digits; JSON has neither infinity nor NaN."""
    return float(f"{value:.5g}") if abs(value) < float("inf") else None


def _text(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


if __name__ == "__main__":
    sys.exit(main())
