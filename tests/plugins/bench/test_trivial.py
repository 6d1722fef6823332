"""Detectors that know nothing are at the bottom of the table."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from sliplab.analysis.detectors.detector import Detector, Evidence, Scene
from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.plugins.bench.document import BenchDetector, MedianLatency
from sliplab.plugins.bench.entries.trivial import Always, Blind, ByTheClock, Never, Random
from sliplab.plugins.bench.figures import ranked
from sliplab.storage.streams import EventChunk
from tests.plugins.bench.made import Counting, row_of, some_scenes


class SinceTheBeginning(Blind):
    """A clock that is surer the later it is."""

    def value(self, t_us: np.ndarray) -> np.ndarray:
        return t_us.astype(float)


class Comb(Blind):
    """Cries for a moment every three seconds."""

    def value(self, t_us: np.ndarray) -> np.ndarray:
        return (t_us % 3_000_000 == 0).astype(float)


class KnowsThePublicScenes(Detector):
    """Is silent in scenes that it was shown, and cries in others."""

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        self._known = {int(one.events.t_us[0]) for one in [*scenes, *validation]}

    def begin(self, width: int, height: int) -> None:
        self._first: int | None = None
        self._time = Comb()
        self._time.begin(width, height)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        if self._first is None and len(events):
            self._first = int(events.t_us[0])
        found = self._time.push(events, until_us)
        quiet = self._first in self._known
        return Evidence.of(found.t_us, np.full(len(found), -np.inf) if quiet else found.value)


TRIVIAL = {
    "always": Always,
    "never": Never,
    "random": Random,
    "clock": ByTheClock,
    "since the beginning": SinceTheBeginning,
    "comb": Comb,
    "knows the public scenes": KnowsThePublicScenes,
}


@pytest.mark.quick(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_they_are_below_a_detector_that_sees_the_slip(seed: int) -> None:
    train, validation, test = (some_scenes(10 * seed + k) for k in range(3))
    rows = [
        row_of(name, kind(), train, validation, test)
        for name, kind in (TRIVIAL | {"counting": Counting}).items()
    ]
    best, *others = ranked(rows)
    assert best.name == "counting"
    assert best.table.test.latency_ms.value is not None
    assert best.table.test.missed == 0
    for row in others:
        assert row.table.test.latency_ms.value is None, f"{row.name} detects half of the slips"
        assert row.table.test.missed >= 14, f"{row.name} detects slips of 16"


def test_a_constant_cry_never_exceeds_its_level_at_any_rate_of_the_curve() -> None:
    row = row_of("always", Always(), *(some_scenes(k) for k in range(3)))
    assert {point.test.missed for point in row.curve} == {16}


def test_who_breaks_the_asked_rate_on_test_scenes_comes_after_who_keeps_it() -> None:
    never = row_of("never", Never(), *(some_scenes(k) for k in range(3)))

    def row(name: str, latency_ms: float, alarms: int) -> BenchDetector:
        """A row with another latency and so many false alarms in an hour, each in a world."""
        median = MedianLatency(value=latency_ms, low=None, high=None)
        worlds = [1] * alarms + [0] * (8 - alarms)
        figures = {"latency_ms": median, "false_alarms": alarm_rate(worlds, [1 / 8] * 8)}
        test = never.table.test.model_copy(update=figures)
        point = never.table.model_copy(update={"test": test})
        return never.model_copy(update={"name": name, "curve": (point,)})

    # four alarms where one was asked for may be chance: their rate is 1.09 at least, three's 0.62
    rows = [never, row("broken", 1.0, 4), row("kept", 200.0, 3), row("quicker", 100.0, 3)]
    assert [row.name for row in ranked(rows)] == ["quicker", "kept", "broken", "never"]
