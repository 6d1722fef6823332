"""Rules that a detector must keep, and what is said where it does not."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.detectors.detector import Detector, DetectorError, Evidence, Scene
from sliplab.analysis.detectors.feeding import feed, steady
from sliplab.plugins.bench.audit import COARSE_US, FINE_US, audit, drawn_edges
from sliplab.storage.streams import EventChunk
from tests.plugins.bench.made import Counting, scene


@pytest.fixture(scope="module")
def one() -> Scene:
    return scene(np.random.default_rng(1), 2.0)


class Answering(Detector):
    """Gives the same answer to each chunk, moved by the time before it."""

    def __init__(self, t_us: list[int], value: list[float], label: list[int] | None = None) -> None:
        self._answer = (t_us, value, label)

    def begin(self, width: int, height: int) -> None:
        self._before_us = 0

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        t_us, value, label = self._answer
        found = Evidence.of(self._before_us + np.array(t_us), value, label)
        self._before_us = until_us
        return found


@pytest.mark.parametrize(
    ("detector", "said"),
    [
        (Answering([0], [1.0]), "evidence at 0 us; must be after 0 us"),
        (Answering([1_000_001], [1.0]), "must be after 0 us and not after 1000000 us"),
        (Answering([5, 5], [1.0, 2.0]), "times of evidence must increase"),
        (Answering([5], [np.nan]), "must be finite or -inf"),
        (Answering([5], [np.inf]), "must be finite or -inf"),
        (Answering([5], [1.0], [3]), "label = 3: must be -1"),
        (Answering([5], [1.0, 2.0]), r"1 times, \(2,\) values"),
    ],
)
def test_evidence_that_is_none_is_refused(detector: Detector, said: str, one: Scene) -> None:
    with pytest.raises(DetectorError, match=said):
        feed(detector, one)


LEVEL = 15.0


class LooksAhead(Counting):
    """Counts the events of the next 100 ms, where it has been given them."""

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        found = super().push(events, until_us)
        later = np.searchsorted(events.t_us, found.t_us + 100_000)
        return Evidence.of(found.t_us, later - np.searchsorted(events.t_us, found.t_us))


class HidesIt(LooksAhead):
    """Says one huge number before, so that differences look small beside it."""

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        found = super().push(events, until_us)
        return Evidence.of(found.t_us, np.where(found.t_us < 500_000, -1e9, found.value))


@pytest.mark.parametrize("detector", [LooksAhead(), HidesIt()])
def test_a_detector_that_looks_ahead_is_refused(detector: Detector, one: Scene) -> None:
    found = feed(detector, one, steady(one, FINE_US))
    with pytest.raises(DetectorError, match="must depend on earlier events alone"):
        audit(detector, one, drawn_edges(one, 1), found, [LEVEL])


def test_a_detector_that_does_not_is_accepted(one: Scene) -> None:
    found = feed(Counting(), one, steady(one, FINE_US))
    again = audit(Counting(), one, drawn_edges(one, 1), found, [-np.inf, LEVEL])
    assert np.array_equal(again.value, found.value)
    assert (found.value > LEVEL).any()


def test_rounding_is_no_look_ahead(one: Scene) -> None:
    class Rounded(Counting):
        """Its numbers depend on the size of chunks, as sums in another order do."""

        def push(self, events: EventChunk, until_us: int) -> Evidence:
            found = super().push(events, until_us)
            return Evidence.of(found.t_us, found.value * (1 + 1e-6 * len(events)))

    found = feed(Rounded(), one, steady(one, FINE_US))
    audit(Rounded(), one, drawn_edges(one, 1), found, [LEVEL])


def test_longer_chunks_are_drawn_anew_and_cover_the_scene(one: Scene) -> None:
    edges = drawn_edges(one, 1)
    assert edges == drawn_edges(one, 1)
    assert edges != drawn_edges(one, 2)
    lengths = np.diff([0, *edges])
    assert lengths[:-1].min() >= COARSE_US[0]
    assert 0 < lengths[-1] <= lengths.max() <= COARSE_US[1]
    assert edges[-1] == one.end_us


def test_all_events_are_given_once_and_in_time(one: Scene) -> None:
    seen: list[int] = []

    class Watching(Answering):
        def push(self, events: EventChunk, until_us: int) -> Evidence:
            assert (events.t_us < until_us).all()
            assert (events.t_us >= self._before_us).all()
            seen.extend(events.t_us.tolist())
            return super().push(events, until_us)

    feed(Watching([], []), one)
    assert seen == one.events.t_us.tolist()
