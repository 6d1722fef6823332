"""A small store of recordings that show one of several classes, as an adapter imports them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.store import Campaign, TrialStore
from tests.analysis.foreign import commit_foreign

CLASSES = ("ball", "box 2", "box 10", "cup", "pen")
TAXELS = 6
LENGTH_MS = 120


def adapter(epochs: int = 1, **changes: Any) -> dict[str, Any]:
    """Return the head of an adapter, as plain data, for a quick training."""
    return {
        "adapter": 1,
        "name": "objects",
        "title": "Objects touched by a skin of six taxels",
        "about": {"licence": "CC0", "made by": "a test"},
        "experiment": "classes",
        "trials": {"files": "{part}_{object}_*.npy"},
        "streams": {
            "events": {"format": "counts", "axes": ["taxel", "polarity", "step"], "step_ms": 10}
        },
        "labels": {"class": "{object}"},
        "split": {"given": "part"},
        "analysis": {
            "windows": {
                "length_ms": LENGTH_MS,
                "step_ms": 10,
                "polarity": "both",
                "taxels": TAXELS,
            },
            "network": {
                "conv1_channels": 8,
                "conv1_kernel": 1,
                "conv2_channels": 16,
                "conv2_kernel": 1,
            },
            "training": {"epochs": epochs, "batch": 4, "mirror": False, "seeds": [0, 1]},
        },
        **changes,
    }


def events(rng: np.random.Generator, number: int, classes: int, begin_ms: int = 0) -> EventChunk:
    """Return events of `LENGTH_MS`: of each class another taxel is the busiest, in both halves."""
    rate = np.full((TAXELS, 2), 1.0)
    rate[number % TAXELS, number // TAXELS % 2] = 24.0
    rate[(number + 1) % TAXELS, 1] += 5.0 * (number / classes)
    counts = rng.poisson(rate)
    taxel, polarity = (
        np.repeat(index.ravel(), counts.ravel()) for index in np.indices(counts.shape)
    )
    t_us = np.sort(rng.integers(0, LENGTH_MS * 1000, len(taxel))) + begin_ms * 1000
    mixed = rng.permutation(len(taxel))
    return EventChunk(
        taxel[mixed].astype(np.uint16),
        np.zeros(len(taxel), np.uint16),
        polarity[mixed].astype(np.uint8),
        t_us,
    )


def add_trial(
    campaign: Campaign,
    name: str,
    chunk: EventChunk,
    spans: Sequence[tuple[int, int, str]],
    *,
    fields: Mapping[str, str],
    condition: Mapping[str, str] | None = None,
    simulated: bool = False,
) -> None:
    """Commit a trial whose label gives classes.

    Args:
        spans: start and end in ms, and the class.
    """
    given = [
        {"start_ns": start * 1_000_000, "end_ns": end * 1_000_000, "name": shown}
        for start, end, shown in spans
    ]
    origin = {
        "unknown": ["clocks"],
        "fields": dict(fields),
        "condition": dict(condition or {}),
        "span_ns": (0, max(end for _, end, _ in spans) * 1_000_000),
        "given": {"source": "file name", "spans": given},
    }
    commit_foreign(campaign, name, chunk, origin, (TAXELS, 1), simulated=simulated)


def begin_campaign(
    store: TrialStore, head: Mapping[str, Any], *, simulated: bool = False
) -> Campaign:
    """Make a campaign that keeps an adapter in place of a protocol."""
    campaign = store.campaign(head["name"])
    about = {"adapter": 1, "from": "data", "format": "adapter"}
    text = yaml.safe_dump(dict(head), sort_keys=False)
    campaign.update(
        {"name": campaign.name, "simulated": simulated, "imported": about},
        text,
        "imported: adapter\n",
    )
    return campaign


def class_store(
    folder: Path,
    classes: Sequence[str] = CLASSES,
    trials: Mapping[str, int] | None = None,
    head: Mapping[str, Any] | None = None,
    *,
    simulated: bool = False,
) -> TrialStore:
    """Make a store with one campaign.

    Args:
        trials: of each class, by part of the split.
        head: the adapter's.
    """
    store = TrialStore.create(folder)
    head = adapter() if head is None else head
    campaign = begin_campaign(store, head, simulated=simulated)
    rng = np.random.default_rng(1)
    each = {"train": 8, "validation": 3, "test": 4} if trials is None else trials
    for number, name in enumerate(classes):
        for part, count in each.items():
            for k in range(count):
                add_trial(
                    campaign,
                    f"{part}_{name.replace(' ', '-')}_{k}",
                    events(rng, number, len(classes)),
                    [(0, LENGTH_MS, name)],
                    fields={"part": part},
                    condition={"force": f"{1 + k % 2} N"},
                    simulated=simulated,
                )
    return store
