"""Every committed trial of a store as one pandas table, units in the column names."""

from __future__ import annotations

from typing import Any

import pandas as pd

from storage.recording import Recording
from storage.store import Store, StoreError


def catalogue(store: Store, unreadable: list[str] | None = None) -> pd.DataFrame:
    """One row a committed trial: campaign, id, condition, counts, quality.

    Conditions become columns by factor; levels with a unit are numbers, the unit stands in the
    column's name (``depth_mm``), a slash in it as ``_per_``.

    Args:
        unreadable: gets a line for every trial that is damaged; without it, one is an error.

    Raises:
        StoreError: a trial is damaged.
    """
    rows: list[dict[str, Any]] = []
    for campaign in store.campaigns():
        if unreadable is not None:
            unreadable += [f"{trial}: {why}" for trial, why in campaign.damaged().items()]
        for recording in campaign.recordings():
            try:
                rows.append(_row(campaign.name, recording))
            except StoreError as error:
                if unreadable is None:
                    raise
                unreadable.append(str(error))
    return pd.DataFrame(rows)


def _row(campaign: str, recording: Recording) -> dict[str, Any]:
    record = recording.record
    return {
        "campaign": campaign,
        "trial": record["trial"],
        "experiment": record["experiment"],
        "role": record["role"],
        "repetition": record["repetition"],
        "block": record["block"],
        "attempt": record["attempt"],
        "simulated": record["simulated"],
        "recorded_s": record["recorded_s"],
        "events": record["counts"]["events"],
        "frames": record["counts"]["frames"],
        "frame_source": recording.frame_source,
        "sync_uncertainty_us": _us(recording.clocks["events"].get("uncertainty_ns")),
        "passed": record["quality"]["passed"],
        **_condition(record["condition"]),
    }


def _us(ns: float | None) -> float | None:
    """Unknown where a trial was imported."""
    return None if ns is None else ns / 1000


def _condition(condition: dict[str, str]) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    for name, text in condition.items():
        number, _, unit = text.partition(" ")
        if unit:
            columns[f"{name}_{unit.replace('/', '_per_')}"] = float(number)
        else:
            columns[name] = number
    return columns


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
