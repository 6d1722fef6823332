"""Trials that no collection takes, with their causes, for people."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.flows.planning.run_request import set_aside
from sliplab.flows.running import console
from sliplab.protocols import InputError
from sliplab.storage.trials.store import IMPORTED, Store, StoreError


def all_aside(
    store: Store, unreadable: list[str], committed: dict[str, set[str]] | None = None
) -> list[dict[str, Any]]:
    """List set-aside trials of each campaign; see `flows.planning.run_request.set_aside`.

    Args:
        unreadable: gets a line for every campaign that cannot be read.
        committed: whole trials by campaign, for whoever knows them already.
    """
    found = []
    for campaign in store.campaigns():
        try:
            if IMPORTED in campaign.info:  # nobody plans them
                continue
            done = None if committed is None else committed.get(campaign.name, set())
            aside = set_aside(Collected(campaign).plan, campaign, done)
        except (InputError, StoreError) as error:
            unreadable.append(f"campaign {campaign.name}: {error}")
            continue
        found += [{"campaign": campaign.name, **item} for item in aside]
    return found


def show_aside(aside: list[dict[str, Any]]) -> None:
    """A table of trials that were set aside; nothing when there are none."""
    if not aside:
        return
    rows = [
        [item["trial"], item["by"] or f"gates, {item['attempts']} attempts", item["cause"]]
        for item in aside
    ]
    console.print_table(
        f"{len(rows)} trials set aside (`sliplab again` takes them)",
        ["trial", "by", "cause"],
        rows,
        limit=40,
    )
