"""Scenes and detectors made by hand for tests of the bench."""

from __future__ import annotations

import numpy as np

from sliplab.analysis.detectors.detector import Detector, Evidence, Scene, Slip
from sliplab.analysis.detectors.feeding import feed
from sliplab.plugins.bench.alarms import SceneEvidence
from sliplab.plugins.bench.document import BenchDetector
from sliplab.plugins.bench.figures import RATES, tested, validated
from sliplab.storage.streams import EventChunk

SLIP_HZ = 2000


def scene(rng: np.random.Generator, hold_s: float) -> Scene:
    """Noise of 200 events a second, and ten times as many from the slip on."""
    slip_us = round(1e6 * (hold_s + rng.uniform(0.2, 1.0)))
    gross_us = slip_us + 3_000_000
    end_us = gross_us + 500_000
    noise = rng.integers(0, end_us, 200 * end_us // 1_000_000)
    signal = rng.integers(slip_us, end_us, SLIP_HZ * (end_us - slip_us) // 1_000_000)
    t_us = np.sort(np.concatenate([noise, signal]))
    x, y = (rng.integers(0, side, len(t_us)).astype(np.uint16) for side in (640, 480))
    p = rng.integers(0, 2, len(t_us)).astype(np.uint8)
    slip = Slip(slip_us, slip_us + 90_000, gross_us)
    return Scene(f"hold of {hold_s:.0f} s", EventChunk(x, y, p, t_us), 640, 480, end_us, slip)


def some_scenes(seed: int) -> list[Scene]:
    """Twelve slides after short holds, and four after a minute."""
    rng = np.random.default_rng(seed)
    holds = [*rng.uniform(1.0, 8.0, 12), *rng.uniform(50.0, 70.0, 4)]
    return [scene(rng, float(hold_s)) for hold_s in holds]


class Counting(Detector):
    """Evidence: events of each 10 ms."""

    def begin(self, width: int, height: int) -> None:
        self._held = np.empty(0, np.int64)
        self._next_us = 10_000

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        held = np.concatenate([self._held, events.t_us])
        ends = np.arange(self._next_us, until_us + 1, 10_000)
        count = np.searchsorted(held, ends) - np.searchsorted(held, ends - 10_000)
        if len(ends):
            self._next_us = int(ends[-1]) + 10_000
        self._held = held[np.searchsorted(held, self._next_us - 10_000) :]
        return Evidence.of(ends, count)


def row_of(
    name: str, detector: Detector, train: list[Scene], validation: list[Scene], test: list[Scene]
) -> BenchDetector:
    """A detector's row, as the bench makes it, without nuisances."""

    def judged(scenes: list[Scene]) -> list[SceneEvidence]:
        return [SceneEvidence(feed(detector, one), one.slip, one.world) for one in scenes]

    detector.train(train, validation)
    levels = validated(judged(validation), RATES)
    return BenchDetector(
        name=name,
        curve=tested(judged(test), levels),
        nuisances={},
        accuracy=None,
        operations=None,
        memory_bytes=None,
        decision_us=0.0,
        train_s=0.0,
    )
