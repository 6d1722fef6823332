"""Pending and excluded trials of a campaign; no collection takes excluded ones.

A trial is excluded if a person skipped it, or if its gates rejected it as often as it may be
retaken. `sliplab again` makes it pending.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

from sliplab.analysis.campaigns import Collected
from sliplab.flows.running import console
from sliplab.protocols import InputError, Plan, PlannedTrial
from sliplab.protocols.shown import plural
from sliplab.storage.trials.control import skipped
from sliplab.storage.trials.store import FORGIVEN, IMPORTED, Campaign, StoreError, TrialStore


def pending_trials(plan: Plan, campaign: Campaign) -> list[PlannedTrial]:
    """Return trials that are neither committed nor excluded, in the plan's order."""
    done = campaign.committed() | skipped(campaign).keys()
    failed = campaign.failed_attempts()
    retakes = plan.protocol.collection.gates.retakes
    return [t for t in plan if t.id not in done and failed.get(t.id, 0) <= retakes]


class ExcludedTrial(TypedDict):
    """A trial that no collection takes.

    Attributes:
        attempts: that failed.
        by: the person who skipped it, None if its gates rejected it; when: likewise.
    """

    trial: str
    cause: str
    attempts: int
    by: str | None
    when: str | None


class StoreExcludedTrial(ExcludedTrial):
    """An excluded trial with the name of its campaign."""

    campaign: str


def excluded_trials(
    plan: Plan, campaign: Campaign, committed: set[str] | None = None
) -> list[ExcludedTrial]:
    """Return trials of the plan that no collection takes, in its order, each with its cause.

    Args:
        committed: the committed trials, if they are known already.
    """
    done = campaign.committed() if committed is None else committed
    by_person, failed = skipped(campaign), campaign.failed_attempts()
    retakes = plan.protocol.collection.gates.retakes
    causes: dict[str, list[str]] = {}
    for item in campaign.quarantined():
        if str(item["cause"]).startswith("gate") and FORGIVEN not in item:
            causes.setdefault(item["trial"], []).append(str(item["cause"]))
    found: list[ExcludedTrial] = []
    for trial in plan:
        if trial.id in done:
            continue
        attempts, known = failed.get(trial.id, 0), by_person.get(trial.id)
        if known is not None:
            cause = known.get("why") or "no reason given"
        elif attempts > retakes:
            cause = "; then ".join(dict.fromkeys(causes[trial.id]))
        else:
            continue
        person = known or {}
        found.append(
            {
                "trial": trial.id,
                "cause": cause,
                "attempts": attempts,
                "by": person.get("who"),
                "when": person.get("when"),
            }
        )
    return found


def all_excluded(
    store: TrialStore, unreadable: list[str], committed: dict[str, set[str]] | None = None
) -> list[StoreExcludedTrial]:
    """List the excluded trials of all campaigns.

    Args:
        unreadable: gets a line for every campaign that cannot be read.
        committed: committed trials by campaign, if they are known already.
    """
    found: list[StoreExcludedTrial] = []
    for campaign in store.campaigns():
        try:
            if IMPORTED in campaign.info:  # it has no plan
                continue
            done = None if committed is None else committed.get(campaign.name, set())
            excluded = excluded_trials(Collected(campaign).plan, campaign, done)
        except (InputError, StoreError) as error:
            unreadable.append(f"campaign {campaign.name}: {error}")
            continue
        found += [{"campaign": campaign.name, **item} for item in excluded]
    return found


def print_excluded(excluded: Sequence[ExcludedTrial]) -> None:
    """Print the excluded trials as a table, if there are any."""
    if not excluded:
        return
    rows = [
        [
            item["trial"],
            item["by"] or f"gates, {plural(item['attempts'], 'attempt')}",
            item["cause"],
        ]
        for item in excluded
    ]
    console.print_table(
        f"{plural(len(rows), 'excluded trial')} (`sliplab again` retakes them)",
        ["trial", "by", "cause"],
        rows,
        limit=40,
    )
