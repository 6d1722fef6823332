"""Results as they are kept: `results/NAME.json`, one a benchmark, and RESULTS.md, made of all.

One that failed, or was left out, keeps its last figures, with the day and machine they were taken.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import RUNS
from sliplab.storage.files import read_json, write_text

FOLDER = Path(__file__).with_name("results")
PAGE = Path(__file__).with_name("RESULTS.md")
Result = dict[str, Any]


def keep(result: Result, names: Sequence[str], folder: Path = FOLDER, page: Path = PAGE) -> None:
    """Keep a result in the place of its last, and write the page anew, in the order of `names`."""
    folder.mkdir(exist_ok=True)
    # not sorted: figures stand in the order that their benchmark gives them
    write_text(folder / f"{result['name']}.json", json.dumps(result, indent=1) + "\n")
    there = [folder / f"{name}.json" for name in names]
    write_text(page, markdown([read_json(path) for path in there if path.exists()]))


def table(figures: dict[str, float | None]) -> list[tuple[str, str, str]]:
    """Figure, median and range as text, one row each."""
    rows = []
    for name, value in figures.items():
        if name.endswith(("_min", "_max")):
            continue
        low, high = figures.get(f"{name}_min"), figures.get(f"{name}_max")
        rows.append((name, _text(value), "" if low is None else f"{_text(low)} to {_text(high)}"))
    return rows


def markdown(results: Sequence[Result]) -> str:
    """All results as a page."""
    lines = [
        "# Benchmarks",
        "",
        "Written by `python -m benchmarks`; do not edit. Figures are medians of "
        f"{RUNS} rounds, in each of",
        "which all rivals ran in turn, with the lowest and the highest beside them; those of "
        "`clocks` are over 1,000 trains.",
        "What each figure means stands at the top of `benchmarks/NAME.py`. All data are simulated.",
    ]
    said: dict[str, None] = {}
    for each in results:
        taken = _taken(each)
        lines += ["", f"## {each['name']}", ""]
        if taken not in said:
            said[taken] = None
            lines += [taken, ""]
        else:
            lines += [f"As run {list(said).index(taken) + 1}.", ""]
        lines += ["| figure | median | range |", "| --- | ---: | --- |"]
        lines += [f"| {' | '.join(row)} |" for row in table(each["figures"])]
    return "\n".join(_numbered(lines, said)) + "\n"


def _taken(result: Result) -> str:
    where, used = result["machine"], result["versions"]
    return (
        f"{result['day']}, {where['cpu']}, {where['cores']} cores, {where['memory_gb']} GB, "
        f"{where['os']}; " + ", ".join(f"{name} {number}" for name, number in used.items()) + "."
    )


def _numbered(lines: Sequence[str], said: dict[str, None]) -> list[str]:
    """The runs by their numbers, where there is more than one."""
    runs = {text: f"**Run {number + 1}**: {text}" for number, text in enumerate(said)}
    return [runs.get(line, line) for line in lines]


def _text(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.3g}"


def as_line(result: Result) -> str:
    """One line of JSON."""
    return json.dumps(result, allow_nan=False)
