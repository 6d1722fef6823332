"""Every committed trial of a store as one pandas table, units in the column names."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pandas as pd

from sliplab.protocols.plan import condition_columns
from sliplab.storage.trials import catalogue_index
from sliplab.storage.trials.checksums import partial
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, Store, StoreError


def catalogue(store: Store, unreadable: list[str] | None = None) -> pd.DataFrame:
    """One row a committed trial: campaign, id, condition, counts, quality.

    Conditions become columns by factor; levels with a unit are numbers, the unit stands in the
    column's name (``depth_mm``), a slash in it as ``_per_``. Trials that have not changed since the
    catalogue was last asked for are not read again (`storage.trials.catalogue_index`).

    Args:
        unreadable: gets a line for every trial that is damaged; without it, one is an error.

    Raises:
        StoreError: a trial is damaged.
    """
    began_ns = time.time_ns()
    found = [(campaign, catalogue_index.Listing.of(campaign)) for campaign in store.campaigns()]
    known = catalogue_index.read(store) or catalogue_index.Known(pd.DataFrame())
    parts, problems = [], []
    for campaign, listing in found:
        part = _Part(campaign, listing, known)
        parts.append(part)
        problems += part.look(unreadable is None)
    if unreadable is not None:
        unreadable += problems
    names = [campaign.name for campaign, _ in found]
    if names == list(known.bounds) and not any(part.changed for part in parts):
        return known.table
    return _anew(store, parts, known, began_ns)


class _Part:
    """A campaign's part of the catalogue: what is known of it, and what has to be read.

    Attributes:
        kept: rows of what is known that are still right, by trial.
        sync: what stands for each trial's refitted clocks, taken before they are read.
    """

    def __init__(
        self, campaign: Campaign, listing: catalogue_index.Listing, known: catalogue_index.Known
    ) -> None:
        self.campaign, self.listing = campaign, listing
        low, high, stamp = known.bounds.get(campaign.name, (0, 0, ""))
        names, keys = known.names[low:high], known.keys[low:high]
        self.kept = dict(zip(names, range(low, high), strict=True))
        if names != listing.names or not np.array_equal(keys, listing.keys):
            now = dict(zip(listing.names, map(tuple, listing.keys.tolist()), strict=True))
            before = zip(names, map(tuple, keys.tolist()), strict=True)
            self.kept = {name: self.kept[name] for name, key in before if now.get(name) == key}
        same_clocks = bool(stamp) and stamp == listing.sync
        self.sync: dict[str, str] = {}
        if not same_clocks:
            old = known.sync()
            self.sync = {name: catalogue_index.sync_key(campaign, name) for name in listing.names}
            self.kept = {n: at for n, at in self.kept.items() if self.sync[n] == old[at]}
        self.fresh: dict[str, dict[str, Any]] = {}
        self.changed = len(self.kept) != high - low or not same_clocks

    def look(self, strict: bool) -> list[str]:
        """Read what is not known; returns a line for each trial that is damaged.

        Raises:
            StoreError: one is, and it is to be `strict`.
        """
        damaged, broken = [], []
        for name in self.listing.names:
            if name in self.kept:
                continue
            folder = self.campaign.folder / "trials" / name
            if (cause := partial(folder)) is not None:
                damaged.append(f"{name}: {cause}")
                continue
            self.sync.setdefault(name, catalogue_index.sync_key(self.campaign, name))
            clocks = catalogue_index.sync_folder(self.campaign) / f"{name}.json"
            try:
                self.fresh[name] = _row(self.campaign.name, Recording(folder, clocks))
            except StoreError as error:
                if strict:
                    raise
                broken.append(str(error))
        self.changed = self.changed or bool(self.fresh)
        return damaged + broken


def _anew(
    store: Store, parts: list[_Part], known: catalogue_index.Known, began_ns: int
) -> pd.DataFrame:
    """The table from what is known and what was read, which is all known from now on."""
    old_rows, old_sync = known.rows(), known.sync()
    rows: list[dict[str, Any]] = []
    sync: list[str] = []
    keys: list[Any] = []
    new = catalogue_index.Known(pd.DataFrame())
    for part in parts:
        first = len(rows)
        for name, key in zip(part.listing.names, part.listing.settled(began_ns), strict=True):
            at = part.kept.get(name)
            if at is None and name not in part.fresh:
                continue  # damaged
            rows.append(part.fresh[name] if at is None else old_rows[at])
            sync.append(part.sync[name] if at is None else old_sync[at])
            new.names.append(name)
            keys.append(key)
        new.bounds[part.campaign.name] = (first, len(rows), part.listing.sync)
    table = pd.DataFrame(rows)
    if rows:
        new.keys = np.array(keys, np.int64).reshape(-1, 2)
        catalogue_index.write(store, table, rows, sync, new)
    return table


def _row(campaign: str, recording: Recording) -> dict[str, Any]:
    record, uncertainty_ns = recording.record, recording.clocks.against_events_ns("events")
    return {
        "campaign": campaign,
        "trial": record.trial,
        "experiment": record.experiment,
        "role": record.role,
        "repetition": record.repetition,
        "block": record.block,
        "attempt": record.attempt,
        "simulated": record.simulated,
        "recorded_s": record.recorded_s,
        "events": record.counts.events,
        "frames": record.counts.frames,
        "frame_source": recording.frame_source,
        "sync_uncertainty_us": None if uncertainty_ns is None else uncertainty_ns / 1000,
        "passed": record.quality.passed,
        **condition_columns(record.condition),
    }


def query(table: pd.DataFrame, expression: str) -> pd.DataFrame:
    """Rows for which a pandas expression holds, such as ``depth_mm > 2.8 and events > 1000``.

    Raises:
        ValueError: the expression cannot be read, or names something besides columns.
    """
    if "@" in expression or "__" in expression:
        raise ValueError("must use columns, numbers, text and operators only")
    try:
        return table.query(expression, engine="python", local_dict={}, global_dict={})
    except Exception as error:
        columns = ", ".join(map(str, table.columns))
        raise ValueError(f"cannot be read ({error}); the columns are {columns}") from None
