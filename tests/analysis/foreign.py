"""Campaigns as an adapter leaves them in a store, written directly."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.schema import trial as schema
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import Campaign, TrialStore


def chunk(t_us: Any, x: Any = 0, y: Any = 0, p: Any = 1) -> EventChunk:
    """Events at these times."""
    times = np.asarray(t_us, np.int64)
    columns = (np.broadcast_to(np.asarray(each), times.shape) for each in (x, y, p))
    x_, y_, p_ = columns
    return EventChunk(x_.astype(np.uint16), y_.astype(np.uint16), p_.astype(np.uint8), times)


_FILES = "\ntrials: {files: '*.raw'}\nstreams: {events: {format: raw}}\n"


def foreign_campaign(
    folder: Path,
    adapter: str,
    trials: Mapping[str, tuple[EventChunk, Mapping[str, Any]]],
    *,
    event_px: tuple[int, int] = (4, 1),
    experiment: str = "classes",
    name: str = "touch",
) -> Collected:
    """Write a campaign of a store, each trial with its events and its `imported` part.

    Args:
        adapter: without `trials` and `streams`, which nothing but the import reads.
        trials: by id; a part without ``span_ns`` gets one second.
    """
    campaign = TrialStore.create(folder).campaign(name)
    about = {"adapter": 1, "from": "data", "format": "adapter", "when": "2026-11-24T00:00:00Z"}
    info: Any = {"name": name, "simulated": False, "experiment": experiment, "imported": about}
    campaign.update(info, adapter + _FILES, "# No rig.\n")
    for trial, (events, origin) in trials.items():
        commit_foreign(campaign, trial, events, origin, event_px, experiment)
    return Collected(campaign)


def commit_foreign(
    campaign: Campaign,
    trial: str,
    events: EventChunk,
    origin: Mapping[str, Any],
    event_px: tuple[int, int],
    experiment: str = "classes",
    *,
    simulated: bool = False,
) -> None:
    """Commit a trial.

    Args:
        origin: its `imported` part, and ``condition``; without ``span_ns`` it gets one second.
    """
    clock = schema.DeviceRecord(grade="unknown", map=IDENTITY, uncertainty_ns=None)
    span = origin.get("span_ns", (0, 1_000_000_000))
    writer = campaign.begin(trial, None, 100)
    writer.add("events", events)
    imported = {key: value for key, value in origin.items() if key != "condition"}
    data = (
        {"format": 1, "trial": trial, "campaign": campaign.name, "experiment": experiment}
        | {"role": "imported", "block": 0, "repetition": 0, "attempt": 0, "simulated": simulated}
        | {"condition": dict(origin.get("condition", {})), "recorded_s": (span[1] - span[0]) / 1e9}
        | {"counts": schema.StreamCounts(events=len(events), frames=0, poses=0, pulses=0)}
        | {"clocks": schema.TrialClockMaps(reference="event camera", events=clock)}
        | {
            "quality": schema.TrialQuality(passed=True),
            "geometry": schema.Geometry(event_px=event_px),
        }
        | {"imported": {"format": "adapter", "from": trial, "span_ns": span, **imported}}
    )
    record = schema.TrialRecord.model_validate(data)
    writer.commit(record, schema.Provenance.model_validate({"imported": "now", "from": trial}))
