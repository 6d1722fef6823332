"""A detector on a stream gives what it gives on the whole; what is wrong with it is an error."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors.at_level import AtLevel
from sliplab.analysis.detectors.detector import (
    Detector,
    DetectorError,
    Evidence,
    Scene,
    Slip,
    checked,
)
from sliplab.analysis.detectors.feeding import feed
from sliplab.analysis.detectors.live import LiveDetector
from sliplab.analysis.metrics.classification import CLASSES, INCIPIENT, NO_SLIP
from sliplab.storage.streams import EventChunk
from tests.patching import put
from tests.plugins.bench.made import Counting

STEP_US = 10_000


def numbers(text: str) -> list[float]:
    return [*map(float, text.split())]


def events(t_us: list[int]) -> EventChunk:
    n = len(t_us)
    zeros = np.zeros(n, np.uint16)
    return EventChunk(zeros, zeros, zeros.astype(np.uint8), np.array(t_us, np.int64))


class Saying(Detector):
    """Gives an answer at the end of each chunk."""

    def __init__(self, value: float, label: int = -1) -> None:
        self.value, self.label = value, label

    def begin(self, width: int, height: int) -> None:
        pass

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        if self.value == np.inf:
            raise OSError("no accelerator")
        return Evidence.of([until_us], [self.value], [self.label])


@settings(max_examples=60)
@given(
    st.lists(st.integers(0, 9000), min_size=1, max_size=50),
    st.lists(st.integers(0, 50), max_size=9),
    st.integers(0, 4),
)
def test_a_stream_cut_anywhere_gives_what_the_scene_gives(
    steps: list[int], cut: list[int], level: int
) -> None:
    t_us = (5_000_000 + np.cumsum(steps)).tolist()
    live = LiveDetector(AtLevel(Counting(), level))
    edges = [0, *sorted(min(place, len(t_us)) for place in cut), len(t_us)]
    made = []
    for begin, end in itertools.pairwise(edges):
        made += live.push(events(t_us[begin:end]))
    end_us = t_us[-1] - t_us[0] + 3 * STEP_US
    made += live.advance(t_us[0] + end_us)
    moved = events([t - t_us[0] for t in t_us])
    whole = feed(Counting(), Scene("", moved, 640, 480, end_us, Slip(0, 0, 0)))
    assert [it.value for it in made] == whole.value.tolist()
    assert [it.end_us - t_us[0] for it in made] == whole.t_us.tolist()
    assert [it.events for it in made] == whole.value.tolist()  # evidence: events of each step
    above = [INCIPIENT if value > level else NO_SLIP for value in whole.value]
    assert [it.valid_class for it in made] == above
    first = above.index(INCIPIENT) if INCIPIENT in above else None
    assert [k for k, it in enumerate(made) if it.onset] == ([] if first is None else [first])
    assert vars(live.losses) == {"late": 0, "disordered": 0, "gaps": 0, "longest_gap_us": 0}


def test_events_that_come_late_are_left_out_and_counted() -> None:
    live = LiveDetector(AtLevel(Counting(), 0))
    assert live.push(events([0, 12_000]))[0].events == 1
    assert live.push(events([11_000, 13_000])) == []  # older than what the detector was given
    (made,) = live.advance(20_000)
    assert (made.events, live.losses.late, live.losses.disordered) == (2, 1, 0)


def test_a_gap_begins_a_new_scene_and_onsets_stay() -> None:
    live = LiveDetector(AtLevel(Counting(), 1), gap_us=1_000_000)
    before = live.push(events([0, 1, 2, 15_000]))
    after = live.push(events([5_000_007, 5_000_008, 5_000_009, 5_011_000]))
    assert [it.onset for it in (*before, *after)] == ["incipient", None]
    assert (after[0].start_us, after[0].end_us, after[0].events) == (5_000_007, 5_010_007, 3)
    assert [it.number for it in (*before, *after)] == [0, 1]


def test_gross_slip_is_the_detectors_own_class() -> None:
    for label, name in ((2, "gross"), (1, "incipient"), (0, "incipient"), (-1, "incipient")):
        live = LiveDetector(AtLevel(Saying(3.0, label), 2.0), origin_us=0)
        (made,) = live.advance(STEP_US)
        assert CLASSES[made.valid_class] == name


@pytest.mark.parametrize(
    ("value", "said"), [(np.nan, "nan or inf"), (np.inf, "OSError: no accelerator")]
)
def test_a_detector_that_fails_is_an_error(value: float, said: str) -> None:
    live = LiveDetector(AtLevel(Saying(value), 0.0), origin_us=0)
    with pytest.raises(DetectorError, match=said):
        live.advance(STEP_US)


def evidence(**change: object) -> Evidence:
    good = {"t_us": np.array([STEP_US]), "value": np.array([1.0]), "label": np.array([-1], np.int8)}
    return Evidence(**{**good, **change})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: evidence(value=None), "values of evidence are of type NoneType"),
        (lambda: evidence(t_us=[STEP_US]), "times of evidence are of type list"),
        (lambda: evidence(t_us=np.array(5)), r"evidence has \(\) times; must be one list"),
        (lambda: evidence(t_us=np.array([np.nan])), "times of evidence, float64, must be whole"),
        (lambda: evidence(t_us=np.array([5.5])), "times of evidence, float64, must be whole"),
        (lambda: Evidence.of([5.5], [1.0]), "times of evidence, float64, must be whole"),
        (lambda: evidence(value=np.array(["x"])), "values of evidence, <U1, must be real"),
        (lambda: evidence(value=np.array([1j])), "values of evidence, complex128, must be real"),
        (lambda: Evidence.of([5], [1j]), "values of evidence, complex128, must be real"),
        (lambda: evidence(value=np.zeros(2)), "must be as many"),
        (lambda: evidence(label=np.array([np.nan])), "labels of evidence, float64, must be whole"),
        (lambda: evidence(label=np.array([0.7])), "labels of evidence, float64, must be whole"),
        (lambda: Evidence.of([5], [1.0], [256]), "labels of evidence, int64, must be whole"),
        (lambda: evidence(slipped=[0.5]), "shares of tips of evidence are of type list"),
        (lambda: evidence(slipped=np.array([np.inf])), "must be from 0 to 1, or nan"),
        (dict, "push returned dict"),
        (lambda: sys.exit(3), "SystemExit: 3"),
        (lambda: checked(None, 0, 1), "push returned NoneType"),  # it raises a DetectorError
    ],
)
def test_evidence_of_another_kind_is_a_detector_error(
    made: Callable[[], Evidence], said: str
) -> None:
    detector = Saying(0.0)
    put(detector, "push", lambda events, until_us: made())
    live = LiveDetector(AtLevel(detector, 0.0), origin_us=0)
    with pytest.raises(DetectorError, match=said) as found:
        live.advance(STEP_US)
    assert found.value.__cause__ is not found.value


def test_evidence_in_other_types_of_the_same_numbers_is_taken() -> None:
    made = evidence(t_us=np.array([9.0]), value=np.array([2]), label=np.array([1]))
    taken = checked(made, 0, 10)
    assert (taken.t_us.dtype, taken.value.dtype, taken.label.dtype) == (np.int64, float, np.int8)
    assert not len(checked(Evidence(np.array([]), np.array([]), np.array([])), 0, 10))


class Tips(Detector):
    """Evidence and shares of slipped tips as they are given, one a millisecond."""

    def __init__(self, value: list[float], slipped: list[float]) -> None:
        self._value, self._slipped = value, np.array(slipped)

    def begin(self, width: int, height: int) -> None:
        pass

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        found = Evidence.of(1000 * np.arange(1, len(self._value) + 1), self._value)
        return replace(found, slipped=self._slipped)


def test_slip_goes_on_after_an_alarm_for_as_long_as_tips_slip() -> None:
    value = numbers("5 0 20 20 0 0 0 0 0 20 0 20 0 0 0 0 0")
    share = numbers("0.1 0.2 0 0.3 0.6 1 0 0.3 nan 0.98 nan 0 0 0.5 0.98 0.82 0.7")
    judged = AtLevel(Tips(value, share), 12.0)
    judged.begin(640, 480)
    found = judged.push(EventChunk.empty(), 17_000)
    assert found.label.tolist() == [0, 0, 1, 1, 1, 2, 0, 0, 0, 2, 0, 1, 0, 1, 2, 2, 1]
    assert found.slipped is not None
    shown = numbers("0 0 0 0.3 0.6 1 0 0 nan 0.98 nan 0 0 0.5 0.98 0.82 0.7")
    assert np.array_equal(found.slipped, shown, equal_nan=True)
