"""The live detector over an hour of stream: how long a window waits for its decision, and memory.

The events of a simulated slide are sent again and again, each time later, in packets of 5 ms, as an
event camera hands them over. What is timed is the call that ends a window: binning the packet, the
network's spikes, the rule. Nothing waits for real time; the hour is the stream's.

The detector by single papillae has the same slide with a million events a second, in packets of
1 ms. The timed call returns a packet's evidence.
"""

from __future__ import annotations

import time
from array import array
from dataclasses import replace
from itertools import pairwise

import numpy as np

from benchmarks.measure import SEED, Figures, one_core, resident_mb
from benchmarks.network import gridded
from benchmarks.slides import HOLD_S, slide_events
from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.live import LiveDetector
from sliplab.analysis.detectors.network_detector import NetworkDetector
from sliplab.analysis.detectors.papillae import LEAST, Papillae
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.protocols.detection import Detection
from sliplab.protocols.windows import Windows
from sliplab.storage.streams import EventChunk

PACKET_US, SHORT_US = 5_000, 1_000
HOUR_S, DENSE_S, DENSE_HZ = 3600.0, 10.0, 1e6
AROUND_US = 10_000


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
        **_papillae(),
    }


def _papillae() -> Figures:
    """Milliseconds of a packet at a million events a second; whether evidence is as of one push."""
    slide, rng = slide_events(), np.random.default_rng(SEED)
    begin_us = int(slide.t_us[0]) + round(HOLD_S * 1e6)
    count = round(DENSE_HZ * SHORT_US * 1e-6)
    parts = []
    for packet in range(round(DENSE_S * 1e6) // SHORT_US):
        middle = begin_us + packet * SHORT_US
        near = np.searchsorted(slide.t_us, (middle - AROUND_US, middle + AROUND_US))
        some = slide[rng.integers(*near, count)]
        t_us = packet * SHORT_US + np.sort(rng.integers(0, SHORT_US, count))
        parts.append(replace(some, t_us=t_us))
    live = LiveDetector(AtLevel(Papillae(), LEAST), origin_us=0)
    wall, processor, values = [], [], []
    with one_core():
        for number, packet in enumerate(parts, 1):
            started, used = time.perf_counter(), time.thread_time()
            made = live.push(packet) + live.advance(number * SHORT_US)
            wall.append(time.perf_counter() - started)
            processor.append(time.thread_time() - used)
            values += [decision.value for decision in made]
    stored = Papillae()
    stored.begin(640, 480)
    whole = stored.push(EventChunk.concatenate(parts), len(parts) * SHORT_US)
    return {
        "papillae_ms_median": float(np.median(wall)) * 1e3,
        "papillae_ms_p99": float(np.percentile(wall, 99)) * 1e3,
        "papillae_processor_ms_p99": float(np.percentile(processor, 99)) * 1e3,
        "papillae_equal": float(np.array_equal(values, whole.value)),
    }
