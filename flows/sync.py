"""`sliplab sync`: fit the clocks of every committed trial again, and show how good they are.

A trial's clocks are fitted when it is taken, by the program of that day. When fitting has improved
since, this step makes them again from the raw streams. The record stays as committed; where
the new clocks differ they are among the derived results, every later step reads them there, and
its results become stale exactly then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.clocks.refit import fit_again, sync_key
from sliplab.analysis.report.clock_page import render
from sliplab.analysis.report.clock_trials import (
    CampaignClocks,
    TrialClocks,
    campaign_clocks,
    read_trials,
)
from sliplab.analysis.report.clocks import PAGE
from sliplab.analysis.trial_work import TrialWork, stale_trials
from sliplab.flows.running import console
from sliplab.flows.running.parallel_map import run_trials
from sliplab.flows.steps import StepResult
from sliplab.protocols.shown import plural
from sliplab.storage.files import write_text
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import SYNC, StoreError, TrialStore

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

PAGE_VERSION = 1
COLUMNS = (
    "device",
    "grade",
    "median\n(µs)",
    "worst\n(µs)",
    "drift (ppm)",
    "missed /\nlate / spurious",
)
"""Columns of the tables for a terminal; uncertainties are of events against the device, both clocks
together; of events, their own."""


class SyncDone(StepResult):
    """Numbers of what `sync` did, and each campaign's clocks.

    Attributes:
        changed: trials whose clocks differ from those of the record.
        page: path of the page.
    """

    changed: int
    simulated: bool
    page: str
    campaigns: dict[str, CampaignClocks]


def sync(store: TrialStore, campaigns: list[Collected], cluster: Cluster | None = None) -> SyncDone:
    """Fit stale clocks, and write the page if anything on it has changed.

    Raises:
        StoreError: nothing but imported recordings, which have no sync pulses.
    """
    campaigns = [item for item in campaigns if item.recorded is None]
    if not campaigns:
        raise StoreError("imported recordings have no sync pulses: there are no clocks to fit")
    required = [
        TrialWork(recording, item.name, sync_key(recording))
        for item in campaigns
        for _, recording in item.trials
    ]
    stale = stale_trials(store, SYNC, required)
    run_trials(store, SYNC, "sync", stale, fit_again, cluster)
    for work in required:
        work.recording.forget_clocks()
    trials = {item.name: read_trials(store, item) for item in campaigns}
    page = _write_page(store, campaigns, required, trials)
    found = {
        name: campaign_clocks(of, sum(work.campaign == name for work in stale))
        for name, of in trials.items()
    }
    for name, of in trials.items():
        for trial in of:
            if trial.refused:
                console.say(f"warning: {name}: {trial.name}: {trial.doubt}")
    return {
        "step": SYNC,
        "done": len(stale),
        "fresh": len(required) - len(stale),
        "changed": sum(known["changed"] for known in found.values()),
        "simulated": store.simulated,
        "page": str(page),
        "campaigns": found,
    }


def _write_page(
    store: TrialStore,
    campaigns: Sequence[Collected],
    required: Sequence[TrialWork],
    trials: Mapping[str, Sequence[TrialClocks]],
) -> Path:
    path = store.folder / "report" / PAGE
    quarantined = [[item.name, item.campaign.quarantined()] for item in campaigns]
    shown = [[work.campaign, work.key] for work in required]
    key = make_key(SYNC, PAGE_VERSION, [shown, quarantined], None)
    stored = Derived.of(store, SYNC)
    if not stored.fresh("page", key) or not path.exists():
        path.parent.mkdir(exist_ok=True)
        write_text(path, render(campaigns, trials, simulated=store.simulated))
        stored.write("page", key, {})
    return path


def tables(result: SyncDone) -> list[tuple[str, list[list[str]]]]:
    """Return for each campaign a title, and rows under `COLUMNS`, of a result of `sync`."""
    found = []
    simulated = " (simulated)" if result["simulated"] else ""
    for campaign, known in result["campaigns"].items():
        rows = []
        for device, numbers in known["devices"].items():
            drift, pulses = numbers["drift_ppm"], numbers["pulses"]
            rows.append(
                [
                    device,
                    numbers["grade"],
                    f"{numbers['uncertainty_us']['median']:.1f}",
                    f"{numbers['uncertainty_us']['worst']:.1f}",
                    f"{drift[0]:.1f} to {drift[1]:.1f}",
                    "-" if pulses is None else " / ".join(map(str, pulses.values())),
                ]
            )
        trials = f"{plural(known['trials'], 'trial')}, {known['refitted']} refitted"
        title = f"Clocks of {campaign}{simulated}: {trials}, {known['changed']} changed"
        found.append((title, rows))
    return found
