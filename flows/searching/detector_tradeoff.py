"""`sliplab tradeoff --detector`: what a detector's speed costs in errors, over a store's trials.

A factorial in two stages. Window length, step, pooling and width need a training each, with every
seed; stride, precision, smoothing and margin are read off the same networks. Each run is kept when
it is made, so that a search may be stopped and gone on with, and made larger later.
"""

from __future__ import annotations

import csv
import io
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.flows.labelling.reviewed import Labels
from sliplab.flows.running import console
from sliplab.flows.searching.detector_tradeoff_compare import comparisons
from sliplab.flows.searching.detector_tradeoff_data import Ask, Data
from sliplab.flows.searching.detector_tradeoff_estimate import estimate
from sliplab.flows.searching.detector_tradeoff_grid import Axes, Setting, make_grid
from sliplab.flows.searching.detector_tradeoff_page import render
from sliplab.flows.searching.detector_tradeoff_rows import OBJECTIVES, make_rows, pair_table
from sliplab.flows.searching.detector_tradeoff_runs import Kept, Run, make_run
from sliplab.flows.searching.detector_tradeoff_text import flat
from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_json, write_text
from sliplab.storage.trials.store import Store

PAGE, NUMBERS, TABLE = (f"detector_tradeoff.{kind}" for kind in ("html", "json", "csv"))


class Search:
    """What is asked of a store, found before anything is computed.

    Args:
        full: every value of the factors with every other.
        reviewed: people's decisions are applied to the labels.

    Raises:
        InputError: a value that no network can have.
        StoreError: trials or labels are missing.
    """

    def __init__(
        self,
        store: Store,
        campaigns: list[Collected],
        ask: Ask,
        axes: Axes,
        full: bool = False,
        reviewed: bool = False,
    ) -> None:
        self.store, self.ask, self.full = store, ask, full
        self.data = Data(Labels(store, reviewed), campaigns, ask)
        base = self.data.settings
        self.grid = make_grid(axes, base.windows, base.network, full)
        self.kept = Kept(self.data)
        # all settings with one seed, then with the next: a search that was stopped has them all
        self.runs = [
            make_run(self.data, setting, seed)
            for seed in range(ask.seeds)
            for setting in self.grid.settings
        ]

    @property
    def pending(self) -> list[Run]:
        """Runs that are not kept."""
        return [run for run in self.runs if not self.kept.done(run)]

    @cached_property
    def estimated(self) -> dict[str, dict[str, float]]:
        """Seconds that each pending run will take, by name and part."""
        found: dict[str, dict[str, float]] = {}
        of: dict[Setting, dict[str, float]] = {}
        pending = self.pending
        with console.bar("estimate (runs)", len(pending)) as bar:
            for run in pending:
                if run.setting not in of or self.kept.model_path(run).exists():
                    like = [other for other in self.runs if other.setting == run.setting]
                    of[run.setting] = estimate(self.kept, run, like)
                found[run.name] = of[run.setting]
                bar.advance()
        return found

    @property
    def estimated_s(self) -> float:
        """Of all that was pending when it was first asked for."""
        return sum(sum(parts.values()) for parts in self.estimated.values())

    def plan(self) -> dict[str, Any]:
        """What there is to do."""
        pending = len(self.pending)
        return {
            "step": "tradeoff",
            "simulated": self.store.simulated,
            "settings": [setting.as_dict() for setting in self.grid.settings],
            "left_out": self.grid.left_out,
            "runs": len(self.runs),
            "kept": len(self.runs) - pending,
            "pending": pending,
        }

    def make(self, over: Callable[[], bool]) -> int:
        """Make pending runs, each kept when it is done; how many.

        Args:
            over: asked before each; no other is begun where it says so.
        """
        made = 0
        with console.bar("trade-off (s, estimated)", round(self.estimated_s)) as bar:
            for run in self.pending:
                if over():
                    break
                self._one(run, bar)
                made += 1
        return made

    def _one(self, run: Run, bar: console.Bar) -> None:
        whole = self.estimated[run.name]
        left = dict(whole)

        def advance(part: str, share: float, note: str) -> None:
            step = min(left[part], share * whole[part])
            left[part] -= step
            bar.advance(step, note)

        self.kept.make(run, advance)
        bar.advance(sum(left.values()), run.words)

    def result(self) -> dict[str, Any]:
        """All numbers of what is kept."""
        with console.bar("judge (settings)", len(self.grid.settings)) as bar:
            rows, left_out = make_rows(self.data, self.kept, self.runs, bar.advance)
        base = self.data.settings
        parts = ("train", "validation", "test", "falling")
        return {
            **self.plan(),
            "full": self.full,
            "left_out": {**self.grid.left_out, **left_out},
            "ask": asdict(self.ask),
            "trials": {name: len(getattr(self.data, name)) for name in parts},
            "windows": base.windows.model_dump(mode="json"),
            "false_early_ms": base.detection.false_early_ms,
            "false_early_rate": base.detection.false_early_rate,
            "objectives": {k: "low" if sign > 0 else "high" for k, sign in OBJECTIVES.items()},
            "rows": rows,
            "comparisons": comparisons(rows),
            "pairs": pair_table(self.data, self.kept, self.runs),
            "warnings": self._warnings(),
        }

    def _warnings(self) -> dict[str, list[str]]:
        """What is wrong with kept networks, by run."""
        there = [run for run in self.runs if self.kept.done(run)]
        found = {run.words: self.kept.derived.read(run.name)["warnings"] for run in there}
        return {words: warnings for words, warnings in found.items() if warnings}


def detector_tradeoff(
    store: Store,
    campaigns: list[Collected],
    folder: Path,
    ask: Ask,
    axes: Axes,
    full: bool = False,
    reviewed: bool = False,
    minutes: float | None = None,
    dry_run: bool = False,
) -> dict[str, Any]:
    """Make what is missing, and write page, numbers and table into `folder`.

    Args:
        minutes: no run is begun after so many; the page is of what is there then.
        dry_run: only say what there is to do, and how long it would take.

    Returns:
        the numbers and how many runs were ``made`` for them, or what there is to do and
        `estimated_s`.

    Raises:
        InputError: a value that no network can have, or a `folder` that is no folder.
        StoreError: trials or labels are missing.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("--out", "", str(folder), "must be a folder")
    search = Search(store, campaigns, ask, axes, full, reviewed)
    for words, why in search.grid.left_out.items():
        console.say(f"left out: {words}: {why}")
    plan = search.plan()
    message = (
        f"{plan['runs']} trainings ({len(search.grid.settings)} settings, {ask.seeds} seeds), "
        f"{plan['kept']} of them kept"
    )
    made = 0
    if minutes == 0 and not dry_run:
        console.say(message)
    else:
        seconds = search.estimated_s
        console.say(f"{message}; the others take about {console.duration(seconds)}")
        if dry_run:
            return {**plan, "estimated_s": round(seconds, 1)}
        began = time.monotonic()
        made = search.make(lambda: minutes is not None and time.monotonic() - began >= 60 * minutes)
    result = search.result()
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / NUMBERS, result)
    write_text(folder / TABLE, as_csv(result))
    write_text(folder / PAGE, render(result))
    return {**result, "made": made}


def as_csv(result: dict[str, Any]) -> str:
    """All rows with units in the names of the columns."""
    text = io.StringIO()
    rows = [flat(row, result["simulated"]) for row in result["rows"]]
    writer = csv.DictWriter(text, list(rows[0]) if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
