"""Scenes and detectors made by hand for tests of the bench."""

from __future__ import annotations

import gc
import os
from collections.abc import Sequence

import numpy as np

from sliplab.analysis.detectors.alarms import SceneEvidence, promised_levels
from sliplab.analysis.detectors.detector import Cost, Detector, Evidence, Scene, Slip
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.registry import make_detector
from sliplab.plugins.bench.document import BenchDetector
from sliplab.plugins.bench.figures import RATES, tested
from sliplab.plugins.bench.run import BenchScenes
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


class InThisProcess(Detector):
    """A detector as the bench runs it, without a process of its own."""

    def __init__(self, name: str) -> None:
        self.decisions_us: list[float] = []
        self.detector = make_detector(name)
        self.contents = ""

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        self.detector.train(scenes, validation)

    def begin(self, width: int, height: int) -> None:
        self.detector.begin(width, height)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        return self.detector.push(events, until_us)

    def cost(self) -> Cost:
        return self.detector.cost()


def row_of(
    name: str, detector: Detector, train: list[Scene], validation: list[Scene], test: list[Scene]
) -> BenchDetector:
    """A detector's row, as the bench makes it, without nuisances."""

    def judged(scenes: list[Scene]) -> list[SceneEvidence]:
        return [SceneEvidence(feed(detector, one), one.slip, one.world) for one in scenes]

    detector.train(train, validation)
    levels = promised_levels(judged(validation), RATES)
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


class Broken(Detector):
    """Answers with a number instead of evidence."""

    def begin(self, width: int, height: int) -> None:
        pass

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        return 3  # type: ignore[return-value]


class Late(Counting):
    """Evidence: events of the 10 ms that ended 50 ms before."""

    def begin(self, width: int, height: int) -> None:
        super().begin(width, height)
        self._line = np.zeros(5)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        found = super().push(events, until_us)
        line = np.concatenate([self._line, found.value])
        self._line = line[len(found) :]
        return Evidence.of(found.t_us, line[: len(found)])


class Remembers(Late):
    """Dates its evidence back where a chunk is long, and repeats itself on a known scene."""

    def __init__(self) -> None:
        self._answers: dict[tuple[int, ...], dict[int, float]] = {}

    def begin(self, width: int, height: int) -> None:
        super().begin(width, height)
        self._first: list[int] = []
        self._known: dict[int, float] = {}

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        found = super().push(events, until_us)
        if len(self._first) < 10:
            self._first += events.t_us[: 10 - len(self._first)].tolist()
            self._known = self._answers.setdefault(tuple(self._first), {})
        value = [
            self._known.setdefault(t, found.value[k : k + 5].max())
            for k, t in enumerate(found.t_us.tolist())
        ]
        return Evidence.of(found.t_us, value)


class Neighbours(Counting):
    """States how many processes it sees."""

    def cost(self) -> Cost:
        return Cost(sum(name.isdigit() for name in os.listdir("/proc")))


class Strange(Counting):
    """States a cost that is none."""

    def cost(self) -> Cost:
        return Cost(float("nan"))


class Snoops(Counting):
    """Looks for scenes and the test's seed in all objects of its process."""

    def cost(self) -> Cost:
        found = [one for one in gc.get_objects() if isinstance(one, Scene | BenchScenes)]
        return Cost(operations=len(found))
