"""The live detector over an hour of stream: how long a window waits for its decision, and memory.

The events of a simulated slide are sent again and again, each time later, in packets of 5 ms, as an
event camera hands them over. What is timed is the call that ends a window: binning the packet, the
network's spikes, the rule. Nothing waits for real time; the hour is the stream's.
"""

from __future__ import annotations

import time
from array import array
from dataclasses import replace
from itertools import pairwise

import numpy as np

from benchmarks.measure import SEED, Figures, one_core, resident_mb
from benchmarks.network import gridded
from benchmarks.slides import slide_events
from sliplab.analysis.detectors.live import LiveDetector
from sliplab.analysis.detectors.network_detector import NetworkDetector
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows

PACKET_US = 5_000
HOUR_S = 3600.0


def measure(seconds: float = HOUR_S) -> Figures:
    """Milliseconds from the packet that ends a window to its decision; memory over the stream."""
    events = slide_events()
    first, last = int(events.t_us[0]), int(events.t_us[-1])
    length = last - first + PACKET_US
    edges = np.searchsorted(events.t_us, np.arange(first, last + PACKET_US, PACKET_US))
    parts = [slice(int(a), int(b)) for a, b in pairwise(edges) if b > a]
    engine = SpikeEngine(gridded(Windows(), SEED), Windows().cells)
    network = NetworkDetector(lambda x: engine.counts(x, 1), Windows(), Detection())
    network.warm_up(640, 480)
    live = LiveDetector(network)
    taken = array("d")  # a list would grow by more than the detector
    memory: list[float] = []
    windows = 0
    with one_core():
        for turn in range(max(1, round(seconds * 1e6 / length))):
            moved = events.t_us + turn * length
            for part in parts:
                packet = replace(
                    events, x=events.x[part], y=events.y[part], p=events.p[part], t_us=moved[part]
                )
                started = time.perf_counter()
                made = live.push(packet)
                if made:
                    taken.append((time.perf_counter() - started) / len(made))
                    windows += len(made)
            memory.append(resident_mb())
    ms = np.array(taken) * 1e3
    tenth = len(memory) // 10
    return {
        "stream_s": float(turn + 1) * length / 1e6,
        "windows": float(windows),
        "decision_ms_median": float(np.median(ms)),
        "decision_ms_p99": float(np.percentile(ms, 99)),
        "decision_ms_max": float(ms.max()),
        "memory_growth_mb": memory[-1] - memory[tenth],
        "windows_given_up": float(live.losses.gaps),
    }
