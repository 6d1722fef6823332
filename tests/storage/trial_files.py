"""Small trials with known content, written through the real writer."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.storage.schema.trial import Provenance, TrialRecord
from sliplab.storage.streams import EventChunk, FrameChunk, PoseChunk, PulseChunk
from sliplab.storage.trials.store import Campaign, TrialStore
from sliplab.storage.trials.writer import TrialWriter

IDENTITY = {"device_ns": [0], "reference_ns": [0], "drift": [0]}
FRAME = (48, 32)


def events(count: int, seed: int = 0, start_us: int = 5_000_000) -> EventChunk:
    """Random events about 100 us apart, some at the same time."""
    rng = np.random.default_rng(seed)
    times = start_us + np.cumsum(rng.integers(0, 200, count))
    return EventChunk(
        rng.integers(0, 640, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        times.astype(np.int64),
    )


def frames(count: int, seed: int = 0) -> FrameChunk:
    """Random frames at 100 a second."""
    rng = np.random.default_rng(seed)
    times = np.arange(count, dtype=np.int64) * 10_000_000
    return FrameChunk(
        rng.integers(0, 256, (count, FRAME[1], FRAME[0])).astype(np.uint8),
        np.arange(count, dtype=np.int64),
        times,
        times,
        np.ones(count, np.uint8),
    )


def fill(
    writer: TrialWriter, count: int = 1000, pieces: int = 3, *, with_frames: bool = True
) -> None:
    """Write events, pulses, poses and frames in some pieces."""
    whole = events(count)
    edges = np.linspace(0, count, pieces + 1).astype(int)
    for low, high in pairwise(edges):
        rows = slice(low, high)
        writer.add("events", whole[rows])
    times = np.arange(10, dtype=np.int64)
    writer.add("events", PulseChunk(times))
    writer.add("arm", PulseChunk(times))
    writer.add("sync_box", PulseChunk(times))
    writer.add("arm", PoseChunk(times, times, np.ones((10, 3)), np.zeros((10, 3))))
    if with_frames:
        writer.add("frames", frames(12))


def record(trial: str, **changes: Any) -> TrialRecord:
    """A record that fits what `fill` writes."""
    clock = {"map": IDENTITY, "uncertainty_ns": 1000.0}
    return TrialRecord.model_validate(
        {
            "trial": trial,
            "campaign": "c",
            "experiment": "kinematic",
            "role": "measured",
            "block": 0,
            "repetition": 1,
            "attempt": 0,
            "condition": {"depth": "2.4 mm", "side": "left"},
            "simulated": True,
            "recorded_s": 1.0,
            "counts": {"events": 1000, "frames": 12, "poses": 10, "pulses": 10},
            "clocks": {"reference": "sync box", "events": clock, "arm": clock, "frames": clock},
            "quality": {"passed": True, "gates": {}},
            **changes,
        }
    )


def campaign(folder: Path, name: str = "c") -> Campaign:
    """An empty campaign in a new store."""
    found = TrialStore.create(folder).campaign(name)
    found.update({"name": name, "simulated": True}, "protocol: 1\n", "rig: 1\n")
    return found


def commit(where: Campaign, trial: str, **changes: Any) -> Path:
    """One committed trial."""
    writer = where.begin(trial, FRAME, 100)
    fill(writer)
    return writer.commit(record(trial, **changes), Provenance(host="test"))


def fail(where: Campaign, trial: str, attempt: int) -> None:
    """An attempt that a gate set aside."""
    writer = where.begin(trial, FRAME, 100)
    fill(writer)
    cause = {"cause": "gate: frames_lost = 3", "trial": trial, "attempt": attempt}
    writer.quarantine(where.quarantine_path(trial), record(trial), Provenance(), cause)
