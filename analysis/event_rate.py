"""Events a second over a recording."""

from __future__ import annotations

import numpy as np

from sliplab.storage.streams import F64
from sliplab.storage.trials.recording import Recording

RATE_NS = 10_000_000
"""Width of a bin of the event rate."""


def event_rate(recording: Recording, start_ns: int, end_ns: int) -> tuple[F64, F64]:
    """Return events per second in bins of 10 ms from the recording's start, whole bins only.

    Returns:
        (k,) float64 middle of each bin, s; (k,) float64 events a second.
    """
    bins = max(0, (end_ns - start_ns) // RATE_NS)
    edges = start_ns + np.arange(bins + 1, dtype=np.int64) * RATE_NS
    device_us = -(-np.asarray(recording.clock("events").to_device(edges)) // 1000)
    with recording.open() as reader:
        times = reader.event_times()
    counted = np.diff(np.searchsorted(times, device_us, "left"))
    return (edges[:-1] + RATE_NS // 2) / 1e9, counted * (1e9 / RATE_NS)
