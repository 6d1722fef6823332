"""`sliplab tradeoff`: speed of a detector against its errors, over a store's trials.

A search is stored run by run, so it may be stopped, resumed, and made larger later.
"""

from __future__ import annotations

import time
from pathlib import Path

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.study import Finding
from sliplab.flows.running import console
from sliplab.plugins.studies.detector.document import DetectorTradeoff
from sliplab.plugins.studies.detector.grid import Axes, make_grid
from sliplab.plugins.studies.detector.rows import plan, search_result, table
from sliplab.plugins.studies.detector.search import STEP, DetectorSearch, SearchSize, search_trials
from sliplab.protocols.errors import InputError
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

STEM = "detector_tradeoff"


def detector_search(
    store: TrialStore,
    campaigns: list[Collected],
    size: SearchSize,
    axes: Axes,
    full: bool = False,
    reviewed: bool = False,
) -> DetectorSearch:
    """Return the search that is requested; nothing is computed yet.

    Args:
        full: every value of the factors with every other.
        reviewed: people's decisions are applied to the labels.

    Raises:
        InputError: a value that no network can have.
        StoreError: trials or labels are missing.
    """
    trials = search_trials(StoreLabels(store, reviewed), campaigns, size)
    grid = make_grid(axes, trials.settings.windows, trials.settings.network, full)
    return DetectorSearch(trials, grid, size, Derived.of(store, STEP))


def tradeoff_detector(
    store: TrialStore,
    campaigns: list[Collected],
    folder: Path,
    size: SearchSize,
    axes: Axes,
    full: bool = False,
    reviewed: bool = False,
    minutes: float | None = None,
    dry_run: bool = False,
) -> Finding[DetectorTradeoff]:
    """Train what is missing, and write the table of means into `folder`.

    Args:
        folder: of page, numbers and table.
        full: every value of the factors with every other.
        reviewed: people's decisions are applied to the labels.
        minutes: no run is started after so many; the page then shows the finished ones.
        dry_run: only plan: report the pending work and its estimated time.

    Returns:
        the numbers, named ``made`` how many trainings were made for them; or a plan.

    Raises:
        InputError: a value that no network can have, or a `folder` that is not a folder.
        StoreError: trials or labels are missing.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError("--out", "", str(folder), "must be a folder")
    search = detector_search(store, campaigns, size, axes, full, reviewed)
    settings = search.grid.settings
    for title, why in search.grid.left_out.items():
        console.say(f"left out: {title}: {why}")
    to_do = plan(search, store.simulated)
    message = (
        f"{to_do['runs']} trainings ({len(settings)} settings, {size.seeds} seeds), "
        f"{to_do['kept']} of them kept"
    )
    made = 0
    if minutes == 0 and not dry_run:
        console.say(message)
    else:
        with console.bar("estimate (runs)", to_do["pending"]) as bar:
            expected = search.sweep.expected(bar.advance)
        seconds = sum(sum(parts.values()) for parts in expected.values())
        console.say(f"{message}; the others take about {console.duration(seconds)}")
        if dry_run:
            planned = {**to_do, "estimated_s": round(seconds, 1)}
            return Finding(DetectorTradeoff.model_validate(planned), folder, dry=True)
        began = time.monotonic()
        with console.bar("trade-off (s, estimated)", round(seconds)) as bar:
            made = search.sweep.run(
                bar.advance,
                expected,
                over=lambda: minutes is not None and time.monotonic() - began >= 60 * minutes,
            )
    with console.bar("judge (settings)", len(settings)) as bar:
        result = search_result(search, full, store.simulated, bar.advance)
    make_folder(folder)
    means = table(result.rows, store.simulated).to_csv(index=False, lineterminator="\n")
    write_text(folder / f"{STEM}.csv", means)
    return Finding(result, folder, STEM, named={"made": made})
